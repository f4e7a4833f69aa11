"""The simulated rig's WT931 on a pseudo-terminal, at the rig's own pace, for commands that speak with it."""

import threading

from softloop.devices.protocols.quantise import deg_to_counts
from softloop.plant.inclinometer_device import InclinometerDevice
from softloop.plant.records import CONTENT_ANGLE, CONTENT_GYRO
from softloop.wire.clock import WallClock
from softloop.wire.serial_urls import open_serial

CLOCK = WallClock()


class Wt931(threading.Thread):
    """`device` as it leaves the shelf; its angle is `angle_deg`, with noise of one count."""

    def __init__(self, path, rate_hz=10, baud=9600):
        super().__init__(daemon=True)
        self.device = InclinometerDevice(rate_hz, baud, 44)
        self.port = open_serial(f"pty://{path}", baud, 0.0)
        self.angle_deg, self.deaf, self.ending, self.sent = 12.0, False, False, 0
        self.start()

    def run(self):
        next_ns = CLOCK.now_ns()
        while not self.ending:
            heard = self.port.read(256)
            answer = b"" if self.deaf else self.device.feed(heard, CLOCK.now_ns())
            self.port.write(answer + self.burst())
            next_ns = max(next_ns + self.device.period_ns, CLOCK.now_ns() - 5 * self.device.period_ns)
            CLOCK.sleep_until_ns(next_ns)
        self.port.close()

    def burst(self):
        self.sent += 1
        return self.device.packets(CONTENT_GYRO | CONTENT_ANGLE, 0, deg_to_counts(self.angle_deg) + self.sent % 2)

    def end(self):
        self.ending = True
        self.join(5.0)
