"""How many messages per second the recorder takes without losing one.

    python benchmarks/record.py [--seconds 3] [--rates 10000 20000 ...] [--json]

A sender in a process of its own publishes the messages of a bench in the proportions of a run, the recorder writes them, and its
account is held against what was sent. The rate rises until something is lost. What the recorder's process needs per message is
put beside what the mcap library's own writer needs for the same messages, both in processor time.
"""

from __future__ import annotations

import argparse
import io
import json
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer
from rich.console import Console
from rich.table import Table

from softloop.watch.config import RecorderConfig
from softloop.watch.recorder import run
from softloop.wire.channels import COMMAND, CYCLE, INCLINATION, PRESSURE, TRUTH, VALVES, can_key, key
from softloop.wire.config import ZenohConfig
from softloop.wire.messages import message
from softloop.wire.session import open_router, open_wire
from softloop.wire.shell import Context, Stop

BENCH = "record"
RATES = (5_000, 10_000, 20_000, 30_000, 40_000, 50_000, 60_000, 80_000)
FRAMES = 3  # of nine messages of a tick three are CAN frames, as in a run
SLICE_S = 0.002
_READY_S = 20.0


def lanes() -> list[tuple[str, Any]]:
    """(key, message) of the nine messages that one tick of a bench makes."""
    of_channel = [(key(BENCH, c), message(c.message)) for c in (PRESSURE, INCLINATION, COMMAND, VALVES, CYCLE, TRUTH)]
    return of_channel + [(can_key(BENCH, "can0", 0x80 + 0x10 * i), message("CanFrame")) for i in range(FRAMES)]


def payloads(seq: int) -> list[bytes]:
    """One message for each lane, with this number."""
    made = []
    for _, kind in lanes():
        values = {"seq": seq, "stamp_ns": seq * 5_000_000}
        made.append(kind.pack(kind.make(**values, **({"node": 1 + len(made)} if kind.name == "CanFrame" else {}))))
    return made


def send(endpoint: str, rate_hz: float, seconds: float) -> None:
    """The sender's process: publish at a steady rate, then print how many went and how long it took."""
    zenoh = ZenohConfig(lease_ms=20_000, endpoint=endpoint)
    ticks = round(rate_hz * seconds / len(lanes()))
    made = [payloads(seq) for seq in range(1, ticks + 1)]
    with open_wire(zenoh, BENCH, "sender") as wire:
        puts = [wire.declare_publisher(full_key, realtime=False).put for full_key, _ in lanes()]
        _until(lambda: "recorder" in wire.processes_alive())
        time.sleep(0.5)
        began = time.monotonic()
        for k, of_tick in enumerate(made):
            behind_s = began + k * len(lanes()) / rate_hz - time.monotonic()
            if behind_s > SLICE_S:
                time.sleep(behind_s)
            for put, payload in zip(puts, of_tick, strict=True):
                put(payload)
        took_s = time.monotonic() - began
        time.sleep(1.0)  # what is under way arrives
    print(json.dumps({"sent": ticks * len(lanes()), "took_s": took_s}))


def record(endpoint: str, run_dir: str) -> None:
    """The recorder's process; prints its processor time."""
    stop = Stop()
    signal.signal(signal.SIGTERM, lambda *_: stop.set("SIGTERM"))
    sys.setswitchinterval(5e-4)  # as the process shell has it
    with open_wire(ZenohConfig(lease_ms=20_000, endpoint=endpoint), BENCH, "recorder") as wire:
        began_s = time.process_time()
        run(RecorderConfig(), Context("recorder", BENCH, Path(run_dir), wire, stop=stop))
        print(json.dumps({"cpu_s": time.process_time() - began_s}))


def _until(condition: Any) -> None:
    end = time.monotonic() + _READY_S
    while not condition():
        if time.monotonic() > end:
            raise SystemExit("record: the recorder did not come up")
        time.sleep(0.05)


