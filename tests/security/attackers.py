"""Those who should not be there, as processes: python -m tests.security.attackers BENCH KEYS NAME MODE SECONDS

Each tries without pause to move a valve, to read, to re-arm and to flood, and prints a JSON line of what it did and heard. NAME -
is one without a certificate. They are nice and of the batch class: on a machine of two processors they stand for somebody on
another computer, who takes no processor time from the rig, but are not to be kept from it altogether.
"""

import json
import os
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import zenoh

from softloop.deploy.bench import load_bench
from softloop.wire.channels import ARM, COMMAND, REQUEST, can_key, key
from softloop.wire.identity import Identity, settings
from softloop.wire.messages import constant, message
from softloop.wire.rights import Rights, rights_of
from softloop.wire.zenoh_settings import make_config

ORIGIN = 666
FLOOD_BYTES = 1000
MARK = b"ours"  # what a session puts it also hears itself
ENDS_WITHIN_S = 60.0


def attackers_config(bench, keys, name, mode):
    """Zenoh's configuration with the certificate of an identity and no rules; `name` "" is without a certificate."""
    told = settings(bench.zenoh.tls.model_copy(update={"folder": str(keys)}), bench.name, name or "guest")
    del told["access_control"]
    if not name:
        own = ("connect_certificate", "connect_private_key", "enable_mtls")
        told["transport/link/tls"] = {k: v for k, v in told["transport/link/tls"].items() if k not in own}
    over = bench.zenoh.endpoint.partition("/")[0]
    listen = [] if mode == "client" else [f"{over}/127.0.0.1:0"]
    identity = Identity(name, Rights(), told)
    config = make_config(mode, listen, [bench.zenoh.endpoint], 5000, listen_must_work=False, identity=identity)
    config.insert_json5("connect/timeout_ms", json.dumps(1500))
    return config


def command(seq, charge_ma=200.0):
    """A command that would open the charge valve."""
    kind = message("ValveCommand")
    return kind.pack(kind.make(seq=seq, stamp_ns=time.monotonic_ns(), charge_current_ma=charge_ma, ready=1))


def request(action, seq=1):
    """A request to the gate."""
    kind = message("GateRequest")
    code = constant("GateRequest", f"ACTION_{action.upper()}")
    return kind.pack(kind.make(seq=seq, stamp_ns=time.monotonic_ns(), origin=ORIGIN, action=code))


def valve_frame(seq=1):
    """A frame that would open the charge valve, by its looks."""
    from softloop.devices.protocols import can_frames  # noqa: PLC0415
    from softloop.wire.can_frame import make_frame, pack_frame  # noqa: PLC0415

    data = can_frames.encode_valve_command(can_frames.ValveCommandFrame(seq % 15, 1, 4000, 0, seq & 0xFFFF))
    return pack_frame(make_frame(seq, time.monotonic_ns(), ORIGIN, can_frames.VALVE_COMMAND_ID, data, 0))


def deeds(bench, seq=1):
    """(key, payload) of what would move a valve or arm the rig, under its own key and under wider ones."""
    head = f"softloop/{bench}"
    yield key(bench, COMMAND), command(seq)
    yield can_key(bench, "can0", 0x80), valve_frame(seq)
    for wide in (f"{head}/*", f"{head}/**", "softloop/**", "**", f"{head}/com$*"):
        yield wide, command(seq)
    for wide in (f"{head}/can/can0/*", f"{head}/can/**", "softloop/*/can/can0/80"):
        yield wide, valve_frame(seq)
    for wide in (key(bench, ARM), key(bench, REQUEST), f"{head}/*", "**"):
        yield wide, request("arm", seq)
    yield key(bench, ARM), request("stop", seq)


def main():
    os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    os.nice(10)
    bench, keys, name, mode, seconds = load_bench(Path(sys.argv[1])), *sys.argv[2:]
    done = {"sessions": 0, "refused": 0, "puts": 0, "heard": 0, "keys": []}
    config = attackers_config(bench, keys, name.strip("-"), mode)
    has = Path(keys) == Path(bench.zenoh.tls.folder) and name != "-"  # a certificate that is good for a link
    rights = rights_of(name, [], []) if has else Rights()
    print("ready", flush=True)
    sys.stdin.readline()
    end = time.monotonic() + float(seconds)
    while time.monotonic() < end:
        with suppress(zenoh.ZError):
            with zenoh.open(config) as session:
                done["sessions"] += 1
                flood(session, bench.name, rights, done, end)
            continue
        done["refused"] += 1
    print(json.dumps(done), flush=True)


def flood(session, bench, rights, done, end):
    """Until the end; a session that has no link after 3 s makes way for another. What `rights` do not let it hear is counted."""

    def note(sample):
        part = str(sample.key_expr).removeprefix(f"softloop/{bench}/")
        if (sample.attachment is None or bytes(sample.attachment) != MARK) and not rights.may_hear(part):
            done["heard"] += 1
            done["keys"] = sorted({*done["keys"], str(sample.key_expr)})[:20]

    listener = session.declare_subscriber(f"softloop/{bench}/**", zenoh.handlers.Callback(note, indirect=False))
    give_up = time.monotonic() + 3.0
    padding = os.urandom(FLOOD_BYTES)
    while time.monotonic() < end and (session.info.routers_zid() or time.monotonic() < give_up):
        for full_key, payload in deeds(bench, done["puts"] + 1):
            for sent in (payload, payload + padding):
                session.put(full_key, sent, priority=zenoh.Priority.REAL_TIME, attachment=MARK)
                done["puts"] += 1
    listener.undeclare()


class Attacker:
    """Such a process, started and ready; it waits for `begin`."""

    def __init__(self, bench_file, keys, name, mode, seconds):
        words = [sys.executable, "-m", "tests.security.attackers", str(bench_file), str(keys), name or "-", mode, str(seconds)]
        self.process = subprocess.Popen(words, stdout=subprocess.PIPE, stdin=subprocess.PIPE, text=True)
        assert self.process.stdout.readline() == "ready\n"

    def begin(self):
        self.process.stdin.write("\n")
        self.process.stdin.flush()

    def done(self):
        """Wait for its end; what it did and heard."""
        said, _ = self.process.communicate(timeout=ENDS_WITHIN_S)
        return json.loads(said)

    def close(self):
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()


if __name__ == "__main__":
    main()
