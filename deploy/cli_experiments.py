# ruff: noqa: PLC0415 - as in `deploy.cli`
"""`softloop experiment ...` and `softloop reproduce`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from softloop.deploy.cli_app import EXIT_CODES, BenchArgument, app, numbers

if TYPE_CHECKING:
    from softloop.plant.config import PlantConfig

experiment_app = typer.Typer(help="Excite a bench's rig for identification, or let its laws track.", rich_markup_mode=None)
app.add_typer(experiment_app, name="experiment")

Out = Annotated[Path | None, typer.Option(metavar="DIR", help="Default: runs/<bench>-<experiment>-<UTC time>.")]
PaceOption = Annotated[
    Literal["wall", "lockstep", "batch"] | None,
    typer.Option(help="Instead of the bench file's; batch: in one process, the same messages as at lockstep pace."),
]
Parameters = Annotated[str | None, typer.Option(metavar="FILE.toml", help="Instead of the bench's, for the laws.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Show nothing but errors.")]
Seed = Annotated[int | None, typer.Option(metavar="N", min=0, help="Of the multi-sines' phases; default: the bench's.")]


def plant_of(file: Path) -> PlantConfig:
    """The simulated rig of a bench. Raises BadConfig when it has none."""
    from softloop.deploy.bench import load_bench
    from softloop.wire.errors import BadConfig

    plant = load_bench(file).plant
    if plant is None:
        raise BadConfig(f"{file}: --over needs a simulated rig, and there is no table [plant]")
    return plant


@experiment_app.command("pressure", epilog=EXIT_CODES)
def pressure(
    bench: BenchArgument,
    out: Out = None,
    pace: PaceOption = None,
    parameters: Parameters = None,
    seed: Seed = None,
    law: Annotated[Literal["pressure", "pressure_eso"], typer.Option(help="The paper's step 2, or with our observer.")] = (
        "pressure_eso"
    ),
    over: Annotated[
        str | None,
        typer.Option(metavar="A:B", help="Instead on all simulated rigs of these seeds, in one process, without logs."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="With --over: the answer as JSON.")] = False,
    quiet: Quiet = False,
) -> int:
    """Run a pressure law on the two multi-sines, which gives Data1 to Data3; exit code 1 where it is off by more than 2 kPa."""
    from softloop.deploy.bench import find_bench
    from softloop.deploy.experiment import Asked
    from softloop.deploy.experiment_pressure import run_over_rigs, run_pressure

    if over is not None:
        return run_over_rigs(law, over, plant_of(find_bench(bench)), as_json=as_json)
    return run_pressure(Asked(find_bench(bench), out, pace, parameters, seed, quiet), law)


@experiment_app.command("tracking", epilog=EXIT_CODES)
def tracking(
    bench: BenchArgument,
    out: Out = None,
    pace: PaceOption = None,
    parameters: Parameters = None,
    seed: Seed = None,
    laws: Annotated[str, typer.Option(metavar="LAW,LAW", help="Which laws, in order.")] = "pid,smc,arc,arc_eso",
    own_gains: Annotated[bool, typer.Option("--own-gains", help="The bench's gains, not each law's tuned ones.")] = False,
    quiet: Quiet = False,
) -> int:
    """Run laws on T1 and T2, the paper's Figs. 6 and 7, and show their errors."""
    from softloop.deploy.bench import find_bench
    from softloop.deploy.experiment import Asked
    from softloop.deploy.experiment_tracking import run_tracking

    chosen = tuple(name.strip() for name in laws.split(",") if name.strip())
    return run_tracking(Asked(find_bench(bench), out, pace, parameters, seed, quiet), chosen, own_gains=own_gains)


@experiment_app.command("valves", epilog=EXIT_CODES)
def valves(
    bench: BenchArgument,
    out: Out = None,
    pace: PaceOption = None,
    supply: Annotated[str, typer.Option(metavar="KPA,KPA,KPA", help="Supply pressures, gauge; three or more.")] = "150,175,200",
    ratios: Annotated[
        bool, typer.Option("--ratios", help="On the actuator itself, without a tank: ratios to its unknown volume.")
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option(metavar="FILE.toml", help="Write the controller's parameters with both valves as measured; tank only."),
    ] = None,
    quiet: Quiet = False,
) -> int:
    """Flow tests of both valves on the tank of [calibration], as for Fig. 4; exit code 1 where they show nothing of a valve."""
    from softloop.deploy.bench import find_bench
    from softloop.deploy.experiment import Asked
    from softloop.deploy.experiment_valves import run_valves

    supplies = numbers("--supply", supply, "150,175,200")
    return run_valves(Asked(find_bench(bench), out, pace, quiet=quiet), supplies, ratios=ratios, output=output)


@app.command(epilog=EXIT_CODES)
def reproduce(
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Default: runs/reproduce-<UTC time>.")] = None,
    pace: Annotated[
        Literal["wall", "lockstep", "batch"], typer.Option(help="Of the experiments; batch is by far the fastest.")
    ] = "batch",
    rigs: Annotated[int, typer.Option(metavar="N", min=0, help="Ideal rigs whose intervals are counted; 0: none.")] = 100,
    seeds: Annotated[str, typer.Option(metavar="A:B", help="Rigs over which fits and laws are judged.")] = "0:20",
    quiet: Quiet = False,
) -> int:
    """Reproduce the paper on simulated rigs: experiments, identification, tracking, and one page with its numbers beside ours."""
    from softloop.deploy.reproduce import Wanted, run_reproduce

    return run_reproduce(Wanted(out, pace, rigs, seeds, quiet))
