"""Reading a whole log: `open_log` beside `mcap`'s own `make_reader`, in turn on the same file in the same run.

    python benchmarks/read.py RUN [--times 5] [--json]

`make_reader` is asked for its raw messages (no decoding), which is the least that anything built on it must do. Memory is what
each leaves allocated at its peak, as tracemalloc sees it, beside the size of the arrays.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import tracemalloc
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader

from softloop.offline.log import Log, open_log
from softloop.offline.run_log import find_log
from softloop.wire.errors import SoftloopError


def read_raw(path: Path) -> int:
    """All messages of a file by mcap's reader, not decoded; how many."""
    with path.open("rb") as file:
        return sum(1 for _ in make_reader(file).iter_messages(log_time_order=False))


def seconds(calls: Sequence[Callable[[], Any]], times: int) -> list[list[float]]:
    """CPU time of some calls, in turn, so that what the machine does beside meets them alike."""
    out: list[list[float]] = [[] for _ in calls]
    for _ in range(times):
        for call, taken in zip(calls, out, strict=True):
            begin = time.process_time()
            call()
            taken.append(time.process_time() - begin)
    return out


def peak_mb(call: Callable[[], Any]) -> float:
    """Peak of the memory that Python and numpy allocate during a call."""
    tracemalloc.start()
    call()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 1e6


def arrays_of(log: Log) -> list[np.ndarray]:
    return [*log.channels.values(), *log.can.values()]


def measure(path: Path, times: int) -> dict[str, Any]:
    log = open_log(path)
    ours, theirs = seconds([lambda: open_log(path), lambda: read_raw(path)], times)
    return {
        "messages": sum(len(a) for a in arrays_of(log)),
        "file_mb": path.stat().st_size / 1e6,
        "open_log_s": float(np.median(ours)),
        "make_reader_s": float(np.median(theirs)),
        "ratio": float(np.median(theirs) / np.median(ours)),
        "ratio_worst": float(min(theirs) / max(ours)),
        "arrays_mb": sum(a.nbytes for a in arrays_of(log)) / 1e6,
        "open_log_peak_mb": peak_mb(lambda: open_log(path)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="a run directory, or its log")
    parser.add_argument("--times", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    try:
        found = measure(find_log(asked.run), asked.times)
    except SoftloopError as error:
        sys.exit(f"read: {error}")
    if asked.json:
        print(json.dumps(found, indent=2))
        return
    print(f"{found['messages']} messages, {found['file_mb']:.1f} MB")
    print(f"open_log {found['open_log_s']:.3f} s, make_reader {found['make_reader_s']:.3f} s (medians of {asked.times})")
    print(f"ratio {found['ratio']:.1f} (slowest of ours, fastest of theirs: {found['ratio_worst']:.1f})")
    print(f"arrays {found['arrays_mb']:.1f} MB, peak while reading {found['open_log_peak_mb']:.1f} MB")


if __name__ == "__main__":
    main()
