# ruff: noqa: PLC0415 - as in `deploy.cli`
"""Commands that work on many runs or on their logs: campaigns, tuning, judging, identification."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from softloop.deploy.cli_app import EXIT_CODES, BenchArgument, app, number
from softloop.offline.tuning_ranges import RANGES


@app.command(epilog=EXIT_CODES)
def batch(
    bench: BenchArgument,
    seeds: Annotated[str, typer.Option(metavar="A:B", help="Rigs to draw: 0:1000 is a thousand of them, 7 is one.")],
    jobs: Annotated[int, typer.Option(min=1, help="Processes that share the work.")] = 1,
    law: Annotated[list[str] | None, typer.Option(help="Instead of the bench's; several with commas, or again.")] = None,
    trajectory: Annotated[list[str] | None, typer.Option(help="Likewise: t1, t2, or the path of a CSV file.")] = None,
    payload: Annotated[bool, typer.Option("--payload", help="Each run once more, with a payload that comes and leaves.")] = False,
    tuned: Annotated[bool, typer.Option("--tuned", help="Each law with its shipped tuned gains, not the bench's.")] = False,
    scheduler: Annotated[str | None, typer.Option(metavar="ADDRESS", help="Work on the Dask cluster of this scheduler.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Default: runs/<bench>-batch-<UTC time>.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="The answer as JSON.")] = False,
) -> int:
    """Run a bench on many simulated rigs, without its processes: every law and trajectory, as a table and a picture."""
    from softloop.deploy.batch import Wanted
    from softloop.deploy.batch import batch as run_batch

    laws, trajectories = (tuple(name for text in given or () for name in text.split(",")) for given in (law, trajectory))
    return run_batch(bench, Wanted(seeds, laws, trajectories, jobs, payload, tuned, scheduler, out, as_json))


@app.command()
def faults(
    only: Annotated[list[Path] | None, typer.Argument(metavar="SCENARIO...", help="Files, or names of shipped ones.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Default: runs/faults-<UTC time>.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="The answer as JSON; it also goes to DIR/faults.json.")] = False,
) -> int:
    """Run all shipped fault scenarios (or the ones named), and say how each ended; exit code 1 where one is not as expected."""
    from softloop.deploy.faults import run_all

    return run_all(only or [], out, as_json=as_json)


@app.command(epilog=EXIT_CODES)
def parity(
    run_a: Annotated[Path, typer.Argument(metavar="RUN_A", help="The run that is the measure: a directory, or a log in it.")],
    run_b: Annotated[Path, typer.Argument(metavar="RUN_B", help="The run that is judged, of the same excitation.")],
    bounds: Annotated[Path | None, typer.Option(metavar="FILE.toml", help="Bounds; default: the shipped ones.")] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where the page and its pictures go.")] = Path("parity"),
    as_json: Annotated[bool, typer.Option("--json", help="The answer as JSON.")] = False,
) -> int:
    """Judge by bounds, channel by channel, whether two runs of one excitation are of one rig; exit code 1 where they are not."""
    from softloop.deploy.parity import judge_parity

    return judge_parity(run_a, run_b, bounds, out, as_json=as_json)


@app.command(epilog=EXIT_CODES)
def shadow(
    bench: Annotated[Path, typer.Argument(metavar="BENCH", help="With a table [shadow]: the plant that is to follow.")],
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A directory, or a log in it.")],
    as_json: Annotated[bool, typer.Option("--json", help="The answer as JSON, every word of the shadow.")] = False,
) -> int:
    """Let the simulated plant of a bench follow a log on its valve currents, and say how far the two were apart."""
    from softloop.deploy.follow_log import follow_run

    return follow_run(bench, run, as_json=as_json)


@app.command()
def tune(
    law: Annotated[str, typer.Argument(metavar="LAW", help=f"One of {', '.join(RANGES)}.")],
    seeds: Annotated[str, typer.Option(metavar="A:B", help="Tuning rigs; judge on others.")] = "1000:1008",
    added_ms: Annotated[float, number(metavar="MS", min=0.0, max=150.0, help="Latency added to the rig's own.")] = 0.0,
    evaluations: Annotated[int, typer.Option(metavar="N", min=1, help="At least so many.")] = 500,
    search_seed: Annotated[int, typer.Option(metavar="N", min=1, help="Of the optimiser.")] = 1,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the [controller] table here.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="The outcome as JSON.")] = False,
) -> int:
    """Search a law's gains with CMA-ES in simulated runs; the same cost and budget for every law."""
    from softloop.deploy.tune import run_tune

    return run_tune(law, seeds, added_ms, evaluations, search_seed, out, as_json=as_json)


