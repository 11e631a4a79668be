"""The conduct of a validation: checks are carried out, then page, PDF, result and seal are written."""

from __future__ import annotations

import json
import math
import os
import tempfile
from collections.abc import Callable
from datetime import datetime
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

from bench.base.computing import CalibrationError, missing
from bench.base.files import read_given, read_json, to_text, write_whole
from bench.base.languages import message
from bench.base.text import visible
from bench.base.yaml_files import sha256_of_file
from bench.batch.job import job_of
from bench.batch.outcome import asked_of, carried_out, rows_of
from bench.batch.store import list_runs
from bench.batch.work import stored_calibration
from bench.calibration.estimators import GLS, find_estimator
from bench.config.bench_file.file import load_bench
from bench.results.registers import (
    NOT_PROVEN,
    AgainstPart,
    ChangedRun,
    ValidatedBench,
    ValidationCheck,
    ValidationResult,
    acts,
    clauses,
    families,
    render_validation,
)
from bench.run.events import sha256
from bench.run.seal import (
    SEAL,
    Seal,
    is_signed,
    private_key,
    public_key,
    read_public_key,
    sign,
    signed,
    write_seal,
)
from bench.services.bench_selection import bench_path
from bench.services.errors import Refused, refusing, sentence
from bench.services.requests.documents import BatchCalibrate, Validate
from bench.services.requests.shared import runs_folder
from bench.services.validated import Validations, fingerprint, laboratory_known, plug_ins
from bench.validation.failures import note_validation
from bench.validation.machine import description
from bench.validation.registry import Context, carry_out, every
from drivers.clock import SystemClock, utc_now

RESULT: Final = "validation.json"
PAGE: Final = "validation.html"
PDF: Final = "validation.pdf"
THRESHOLD_U: Final = 0.1
"""Largest change of a coefficient of a past run, or of its u, that is not listed, in units of the stored u."""


def validated(request: Validate, passphrase: Callable[[], bytes]) -> ValidationResult:
    """Carry out a validation; write result, page, PDF and seal.

    Raises `Refused` for an unusable folder, key or release, and if `request.against` names no run. Raises
    `FileMistakes` for a bench file with mistakes.
    """
    began, clock, cpu_s = utc_now(), SystemClock(), _cpu_s()
    began_s = clock.now_s()
    _check_release(request)
    key = None if request.key is None else private_key(request.key, passphrase)
    bench = bench_path(request.bench)
    load_bench(bench)  # its mistakes are refused before the checks begin
    if request.against is not None:  # what names no run is refused before the checks begin
        _past_runs(request, request.against)
    folder = request.out or Path(f"validation-{began.astimezone():%Y%m%d-%H%M%S}")
    _take(folder)
    laboratory = laboratory_known(request.laboratory)
    number, accepted = _accepted(laboratory, bench)
    places = [runs_folder(request.runs), folder]
    places += [] if laboratory is None else [Validations.beside(laboratory).folder]
    with tempfile.TemporaryDirectory(prefix="bench-validation-") as scratch:
        released = request.release, request.release_key
        context = Context(bench, Path(scratch), request.quick, accepted, tuple(places), *released)
        checks = carry_out(context, every())
        name, own = context.bench.name, plug_ins(context.bench)
    part: AgainstPart | None = None
    if request.against is not None:
        part = against(request, request.against, folder / "against")
        checks.append(_of_past_runs(part))
    result = ValidationResult(
        passed=all(one.passed for one in checks),
        quick=request.quick,
        began=began.astimezone().isoformat(timespec="seconds"),
        took_s=round(clock.now_s() - began_s, 1),
        cpu_s=round(_cpu_s() - cpu_s, 1),
        false_alarm=sum(one.p_false for one in every()),
        program=fingerprint(),
        bench=ValidatedBench(name=name, file=str(bench), sha256=sha256_of_file(bench), plug_ins=own),
        machine=description(),
        checks=checks,
        against=part,
        not_proven=list(NOT_PROVEN),
        accepted_before=number,
    )
    if result.failed and laboratory is not None:
        result = result.model_copy(update={"failure": _noted(laboratory, folder, result)})
    written, seal = _write(result, folder, began)
    if key is not None:
        seal = signed(seal, *sign(key, seal.signed_bytes))
    written.append(str(write_seal(folder, seal)))
    return result.model_copy(update={"files": written})


