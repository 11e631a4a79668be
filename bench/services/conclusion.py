"""Results of finished runs, stored in the run's folder and shown at its end; export and import of readings."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from bench.base.computing import quiet, versions
from bench.base.files import read_given, read_regular, to_text, write_whole
from bench.base.languages import message
from bench.base.text import as_typed
from bench.base.yaml_files import load_validated
from bench.calibration import CalibrationError
from bench.calibration.conformity import Statement
from bench.calibration.result import FaultyReadings, SpoiledFit
from bench.config.shipped import CONFIG, PROCEDURES, shipped_folder
from bench.readings.csv import format_csv, read_csv
from bench.results.calibration import fit_in_a_line
from bench.results.verification import basis_in_words, outcome_in_words
from bench.run.events import Manifest, RecordError
from bench.run.folder import BENCH, IMPORTED, RESULTS, Run, checked_name
from bench.run.interrupts import Interrupts
from bench.run.record import Record
from bench.services.bench_selection import SUFFIX, BenchTaken, bench_of, is_told, origin_beside, own_bench
from bench.services.calibration import CalibrationResult, calibration_of, report_page
from bench.services.errors import Refused, refusing
from bench.services.requests import measuring as asked
from bench.services.requests.shared import (
    devices_to_type,
    name_to_type,
    resume_to_type,
    runs_folder,
    runs_to_type,
)
from bench.services.source import Request, Source, load_sources
from bench.services.verification import VerdictOptions, VerificationResult
from drivers.clock import utc_now

if TYPE_CHECKING:
    from bench.config.foreign_log import ConvertedLog
    from bench.results.control_chart import CheckBlockChart

_MADE: Final = ("calibrate.json", "verify.json", "report.html", "chart.json")
"""Names of the result files that may be made from a finished run."""


@dataclass(frozen=True)
class Conclusion:
    """The results of a finished run; a missing result is None.

    `looks` are sentences on early warnings. `short` is true if the run ended without reaching its goals.
    `no_calibration` and `no_chart` are the reasons for a missing calibration or chart. `spoiled` is true if wrong
    readings, not the procedure, are the reason for a missing calibration, and `findable` if a diagnosis can find
    them. Only a run of the check block can have a chart or `no_chart`. `chart_unwritten` is the chart's file, if
    unwritten, and the reason.
    """

    run: Run
    source: Source
    looks: tuple[str, ...]
    short: bool
    calibration: CalibrationResult | None = None
    verification: VerificationResult | None = None
    report: Path | None = None
    no_calibration: str = ""
    spoiled: bool = False
    findable: bool = False
    chart: CheckBlockChart | None = None
    no_chart: str = ""
    chart_unwritten: str = ""

    @property
    def diagnosable(self) -> bool:
        """Whether a diagnosis may find why there is no calibration: wrong readings or early warnings."""
        return bool(self.no_calibration and (self.findable or (self.looks and not self.spoiled)))

    @property
    def accepted(self) -> bool:
        """Whether the run reached its goal unspoiled, and fit, verdict and chart (if present) are accepted."""
        judged = (
            self.calibration and self.calibration.accepted,
            self.verification and self.verification.passed,
        )
        return not (self.short or self.spoiled) and all(
            one is not False for one in (*judged, self.chart and self.chart.accepted)
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the result as `bench run --json` writes it, with null for a missing calibration or verdict."""
        return {
            "run": self.run.name,
            "folder": str(self.run.folder),
            "calibration": self.calibration and self.calibration.to_dict(),
            "verification": self.verification and self.verification.to_dict(),
        }


def make_results(run: Run, interrupts: Interrupts) -> Conclusion:
    """Compute and write a finished run's results. Raises `Refused` if a signal or an `OSError` stops it."""
    kept = message(f"all readings are kept in {run.folder}")
    again = message(
        f"stopped before the results were ready; {kept}, and 'bench resume {resume_to_type(run.folder)}' computes "
        "the results"
    )
    try:
        interrupts.release(again)
        return conclude(run)
    except KeyboardInterrupt:
        raise Refused(
            again if run.results_missing else message(f"stopped; {kept} with their results")
        ) from None


