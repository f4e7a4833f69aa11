"""What must be so before processes start: kernels compiled, the trajectory feasible, the parameters kept with the run.

The launcher does it in a child of its own, `softloop prepare`: it stays light, and an error there is an error here.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module, resources
from pathlib import Path
from typing import Any

from softloop.deploy.bench import Bench
from softloop.deploy.envelope import check_envelope
from softloop.wire.errors import EXIT_LOST, BadConfig, Interrupted, SoftloopError
from softloop.wire.shell import Stop

PACKAGE = Path(__file__).resolve().parent.parent
RUN_ROOMS = ("dynamics", "devices", "plant", "controller")
ROOMS = (*RUN_ROOMS, "offline")

POLL_S = 0.05

Progress = Callable[[str, int, int], None]  # module, how many are done, how many there are


@dataclass(frozen=True)
class Prepared:
    """What the launcher learns: the length of the trajectory (0 without a controller) and the number of kernel modules."""

    trajectory_s: float
    kernel_modules: int


def kernel_modules(rooms: Sequence[str] = ROOMS, package: Path = PACKAGE) -> list[str]:
    """Names of all modules of some rooms that define kernels; rooms whose kernels others call come first."""
    files = (f for room in rooms for f in sorted((package / room).rglob("*.py")))
    return [_module_name(f, package) for f in files if "\n@kernel(" in f.read_text(encoding="utf-8")]


def _module_name(file: Path, package: Path) -> str:
    return ".".join(("softloop", *file.relative_to(package).with_suffix("").parts))


def warm(progress: Progress, rooms: Sequence[str] = ROOMS) -> int:
    """Compile, or load from the cache, all kernels of some rooms; returns how many modules. Calls `progress`."""
    modules = kernel_modules(rooms)
    for done, name in enumerate(modules):
        progress(name, done, len(modules))
        import_module(name)
    return len(modules)


def check_controller(bench: Bench) -> float:
    """Build the controller without running it; returns its trajectory's length in s, 0 when the bench has none.

    Raises:
        BadFile, BadConfig: its parameter file or trajectory is wrong, not feasible, or beyond the gate's limits.
    """
    if bench.controller is None:
        return 0.0
    from softloop.controller.setup import build  # noqa: PLC0415 - it brings numba and scipy: only where it is needed

    controller = build(bench.controller)
    check_envelope(bench, controller)
    return controller.plan.duration_s


def prepare(bench: Bench, run_dir: Path, progress: Progress) -> Prepared:
    """Warm, check, and put parameters and the CAN description beside the log. Raises as `check_controller` does."""
    modules = warm(progress, RUN_ROOMS)
    trajectory_s = check_controller(bench)
    check_identity(bench)
    if bench.controller is not None:
        shutil.copyfile(_parameter_file(bench.controller.parameters), run_dir / "parameters.toml")
    dbc = Path(str(resources.files("softloop.devices.protocols") / "rig.dbc"))
    shutil.copyfile(dbc, run_dir / "rig.dbc")
    return Prepared(trajectory_s, modules)


def check_identity(bench: Bench) -> None:
    """That the controller's parameters were identified on this rig, where their file says on which. Raises BadConfig."""
    if bench.controller is None or bench.run.foreign_parameters:
        return
    from softloop.controller.setup import parameters_of  # noqa: PLC0415 - likewise

    evidence, rig = parameters_of(bench.controller).evidence, bench.run.rig or bench.name
    if evidence is not None and evidence.rig != rig:
        raise BadConfig(
            f"parameters '{bench.controller.parameters}' were identified on rig '{evidence.rig}' and this is '{rig}' "
            "(key 'run.rig', default the bench's name); to run on them all the same set run.foreign_parameters = true"
        )


def _parameter_file(named: str) -> Path:
    from softloop.dynamics.parameters import shipped  # noqa: PLC0415 - likewise

    return shipped(named) if shipped(named).is_file() else Path(named)


def prepare_in_child(bench_file: Path, run_dir: Path, stop: Stop, progress: Progress) -> Prepared:
    """`softloop prepare` in a process of its own. Raises SoftloopError with that process's line and exit code."""
    command = [sys.executable, "-m", "softloop.deploy.cli", "prepare", str(bench_file), "--run-dir", str(run_dir)]
    log = run_dir / "prepare.log"
    with (
        log.open("wb") as errors,
        subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=errors, text=True, start_new_session=True
        ) as child,
    ):
        result: list[Prepared] = []
        reader = threading.Thread(target=_read_lines, args=(child.stdout, progress, result), daemon=True)
        reader.start()
        while child.poll() is None:
            if stop.wait(POLL_S):
                child.kill()
        reader.join()
    if stop:
        raise Interrupted("interrupted before any process was started")
    if child.returncode != 0 or not result:
        raise _failure(child.returncode, log)
    log.unlink()
    return result[0]


def _read_lines(lines: Any, progress: Progress, result: list[Prepared]) -> None:
    for line in lines:
        content = json.loads(line)
        if "module" in content:
            progress(content["module"], content["done"], content["total"])
        else:
            result.append(Prepared(**content))


def _failure(code: int, log: Path) -> SoftloopError:
    lines = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    failure = SoftloopError(
        lines[-1].removeprefix("softloop: ") if lines else "the bench cannot be prepared, and nothing says why"
    )
    failure.exit_code = code if code > 0 else EXIT_LOST
    return failure


def prepare_as_child(bench: Bench, run_dir: Path) -> None:
    """The child's side: progress and result as JSON lines on standard output."""

    def tell(module: str, done: int, total: int) -> None:
        print(json.dumps({"module": module, "done": done, "total": total}), flush=True)

    print(json.dumps(asdict(prepare(bench, run_dir, tell))), flush=True)
