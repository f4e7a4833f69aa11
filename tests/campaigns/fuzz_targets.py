"""The boundaries of softloop, each as a function of bytes: whatever they are, it returns; what it must hold is asserted."""

import atexit
import contextlib
import hashlib
import math
import os
import shutil
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from softloop.deploy.bench import load_bench
from softloop.devices import gate as g
from softloop.devices.config import InclinometerConfig
from softloop.devices.gate_messages import COMMAND as COMMAND_DTYPE
from softloop.devices.protocols import can_frames, wt931
from softloop.devices.protocols.can_frames import E2eReceiver, e2e_crc
from softloop.devices.protocols.quantise import counts_to_deg
from softloop.devices.valves import ValvesLoop
from softloop.dynamics.parameters import load_parameters
from softloop.offline.log import open_log
from softloop.offline.log_check import check_log
from softloop.offline.log_repair import repair_log
from softloop.wire.can_frame import make_frame, pack_frame, unpack_frame
from softloop.wire.channels import CHANNELS, COMMAND, key
from softloop.wire.errors import SoftloopError
from softloop.wire.mcap_layout import BadMessage, LogWriter, Origin
from softloop.wire.messages import BadPayload, message, message_names
from tests.campaigns.fuzz_corpora import bench_files, log_files, parameter_files
from tests.devices.gate_bench import GateBench

FOLDER = Path(tempfile.mkdtemp(prefix="sl-fuzz-", dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else None))
atexit.register(shutil.rmtree, FOLDER, ignore_errors=True)
WHOLE_CAN = b"\xff" * 8


def can(data):
    """Frames of any length into both receivers, and the payload of a frame on Zenoh."""
    frame = unpack_frame(data)
    if frame is not None:
        assert unpack_frame(pack_frame(frame)) == frame
    for data_id, decode in (
        (can_frames.VALVE_COMMAND_ID, can_frames.decode_valve_command),
        (can_frames.VALVE_STATUS_ID, can_frames.decode_valve_status),
    ):
        receiver = E2eReceiver(data_id, 4)
        for at in range(0, max(1, len(data)), 8):
            part = data[at : at + 8]
            if receiver.judge(part).usable:
                assert len(part) == 8
                assert part[0] == e2e_crc(part, data_id), "a frame with a wrong CRC was let through"
                assert 0 <= decode(part).counter < can_frames.COUNTER_STATES
    if len(data) >= 8:
        can_frames.decode_analog_inputs(data[:8])


def can_corpus():
    command = can_frames.encode_valve_command(can_frames.ValveCommandFrame(0, 1, 8000, 0, 1))
    more = can_frames.encode_valve_command(can_frames.ValveCommandFrame(1, 1, 8000, 0, 2))
    status = can_frames.encode_valve_status(can_frames.ValveStatusFrame(3, 0, 100, 200, 7))
    return [command + more, status, pack_frame(make_frame(1, 2, 3, 0x80, command)), WHOLE_CAN]


def new_sampler():
    config = InclinometerConfig(port="x")
    bounds = (config.rate_hz, config.max_rate_deg_s, config.noise_deg, config.max_acceleration_deg_s2, config.noise_deg_s)
    return wt931.Sampler(wt931.sampler_config(*bounds), config.baud)


def serial(data):
    """Bytes of the serial line, in pieces, into the inclinometer's sampler and into the device's command parser."""
    sampler, arrival_ns, at = new_sampler(), 1_000_000_000, 0
    while at < len(data):
        size = 1 + data[at] % 23
        arrival_ns += 5_000_000
        for sample in sampler.feed(data[at : at + size], arrival_ns):
            assert math.isfinite(counts_to_deg(sample.angle_counts))
            assert -32768 <= sample.rate_counts <= 32767
            assert sample.stamp_ns <= arrival_ns
        at += size
    wt931.CommandParser().feed(data)


def serial_corpus():
    burst = b"".join(wt931.encode_packet(kind, (1, 2, 3, 4)) for kind in sorted(wt931.TYPES))
    return [burst * 4, wt931.encode_unlock() + wt931.encode_command(3, 9), burst[:-3] + burst]


class _Nowhere:
    def __init__(self):
        self.at = 0

    def write(self, data):
        self.at += len(data)

    def tell(self):
        return self.at


_KINDS = [message(name) for name in message_names()]
_ORIGIN = Origin("fuzz", 1, 0)
_LOG = LogWriter(_Nowhere(), _ORIGIN, {})


def _gates():
    """A disarmed, an armed and a faulted gate behind the process's own reading of commands."""
    for prepare in (lambda b: b.tick(), lambda b: b.armed(), lambda b: (b.armed(), b.tick(stop=1))):
        bench = GateBench()
        prepare(bench)
        yield bench


