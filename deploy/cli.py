# ruff: noqa: PLC0415 - every command imports what it needs, and no other command pays for it
"""The command line. Everything heavy is imported inside the commands, so that `softloop --help` and each process start fast."""

from __future__ import annotations

import sys
from math import inf
from pathlib import Path
from typing import Annotated, Literal

import typer

from softloop.deploy.cli_app import EXIT_CODES, BenchArgument, OptionalBench, RunArgument, RunDir, app, log_app, number
from softloop.deploy.interrupts import careful_interrupts
from softloop.wire.errors import EXIT_LOST, EXIT_OK, EXIT_USAGE, BadConfig, SoftloopError


@app.command(epilog=EXIT_CODES)
def run(
    bench: BenchArgument,
    run_dir: Annotated[Path | None, typer.Option(metavar="DIR", help="Default: runs/<bench>-<UTC time>.")] = None,
    host: Annotated[str | None, typer.Option(metavar="NAME", help="Of a bench on several hosts: which of them this is.")] = None,
    duration: Annotated[float | None, number(metavar="S", min=0.0, help="End after S seconds, armed.")] = None,
    no_report: Annotated[bool, typer.Option("--no-report", help="Leave out the report at the end.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show nothing but errors.")] = False,
    page: Annotated[bool, typer.Option("--page", help="Serve the live page while the rig runs.")] = False,
    foxglove: Annotated[bool, typer.Option("--foxglove", help="Serve the channels to Foxglove while the rig runs.")] = False,
    pace: Annotated[
        Literal["wall", "lockstep"] | None,
        typer.Option(help="Instead of the bench file's: by the clock, or tick by tick."),
    ] = None,
    faults: Annotated[
        Path | None,
        typer.Option(metavar="SCENARIO.toml", help="Let things go wrong, and judge how that ends; see `softloop faults`."),
    ] = None,
    certificate: Annotated[
        Path | None, typer.Option(metavar="FILE", help="What `softloop doctor --certificate` wrote: into the log.")
    ] = None,
) -> int:
    """Run a bench: start its processes, arm, watch, vent, stop, summary and report."""
    from softloop.deploy.bench import find_bench
    from softloop.deploy.launcher import Options, launch

    report = False if no_report else None
    options = Options(
        run_dir=run_dir, duration_s=duration, report=report, quiet=quiet, pace=pace, page=page, foxglove=foxglove,
        certificate=certificate, host=host,
    )  # fmt: skip
    if faults is not None:
        from softloop.deploy.faults import run_with_faults

        return run_with_faults(find_bench(bench), faults, options)
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
    from softloop.deploy.hosts import shares
    from softloop.deploy.node import processes_of
    from softloop.deploy.prepare import check_controller, check_identity

    loaded = load_bench(find_bench(bench))
    trajectory_s = check_controller(loaded)
    check_identity(loaded)
    names = ", ".join(p.name for p in processes_of(loaded)) or "no process"
    where = "".join(f"; host {host}: {', '.join(processes)}" for host, processes in shares(loaded).items())
    print(f"{bench}: good. Bench '{loaded.name}': {names}; trajectory {trajectory_s:.1f} s{where}")
    return EXIT_OK


@app.command()
def request(
    bench: BenchArgument,
    action: Annotated[
        Literal["arm", "disarm", "stop", "fault", "mend"],
        typer.Argument(help="stop: emergency stop, FAULT until armed again. fault, mend: of a simulated rig."),
    ],
    kind: Annotated[
        str, typer.Argument(metavar="[KIND]", help="What breaks or is mended, as in [[plant.faults]]; mend: default all.")
    ] = "",
    size: Annotated[float, number(metavar="X", help="Of a fault that has one.")] = 0.0,
    seconds: Annotated[float, number("--for", metavar="S", help="How long it stays. Default: until mended.")] = 0.0,
    timeout: Annotated[float, number(metavar="S", min=0.1, help="How long to wait for the answer.")] = 5.0,
) -> int:
    """Ask the gate of a running bench to arm, disarm or stop, or its simulated rig to break, and report the answer."""
    from softloop.deploy.bench import find_bench, load_bench
    from softloop.deploy.fault_requests import request_fault
    from softloop.deploy.gate_requests import request_once

    loaded = load_bench(find_bench(bench))
    if action == "fault" or action == "mend":
        asked = {"action": "break" if action == "fault" else "mend", "kind": kind, "size": size, "duration_s": seconds}
        return request_fault(loaded, asked, timeout)
    if kind or size or seconds:
        raise BadConfig(f"request {action}: KIND, --size and --for go with fault and mend")
    return request_once(loaded, action, timeout)


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


