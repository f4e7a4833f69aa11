"""The functions of `quantise`, compiled."""

from __future__ import annotations

from numba import types

from softloop.devices.protocols import quantise
from softloop.wire.kernel import kernel

_F8, _I8 = types.f8, types.i8

current_to_counts = kernel(_I8(_F8))(quantise.current_to_counts)
counts_to_current = kernel(_F8(_I8))(quantise.counts_to_current)
counts_to_kpa = kernel(_F8(_I8, _F8, _F8, _F8))(quantise.counts_to_kpa)
kpa_to_counts = kernel(_I8(_F8, _F8, _F8, _F8))(quantise.kpa_to_counts)
counts_to_deg = kernel(_F8(_I8))(quantise.counts_to_deg)
counts_to_deg_s = kernel(_F8(_I8))(quantise.counts_to_deg_s)
mounted_deg = kernel(_F8(_F8, _I8, _F8))(quantise.mounted_deg)
deg_to_counts = kernel(_I8(_F8))(quantise.deg_to_counts)
value_to_int16 = kernel(_I8(_F8, _F8))(quantise.value_to_int16)
