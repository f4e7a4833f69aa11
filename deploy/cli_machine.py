# ruff: noqa: PLC0415 - as in `deploy.cli`
"""Commands about the computer that a bench runs on."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from softloop.deploy.cli_app import BenchArgument, app, log_app, number
from softloop.wire.errors import EXIT_OK


@app.command()
def doctor(
    bench: BenchArgument,
    seconds: Annotated[float, number(metavar="S", min=0.5, max=3600.0, help="For each thing that is listened to.")] = 5.0,
    certificate: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the outcome here too; `[run] certificate` puts it into each log.")
    ] = None,
    host: Annotated[str | None, typer.Option(metavar="NAME", help="Of a bench on several hosts: which of them this is.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="The answer as JSON.")] = False,
) -> int:
    """Accept the computer and the devices before the rig runs: permissions, lateness, Zenoh, CAN, inclinometer, disk."""
    from softloop.deploy.doctor import doctor as examine

    return examine(bench, seconds, certificate, host, as_json=as_json)


@app.command("doctor-ticks", hidden=True)
def doctor_ticks(bench: BenchArgument, seconds: Annotated[float, number(metavar="S")] = 5.0) -> int:
    """The doctor's helper: what a process of the 5 ms path sees of this machine, as JSON."""
    from softloop.deploy.bench import find_bench, load_bench
    from softloop.deploy.doctor_ticks import measure_as_child

    measure_as_child(load_bench(find_bench(bench)), seconds)
    return EXIT_OK


@log_app.command("prune")
def log_prune(
    bench: BenchArgument,
    budget: Annotated[int | None, typer.Option(metavar="MIB", min=0, help="Instead of [recorder] budget_mib.")] = None,
    dry: Annotated[bool, typer.Option("--dry-run", help="Say what would go, and remove nothing.")] = False,
) -> int:
    """Remove a bench's oldest runs until the rest fits its disk budget; never one in use, or one that holds a file `keep`."""
    from softloop.deploy.rotate import prune

    return prune(bench, budget, dry=dry)


@app.command()
def install(
    to: Annotated[Path, typer.Option(metavar="DIR", help="Where the units go.")] = Path("/etc/systemd/system"),
    user: Annotated[
        str, typer.Option(metavar="NAME", help="Who runs them, not root; a user and a group of that name.")
    ] = "softloop",
    benches: Annotated[Path, typer.Option(metavar="DIR", help="The folder of bench files: NAME.toml for softloop@NAME.")] = Path(
        "/etc/softloop"
    ),
    cpus: Annotated[str, typer.Option(metavar="LIST", help="Cores for the rig, such as 2-3. Default: all.")] = "",
    program: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The command softloop. Default: that of this installation.")
    ] = None,
    host: Annotated[str, typer.Option(metavar="NAME", help="Of benches on several hosts: which of them this is.")] = "",
    network: Annotated[bool, typer.Option("--network", help="Allow addresses off this machine.")] = False,
) -> int:
    """Write systemd units: a run of a bench, its router, its viewers, each a template by bench."""
    from softloop.deploy.install import install as write_units
    from softloop.deploy.install import own_program
    from softloop.deploy.services import Setting

    return write_units(to, Setting(program or own_program(), user, benches, cpus, network, host))
