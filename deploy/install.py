"""`softloop install`: write the systemd units, and say what is left for a person to do."""

from __future__ import annotations

import sys
from pathlib import Path

from softloop.deploy.services import Setting, needed, out_of_reach, units
from softloop.wire.errors import EXIT_OK, BadConfig, Unavailable


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
    if not to.is_dir():
        raise Unavailable(f"{to}: there is no such folder; make it, or name another with --to")
    for unit in units(setting):
        file = to / unit.file
        try:
            file.write_text(unit.text(), encoding="utf-8")
        except OSError as error:
            raise Unavailable(f"{file}: cannot be written: {error.strerror or error}") from None
        print(file)
    print("\n".join(_left_to_do(setting)))
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
    if not all(sign in "0123456789-, " for sign in setting.cpus):
        raise BadConfig(f"--cpus {setting.cpus!r}: cores by number, such as 2-3 or 2,3")


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
