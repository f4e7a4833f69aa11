"""The process `shadow`: hears valve currents and sensors, brings a simulated plant along, and says how far the two are apart.

It listens, as the recorder does: nothing waits for it, and nothing it says is read by the control path.
"""

from __future__ import annotations

from softloop.plant.shadow import Shadow
from softloop.plant.shadow_config import ShadowProcess
from softloop.wire.channels import INCLINATION, PRESSURE, SHADOW, VALVES
from softloop.wire.messages import BadPayload, constant, message
from softloop.wire.shell import Context
from softloop.wire.status import StatusReporter

SOURCE = constant("Event", "SOURCE_SHADOW")
TURN_NS = 5_000_000  # one tick: at lockstep pace nothing happens between two
# Channel -> the process that speaks on it.
_HEARD = {VALVES: "valves", PRESSURE: "pressures", INCLINATION: "inclinometer"}
_KINDS = {channel.name: message(channel.message) for channel in _HEARD}


class ShadowLoop:
    """The process's inputs and output around the pure `Shadow`."""

    def __init__(self, process: ShadowProcess, context: Context) -> None:
        self._clock = context.clock
        self._shadow = Shadow(process)
        self._behind_ns = round(1e6 * process.table.behind_ms)
        self._inbox, self._lost = context.wire.inbox(*_HEARD), 0
        for speaker in _HEARD.values():
            context.pace.hear_out(speaker)
        self._put = context.wire.publisher(SHADOW)
        self._status = StatusReporter(context, SOURCE)

    def turn(self) -> None:
        """Take what came, simulate up to what must have arrived, and say what there is to say."""
        for full_key, payload in self._inbox.take_all():
            channel = full_key.rsplit("/", 1)[1]
            try:
                self._shadow.put(channel, _KINDS[channel].unpack(payload))
            except BadPayload:
                self._status.dropped += 1
        for divergence in self._shadow.advance_to(self._clock.now_ns() - self._behind_ns):
            self._put(message(SHADOW.message).pack(divergence))
        self._status.dropped += self._inbox.dropped - self._lost
        self._lost = self._inbox.dropped
        self._status.cycle()

    def close(self) -> None:
        """The last word."""
        self._status.close()


def run(process: ShadowProcess, context: Context) -> None:
    """Follow the rig until asked to stop. Raises BadFile or BadConfig before its loop."""
    loop = ShadowLoop(process, context)
    context.enter_loop()
    while not context.stop:
        loop.turn()
        context.clock.sleep_until_ns(context.clock.now_ns() + TURN_NS)
    loop.turn()
    loop.close()
