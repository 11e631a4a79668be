"""calibrate, verify, report: from sources to results, printed, written and returned as an exit status."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from bench.analysis.calibration import Calibration, CalibrationError, Verification, implausible
from bench.analysis.calibration import calibrate as estimate
from bench.analysis.calibration import verify as check
from bench.analysis.calibration.estimators import CLOSED_FORM, GLS
from bench.analysis.calibration.verification import SIMPLE, rule_name
from bench.analysis.temperature.plateaus import separate_temperatures
from bench.cli import CommandError, printing
from bench.cli.coefficients import Coefficients, read_coefficients
from bench.cli.source import (
    Request,
    Source,
    check_target,
    load_sources,
    to_text,
    write_beside,
    write_json,
    write_whole,
)

__all__ = ["Request", "calibrate", "report", "verify"]

LACK_OF_FIT_P = 0.01
SEVERAL_TEMPERATURES = 3


@dataclass(frozen=True)
class Fitting:
    """How a calibration is to be made, by the options of `bench calibrate`."""

    estimator: str = GLS
    nominal_angles: bool = False
    join_free: bool = True
    join_verification: bool = False


def calibrate(request: Request, fitting: Fitting, target: str | None, *, strict: bool) -> int:
    """Carry out `bench calibrate`; 1 with `strict` when the model does not fit, or the block is another."""
    check_target(target)
    sources = [told_of_temperatures(source) for source in load_sources(request)]
    results = [calibration_of(source, fitting) for source in sources]
    accepted = True
    for source, result in zip(sources, results, strict=True):
        doubts = doubts_of(source, result)
        accepted &= not doubts and not result.lack_of_fit.p < LACK_OF_FIT_P
        file = _written(source, "calibrate", calibration_json(source, result))
        if target == "-":
            _notes_to_stderr((*doubts, *result.notes, *source.readings.notes, *source.readings.skipped))
        else:
            printing.calibration(source, result, doubts, file)
    write_json([calibration_json(s, r) for s, r in zip(sources, results, strict=True)], target)
    return 0 if accepted or not strict else 1


def verify(
    request: Request, coefficients: Path | None, limit_g: float | None, target: str | None, *, rule: str
) -> int:
    """Carry out `bench verify`; 1 when a verification point is not accepted by the rule, or missing."""
    check_target(target)
    rule = rule_name(rule)
    if limit_g is not None and not (math.isfinite(limit_g) and limit_g > 0):
        raise CommandError(f"--limit {limit_g}: a limit is a positive number of g, such as 3e-4")
    sources = load_sources(request)
    if coefficients is None:
        sources = [told_of_temperatures(source) for source in sources]
    results = [verification_of(source, coefficients, limit_g, rule=rule) for source in sources]
    for source, result in zip(sources, results, strict=True):
        file = _written(source, "verify", result.to_json())
        if target == "-":
            _notes_to_stderr((*source.readings.notes, *source.readings.skipped))
        else:
            printing.verification(source, result, file)
    write_json([result.to_json() for result in results], target)
    return 0 if all(result.passed for result in results) else 1


def report(request: Request, target: str | None) -> int:
    """Carry out `bench report`; the exit status is that of the verification in it."""
    check_target(target)
    source = told_of_temperatures(*load_sources(request))
    out = printing.console(json=target)
    verdict = write_report(source, calibration_of(source), out)
    if verdict is not None:
        printing.verdict(source.name, verdict, out)
    page = str(source.output("report", ".html"))
    write_json([{"report": page, "verification": verdict and verdict.to_json()}], target)
    return 0 if verdict is None or verdict.passed else 1


def told_of_temperatures(source: Source) -> Source:
    """Note where the readings are at several temperatures, of which one calibration makes a mixture."""
    found = separate_temperatures(source.readings)
    if len(found) < SEVERAL_TEMPERATURES:
        return source
    note = (
        f"readings span {found[-1] - found[0]:.0f} K at {len(found)} temperatures, and these coefficients mix "
        "them: see bench compensate"
    )
    return replace(source, readings=replace(source.readings, notes=(*source.readings.notes, note)))


def calibration_of(source: Source, fitting: Fitting | None = None) -> Calibration:
    """Calibrate a source with its own bench and model."""
    how = fitting or Fitting()
    return estimate(
        source.readings,
        source.model,
        source.stand_u,
        source.g_m_s2,
        how.estimator,
        nominal_angles=how.nominal_angles,
        join_free=how.join_free,
        join_verification=how.join_verification,
    )


def doubts_of(source: Source, result: Calibration) -> tuple[str, ...]:
    """Say where the block found is not the block announced."""
    return implausible(result, source.bench.unit_under_test.scale_factors.values)


def calibration_json(source: Source, result: Calibration) -> dict[str, Any]:
    """Return the promised result, where it comes from, when it was measured and of which block."""
    unit = source.bench.unit_under_test
    return {
        **result.to_json(),
        "source": source.name,
        "made_at": source.made_at,
        "unit_under_test": {"type": unit.type, "serial": unit.serial} if source.block_name else None,
        "simulated": source.simulated,
        "notes": [*doubts_of(source, result), *result.notes, *source.readings.notes],
        "skipped_rows": list(source.readings.skipped),
    }


def verification_of(
    source: Source,
    coefficients: Path | None = None,
    limit_g: float | None = None,
    calibration: Calibration | None = None,
    rule: str = SIMPLE,
) -> Verification:
    """Verify a source with coefficients of a file, of a calibration at hand, or of its own readings."""
    limit = source.bench.verification_limit_g if limit_g is None else limit_g
    if coefficients is not None:
        taken = read_coefficients(coefficients, source.readings.unit)
        if taken.simulated and not source.simulated:
            _notes_to_stderr((f"the coefficients in {coefficients} were found on simulated instruments",))
    else:
        own = calibration or calibration_of(source)
        taken = Coefficients(own.block, own.covariance, own.noise.reading, own.g_m_s2, own.unit)
    ratio = taken.g_m_s2 / source.g_m_s2
    return check(source.readings, taken.block, taken.covariance, taken.noise, limit, ratio, rule)


def _written(source: Source, command: str, result: dict[str, Any]) -> Path | None:
    file = source.output(command, ".json")
    return file if write_beside(file, to_text(result), asked=source.request.out is not None) else None


def _notes_to_stderr(notes: tuple[str, ...]) -> None:
    """Standard output is JSON alone; what a person should know goes beside it."""
    for note in notes:
        print(f"note: {note}", file=sys.stderr)


def write_report(source: Source, calibration: Calibration, out: Console | None = None) -> Verification | None:
    """Verify and write the page of a source; return the verification where there is one. Raises `OSError`."""
    from bench.cli.provenance import provenance
    from bench.report import ReportContent, render_report

    verdict = None
    if len(source.readings.verification()):
        verdict = verification_of(source, calibration=calibration)
    content = ReportContent(
        title=f"Calibration of {source.block_name or source.name}",
        calibration=calibration,
        verification=verdict,
        compared=_closed_form(source),
        provenance=provenance(source),
        notes=(*doubts_of(source, calibration), *calibration.notes, *source.readings.notes),
        skipped=source.readings.skipped,
        simulated=source.simulated,
    )
    file = source.output("report", ".html")
    file.parent.mkdir(parents=True, exist_ok=True)
    write_whole(file, render_report(content))
    printing.written("report", file, out)
    return verdict


def _closed_form(source: Source) -> Calibration | None:
    """The paper's estimator beside ours, where the readings are such that it applies."""
    try:
        return calibration_of(source, Fitting(CLOSED_FORM))
    except CalibrationError:
        return None
