"""calibrate, verify, report: from sources to results, printed, written and returned as an exit status."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from bench.calibration import Calibration, Verification
from bench.calibration import calibrate as estimate
from bench.calibration import verify as check
from bench.commands import CommandError, printing
from bench.commands.source import Request, Source, load_sources, write_beside, write_json
from bench.model.block import COEFFICIENTS, Block

__all__ = ["Request", "calibrate", "report", "verify"]

LACK_OF_FIT_P = 0.01


def calibrate(request: Request, estimator: str, target: str | None, *, strict: bool) -> int:
    """Carry out `bench calibrate`; 1 with `strict` when the model does not fit the readings."""
    results: list[dict[str, Any]] = []
    accepted = True
    for source in load_sources(request):
        result = calibration_of(source, estimator)
        results.append(result.to_json())
        accepted &= not result.lack_of_fit.p < LACK_OF_FIT_P
        text = json.dumps(results[-1], indent=1) + "\n"
        file = source.output("calibrate", ".json")
        written = write_beside(file, text, asked=request.out is not None)
        if target != "-":
            printing.calibration(source, result, file if written else None)
    write_json(results, target)
    return 0 if accepted or not strict else 1


def verify(request: Request, coefficients: Path | None, limit_g: float | None, target: str | None) -> int:
    """Carry out `bench verify`; 1 when a verification point is outside the limit."""
    results: list[dict[str, Any]] = []
    passed = True
    for source in load_sources(request):
        result = verification_of(source, coefficients, limit_g)
        results.append(result.to_json())
        passed &= result.passed
        file = source.output("verify", ".json")
        written = write_beside(file, json.dumps(results[-1], indent=1) + "\n", asked=request.out is not None)
        if target != "-":
            printing.verification(source.name, result, file if written else None)
    write_json(results, target)
    return 0 if passed else 1


def report(request: Request) -> int:
    """Carry out `bench report`; the exit status is that of the verification in it."""
    (source,) = load_sources(request)
    verdict = write_report(source)
    return 0 if verdict is None or verdict.passed else 1


def calibration_of(source: Source, estimator: str = "gls") -> Calibration:
    """Calibrate a source with its own bench and model."""
    return estimate(source.readings, source.model, source.stand_u, source.g_m_s2, estimator)


def verification_of(
    source: Source,
    coefficients: Path | None = None,
    limit_g: float | None = None,
    calibration: Calibration | None = None,
) -> Verification:
    """Verify a source with coefficients of a file, of a calibration at hand, or of its own readings."""
    limit = source.bench.verification_limit_g if limit_g is None else limit_g
    if coefficients is not None:
        block, covariance, noise = read_coefficients(coefficients, source.readings.unit)
    else:
        own = calibration or calibration_of(source)
        block, covariance, noise = own.block, own.covariance, own.noise.reading
    return check(source.readings, block, covariance, noise, limit)


def read_coefficients(path: Path, unit: str) -> tuple[Block, Any, float]:
    """Read a result of `calibrate --json`: the block, its covariance (12, 12), the noise of a reading.

    Raises `CommandError` when the file is not one, or in another unit than the readings.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        values = np.array([data["coefficients"][name]["value"] for name in COEFFICIENTS], dtype=np.float64)
        by_name = {name: i for i, name in enumerate(data["order"])}
        order = [by_name[name] for name in COEFFICIENTS]
        covariance = np.array(data["covariance"], dtype=np.float64)[np.ix_(order, order)]
        noise = float(data["noise"]["reading_v"])
        theirs = str(data["unit"])
    except OSError as error:
        raise CommandError(f"{path}: cannot be read ({error.strerror}); check the name") from error
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise CommandError(
            f"{path}: not a result of 'bench calibrate --json' ({type(error).__name__}: {error})"
        ) from error
    if theirs != unit:
        raise CommandError(f"{path}: coefficients in {theirs}/g, but the readings are in {unit}")
    return Block.from_vector(values), covariance, noise


def write_report(source: Source) -> Verification | None:
    """Calibrate, verify and write the page of a source; return the verification where there is one."""
    from bench.commands.provenance import provenance
    from bench.report import ReportContent, render_report

    calibration = calibration_of(source)
    verdict = None
    if len(source.readings.verification()):
        verdict = verification_of(source, calibration=calibration)
    unit = source.bench.unit_under_test
    content = ReportContent(
        title=f"Calibration of {unit.type} {unit.serial}".strip(),
        calibration=calibration,
        verification=verdict,
        compared=_closed_form(source),
        provenance=provenance(source),
        notes=source.readings.notes,
        skipped=source.readings.skipped,
        simulated=source.run is not None and source.run.simulated,
    )
    file = source.output("report", ".html")
    if write_beside(file, render_report(content), asked=source.request.out is not None):
        printing.written("report", file)
    return verdict


def _closed_form(source: Source) -> Calibration | None:
    """The paper's estimator beside ours, where the readings are such that it applies."""
    from bench.calibration import CalibrationError

    try:
        return calibration_of(source, "closed-form")
    except CalibrationError:
        return None
