"""What the doctor says of the identities of a secured bench: whether each that is needed here can be used, and for how long."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from softloop.deploy.bench import PROCESS_NAMES, Bench
from softloop.deploy.doctor_check import Check
from softloop.deploy.hosts import leader, shares
from softloop.wire.errors import Unavailable
from softloop.wire.identity import check_identity
from softloop.wire.rights import FOLLOWER, LAUNCHER, ROUTER

NAME = "identities"


def needed_here(bench: Bench, host: str = "") -> list[str]:
    """The identities of the processes that a launcher starts on a host, and its own."""
    own = shares(bench)[host] if host else [name for name in PROCESS_NAMES if getattr(bench, name) is not None]
    leads = not host or host == leader(bench)
    return [*own, *((LAUNCHER, ROUTER) if leads else (FOLLOWER,))]


def identities(bench: Bench, host: str = "") -> list[Check]:
    """One check on a bench with `[zenoh.tls]`, none on another."""
    if bench.zenoh.tls is None:
        return []
    return [judge_identities(Path(bench.zenoh.tls.folder), bench.name, needed_here(bench, host))]


def judge_identities(folder: Path, bench: str, names: Iterable[str]) -> Check:
    """Whether certificate and key of each are there, of this bench, and valid."""
    wrong, soon, count = [], [], 0
    for name in names:
        count += 1
        try:
            warning = check_identity(folder, bench, name)
        except Unavailable as error:
            wrong.append(str(error))
        else:
            soon += [warning] if warning else []
    do = "`softloop keys` makes what is missing, `softloop keys --renew` all anew; copy to each host its own"
    measured = {"identities": count, "unusable": len(wrong), "expire_soon": len(soon)}
    if wrong or soon:
        return Check(NAME, "fail" if wrong else "warn", "\n".join([*wrong, *soon]), do, measured)
    return Check(NAME, "pass", f"{count} in {folder}, all usable", "", measured)