@app.command()
def evaluate(
    seeds: Annotated[str, typer.Option(metavar="A:B", help="The rigs to judge on; not those of tuning.")] = "0:20",
    laws: Annotated[str, typer.Option(metavar="LAW,LAW", help="Default: all.")] = "",
    only: Annotated[str, typer.Option(metavar="CONDITION", help='One condition, such as "own latency"; default: all.')] = "",
    figures: Annotated[Path | None, typer.Option(metavar="DIR", help="Draw Figs. 6 and 7 of all laws there.")] = None,
    confirm: Annotated[int, typer.Option(metavar="N", min=0, help="Run the first N rigs over the whole stack too.")] = 0,
    pace: Annotated[Literal["wall", "lockstep"], typer.Option(help="Of the runs that confirm, all processes.")] = "wall",
    as_json: Annotated[bool, typer.Option("--json", help="Everything as JSON, every rig.")] = False,
) -> int:
    """Judge every law with its tuned gains on many simulated rigs; exit code 1 where arc_eso misses a bar of its own."""
    from softloop.deploy.evaluate import run_evaluate

    return run_evaluate(seeds, laws, only, figures, confirm, pace, as_json=as_json)


@app.command()
def identify(
    context: typer.Context,
    runs: Annotated[list[Path] | None, typer.Argument(metavar="RUN...", help="Logs of excitation; the first one trains.")] = None,
    csv: Annotated[
        list[Path] | None, typer.Option(metavar="FILE", help="A CSV file; the first one trains, more validate.")
    ] = None,
    columns: Annotated[list[str] | None, typer.Option("--map", metavar="KEY=COLUMN", help="time, pressure and angle.")] = None,
    orders: Annotated[str, typer.Option(metavar="m,n,r", help="Orders of a(y), b(y) and c(y).")] = "2,0,3",
    hysteresis: Annotated[int, typer.Option(min=0, max=4, help="How many Bouc-Wen elements.")] = 0,
    creep: Annotated[int, typer.Option(min=0, max=4, help="How many Prony terms.")] = 0,
    delay: Annotated[bool, typer.Option("--delay", help="Estimate the angle's delay behind the pressure.")] = False,
    lag: Annotated[bool, typer.Option("--lag", help="Estimate a first-order lag of the angle's sensor.")] = False,
    at_rest: Annotated[
        bool, typer.Option("--at-rest", help="Every file begins at rest; the zero of its angle is its own.")
    ] = False,
    method: Annotated[
        Literal["oe", "iv", "ls"], typer.Option(help="Output error, instrumental variables, least squares.")
    ] = "oe",
    interval: Annotated[
        Literal["coloured", "bootstrap", "white"], typer.Option(help="What the residuals are taken for.")
    ] = "coloured",
    output: Annotated[Path | None, typer.Option(metavar="FILE.toml", help="Write a parameter file with its evidence.")] = None,
    select: Annotated[bool, typer.Option("--select", help="Compare orders instead.")] = False,
    venting: Annotated[
        bool, typer.Option("--venting", help="Fit the flow law of an emptying volume; map time, pressure and maybe input.")
    ] = False,
    train: Annotated[int, typer.Option(metavar="N", help="With --venting: the first N files train.")] = 1,
    figure: Annotated[Path | None, typer.Option(metavar="FILE.png", help="Draw measured and simulated angle.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="The answer as JSON.")] = False,
) -> int:
    """Identify the bending model from logs or CSV files, with intervals, and score it by free simulation."""
    from softloop.deploy import identify as identification
    from softloop.deploy.identify_checks import check_options

    check_options(_given(context))
    if venting:
        return identification.identify_vent(tuple(csv or ()), tuple(columns or ()), train, as_json=as_json)
    asked = identification.Asked(
        tuple(runs or ()), tuple(csv or ()), tuple(columns or ()), orders, hysteresis, creep, delay, lag, at_rest, method,
        interval, select, output, figure, as_json,
    )  # fmt: skip
    return identification.identify(asked)


def _given(context: typer.Context) -> dict[str, str]:
    """Parameters that stand on the command line -> how a person writes them."""
    there = (p for p in context.command.params if p.name)
    written = {p.name: p.opts[0] if p.param_type_name == "option" else (getattr(p, "metavar", None) or p.opts[0]) for p in there}
    sources = {name: context.get_parameter_source(name) for name in written if name}
    return {name: written[name] for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"}


@app.command()
def valve(
    csv: Annotated[Path, typer.Argument(metavar="FILE", help="Steady flow tests of one valve, a row each.")],
    columns: Annotated[
        list[str] | None,
        typer.Option("--map", metavar="KEY=COLUMN", help="current (mA), upstream, downstream (kPa gauge), flow (kg/s)."),
    ] = None,
    discharge: Annotated[float, number(metavar="C_f", min=0.01, max=1.0, help="Discharge coefficient; 1: areas hold it.")] = 1.0,
    temperature: Annotated[float, number(metavar="K", min=200.0, max=400.0, help="Of the gas.")] = 293.15,
    as_json: Annotated[bool, typer.Option("--json", help="The answer as JSON.")] = False,
) -> int:
    """Identify a valve's model, Eqs. 12 and 16, from flow tests; what they do not show gets no number."""
    from softloop.deploy.identify import identify_valve

    return identify_valve(csv, tuple(columns or ()), discharge, temperature, as_json=as_json)


@app.command()
def coverage(
    rigs: Annotated[int, typer.Option(min=1, help="How many rigs; on the rig layer each is excited 40 times.")] = 1000,
    layer: Annotated[Literal["ideal", "rig"], typer.Option(help="Rigs that are the model, or that have more than it.")] = "ideal",
    first_seed: Annotated[int, typer.Option(metavar="N", min=0, help="Seeds are N, N+1, ...")] = 1,
    output: Annotated[Path | None, typer.Option(metavar="FILE.json", help="Write what was counted, as it grows.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="The answer as JSON.")] = False,
) -> int:
    """Count over simulated rigs whether the intervals of each method hold what they say."""
    from softloop.deploy.coverage import coverage as count

    return count(layer, rigs, first_seed, output, as_json=as_json)


@app.command()
def fits(
    seeds: Annotated[str, typer.Option(metavar="FIRST:END", help="Rigs, by seed; END is not among them.")] = "0:20",
    hysteresis: Annotated[
        int | None, typer.Option(min=0, max=4, metavar="N", help="Bouc-Wen elements; default: the recommended.")
    ] = None,
    creep: Annotated[int | None, typer.Option(min=0, max=4, metavar="N", help="Creep terms; default: the recommended.")] = None,
    output: Annotated[Path | None, typer.Option(metavar="FILE.json", help="Write what was found, after each rig.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="The answer as JSON.")] = False,
) -> int:
    """Identify simulated rigs from their own Data1, and score the models on Data2 and Data3, which they have not seen."""
    from softloop.deploy.fits import fits as fit

    return fit(seeds, hysteresis, creep, output, as_json=as_json)
