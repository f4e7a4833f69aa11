"""What is done with logs after a run. `softloop.offline.open_log` reads one."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from softloop.offline.log import open_log as open_log


def __getattr__(name: str) -> Any:
    """`open_log`, loaded when it is asked for: numba and numpy come with it, and most that is in here needs less."""
    if name != "open_log":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from softloop.offline.log import open_log  # noqa: PLC0415

    return open_log
