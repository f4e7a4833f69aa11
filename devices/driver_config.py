"""`[valves.canopen_analog]` and `[valves.canopen_current]`: a CANopen node as valve driver, as its manual describes it."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from softloop.devices.protocols.canopen_output import NodePlan, Scale
from softloop.wire.benchfile import Table


class CanopenAnalogConfig(Table):
    """An analogue-output module of CiA 401 with a current stage behind each output.

    A current of 0 mA is `off_counts`; from `low_ma` to `full_ma` counts go in a straight line; between 0 and `low_ma` the
    output is off, since more current than was asked for is never given.
    """

    node_id: int = Field(1, ge=1, le=127, description="the node's number, as set at the node")
    gate_node_id: int = Field(126, ge=1, le=127, description="under which the gate sends its heartbeat; free on this bus")
    charge_output: int = Field(1, ge=1, le=254, description="sub-index of the charge valve's output")
    exhaust_output: int = Field(2, ge=1, le=254, description="sub-index of the exhaust valve's output")
    rpdo: int = Field(2, ge=1, le=4, description="which receive PDO carries the set points; CiA 401: 2 for analogue outputs")
    deadline_ms: int = Field(20, ge=10, le=1000, description="without a receive PDO for so long the outputs take error values")
    gate_heartbeat_ms: int = Field(100, ge=50, le=5000, description="likewise without the gate's heartbeat (object 1016h)")
    heartbeat_ms: int = Field(10, ge=5, le=1000, description="how often the node says that it lives (object 1017h)")
    error_state: Literal["stopped", "pre-operational"] = Field(
        "stopped", description="where the node goes when a deadline has passed (object 1029h)"
    )
    error_value_shift: Literal[0, 16] = Field(16, description="16: its error values are left-justified in 32 bits; 0: not")
    setpoint_index: int = Field(0x6411, ge=0x2000, le=0x9FFF, description="object of the set points, int16")
    error_mode_index: int = Field(0x6443, ge=0x2000, le=0x9FFF, description="object of the error modes, uint8")
    error_value_index: int = Field(0x6444, ge=0x2000, le=0x9FFF, description="object of the error values, int32")
    measured_index: int = Field(
        0, ge=0, le=0x9FFF, description="object of the measured currents, int16, on the set points' scale; 0: it has none"
    )
    off_counts: int = Field(0, ge=-32768, le=32767, description="set point of an output without current")
    low_counts: int = Field(0, ge=-32768, le=32767, description="set point of low_ma")
    low_ma: float = Field(0.0, ge=0, description="least current that the stage gives")
    full_counts: int = Field(32767, ge=-32767, le=32767, description="set point of full_ma; above low_counts")
    full_ma: float = Field(220.0, gt=0, le=655, description="current of the stage there; above low_ma")

    @model_validator(mode="after")
    def _agrees_with_itself(self) -> CanopenAnalogConfig:
        if self.charge_output == self.exhaust_output:
            raise ValueError(f"exhaust_output must differ from charge_output ({self.charge_output})")
        if self.node_id == self.gate_node_id:
            raise ValueError(f"gate_node_id must differ from node_id ({self.node_id})")
        if self.full_counts <= self.low_counts:
            raise ValueError(f"full_counts must be above low_counts ({self.low_counts})")
        if self.full_ma <= self.low_ma:
            raise ValueError(f"full_ma must be above low_ma ({self.low_ma:g})")
        if self.low_counts < self.off_counts <= self.full_counts:
            raise ValueError(f"off_counts must be low_counts ({self.low_counts}) or outside low_counts to full_counts")
        return self

    def plan(self, vent_ma: float) -> NodePlan:
        """The node as the protocol's functions take it; `vent_ma` is the exhaust current of its own vent."""
        scale = Scale(self.off_counts, self.low_counts, self.low_ma, self.full_counts, self.full_ma)
        same = {name: getattr(self, name) for name in NodePlan.__dataclass_fields__ if name in type(self).model_fields}
        return NodePlan(outputs=(self.charge_output, self.exhaust_output), scale=scale, vent_ma=vent_ma, **same)


class CanopenCurrentConfig(CanopenAnalogConfig):
    """A driver that controls the coil currents itself, and measures them. By default a count is 1 mA."""

    measured_index: int = Field(
        0x6401, ge=0, le=0x9FFF, description="object of the measured currents, int16, on the set points' scale; 0: it has none"
    )
    full_counts: int = Field(650, ge=-32767, le=32767, description="set point of full_ma; above low_counts")
    full_ma: float = Field(650.0, gt=0, le=655, description="current of the driver there; above low_ma")
