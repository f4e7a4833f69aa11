"""The function of `analog`, compiled."""

from __future__ import annotations

from numba import types

from softloop.devices.protocols import analog
from softloop.wire.kernel import kernel, record_type

_F8, _I8 = types.f8, types.i8

analog_step = kernel(
    _I8(record_type(analog.ANALOG_CONFIG), record_type(analog.ANALOG_STATE), _I8, _F8, _F8, _I8, _I8),
)(analog.analog_step)
