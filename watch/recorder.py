"""The recorder: every message of a bench into one MCAP file, and an account of what is missing.

What it drops, it counts, by these rules:
- backlog: more messages wait than `backlog_messages`: the oldest go, and the senders' numbers say how many;
- storage: the disk has not taken `unwritten_mib` of finished bytes: new messages go until it takes them again. Nothing that
  was written becomes invalid: the file goes on at the byte at which the disk refused;
- malformed: a payload that is not the message of its channel is counted and not logged, because a log whose bytes do not fit
  their schema cannot be read by others;
- unknown: a key that is no channel of the table.
The first two are events in the log; the first three stand in `ProcessStatus.dropped`. At the end `recorder.json` in the run's
directory says it all. A recorder that is started again in a run writes the log's next part, `run-2.mcap` and `recorder-2.json`.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import math
import os
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from softloop.watch.config import RecorderConfig
from softloop.wire.backlog import Backlog
from softloop.wire.channels import CAN, EVENT, STATUS, Channel
from softloop.wire.errors import Unavailable
from softloop.wire.log_parts import account_of, next_part
from softloop.wire.mcap_layout import (
    BadMessage,
    LogWriter,
    attachments_of,
    known_channel,
    read_origin,
    topic_of_key,
)
from softloop.wire.messages import constant, message
from softloop.wire.shell import Context, say

NAME = "recorder"
SOURCE = constant("Event", "SOURCE_RECORDER")
KIND_BACKLOG = constant("Event", "KIND_BACKLOG")
CODE_BACKLOG = 0  # Event.code with KIND_BACKLOG: the recorder did not keep up
CODE_STORAGE = 1  # the disk took nothing
CODE_RENEWED = 2  # a steady channel fell silent, and the recorder subscribed anew
_STEADY_HZ = 100.0  # a channel of at least this rate that says nothing for a second is silent
STATUS_S = 1.0
_STORE_BYTES = 1 << 20
_RETRY_S = 0.1
_BATCH = 4096  # messages written between two looks at what is due to the disk
_QUIET_PASSES = 3  # nothing came on so many passes: all that was sent has arrived


class Sink:
    """A stream that takes everything into memory and gives it to the disk when the disk takes it.

    A failing disk therefore never leaves half a record: what it refused stays here, and goes at the same offset later.
    """

    def __init__(self, path: Path) -> None:
        """Raises Unavailable when the file cannot be made."""
        try:
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise Unavailable(f"{path}: cannot be written: {error.strerror or error}") from None
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(self._file, fcntl.LOCK_SH | fcntl.LOCK_NB)  # whoever keeps a disk budget sees that it is being written
        self._waiting = bytearray()
        self.stored = 0

    @property
    def waiting(self) -> int:
        """Bytes that the disk has not taken yet."""
        return len(self._waiting)

    def write(self, data: bytes) -> int:
        self._waiting += data
        return len(data)

    def tell(self) -> int:
        return self.stored + len(self._waiting)

    def store(self) -> None:
        """Give to the disk what waits. Raises OSError when it does not take all; the rest stays."""
        while self._waiting:
            taken = os.write(self._file, self._waiting[:_STORE_BYTES])
            del self._waiting[:taken]
            self.stored += taken

    def close(self) -> None:
        os.close(self._file)


@dataclass
class Sequence:
    """What one sender's numbers on one topic (CAN: one bus) say about loss."""

    first: int
    last: int
    messages: int = 1
    missing: int = 0
    backward: int = 0  # numbers at or below one seen before: repeated, out of order, or a sender that started anew

    def note(self, seq: int) -> int:
        """Count a message; returns how many are missing before it."""
        gap = max(0, seq - self.last - 1) if seq != self.last + 1 else 0
        self.messages += 1
        self.missing += gap
        self.backward += seq <= self.last
        self.last = seq
        return gap


