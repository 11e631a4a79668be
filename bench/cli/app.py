"""The `bench` command: parses, calls, prints. What a command needs is imported when it runs."""

from __future__ import annotations

import os
import sys
import traceback
from pathlib import Path
from typing import Annotated, Any

import typer

from bench.cli.options import (
    ESTIMATORS_TOLD,
    RUNS,
    BenchOption,
    GravityOption,
    JsonOption,
    LatestRun,
    ModelOption,
    OutOption,
    ProcedureArgument,
    RuleOption,
    RunArgument,
    RunsOption,
    SkipOption,
    Sources,
    WireLogOption,
    WithEstimators,
    app,
)

DONE, NOT_DONE = 0, 2
CTRL_C = 130
"""What the command-line library makes of a Ctrl-C."""


def _print_version(asked: bool) -> None:
    if asked:
        from importlib import metadata

        print(f"bench {metadata.version('triaxial-bench')}")
        raise typer.Exit


@app.callback()
def _common(
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the program's version.", is_eager=True, callback=_print_version
        ),
    ] = False,
) -> None:
    """Calibrates triaxial accelerometer blocks on a dividing head."""


@app.command(epilog="Example: bench run calibration --bench my-bench.yaml --name unit-17")
def run(
    procedure: ProcedureArgument,
    bench: BenchOption = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Simulated instruments, virtual clock.")] = False,
    seed: Annotated[int, typer.Option(help="Random numbers of a dry run.", min=0)] = 1,
    name: Annotated[str | None, typer.Option(help="Name of the run (default: procedure and time).")] = None,
    operator: Annotated[str, typer.Option(help="Who stands at the bench, for the record.")] = "",
    model: ModelOption = None,
    wire_log: WireLogOption = None,
    follow: Annotated[
        bool, typer.Option("--follow", help="Then diagnose, and run at once what would tell more.")
    ] = False,
    json: JsonOption = None,
    runs: RunsOption = RUNS,
) -> int:
    """Run a procedure on the bench, or dry on simulated instruments; then calibrate, verify, report."""
    from bench.cli import execute

    request = execute.Request(
        procedure, bench, dry_run, seed, name, operator, model, runs, wire_log, json, follow
    )
    return execute.run(request)


@app.command(epilog="Example: bench resume unit-17")
def resume(
    name: LatestRun = None,
    wire_log: WireLogOption = None,
    json: JsonOption = None,
    runs: RunsOption = RUNS,
) -> int:
    """Go on with an interrupted run at the first point without a reading."""
    from bench.cli import execute

    return execute.resume(name, runs, wire_log, json)


@app.command(epilog="Example: bench abort unit-17")
def abort(name: LatestRun = None, runs: RunsOption = RUNS) -> int:
    """End an interrupted run for good; its record is kept."""
    from bench.cli import execute

    return execute.abort(name, runs)


@app.command(epilog='Example: bench control unit-17 skip "the cable came loose"')
def control(
    run: RunArgument,
    wish: Annotated[str, typer.Argument(help="pause, continue, redo (the point), redo-pass, skip, abort.")],
    reason: Annotated[str, typer.Argument(help="Why; a skip needs it.")] = "",
    runs: RunsOption = RUNS,
) -> int:
    """Ask something of a run that another program is carrying out; typed at a prompt it is :pause, :redo, …"""
    from bench.cli import execute

    return execute.control(run, wish, reason, runs)


@app.command(epilog="Example: bench check calibration --bench my-bench.yaml")
def check(
    procedure: ProcedureArgument,
    bench: BenchOption = None,
    json: JsonOption = None,
    every_step: Annotated[
        bool, typer.Option("--all", help="List each step, not runs of equal ones.")
    ] = False,
    instruments: Annotated[
        bool, typer.Option("--instruments", help="Then open the bench's instruments, too.")
    ] = False,
    runs: RunsOption = RUNS,
) -> int:
    """Validate a procedure against a bench and print steps, time and operator actions; touch no instrument."""
    from bench.cli import check as command

    status = command.check(procedure, bench, json, every_step=every_step, runs=runs)
    if not instruments:
        return status
    from bench.cli import instruments as live

    return max(status, live.look(bench, None, None))


