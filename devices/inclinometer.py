"""The process `inclinometer`: the WT931's bytes become samples of bending angle and rate."""

from __future__ import annotations

from softloop.devices.config import InclinometerConfig, sampler_bounds
from softloop.devices.inclinometer_setup import SerialSource, configure
from softloop.devices.protocols import wt931
from softloop.devices.protocols.quantise import counts_to_deg, counts_to_deg_s, mounted_deg
from softloop.wire.channels import INCLINATION
from softloop.wire.errors import Lost, Unavailable
from softloop.wire.messages import constant, message
from softloop.wire.pace import WIRE_INCLINOMETER
from softloop.wire.shell import Context, say
from softloop.wire.status import EventReporter, StatusReporter

_SAMPLE = message("InclinationSample")
_OK, _RATE_MISSING = constant("InclinationSample", "STATUS_OK"), constant("InclinationSample", "STATUS_RATE_MISSING")
_SOURCE, _KIND_BUS = constant("Event", "SOURCE_INCLINOMETER"), constant("Event", "KIND_BUS")
_WAIT_S = 0.05
_REOPEN_S = 0.1
_WINDOW_NS = 1_000_000_000
_WRONG_WINDOWS = 3  # so many seconds in a row with a wrong rate are the device's setting, not a busy computer


def run(config: InclinometerConfig, context: Context) -> None:
    """Publish one sample for each pair of packets until asked to stop; a port that goes away is opened again.

    Raises:
        Unavailable: the port cannot be opened, or the device does not send as the bench file says.
    """
    source = _open_patiently(config, context)
    if config.configure and source is not None:
        source.close()
        configure(config, context.clock)
        source = SerialSource(config.port, config.baud)
    loop = InclinometerLoop(config, context, source)
    context.enter_loop()
    try:
        while not context.stop:
            loop.turn()
    finally:
        loop.close()


def _open_patiently(config: InclinometerConfig, context: Context) -> SerialSource | None:
    """The port, waiting for it as long as the bench file says; None when asked to stop."""
    until_ns = context.clock.now_ns() + round(config.open_wait_s * 1e9)
    while not context.stop:
        try:
            return SerialSource(config.port, config.baud)
        except Unavailable:
            if context.clock.now_ns() >= until_ns:
                raise
        context.stop.wait(_REOPEN_S)
    return None


class InclinometerLoop:
    """From bytes to samples, over losses of the port."""

    def __init__(self, config: InclinometerConfig, context: Context, source: SerialSource | None) -> None:
        self.config, self.context, self.clock, self.source = config, context, context.clock, source
        self.sampler = wt931.Sampler(sampler_bounds(config), config.baud)
        self.seq = 0
        self.put = context.wire.publisher(INCLINATION)
        self.status, self.events = StatusReporter(context, _SOURCE), EventReporter(context, _SOURCE)
        self.rate = RateWatch(config)
        self.bytes = context.bytes(self, WIRE_INCLINOMETER)

    def turn(self) -> None:
        """Wait for bytes, publish what they bring, keep time. Raises Unavailable on a wrong rate from the start."""
        data = self.bytes.read(_WAIT_S)
        now_ns = self.clock.now_ns()
        for sample in self.sampler.feed(data, now_ns) if data else ():
            self._publish(sample)
        word = self.rate.look(now_ns, self.sampler.parser)
        if word:
            say(self.context.process, word)
        self.status.cycle()

    def read(self, timeout_s: float) -> bytes:
        """What has come, waiting up to `timeout_s`; over losses of the port."""
        if self.source is None:
            self._reopen()
            return b""
        try:
            return self.source.read(timeout_s)
        except Lost as error:
            say(self.context.process, f"{error}; trying to open it again")
            self._note(lost=True)
            self.source.close()
            self.source = None
            return b""

    def _reopen(self) -> None:
        self.context.stop.wait(_REOPEN_S)
        try:
            self.source = SerialSource(self.config.port, self.config.baud)
        except Unavailable:
            return
        self.sampler.parser.forget()
        say(self.context.process, f"serial port {self.config.port} is back")
        self._note(lost=False)

    def _note(self, *, lost: bool) -> None:
        self.events.say(_KIND_BUS, self.clock.now_ns(), code=int(lost))

    def _publish(self, sample: wt931.Sample) -> None:
        self.seq += 1
        packed = _SAMPLE.make(
            seq=self.seq,
            stamp_ns=sample.stamp_ns,
            received_ns=sample.received_ns,
            published_ns=self.clock.now_ns(),
            angle_deg=mounted_deg(counts_to_deg(sample.angle_counts), self.config.direction, self.config.zero_deg),
            rate_deg_s=self.config.direction * counts_to_deg_s(sample.rate_counts),
            rejected=self.sampler.rejected,
            status=_OK if sample.kind == wt931.SAMPLE else _RATE_MISSING,
        )
        self.put(_SAMPLE.pack(packed))

    def close(self) -> None:
        if self.source is not None:
            self.source.close()
        self.status.close()


class RateWatch:
    """Measures, second by second, how often the device sends."""

    def __init__(self, config: InclinometerConfig) -> None:
        self.config = config
        self.wrong = 0  # windows in a row
        self.was_right = False
        self._since_ns = 0  # 0: waiting for the first byte
        self._packets = self._bytes = 0

    def look(self, now_ns: int, parser: wt931.Parser) -> str:
        """A line for a person when something changed, else nothing. Raises Unavailable when the rate never was right."""
        if self._since_ns == 0:
            if parser.taken > self._bytes:
                self._begin(now_ns, parser)
            return ""
        if now_ns - self._since_ns < _WINDOW_NS:
            return ""
        samples_hz = (parser.accepted - self._packets) / 2 * 1e9 / (now_ns - self._since_ns)
        came = parser.taken > self._bytes
        self._begin(now_ns if came else 0, parser)
        return self._judge(samples_hz, came)

    def _begin(self, now_ns: int, parser: wt931.Parser) -> None:
        self._since_ns, self._packets, self._bytes = now_ns, parser.accepted, parser.taken

    def _judge(self, samples_hz: float, came: bool) -> str:
        right = abs(samples_hz - self.config.rate_hz) <= self.config.rate_tolerance * self.config.rate_hz
        before, self.wrong = self.wrong, 0 if right else self.wrong + 1
        if right:
            self.was_right = True
            return f"{samples_hz:.0f} samples per second again" if before >= _WRONG_WINDOWS else ""
        word = f"WT931 on {self.config.port}: {self._fault(samples_hz, came)}"
        if came and self.wrong >= _WRONG_WINDOWS and not self.was_right:
            raise Unavailable(word)
        return word if self.wrong == _WRONG_WINDOWS or not came else ""

    def _fault(self, samples_hz: float, came: bool) -> str:
        if not came:
            return "no bytes come any more"
        if samples_hz < 1:
            return f"bytes come, but no packets; is its baud rate {self.config.baud}?"
        return (
            f"{samples_hz:.0f} samples per second, the bench file says {self.config.rate_hz}; "
            "set configure = true, or rate_hz to what the device does"
        )
