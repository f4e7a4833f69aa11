"""The functions of `wt931` that the one-process batch needs, compiled."""

from __future__ import annotations

from numba import types

from softloop.devices.protocols import wt931
from softloop.wire.kernel import kernel, record_type

_I8 = types.i8

sample_step = kernel(
    _I8(record_type(wt931.SAMPLER_CONFIG), record_type(wt931.SAMPLER_STATE), _I8, _I8, _I8, _I8, _I8),
)(wt931.sample_step)
