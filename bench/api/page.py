"""The page of a calibration, with the verification that stands on it."""

from __future__ import annotations

from bench.analysis.calibration import Calibration, CalibrationError
from bench.analysis.calibration.estimators import CLOSED_FORM
from bench.api.calibration import CalibrationResult, calibration_of
from bench.api.own_effects import knowing_effects_of
from bench.api.provenance import provenance
from bench.api.source import Source
from bench.api.verification import NOTHING_ASKED, Asked, VerificationResult, verification_of


def report_page(
    result: CalibrationResult, asked: Asked = NOTHING_ASKED
) -> tuple[str, VerificationResult | None]:
    """Verify, where there are verification points; return the page (HTML) and the verification in it."""
    from bench.report import ReportContent, render_report

    source = result.source
    verdict = verification_of(source, result, asked) if len(source.readings.verification()) else None
    content = ReportContent(
        title=f"Calibration of {source.block_name or source.name}",
        calibration=result.calibration,
        verification=None if verdict is None else verdict.verification,
        compared=_closed_form(source),
        provenance=provenance(source),
        notes=(*result.doubts, *result.calibration.notes, *source.readings.notes),
        skipped=source.readings.skipped,
        simulated=source.simulated,
    )
    with knowing_effects_of(source):
        return render_report(content), verdict


def _closed_form(source: Source) -> Calibration | None:
    """The paper's estimator beside ours, where the readings are such that it applies."""
    try:
        return calibration_of(source, CLOSED_FORM).calibration
    except CalibrationError:
        return None
