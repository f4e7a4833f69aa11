"""Before `softloop identify` reads or fits anything: an option that would be ignored, a file that cannot be written."""

from __future__ import annotations

from collections.abc import Mapping

from softloop.wire.errors import BadConfig

OF_VENTING = {"venting", "csv", "columns", "train", "as_json"}
NOT_OF_SELECT = {"orders", "method", "interval", "output", "figure"}


def check_options(given: Mapping[str, str]) -> None:
    """`given`: parameter -> how it is written, of those on the command line. Raises BadConfig on one that would be ignored."""
    if "venting" in given:
        _none_of(given, set(given) - OF_VENTING, "identify --venting")
        if "csv" not in given:
            raise BadConfig("identify --venting needs --csv FILE, with --map time=COLUMN and --map pressure=COLUMN")
        return
    if "train" in given:
        raise BadConfig("identify: --train goes with --venting; without it the first file trains")
    if "runs" in given and "columns" in given and "csv" not in given:
        raise BadConfig("identify: --map goes with --csv FILE; a log knows its columns itself, leave --map out")
    if "select" in given:
        _none_of(given, set(given) & NOT_OF_SELECT, "identify --select compares orders, and")


def _none_of(given: Mapping[str, str], idle: set[str], what: str) -> None:
    if idle:
        raise BadConfig(f"{what} has no use for {', '.join(given[name] for name in given if name in idle)}; leave it out")
