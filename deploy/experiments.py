"""Runs started from the page: `softloop run` as a child, on the page's bench with another law or trajectory."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

import tomlkit

from softloop.deploy.bench import Bench, load_bench
from softloop.deploy.children import PROGRAM, Child
from softloop.wire.errors import SoftloopError

END_S = 30.0


class Experiments:
    """At most one run at a time.

    Attributes:
        on_change: called, from any thread, when `state` has changed.
    """

    def __init__(self, bench: Bench, file: Path) -> None:
        self._bench = bench
        self._file = file
        self._folder = tempfile.TemporaryDirectory(prefix="softloop-page-")
        self._child: Child | None = None
        self._waiter: threading.Thread | None = None
        self._said = "no experiment was started from here"
        self._chosen: dict[str, str] = {}
        self.on_change: Callable[[], None] = lambda: None

    def __enter__(self) -> Experiments:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """End what runs, as Ctrl-C would: it vents, stops its processes and leaves its summary."""
        if self._child is not None and self.running:
            self._child.popen.send_signal(signal.SIGINT)
            try:
                self._child.popen.wait(END_S)
            except subprocess.TimeoutExpired:
                self._child.popen.terminate()
        if self._waiter is not None:
            self._waiter.join(1.0)
        self._folder.cleanup()

    @property
    def running(self) -> bool:
        return self._child is not None and self._child.exit_code() is None

    def state(self) -> dict[str, Any]:
        """What the page shows."""
        return {"running": self.running, "text": self._said, **self._chosen}

    async def start(self, asked: dict[str, Any]) -> dict[str, Any]:
        """Start a run: `law`, `trajectory`, `duration_s` (0: to its end). Returns `error` in one line when it cannot be."""
        return await asyncio.to_thread(self._start, asked)

    async def end(self, _asked: dict[str, Any]) -> dict[str, Any]:
        """Ask the run to end, as Ctrl-C does."""
        if self._child is None or not self.running:
            return {"error": "no experiment of this page is running"}
        self._child.popen.send_signal(signal.SIGINT)
        self._say("ending: it vents and stops")
        return {}

    def _start(self, asked: dict[str, Any]) -> dict[str, Any]:
        if self.running:
            return {"error": "an experiment is running"}
        try:
            file = self._bench_file(asked)
            load_bench(file)
        except (SoftloopError, ValueError, TypeError) as error:
            return {"error": " ".join(str(error).split())}
        log = Path(self._folder.name) / "run.log"
        with log.open("wb") as output:
            popen = subprocess.Popen(
                [*PROGRAM, "run", str(file)], stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True
            )
        self._child = Child("run", popen, log)
        self._chosen = {name: str(asked[name]) for name in ("law", "trajectory") if asked.get(name)}
        self._say("starting")
        self._waiter = threading.Thread(target=self._wait, args=(self._child,), name="experiment", daemon=True)
        self._waiter.start()
        return {}

    def _bench_file(self, asked: dict[str, Any]) -> Path:
        """A bench file on the page's own with what was asked for."""
        controller = {name: str(asked[name]) for name in ("law", "trajectory") if asked.get(name)}
        content = {"base": str(self._file.resolve()), "name": self._bench.name, "controller": controller}
        duration_s = float(asked.get("duration_s") or 0.0)
        if duration_s > 0:
            content["run"] = {"duration_s": duration_s}
        file = Path(self._folder.name) / f"{self._bench.name}.toml"
        file.write_text(tomlkit.dumps(content), encoding="utf-8")
        return file

    def _wait(self, child: Child) -> None:
        """Tell the page what the run said last, until it ends."""
        while True:
            try:
                code = child.popen.wait(0.5)
            except subprocess.TimeoutExpired:
                self._say(child.last_line() or "starting")
                continue
            said = [
                line for line in child.log.read_text(errors="replace").splitlines() if line.startswith(("softloop: ", "run: "))
            ]
            self._say(f"ended with code {code}: " + "; ".join(line.removeprefix("softloop: ") for line in said))
            return

    def _say(self, text: str) -> None:
        self._said = text
        self.on_change()
