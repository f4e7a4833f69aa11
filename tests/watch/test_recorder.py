"""The recorder process: all that was published, an account of what is missing, and nothing that ends it."""

import errno
import gc
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import pytest
import zenoh
from mcap.reader import make_reader

from softloop.watch import recorder as module
from softloop.watch.config import RecorderConfig
from softloop.watch.recorder import Sequence, Sink, run
from softloop.wire.benchfile import load_model
from softloop.wire.channels import CYCLE, EVENT, PRESSURE, STATUS, can_key, key
from softloop.wire.config import ZenohConfig
from softloop.wire.errors import BadConfig, Unavailable
from softloop.wire.messages import message
from softloop.wire.session import open_router, open_wire
from softloop.wire.shell import Context

BENCH = "rec"
END_S = 20.0


def pressure(seq, stamp_ns=1):
    kind = message("PressureSample")
    return kind.pack(kind.make(seq=seq, stamp_ns=stamp_ns))


def frame(seq, node):
    kind = message("CanFrame")
    return kind.pack(kind.make(seq=seq, stamp_ns=1, node=node))


class Bench:
    """A meeting point, a recorder on it in a thread, and a guest who publishes."""

    def __init__(self, run_dir, **config):
        self.run_dir = run_dir
        self.socket_dir = tempfile.TemporaryDirectory(prefix="sl", dir="/tmp")
        # On a busy machine a link must not be given up for a pause of half a second.
        self.zenoh = ZenohConfig(mode="client", lease_ms=10_000, endpoint=f"unixsock-stream/{self.socket_dir.name}/m.sock")
        self.config = RecorderConfig(**{"poll_s": 0.005, "flush_s": 0.05, **config})

    def __enter__(self):
        self.router = open_router(self.zenoh, BENCH)
        self.wires = [open_wire(self.zenoh, BENCH, name) for name in ("recorder", "guest")]
        own, self.guest = [w.__enter__() for w in self.wires]
        self.context = Context("recorder", BENCH, self.run_dir, own)
        self.original, self.recorder = module.Recorder, None
        module.Recorder = self._keep
        self.thread = threading.Thread(target=run, args=(self.config, self.context), daemon=True)
        self.thread.start()
        self.until(lambda: "recorder" in self.guest.processes_alive())
        return self

    def _keep(self, config, context):
        self.recorder = self.original(config, context)
        return self.recorder

    def arrived(self, n):
        """Wait until the recorder has dealt with so many messages beside its own, then stop it."""

        def dealt_with():
            account = self.recorder.account
            own = sum(account.topics.get(key(BENCH, c), [0])[0] for c in (EVENT, STATUS))
            logged = sum(count[0] for count in list(account.topics.values()))
            return logged - own + account.malformed + account.unknown + account.storage >= n

        self.until(dealt_with)
        self.stop()

    def until(self, condition):
        end = time.monotonic() + END_S
        while not condition():
            assert time.monotonic() < end, "waited in vain"
            assert self.thread.is_alive(), "the recorder ended"
            time.sleep(0.005)

    def put(self, full_key, payload):
        self.guest.session.put(full_key, payload, congestion_control=zenoh.CongestionControl.BLOCK)

    def handed_over(self):
        """Wait until all that was put has reached the recorder's session: what is put later by the same way has."""
        heard = threading.Event()
        handler = zenoh.handlers.Callback(lambda _: heard.set(), indirect=False)
        marker = self.context.wire.session.declare_subscriber("marker", handler)
        self.until(lambda: self.put("marker", b"") or heard.is_set())
        marker.undeclare()

    def stop(self):
        self.context.stop.set("test")
        self.thread.join(END_S)
        assert not self.thread.is_alive()

    def __exit__(self, *_):
        self.stop()
        for wire in self.wires:
            wire.__exit__(None, None, None)
        module.Recorder = self.original
        self.router.close()
        self.socket_dir.cleanup()
        gc.enable()
        gc.unfreeze()

    @property
    def account(self):
        return json.loads((self.run_dir / "recorder.json").read_text())

    def messages(self, channel_key):
        with (self.run_dir / self.config.file).open("rb") as file:
            return [m for _, _, m in make_reader(file).iter_messages(topics=[f"/{channel_key}"], log_time_order=False)]


