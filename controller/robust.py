"""What keeps a law robust and its estimates inside their set: the smooth robust term and the projection."""

from __future__ import annotations

from math import tanh

from numba import types

from softloop.wire.kernel import kernel

_F8 = types.f8
# max over u of |u| - u tanh(SMOOTH u / epsilon) is epsilon exactly at this constant, since max(|x| - x tanh x) = 0.27846:
# so -h tanh(SMOOTH h S / epsilon) meets conditions (i) and (ii) of Eqs. 38 and 47, and never asks for more than h.
SMOOTH = 0.2785


@kernel(_F8(_F8, _F8, _F8))
def robust_term(bound: float, s: float, epsilon: float) -> float:
    """-h tanh(0.2785 h S / epsilon): the bounded solution of Eqs. 38 and 47, in the unit of `bound`."""
    return -bound * tanh(SMOOTH * bound * s / epsilon)


@kernel(_F8(_F8, _F8, _F8, _F8, _F8, _F8))
def adapted(value: float, rate: float, rate_limit: float, low: float, high: float, period_s: float) -> float:
    """Eqs. 30 and 31 in discrete time: a limited step along Gamma tau, projected into [low, high].

    Clipping keeps P1 exactly, and P2 up to T_s^2 tau^T Gamma tau, which the rate limit keeps small.
    """
    step = period_s * min(max(rate, -rate_limit), rate_limit)
    return min(max(value + step, low), high)


@kernel(_F8(_F8, _F8, _F8, _F8, _F8))
def projected_rate(value: float, rate: float, rate_limit: float, low: float, high: float) -> float:
    """The rate that Eq. 31 lets through: none outward at a bound, and none beyond the limit."""
    if (value >= high and rate > 0.0) or (value <= low and rate < 0.0):
        return 0.0
    return min(max(rate, -rate_limit), rate_limit)
