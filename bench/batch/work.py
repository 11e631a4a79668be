"""The unit of work: the path of a run and a job in, a row out. It writes nothing into the folder of the run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any, Final

from bench.base.files import to_text, write_whole
from bench.base.text import visible
from bench.batch.job import DIAGNOSE, REPORT, Job, Row
from bench.batch.stored import Found, Judged, Named, Stored, changes, stored_calibration, stored_diagnosis
from bench.config.formulas import effects_in
from bench.diagnosis.full import TooLittleLeft
from bench.model import CATALOGUE, Effect
from bench.run.events import RecordError, read_manifest, sha256
from bench.services.calibration import CalibrationResult, calibration_of
from bench.services.diagnosis import body_of, diagnosis_of
from bench.services.documents import report_page
from bench.services.explained import sentence
from bench.services.free_diagnosis import free_diagnosis_of, free_sources
from bench.services.source import Source, load_sources
from bench.services.verification import VerificationResult, verification_of

_ONE_AT_A_TIME: Final = Lock()
"""A process computes one run at a time: which effects are known holds for all of it."""


def worked(job: Job, run: str) -> Row:
    """Return what a run gives: its row, or one with the sentence of why there is none (`failed`)."""
    row: Row = {"run": run, "name": Path(run).name}
    with _ONE_AT_A_TIME:
        try:
            row |= _told_by_manifest(Path(run))
            with _knowing(job.effects):
                row |= _of_run(job, run)
        except Exception as error:  # one bad run never ends the batch; its sentence is listed
            row["failed"] = visible(sentence(error))
    return row


def _told_by_manifest(folder: Path) -> Row:
    try:
        manifest = read_manifest(folder)
    except RecordError:
        return {}  # whatever reads the run will say it
    unit = manifest.get("unit_under_test")
    said = manifest.get("versions", {})
    return {
        "simulated": bool(manifest.get("dry_run")),
        "begun": manifest.get("created"),
        "measured_with": said.get("triaxial-bench"),
        **({"unit_type": unit["type"], "serial": unit["serial"]} if unit else {}),
    }


@contextmanager
def _knowing(files: tuple[str, ...]) -> Iterator[None]:
    with CATALOGUE.also(_effects(files)):
        yield


@lru_cache(maxsize=1)
def _effects(files: tuple[str, ...]) -> tuple[Effect, ...]:
    return tuple(effects_in(files))


def _of_run(job: Job, run: str) -> Row:
    (source,) = load_sources(job.request(run))
    row: Row = {"bench": source.bench.name, "simulated": source.simulated}
    if source.block_name:
        row |= {"unit_type": source.bench.unit_under_test.type, "serial": source.bench.unit_under_test.serial}
    if job.command == DIAGNOSE:
        return row | _diagnosed(source)
    return row | _calibrated(job, source)


# --- calibrate and report ---------------------------------------------------------------------------


def _calibrated(job: Job, source: Source) -> Row:
    result = calibration_of(
        source,
        job.estimator,
        nominal_angles=job.nominal_angles,
        join_free=job.join_free,
        join_verification=job.join_verification,
    )
    row: Row = {}
    verdict: VerificationResult | None = None
    if job.command == REPORT:
        page, verdict = report_page(result, job.asked())
        row["page"] = str(_written(job, source, page))
    elif len(source.readings.verification()) and not job.join_verification:
        verdict = verification_of(result.source, result, job.asked())
    stored = stored_calibration(Path(source.name))
    return row | _compared(result, verdict, stored)


def _written(job: Job, source: Source, page: str) -> Path:
    """Write the page of a run; runs of several folders may share a name, and folders theirs."""
    folder = Path(source.name)
    place = f"{folder.parent.name}-{sha256(str(folder.parent).encode())[:6]}"
    file = Path(job.pages) / place / f"{folder.name}.html"
    file.parent.mkdir(parents=True, exist_ok=True)
    write_whole(file, page)
    return file


def _compared(result: CalibrationResult, verdict: VerificationResult | None, stored: Stored) -> Row:
    now, before = Found.of_result(result), stored.calibration
    judged = None if verdict is None else Judged.of_result(verdict)
    notes = [*stored.notes, *(() if before is None else _notes_on(before, result)), *result.notes]
    return {
        **changes(before, now),
        **_verdicts(stored.verdict, judged),
        "readings_used": now.used,
        "covariance": result.covariance.ravel().tolist(),
        "notes": "; ".join(map(visible, notes)),
    }


def _notes_on(before: Found, result: CalibrationResult) -> Iterator[str]:
    run = result.source.run
    if run is not None and before.head is not None and before.head != run.history.head:
        yield "the stored result is of another state of the record (its head is another)"
    if before.u_of_readings_alone:
        yield "the stored u is that of an earlier version: of the readings alone"


def _verdicts(before: Judged | None, now: Judged | None) -> Row:
    row: Row = {}
    for one, suffix in ((before, "_stored"), (now, "")):
        if one is not None:
            row |= {
                f"verdict{suffix}": one.words,
                f"worst_delta_g{suffix}": one.delta_g,
                f"worst_delta_g_u{suffix}": one.u,
                f"limit_g{suffix}": one.limit_g,
                f"rule{suffix}": one.rule,
            }
    if before is not None and now is not None:
        row["verdict_differs"] = before.words != now.words
    return row


# --- diagnose ---------------------------------------------------------------------------------------


def _diagnosed(source: Source) -> Row:
    found = _diagnosis(source)
    now, stored = Named.of_file(found), stored_diagnosis(Path(source.name))
    before = stored.diagnosis
    row: Row = {
        "model": source.model.name,
        "verdict": now.verdict,
        "names": now.names,
        "gap_before": now.before,
        "gap_after": now.after,
        "result": to_text(found),
        "notes": "; ".join(map(visible, (*stored.notes, *source.readings.notes, *found.get("notes", ())))),
    }
    if before is None:
        return row
    return row | {
        "verdict_stored": before.verdict,
        "verdict_differs": before.verdict != now.verdict,
        "names_stored": before.names,
        "names_differ": before.names != now.names,
        "gap_before_stored": before.before,
        "gap_after_stored": before.after,
    }


def _diagnosis(source: Source) -> dict[str, Any]:
    if free_sources([source]):
        return free_diagnosis_of([source]).to_dict()
    try:
        return diagnosis_of(body_of([source]).source).to_dict()
    except TooLittleLeft as found:
        return found.to_dict(source.name)
