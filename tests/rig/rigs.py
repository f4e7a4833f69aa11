"""Running a whole rig in a test: one at a time, with a hard limit that ends its own processes by pid."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil

LIMIT_S = 120.0
PROGRAM = (sys.executable, "-m", "softloop.deploy.cli")


class Rig:
    """A `softloop run` in a session of its own, on a bench of its own name, in a short temporary folder."""

    def __init__(self, bench_text, *, name, arguments=(), runtime=None):
        self.folder = Path(tempfile.mkdtemp(prefix="sl-rig-"))
        self.run_dir = self.folder / "run"
        self.bench = self.folder / "bench.toml"
        self.bench.write_text(f'name = "{name}"\n{bench_text}')
        command = [*PROGRAM, "run", str(self.bench), "--run-dir", str(self.run_dir), *arguments]
        # Sockets go into the folder of this test, not among those of the user's own benches.
        environment = {**os.environ, "XDG_RUNTIME_DIR": str(runtime or self.folder)}
        self.words = self.folder / "output.txt"
        with self.words.open("w") as output:
            self.process = subprocess.Popen(
                command, stdout=output, stderr=subprocess.STDOUT, start_new_session=True, env=environment
            )
        self.started = time.monotonic()
        self.family = {}

    def children(self):
        """Process name -> psutil.Process of the rig's processes that run now."""
        with contextlib.suppress(psutil.NoSuchProcess):
            for child in psutil.Process(self.process.pid).children(recursive=True):
                with contextlib.suppress(psutil.NoSuchProcess):
                    words = child.cmdline()
                    self.family[child.pid] = child
                    if "node" in words:
                        yield words[words.index("node") + 1], child

    def named(self, name):
        return dict(self.children())[name]

    def wait_for(self, condition, what):
        """Wait until `condition()` is true; the rig must still run."""
        while not condition():
            list(self.children())
            assert time.monotonic() - self.started < LIMIT_S, f"{what}: not within {LIMIT_S} s\n{self.logs()}"
            assert self.process.poll() is None, f"the rig ended before: {what}\n{self.output}\n{self.logs()}"
            time.sleep(0.05)

    def wait_for_word(self, word):
        """Wait until the launcher has printed `word`."""
        self.wait_for(lambda: word in self.output, f"the word '{word}'")

    @property
    def output(self):
        """What the launcher has printed so far."""
        return self.words.read_text()

    def finish(self, *allowed):
        """Wait for the end; returns the exit code, one of those allowed, if any are named. A failure shows the words."""
        while self.process.poll() is None:
            list(self.children())
            assert time.monotonic() - self.started < LIMIT_S, f"the rig did not end\n{self.output}\n{self.logs()}"
            time.sleep(0.1)
        code = self.process.returncode
        assert not allowed or code in allowed, f"exit code {code}, not one of {allowed}\n{self.output}\n{self.logs()}"
        return code

    def signal(self, number):
        self.process.send_signal(number)

    def summary(self):
        return json.loads((self.run_dir / "summary.json").read_text())

    def logs(self):
        return "\n".join(f"--- {p.name}\n{p.read_text()[-2000:]}" for p in sorted(self.run_dir.glob("*.log")))

    def left_over(self, patience_s=10.0):
        """Names of this rig's processes that still run after a while."""
        end = time.monotonic() + patience_s
        while time.monotonic() < end:
            alive = [p for p in self.family.values() if p.is_running() and p.status() != psutil.STATUS_ZOMBIE]
            if not alive:
                return []
            time.sleep(0.1)
        return [" ".join(p.cmdline()) for p in alive]

    def close(self):
        """End whatever is left, by pid, and remove the folder."""
        list(self.children())
        for process in [*self.family.values(), psutil.Process(self.process.pid) if self.process.poll() is None else None]:
            with contextlib.suppress(psutil.NoSuchProcess, AttributeError):
                process.send_signal(signal.SIGCONT)
                process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout=10)
        shutil.rmtree(self.folder, ignore_errors=True)


@contextlib.contextmanager
def running(bench_text, **options):
    """A rig that is ended, whatever happens, when the block is left."""
    rig = Rig(bench_text, **options)
    try:
        yield rig
    finally:
        rig.close()
