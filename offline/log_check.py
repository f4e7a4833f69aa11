"""What a log holds, what its senders' numbers say is missing, and in which stretches of the run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softloop.offline.log import Log, Records
from softloop.wire.channels import CAN
from softloop.wire.mcap_layout import SENDER_FIELDS, Origin

_NUMBERS = np.dtype([("seq", "<u8"), ("stamp_ns", "<i8"), ("node", "<u8")])
JOINED_S = 0.01  # gaps so near each other are one stretch


@dataclass(frozen=True)
class Gap:
    """Numbers `first` to `last` of one sender that are not in the log, between two messages of it that are, s of the run."""

    topic: str
    sender: int
    first: int
    last: int
    after_s: float
    before_s: float

    @property
    def missing(self) -> int:
        return self.last - self.first + 1


@dataclass(frozen=True)
class Held:
    """One channel, or one CAN identifier: how many messages, and from when to when, s of the run."""

    topic: str
    messages: int
    first_s: float
    last_s: float


@dataclass(frozen=True)
class LogCheck:
    """What was found.

    Attributes:
        held: what the log holds, in the order of names.
        gaps: by topic and sender, in the order of their numbers.
        restarts: (topic, sender, number) with which a sender's numbers began anew.
        windows: the stretches of the run in which something is missing, (from, to) in s, joined over all channels.
        problems: what is damaged, as `Log.problems`.
        ends_s: the newest stamp in the log. Of a file that was not finished, all that came later is lost.
        finished: the recorder ended this file itself.
    """

    held: list[Held] = field(default_factory=list)
    gaps: list[Gap] = field(default_factory=list)
    restarts: list[tuple[str, int, int]] = field(default_factory=list)
    windows: list[tuple[float, float]] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    ends_s: float = 0.0
    finished: bool = True

    @property
    def whole(self) -> bool:
        """Nothing is damaged, no number is missing, and the recorder saw the run's end."""
        return self.finished and not self.problems and not self.gaps

    @property
    def missing(self) -> int:
        return sum(gap.missing for gap in self.gaps)


def check_log(log: Log) -> LogCheck:
    """Judge a log that was read. Stamps count from the start of the run, or from the first one where the log does not say it."""
    named = [(name, records) for name, records in sorted(log.channels.items()) if _counts(records)]
    frames = [(f"{CAN.name}/{bus}/{number:x}", records) for (bus, number), records in sorted(log.can.items()) if _counts(records)]
    start_ns = _start_ns(log.origin, [records for _, records in named + frames])
    held = [_held(topic, records, start_ns) for topic, records in named + frames if len(records)]
    gaps, restarts = [], []
    for topic, sender, seqs, stamps_s in _sequences(log, start_ns):
        found, began = _gaps(topic, sender, seqs, stamps_s)
        gaps += found
        restarts += began
    return LogCheck(
        held=held,
        gaps=gaps,
        restarts=restarts,
        windows=_windows(gaps),
        problems=list(log.problems),
        ends_s=max((h.last_s for h in held), default=0.0),
        finished=log.finished,
    )


def _counts(records: Records, *more: str) -> bool:
    """It has the fields that all our messages have; in a log of another layout, or a damaged one, it may not."""
    return {"seq", "stamp_ns", *more} <= set(records.dtype.names or ())


def _start_ns(origin: Origin | None, arrays: list[Records]) -> int:
    if origin is not None:
        return origin.clock_ns
    return min((int(a["stamp_ns"].min()) for a in arrays if len(a)), default=0)


def _held(topic: str, records: Records, start_ns: int) -> Held:
    stamps = records["stamp_ns"]
    return Held(topic, len(records), _seconds(int(stamps.min()), start_ns), _seconds(int(stamps.max()), start_ns))


def _seconds(stamp_ns: int, start_ns: int) -> float:
    return (stamp_ns - start_ns) * 1e-9


def _sequences(log: Log, start_ns: int) -> Iterator[tuple[str, int, NDArray[Any], NDArray[np.float64]]]:
    """Topic, sender, numbers and stamps of each sender that counts for itself, in the order of the log."""
    by_message = {"event": "Event", "status": "ProcessStatus", "clock": "ClockOffset"}
    by_message |= dict.fromkeys(("request", "arm"), "GateRequest")
    for name, records in sorted(log.channels.items()):
        sender_field = SENDER_FIELDS.get(by_message.get(name, ""))
        if _counts(records, *([sender_field] if sender_field else [])):
            yield from _of_senders(name, records, sender_field, start_ns)
    for bus in sorted({bus for bus, _ in log.can}):
        # A node counts its frames over all identifiers of its bus, and has a new number when it starts anew.
        of_bus = [records for (of, _), records in sorted(log.can.items()) if of == bus and _counts(records, "node")]
        frames = np.concatenate([_numbers(records) for records in of_bus] or [_numbers(np.zeros(0, _NUMBERS))])
        yield from _of_senders(f"{CAN.name}/{bus}", np.sort(frames, order=("node", "seq")), "node", start_ns)


def _numbers(records: Records) -> Records:
    kept = np.zeros(len(records), _NUMBERS)
    for name in kept.dtype.names or ():
        kept[name] = records[name]
    return kept


def _of_senders(
    topic: str, records: Records, sender_field: str | None, start_ns: int
) -> Iterator[tuple[str, int, NDArray[Any], NDArray[np.float64]]]:
    senders = np.zeros(len(records), np.uint64) if sender_field is None else records[sender_field]
    for sender in np.unique(senders):
        of_sender = records[senders == sender]
        yield topic, int(sender), of_sender["seq"].astype(np.int64), (of_sender["stamp_ns"] - start_ns) * 1e-9


def _gaps(
    topic: str, sender: int, seqs: NDArray[np.int64], stamps_s: NDArray[np.float64]
) -> tuple[list[Gap], list[tuple[str, int, int]]]:
    """Gaps of one sender, and the numbers at which it began anew: where they fall, and what follows is a count of its own."""
    steps = np.diff(seqs)
    jumps = np.flatnonzero(steps > 1).tolist()
    gaps = [Gap(topic, sender, int(seqs[i]) + 1, int(seqs[i + 1]) - 1, float(stamps_s[i]), float(stamps_s[i + 1])) for i in jumps]
    return gaps, [(topic, sender, int(seqs[i + 1])) for i in np.flatnonzero(steps < 1).tolist()]


def _windows(gaps: list[Gap]) -> list[tuple[float, float]]:
    windows: list[tuple[float, float]] = []
    for start, end in sorted((min(g.after_s, g.before_s), max(g.after_s, g.before_s)) for g in gaps):
        if windows and start <= windows[-1][1] + JOINED_S:
            windows[-1] = (windows[-1][0], max(windows[-1][1], end))
        else:
            windows.append((start, end))
    return windows
