"""`[run]`: what the launcher does around a run; `[calibration]`: what valves are measured with; `[hosts.NAME]`: the computers."""

from __future__ import annotations

from pydantic import Field, field_validator

from softloop.wire.benchfile import Table
from softloop.wire.config import ip


class RunConfig(Table):
    """`[run]`: arming, time limits and what is left at the end."""

    arm: bool = Field(True, description="arm the gate once every process is alive; false: wait for `softloop request`")
    shared_router: bool = Field(False, description="join the meeting point of a `softloop router` instead of being it")
    folder: str = Field("runs", description="where run directories are made")
    duration_s: float = Field(0.0, ge=0, description="end after this time, armed; 0: when the controller is done")
    router_wait_s: float = Field(60.0, gt=0, description="a shared meeting point that is gone for longer ends the run")
    hosts_wait_s: float = Field(600.0, gt=0, description="several hosts: all must be there by then")
    host_silence_s: float = Field(5.0, ge=1, description="several hosts: one whose launcher is silent for longer is lost")
    ready_timeout_s: float = Field(30.0, gt=0, description="every process must be alive by then")
    settle_s: float = Field(0.5, ge=0, description="from all alive to arming: what starting up disturbed has passed by then")
    arm_timeout_s: float = Field(10.0, gt=0, description="the gate must be armed by then, after all are alive")
    vent_timeout_s: float = Field(3.0, ge=0, description="at the end, wait no longer than this for the chamber to vent")
    vented_kpa: float = Field(2.0, gt=0, description="gauge pressure under which the chamber counts as vented")
    stop_timeout_s: float = Field(5.0, gt=0, description="a process that has not ended by then is killed")
    rig: str = Field("", max_length=80, description="which rig this is, for parameter files; default: the bench's name")
    foreign_parameters: bool = Field(False, description="run on a parameter file that was identified on another rig")
    certificate: str = Field("", description="what `softloop doctor --certificate` wrote for this bench: it goes into the log")
    report: bool = Field(True, description="write report.html and its pictures at the end")


class CalibrationConfig(Table):
    """`[calibration]`: a tank of known volume on the rig's port, for flow tests of the valves."""

    tank_ml: float = Field(gt=0, description="the tank with its tubing; it stands in the actuator's place")
    tank_error_percent: float = Field(1.0, ge=0, lt=50, description="how well that is known, one standard error")
    temperature_c: float = Field(20.0, ge=-20, le=60, description="of the room, and so of the tank's gas")


class MachineConfig(Table):
    """`[hosts.NAME]`: one of the computers of a bench that runs on several; a process names its own by the key `host`."""

    address: str = Field("", description="mode peer: its address, for direct links; empty: that of the meeting point")

    @field_validator("address")
    @classmethod
    def _is_an_address(cls, value: str) -> str:
        return ip(value)
