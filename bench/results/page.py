"""The report of a calibration as an HTML page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

from bench.base.languages import message
from bench.base.numbers import probability, rounded, scale_for, uncertainty
from bench.calibration.conformity import Statement
from bench.calibration.intrinsic import intrinsic_of
from bench.calibration.result import Calibration, LackOfFit
from bench.calibration.verification import Verification
from bench.results import parts, plots, tables
from bench.results.verification import advice, global_risk_in_words, headline, risk_in_words, rule_in_words


def render_report(
    title: str,
    calibration: Calibration,
    verification: Verification | None,
    *,
    compared: Calibration | None,
    provenance: Mapping[str, str],
    notes: Sequence[str],
    skipped: Sequence[str],
    simulated: bool,
    warnings: Sequence[str] = (),
) -> str:
    """Return the report as one self-contained HTML page; the same content always gives the same text.

    `compared` is a calibration of the same readings, to be compared with `calibration`; it is ignored if both have
    the same estimator. `provenance` maps names such as "operator" to text, which is shown unchanged. `warnings`
    are shown in the box of the verdict.
    """
    other = compared if compared is not None and compared.estimator != calibration.estimator else None
    return tables.page(
        "report.html.j2",
        title=title,
        calibration=calibration,
        verification=verification,
        other=other,
        provenance=provenance,
        notes=notes,
        skipped=skipped,
        simulated=simulated,
        warnings=warnings,
        own=intrinsic_of(calibration),
        scale=scale_for(1.0, calibration.unit),
        verdict=_verdict(verification, doubted=bool(warnings)),
        fit=_fit(calibration.lack_of_fit),
        measured=_measured(provenance),
        tables=tables,
        plots=plots,
        intrinsic=parts,
    )


STATES: Final = {
    Statement.PASS: "passed",
    Statement.CONDITIONAL_PASS: "conditional",
    Statement.CONDITIONAL_FAIL: "conditional",
    Statement.INCONCLUSIVE: "none",
    Statement.NOT_COMPLETE: "failed",
    Statement.MISFIT: "failed",
    Statement.FAIL: "failed",
}
"""The style of the verdict box for each statement."""


def _verdict(verification: Verification | None, *, doubted: bool) -> dict[str, Any]:
    """Return the verdict in words; `state` selects the style of its box, which is no pass if it is `doubted`."""
    if verification is None:
        return {"state": "none", "word": message("Not verified"), "points": 0}
    worst = verification.worst
    scale = scale_for(verification.limit_g, "g")
    mark = "✓" if verification.passed else "✗" if verification.rejected else "–"
    words = headline(verification)
    said = f": {words}" if words.startswith("conditional") else f" {words}"
    state = STATES[verification.statement]
    return {
        "state": "conditional" if doubted and state == "passed" else state,
        "word": message(f"{mark} Verification{said}"),
        "worst": rounded(abs(worst.delta_g) / scale.size, worst.u / scale.size),
        "u": uncertainty(worst.u / scale.size),
        "expanded": uncertainty(worst.U / scale.size),
        "k": f"{worst.k:.3g}",
        "unit": scale.unit,
        "where": message(f"{worst.angle_deg:.4f}° (pass {worst.pass_number}, point {worst.point})")
        if worst.series == 1
        else message(
            f"{worst.angle_deg:.4f}° (series {worst.series}, pass {worst.pass_number}, point {worst.point})"
        ),
        "limit": f"{verification.limit_g / scale.size:g}",
        "tur": f"{verification.tur:.2g}",
        "risk": risk_in_words(verification),
        "rule": verification.decision.words,
        "rule_in_words": rule_in_words(verification.decision),
        "points": len(verification.points),
        "outside": sum(abs(p.delta_g) > verification.limit_g for p in verification.points),
        "advice": advice(verification),
        "of_all": global_risk_in_words(verification),
    }


def _fit(fit: LackOfFit) -> dict[str, str]:
    """Return the outcome of a test for lack of fit in words; `state` is fits, misfits or unknown."""
    figures = message(f"χ² = {fit.chi2:.1f} for {fit.dof} degrees of freedom, {probability(fit.p)}")
    if not math.isfinite(fit.p):
        state, figures, short = "unknown", "", message("cannot be judged: too few repeats")
        sentence = message(
            "Whether the model fits cannot be judged: the readings have too few repeats to separate "
            "misfit from scatter."
        )
    elif not fit.shown:
        state, short = "fits", message("no lack of fit shown at 1 %")
        sentence = message(
            "No lack of fit is shown: the scatter of the repeats explains the residuals; "
            f"chance alone would leave more in {_percent(fit.p)} of calibrations."
        )
    else:
        state, short = "misfits", message("the model does not fit the readings")
        if fit.accepted():
            short = message("lack of fit shown at 1 %")
        sentence = message(
            "A lack of fit is shown: the residuals exceed the scatter of the repeats; chance alone would leave "
            f"as much in {_percent(fit.p)} of calibrations. The misfit has widened u; the residuals show where "
            "it acts."
        )
    return {"state": state, "figures": figures, "short": short, "sentence": sentence}


_MEASURED: Final = {
    "unit under test": "Unit",
    "begun": "Measured",
    "operator": "Operator",
    "procedure": "Procedure",
}
"""The entries of the provenance that are repeated near the top of the page, with their titles there."""
_INSTRUMENTS = ("voltmeter", "head", "thermometer", "meter_", "room_", "level", "power_supply")
"""Prefixes of the names of instruments that are listed near the top; a chamber is listed only at the end."""


def _measured(provenance: Mapping[str, str]) -> dict[str, str]:
    """Return the unit, date, operator, procedure and instruments from the provenance, as far as they are stated."""
    stated = {title: provenance[name] for name, title in _MEASURED.items() if name in provenance}
    if "Procedure" in stated:
        stated["Procedure"] = stated["Procedure"].partition(" (plan")[0]
    used = [text for name, text in provenance.items() if name.startswith(_INSTRUMENTS)]
    return {**stated, "Instruments": "; ".join(used)} if used else stated


def _percent(p: float) -> str:
    if p < 1e-3:
        return message("less than 0.1 %")
    return f"{100.0 * p:.0f} %" if p >= 0.1 else f"{100.0 * p:.2g} %"