@log_app.command("invariants")
def log_invariants(run: RunArgument, as_json: Annotated[bool, typer.Option("--json", help="The answer as JSON.")] = False) -> int:
    """Judge a log by the invariants that the monitor watches; exit code 1 when one does not hold."""
    from softloop.deploy.log_invariants import check_invariants

    return check_invariants(run, as_json=as_json)


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


@app.command()
def plot(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run directory, or a log in it.")],
    curves: Annotated[list[str], typer.Argument(metavar="CHANNEL.FIELD...", help="Such as cycle.angle_deg or cycle.theta[8].")],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A file ending in .svg, .pdf or .png. Default: plot.svg beside the log.")
    ] = None,
    first: Annotated[float | None, number("--from", metavar="S", help="From S seconds after the start of the log.")] = None,
    last: Annotated[float | None, number("--to", metavar="S", help="Until then.")] = None,
) -> int:
    """Draw fields of a log against time, one panel per unit."""
    from softloop.deploy.plotting import plot_run

    return plot_run(run, curves, out, -inf if first is None else first, inf if last is None else last)


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
    seconds: Annotated[float | None, number(metavar="S", min=0.1, help="End after S seconds.")] = None,
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
    rate: Annotated[float | None, number(metavar="HZ", min=0.01, help="At most so many a second, each the newest.")] = None,
    timeout: Annotated[float, number(metavar="S", min=0.0, help="Exit code 4 after S seconds without one; 0: wait.")] = 0.0,
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
def router(
    bench: BenchArgument,
    program: Annotated[
        Literal["auto", "zenohd", "softloop"],
        typer.Option("--with", help="auto: zenohd where it is installed, else softloop itself."),
    ] = "auto",
    lifeline_fd: Annotated[int | None, typer.Option(hidden=True)] = None,
) -> int:
    """Be the meeting point of a bench until Ctrl-C, for benches with `[run] shared_router = true`."""
    from softloop.deploy.bench import find_bench, load_bench
    from softloop.deploy.router import run_router
    from softloop.deploy.signals import stop_on_signals
    from softloop.deploy.zenohd import find_zenohd
    from softloop.wire.shell import watch_lifeline

    with stop_on_signals() as stop:
        if lifeline_fd is not None:
            watch_lifeline(lifeline_fd, stop)
        run_router(load_bench(find_bench(bench)), stop, find_zenohd(program))
    return EXIT_OK


@app.command()
def keys(
    bench: BenchArgument,
    renew: Annotated[bool, typer.Option("--renew", help="Make anew what is there.")] = False,
    only: Annotated[list[str] | None, typer.Option(metavar="NAME", help="This one alone; several by giving it again.")] = None,
    authority: Annotated[bool, typer.Option("--authority", help="With --renew: the authority too; older keys are void.")] = False,
    days: Annotated[int | None, typer.Option(metavar="N", min=1, max=3650, help="Instead of [zenoh.tls] valid_days.")] = None,
) -> int:
    """Make the certificate authority and the identities of a bench with [zenoh.tls]; what is there stays, unless --renew."""
    from softloop.deploy.keys import make_keys

    if authority and (not renew or only):
        raise BadConfig("keys: --authority goes with --renew, and makes everybody's keys anew")
    return make_keys(bench, renew=renew, only=only or (), authority=authority, days=days)


@app.command(hidden=True)
def prepare(bench: BenchArgument, run_dir: RunDir) -> int:
    """The launcher's helper: compile, check, and put parameters into the run's directory; JSON lines on standard output."""
    from softloop.deploy.bench import load_bench
    from softloop.deploy.prepare import prepare_as_child

    prepare_as_child(load_bench(bench, run_dir), run_dir)
    return EXIT_OK


# After these in the list of commands; each enters itself.
import softloop.deploy.cli_campaigns  # noqa: E402
import softloop.deploy.cli_devices  # noqa: E402
import softloop.deploy.cli_experiments  # noqa: E402
import softloop.deploy.cli_machine  # noqa: E402, F401


def main(arguments: list[str] | None = None) -> None:
    """The entry point: every error is one line on standard error, and a documented exit code."""
    given = sys.argv[1:] if arguments is None else arguments
    sys.exit(_run(given or ["--help"]))


def _run(arguments: list[str]) -> int:
    try:
        with careful_interrupts():
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
