"""What a log holds, its gaps, and the good file that is made of a damaged one."""

import json
import random

import numpy as np
import pytest
from mcap.reader import make_reader
from tests.offline import synthetic

from softloop.deploy import cli
from softloop.offline.log import open_log
from softloop.offline.log_check import check_log
from softloop.offline.log_repair import repair_log
from softloop.offline.mcap_walk import FileRecords, next_chunk
from softloop.offline.summary import summarise
from softloop.wire.errors import BadFile, Unavailable
from softloop.wire.mcap_layout import CUT_OFF_NAME


@pytest.fixture(scope="module")
def made():
    return list(synthetic.messages(1.0))


def lose(made, name, numbers):
    return [m for m in made if not (m[0] == name and m[2].seq in numbers)]


def test_a_whole_log_is_whole(tmp_path, made):
    found = check_log(open_log(synthetic.write_log(tmp_path / "run.mcap", made)))
    assert found.whole
    assert found.finished
    assert {h.topic: h.messages for h in found.held}["cycle"] == 200
    assert found.windows == []


def test_gaps_are_named_with_numbers_and_times(tmp_path, made):
    lossy = lose(lose(made, "pressure", range(50, 60)), "can", {7, 100})
    found = check_log(open_log(synthetic.write_log(tmp_path / "run.mcap", lossy)))
    assert not found.whole
    assert [(g.topic, g.first, g.last, g.missing) for g in found.gaps] == [
        ("pressure", 50, 59, 10),
        ("can/can0", 7, 7, 1),
        ("can/can0", 100, 100, 1),
    ]
    assert found.missing == 12
    gap = found.gaps[0]
    assert gap.before_s - gap.after_s == pytest.approx(11 * 0.005)
    assert len(found.windows) == 3
    assert (gap.after_s, gap.before_s) in found.windows


def test_a_sender_that_counts_anew_is_no_gap(tmp_path, made):
    twice = made + [(n, k, v._replace(stamp_ns=v.stamp_ns + 2 * 10**9)) for n, k, v in made if n == "cycle"]
    found = check_log(open_log(synthetic.write_log(tmp_path / "run.mcap", twice)))
    assert found.gaps == []
    assert found.restarts == [("cycle", 0, 1)]


def test_an_unfinished_log_is_repaired_in_place_and_the_old_one_kept(tmp_path, made):
    file = synthetic.write_log(tmp_path / "run.mcap", made, finish=False)
    old = file.read_bytes()
    before = open_log(file)
    result = repair_log(file)
    after = open_log(file)
    assert before.problems
    assert after.problems == []
    assert result.messages == len(made)
    assert (tmp_path / "run.mcap.damaged").read_bytes() == old
    assert after.attachments == before.attachments
    assert after.metadata == before.metadata | {CUT_OFF_NAME: {}}
    assert not after.finished
    for name, records in before.channels.items():
        assert np.array_equal(after[name].view(np.uint8), records.view(np.uint8))
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        assert summary.statistics.message_count == len(made)
        assert sum(1 for _ in make_reader(stream).iter_messages()) == len(made)
    with pytest.raises(Unavailable, match="is there already"):
        repair_log(file)


def test_behind_a_broken_length_reading_goes_on_at_the_next_chunk(tmp_path, made):
    file = synthetic.write_log(tmp_path / "run.mcap", made, chunk_bytes=8000)
    content = bytearray(file.read_bytes())
    view = memoryview(bytes(content))
    chunks = [at for opcode, at, _ in FileRecords(view) if opcode == 6]
    assert len(chunks) > 10
    assert [next_chunk(view, at) for at in chunks] == chunks
    for broken in (b"\xff" * 8, (5000).to_bytes(8, "little"), (50_000).to_bytes(8, "little")):
        content[chunks[4] + 1 : chunks[4] + 9] = broken
        (tmp_path / "broken.mcap").write_bytes(content)
        log = open_log(tmp_path / "broken.mcap")
        found = check_log(log)
        assert log.problems or found.whole, "a length that is too long costs nothing: the chunk says its own"
        assert max((g.missing for g in found.gaps), default=0) < 30, [
            (g.topic, g.first, g.last) for g in found.gaps if g.missing > 29
        ]
        assert log["cycle"]["seq"][-1] == 200
        repair_log(tmp_path / "broken.mcap", tmp_path / "good.mcap")
        good = open_log(tmp_path / "good.mcap")
        assert good.problems == []
        assert np.array_equal(good["cycle"], log["cycle"])
        (tmp_path / "good.mcap").unlink()


