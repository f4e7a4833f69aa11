# ruff: noqa: PLC0415 - as in `deploy.cli`
"""Commands about the devices of a bench that does not run: their settings, and their calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from softloop.deploy.cli_app import BenchArgument, app, number

wt931_app = typer.Typer(help="The inclinometer.", rich_markup_mode=None)
app.add_typer(wt931_app, name="wt931")
canopen_app = typer.Typer(help="A CANopen node that drives the valves.", rich_markup_mode=None)
app.add_typer(canopen_app, name="canopen")


@wt931_app.callback()
def _wt931() -> None:
    """The inclinometer."""


@canopen_app.callback()
def _canopen() -> None:
    """A CANopen node that drives the valves."""


@wt931_app.command("configure")
def wt931_configure(
    bench: BenchArgument,
    from_baud: Annotated[
        int | None, typer.Option(metavar="BAUD", help="At which it listens now; new ones: 9600. Default: the bench file's.")
    ] = None,
) -> int:
    """Write rate, content, filter and baud rate to the inclinometer, save them, read them back, and count its samples."""
    from softloop.deploy.device_setup import configure_wt931

    return configure_wt931(bench, from_baud)


@canopen_app.command("configure")
def canopen_configure(bench: BenchArgument) -> int:
    """Write the deadlines and error values that let the node vent by itself, let it keep them, and read them back."""
    from softloop.deploy.device_setup import configure_canopen

    return configure_canopen(bench)


@app.command()
def calibrate(
    bench: BenchArgument,
    output: Annotated[Path, typer.Option(metavar="FILE.toml", help="The piece of a bench file to write, or to go on with.")],
    supply_vented: Annotated[
        bool, typer.Option("--supply-vented", help="At rest: nothing is on the supply sensor either.")
    ] = False,
    rest_deg: Annotated[float | None, number(metavar="DEG", help="At rest: the bending angle is this.")] = None,
    chamber_kpa: Annotated[float | None, number(metavar="KPA", help="A known point: on the chamber, by a manometer.")] = None,
    supply_kpa: Annotated[float | None, number(metavar="KPA", help="A known point: on the supply.")] = None,
    bent_deg: Annotated[float | None, number(metavar="DEG", help="A known point: bent by hand to this angle.")] = None,
    seconds: Annotated[float, number(metavar="S", min=0.5, max=600.0, help="For each thing that is listened to.")] = 5.0,
) -> int:
    """Zero of the sensors with the rig vented and at rest, gain and sign at a known point. Nothing is sent to a device."""
    from softloop.deploy.calibrate import Known
    from softloop.deploy.calibrate import calibrate as measure

    return measure(bench, output, Known(supply_vented, rest_deg, chamber_kpa, supply_kpa, bent_deg), seconds)