def conclude(run: Run) -> Conclusion:
    """Calibrate, verify, report and chart a finished run; write the results into its folder. Raises `Refused`."""
    (source,) = load_sources(Request([str(run.folder)], run.folder.parent))
    remedy = message(
        "the run is finished and kept; free disk space or make the folder writable, then "
        f"'bench resume {resume_to_type(run.folder)}' computes its results"
    )
    with refusing(remedy):
        found = {**_evaluated(source), **charted(run)}
        concluded = Conclusion(run, source, _looks(run), _is_short(run), **found)
        made = [name for name in _MADE if (run.folder / name).is_file()]
        why = {"no_calibration": concluded.no_calibration, "diagnosable": concluded.diagnosable}
        write_whole(
            run.folder / RESULTS, to_text({"made": made, **(why if concluded.no_calibration else {})})
        )
    return concluded


def _looks(run: Run) -> tuple[str, ...]:
    if not run.history.progress.signs:
        return ()
    from bench.services.bodies import told_in_words  # takes long to import: the whole diagnosis

    return tuple(told_in_words(run))


def _is_short(run: Run) -> bool:
    try:
        chosen = run.history.progress.chosen
    except RecordError:
        return False
    if not chosen:
        return False
    from bench.planning.choice import REACHED  # takes long to import

    return chosen[-1]["stop"] not in ("", REACHED) and bool((chosen[-1]["now"] or {}).get("asked"))


def _evaluated(source: Source) -> dict[str, Any]:
    """Calibrate, verify and report the readings; return members of a `Conclusion`. Raises `OSError`."""
    try:
        result = calibration_of(source)
    except CalibrationError as reason:
        kind = {"spoiled": isinstance(reason, FaultyReadings), "findable": isinstance(reason, SpoiledFit)}
        return {"no_calibration": str(reason), **kind}
    write_whole(source.output("calibrate", ".json"), to_text(result.to_dict()))
    page, verdict = report_page(result)
    file = source.output("report", ".html")
    write_whole(file, page)
    if verdict is not None:
        write_whole(source.output("verify", ".json"), to_text(verdict.to_dict()))
    return {"calibration": result, "verification": verdict, "report": file}


def charted(run: Run) -> dict[str, Any]:
    """Return the control chart of a check-block run as members of a `Conclusion`; {} for any other run."""
    bench, path = own_bench(run)
    unit = run.manifest.get("unit_under_test")
    if bench.check_block is None or unit is None:
        return {}
    from bench.services.check_block import chart_of, check_block_runs, is_check_block  # takes long to import

    if not is_check_block(bench, unit):
        return {}
    runs = check_block_runs(bench, run.folder.parent, simulated=run.simulated)
    try:
        chart = chart_of(runs, bench.check_block, of_bench=path, folder=run.folder.parent)
    except Refused as reason:
        return {"no_chart": str(reason)}
    try:
        write_whole(run.folder / "chart.json", to_text(chart.to_dict()))
    except OSError as error:
        return {
            "chart": chart,
            "chart_unwritten": f"{os.fspath(run.folder / 'chart.json')} ({error.strerror})",
        }
    return {"chart": chart}


# --- the lines at the end of a run ----------------------------------------------------------------

MOST_LINES: Final = 15
"""Largest number of lines of an ending."""
_MOST_SENTENCES: Final = 2
NOTE: Final = message("note")


def ending(found: Conclusion) -> list[str]:
    """Return the lines shown at the end of a run: verdicts, their basis, notes, files, and the next step.

    The verdict on the check block, if any, comes before the verdict on the run.
    """
    chart = [] if found.chart is None else [found.chart.sentence()]
    lines = [*chart, _verdict(found), *_basis(found)]
    if found.no_chart:
        lines.append(message(f"check block: no control chart: {found.no_chart}"))
    lines += _shortened(
        [
            f"{NOTE}: {look}"
            for look in (*(found.calibration.doubts if found.calibration else ()), *found.looks)
        ],
        f"bench diagnose {name_to_type(found.run.folder)}",
    )
    return [*lines, *_files(found), *_next(found)]


def _verdict(found: Conclusion) -> str:
    name = message(f"{found.run.name} (SIMULATED)") if found.run.simulated else found.run.name
    if found.calibration is None:
        return message(f"{name}: MEASURED; no calibration from it: {found.no_calibration}")
    if not found.calibration.accepted:
        return message(f"{name}: NOT ACCEPTED: the model does not fit the readings")
    if found.verification is not None:
        return outcome_in_words(name, found.verification.verification)
    return message(f"{name}: CALIBRATED; no verdict, as the procedure has no verification points")