def test_random_damage_never_ends_in_a_traceback_and_a_repair_keeps_all_that_can_be_read(tmp_path, made):
    rng = random.Random(3)
    whole = synthetic.write_log(tmp_path / "run.mcap", made, chunk_bytes=8000).read_bytes()
    lost = 0
    for k in range(60):
        content = bytearray(whole)
        for _ in range(rng.randint(1, 4)):
            at = rng.randrange(8, len(content))
            content[at : at + rng.randint(1, 40)] = rng.randbytes(rng.randint(0, 40))
        (tmp_path / f"{k}.mcap").write_bytes(content)
        damaged = open_log(tmp_path / f"{k}.mcap")
        repair_log(tmp_path / f"{k}.mcap", tmp_path / "good.mcap")
        good = open_log(tmp_path / "good.mcap")
        assert [p for p in good.problems if "not finished" in p or "damaged" in p or "unknown record" in p] == []
        assert {name: len(r) for name, r in good.channels.items()} == {name: len(r) for name, r in damaged.channels.items()}
        lost += len(made) - sum(len(r) for r in (*good.channels.values(), *good.can.values()))
        (tmp_path / "good.mcap").unlink()
    assert lost < 0.2 * 60 * len(made)


def test_what_is_no_log_is_one_line(tmp_path):
    (tmp_path / "x.mcap").write_bytes(b"nothing")
    with pytest.raises(BadFile, match="not an MCAP file"):
        repair_log(tmp_path / "x.mcap")
    with pytest.raises(BadFile, match="cannot be read"):
        repair_log(tmp_path / "none.mcap")


def command(*arguments):
    return cli._run(["log", *map(str, arguments)])


def test_the_commands_and_their_exit_codes(tmp_path, made, capsys):
    run = tmp_path / "run"
    run.mkdir()
    synthetic.write_log(run / "run.mcap", lose(made, "truth", {5}), finish=False)
    assert command("check", run) == 1
    said = capsys.readouterr().out
    assert "truth: 1 missing, 5 to 5" in said
    assert "loss window" in said
    assert "did not end its file" in said
    assert command("check", run, "--json") == 1
    assert json.loads(capsys.readouterr().out)["missing"] == 1
    assert command("repair", run, "-o", tmp_path / "good.mcap") == 0
    assert command("repair", run) == 0
    assert "kept as run.mcap.damaged" in capsys.readouterr().out
    assert command("check", run) == 1  # whole, but a number is missing all the same
    assert command("repair", run) == 0
    assert "nothing to repair" in capsys.readouterr().out
    assert command("repair", run, "-o", tmp_path / "good.mcap") == 3
    assert command("check", tmp_path / "none") == 2


def test_a_chunk_amid_the_words_of_a_schema_is_not_taken_into_the_repaired_file(tmp_path, made):
    """Else that file would look damaged itself, and be read at the chunk that is none."""
    file = synthetic.write_log(tmp_path / "run.mcap", made[:40], chunk_bytes=600)
    content = bytearray(file.read_bytes())
    records = [(opcode, at, len(body)) for opcode, at, body in FileRecords(memoryview(content))]
    size, chunk = min((n + 9, at) for opcode, at, n in records if opcode == 6)
    schema = next(at for opcode, at, n in records if opcode == 3 and n > size + 200)
    content[schema + 100 : schema + 100 + size] = content[chunk : chunk + size]
    content[next(at for opcode, at, _ in records if opcode == 6) + 100] ^= 255  # with the schemas' second copies
    file.write_bytes(content)
    assert open_log(file).problems
    again = open_log(repair_log(file, tmp_path / "good.mcap").file)
    assert again.problems == []
    assert again.channels


def test_what_stands_in_an_attachment_of_a_wrong_length_is_read_and_kept(tmp_path, made):
    file = synthetic.write_log(tmp_path / "run.mcap", made[:40], chunk_bytes=600)
    content = file.read_bytes()
    records = [(opcode, at, len(body)) for opcode, at, body in FileRecords(memoryview(content))]
    start = next(at for opcode, at, _ in records if opcode != 1)  # behind the header
    end = max(at + 9 + n for opcode, at, n in records if opcode in {3, 4, 6})  # all that describes a channel is inside
    file.write_bytes(content[:start] + b"\x09" + (end - start).to_bytes(8, "little") + content[start:])
    damaged = open_log(file)
    assert damaged.channels
    again = open_log(repair_log(file, tmp_path / "good.mcap").file)
    assert {name: len(r) for name, r in again.channels.items()} == {name: len(r) for name, r in damaged.channels.items()}


def test_a_repair_does_not_make_a_log_that_was_cut_off_whole(tmp_path, made):
    """Its gaps show by their numbers; that its end is missing shows by nothing but what the repair says of it."""
    cut = synthetic.write_log(tmp_path / "cut.mcap", made, finish=False)
    again = repair_log(repair_log(cut, tmp_path / "good.mcap").file, tmp_path / "better.mcap").file
    assert open_log(again).problems == []
    assert not check_log(open_log(again)).whole
    found = summarise(open_log(again))
    assert not found["evidence_valid"]
    assert "the log file is damaged or unfinished" in found["evidence_problems"]
    whole = repair_log(synthetic.write_log(tmp_path / "whole.mcap", made), tmp_path / "copy.mcap").file
    assert check_log(open_log(whole)).whole
