"""A bench on several hosts: who runs what where, which host leads, and what cannot be."""

from __future__ import annotations

import hashlib
import json
import re
from typing import TYPE_CHECKING

from softloop.wire.config import is_loopback
from softloop.wire.errors import BadConfig
from softloop.wire.messages import message, message_names

if TYPE_CHECKING:
    from softloop.deploy.bench import Bench

# In the order in which they are started, as in `deploy.bench`, which cannot be imported here.
_TABLES = ("recorder", "monitor", "shadow", "plant", "valves", "pressures", "inclinometer", "controller")
_NAME = re.compile(r"[a-z0-9_-]{1,24}")
LAUNCHER = "launcher"
_OF_A_RUN = ("{run_dir}", "{port}")


def host_of(bench: Bench, process: str) -> str:
    """The host on which a process runs; empty on a bench of one host."""
    table = getattr(bench, process)
    return "" if table is None else str(table.host)


def shares(bench: Bench) -> dict[str, tuple[str, ...]]:
    """Host -> the processes whose tables name it, hosts in the order of names; empty for a bench of one host."""
    return {host: tuple(n for n in _TABLES if host_of(bench, n) == host) for host in sorted(bench.hosts)}


def leader(bench: Bench) -> str:
    """The host that arms, ends the run and keeps the rig clock: that of the controller."""
    return host_of(bench, "controller")


def launcher_name(bench: Bench, host: str) -> str:
    """By which name the launcher of a host is known on the wire; that which leads has the name of the only one."""
    return LAUNCHER if not host or host == leader(bench) else f"{LAUNCHER}-{host}"


def number_of(bench: Bench, host: str) -> int:
    """A host's place among the bench's hosts, as messages name it."""
    return sorted(bench.hosts).index(host)


def share_of(bench: Bench, host: str) -> Bench:
    """The bench with the tables of one host's processes alone."""
    elsewhere = {name: None for name in _TABLES if host_of(bench, name) != host}
    return bench.model_copy(update=elsewhere) if host else bench


def on_host(bench: Bench, host: str) -> Bench:
    """The bench as a process on `host` sees it: direct links at that host's address."""
    address = bench.hosts[host].address if host else ""
    return bench.model_copy(update={"zenoh": bench.zenoh.model_copy(update={"listen": address})}) if address else bench


def choose_host(bench: Bench, asked: str | None) -> str:
    """The host that `softloop run --host` is to be; empty for a bench of one host. Raises BadConfig when it is not one of it."""
    names = ", ".join(f"{host} ({', '.join(processes)})" for host, processes in shares(bench).items())
    if asked is None:
        if bench.hosts:
            raise BadConfig(f"bench '{bench.name}' runs on several hosts: {names}; say with --host which one this is")
        return ""
    if asked not in bench.hosts:
        raise BadConfig(f"bench '{bench.name}' has no host '{asked}'; it has: {names or 'none, it runs on one'}")
    return asked


def check_hosts(bench: Bench) -> None:
    """Every process names a host, every host has one, and no address follows from one host's run alone. Raises BadConfig."""
    there = [name for name in _TABLES if getattr(bench, name) is not None]
    for name in there:
        host = host_of(bench, name)
        if host and host not in bench.hosts:
            raise BadConfig(f"key '{name}.host': there is no [hosts.{host}]; there are: {', '.join(bench.hosts) or 'none'}")
    if not bench.hosts:
        return
    for name in there:
        if not host_of(bench, name):
            raise BadConfig(f"key '{name}.host' is missing: this bench runs on the hosts {', '.join(bench.hosts)}")
    for host, processes in shares(bench).items():
        if not _NAME.fullmatch(host):
            raise BadConfig(f"key 'hosts.{host}': a name is a-z, 0-9, _ and -, at most 24")
        if not processes:
            raise BadConfig(f"key 'hosts.{host}': no process runs there")
    if bench.controller is None:
        raise BadConfig("key 'hosts': a bench on several hosts needs [controller]: its host leads the run")
    _check_addresses(bench)


def _check_addresses(bench: Bench) -> None:
    """Off this machine only with TLS; and what `{port}` and `{run_dir}` become differs from host to host."""
    for host, machine in bench.hosts.items():
        if machine.address and bench.zenoh.tls is None and not is_loopback(machine.address):
            raise BadConfig(
                f"key 'hosts.{host}.address': must be a loopback address, such as 127.0.0.2, or the bench have [zenoh.tls]; "
                "see docs/security.md"
            )
    if any(text in bench.zenoh.endpoint for text in _OF_A_RUN):
        raise BadConfig("key 'zenoh.endpoint': {run_dir} and {port} differ from host to host; name a port")
    if bench.plant is None or bench.inclinometer is None or bench.plant.host == bench.inclinometer.host:
        return
    for key, address in (("plant.serial", bench.plant.serial), ("inclinometer.port", bench.inclinometer.port)):
        if any(text in address for text in _OF_A_RUN):
            raise BadConfig(
                f"key '{key}': {{run_dir}} and {{port}} differ from host to host, and [plant] and [inclinometer] are on two; "
                "name a port"
            )


def digest(bench: Bench, folders: tuple[str, ...] = ()) -> int:
    """A number that is the same where a bench file and the messages are, whatever folders the files stand in. Below 2**63."""
    content = bench.model_dump(mode="json", exclude={"run": {"folder", "report", "duration_s", "certificate"}})
    text = json.dumps(content, sort_keys=True)
    for folder in sorted(folders, key=len, reverse=True):
        text = text.replace(folder, "{bench_dir}")
    text += "".join(message(name).text for name in message_names())
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest()) >> 1
