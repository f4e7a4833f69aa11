"""Which terms a model has, and where each of its parameters stands in one flat vector.

The model is Eq. 2 with the Taylor series of Eqs. 3 to 5, b(y) once per pressure, and as options

- hysteresis: Bouc-Wen elements with n = 1 and beta = gamma (Dahl's model), each a force `h` that is reached over about `w` deg
  of travel and turns with the direction;
- creep: Prony terms, a spring `k` whose other end follows the angle at `rate`;
- a delay of the angle behind the pressure, which may be negative, and a first-order lag of the angle's sensor.

The last two places are the state in which the series begins: angle and rate. Memory begins relaxed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Structure:
    """Orders and options of a model.

    Attributes:
        m, n, r: orders of a(y), b(y) and c(y), Eqs. 3 to 5.
        inputs: how many pressures act.
        hysteresis, creep: how many elements of each.
        delay, lag: whether these are estimated.
        at_rest: every experiment begins at rest, so that d follows from its own first angle and pressure: the angle's zero may
            differ from run to run.
    """

    m: int = 2
    n: int = 0
    r: int = 3
    inputs: int = 1
    hysteresis: int = 0
    creep: int = 0
    delay: bool = False
    lag: bool = False
    at_rest: bool = False

    @property
    def layout(self) -> NDArray[np.int64]:
        """Counts of each kind of parameter, as the simulator reads them."""
        counts = [self.m + 1, self.inputs, self.n + 1, self.r + 1, self.hysteresis, self.creep, int(self.delay), int(self.lag)]
        counts.append(int(self.at_rest))
        return np.array(counts, np.int64)

    @property
    def names(self) -> tuple[str, ...]:
        """All parameters but the first state, in order."""
        mark = [""] if self.inputs == 1 else [f"_p{i + 1}" for i in range(self.inputs)]
        names = [f"a{i}" for i in range(self.m + 1)]
        names += [f"b{j}{p}" for p in mark for j in range(self.n + 1)]
        names += [f"c{k}" for k in range(self.r + 1)] + ["d"]
        names += [f"h{i + 1}" for i in range(self.hysteresis)] + [f"w{i + 1}" for i in range(self.hysteresis)]
        names += [f"k{i + 1}" for i in range(self.creep)] + [f"rate{i + 1}" for i in range(self.creep)]
        return (*names, *(["delay_s"] if self.delay else []), *(["lag_s"] if self.lag else []))

    @property
    def size(self) -> int:
        """Length of the flat vector, the first state with it."""
        return len(self.names) + 2

    def place(self, name: str) -> int:
        """Where a parameter stands."""
        return self.names.index(name)

    def terms(self, kind: str) -> slice:
        """The places of `a`, `b`, `c`, `h`, `w`, `k` or `rate`."""
        found = [i for i, name in enumerate(self.names) if name.split("_")[0].rstrip("0123456789") == kind]
        return slice(found[0], found[-1] + 1) if found else slice(0, 0)

    def scales(self, angle_deg: float, pressure_kpa: float) -> Floats:
        """Sizes of the parameters at which each of them matters about as much, (size,): for steps and for the solver."""
        y, acceleration = max(angle_deg, 1e-9), 60.0 * max(angle_deg, 1e-9)
        powers = np.arange(10.0)
        parts = [60.0 / y ** powers[: self.m + 1]]
        parts += [acceleration / max(pressure_kpa, 1e-9) / y ** powers[: self.n + 1]] * self.inputs
        parts += [10.0 / y ** powers[: self.r + 1], np.array([acceleration])]
        parts += [np.full(self.hysteresis, 0.1 * acceleration), np.full(self.hysteresis, 0.1 * y)]
        parts += [np.full(self.creep, 6.0), np.full(self.creep, 0.1)]
        parts += [np.full(int(self.delay) + int(self.lag), 0.01), np.array([0.1 * y, y])]
        return np.concatenate(parts)


PAPER = Structure()
LINEAR = Structure(m=0, n=0, r=0)  # Eq. 1, with the constant d that a rest angle needs


def bare_of(structure: Structure) -> Structure:
    """The structure without any option."""
    return Structure(structure.m, structure.n, structure.r, structure.inputs)


def d_at_rest(structure: Structure, values: Floats, pressure_kpa: Floats) -> float:
    """The d at which the first state of `values` is one of rest under the pressures (inputs,), deg/s2."""
    y, poly = float(values[-2]), np.polynomial.polynomial.polyval
    gains = values[structure.terms("b")].reshape(structure.inputs, structure.n + 1)
    return float(
        poly(y, values[structure.terms("a")]) * y - sum(poly(y, g) * p for g, p in zip(gains, pressure_kpa, strict=True))
    )


def carry_over(values: Floats, old: Structure, new: Structure) -> Floats:
    """`values` of `old` in the places of `new`; what `old` does not have is 0."""
    out = np.zeros(new.size)
    for name in set(old.names) & set(new.names):
        out[new.place(name)] = values[old.place(name)]
    out[-2:] = values[-2:]
    return out
