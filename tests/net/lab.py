"""Computers on a network, made of namespaces: each host has a network and a monotonic clock of its own.

    desk   10.77.1.2 --veth-- +---------+
    board  10.77.2.2 --veth-- | network | --TUN-- relay
    logger 10.77.3.2 --veth-- +---------+

The network is a namespace too. It routes what comes from a host into the TUN device, and what the relay puts back to the host
that it is for; where the kernel has netem, that can stand in for the relay, on the network's end of each link. No namespace has a
name, and nothing is made in that of the computer itself: all of it is held by processes that end with this one, however it ends,
and goes with them.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

from pyroute2 import IPRoute, NetlinkError, netns

from tests.net.cable import Way

TUN = "cable0"
# What docs/hosts.md advises on networks that lose packets. The kernel's own 200 ms are longer than any budget here: TCP would not
# try again in time; nor would it, doubling its patience, where the second packet is lost too.
RTO_MIN_MS = 10
TCP_SETTINGS = ("net.ipv4.tcp_thin_linear_timeouts=1",)
INTO_TUN = 100  # the routing table of what comes from a host
TOOLS = ("nsenter", "setpriv", "unshare")  # util-linux
NO_SUCH_KIND = 2  # ENOENT: the kernel does not know the queueing discipline


def missing() -> str:
    """What this machine lacks, in one line; empty where all is there."""
    if os.geteuid() != 0:
        return "needs root, to make network namespaces and TUN devices; try `sudo make test-net`"
    for tool in TOOLS:
        if shutil.which(tool) is None:
            return f"needs {tool}, of util-linux"
    if not Path("/dev/net/tun").exists():
        return "needs /dev/net/tun; try `modprobe tun`"
    made = subprocess.run(["unshare", "--net", "--time", "--fork", "true"], capture_output=True, text=True, check=False)
    return "" if made.returncode == 0 else f"may not make namespaces here: {made.stderr.strip()}"


class Namespace:
    """A network namespace, and a time namespace whose monotonic clock is `ahead_s` ahead of the machine's."""

    def __init__(self, ahead_s: int = 0) -> None:
        self.ahead_s = ahead_s
        clock = ["--time", f"--monotonic={ahead_s}"]
        # It ends when its input does, so when this process ends. The clock is that of what is forked after it was made.
        stay = ["unshare", "--net", *clock, "--fork", "--kill-child", "sh", "-c", "echo $$; exec cat"]
        self._holder = subprocess.Popen(stay, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True)
        self.pid = int(_line(self._holder.stdout))
        self.route = _route_in(f"/proc/{self.pid}/ns/net")
        self.route.link("set", index=self.index("lo"), state="up")

    def index(self, device: str) -> int:
        return int(self.route.link_lookup(ifname=device)[0])

    def inside(self, command: list[str]) -> list[str]:
        """The command that runs `command` in here, and that is killed when this process ends."""
        ns = f"/proc/{self.pid}/ns"
        return ["setpriv", "--pdeathsig", "KILL", "nsenter", f"--net={ns}/net", f"--time={ns}/time", "--", *command]

    def address(self, device: str, address: str) -> None:
        self.route.addr("add", index=self.index(device), address=address, prefixlen=30)
        self.route.link("set", index=self.index(device), state="up")

    def close(self) -> None:
        with contextlib.suppress(Exception):
            self.route.close()
        self._holder.communicate()


def _route_in(namespace: str) -> IPRoute:
    """Netlink in another network namespace. Its socket stays there; this thread is back at once.

    `pyroute2.NetNS` forks to the same end, and hangs at times where others' threads run, as Zenoh's do.
    """
    with open("/proc/thread-self/ns/net") as here:
        netns.setns(namespace, flags=0, fork=False)
        try:
            route = IPRoute()
            route.link_lookup(ifname="lo")
            return route
        finally:
            netns.setns(here, flags=0, fork=False)


def _set(namespace: Namespace, *settings: str) -> None:
    """Settings of the kernel, such as `net.ipv4.ip_forward=1`, in a namespace alone."""
    for setting in settings:
        key, value = setting.split("=")
        file = f"/proc/sys/{key.replace('.', '/')}"
        subprocess.run(namespace.inside(["sh", "-c", f"echo {value} > {file}"]), check=True)


def _line(stream: IO[str] | None) -> str:
    assert stream is not None
    return stream.readline()


