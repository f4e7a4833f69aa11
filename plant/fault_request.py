"""A fault that somebody asks of the running plant: what may be asked, and its bytes. No kernels: who asks needs no compiler."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, get_args

from pydantic import Field, ValidationError, model_validator

from softloop.plant.config import FaultConfig
from softloop.wire.benchfile import Table, load_model
from softloop.wire.errors import BadConfig
from softloop.wire.messages import constant, message, names_of

KINDS: tuple[str, ...] = get_args(FaultConfig.model_fields["kind"].annotation)
UNITS = {
    "chamber_bias": "kPa", "angle_bias": "deg", "rate_bias": "deg/s", "noise": "times", "supply_loss": "part",
    "hose_burst": "mm2", "charge_leak": "mm2",
}  # fmt: skip
SIZE_MAX = 1000.0
DURATION_MAX_S = 1e6
_NUMBERS = {name: number for number, name in names_of("Event", "FAULT_").items()}
_ACTIONS = {"break": constant("FaultRequest", "ACTION_BREAK"), "mend": constant("FaultRequest", "ACTION_MEND")}


class FaultRequest(Table):
    """Break something now, or mend it; `kind` as in `[[plant.faults]]`, empty with `mend` for all that is broken."""

    action: Literal["break", "mend"] = "break"
    kind: str = ""
    size: float = Field(0.0, ge=-SIZE_MAX, le=SIZE_MAX)
    duration_s: float = Field(0.0, ge=0.0, le=DURATION_MAX_S)

    @model_validator(mode="after")
    def _makes_sense(self) -> FaultRequest:
        if self.kind not in KINDS and (self.kind or self.action == "break"):
            raise ValueError(f"kind must be one of {', '.join(KINDS)}, got '{self.kind}'")
        if self.action == "break":
            _check_as_planned(self.kind, self.size)
        elif self.size or self.duration_s:
            raise ValueError("mend has no size and no duration")
        return self


def _check_as_planned(kind: str, size: float) -> None:
    """Hold a fault to what `[[plant.faults]]` asks of it. Raises ValueError with the first thing that is wrong."""
    try:
        FaultConfig.model_validate({"kind": kind, "on_s": 0.0, "size": size})
    except ValidationError as error:
        raise ValueError(error.errors()[0]["msg"].removeprefix("Value error, ")) from None


def is_sized(kind: str) -> bool:
    """Whether a kind of fault has a size."""
    try:
        FaultRequest(kind=kind)
    except ValueError:
        return True
    return False


def read_request(asked: Mapping[str, Any]) -> FaultRequest:
    """A request from what a person gave. Raises BadConfig with one line."""
    return load_model(FaultRequest, dict(asked), "fault")


def pack_request(request: FaultRequest) -> bytes:
    """Its bytes on the wire."""
    kind = message("FaultRequest")
    number = _NUMBERS[request.kind] if request.kind else 0
    made = kind.make(size=request.size, duration_s=request.duration_s, action=_ACTIONS[request.action], fault=number)
    return kind.pack(made)


def unpack_request(payload: bytes) -> FaultRequest:
    """The request in `payload`. Raises BadPayload where it is no such message, BadConfig where it makes no sense."""
    told = message("FaultRequest").unpack(payload)
    actions = {number: name for name, number in _ACTIONS.items()}
    names = {0: "", **{number: name for name, number in _NUMBERS.items()}}
    try:
        content = {"action": actions[told.action], "kind": names[told.fault], "size": told.size, "duration_s": told.duration_s}
    except KeyError as error:
        raise BadConfig(f"fault: no action or fault has the number {error}") from None
    return read_request(content)