@app.command(epilog="Example: bench runs")
def runs(runs: RunsOption = RUNS, json: JsonOption = None) -> int:
    """List the runs, what became of them, and how to go on."""
    from bench.cli import records

    return records.runs(runs, json)


@app.command(epilog="Example: bench show unit-17 --verify")
def show(
    run: RunArgument,
    verify: Annotated[bool, typer.Option("--verify", help="Check the record for changed lines.")] = False,
    runs: RunsOption = RUNS,
    json: JsonOption = None,
) -> int:
    """Show what a run holds: inputs, events, readings."""
    from bench.cli import records

    return records.show(run, runs, json, check=verify)


@app.command(epilog="Example: bench export unit-17 --csv readings.csv")
def export(
    run: RunArgument,
    csv: Annotated[str, typer.Option("--csv", metavar="FILE", help="File; - is standard output.")],
    runs: RunsOption = RUNS,
) -> int:
    """Write the readings of a run as a readings file."""
    from bench.cli import records

    return records.export(run, runs, csv)


@app.command("import", epilog="Example: bench import readings.csv --name unit-17-by-hand")
def import_(
    file: Annotated[Path, typer.Argument(help="Readings file.")],
    name: Annotated[str | None, typer.Option(help="Name of the run (default: the file's).")] = None,
    bench: BenchOption = None,
    runs: RunsOption = RUNS,
) -> int:
    """Make a run of a readings file that was measured elsewhere."""
    from bench.cli import records

    return records.import_file(file, name, bench, runs)


@app.command(
    cls=WithEstimators,
    epilog="Example: bench calibrate readings.csv --bench my-bench.yaml --json coefficients.json",
)
def calibrate(
    sources: Sources,
    estimator: Annotated[
        str,
        typer.Option(help=ESTIMATORS_TOLD),
    ] = "gls",
    nominal_angles: Annotated[
        bool, typer.Option("--nominal-angles", help="Target angles in place of those read back.")
    ] = False,
    join_free: Annotated[
        bool,
        typer.Option("--join-free/--no-join-free", help="Free positions (F) join the fit by |a| = 1 g."),
    ] = True,
    join_verification: Annotated[
        bool,
        typer.Option("--join-verification", help="So do verification points; they check nothing then."),
    ] = False,
    bench: BenchOption = None,
    model: ModelOption = None,
    g: GravityOption = None,
    json: JsonOption = None,
    out: OutOption = None,
    skip_bad_rows: SkipOption = False,
    strict: Annotated[bool, typer.Option("--strict", help="Lack of fit (p < 0.01) is not accepted.")] = False,
    runs: RunsOption = RUNS,
) -> int:
    """Coefficients with uncertainty from runs or readings files."""
    from bench.cli import analyse

    request = analyse.Request(sources, runs, bench, model, g, out, skip_bad_rows)
    fitting = analyse.Fitting(estimator, nominal_angles, join_free, join_verification)
    return analyse.calibrate(request, fitting, json, strict=strict)


@app.command(epilog="Example: bench verify unit-17 --coefficients last-year.json")
def verify(
    sources: Sources,
    coefficients: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Result of 'calibrate --json' of another day.")
    ] = None,
    limit: Annotated[
        float | None, typer.Option(help="Limit of |Δg| in g, in place of the bench file's.")
    ] = None,
    rule: RuleOption = None,
    bench: BenchOption = None,
    model: ModelOption = None,
    g: GravityOption = None,
    json: JsonOption = None,
    out: OutOption = None,
    skip_bad_rows: SkipOption = False,
    runs: RunsOption = RUNS,
) -> int:
    """Δg at the verification points against the limit; exit status 1 when one is outside."""
    from bench.cli import analyse

    request = analyse.Request(sources, runs, bench, model, g, out, skip_bad_rows)
    return analyse.verify(request, coefficients, limit, json, rule=rule or "simple")


@app.command(epilog="Example: bench report unit-17")
def report(
    source: Annotated[str, typer.Argument(help="Run (name or path) or readings file.")],
    bench: BenchOption = None,
    model: ModelOption = None,
    g: GravityOption = None,
    json: JsonOption = None,
    out: OutOption = None,
    skip_bad_rows: SkipOption = False,
    runs: RunsOption = RUNS,
) -> int:
    """Write the report of a run: one HTML page."""
    from bench.cli import analyse

    return analyse.report(analyse.Request([source], runs, bench, model, g, out, skip_bad_rows), json)


