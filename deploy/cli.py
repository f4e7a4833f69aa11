# ruff: noqa: PLC0415 - every command imports what it needs, and no other command pays for it
"""The command line. Everything heavy is imported inside the commands, so that `softloop --help` and each process start fast."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer.core import TyperGroup

from softloop.wire.errors import EXIT_LOST, EXIT_OK, EXIT_USAGE, Interrupted, SoftloopError

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


@app.command(epilog=EXIT_CODES)
def run(
    bench: BenchArgument,
    run_dir: Annotated[Path | None, typer.Option(metavar="DIR", help="Default: runs/<bench>-<UTC time>.")] = None,
    duration: Annotated[float | None, typer.Option(metavar="S", min=0.0, help="End after S seconds, armed.")] = None,
    no_report: Annotated[bool, typer.Option("--no-report", help="Leave out the report at the end.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show nothing but errors.")] = False,
    page: Annotated[bool, typer.Option("--page", help="Serve the live page while the rig runs.")] = False,
    foxglove: Annotated[bool, typer.Option("--foxglove", help="Serve the channels to Foxglove while the rig runs.")] = False,
    pace: Annotated[
        Literal["wall", "lockstep"] | None,
        typer.Option(help="Instead of the bench file's: by the clock, or tick by tick."),
    ] = None,
) -> int:
    """Run a bench: start its processes, arm, watch, vent, stop, summary and report."""
    from softloop.deploy.bench import find_bench
    from softloop.deploy.launcher import Options, launch

    options = Options(
        run_dir=run_dir, duration_s=duration, report=False if no_report else None, quiet=quiet, pace=pace, page=page
    )
    return launch(find_bench(bench), options)


@app.command()
def node(
    name: Annotated[str, typer.Argument(metavar="NAME", help="The process: the name of its table in the bench file.")],
    bench: BenchArgument,
    run_dir: RunDir,
    lifeline_fd: Annotated[int | None, typer.Option(metavar="N", help="A pipe; when it ends, vent and exit.")] = None,
) -> int:
    """Be one process of a bench, in this terminal."""
    from softloop.deploy.bench import find_bench
    from softloop.deploy.node import run_node

    return run_node(name, find_bench(bench), run_dir, lifeline_fd)


@app.command()
def check(bench: BenchArgument) -> int:
    """Check a bench file, and that the actuator can follow its trajectory."""
    from softloop.deploy.bench import find_bench, load_bench
    from softloop.deploy.node import processes_of
    from softloop.deploy.prepare import check_controller, check_identity

    loaded = load_bench(find_bench(bench))
    trajectory_s = check_controller(loaded)
    check_identity(loaded)
    names = ", ".join(p.name for p in processes_of(loaded)) or "no process"
    print(f"{bench}: good. Bench '{loaded.name}': {names}; trajectory {trajectory_s:.1f} s")
    return EXIT_OK


@app.command()
def request(
    bench: BenchArgument,
    action: Annotated[Literal["arm", "disarm", "stop"], typer.Argument(help="stop: emergency stop, FAULT until armed again.")],
    timeout: Annotated[float, typer.Option(metavar="S", min=0.1, help="How long to wait for the gate's answer.")] = 5.0,
) -> int:
    """Ask the gate of a running bench to arm, disarm or stop, and report its answer."""
    from softloop.deploy.bench import find_bench, load_bench
    from softloop.deploy.gate_requests import request_once

    return request_once(load_bench(find_bench(bench)), action, timeout)


@app.command()
def report(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run directory, or a log in it.")],
) -> int:
    """Compute summary and report of a run again, from its log."""
    from softloop.deploy.conclude import judge

    judge(run, report=True, quiet=False)
    return EXIT_OK


@app.command()
def replay(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run directory, or a log in it.")],
    controller: Annotated[
        Path | None, typer.Option(metavar="BENCH.toml", help="Ask this bench's controller instead: how far are its commands?")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="The answer as JSON.")] = False,
) -> int:
    """Feed a log's inputs through its controller again, and compare every command and state bit for bit."""
    from softloop.deploy.replay import replay_run

    return replay_run(run, controller, as_json=as_json)


@log_app.command("check")
def log_check(run: RunArgument, as_json: Annotated[bool, typer.Option("--json", help="The answer as JSON.")] = False) -> int:
    """What a log holds, its gaps by sequence number per channel, and its loss windows; exit code 1 when something is missing."""
    from softloop.deploy.log_tools import check_run

    return check_run(run, as_json=as_json)


