"""The command line's frame: the application that commands enter themselves into, and arguments that several share."""

from __future__ import annotations

from contextlib import suppress
from math import isfinite
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from softloop.wire.errors import BadConfig, Interrupted

EXIT_CODES = """Exit codes: 0 all is well; 1 the command ran and its answer is no (a gate fault, a difference, a refused request);
2 a bad argument or a bad file; 3 the machine (an address in use, a device or permission that is missing);
4 a process or a wire was lost while running; 130 interrupted."""


class Commands(TyperGroup):
    """All commands; Ctrl-C in one is an error like others, so that it is said in one line."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            raise Interrupted("interrupted") from None


app = typer.Typer(
    name="softloop",
    cls=Commands,
    help="Hardware-in-the-loop control of pneumatic soft bending actuators over Zenoh and CAN.",
    epilog=EXIT_CODES,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 130},
)

log_app = typer.Typer(help="Look at a run's log, and mend it.", rich_markup_mode=None)
app.add_typer(log_app, name="log")

RunArgument = Annotated[Path, typer.Argument(metavar="RUN", help="A run directory, or a log in it.")]
BenchArgument = Annotated[Path, typer.Argument(metavar="BENCH.toml", help="A bench file, or the name of a shipped one (sim).")]
OptionalBench = Annotated[Path, typer.Argument(metavar="BENCH.toml", help="A bench file, or the name of a shipped one.")]
RunDir = Annotated[Path, typer.Option(metavar="DIR", help="The run's directory.")]


def finite(value: float | None) -> float | None:
    """What every float option passes: nan is within any bounds, and inf within those open to one side. Raises BadParameter."""
    if value is not None and not isfinite(value):
        raise typer.BadParameter(f"{value} is not a finite number; give one.")
    return value


def number(*names: str, **settings: Any) -> Any:
    """A float option, as `typer.Option`, that takes finite numbers alone."""
    return typer.Option(*names, callback=finite, **settings)


def numbers(option: str, text: str, example: str) -> tuple[float, ...]:
    """The finite numbers of a text option, with commas between. Raises BadConfig."""
    with suppress(ValueError):
        found = tuple(float(part) for part in text.split(","))
        if all(map(isfinite, found)):
            return found
    raise BadConfig(f"{option} {text}: give finite numbers with commas between, such as {example}")