def _noted(laboratory: Path, folder: Path, result: ValidationResult) -> str:
    """Enter a failed validation in the register of failures; return its number, or why that failed."""
    try:
        return note_validation(laboratory, folder.name, result)
    except Refused as why:  # a folder that cannot be written must not cost the result
        return str(why)


def _check_release(request: Validate) -> None:
    """Refuse an unusable manifest or key at once, before checks that take minutes."""
    for file in (request.release, request.release_key):
        if file is not None:
            with refusing("check its name", file, reading=True):
                read_given(file)
    if request.release_key is not None:
        read_public_key(request.release_key)


def _cpu_s() -> float:
    """Return the processor time (s) of this program and of the processes that it waited for."""
    return sum(os.times()[:4])


def _take(folder: Path) -> None:
    if (folder / RESULT).exists():
        raise Refused(f"{folder}: holds a validation already; name another folder with --out")
    with refusing("name another folder with --out", folder):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / RESULT).touch()
        (folder / RESULT).unlink()


def _accepted(laboratory: Path | None, bench: Path) -> tuple[str, dict[str, Any]]:
    """Return number and result of the latest accepted validation for this bench file; both empty without one."""
    if laboratory is None:
        return "", {}
    register = Validations.beside(laboratory).read_lines()
    entry = register.latest(bench)
    if entry is None:
        return "", {}
    kept: dict[str, Any] = read_json(register.kept(str(entry.data["result_sha256"])))
    return entry.number, kept


# --- past runs computed again, each with the estimator of its stored result ---------------------------


def _past_runs(request: Validate, over: str) -> tuple[str, ...]:
    return list_runs([over], runs_folder(request.runs), request.catalogue, "--against").runs


def against(request: Validate, over: str, folder: Path) -> AgainstPart:
    """Recompute the runs that `over` names, by a path pattern or a query of the catalogue, into a folder.

    A run without a stored result is computed with the default estimator, and not compared. Raises `Refused`
    if no run is found.
    """
    by_estimator: dict[str, list[str]] = {}
    for run in _past_runs(request, over):
        stored = stored_calibration(Path(run), [])
        by_estimator.setdefault(_known(GLS if stored is None else stored.estimator), []).append(run)
    rows: list[dict[str, Any]] = []
    for estimator, runs in by_estimator.items():
        rows += _rows(BatchCalibrate(over=runs, out=folder / estimator, estimator=estimator))
    compared = [row for row in rows if row["estimator_stored"] is not None and row["failed"] is None]
    return AgainstPart(
        over=[over],
        runs=len(rows),
        compared=len(compared),
        threshold_u=THRESHOLD_U,
        changed=[_changed(row) for row in compared if _differs(row)],
        failed={row["run"]: row["failed"] for row in rows if row["failed"] is not None},
    )


def _known(estimator: str) -> str:
    try:
        return find_estimator(estimator).name
    except CalibrationError:
        return GLS  # an estimator that is not installed here: the default estimator replaces it


def _rows(request: BatchCalibrate) -> list[dict[str, Any]]:
    job_of(request).checked()
    carried_out(request, lambda notes: None)
    with asked_of(request.out) as ask:
        return rows_of(
            ask,
            "SELECT run, failed, estimator_stored, largest_change_in_u, largest_change_of, least_u_ratio, "
            "most_u_ratio, verdict_stored, verdict, verdict_differs FROM changes ORDER BY run",
        )


def _largest(row: dict[str, Any]) -> tuple[float, str]:
    """Return the largest change of a coefficient or of a u, in units of the stored u, and what changed.

    It is infinite for results that cannot be compared.
    """
    change = row["largest_change_in_u"]
    if change is None or math.isnan(change):
        return math.inf, "unknown"
    ratios = (row[name] for name in ("least_u_ratio", "most_u_ratio"))
    of_u = max((abs(ratio - 1.0) for ratio in ratios if ratio is not None), default=0.0)
    return (of_u, "u") if of_u > change else (change, row["largest_change_of"])


def _differs(row: dict[str, Any]) -> bool:
    """Return whether a result changed by more than the threshold, has another verdict, or cannot be compared."""
    return _largest(row)[0] > THRESHOLD_U or bool(row["verdict_differs"])


