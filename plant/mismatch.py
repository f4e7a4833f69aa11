"""How one simulated rig differs from the parameter file: drawn by seed from a table that is fixed.

| what | draw |
|---|---|
| chamber and tube volume | +-15 % |
| leak, both parts together | x0.3 to x5, log-uniform |
| k_v1 | +-10 % per valve |
| k_v6 | +-15 % per valve |
| valve hysteresis, whole width of the loop | 5 to 10 % of full current per valve |
| supply pressure | +-5 % |
| pressure sensors | gain +-0.75 % and zero +-0.75 % of full scale, each: +-1.5 % together |
| gyro | bias +-0.5 deg/s, scale +-2 % |
| inclinometer's clock | +-100 ppm |
| ambient temperature | 10 to 40 C |
| a0 ... d, b0 of Table 1 | uniform inside their printed bounds |
| phases of driver, analogue module and inclinometer | uniform in their period |

Each line has its own number, so that a line added later changes no other.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, log

from softloop.dynamics.noise import uniform

# Places of the draws; noise of the sensors uses numbers under 100 (see `electrical`).
VOLUME, LEAK, KV1_IN, KV1_OUT, KV6_IN, KV6_OUT, PLAY_IN, PLAY_OUT, SUPPLY_LEVEL = range(100, 109)
SUPPLY_GAIN, SUPPLY_ZERO, CHAMBER_GAIN, CHAMBER_ZERO, GYRO_BIAS, GYRO_SCALE, CLOCK, AMBIENT = range(110, 118)
ECHO_PHASE, ANALOG_PHASE, INCLINOMETER_PHASE = range(120, 123)
THETA = 130  # and the eight after it


@dataclass(frozen=True)
class Draws:
    """The numbers of one rig; see the table above. Factors are 1 and offsets 0 where nothing differs."""

    volume: float = 1.0
    leak: float = 1.0
    k_v1: tuple[float, float] = (1.0, 1.0)
    k_v6: tuple[float, float] = (1.0, 1.0)
    play_fraction: tuple[float, float] = (0.0, 0.0)
    supply: float = 1.0
    supply_sensor: tuple[float, float] = (0.0, 0.0)  # gain error, and zero error in parts of full scale
    chamber_sensor: tuple[float, float] = (0.0, 0.0)
    gyro_bias_deg_s: float = 0.0
    gyro_scale: float = 1.0
    clock_error: float = 0.0
    ambient_c: float = 20.0
    theta_fraction: tuple[float, ...] = ()  # where between the bounds; empty: nominal
    phases: tuple[float, float, float] = (0.0, 0.2, 0.5)  # driver, analogue module, inclinometer, in periods


def draw(seed: int) -> Draws:
    """The draws of a seed (0 or more)."""

    def between(place: int, low: float, high: float) -> float:
        return low + (high - low) * uniform(seed, place, 0)

    def about(place: int, spread: float) -> float:
        return between(place, 1.0 - spread, 1.0 + spread)

    return Draws(
        volume=about(VOLUME, 0.15),
        leak=exp(between(LEAK, log(0.3), log(5.0))),
        k_v1=(about(KV1_IN, 0.10), about(KV1_OUT, 0.10)),
        k_v6=(about(KV6_IN, 0.15), about(KV6_OUT, 0.15)),
        play_fraction=(between(PLAY_IN, 0.05, 0.10), between(PLAY_OUT, 0.05, 0.10)),
        supply=about(SUPPLY_LEVEL, 0.05),
        supply_sensor=(between(SUPPLY_GAIN, -0.0075, 0.0075), between(SUPPLY_ZERO, -0.0075, 0.0075)),
        chamber_sensor=(between(CHAMBER_GAIN, -0.0075, 0.0075), between(CHAMBER_ZERO, -0.0075, 0.0075)),
        gyro_bias_deg_s=between(GYRO_BIAS, -0.5, 0.5),
        gyro_scale=about(GYRO_SCALE, 0.02),
        clock_error=between(CLOCK, -1e-4, 1e-4),
        ambient_c=between(AMBIENT, 10.0, 40.0),
        theta_fraction=tuple(uniform(seed, THETA + i, 0) for i in range(9)),
        phases=(
            between(ECHO_PHASE, 0.0, 1.0),
            between(ANALOG_PHASE, 0.0, 1.0),
            between(INCLINOMETER_PHASE, 0.0, 1.0),
        ),
    )