@dataclass
class Account:
    """What was logged and what was not."""

    topics: dict[str, list[int]] = field(default_factory=dict)  # key -> [messages, payload bytes]
    sequences: dict[tuple[str, int], Sequence] = field(default_factory=dict)  # (what the sender counts over, sender)
    backlog: int = 0
    storage: int = 0
    malformed: int = 0
    unknown: int = 0
    missing: int = 0  # numbers that never came, of all sequences together: what the senders dropped and the backlog
    storage_errors: list[str] = field(default_factory=list)
    _by_key: dict[tuple[str, int], Sequence] = field(default_factory=dict)  # the same by the key they come on, for speed

    @property
    def dropped(self) -> int:
        return self.backlog + self.storage + self.malformed

    def note(self, full_key: str, n_bytes: int, seq: int, sender: int) -> None:
        count = self.topics.get(full_key)
        if count is None:
            count = self.topics[full_key] = [0, 0]
        count[0] += 1
        count[1] += n_bytes
        sequence = self._by_key.get((full_key, sender))
        if sequence is not None:
            self.missing += sequence.note(seq)
            return
        name = (_counted_over(full_key), sender) if sender else (full_key, 0)
        sequence = self.sequences.get(name)
        if sequence is None:
            sequence = self.sequences[name] = Sequence(seq, seq)
        else:
            self.missing += sequence.note(seq)
        self._by_key[full_key, sender] = sequence

    def as_dict(self, stored: int, *, finished: bool) -> dict[str, Any]:
        return {
            "finished": finished,
            "bytes_in_file": stored,
            "messages": sum(count[0] for count in self.topics.values()),
            "missing": self.missing,
            "dropped_backlog": self.backlog,
            "dropped_storage": self.storage,
            "malformed": self.malformed,
            "unknown_keys": self.unknown,
            "storage_errors": self.storage_errors,
            "channels": {topic_of_key(k): {"messages": c[0], "payload_bytes": c[1]} for k, c in sorted(self.topics.items())},
            "sequences": [
                {"topic": topic_of_key(k), "sender": sender, **vars(s)} for (k, sender), s in sorted(self.sequences.items())
            ],
        }


def _counted_over(full_key: str) -> str:
    """A CAN node counts its frames over all identifiers of a bus; other senders count on one key."""
    parts = full_key.split("/")
    return "/".join(parts[:-1]) if parts[2] == CAN.name else full_key


