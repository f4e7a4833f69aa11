"""What Zenoh is told: explicit endpoints, no scouting, timeouts, and that nothing waits for a slow reader."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import zenoh

from softloop.wire.config import QUIC
from softloop.wire.identity import Identity

UNIX = "unixsock-stream/"
CLIENT_PATIENCE_MS = 10_000
# How long a link may take to come about. A packet of its opening that a network loses is sent again after 1 s, and after 2 s
# more; and a direct link to a peer is tried once.
OPENING_MS, OPENING_FAR_MS = 1000, 5000


def make_config(
    mode: str,
    listen: list[str],
    connect: list[str],
    lease_ms: int,
    *,
    listen_must_work: bool = True,
    identity: Identity | None = None,
) -> zenoh.Config:
    """The one way to a Zenoh configuration: nothing is left to Zenoh's defaults that reaches beyond this machine."""
    config = zenoh.Config()
    for name, value in settings_of(mode, listen, connect, lease_ms, listen_must_work=listen_must_work, identity=identity).items():
        config.insert_json5(name, json.dumps(value))
    return config


def settings_of(
    mode: str,
    listen: list[str],
    connect: list[str],
    lease_ms: int,
    *,
    listen_must_work: bool = True,
    identity: Identity | None = None,
) -> dict[str, Any]:
    """The settings in `make_config`, by the path of each."""
    opening_ms = OPENING_MS if identity is None else OPENING_FAR_MS
    told = {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        # Of two peers that hear of each other one connects: else both do, and there are two links between them.
        "scouting/gossip/autoconnect_strategy": {"peer": {"to_router": "always", "to_peer": "greater-zid"}},
        "listen/endpoints": [_locator(one) for one in listen],
        "listen/exit_on_failure": listen_must_work,
        "listen/timeout_ms": 0,
        "connect/endpoints": [_locator(one) for one in connect],
        "connect/exit_on_failure": False,
        "connect/timeout_ms": _patience_ms(mode, listen_must_work=listen_must_work),
        # 20 to 100 ms: a router that came back is found again well within the 2 s a rig may be without one.
        "connect/retry": {"period_init_ms": 20, "period_max_ms": 100, "period_increase_factor": 1.5},
        "open/return_conditions/connect_scouted": False,
        "transport/link/tx/lease": lease_ms,
        # A frozen process still has its socket: without these, who meets it waits 10 s, also in closing its own session.
        "transport/unicast/open_timeout": opening_ms,
        "transport/unicast/accept_timeout": opening_ms,
        # A stalled reader must cost the 5 ms path nothing: what cannot be sent now is dropped.
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
        "transport/shared_memory/enabled": False,
        "timestamping/enabled": False,
        "adminspace/enabled": False,
    }
    return (identity.settings if identity else {}) | told


def _locator(endpoint: str) -> str:
    """As Zenoh is told of it: over QUIC a message may go as a datagram too, which nothing waits for when it is lost."""
    return f"{endpoint}?mixed_rel=1" if endpoint.startswith(QUIC) else endpoint


def _patience_ms(mode: str, *, listen_must_work: bool) -> int:
    """What Zenoh's connect timeout is to be.

    A client needs its router to open. A peer keeps trying in the background, for ever (-1): also before its router is there and
    after it went away. A guest, who may be the meeting point itself, tries once while it opens (0), so that it can send at once.
    """
    if mode == "client":
        return CLIENT_PATIENCE_MS
    return -1 if listen_must_work else 0


def own_endpoint(meeting_point: str, process: str, address: str = "") -> str:
    """Where a peer listens for direct links: beside the meeting point, or at `address`, on a socket or port of its own."""
    if meeting_point.startswith(UNIX):
        folder = Path(meeting_point[len(UNIX) :]).parent
        return f"{UNIX}{folder}/{Path(meeting_point).stem}.{process}.{os.getpid()}.sock"
    if address:
        shown = f"[{address}]" if ":" in address and not address.startswith("[") else address
        return f"{meeting_point.split('/', 1)[0]}/{shown}:0"
    return meeting_point.rsplit(":", 1)[0] + ":0"
