"""`softloop install`: write the systemd units, and say what is left for a person to do."""

from __future__ import annotations

import os
import pwd
import re
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from softloop.deploy.services import Setting, needed, out_of_reach, units
from softloop.wire.errors import EXIT_OK, BadConfig, Unavailable

# Where systemd of this machine looks; units in any other folder may be for another one.
OWN_FOLDERS = tuple(Path(root, "systemd/system") for root in ("/etc", "/run", "/usr/local/lib", "/usr/lib", "/lib"))
USER = re.compile(r"[a-z_][a-z0-9_-]{0,31}")  # what useradd takes
CORES = re.compile(r"[0-9]{1,9}(-[0-9]{1,9})?")
MOST_CORES = 8192  # of Linux and of systemd


def own_program() -> Path:
    """The command `softloop` of this installation."""
    return Path(sys.executable).absolute().with_name("softloop")


def install(to: Path, setting: Setting) -> int:
    """Write all units to the folder `to`, replacing those that stand there; returns the exit code.

    Raises:
        BadConfig: a choice that cannot stand in a unit, such as a program's path with a blank.
        Unavailable: the folder is not there, or cannot be written.
    """
    _check(setting)
    lacking = _lacking(to, setting.cpus)
    if not to.is_dir():
        raise Unavailable(f"{to}: there is no such folder; make it, or name another with --to")
    for unit in units(setting):
        file = to / unit.file
        try:
            file.write_text(unit.text(), encoding="utf-8")
        except OSError as error:
            raise Unavailable(f"{file}: cannot be written: {error.strerror or error}") from None
        print(file)
    print("\n".join([*lacking, *_left_to_do(setting)]))
    return EXIT_OK


def _check(setting: Setting) -> None:
    for what, text in (("--program", str(setting.program)), ("--benches", str(setting.benches)), ("--user", setting.user)):
        if not text.isprintable() or any(sign in text for sign in " \t\"'%\\;$") or not text:
            raise BadConfig(f"{what} {text!r}: blanks, quotes, %, \\, ; and $ cannot stand in a unit")
    if not setting.program.is_absolute() or not setting.benches.is_absolute():
        raise BadConfig("--program and --benches: give the whole paths, from / on")
    if not setting.program.is_file():
        raise BadConfig(f"--program {setting.program}: there is no such file")
    if not all(sign in "abcdefghijklmnopqrstuvwxyz0123456789_-" for sign in setting.host):
        raise BadConfig(f"--host {setting.host!r}: a name is a-z, 0-9, _ and -")
    _check_user(setting.user)


def _check_user(name: str) -> None:
    """What useradd would make, and nobody with root's rights, which is what the units keep from a rig."""
    if not USER.fullmatch(name):
        raise BadConfig(f"--user {name!r}: a name is a-z, 0-9, _ and -, not first a digit or -, of at most 32 signs")
    uid = None
    with suppress(KeyError):
        uid = pwd.getpwnam(name).pw_uid
    if name == "root" or uid == 0:
        raise BadConfig(f"--user {name}: is root; name a user without its rights, such as softloop")


def _lacking(to: Path, cpus: str) -> list[str]:
    """A warning about cores that are not here, for units that may be another machine's. Raises BadConfig for this one's."""
    here = os.sysconf("SC_NPROCESSORS_CONF")
    most = max((last for _, last in _cores(cpus)), default=0)
    if most < here:
        return []
    said = f"--cpus {cpus}: this machine has no core {most}; it has {here}, from 0 on"
    if to.resolve() in {folder.resolve() for folder in OWN_FOLDERS}:
        raise BadConfig(f"{said}: name some of these")
    return [f"warning: {said}"]


def _cores(cpus: str) -> Iterator[tuple[int, int]]:
    """First and last core of each part of a list such as `2-3` or `0,2 4`; none of an empty text. Raises BadConfig."""
    for part in re.split(" *, *| +", cpus.strip(" ")) if cpus else ():
        if not CORES.fullmatch(part):
            raise BadConfig(f"--cpus {cpus!r}: cores by number, such as 2-3 or 2,3")
        first, last = (int(end) for end in (part.split("-") * 2)[:2])
        if first > last:
            raise BadConfig(f"--cpus {cpus!r}: {part} goes down; write {last}-{first}")
        if last >= MOST_CORES:
            raise BadConfig(f"--cpus {cpus!r}: no machine has a core {last}; the last possible one is {MOST_CORES - 1}")
        yield first, last


def _left_to_do(setting: Setting) -> list[str]:
    user = setting.user
    return [
        *(f"warning: user '{user}' cannot enter {path}" for path in _closed(setting)),
        "left to do, as root:",
        f"  useradd --system --home-dir /var/lib/softloop --shell /usr/sbin/nologin --groups dialout {user}",
        f"  install -d {setting.benches}   # and the bench files in it: NAME.toml for softloop@NAME",
        "  systemctl daemon-reload",
        "  systemctl start softloop@NAME",
    ]


def _closed(setting: Setting) -> list[Path]:
    """What is closed to others on the way to the program, and to the interpreter behind it."""
    return sorted({path for start in needed(setting.program) for path in out_of_reach(start)})
