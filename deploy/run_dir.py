"""The run's directory and the lock that keeps a bench from running twice."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import gmtime, strftime
from typing import Any

import tomlkit

from softloop.deploy.bench import Bench
from softloop.wire.config import runtime_dir
from softloop.wire.errors import BadConfig, BadFile, Unavailable

BENCH_FILE = "bench.toml"
CERTIFICATE_FILE = "certificate.json"  # one of wire.mcap_layout.RUN_FILES, so that the recorder takes it into the log


def make_run_dir(bench: Bench, asked: Path | None, host: str = "") -> Path:
    """The directory of a new run, made now: `asked`, or `<folder>/<bench>[-<host>]-<UTC time>`.

    Raises:
        Unavailable: it cannot be made, or it holds a run already.
    """
    name = f"{bench.name}-{host}" if host else bench.name
    path = asked or Path(bench.run.folder) / f"{name}-{strftime('%Y%m%dT%H%M%SZ', gmtime())}"
    if (path / BENCH_FILE).exists():
        raise Unavailable(f"{path}: holds a run already; name another with --run-dir")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Unavailable(f"{path}: cannot be made: {error.strerror or error}") from None
    return path.resolve()


def keep_bench(run_dir: Path, bench: Bench) -> Path:
    """Write the whole bench into the run's directory, every default included; returns the file."""
    file = run_dir / BENCH_FILE
    text = tomlkit.dumps(bench.model_dump(mode="json", exclude_none=True))
    file.write_text(
        f"# The bench of this run: bases merged, defaults written out, addresses filled in.\n{text}", encoding="utf-8"
    )
    return file


def read_certificate(file: Path) -> dict[str, Any]:
    """What `softloop doctor --certificate` wrote. Raises BadFile when the file is not that."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise BadFile(f"{file}: cannot be read: {error.strerror or error}") from None
    except ValueError:
        raise BadFile(f"{file}: no certificate of `softloop doctor`") from None
    if not isinstance(content, dict) or not {"bench", "verdict", "checks"} <= set(content):
        raise BadFile(f"{file}: no certificate of `softloop doctor`")
    return content


def keep_certificate(run_dir: Path, bench: Bench) -> None:
    """Put the certificate that the bench names beside the log.

    Raises:
        BadFile: it cannot be read, or is none.
        BadConfig: it is that of another bench.
    """
    if not bench.run.certificate:
        return
    file = Path(bench.run.certificate)
    certified = read_certificate(file)["bench"]
    if certified != bench.name:
        raise BadConfig(f"{file}: is the certificate of bench '{certified}', and this is '{bench.name}'")
    (run_dir / CERTIFICATE_FILE).write_bytes(file.read_bytes())


@contextmanager
def bench_lock(name: str) -> Iterator[None]:
    """Held while a bench runs on this machine. Raises Unavailable when somebody else holds it, and says who."""
    path = runtime_dir() / f"softloop-{name}.lock"
    fd = _take(path, name)
    try:
        os.ftruncate(fd, 0)
        os.write(fd, str(os.getpid()).encode())
        yield
    finally:
        path.unlink(missing_ok=True)  # while it is held: whoever opened it before sees below that it is gone
        os.close(fd)


def _take(path: Path, name: str) -> int:
    while True:
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(fd, 32).decode(errors="replace") or "unknown"
            os.close(fd)
            raise Unavailable(f"bench '{name}' is running already (launcher process {holder}); stop it first") from None
        if _is_still(fd, path):
            return fd
        os.close(fd)


def _is_still(fd: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(fd), path.stat())
    except FileNotFoundError:
        return False