class Network:
    """Hosts by their names, each with a link to the network between them."""

    def __init__(self, ahead_s: Mapping[str, int]) -> None:
        self.hosts: dict[str, Namespace] = {}
        self._relay: subprocess.Popen[str] | None = None
        self._files: Path | None = None
        self.middle = Namespace()
        try:
            filters = (f"net.ipv4.conf.{of}.rp_filter=0" for of in ("all", "default"))
            _set(self.middle, "net.ipv4.ip_forward=1", *filters)
            for name, ahead in ahead_s.items():
                self.hosts[name] = Namespace(ahead)
                self._link(name)
        except BaseException:
            self.close()
            raise

    def number(self, host: str) -> int:
        return list(self.hosts).index(host) + 1

    def address_of(self, host: str) -> str:
        return f"10.77.{self.number(host)}.2"

    def _link(self, name: str) -> None:
        host, number = self.hosts[name], self.number(name)
        _set(host, *TCP_SETTINGS)
        peer = {"ifname": "eth0", "net_ns_pid": host.pid}
        self.middle.route.link("add", ifname=f"to-{name}", kind="veth", peer=peer)
        self.middle.address(f"to-{name}", f"10.77.{number}.1")
        host.address("eth0", f"10.77.{number}.2")
        host.route.route("add", dst="0.0.0.0/0", gateway=f"10.77.{number}.1", metrics={"rto_min": RTO_MIN_MS})

    def cable(self, host: str, *, plugged: bool) -> None:
        """Pull a host's cable, or plug it in again: its link has no carrier while it is out."""
        end = self.middle
        end.route.link("set", index=end.index(f"to-{host}"), state="up" if plugged else "down")

    @contextlib.contextmanager
    def relayed(self, way: Way, seed: int, json_file: Path) -> Iterator[None]:
        """While the block runs, every packet between hosts goes through the relay; its counts are in the file afterwards."""
        options = ["--delay-ms", str(way.delay_ms), "--jitter-ms", str(way.jitter_ms), "--loss", str(way.loss)]
        command = [sys.executable, "-m", "tests.net.relay", "--tun", TUN, *options, "--seed", str(seed), "--json", str(json_file)]
        relay = subprocess.Popen(self.middle.inside(command), stdout=subprocess.PIPE, text=True, start_new_session=True)
        try:
            if not _line(relay.stdout):
                raise RuntimeError("the relay did not start")
            self._into_tun()
            yield
        finally:
            relay.send_signal(signal.SIGTERM)
            try:
                relay.wait(10)
            except subprocess.TimeoutExpired:
                relay.kill()
                relay.wait()
            relay.communicate()

    def _into_tun(self) -> None:
        """Route what comes from a host into the device; what comes out of it goes by the main table to the other host."""
        route = self.middle.route
        route.link("set", index=self.middle.index(TUN), state="up")
        route.route("add", dst="0.0.0.0/0", family=socket.AF_INET, oif=self.middle.index(TUN), table=INTO_TUN)
        known = {dict(rule["attrs"]).get("FRA_IIFNAME") for rule in route.get_rules(family=socket.AF_INET)}
        for name in self.hosts:
            if f"to-{name}" not in known:
                route.rule("add", family=socket.AF_INET, iifname=f"to-{name}", table=INTO_TUN, priority=INTO_TUN)

    @contextlib.contextmanager
    def netem(self, way: Way) -> Iterator[None]:
        """The same by the kernel's own discipline, on the network's end of every link. Raises NetlinkError without it."""
        route, ends = self.middle.route, [self.middle.index(f"to-{name}") for name in self.hosts]
        made: list[int] = []
        try:
            for end in ends:
                jitter = {"jitter": round(way.jitter_ms * 1e3)} if way.jitter_ms else {}
                route.tc("add", "netem", index=end, handle="1:", delay=round(way.delay_ms * 1e3), loss=100.0 * way.loss, **jitter)
                made.append(end)
            yield
        finally:
            for end in made:
                route.tc("del", "netem", index=end, handle="1:")

    def has_netem(self) -> bool:
        try:
            with self.netem(Way(1.0)):
                return True
        except NetlinkError as error:
            if error.code == NO_SUCH_KIND:
                return False
            raise

    def close(self) -> None:
        for namespace in (*self.hosts.values(), self.middle):
            namespace.close()


def links_of_this_computer() -> list[str]:
    """Names of the network devices here, to see that none is left."""
    with IPRoute() as route:
        return sorted(str(link.get_attr("IFLA_IFNAME")) for link in route.get_links())


def counts(json_file: Path) -> dict[str, Any]:
    """What the relay left."""
    found: dict[str, Any] = json.loads(json_file.read_text())
    return found