def _child(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, __file__, *arguments], stdout=subprocess.PIPE, text=True)


def measure(rate_hz: float, seconds: float) -> dict[str, Any]:
    """One rate: what was sent, what was lost, and the processor time per message."""
    with tempfile.TemporaryDirectory(prefix="sl-record-") as folder:
        endpoint = f"unixsock-stream/{folder}/m.sock"
        with open_router(ZenohConfig(endpoint=endpoint), BENCH):
            recorder = _child("--be-recorder", endpoint, folder)
            sender = _child("--be-sender", endpoint, str(rate_hz), str(seconds))
            sent = json.loads(sender.communicate(timeout=seconds * 4 + 60)[0])
            recorder.terminate()
            used = json.loads(recorder.communicate(timeout=30)[0])
        account = json.loads((Path(folder) / "recorder.json").read_text())
    own = sum(account["channels"].get(f"/softloop/{BENCH}/{n}", {"messages": 0})["messages"] for n in ("status", "event"))
    logged = account["messages"] - own
    return {
        "asked_hz": rate_hz,
        "sent_hz": sent["sent"] / sent["took_s"],
        "sent": sent["sent"],
        "lost": sent["sent"] - logged,
        "lost_in_recorder": account["dropped_backlog"] + account["dropped_storage"],
        "cpu_us_per_message": used["cpu_s"] / max(1, logged) * 1e6,
    }


def library_us(ticks: int = 3000) -> float:
    """Processor time per message of the mcap library's writer for the same messages, us."""
    made = [payloads(seq) for seq in range(1, ticks + 1)]
    writer = Writer(io.BytesIO(), chunk_size=64 * 1024, compression=CompressionType.LZ4)
    writer.start("ros2", "benchmark")
    ids = []
    for full_key, kind in lanes():
        schema = writer.register_schema(kind.ros_name, "ros2msg", kind.text.encode())
        ids.append(writer.register_channel(f"/{full_key}", "cdr", schema))
    began_s = time.process_time()
    for seq, of_tick in enumerate(made, 1):
        for channel_id, payload in zip(ids, of_tick, strict=True):
            writer.add_message(channel_id, seq, payload, seq, seq)
    writer.finish()
    return (time.process_time() - began_s) / (ticks * len(ids)) * 1e6


def show(result: dict[str, Any]) -> None:
    """The table for a person."""
    table = Table(title="recorder", title_justify="left")
    for head in ("asked, 1/s", "sent, 1/s", "sent", "lost", "of these in the recorder", "us of processor per message"):
        table.add_column(head, justify="right")
    for row in result["rates"]:
        counts = (f"{row['asked_hz']:.0f}", f"{row['sent_hz']:.0f}", str(row["sent"]), str(row["lost"]))
        table.add_row(*counts, str(row["lost_in_recorder"]), f"{row['cpu_us_per_message']:.1f}")
    console = Console(width=110)
    console.print(table)
    console.print(f"most without loss: {result['without_loss_hz']:.0f} messages per second")
    console.print(f"mcap's own writer alone: {result['library_us']:.1f} us of processor per message")


def main() -> None:
    """Measure, show, and with --json print the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--rates", type=float, nargs="+", default=list(RATES))
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--be-sender", nargs=3, help=argparse.SUPPRESS)
    parser.add_argument("--be-recorder", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.be_sender:
        return send(options.be_sender[0], float(options.be_sender[1]), float(options.be_sender[2]))
    if options.be_recorder:
        return record(*options.be_recorder)
    rows: list[dict[str, Any]] = []
    for rate_hz in options.rates:
        rows.append(measure(rate_hz, options.seconds))
        if rows[-1]["lost"]:
            break
    best = max((row["sent_hz"] for row in rows if row["lost"] == 0), default=0.0)
    result = {"rates": rows, "without_loss_hz": best, "library_us": library_us()}
    print(json.dumps(result)) if options.json else show(result)
    return None


if __name__ == "__main__":
    main()
