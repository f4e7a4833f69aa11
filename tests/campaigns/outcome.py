"""What all campaigns share: their options, their counts on the screen and as JSON, and their exit code."""

import argparse
import json
import sys
import time
from pathlib import Path

from rich.progress import Progress

FOLDER = Path("build/campaigns")
FAILURES_SHOWN = 20


class Outcome:
    """Counts and failures of one campaign."""

    def __init__(self, name):
        self.name = name
        self.counts = {}
        self.failures = []
        self._began = time.monotonic()

    def count(self, what, n=1):
        self.counts[what] = self.counts.get(what, 0) + n

    def keep_largest(self, what, n):
        self.counts[what] = max(self.counts.get(what, 0), round(n))

    def fail(self, text):
        self.failures.append(text)

    def as_dict(self):
        took_s = round(time.monotonic() - self._began, 1)
        return {"campaign": self.name, "counts": self.counts, "failures": self.failures, "took_s": took_s}

    def finish(self, file=None):
        """Print the counts, write the JSON, and return the exit code: 1 when anything failed."""
        for what, n in self.counts.items():
            print(f"{n:12,d}  {what}")
        for text in self.failures[:FAILURES_SHOWN]:
            print(f"FAILED: {text}")
        print(f"{self.name}: {len(self.failures)} failures in {self.as_dict()['took_s']} s")
        file = Path(file or FOLDER / f"{self.name}.json")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(self.as_dict(), indent=2) + "\n")
        return 1 if self.failures else 0


def options(doc, **defaults):
    """A parser with --json, --seed and one number for each of `defaults`."""
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    for name, value in defaults.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=type(value), default=value)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", help="where the counts go; default build/campaigns/NAME.json")
    return parser


def steps(items, what):
    """The items, with a bar on a terminal."""
    if not sys.stderr.isatty():
        yield from items
        return
    with Progress() as progress:
        yield from progress.track(list(items), description=what)