class _Asked:
    """A gate behind what its process does with a command, made anew for each: on arrays, which cost less than records."""

    def __init__(self, bench):
        self.now_ns = bench.now_ns
        self._records = [np.zeros(1, d) for d in (g.GATE_CONFIG, g.GATE_STATE, g.GATE_INPUT, g.GATE_OUTPUT)]
        self._config, self._state, self._given, self._output = self._records
        bench.given.command_new = bench.given.stop = bench.given.arm = 0
        bench.given.now_ns = bench.given.driver_stamp_ns = bench.now_ns + 5_000_000
        self._config[0], self._state[0], self._given[0] = bench.config, bench.state, bench.given
        self._before = self._state.copy(), self._given.copy()
        self._was_armed = int(bench.state.gate) == g.GATE_ARMED
        command = np.zeros(1, COMMAND_DTYPE)
        self._loop = SimpleNamespace(
            status=SimpleNamespace(dropped=0), commands=SimpleNamespace(take_all=list), given=self._given[0],
            records=self._records, command=command, command_bytes=command.view("u1"), wait_ns=0, tick=0,
        )  # fmt: skip

    def ask(self, data):
        """Give `data` to the gate as its process would."""
        np.copyto(self._state, self._before[0])
        np.copyto(self._given, self._before[1])
        ValvesLoop._take_newest(self._loop, data, self.now_ns + 5_000_000)
        g.gate_step_of_arrays(self._config, self._state, self._given, self._output)
        out = dict(zip(g.GATE_OUTPUT.names, self._output.tolist()[0], strict=True))
        armed = out["gate"] == g.GATE_ARMED
        assert armed or (out["charge_counts"] == 0 and out["output"] != g.OUTPUT_PASS), "current without being armed"
        assert self._was_armed or not armed, "armed by a command"
        assert 0 <= out["charge_current_ma"] <= 220.0
        assert 0 <= out["exhaust_current_ma"] <= 220.0


_ASKED = [_Asked(bench) for bench in _gates()]
_LANES = [(channel, key("fuzz", channel)) for channel in CHANNELS]


def cdr(data):
    """A payload on every channel: unpacked or refused; as a command at the gate it passes nothing that it must not."""
    for kind in _KINDS:
        with contextlib.suppress(BadPayload):
            kind.unpack(data)
    for channel, full_key in _LANES:
        with contextlib.suppress(BadMessage):
            _LOG.add(full_key, channel, data)
    for asked in _ASKED:
        asked.ask(data)


def cdr_corpus():
    kind = message(COMMAND.message)
    near = _ASKED[1].now_ns
    good = kind.make(
        seq=5000, pressure_stamp_ns=near, inclination_stamp_ns=near, angle_deg=70.0, charge_current_ma=100.0, ready=1
    )
    ones = [k.make(**{name: 1 for name in ("seq", "stamp_ns") if name in k.Tuple._fields}) for k in _KINDS]
    return [kind.pack(good)] + [k.pack(one) for k, one in zip(_KINDS, ones, strict=True)]


def one_line(read, file):
    """A file is read, or refused in one line."""
    refused = ""
    try:
        read(file)
    except SoftloopError as error:
        refused = str(error) or "\n"
    assert "\n" not in refused, refused


def bench(data):
    """A bench file."""
    file = FOLDER / "bench.toml"
    file.write_bytes(data)
    one_line(load_bench, file)


def parameters(data):
    """A parameter file."""
    file = FOLDER / "parameters.toml"
    file.write_bytes(data)
    one_line(load_parameters, file)


def mcap(data):
    """A log: read and judged, one in sixteen also repaired and read again."""
    file, good = FOLDER / "run.mcap", FOLDER / "good.mcap"
    file.write_bytes(data)
    try:
        log = open_log(file)
        check_log(log)
    except SoftloopError:
        return
    if hashlib.blake2b(data, digest_size=1).digest()[0] % 16:
        return
    good.unlink(missing_ok=True)
    repair_log(file, good)
    again = open_log(good)
    # A metadata record has no checksum: a damaged one is kept as it is.
    assert not [p for p in again.problems if "not finished" in p or ("damaged" in p and "damaged metadata" not in p)]
    for name, records in log.channels.items():
        assert len(again[name]) >= len(records), f"{name} was lost by the repair"


TARGETS = {f.__name__: f for f in (can, serial, cdr, bench, parameters, mcap)}
CORPORA = {
    "can": can_corpus, "serial": serial_corpus, "cdr": cdr_corpus, "bench": lambda: bench_files(FOLDER),
    "parameters": parameter_files, "mcap": lambda: log_files(FOLDER),
}  # fmt: skip
