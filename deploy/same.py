"""`softloop same`: whether two logs are the same run, byte by byte."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from softloop.offline.log import find_log, open_log
from softloop.offline.same import differences, series_of
from softloop.wire.errors import EXIT_NEGATIVE, EXIT_OK


def same_runs(first: Path, second: Path, *, as_json: bool) -> int:
    """Compare two runs and say what was found. Returns EXIT_NEGATIVE when they differ. Raises BadFile."""
    a, b = open_log(find_log(first)), open_log(find_log(second))
    found, series = differences(a, b), series_of(a)
    if as_json:
        print(json.dumps({"same": not found, "differences": [asdict(apart) for apart in found]}, indent=2))
    elif found:
        print("\n".join(f"different: {apart}" for apart in found))
    else:
        messages = sum(len(records) for records in series.values())
        print(f"the same run: {messages} messages in {len(series)} series, byte by byte")
    return EXIT_NEGATIVE if found else EXIT_OK