def test_everything_published_is_in_the_log_with_gaps_counted(tmp_path):
    (tmp_path / "bench.toml").write_text("name = 'rec'\n")
    with Bench(tmp_path) as bench:
        sent = [1, 2, 3, 6, 7, 5, 9]
        for seq in sent:
            bench.put(key(BENCH, PRESSURE), pressure(seq))
        for seq, number in ((1, 0x80), (2, 0x90), (4, 0x80)):
            bench.put(can_key(BENCH, "can0", number), frame(seq, node=77))
        bench.arrived(len(sent) + 3)
    assert [m.sequence for m in bench.messages(key(BENCH, PRESSURE))] == sent
    account = bench.account
    assert account["finished"]
    assert account["channels"]["/softloop/rec/pressure"]["messages"] == len(sent)
    by_topic = {(s["topic"], s["sender"]): s for s in account["sequences"]}
    assert by_topic["/softloop/rec/pressure", 0] == {
        "topic": "/softloop/rec/pressure", "sender": 0, "first": 1, "last": 9, "messages": 7, "missing": 5, "backward": 1,
    }  # fmt: skip
    can = by_topic["/softloop/rec/can/can0", 77]
    assert (can["messages"], can["missing"]) == (3, 1)


def test_the_log_ends_properly_and_holds_the_recorders_own_status(tmp_path):
    with Bench(tmp_path) as bench:
        bench.stop()
    statuses = [message("ProcessStatus").unpack(m.data) for m in bench.messages(key(BENCH, STATUS))]
    assert statuses
    assert statuses[-1].process == module.SOURCE
    assert statuses[-1].state == 2
    assert bench.account["bytes_in_file"] == (tmp_path / "run.mcap").stat().st_size


def test_malformed_payloads_and_strangers_are_counted_and_harm_nothing(tmp_path):
    with Bench(tmp_path) as bench:
        good = pressure(1)
        for payload in (b"", b"\xff" * 11, good[:-1], good + b"\0", b"\xff" + good[1:], pressure(2, stamp_ns=-(1 << 63))):
            bench.put(key(BENCH, PRESSURE), payload)
        bench.put(f"softloop/{BENCH}/nothing", good)
        bench.put(f"softloop/{BENCH}/can/can0/XYZ", good)
        bench.put(key(BENCH, PRESSURE), good)
        bench.arrived(9)
    assert [m.sequence for m in bench.messages(key(BENCH, PRESSURE))] == [1]
    assert (bench.account["malformed"], bench.account["unknown_keys"]) == (6, 2)


def test_a_backlog_drops_the_oldest_and_says_so_in_the_log(tmp_path, monkeypatch):
    gate, entered = threading.Event(), threading.Event()
    gate.set()
    with Bench(tmp_path, backlog_messages=10) as bench:
        events = bench.guest.inbox(EVENT)
        take = bench.recorder.take

        def take_when_let():
            if not gate.is_set():
                entered.set()
                gate.wait(END_S)
            return take()

        monkeypatch.setattr(bench.recorder, "take", take_when_let)
        bench.put(key(BENCH, PRESSURE), pressure(1))
        bench.until(lambda: key(BENCH, PRESSURE) in bench.recorder.account.topics)
        gate.clear()
        assert entered.wait(END_S)
        for seq in range(2, 52):
            bench.put(key(BENCH, PRESSURE), pressure(seq))
        bench.handed_over()
        gate.set()
        bench.until(events.take)
        bench.stop()
    kept = [m.sequence for m in bench.messages(key(BENCH, PRESSURE))]
    assert kept == sorted(kept)
    assert (kept[0], kept[-1]) == (1, 51)
    assert len(kept) <= 11
    events = [message("Event").unpack(m.data) for m in bench.messages(key(BENCH, EVENT))]
    assert events[0].kind == module.KIND_BACKLOG
    assert events[0].source == module.SOURCE
    # The recorder's own words take a place in its backlog like any other message, so a few more may have gone.
    assert bench.account["dropped_backlog"] >= 40
    assert bench.account["missing"] >= 40
    assert events[-1].value >= 40


