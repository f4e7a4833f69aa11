"""What all campaigns share: their options, their counts on the screen and as JSON, their end by a signal, and their exit code."""

import argparse
import json
import signal
import sys
import time
from contextlib import contextmanager
from pathlib import Path

from rich.progress import Progress

from softloop.wire.mcap_layout import git_state

FOLDER = Path("build/campaigns")
FAILURES_SHOWN = 20
SAVE_S = 5.0
INTERRUPTED, NOT_RESUMED = 130, 3  # exit codes beside 0 and 1


class Outcome:
    """Counts and failures of one campaign; with a `file` they are saved there as it goes."""

    def __init__(self, name, file=None):
        self.name, self.file = name, file
        self.counts = {}
        self.failures = []
        self.ended = ""  # "" while it runs; "complete", "interrupted" or "stopped by an error"
        self._code = git_state(Path(__file__).parent) if file else {}
        self._began = self._saved = time.monotonic()

    def count(self, what, n=1):
        self.counts[what] = self.counts.get(what, 0) + n
        if self.file and time.monotonic() - self._saved > SAVE_S:
            self.save()

    def keep_largest(self, what, n):
        self.counts[what] = max(self.counts.get(what, 0), round(n))

    def fail(self, text):
        self.failures.append(text)

    def as_dict(self):
        found = {"campaign": self.name, "ended": self.ended or "running", **self._code}
        found |= {"counts": self.counts, "failures": self.failures}
        return found | {"took_s": round(time.monotonic() - self._began, 1)}

    def save(self):
        """Write the JSON; whoever reads it meets the old one or the new one, never half of it."""
        self._saved = time.monotonic()
        self.file.parent.mkdir(parents=True, exist_ok=True)
        made = self.file.with_name(f"{self.file.name}.partial")
        made.write_text(json.dumps(self.as_dict(), indent=2) + "\n")
        made.rename(self.file)

    def resume(self):
        """Go on from the counts in the file. Raises ValueError when there are none, or when they are of other code."""
        try:
            found = json.loads(self.file.read_text())
        except (OSError, ValueError) as error:
            raise ValueError(f"{self.file}: no counts to go on from: {error}") from None
        if found["commit"] != self._code["commit"]:
            raise ValueError(f"{self.file}: counted at commit {found['commit']}, this is {self._code['commit']}: begin anew")
        self.counts, self.failures = found["counts"], found["failures"]
        self._began -= found["took_s"]

    def finish(self):
        """Print the counts, write the JSON, and return the exit code: 1 when anything failed, 130 when it was interrupted."""
        for what, n in self.counts.items():
            print(f"{n:12,d}  {what}")
        for text in self.failures[:FAILURES_SHOWN]:
            print(f"FAILED: {text}")
        interrupted = "" if self.ended == "complete" else f", {self.ended}"
        print(f"{self.name}: {len(self.failures)} failures in {self.as_dict()['took_s']} s{interrupted}", flush=True)
        if self.file:
            self.save()
        return 1 if self.failures else 0 if self.ended == "complete" else INTERRUPTED


def carried_out(name, given, run):
    """Run a campaign, `run(outcome)`, by its options; what it counted is kept whatever ends it. Returns the exit code."""
    outcome = Outcome(name, given.json or FOLDER / f"{name}.json")
    try:
        if getattr(given, "resume", False):
            outcome.resume()
    except ValueError as error:
        print(f"{name}: {error}")
        return NOT_RESUMED
    with _interrupted_by_signals():
        try:
            run(outcome)
            outcome.ended = "complete"
        except KeyboardInterrupt:
            outcome.ended = "interrupted"
        except Exception:
            outcome.ended = "stopped by an error"
            raise
        finally:
            code = outcome.finish()
    return code


@contextmanager
def _interrupted_by_signals():
    """Ctrl-C and SIGTERM as KeyboardInterrupt, also in a background process, whose shell lets it ignore Ctrl-C."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, signal.default_int_handler) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def options(doc, *, resumable=False, **defaults):
    """A parser with --json, --seed, --resume where that can be, and one number for each of `defaults`."""
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    for name, value in defaults.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=type(value), default=value)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, help="where the counts go; default build/campaigns/NAME.json")
    if resumable:
        parser.add_argument("--resume", action="store_true", help="go on from the counts there, of the same commit")
    return parser


def steps(items, what):
    """The items, with a bar on a terminal."""
    if not sys.stderr.isatty():
        yield from items
        return
    with Progress() as progress:
        yield from progress.track(list(items), description=what)