class Recorder:
    """The loop's state: what comes in, where it goes, and the account."""

    def __init__(self, config: RecorderConfig, context: Context) -> None:
        self.config = config
        self.context = context
        self.account = Account()
        self.inbox: Backlog = context.wire.everything(config.backlog_messages)
        self.file = next_part(context.run_dir / config.file)
        self.sink = Sink(self.file)
        origin = read_origin(context.bench, context.clock.now_ns())
        attachments = attachments_of(context.run_dir)
        self.log = LogWriter(self.sink, origin, attachments, config.chunk_kib * 1024)
        self._channels: dict[str, Channel | None] = {}
        self._publish_event = context.wire.publisher(EVENT)
        self._publish_status = context.wire.publisher(STATUS)
        self._events = self._statuses = self._passes = 0
        self._said_dropped = 0
        self._heard: dict[str, int] = {}
        self._silent: set[str] = set()
        self._refused = False
        self._retry_s = -math.inf  # until then a disk that refused is left alone
        self._looked_s = time.monotonic()  # nothing waited then
        self._oldest_s = math.inf  # since when the chunk in progress may hold messages, or these may have waited before
        self._late_max_ns = 0
        # At lockstep pace its word on itself, which is of this machine and moment, stands in its account alone.
        self._speaks = not context.pace.exact
        self.store()

    def take(self) -> int:
        """Write what has arrived; how many messages came."""
        arrived, overrun = self.inbox.take_all()
        since_s, self._looked_s = self._looked_s, time.monotonic()
        missing_before = self.account.missing
        for start in range(0, len(arrived), _BATCH):
            self._oldest_s = min(self._oldest_s, since_s)
            self._write_all(arrived[start : start + _BATCH])
            self.keep()
        if overrun:
            self.account.backlog += self.account.missing - missing_before
        return len(arrived)

    def _write_all(self, arrived: list[tuple[str, bytes]]) -> None:
        full = self.sink.waiting > self.config.unwritten_mib << 20
        for full_key, payload in arrived:
            channel = self._channel(full_key)
            if channel is None:
                self.account.unknown += 1
            elif not channel.logged:
                continue
            elif full:
                self.account.storage += 1
            else:
                self._write(full_key, channel, payload)

    def _channel(self, full_key: str) -> Channel | None:
        if full_key not in self._channels:
            if len(self._channels) > 10_000:  # CAN identifiers make keys; strangers' keys must not eat the memory
                self._channels.clear()
            self._channels[full_key] = known_channel(self.context.bench, full_key)
        return self._channels[full_key]

    def _write(self, full_key: str, channel: Channel, payload: bytes) -> None:
        try:
            seq, sender = self.log.add(full_key, channel, payload)
        except BadMessage:
            self.account.malformed += 1
        else:
            self.account.note(full_key, len(payload), seq, sender)

    def keep(self) -> None:
        """Give to the disk what is due: the chunk in progress once it holds what is `flush_s` old, a full one at once.

        Age counts from the look before, at which nothing waited, so that a message's wait for this process is in it.
        """
        now_s = time.monotonic()
        if now_s < self._retry_s:
            return
        if now_s - self._oldest_s >= self.config.flush_s:
            self.flush()
        elif self.sink.waiting:
            self.store()

    def flush(self) -> None:
        """Close the chunk and give all to the disk; a disk that refuses is said once, and tried again soon."""
        if self.sink.waiting <= self.config.unwritten_mib << 20:
            self.log.flush()
            self._oldest_s = math.inf
        self.store()

    def store(self) -> None:
        """Give what waits to the disk. Never raises."""
        try:
            self.sink.store()
        except OSError as error:
            self._retry_s = time.monotonic() + _RETRY_S
            if not self._refused:
                self._refused = True
                self._storage_lost(error.strerror or str(error))
        else:
            if self._refused:
                self._refused = False
                say(NAME, f"the disk takes the log again; {self.account.storage} messages are lost")

    def _storage_lost(self, text: str) -> None:
        self.account.storage_errors.append(text)
        say(NAME, f"{self.file.name}: {text}; the run goes on, and up to {self.config.unwritten_mib} MiB wait for the disk")
        self._event(CODE_STORAGE, self.account.storage)

    def listen_again(self) -> None:
        """Once a second: where a steady channel has fallen silent, subscribe anew, once per silence.

        Seen once, at a start on a busy machine: a process whose way to the recorder changed from the router to a
        direct link sent nothing more there, though its other readers heard it.
        """
        now = {key: count[0] for key, count in self.account.topics.items()}
        steady = {key for key in now if (channel := self._channels.get(key)) and channel.rate_hz >= _STEADY_HZ}
        silent = {key for key in steady if now[key] == self._heard.get(key)}
        if silent - self._silent:
            self.inbox.renew()
            self._event(CODE_RENEWED, len(silent))
        self._silent, self._heard = silent, now

    def report(self) -> None:
        """Once a second: drops as an event, and this process's status."""
        if not self._speaks:
            return
        lost = self.account.backlog + self.account.storage
        if lost > self._said_dropped:
            say(NAME, f"dropped {lost - self._said_dropped} messages")
            self._said_dropped = lost
            self._event(CODE_STORAGE if self._refused else CODE_BACKLOG, lost)
        self._statuses += 1
        kind = message("ProcessStatus")
        status = kind.make(
            seq=self._statuses,
            stamp_ns=self.context.clock.now_ns(),
            pid=os.getpid(),
            cycles=self._passes,
            dropped=self.account.dropped,
            late_max_ns=self._late_max_ns,
            process=SOURCE,
            state=constant("ProcessStatus", "STATE_STOPPING" if self.context.stop else "STATE_RUNNING"),
            realtime=int(self.context.realtime),
        )
        self._publish_status(kind.pack(status))
        self._late_max_ns = 0

    def _event(self, code: int, value: int) -> None:
        self._events += 1
        kind = message("Event")
        now_ns = self.context.clock.now_ns()
        made = kind.make(seq=self._events, stamp_ns=now_ns, value=float(value), source=SOURCE, kind=KIND_BACKLOG, code=code)
        self._publish_event(kind.pack(made))

    def keep_time(self, began_s: float) -> None:
        """Wait for the next pass, and note by how much this one was longer than its period."""
        self._passes += 1
        late_s = time.monotonic() - began_s - self.config.poll_s
        self._late_max_ns = max(self._late_max_ns, int(late_s * 1e9))
        self.context.stop.wait(self.config.poll_s)

    def finish(self) -> None:
        """Write what is left, within `drain_s`, close the file and leave the account.

        What was heard goes to the disk first: who has no patience with this process may kill it.
        """
        end = time.monotonic() + self.config.drain_s
        self.flush()
        self.report()
        quiet = 0
        while quiet < _QUIET_PASSES and time.monotonic() < end:
            time.sleep(self.config.poll_s)  # what others sent with their last breath is on its way
            quiet = 0 if self.take() else quiet + 1
            self.keep()
        self.log.finish()
        self.store()
        while self.sink.waiting and time.monotonic() < end:
            time.sleep(_RETRY_S)
            self.store()
        finished = self.sink.waiting == 0
        self.sink.close()
        self._leave_account(finished=finished)

    def _leave_account(self, *, finished: bool) -> None:
        text = json.dumps(self.account.as_dict(self.sink.stored, finished=finished), indent=2)
        file = account_of(self.file)
        try:
            file.write_text(text + "\n")
        except OSError as error:
            say(NAME, f"{file.name}: {error.strerror or error}")


def run(config: RecorderConfig, context: Context) -> None:
    """The recorder process. Raises Unavailable when the log cannot be begun; from then on nothing ends it but a stop.

    Its own pace is the machine's, whatever clock the rig runs on: flushing is about what a killed process may cost.
    """
    recorder = Recorder(config, context)
    context.enter_loop()
    next_report_s = time.monotonic()
    while not context.stop:
        now_s = time.monotonic()
        context.pace.keep_up(recorder.take)
        recorder.keep()
        if now_s >= next_report_s:
            recorder.report()
            if not context.pace.exact:  # there a channel may rest for as long as the slowest process needs
                recorder.listen_again()
            next_report_s = now_s + STATUS_S
        recorder.keep_time(now_s)
    recorder.finish()