def _basis(found: Conclusion) -> Iterator[str]:
    if found.short:
        goals = ", ".join(found.run.manifest.get("until", ()))
        yield message(f"NOT REACHED: {goals}; no further point of the procedure would help")
    if found.calibration is not None:
        yield fit_in_a_line(found.calibration.calibration)
    if found.verification is None:
        return
    if found.calibration is not None and not found.calibration.accepted:
        yield outcome_in_words(message("verification points"), found.verification.verification)
    yield basis_in_words(found.verification.verification)
    if not found.verification.passed:
        yield from found.verification.sentences[:_MOST_SENTENCES]


def _shortened(lines: list[str], elsewhere: str) -> list[str]:
    rest = len(lines) - _MOST_SENTENCES
    return (
        lines
        if rest <= 1
        else [*lines[:_MOST_SENTENCES], message(f"note: {rest} more notes; '{elsewhere}' explains them")]
    )


def _files(found: Conclusion) -> Iterator[str]:
    folder, name = found.run.folder, name_to_type(found.run.folder)
    yield message(f"readings: {len(found.source.readings)}, kept in {folder}")
    if found.report is not None:
        count = len(found.calibration.notes) if found.calibration is not None else 0
        if count and not quiet.get():
            yield message(f"report: {found.report} (with {count} note{'' if count == 1 else 's'})")
        else:
            yield message(f"report: {found.report}")
        yield message(f"coefficients: {folder / 'calibrate.json'} ('bench calibrate {name}' prints them)")
    if found.chart is not None and not found.chart_unwritten:
        yield message(
            f"chart: {folder / 'chart.json'} ('bench chart {as_typed(folder.parent)} --page FILE' draws it)"
        )


def _next(found: Conclusion) -> Iterator[str]:
    run, name = found.run, name_to_type(found.run.folder)
    again = run_again(run)
    verification = found.verification
    if found.calibration is None:
        yield message(f"next: bench {'diagnose' if found.diagnosable else 'show'} {name}")
    elif (
        not found.calibration.accepted
        or found.calibration.doubts
        or (
            verification is not None
            and (verification.warnings or verification.statement in (Statement.MISFIT, Statement.FAIL))
        )
    ):
        yield message(f"next: bench diagnose {name}")
    elif verification is not None and verification.statement == Statement.NOT_COMPLETE:
        then = f"bench verify NEW --coefficients {as_typed(run.folder / 'calibrate.json')}"
        points = run_again(run, "verification") + " --dry-run" * run.simulated
        yield message(f"next: measure the verification points, {points}; then {then}")
    elif verification is not None and not verification.passed:
        yield message(f"next: {run_again(run, command='budget')}, which shows what makes U large")
    elif found.chart is not None and not found.chart.accepted:
        yield message(f"next: find the cause, then repeat the run: {again}")
    elif run.simulated:
        yield message(f"next: on real instruments: {again}{'' if ' --bench ' in again else ' --bench FILE'}")
    else:
        if verification is not None and found.chart is None:
            yield message(f"next: bench certificate {name}")
        yield message(f"next unit: {again} --unit SERIAL")


def run_again(run: Run, procedure: str | None = None, command: str = "run") -> str:
    """Return the command for `procedure`, else that of `run`, on the bench of `run` and into its folder of runs.

    It judges as `run` did, and has the same goals if the procedure is the same.
    """
    asked = run.manifest.get("bench_why") == "as asked for"
    bench = f" --bench {_typed(run.manifest['bench'], CONFIG)}" if asked else ""
    own = procedure or _typed(str(run.manifest.get("procedure", "PROCEDURE")), PROCEDURES)
    further = ""
    if command == "run":
        goals = () if procedure else run.manifest.get("until", ())
        judged = VerdictOptions.of_run(run)
        stated = {"limit": judged.limit_g, "rule": judged.rule, "guard-band": judged.guard_band}
        options = [("until", goal) for goal in goals] + [(n, v) for n, v in stated.items() if v is not None]
        further = "".join(f" --{name} {as_typed(value)}" for name, value in options)
        further += runs_to_type(run.folder.parent)
    return f"bench {command} {own}{bench}{further}{devices_to_type(run.folder)}"


def _typed(file: str, kind: str) -> str:
    """Return a file as a user may type it on the command line; a shipped file is typed by its name."""
    path = Path(file)
    return as_typed(path.stem if path.parent == shipped_folder(kind) else file)


