"""`softloop faults` and `softloop run --faults`: run scenarios, judge each by its log, and say how it ended."""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from time import gmtime, strftime
from typing import TYPE_CHECKING, Any

from softloop.deploy.bench import Bench
from softloop.deploy.conclude import conclude
from softloop.deploy.launcher import Options, Outcome, launch
from softloop.deploy.progress import counted_progress
from softloop.deploy.rig_state import event_line
from softloop.deploy.scenario import Scenario, bench_of, find_scenario, load_scenario, make_bench, shipped_scenarios, write_bench
from softloop.wire.errors import EXIT_INTERRUPTED, EXIT_NEGATIVE, EXIT_OK, BadFile, Interrupted, Unavailable

if TYPE_CHECKING:
    from softloop.offline.log import Log

NOTHING = "NOTHING"  # the rig was not armed, or nothing was injected: no outcome to judge
_SHOWN = 8


@dataclass(frozen=True)
class Result:
    """How a scenario ended.

    Attributes:
        seen: VENT, DEAD, CONTINUE, TRAPPED, NONE or NOTHING; see `offline.safe_outcome`.
        chamber_kpa: chamber pressure when the first thing went wrong; of CONTINUE and TRAPPED, at the planned end.
        vent_s, empty_s: from then to charge current 0 with the exhaust open, and to under 5 kPa; None: never.
        events: what was said in the run from the first injection on.
    """

    scenario: str
    expected: str
    seen: str
    chamber_kpa: float | None
    vent_s: float | None
    empty_s: float | None
    events: list[str]
    ended: str
    run: str

    @property
    def good(self) -> bool:
        return self.seen == self.expected


def run_with_faults(bench_file: Path, scenario_file: Path, options: Options) -> int:
    """Run a bench under a scenario, conclude as after any run, and say how the scenario ended; returns the exit code.

    A bench without a simulated rig has no truth to judge by: then the code is that of the run.

    Raises BadFile, BadConfig, Unavailable.
    """
    file = find_scenario(scenario_file)
    scenario = load_scenario(file)
    asked = {"pace": options.pace, "duration_s": options.duration_s}
    scenario = scenario.model_copy(update={key: value for key, value in asked.items() if value is not None})

    def then(bench: Bench, run_dir: Path, outcome: Outcome, *, quiet: bool) -> int:
        code = conclude(bench, run_dir, outcome.code, outcome.text, began=outcome.began, quiet=quiet)
        if code == EXIT_INTERRUPTED or not outcome.began:
            return code
        if bench.plant is None:
            sys.stderr.write("softloop: no simulated rig, so no truth to judge the scenario by; see the events above\n")
            return code
        result = judged(scenario, bench, run_dir, outcome)
        if not quiet:
            _print_table([result])
        return EXIT_OK if result.good else EXIT_NEGATIVE

    return _launched(scenario, file, bench_file, options, {}, then)


def run_all(only: list[Path], out: Path | None, *, as_json: bool) -> int:
    """Run scenarios one after the other; returns EXIT_NEGATIVE where one did not end as expected.

    Raises BadFile, BadConfig, Unavailable; Interrupted.
    """
    files = [find_scenario(path) for path in only] or list(shipped_scenarios().values())
    scenarios = [(file, load_scenario(file)) for file in files]
    for file, scenario in scenarios:  # a mistake in the last one is said before the first one runs
        make_bench(scenario, file, bench_of(scenario, file))
    folder = out or Path("runs") / f"faults-{strftime('%Y%m%dT%H%M%SZ', gmtime())}"
    results: list[Result] = []
    with counted_progress("scenarios", quiet=as_json) as progress:
        for file, scenario in scenarios:
            progress(len(results), len(scenarios))
            results.append(run_one(scenario, file, folder / scenario.name))
            _keep(folder, results)
    _say(results, as_json=as_json)
    return EXIT_OK if all(result.good for result in results) else EXIT_NEGATIVE


