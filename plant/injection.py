"""Faults asked of the running plant: taken between two turns of its loop, from then on faults like those of the bench file."""

from __future__ import annotations

from typing import Any

from softloop.plant.fault_request import FaultRequest, unpack_request
from softloop.plant.faults import FAULTS, plan_faults
from softloop.wire.channels import FAULT
from softloop.wire.errors import BadConfig, SoftloopError
from softloop.wire.questions import Questions
from softloop.wire.shell import Context

_S = 1_000_000_000
_STAYS_NS = 1_000_000_000 * _S


class Injection:
    """The plant's ear for faults. At lockstep pace it refuses: when a request comes would differ from run to run."""

    def __init__(self, context: Context) -> None:
        self._exact = context.pace.exact
        self._questions = Questions(context.wire, FAULT)

    def take(self, params: Any, state: Any) -> None:
        """Do and answer what was asked since the last turn."""
        for question in self._questions.take_all():
            try:
                if self._exact:
                    raise BadConfig("at lockstep pace faults come by schedule alone: write them as [[plant.faults]]")
                obey(params, state, unpack_request(question.payload))
            except SoftloopError as error:
                question.refuse(str(error))
            else:
                question.accept()


def obey(params: Any, state: Any, request: FaultRequest) -> None:
    """Let a fault come, or leave, at the next nanosecond of the rig. Raises BadConfig when that cannot be."""
    soon_ns = int(state.reached_ns) - int(state.start_ns) + 1
    if request.action == "mend":
        _mend(params, soon_ns, FAULTS[request.kind] if request.kind else 0)
    else:
        place = params.faults[_free_place(params, state, soon_ns)]
        place.kind, place.magnitude = FAULTS[request.kind], request.size
        place.on_ns = soon_ns
        place.off_ns = soon_ns + (round(request.duration_s * _S) or _STAYS_NS)
    plan_faults(params, state)


def _mend(params: Any, soon_ns: int, kind: int) -> None:
    """What is broken now is whole; what the bench file has for later comes all the same."""
    standing = [p for p in params.faults if p.kind and p.on_ns <= soon_ns < p.off_ns and kind in (0, p.kind)]
    if not standing:
        raise BadConfig("nothing of that kind is broken" if kind else "nothing is broken")
    for place in standing:
        place.off_ns = soon_ns


def _free_place(params: Any, state: Any, soon_ns: int) -> int:
    """A place without a fault, or of one that is over. Raises BadConfig when all are taken."""
    for i, place in enumerate(params.faults):
        if place.kind == 0 or (place.off_ns < soon_ns and not state.fault_on[i]):
            return i
    raise BadConfig(f"{len(params.faults)} faults are standing or to come; that is the most")