class FullDisk:
    """`os.write` on a disk with so much room; a last write may be taken in part."""

    def __init__(self, room):
        self.room, self.real, self.refused = room, os.write, 0

    def __call__(self, file, data):
        if self.room <= 0:
            self.refused += 1
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        taken = self.real(file, bytes(data[: self.room]))
        self.room -= taken
        return taken


def test_a_full_disk_that_gets_room_again_loses_nothing(tmp_path, monkeypatch, capfd):
    disk = FullDisk(8000)
    monkeypatch.setattr(module.os, "write", disk)
    with Bench(tmp_path) as bench:
        for seq in range(1, 1001):
            bench.put(key(BENCH, PRESSURE), pressure(seq, stamp_ns=seq * 7919 % 1_000_003))
        bench.until(lambda: disk.refused > 3)
        disk.room = 1 << 30
        bench.arrived(1000)
    assert [m.sequence for m in bench.messages(key(BENCH, PRESSURE))] == list(range(1, 1001))
    assert bench.account["storage_errors"] == ["No space left on device"]
    assert capfd.readouterr().err.count("No space left on device") == 1
    events = [message("Event").unpack(m.data) for m in bench.messages(key(BENCH, EVENT))]
    assert [(e.kind, e.code) for e in events] == [(module.KIND_BACKLOG, module.CODE_STORAGE)]


def test_a_disk_that_stays_full_ends_in_an_account_not_in_a_fault(tmp_path, monkeypatch):
    disk = FullDisk(4000)
    monkeypatch.setattr(module.os, "write", disk)
    with Bench(tmp_path, drain_s=0.2) as bench:
        for seq in range(1, 1001):
            bench.put(key(BENCH, PRESSURE), pressure(seq, stamp_ns=seq * 7919 % 1_000_003))
        bench.until(lambda: disk.refused > 3)
        bench.stop()
    assert bench.account["finished"] is False
    assert bench.account["bytes_in_file"] == (tmp_path / "run.mcap").stat().st_size == 4000