@app.command(epilog="Example: bench simulate --bench my-bench.yaml --port 5025 --ready-file ready.json")
def simulate(
    command: Annotated[
        str | None,
        typer.Argument(help="With --control: what to do on a bench that is served, such as 'turn 45 deg'."),
    ] = None,
    bench: BenchOption = None,
    model: ModelOption = None,
    seed: Annotated[int, typer.Option(help="Random numbers of the simulated bench.", min=0)] = 1,
    speed: Annotated[float, typer.Option(help="How many times faster than real time it goes.")] = 1.0,
    host: Annotated[str, typer.Option(help="Address to listen on; loopback keeps others out.")] = "127.0.0.1",
    port: Annotated[
        int | None, typer.Option(help="First TCP port, the others follow (default: free ones).")
    ] = None,
    ready_file: Annotated[
        Path | None,
        typer.Option(
            "--ready-file", metavar="FILE", help="JSON with all addresses, once everything listens."
        ),
    ] = None,
    no_pty: Annotated[bool, typer.Option("--no-pty", help="TCP alone, no pseudo-terminals.")] = False,
    control: Annotated[
        str | None,
        typer.Option("--control", metavar="HOST:PORT", help="Send COMMAND to a bench that is served."),
    ] = None,
) -> int:
    """Serve the simulated instruments of a bench file until Ctrl-C, or command a bench that is served."""
    from bench.cli import simulate as served

    if control is not None or command is not None:
        return served.command(control, command)
    return served.serve(served.Request(bench, model, seed, speed, host, port, ready_file, not no_pty))


@app.command(epilog="Example: bench instruments --bench my-bench.yaml")
def instruments(
    bench: BenchOption = None,
    discover: Annotated[
        bool, typer.Option("--discover", help="List what the interfaces offer; address no instrument.")
    ] = False,
    json: JsonOption = None,
    wire_log: WireLogOption = None,
) -> int:
    """Open every instrument of a bench at once: identity, self-test, a reading, and all that is wrong."""
    from bench.cli import instruments as command

    return command.offers(json) if discover else command.look(bench, json, wire_log)


@app.command(epilog="Example: bench init my-lab")
def init(folder: Annotated[Path, typer.Argument(help="Folder to write into.")] = Path()) -> int:
    """Write copies of the shipped procedures and bench files, to edit."""
    from bench.cli import check as command

    return command.init(folder)


# imported here so that its commands stand after those above in the help
import bench.cli.diagnose  # noqa: E402
import bench.cli.history_options  # noqa: E402
import bench.cli.uncertainty_options  # noqa: E402, F401


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit with its status; every mistake is a clear line on standard error."""
    given = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in given
    try:
        status = app([a for a in given if a != "--debug"] or ["--help"], standalone_mode=False)
        if status == CTRL_C:
            status = _fail("stopped by Ctrl-C")
    except KeyboardInterrupt:
        status = _fail("stopped by Ctrl-C")
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = NOT_DONE
    except typer.Abort:
        status = _fail("stopped")
    except Exception as error:
        if debug:
            traceback.print_exc()
        status = _fail(explain(error))
    sys.exit(status if isinstance(status, int) else DONE)


def explain(error: Exception) -> str:
    """Return the sentence for an error; one that nobody foresaw says how to see more."""
    if isinstance(error, typer.TyperException) or expected(error):
        return str(error)
    if isinstance(error, OSError):
        return f"{error.filename or 'a file'}: {error.strerror or error}"
    return f"unexpected {type(error).__name__}: {error}; run again with --debug and report what it shows"


def expected(error: Exception) -> bool:
    """Whether an error was made to be read by a person."""
    from bench.analysis.calibration import CalibrationError
    from bench.cli import CommandError
    from bench.files.bench.file import FileMistakes
    from bench.readings.csv import ReadingsError
    from bench.run.record import RecordError
    from drivers.interfaces import BenchError

    kinds: tuple[Any, ...] = (
        FileMistakes, CalibrationError, CommandError, ReadingsError, RecordError, BenchError,
    )  # fmt: skip
    return isinstance(error, kinds)


def _fail(text: str) -> int:
    print(f"bench: {text}", file=sys.stderr)
    return NOT_DONE
