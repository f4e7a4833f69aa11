"""`softloop install`: systemd units of benches, as text. One run, one router and the viewers, each a template by bench.

Restart policy as docs/safety.md has it: what holds the control path is never started again by itself, and never at boot; what
only listens is. The units give what the 5 ms path asks for (real-time priority, locked memory, cores) and take the rest away.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

Lines = tuple[str, ...]

# From the first SIGTERM to the last process: venting, four groups of processes, with the defaults of `[run]`, and the report.
STOP_S = 120
RTPRIO = 60  # [host] realtime_priority is 50; a bench above it is not granted


@dataclass(frozen=True)
class Setting:
    """What a person may choose.

    Attributes:
        program: the command `softloop`. user: who runs it, and its group. benches: the folder of bench files.
        cpus: cores of the rig, as systemd's CPUAffinity; empty: all. network: whether off loopback is allowed.
        host: of benches on several hosts, which this is.
    """

    program: Path
    user: str = "softloop"
    benches: Path = Path("/etc/softloop")
    cpus: str = ""
    network: bool = False
    host: str = ""


@dataclass(frozen=True)
class Unit:
    """One unit: its template's name, and its sections."""

    name: str
    sections: dict[str, Lines] = field(default_factory=dict)

    @property
    def file(self) -> str:
        return f"{self.name}@.service"

    def text(self) -> str:
        """The file's content."""
        parts = (f"[{section}]\n" + "".join(f"{line}\n" for line in lines) for section, lines in self.sections.items())
        return "# Written by `softloop install`; changes belong in a drop-in (systemctl edit).\n" + "\n".join(parts)


def units(setting: Setting) -> tuple[Unit, ...]:
    """All units."""
    return (
        _run(setting),
        _service(setting, "softloop-router", "meeting point of softloop bench %i", "router", _always("0.5", never="2")),
        _service(setting, "softloop-page", "live page of softloop bench %i", "page", _always("1", never="2 3")),
        _service(setting, "softloop-foxglove", "Foxglove bridge of softloop bench %i", "foxglove", _always("5", never="2")),
    )


def _run(setting: Setting) -> Unit:
    """The launcher and with it the control path: it ends when it ends. No [Install]: a machine that boots moves nothing."""
    service = (
        "Type=exec",
        f"ExecStart={setting.program} run --quiet {_host(setting)}{setting.benches}/%i.toml",
        "# The control path never starts again by itself, see docs/safety.md; the launcher brings back what only listens.",
        "Restart=no",
        "# SIGTERM to the launcher alone, which vents and then ends the others in order; to all of them when it is gone.",
        "ExecStop=-/bin/kill -TERM $MAINPID",
        "ExecStop=-/usr/bin/tail --pid=${MAINPID} -f /dev/null",
        f"TimeoutStopSec={STOP_S}",
        "OOMPolicy=continue",
        f"LimitRTPRIO={RTPRIO}",
        "LimitMEMLOCK=infinity",
        *((f"CPUAffinity={setting.cpus}",) if setting.cpus else ()),
        "SupplementaryGroups=dialout",
        *_own_folders(setting),
        *_sandbox(setting, devices=True),
    )
    head = ("Description=softloop bench %i", "After=network.target softloop-router@%i.service")
    return Unit("softloop", {"Unit": head, "Service": service})


def _host(setting: Setting) -> str:
    return f"--host {setting.host} " if setting.host else ""


def _service(setting: Setting, name: str, what: str, command: str, restart: Lines) -> Unit:
    """Something that only listens, or that others meet at: started again, also at boot where it is enabled."""
    service = (
        "Type=exec",
        f"ExecStart={setting.program} {command} {setting.benches}/%i.toml",
        *restart,
        "TimeoutStopSec=20",
        *_own_folders(setting),
        *_sandbox(setting, devices=False),
    )
    head = (f"Description={what}", "After=network.target", "StartLimitIntervalSec=0")
    return Unit(name, {"Unit": head, "Service": service, "Install": ("WantedBy=multi-user.target",)})


def _always(pause_s: str, never: str) -> Lines:
    """Restart but after exit codes with which it would never run: a bad file, and for some a port in use."""
    return ("Restart=always", f"RestartSec={pause_s}", f"RestartPreventExitStatus={never}")


def _own_folders(setting: Setting) -> Lines:
    """A user of its own, and the folders that are its own: kernels in /var/cache, runs in /var/lib, sockets in /run."""
    return (
        f"User={setting.user}",
        f"Group={setting.user}",
        "UMask=0027",
        *(f"{kind}Directory{end}" for kind in ("Cache", "State", "Runtime") for end in ("=softloop", "Mode=0750")),
        "# Several units share it.",
        "RuntimeDirectoryPreserve=yes",
        "WorkingDirectory=%S/softloop",
        "Environment=XDG_CACHE_HOME=%C XDG_RUNTIME_DIR=%t/softloop MPLCONFIGDIR=%C/softloop/matplotlib PYTHONDONTWRITEBYTECODE=1",
    )


def _sandbox(setting: Setting, *, devices: bool) -> Lines:
    """All that systemd takes away, but for what the rig needs."""
    return (
        "NoNewPrivileges=yes",
        "CapabilityBoundingSet=",
        "AmbientCapabilities=",
        "ProtectSystem=strict",
        f"ProtectHome={'read-only' if in_a_home(setting.program) else 'yes'}",
        "PrivateTmp=yes",
        *(_devices() if devices else ("PrivateDevices=yes",)),
        "ProtectClock=yes",
        "ProtectControlGroups=yes",
        "ProtectHostname=yes",
        "ProtectKernelLogs=yes",
        "ProtectKernelModules=yes",
        "ProtectKernelTunables=yes",
        "ProtectProc=invisible",
        "RestrictNamespaces=yes",
        "RestrictSUIDSGID=yes",
        "LockPersonality=yes",
        f"RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK{' AF_CAN' if devices else ''}",
        *(() if setting.network else ("IPAddressDeny=any", "IPAddressAllow=localhost")),
        "SystemCallArchitectures=native",
        "SystemCallFilter=@system-service",
        "SystemCallFilter=~@privileged",
        "SystemCallErrorNumber=EPERM",
        "# No MemoryDenyWriteExecute: numba writes the code that it runs. RestrictRealtime would take the priority away.",
    )


def _devices() -> Lines:
    """Serial ports and pseudo-terminals, and no device else. CAN of the kernel is a network; other adapters need a drop-in."""
    return ("DevicePolicy=closed", *(f"DeviceAllow=char-{kind} rw" for kind in ("ttyUSB", "ttyACM", "ttyS", "ttyAMA", "pts")))


def needed(program: Path) -> list[Path]:
    """The files without which a command does not start: itself, the interpreter in its first line, and what they link to."""
    found = [program]
    with suppress(OSError, ValueError), program.open("rb") as file:
        first = file.readline(512)
        if first.startswith(b"#!") and first[2:].strip():
            found.append(Path(first[2:].split()[0].decode()))
    return [*found, *(path.resolve() for path in found)]


def in_a_home(program: Path) -> bool:
    """Whether a command, or its interpreter, stands where ProtectHome=yes would hide it."""
    return any(str(path).startswith(("/home/", "/root/", "/run/user/")) for path in needed(program))


def out_of_reach(path: Path) -> Iterator[Path]:
    """The folders on the way to `path`, and itself, that other users may not enter or run."""
    for step in (*reversed(path.parents), path):
        if not step.exists() or not step.stat().st_mode & 0o001:
            yield step
