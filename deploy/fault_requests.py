"""Asking the simulated rig to break: from the page, and by `softloop request`."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Mapping
from typing import Any

from softloop.deploy.bench import Bench
from softloop.plant.fault_request import KINDS, UNITS, is_sized, pack_request, read_request
from softloop.watch.guest import guest_wire
from softloop.watch.page.app import Site
from softloop.wire.channels import FAULT
from softloop.wire.errors import EXIT_NEGATIVE, EXIT_OK, BadConfig, SoftloopError, Unavailable
from softloop.wire.questions import ask
from softloop.wire.session import Wire

ANSWER_S = 2.0


def ask_plant(wire: Wire, asked: Mapping[str, Any], timeout_s: float) -> None:
    """Let a fault come or leave: `action` (break, mend), `kind`, `size`, `duration_s`.

    Raises:
        BadConfig: it makes no sense, or the plant refuses.
        Unavailable: no simulated plant answers.
    """
    payload = pack_request(read_request(asked))
    try:
        ask(wire, FAULT, payload, timeout_s)
    except Unavailable as error:
        if "no right" in str(error):
            raise
        raise Unavailable(f"no simulated plant of bench '{wire.bench}' answers; a real rig has no faults to ask for") from None


def request_fault(bench: Bench, asked: Mapping[str, Any], timeout_s: float) -> int:
    """`softloop request BENCH fault|mend`: ask, and print the answer; returns the exit code. Raises as `ask_plant` does."""
    read_request(asked)
    with guest_wire(bench.zenoh, bench.name, f"fault-{os.getpid()}") as wire:
        wire.settle(lambda: False)
        try:
            ask_plant(wire, asked, timeout_s)
        except BadConfig as error:
            print(f"refused: {error}", flush=True)
            return EXIT_NEGATIVE
    what = asked["kind"] or "everything"
    print(f"plant: {what} {'breaks' if asked['action'] == 'break' else 'is mended'}", flush=True)
    return EXIT_OK


def offer_faults(site: Site) -> None:
    """Put the action `fault` on a page, and tell its viewers which faults there are, with the units of their sizes."""

    async def fault(asked: dict[str, Any]) -> dict[str, Any]:
        if site.requester is None:
            return {"error": "no bench was reached yet"}
        try:
            await asyncio.to_thread(ask_plant, site.requester.wire, asked, ANSWER_S)
        except SoftloopError as error:
            return {"error": str(error)}
        return {}

    site.actions = {**site.actions, "fault": fault}
    site.hello["actions"] = sorted(site.actions)
    site.hello["faults"] = [{"kind": kind, "unit": UNITS[kind] if is_sized(kind) else ""} for kind in KINDS]