def run_one(scenario: Scenario, file: Path, run_dir: Path) -> Result:
    """Run a scenario on its own bench, in `run_dir`. Raises BadFile, BadConfig, Unavailable; Interrupted."""
    found: list[Result] = []

    def then(bench: Bench, run_dir: Path, outcome: Outcome, *, quiet: bool) -> int:
        if outcome.code == EXIT_INTERRUPTED:
            raise Interrupted(outcome.text)
        found.append(judged(scenario, bench, run_dir, outcome))
        return EXIT_OK

    own = {"name": f"faults-{scenario.name}"[:24]}
    _launched(scenario, file, bench_of(scenario, file), Options(run_dir=run_dir, report=False, quiet=True), own, then)
    return found[0]


def judged(scenario: Scenario, bench: Bench, run_dir: Path, outcome: Outcome) -> Result:
    """What the log of a run says of its scenario."""
    from softloop.offline.log import open_log  # noqa: PLC0415 - it brings numba: only once the rig has stopped
    from softloop.offline.safe_outcome import outcome_of  # noqa: PLC0415

    if bench.recorder is None:
        raise BadFile(f"{run_dir}: the bench has no [recorder], and without a log a scenario cannot be judged")
    log = open_log(run_dir / bench.recorder.file)
    seen = outcome_of(log, bench.run.duration_s)
    given = {"scenario": scenario.name, "expected": scenario.expected, "ended": outcome.text, "run": str(run_dir)}
    if seen is None:
        return Result(seen=NOTHING, chamber_kpa=None, vent_s=None, empty_s=None, events=[], **given)
    events = _events(log, seen.began_ns)
    return Result(seen=seen.seen, chamber_kpa=seen.chamber_kpa, vent_s=seen.vent_s, empty_s=seen.empty_s, events=events, **given)


def _events(log: Log, from_ns: int) -> list[str]:
    """The events of a run from an instant on, each with its time after it."""
    records = log["event"]
    later = records[records["stamp_ns"] >= from_ns]
    ordered = later[later["stamp_ns"].argsort(kind="stable")]
    return [f"{1e-9 * (int(event['stamp_ns']) - from_ns):.3f} s {event_line(event)}" for event in ordered.view(type=_records())]


def _records() -> Any:
    from numpy import recarray  # noqa: PLC0415

    return recarray


def _launched(
    scenario: Scenario, file: Path, bench_file: Path, options: Options, changes: dict[str, Any], then: Callable[..., int]
) -> int:
    with tempfile.TemporaryDirectory(prefix="softloop-faults-") as folder:
        written = Path(folder) / f"{file.stem}.bench.toml"
        write_bench(scenario, file, bench_file, written, changes)
        return launch(written, options, then)


def _keep(folder: Path, results: list[Result]) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "faults.json").write_text(_json(results), encoding="utf-8")
    except OSError as error:
        raise Unavailable(f"{folder}: cannot be written: {error.strerror or error}") from None


def _json(results: list[Result]) -> str:
    rows = [{**asdict(result), "as_expected": result.good} for result in results]
    return json.dumps({"as_expected": all(result.good for result in results), "scenarios": rows}, indent=2)


def _say(results: list[Result], *, as_json: bool) -> None:
    if as_json:
        print(_json(results))
        return
    _print_table(results)
    wrong = [result for result in results if not result.good]
    for result in wrong:
        sys.stderr.write(f"softloop: {result.scenario}: expected {result.expected}, seen {result.seen}: {result.ended}\n")
    print(f"{len(results) - len(wrong)} of {len(results)} scenarios ended as expected")


def _print_table(results: list[Result]) -> None:
    """A line for each scenario, and what was said in it below."""
    print(_line("scenario", "expected", "seen", "from kPa", "vent ms", "< 5 kPa ms"))
    for result in results:
        times = (_number(result.vent_s, 1000, 0), _number(result.empty_s, 1000, 0))
        print(_line(result.scenario, result.expected, result.seen, _number(result.chamber_kpa), *times))
        print("".join(f"    {event}\n" for event in _shown(result.events)), end="")


def _line(scenario: str, expected: str, seen: str, *numbers: str) -> str:
    return f"{scenario:28} {expected:8} {seen:8}" + "".join(f" {number:>10}" for number in numbers)


def _number(value: float | None, times: float = 1.0, places: int = 1) -> str:
    return "-" if value is None else f"{times * value:.{places}f}"


def _shown(events: list[str]) -> list[str]:
    """The first events."""
    more = [f"and {len(events) - _SHOWN} more"] if len(events) > _SHOWN else []
    return events[:_SHOWN] + more