# --- readings files ---------------------------------------------------------------------------------


class Exported(NamedTuple):
    """Exported readings: text, number of readings, and the paths of readings file and origin file (or None)."""

    text: str
    readings: int
    file: Path | None = None
    beside: Path | None = None


def export_readings(request: asked.ExportReadings) -> Exported:
    """Return the readings of a run as CSV; write the file unless its name is "-". Raises `Refused`."""
    (source,) = load_sources(Request([request.run], runs_folder(request.runs)))
    text = format_csv(source.as_read)
    if request.csv == "-":
        return Exported(text, len(source.readings))
    csv = Path(request.csv or f"{Path(request.run).resolve().name}.csv")
    beside = Path(f"{csv}{SUFFIX}")
    if beside.exists() and not is_told(beside):
        raise Refused(
            f"{beside}: this program did not write this file; export to another file with --csv FILE"
        )
    if request.csv is None and csv.exists() and not beside.exists():
        raise Refused(f"{csv}: exists; name another file with --csv FILE")
    write_whole(csv, text)
    if source.origin is None:
        return Exported(text, len(source.readings), csv)
    write_whole(beside, source.origin.text_beside(csv, text.encode()))
    return Exported(text, len(source.readings), csv, beside)


COLUMNS: Final = "columns.yaml"
"""The mapping by which a log was imported, in the run's folder."""


def _given(file: Path) -> bytes:
    """Return the content of a file, read only once because a pipe cannot be read again. Raises `Refused`."""
    with refusing("check name and permissions", file, reading=True):
        return read_given(file)


def _converted(request: asked.ImportReadings, content: bytes) -> ConvertedLog:
    from bench.config.foreign_log import LogColumns, convert_log

    assert request.columns is not None  # noqa: S101 - who converts has a mapping
    mapping = load_validated(request.columns, LogColumns)
    return convert_log(request.file, content, mapping, skip_bad_rows=request.skip_bad_rows)


def preview_log(request: asked.ImportReadings) -> ConvertedLog:
    """Return a log of another program converted as for an import. Raises the errors of `import_readings`."""
    if request.columns is None:
        raise Refused(
            "--preview shows how a log is read; name the mapping of its columns with --columns FILE"
        )
    return _converted(request, _given(request.file))


def check_preview(request: asked.ImportReadings, log: ConvertedLog) -> None:
    """Raise the errors that importing the converted `log` would raise (see `import_readings`)."""
    taken, _ = bench_of(str(request.file), None, origin_beside(request.file), request.bench)
    read_csv(request.file, taken.file.installation_models(), content=log.text.encode())


def import_readings(
    request: asked.ImportReadings, announce: Callable[[BenchTaken, Sequence[str]], None]
) -> Run:
    """Create a run from readings measured elsewhere; first call `announce` with the bench file and notes.

    Raises `Refused` for a file that cannot be read, `ReadingsError` for bad rows, `FileMistakes` for a mapping
    of columns with mistakes, `RecordError` for a name that is taken.
    """
    file = request.file
    content = _given(file)
    log = None if request.columns is None else _converted(request, content)
    content = content if log is None else log.text.encode()
    told = origin_beside(file)
    taken, notes = bench_of(str(file), None, told, request.bench)
    announce(taken, notes)
    path = Path(taken.where)
    readings = read_csv(file, taken.file.installation_models(), content=content)
    name = request.name or re.sub(r"[^\w.+-]", "-", file.stem)
    run = Run(runs_folder(request.runs) / checked_name(name))
    manifest: Manifest = {
        "name": run.name,
        "created": utc_now().isoformat(),
        "imported": str(file),
        "readings": len(readings),
        "bench": str(path),
        "bench_why": taken.why,
        "versions": versions(),
    }
    inputs = {IMPORTED: content, BENCH: read_regular(path)}
    if request.columns is not None:
        inputs[COLUMNS] = read_regular(request.columns)
    if told.origin is not None:
        manifest["dry_run"] = told.origin.simulated
        inputs[IMPORTED + SUFFIX] = read_regular(file.with_name(file.name + SUFFIX))
    record = Record.create(run.folder, manifest, inputs, utc_now)
    record.append("imported", 0.0, file=str(file), readings=len(readings))
    record.close()
    return run
