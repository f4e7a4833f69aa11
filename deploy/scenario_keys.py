"""Errors of the bench that a scenario makes, said of the scenario's file and of the keys as they stand there.

The bench itself is a file of a moment, which nobody has written and nobody can look into.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from softloop.deploy.bench import load_bench
from softloop.wire.errors import BadConfig

Places = dict[str, str]  # key of the bench -> key of the scenario
_KEY = re.compile(r"\bkey '([^']+)'")
_TIMES = {"on_s": "at_s", "off_s": "duration_s"}  # of [[plant.faults]]


@dataclass
class ScenarioKeys:
    """Where each key of a scenario's bench stands.

    Attributes:
        path: the scenario's file.
        bench_file: what it is put over.
        overrides: its `[overrides]`.
        places: what it puts into the bench besides.
    """

    path: Path
    bench_file: Path
    overrides: dict[str, Any]
    places: Places = field(default_factory=dict)

    @contextmanager
    def named(self) -> Iterator[None]:
        """Say a BadConfig of the made bench, which begins with the scenario's file, in the scenario's own keys."""
        try:
            yield
        except BadConfig as error:
            load_bench(self.bench_file)  # what is wrong with the bench by itself is said of its own file
            raise BadConfig(self.said(str(error.args[0]))) from None

    def said(self, text: str) -> str:
        """`text` with the scenario's keys; where it names one that the bench alone has, with the bench too."""
        told = text.removeprefix(f"{self.path}: ")
        strange = [key for key in _KEY.findall(told)[:1] if self._here(key) is None]
        told = _KEY.sub(lambda found: f"key '{self._here(found[1]) or found[1]}'", told)
        return f"{self.path}: {f'with the bench {self.bench_file}: ' if strange else ''}{told}"

    def _here(self, key: str) -> str | None:
        """The scenario's key behind one of the bench; None where the scenario has none."""
        parts = key.split(".")
        entry = self.places.get(".".join(parts[:3]))  # an entry of a list, and what stands in it
        if key in self.places or entry is not None:
            return self.places.get(key) or ".".join((str(entry), *parts[3:]))
        return f"overrides.{key}" if self._overrides(parts) else None

    def _overrides(self, parts: list[str]) -> bool:
        value: Any = self.overrides
        for part in parts:
            if not isinstance(value, dict):
                return True  # within a list or a value that the scenario has
            if part not in value:
                return False
            value = value[part]
        return True


def places_of(listed: str, before: int, ours: Iterable[int]) -> Places:
    """The places of the scenario's injections `ours` in a list of the bench, which has `before` of its own."""
    places: Places = {listed: "injections"}
    for at, own in enumerate(ours, before):
        places[f"{listed}.{at}"] = f"injections.{own}"
        places |= {f"{listed}.{at}.{theirs}": f"injections.{own}.{name}" for theirs, name in _TIMES.items()}
    return places