def test_when_the_disk_takes_nothing_for_long_new_messages_go_and_are_counted(tmp_path, monkeypatch):
    disk = FullDisk(0)
    monkeypatch.setattr(module.os, "write", disk)
    kind = message("CycleRecord")
    with Bench(tmp_path, unwritten_mib=1) as bench:
        for seq in range(1, 4001):
            bench.put(key(BENCH, CYCLE), pressure(seq)[:20] + os.urandom(kind.size - 20))  # does not compress
        bench.until(lambda: bench.recorder.account.storage > 0)
        disk.room = 1 << 30
        bench.arrived(4000)
    account = bench.account
    kept = [m.sequence for m in bench.messages(key(BENCH, CYCLE))]
    assert account["finished"]
    assert account["dropped_storage"] > 0
    assert kept[: len(kept) // 2] == list(range(1, len(kept) // 2 + 1))
    # The recorder's own words may be among what was dropped.
    assert len(kept) + account["dropped_storage"] >= 4000


def incompressible(seq):
    """A cycle record of this number."""
    return pressure(seq)[:20] + os.urandom(message("CycleRecord").size - 20)


def test_a_full_chunk_goes_to_the_disk_at_once(tmp_path):
    with Bench(tmp_path, flush_s=60.0, chunk_kib=4) as bench:
        begun = (tmp_path / "run.mcap").stat().st_size
        for seq in range(1, 101):
            bench.put(key(BENCH, CYCLE), incompressible(seq))
        bench.until(lambda: (tmp_path / "run.mcap").stat().st_size > begun + 4096)


def test_who_asks_the_recorder_to_end_may_kill_it_while_it_waits_for_the_last_words(tmp_path):
    """All that it heard before is on the disk first, and what comes then goes there when it is due."""
    log, seq = tmp_path / "run.mcap", 1
    with Bench(tmp_path, flush_s=60.0, drain_s=60.0) as bench:
        begun = log.stat().st_size
        bench.put(key(BENCH, CYCLE), incompressible(seq))
        bench.until(lambda: key(BENCH, CYCLE) in bench.recorder.account.topics)
        assert log.stat().st_size == begun, "it waits for its flush"
        bench.context.stop.set("test")
        while log.stat().st_size == begun:
            seq = speak_on(bench, seq)
        before = log.stat().st_size
        bench.recorder.config = bench.config.model_copy(update={"flush_s": 0.1})
        while log.stat().st_size == before:
            seq = speak_on(bench, seq)
    assert [m.sequence for m in bench.messages(key(BENCH, CYCLE))] == list(range(1, seq + 1))


def speak_on(bench, seq):
    """Who still speaks keeps the recorder from its end; the number of the message."""
    assert bench.thread.is_alive()
    assert seq < 20_000
    bench.put(key(BENCH, CYCLE), incompressible(seq + 1))
    time.sleep(0.001)
    return seq + 1


def test_a_renewed_subscription_keeps_what_waits(tmp_path):
    with Bench(tmp_path, poll_s=0.5) as bench:
        other = bench.guest.everything(1000)
        witness = bench.guest.inbox(PRESSURE)
        for seq in range(1, 11):
            bench.put(key(BENCH, PRESSURE), pressure(seq))
        for _ in range(10):
            assert witness.take(END_S)
        time.sleep(0.1)
        other.renew()
        bench.put(key(BENCH, PRESSURE), pressure(11))
        got = []
        bench.until(lambda: got.extend(p for k, p in other.take_all()[0] if k == key(BENCH, PRESSURE)) or len(got) >= 11)
    assert got == [pressure(seq) for seq in range(1, 12)]


def test_a_log_that_cannot_be_begun_is_said_before_the_run(tmp_path):
    with pytest.raises(Unavailable, match=r"none/run\.mcap: cannot be written: No such file"):
        Sink(tmp_path / "none" / "run.mcap")


@pytest.mark.parametrize("name", ["../run.mcap", "run.txt", "a/b.mcap"])
def test_the_log_stays_in_the_runs_directory(name):
    with pytest.raises(BadConfig, match="key 'file'"):
        load_model(RecorderConfig, {"file": name}, "bench.toml")


def test_sequences():
    sequence = Sequence(5, 5)
    for seq in (6, 9, 9, 2, 3):
        sequence.note(seq)
    assert (sequence.messages, sequence.missing, sequence.backward, sequence.last) == (6, 2, 2, 3)


def test_no_compiler_and_no_solver_in_this_process():
    code = "import sys, softloop.watch.recorder; print([m for m in ('numba', 'scipy', 'matplotlib') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "[]"


def test_a_killed_recorder_leaves_what_was_flushed(tmp_path: Path):
    """In a process of its own, ended by SIGKILL while messages come in."""
    with Bench(tmp_path) as bench:  # gives the meeting point; its own recorder is of no interest here
        other = tmp_path / "killed"
        other.mkdir()
        code = (
            "import sys; from pathlib import Path\n"
            "from softloop.watch.config import RecorderConfig; from softloop.watch.recorder import run\n"
            "from softloop.wire.config import ZenohConfig; from softloop.wire.session import open_wire\n"
            "from softloop.wire.shell import Context\n"
            "with open_wire(ZenohConfig(mode='client', lease_ms=10000, endpoint=sys.argv[1]), 'rec', 'other') as wire:\n"
            "    run(RecorderConfig(flush_s=0.05, poll_s=0.005), Context('other', 'rec', Path(sys.argv[2]), wire))\n"
        )
        child = subprocess.Popen([sys.executable, "-c", code, bench.zenoh.endpoint, str(other)])
        try:
            bench.until(lambda: "other" in bench.guest.processes_alive())
            log = other / "run.mcap"
            begun = log.stat().st_size
            seq = 0
            while log.stat().st_size < begun + 10_000:
                seq += 1
                bench.put(key(BENCH, PRESSURE), pressure(seq, stamp_ns=seq * 7919 % 1_000_003))
                assert child.poll() is None
                time.sleep(0.001)
        finally:
            child.kill()
            child.wait(10)
    content = log.read_bytes()
    assert content.count(b"lz4") >= 1
    assert b"versions.json" in content
    assert not (other / "recorder.json").exists()
