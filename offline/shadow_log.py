"""A log's valve currents and sensors through the simulated plant of a `[shadow]` table: how far the two were apart."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from softloop.offline.log import Log
from softloop.plant.shadow import Shadow
from softloop.plant.shadow_config import ShadowProcess
from softloop.wire.channels import INCLINATION, PRESSURE, SHADOW, VALVES
from softloop.wire.errors import BadFile
from softloop.wire.messages import message

_HEARD = (VALVES, PRESSURE, INCLINATION)
# Unit -> the field of `ShadowDivergence`, and whether its name is that of a residual.
FIGURES = {
    "angle, deg": "angle_residual_deg",
    "rate, deg/s": "rate_residual_deg_s",
    "chamber, kPa": "chamber_residual_kpa",
    "supply, kPa": "supply_residual_kpa",
    "correction, kPa/s": "correction_kpa_s",
}
_BLOCK = 2000  # messages between two words of progress


def follow(log: Log, process: ShadowProcess, progress: Callable[[int, int], None] = lambda done, total: None) -> list[Any]:
    """The `ShadowDivergence` messages that the process `shadow` would have said beside this run, 20 for each second of it.

    Raises BadFile when the log lacks a channel that a shadow hears; BadFile or BadConfig when its parameters cannot be used.
    """
    for channel in _HEARD:
        if channel.name not in log.channels or not len(log[channel.name]):
            raise BadFile(f"{log.path}: nothing on channel '{channel.name}', which a shadow follows")
    shadow, said = Shadow(process), []
    total = sum(len(log[channel.name]) for channel in _HEARD)
    for done, (name, sample) in enumerate(_in_order(log)):
        shadow.put(name, sample)
        if done % _BLOCK == 0:
            said += shadow.advance_to(sample.stamp_ns - round(1e6 * process.table.behind_ms))
            progress(done, total)
    return said + shadow.advance_to(max(int(log[channel.name]["stamp_ns"][-1]) for channel in _HEARD))


def _in_order(log: Log) -> Iterator[tuple[str, Any]]:
    """(channel, message) of what a shadow hears, by their stamps."""
    found = []
    for channel in _HEARD:
        records, kind = log[channel.name], message(channel.message).Tuple
        found += [(int(record["stamp_ns"]), channel.name, kind(*record.tolist())) for record in records]
    yield from ((name, sample) for _, name, sample in sorted(found, key=lambda item: item[0]))


def figures(said: list[Any]) -> dict[str, dict[str, float]]:
    """Figure of `FIGURES` -> RMS and largest magnitude over what was said; an empty list gives NaN."""
    found = {}
    for name, field in FIGURES.items():
        values = np.array([getattr(one, field) for one in said], dtype=float)
        values = values[np.isfinite(values)]
        rms, most = (np.sqrt(np.mean(values**2)), np.abs(values).max()) if len(values) else (np.nan, np.nan)
        found[name] = {"rms": float(rms), "most": float(most)}
    return found


def content(said: list[Any]) -> list[dict[str, float]]:
    """What was said, JSON-able."""
    return [{name: getattr(one, name) for name in message(SHADOW.message).Tuple._fields} for one in said]
