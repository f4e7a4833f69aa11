"""Random numbers without a state: each draw is a function of (seed, device, sample) alone.

So noise does not depend on who asked first, and processes, replay and batch see the same. splitmix64 (Steele, Lea and Flood,
2014) mixes the key; Box and Muller (1958) make it Gaussian. The 64-bit products and sums are taken in halves that cannot
overflow, so that the plain Python functions give the compiled ones' bits without a warning.
"""

from __future__ import annotations

from math import cos, log, pi, sqrt

import numpy as np
from numba import types

from softloop.wire.kernel import kernel

_U8 = types.u8
_I8 = types.i8
_F8 = types.f8

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_LOW = np.uint64(0xFFFFFFFF)
_S11, _S27, _S30, _S31, _S32 = np.uint64(11), np.uint64(27), np.uint64(30), np.uint64(31), np.uint64(32)
_ONE = np.uint64(1)
_TO_UNIT = 2.0**-53


@kernel(_U8(_U8, _U8))
def _times(a: np.uint64, b: np.uint64) -> np.uint64:
    """The product modulo 2^64."""
    low = (a & _LOW) * (b & _LOW)
    cross = (((a & _LOW) * (b >> _S32)) & _LOW) + (((a >> _S32) * (b & _LOW)) & _LOW)
    return (((low >> _S32) + cross & _LOW) << _S32) | (low & _LOW)


@kernel(_U8(_U8, _U8))
def _plus(a: np.uint64, b: np.uint64) -> np.uint64:
    """The sum modulo 2^64."""
    low = (a & _LOW) + (b & _LOW)
    return (((a >> _S32) + (b >> _S32) + (low >> _S32) & _LOW) << _S32) | (low & _LOW)


@kernel(_U8(_U8))
def splitmix64(state: np.uint64) -> np.uint64:
    """The output of splitmix64 whose state was `state` before the step."""
    z = _plus(state, _GOLDEN)
    z = _times(z ^ (z >> _S30), _MIX_1)
    z = _times(z ^ (z >> _S27), _MIX_2)
    return z ^ (z >> _S31)


@kernel(_U8(_I8, _I8, _I8))
def _key(seed: int, device: int, sample: int) -> np.uint64:
    mixed = splitmix64(np.uint64(seed))
    mixed = splitmix64(mixed ^ np.uint64(device))
    return splitmix64(mixed ^ np.uint64(sample))


@kernel(_F8(_I8, _I8, _I8))
def uniform(seed: int, device: int, sample: int) -> float:
    """A number in (0, 1], uniform. All three must not be negative."""
    return ((_key(seed, device, sample) >> _S11) + _ONE) * _TO_UNIT


@kernel(_F8(_I8, _I8, _I8))
def gaussian(seed: int, device: int, sample: int) -> float:
    """A number of zero mean and unit variance. All three must not be negative."""
    key = _key(seed, device, sample)
    first = ((key >> _S11) + _ONE) * _TO_UNIT
    second = (splitmix64(key) >> _S11) * _TO_UNIT
    return sqrt(-2.0 * log(first)) * cos(2.0 * pi * second)