@log_app.command("repair")
def log_repair(
    run: RunArgument,
    output: Annotated[Path | None, typer.Option("--output", "-o", metavar="FILE", help="Default: in place.")] = None,
) -> int:
    """Write a good file from a damaged log; in place, the damaged one is kept beside it as *.damaged."""
    from softloop.deploy.log_tools import repair_run

    return repair_run(run, output)


@app.command()
def same(
    first: Annotated[Path, typer.Argument(metavar="RUN_A", help="A run directory, or a log in it.")],
    second: Annotated[
        Path | None, typer.Argument(metavar="RUN_B", help="Another one; without it, its bench in one process.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="The answer as JSON.")] = False,
) -> int:
    """Compare two lockstep runs byte by byte, or one with the same bench in one process: they come out the same."""
    from softloop.deploy.same import same_runs

    return same_runs(first, second, as_json=as_json)


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
def tune(
    law: Annotated[str, typer.Argument(metavar="LAW", help="pid, pid_eso, smc, arc or arc_eso.")],
    seeds: Annotated[str, typer.Option(metavar="A:B", help="Tuning rigs; judge on others.")] = "1000:1002",
    added_ms: Annotated[float, typer.Option(metavar="MS", min=0.0, max=150.0, help="Latency added to the rig's own.")] = 0.0,
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
    confirm: Annotated[int, typer.Option(metavar="N", min=0, help="Run the first N rigs at wall pace too, all processes.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Everything as JSON, every rig.")] = False,
) -> int:
    """Judge every law with its tuned gains on many simulated rigs; exit code 1 where arc_eso misses a bar of its own."""
    from softloop.deploy.evaluate import run_evaluate

    return run_evaluate(seeds, laws, only, figures, confirm, as_json=as_json)


@app.command()
def identify(
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

    if venting:
        return identification.identify_vent(tuple(csv or ()), tuple(columns or ()), train, as_json=as_json)
    asked = identification.Asked(
        tuple(runs or ()), tuple(csv or ()), tuple(columns or ()), orders, hysteresis, creep, delay, lag, at_rest, method,
        interval, select, output, figure, as_json,
    )  # fmt: skip
    return identification.identify(asked)


@app.command()
def valve(
    csv: Annotated[Path, typer.Argument(metavar="FILE", help="Steady flow tests of one valve, a row each.")],
    columns: Annotated[
        list[str] | None,
        typer.Option("--map", metavar="KEY=COLUMN", help="current (mA), upstream, downstream (kPa gauge), flow (kg/s)."),
    ] = None,
    discharge: Annotated[
        float, typer.Option(metavar="C_f", min=0.01, max=1.0, help="Discharge coefficient; 1: areas hold it.")
    ] = 1.0,
    temperature: Annotated[float, typer.Option(metavar="K", min=200.0, max=400.0, help="Of the gas.")] = 293.15,
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
    output: Annotated[Path | None, typer.Option(metavar="FILE.json", help="Write what was counted.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="The answer as JSON.")] = False,
) -> int:
    """Count over simulated rigs whether the intervals of each method hold what they say."""
    from softloop.deploy.coverage import coverage as count

    return count(layer, rigs, first_seed, output, as_json=as_json)


@app.command()
def plot(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run directory, or a log in it.")],
    curves: Annotated[list[str], typer.Argument(metavar="CHANNEL.FIELD...", help="Such as cycle.angle_deg or cycle.theta[8].")],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A file ending in .svg, .pdf or .png. Default: plot.svg beside the log.")
    ] = None,
    first: Annotated[float, typer.Option("--from", metavar="S", help="From S seconds after the start of the log.")] = float(
        "-inf"
    ),
    last: Annotated[float, typer.Option("--to", metavar="S", help="Until then.")] = float("inf"),
) -> int:
    """Draw fields of a log against time, one panel per unit."""
    from softloop.deploy.plotting import plot_run

    return plot_run(run, curves, out, first, last)


@app.command()
def compare(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN RUN...", help="Run directories, or logs in them; two to six.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where the page and its pictures go.")] = Path("compare"),
) -> int:
    """Lay several runs over each other: one page with their figures, pictures and what differs in their set-up."""
    from softloop.deploy.comparing import compare_runs

    return compare_runs(runs, out)


@app.command()
def top(
    bench: OptionalBench = Path("sim"),
    seconds: Annotated[float | None, typer.Option(metavar="S", min=0.1, help="End after S seconds.")] = None,
    once: Annotated[bool, typer.Option("--once", help="One look of two seconds (or --seconds), as plain text.")] = False,
) -> int:
    """Show a running bench: rates, ages, tick lateness, loads of buses and processes."""
    from softloop.deploy.watching import top as show_top

    return show_top(bench, seconds, once=once)


@app.command()
def page(
    bench: OptionalBench = Path("sim"),
    port: Annotated[int | None, typer.Option(metavar="N", min=0, max=65_534, help="Instead of [page] port.")] = None,
    launch: Annotated[bool, typer.Option("--launch", help="Start and end experiments from the page.")] = False,
) -> int:
    """Serve the live page of a bench in a browser until Ctrl-C; the bench may be running already, come later, and come again."""
    from softloop.deploy.page import page as serve_page

    return serve_page(bench, port, launch=launch)


@app.command()
def foxglove(
    bench: OptionalBench = Path("sim"),
    port: Annotated[int | None, typer.Option(metavar="N", min=0, max=65_535, help="Instead of [foxglove] port.")] = None,
    layout: Annotated[Path | None, typer.Option(metavar="FILE", help="Write a layout for this bench, and end.")] = None,
) -> int:
    """Serve a running bench's channels to Foxglove and Lichtblick on this machine until Ctrl-C (extra 'foxglove')."""
    from softloop.deploy.foxglove import foxglove as serve_foxglove
    from softloop.deploy.foxglove import write_layout

    return serve_foxglove(bench, port) if layout is None else write_layout(bench, layout)


@app.command(hidden=True)
def bounds(bench: BenchArgument) -> int:
    """The page's helper: the parameters and their bounds as JSON."""
    from softloop.deploy.page import bounds as print_bounds

    return print_bounds(bench)


@app.command()
def echo(
    channel: Annotated[
        str, typer.Argument(metavar="CHANNEL", help="Such as cycle, cycle.angle_deg,error_deg, event or can/can0/80.")
    ],
    bench: OptionalBench = Path("sim"),
    count: Annotated[int | None, typer.Option("--count", "-n", metavar="N", min=1, help="End after N messages.")] = None,
    rate: Annotated[float | None, typer.Option(metavar="HZ", min=0.01, help="At most so many a second, each the newest.")] = None,
    timeout: Annotated[float, typer.Option(metavar="S", min=0.0, help="Exit code 4 after S seconds without one; 0: wait.")] = 0.0,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object a line.")] = False,
) -> int:
    """Print the messages of a channel of a running bench."""
    from softloop.deploy.watching import echo as print_channel

    return print_channel(channel, bench, count, rate, timeout, json_lines=as_json)


@app.command()
def warm(quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show nothing but errors.")] = False) -> int:
    """Compile every kernel once; later starts load them from the cache."""
    from softloop.deploy.prepare import warm as warm_all
    from softloop.deploy.progress import compile_progress

    with compile_progress(quiet=quiet) as progress:
        count = warm_all(progress)
    if not quiet:
        print(f"kernels of {count} modules are compiled")
    return EXIT_OK


@app.command()
def router(bench: BenchArgument) -> int:
    """Be the meeting point of a bench until Ctrl-C, for benches with `[run] shared_router = true`."""
    from softloop.deploy.bench import find_bench, load_bench
    from softloop.deploy.launcher import stop_on_signals
    from softloop.deploy.router import run_router

    with stop_on_signals() as stop:
        run_router(load_bench(find_bench(bench)), stop)
    return EXIT_OK


@app.command(hidden=True)
def prepare(bench: BenchArgument, run_dir: RunDir) -> int:
    """The launcher's helper: compile, check, and put parameters into the run's directory; JSON lines on standard output."""
    from softloop.deploy.bench import load_bench
    from softloop.deploy.prepare import prepare_as_child

    prepare_as_child(load_bench(bench, run_dir), run_dir)
    return EXIT_OK


def main(arguments: list[str] | None = None) -> None:
    """The entry point: every error is one line on standard error, and a documented exit code."""
    given = sys.argv[1:] if arguments is None else arguments
    sys.exit(_run(given or ["--help"]))


def _run(arguments: list[str]) -> int:
    try:
        code = app(arguments, standalone_mode=False)
    except SoftloopError as error:
        return _complain(str(error), error.exit_code)
    except BrokenPipeError:
        sys.stderr.close()  # whoever read our output is gone; nothing more can be said
        return EXIT_LOST
    except Exception as error:  # noqa: BLE001 - the last frame: a person gets one line
        if hasattr(error, "format_message"):  # click's own: a wrong argument or option
            return _complain(f"{error.format_message()} See softloop --help.", EXIT_USAGE)
        return _complain(f"stopped by a fault of its own: {error!r}", EXIT_LOST)
    return code if isinstance(code, int) else EXIT_OK


def _complain(text: str, code: int) -> int:
    sys.stderr.write(f"softloop: {' '.join(text.split())}\n")
    return code


if __name__ == "__main__":
    main()
