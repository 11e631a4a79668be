"""run: a procedure carried out on a bench or dry, recorded, then calibrated, verified and reported."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from bench.cli import printing
from bench.cli.options import (
    RUNS,
    AnswersOption,
    BenchOption,
    GuardBandOption,
    JsonOption,
    LimitOption,
    ModelOption,
    PanelOption,
    ProcedureArgument,
    RuleOption,
    RunsOption,
    UntilOption,
    WireLogOption,
    app,
)
from bench.cli.panel import link_to
from bench.services.errors import Refused

if TYPE_CHECKING:
    from rich.console import Console

    from bench.run.events import VerdictAsked
    from bench.run.folder import Run
    from bench.run.listening import Interrupts
    from bench.services.source import Source

_MADE: Final = ("calibrate.json", "verify.json", "report.html", "chart.json")
"""What may be made of a finished run."""


@app.command(epilog="Example: bench run calibration --bench my-bench.yaml --name unit-17")
def run(
    procedure: ProcedureArgument,
    bench: BenchOption = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Simulated instruments, virtual clock.")] = False,
    seed: Annotated[int, typer.Option(help="Random numbers of a dry run.", min=0)] = 1,
    name: Annotated[str | None, typer.Option(help="Name of the run (default: procedure and time).")] = None,
    operator: Annotated[str, typer.Option(help="Who stands at the bench, for the record.")] = "",
    unit: Annotated[
        str | None,
        typer.Option(metavar="SERIAL", help="Serial number of the block, in place of the bench file's."),
    ] = None,
    limit: LimitOption = None,
    rule: RuleOption = None,
    guard_band: GuardBandOption = None,
    model: ModelOption = None,
    until: UntilOption = None,
    wire_log: WireLogOption = None,
    check_block: Annotated[
        bool, typer.Option("--check-block", help="Hold a dry run, too, to the check block of the bench file.")
    ] = False,
    despite_check: Annotated[
        str | None,
        typer.Option(metavar="REASON", help="Begin whatever the check block says; the record keeps why."),
    ] = None,
    follow: Annotated[
        bool, typer.Option("--follow", help="Then diagnose, and run at once what would tell more.")
    ] = False,
    answers: AnswersOption = None,
    panel: PanelOption = False,
    json: JsonOption = None,
    runs: RunsOption = RUNS,
) -> int:
    """Run a procedure on the bench, or dry on simulated instruments; then calibrate, verify, report."""
    printing.check_target(json)
    if follow and json is not None:
        raise Refused(
            "--follow makes two runs, and --json is the result of one; the folders of both hold theirs"
        )
    if not (bench or os.environ.get("BENCH_FILE") or dry_run):
        raise Refused(
            "a run on real instruments needs a bench file: say --bench FILE (or set BENCH_FILE), "
            "or try it first with --dry-run"
        )
    if model is not None and not dry_run:
        raise Refused("--model says what the simulated bench contains; it goes with --dry-run")

    away = is_away(answers, panel=panel)
    asked_for = procedure
    if follow and away:
        raise Refused("--follow asks at the terminal before it measures further: it wants --answers terminal")

    verdict: VerdictAsked | None = None
    if (limit, rule, guard_band) != (None, None, None):
        from bench.services.bench_selection import find_bench_file
        from bench.services.verification import Asked, judgement_of

        asked = Asked(limit, rule, guard_band)
        judgement_of(find_bench_file(bench).file, asked)
        verdict = asked.recorded()

    def carried_out(procedure: str, name: str | None, seed: int) -> tuple[Run, int]:
        from bench.run.folder import Run
        from bench.run.listening import Interrupts, WishListener
        from bench.run.person import ControlFile
        from bench.services.execution import carry_out, new_run
        from bench.services.heard import heard_in
        from drivers.wire.replay import logged_wire

        new = new_run(
            procedure,
            bench,
            runs,
            dry_run=dry_run,
            seed=seed,
            name=name,
            operator=operator,
            unit=unit,
            model=model,
            verdict=verdict,
            living=dry_run and (panel or answers is not None),
            until=until or () if procedure == asked_for else (),
            check_block=check_block,
            despite_check=despite_check,
        )
        out = printing.console(json=json)
        if json != "-":
            out.print(f"bench file: {new.manifest['bench']}, {new.manifest['bench_why']}")
        printing.notes_on(out, new.notes)
        if panel:
            out.print(f"panel: {link_to(new.folder.name, runs)}", soft_wrap=True)
        with Interrupts() as interrupts:
            with logged_wire(wire_log) as wire, WishListener(ControlFile(new.folder)) as wishes:
                record = new.record(interrupts.shield)
                begun = Run(new.folder)
                heard = heard_in(begun, record, None, wishes, out, away=away)
                carry_out(begun, record, None, wire, out, interrupts, heard)
            done = Run(new.folder)
            return done, make_results(done, json, interrupts)

    done, status = carried_out(procedure, name, seed)
    if not follow:
        return status
    from bench.cli.following import follow as measure_further

    # a dry run draws another stand for the mountings to come
    return max(
        status, measure_further(done, lambda further, called: carried_out(further, called, seed + 1)[1])
    )


def charted(run: Run, out: Console) -> int:
    """Put a run of the check block on its chart, and say and write what that shows; 1 where it is out of control.

    Of any other run there is nothing to say. Where no chart can be made, that is said: the run is finished.
    """
    from bench.services.bench_selection import own_bench

    bench, path = own_bench(run)
    unit = run.manifest.get("unit_under_test")
    if bench.check_block is None or unit is None:
        return 0
    from bench.base.files import to_text
    from bench.cli.chart import print_chart
    from bench.services.check_block import chart_of, check_block_runs, is_check_block

    if not is_check_block(bench, unit):
        return 0
    runs = check_block_runs(bench, run.folder.parent, simulated=run.simulated)
    try:
        chart = chart_of(runs, bench.check_block, of_bench=path, folder=run.folder.parent)
    except Refused as reason:
        out.print(f"the run is finished; no control chart: {reason}")
        return 0
    print_chart(chart, out)
    if printing.write_beside(run.folder / "chart.json", to_text(chart.to_dict()), asked=False):
        out.print(
            f"chart: {run.folder / 'chart.json'} (bench chart {run.folder.parent} --page FILE draws it)"
        )
    return 0 if chart.accepted else 1


def is_away(answers: str | None, *, panel: bool) -> bool:
    """Whether questions are answered in the run's folder alone. Raises `Refused` for a place that is none.

    With a `panel`, and no terminal to type at, they are.
    """
    if answers not in (None, "terminal", "folder"):
        raise Refused(f"--answers {answers}: questions are answered at the terminal or in the folder")
    return answers == "folder" or (panel and answers is None and not sys.stdin.isatty())


def make_results(run: Run, target: str | None, interrupts: Interrupts) -> int:
    """Conclude a run whose bench is safe; `resume` does so again after a signal. Raises `Refused` for one."""
    kept = f"all readings are kept in {run.folder}"
    again = f"stopped before the results were made; {kept}, and 'bench resume {run.name}' makes the results"
    try:
        interrupts.release(again)
        return conclude(run, target)
    except KeyboardInterrupt:
        raise Refused(again if run.results_missing else f"stopped; {kept} with their results") from None


def conclude(run: Run, target: str | None = None) -> int:
    """Calibrate, verify and report a finished run; 1 where one of them or a check is not accepted.

    `target` is where the whole result goes as JSON: null stands for a calibration or verdict that is not.

    A procedure need not be a calibration: where its readings do not make one, that is said and no mistake.
    """
    from bench.base.files import to_text, write_whole
    from bench.run.folder import RESULTS
    from bench.services.source import Request, load_sources

    (source,) = load_sources(Request([str(run.folder)], run.folder.parent))
    try:
        status = max(_draw(run, source, target), charted(run, printing.console(json=target)))
        made = [name for name in _MADE if (run.folder / name).is_file()]
        write_whole(run.folder / RESULTS, to_text({"made": made}))
    except OSError as error:
        raise Refused(
            f"{error.filename}: cannot be written ({error.strerror}); the run is finished and kept: free the disk, "
            f"then 'bench resume {run.name}' makes its results"
        ) from error
    return status


def _draw(run: Run, source: Source, target: str | None) -> int:
    """Draw the results from a finished run and write them into its folder. Raises `OSError`."""
    from bench.base.files import to_text, write_whole
    from bench.calibration import CalibrationError
    from bench.services.calibration import calibration_of
    from bench.services.diagnosis import told_in_words
    from bench.services.until import is_short

    out = printing.console(json=target)
    short = is_short(run)
    for line in told_in_words(run):
        out.print(f"look: {line}")
    drawn: dict[str, Any] = {
        "run": run.name,
        "folder": str(run.folder),
        "calibration": None,
        "verification": None,
    }
    try:
        result = calibration_of(source)
    except CalibrationError as reason:
        out.print(f"the run is finished; no calibration from it: {reason}")
        printing.write_json([drawn], target)
        return 1 if short else 0
    file = source.output("calibrate", ".json")
    printing.calibration(result, file, out)
    drawn["calibration"] = result.to_dict()
    write_whole(file, to_text(drawn["calibration"]))
    verdict, _ = printing.report(result, out)
    if verdict is None:
        out.print("no verification points in this procedure: no verdict")
    else:
        file = source.output("verify", ".json")
        drawn["verification"] = verdict.to_dict()
        write_whole(file, to_text(drawn["verification"]))
        printing.verification(verdict, file, out)
    if short:
        out.print(
            f"NOT REACHED: {', '.join(run.manifest.get('until', ()))}; the procedure has no more that would help"
        )
    printing.write_json([drawn], target)
    return 0 if not short and result.accepted and (verdict is None or verdict.passed) else 1
