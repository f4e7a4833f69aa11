"""A bench of Zenoh sessions on Unix sockets in a short temporary folder, for tests."""

import shutil
import tempfile
from contextlib import contextmanager
from pathlib import Path

from softloop.wire.config import ZenohConfig
from softloop.wire.session import open_router, open_wire


@contextmanager
def short_folder():
    """A folder whose path is short enough for Unix sockets."""
    folder = Path(tempfile.mkdtemp(prefix="sl-"))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def meeting(mode="peer", lease_ms=500):
    """A router, and the configuration with which wires join it."""
    with short_folder() as folder:
        config = ZenohConfig(mode=mode, lease_ms=lease_ms)
        config = config.model_copy(update={"endpoint": f"unixsock-stream/{folder}/meet.sock"})
        with open_router(config, "test"):
            yield config


@contextmanager
def two_wires(mode="peer"):
    """Two wires, `a` and `b`, on one bench."""
    with meeting(mode) as config, open_wire(config, "test", "a") as a, open_wire(config, "test", "b") as b:
        yield a, b
