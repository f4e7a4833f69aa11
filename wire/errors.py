"""The errors a person sees: one line each, with an exit code."""

from __future__ import annotations

EXIT_OK = 0
EXIT_NEGATIVE = 1  # the command ran, and its answer is no (a fault, a difference, a missed check)
EXIT_USAGE = 2  # a bad argument or a bad file
EXIT_ENVIRONMENT = 3  # the machine: an address in use, a device or a permission that is missing
EXIT_LOST = 4  # a process or a wire was lost while running
EXIT_INTERRUPTED = 130


def printable(said: str) -> str:
    """The text as one line, whatever it quotes: a line's end, a bell, half a character are shown as they are written."""
    return said if said.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in said)


class SoftloopError(Exception):
    """Base of all errors meant for a person: `str(error)` is the one line to show, `printable`."""

    exit_code = EXIT_USAGE

    def __str__(self) -> str:
        return printable(super().__str__())


class BadFile(SoftloopError):
    """A file that cannot be read as what it should be."""


class BadConfig(SoftloopError):
    """A bench or parameter file with a wrong key or value."""


class Unavailable(SoftloopError):
    """Something of the machine that is not there or in use."""

    exit_code = EXIT_ENVIRONMENT


class Lost(SoftloopError):
    """A process or a wire that went away while running."""

    exit_code = EXIT_LOST


class Interrupted(SoftloopError):
    """A person or the system asked to end."""

    exit_code = EXIT_INTERRUPTED