def _changed(row: dict[str, Any]) -> ChangedRun:
    change, of = _largest(row)
    return ChangedRun(
        run=row["run"],
        largest_change_in_u=change if math.isfinite(change) else -1.0,
        largest_change_of=of,
        verdict_stored=row["verdict_stored"],
        verdict=row["verdict"],
    )


def _of_past_runs(part: AgainstPart) -> ValidationCheck:
    """Return the finding on past runs as a check; a person may accept a changed result."""
    runs = [one.run for one in part.changed]
    words = f"{len(runs)} of {part.compared} changed" + (
        f", {len(part.failed)} failed" if part.failed else ""
    )
    return ValidationCheck(
        name="past runs",
        family=message("changes since the accepted validation"),
        clause="7.11.2",
        did="Recompute past runs by the estimators of their stored results.",
        source="",
        expected=f"no coefficient, and no u, changed by more than {part.threshold_u:g} u; no verdict changed",
        found=words,
        passed=not (runs or part.failed),
        where=", ".join([*runs, *part.failed][:5]),
        change=True,
        took_s=0.0,
    )


# --- what is written ----------------------------------------------------------------------------------


def _write(result: ValidationResult, folder: Path, began: datetime) -> tuple[list[str], Seal]:
    """Write result, page and PDF; return their paths and an unsigned seal of these files."""
    contents = {RESULT: to_text(result.to_dict()).encode(), PAGE: render_validation(result).encode()}
    try:
        contents[PDF] = pdf_of(result, int(began.timestamp()))
    except ImportError as error:
        if not missing(error):  # the result says that there is no PDF
            raise
    for name, content in contents.items():
        write_whole(folder / name, content)
    hashes = {name: sha256(content) for name, content in contents.items()}
    seal = Seal(
        run=folder.name,
        events=len(result.checks),
        head=hashes[RESULT],
        manifest_sha256=hashes[RESULT],
        files=hashes,
        sealed=utc_now().isoformat(),
    )
    return [str(folder / name) for name in contents], seal


def pdf_of(result: ValidationResult, moment: int) -> bytes:
    """Return the PDF/A of a validation, with its result attached. Raises `ImportError` if typst is missing."""
    from bench.certificate.page import typeset_pdf

    told = result.to_dict()
    told["headline"] = result.headline
    told["clauses"] = [[clause, str(count), str(passed)] for clause, count, passed in clauses(result.checks)]
    told["families"] = [
        {
            "name": family[0].upper() + family[1:],
            "acts": [
                {
                    "did": did,
                    "source": own[0].source,
                    "clause": own[0].clause,
                    "rows": [row.to_dict() for row in own],
                }
                for did, own in acts(rows)
            ],
        }
        for family, rows in families(result.checks)
    ]
    day = datetime.fromisoformat(result.began)
    told["date"] = [day.year, day.month, day.day]
    template = files(__package__).joinpath("validation.typ").read_bytes()
    attached = to_text(result.to_dict())
    try:
        return typeset_pdf({"data": json.dumps(_shown(told)), "result": attached}, moment, template)
    except Refused:  # a name in letters that the fonts lack must not cost the validation its PDF
        return typeset_pdf(
            {"data": json.dumps(_shown(told, plain=True)), "result": attached}, moment, template
        )


def _shown(told: Any, *, plain: bool = False) -> Any:
    """Return data with control characters (with `plain`, all characters beyond ASCII) shown as escapes."""
    if isinstance(told, str):
        return visible(told.encode("ascii", "backslashreplace").decode() if plain else told)
    if isinstance(told, dict):
        return {_shown(name, plain=plain): _shown(one, plain=plain) for name, one in told.items()}
    return [_shown(one, plain=plain) for one in told] if isinstance(told, list) else told


def damage_of(folder: Path, seal: Seal) -> list[str]:
    """Return a sentence for each file of a validation that differs from its seal, and for a wrong signature."""
    wrong = []
    if seal.signature:
        key = public_key(seal.public_key, str(folder / SEAL))
        if not is_signed(key, seal.signature, seal.signed_bytes):
            wrong.append(f"{folder / SEAL}: not signed with the key that it names")
    for name, digest in seal.files.items():
        try:
            if sha256((folder / name).read_bytes()) != digest:
                wrong.append(f"{folder / name} differs from the sealed file; restore it from a copy")
        except OSError as error:
            wrong.append(sentence(error))
    return wrong
