"""A hundredth of `make kill`."""

from pathlib import Path

import pytest

from tests.campaigns.full_disk import LEFT_OUT, FileLimit, SmallDisk, may_mount
from tests.campaigns.kill import campaign


def test_a_hundredth_of_the_kill_campaign():
    outcome = campaign(kills=2, cuts=20, full=2, seed=7)
    assert outcome.failures == []
    assert outcome.counts["recorders killed"] == 2
    assert outcome.counts["files cut"] == 20
    for kind in (FileLimit, SmallDisk) if may_mount() else (FileLimit,):
        assert outcome.counts[f"{kind.what}, with room again"] == 1
        assert outcome.counts[f"{kind.what}, then killed"] == 1
    assert outcome.counts.get(LEFT_OUT, 0) == (0 if may_mount() else 2)


def test_a_small_disk_is_seen_by_nobody_else_and_gone_with_its_holder(tmp_path):
    if not may_mount():
        pytest.skip("mounting needs root")
    disk = SmallDisk(tmp_path, 8192)
    assert disk.seen.joinpath("filler").stat().st_size == (8 << 20) - 8192
    assert list(tmp_path.iterdir()) == []
    assert str(tmp_path) not in Path("/proc/mounts").read_text()
    disk.close()
    assert not disk.seen.exists()
