"""Our logs in rerun's reader: equal values, by its own decoding. By `make test-rerun`, which installs rerun's library first."""

import pytest
import synthetic

from softloop.wire.messages import message

pytestmark = pytest.mark.rerun


def rows_of(stream):
    """Entity path -> its messages as rerun decoded them, in order of their time."""
    found = {}
    for chunk in stream:
        batch = chunk.to_record_batch()
        names = [name for name in batch.schema.names if name.endswith(":message")]
        if names:
            times = batch.column("message_log_time").to_pylist()
            values = [value for (value,) in batch.column(names[0]).to_pylist()]
            found.setdefault(chunk.entity_path, []).extend(zip(times, values, strict=True))
    return {path: [value for _, value in sorted(rows, key=lambda row: row[0])] for path, rows in found.items()}


def test_rerun_reads_equal_values(tmp_path):
    from rerun.chunk import McapReader  # noqa: PLC0415 - an extra

    made = list(synthetic.messages(0.2))
    file = synthetic.write_log(tmp_path / "run.mcap", made)
    seen = rows_of(McapReader(file).stream())
    assert set(seen) == {f"/{key}" for _, key, _ in made}
    for path, theirs in seen.items():
        ours = sorted((value for _, key, value in made if f"/{key}" == path), key=lambda value: value.stamp_ns)
        assert len(theirs) == len(ours)
        for got, value in zip(theirs, ours, strict=True):
            for field in message(type(value).__name__).fields:
                expected = getattr(value, field.name)
                assert (tuple(got[field.name]) if field.length else got[field.name]) == expected, field.name
