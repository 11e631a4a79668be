"""The results of `bench verify` and `bench report`: Δg at the verification points as JSON, words, table."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, Final, Literal

from pydantic import Field
from rich.console import Console
from rich.table import Table

from bench.base.languages import message, translated
from bench.base.result_model import Matrix, Real, ResultModel
from bench.base.tables import print_notes, table
from bench.calibration.conformity import NON_BINARY, SIMPLE, DecisionRule, Population, Statement
from bench.calibration.verification import Verification, VerificationPoint
from bench.model.conditions import Mounting
from bench.readings.table import VERIFICATION
from bench.results.parts import BenchPart, Corrections


class PointPart(ResultModel):
    """A verification point: its Δg with u, the risks of the decision, and the statement of conformity."""

    angle_deg: float = Field(description="angle of the head, deg")
    series: int = Field(1, description="number of the mounting in installation V")
    pass_number: int = Field(alias="pass")
    point: int
    g_p: float = Field(description="modulus of the measured specific force, local g")
    delta_g: float = Field(description="g_p − 1, local g")
    u: float = Field(description="standard uncertainty of delta_g")
    U: float = Field(description="expanded uncertainty of delta_g, g")
    k: float = Field(description="coverage factor, U = k u")
    dof: Real = Field(description="degrees of freedom of u; null: infinite")
    tur: Real = Field(description="test uncertainty ratio, limit over U")
    accepted_up_to: float = Field(description="largest |Δg| that the rule accepts here, g")
    passed: bool = Field(description="whether the rule accepts the point")
    statement: Statement
    p_false_accept: float | None
    """probability that the true error is outside the limit; null if the point is not accepted"""
    p_false_reject: float | None
    """probability that the true error is within the limit; null if the point is not rejected"""


class GlobalRiskPart(ResultModel):
    """The global risks of a decision rule for a population of blocks, at the point with the largest U.

    Those of all points together (`…_all`) are the risks of the check, which accepts a block only at every point.
    """

    false_accept: float = Field(description="fraction of all blocks that are accepted but do not conform")
    false_reject: float = Field(description="fraction of all blocks that are not accepted but conform")
    false_accept_all: float | None = Field(default=None, description="`false_accept` of all points together")
    false_reject_all: float | None = Field(default=None, description="`false_reject` of all points together")
    population: Population = Field(description="stated distribution of Δg over many blocks, g")


class RulePart(ResultModel):
    """The limit of |Δg| at the verification points, and the decision rule."""

    limit_g: float = Field(description="limit of |Δg|, local g")
    rule: Literal["simple acceptance", "guarded", "non-binary"] = Field(description="decision rule")
    guard_band: float
    """guard band as a multiple of U; if `false_acceptance` is given, the value for a normal distribution
    (`accepted_up_to` is exact); simple acceptance does not subtract it from the limit
    """
    false_acceptance: float | None
    """probability of false acceptance that sets the guard band of the default rule; null for other rules"""


class VerdictPart(RulePart):
    """Δg at the verification points, and the verdict against the limit."""

    passed: bool = Field(description="whether all points were measured and are accepted by the rule")
    statement: Statement
    """statement for the worst point; `inconclusive` if U exceeds the limit, `not complete` if points are
    missing, `does not fit` if the readings contradict the coefficients or the orientation stated for V
    """
    missing: int = Field(description="planned points that were not measured")
    U: float = Field(description="largest expanded uncertainty of the points, g")
    tur: Real = Field(description="smallest test uncertainty ratio, limit over U")
    p_false_accept: float | None
    """probability that the true error of at least one point is outside the limit; null if not accepted,
    except for a conditional pass, on which the customer decides
    """
    p_false_accept_worst: float | None = Field(description="the same for the point at which it is largest")
    p_false_reject: float | None
    """probability that the true errors of all points are within the limit; null if no point is rejected"""
    global_risk: GlobalRiskPart | None = Field(description="global risks; null without a stated population")
    points: list[PointPart]
    covariance: Matrix = Field(description="covariance of Δg at the points in their order, g²")


class VerifyResult(VerdictPart):
    """Δg at the verification points, and the verdict against the limit.

    For several sources, the output is a list of these; a source that could not be evaluated has a `source-failed`
    object in its place.
    """

    notes: list[str] = Field(description="remarks on the meaning of the statements and on remedies")
    warnings: list[str] = Field(description="those `notes` that cast doubt on coefficients or readings")
    bench: BenchPart
    corrections: Corrections


class ReportResult(ResultModel):
    """The path of the calibration report, and the verification in the report."""

    report: str = Field(description="path of the page")
    bench: BenchPart
    verification: VerifyResult | None = Field(description="verdict; null without verification points")


def verdict_members(found: Verification) -> dict[str, Any]:
    """Return the members of `VerdictPart` that are not simply attributes of `Verification`."""
    risk, accepted = found.global_risk, found.passed or found.left_open
    of_all = {f"{name}_all": share for name, share in vars(found.global_risk_of_all).items()} if risk else {}
    return {
        **found.decision.to_json(),
        "U": found.expanded,
        "p_false_accept": found.p_outside if accepted else None,
        "p_false_accept_worst": found.p_outside_worst if accepted else None,
        "p_false_reject": 1.0 - found.p_outside if found.rejected else None,
        "global_risk": risk and {**vars(risk), **of_all, "population": found.population},
    }


def verify_result(found: Verification, **made_from: Any) -> VerifyResult:
    """Return the result of a verification; `made_from` has notes, warnings, bench and corrections."""
    return VerifyResult.from_object(found, **verdict_members(found), **made_from)


# --- as a table -------------------------------------------------------------------------------------


def place_in_words(point: VerificationPoint) -> str:
    """Return the pass and the number of a point, and the series if installation V was mounted before."""
    where = message(f"pass {point.pass_number} point {point.point}")
    return where if point.series == 1 else message(f"series {point.series} {where}")


def numbers_in_words(point: VerificationPoint) -> str:
    """Return the pass and the number of a point for a table, with the mounting from the second on."""
    numbers = f"{point.pass_number} / {point.point}"
    return numbers if point.series == 1 else f"{Mounting(point.series, VERIFICATION)}: {numbers}"


def verification_table(found: Verification) -> Table:
    """Return a table of the verification points: Δg, statement of conformity and risks."""
    guarded = found.rule != SIMPLE
    expanded = ">U (k=2)" if all(p.k == 2.0 for p in found.points) else ">U (95.45 %)"
    shown = table(
        "verification point", ">angle", ">Δg", ">u", expanded, *([">accepted up to"] * guarded),
        ">false accept", ">false reject", "statement",
    )  # fmt: skip
    for p in found.points:
        up_to = f"{p.accepted_up_to * 1e6:.1f} µg" if p.accepted_up_to > 0 else translated(message("nothing"))
        shown.add_row(
            place_in_words(p),
            f"{p.angle_deg:.4f}°",
            f"{p.delta_g * 1e6:+.1f} µg",
            f"{p.u * 1e6:.1f} µg",
            f"{p.U * 1e6:.1f} µg",
            *([up_to] * guarded),
            optional_probability(p.p_false_accept),
            optional_probability(p.p_false_reject),
            translated(str(p.statement), "statement"),
        )
    return shown


def print_verification(found: Verification, notes: Sequence[str], out: Console) -> None:
    """Print Δg at each verification point, and the notes."""
    out.print(verification_table(found))
    print_notes(out, notes)


# --- in words ---------------------------------------------------------------------------------------


HEADLINES: Final = {
    Statement.PASS: message("passed"),
    Statement.CONDITIONAL_PASS: message("conditional pass"),
    Statement.CONDITIONAL_FAIL: message("conditional fail"),
    Statement.INCONCLUSIVE: message("inconclusive"),
    Statement.NOT_COMPLETE: message("not complete"),
    Statement.MISFIT: message("not accepted"),
    Statement.FAIL: message("failed"),
}
"""The words for the overall verdict of a verification."""
VERDICTS: Final = {
    Statement.PASS: message("PASSED"),
    Statement.CONDITIONAL_PASS: message("CONDITIONAL PASS"),
    Statement.CONDITIONAL_FAIL: message("CONDITIONAL FAIL"),
    Statement.INCONCLUSIVE: message("INCONCLUSIVE"),
    Statement.NOT_COMPLETE: message("NOT COMPLETE"),
    Statement.MISFIT: message("NOT ACCEPTED"),
    Statement.FAIL: message("FAILED"),
}
"""The words that begin a line with the verdict."""

_LEAST_SHOWN: Final = 1e-4
_MOST: Final = 2
"""Largest number of contributions to u that are named."""


def headline(result: Verification, *, upper: bool = False) -> str:
    """Return the verdict in a few words; a conditional pass also states whether the rule accepts it."""
    word = (VERDICTS if upper else HEADLINES)[result.statement]
    if result.statement is Statement.CONDITIONAL_PASS:
        left_open = message("the customer decides") if result.left_open else message("not accepted")
        return f"{word}, {message('accepted') if result.passed else left_open}"
    return word


def rule_in_words(rule: DecisionRule) -> str:
    """Return the acceptance criterion of a decision rule in words, with its source."""
    if rule.name == SIMPLE:
        return message(
            "accepted when |Δg| ≤ limit at every verification point; no guard band is taken off the limit "
            "(JCGM 106:2012, 8.2)"
        )
    if rule.guard_band is None:
        band = message("w = 1.645 u; for two limits or a population, w is computed to give 5 %")
        sure = message(
            f"the probability of a false acceptance is at most 5 % at every verification point ({band})"
        )
        return message(
            f"accepted when {sure}; a larger |Δg| up to the limit is conditional, and the customer decides "
            "(JCGM 106:2012, 8.3.2; ILAC-G8:09/2019)"
        )
    times = "" if rule.guard_band == 1.0 else f"{rule.guard_band:g} "
    accepted = message(
        f"accepted when |Δg| + {times}U ≤ limit at every verification point; a guard band w = {times}U is taken "
        "off the limit (JCGM 106:2012, 8.3.2; ILAC-G8:09/2019)"
    )
    if rule.name != NON_BINARY:
        return accepted
    return message(f"{accepted}; |Δg| within w of the limit is conditional, and the customer decides")


def probability_in_words(p: float) -> str:
    """Return a probability with two digits, such as "0.012", or a bound such as "< 0.0001"."""
    if p < _LEAST_SHOWN:
        return f"< {_LEAST_SHOWN:g}"
    return f"{p:.2g}" if p < 1.0 - _LEAST_SHOWN else f"> {1.0 - _LEAST_SHOWN:g}"


def optional_probability(p: float | None) -> str:
    """Return a probability with two digits; a dash for None."""
    return "–" if p is None else probability_in_words(p)


def risk_in_words(result: Verification) -> str:
    """Return the specific risk of the decision, overall and at the worst point; "" if nothing was decided."""
    if result.passed or result.left_open:
        of_all, worst = (probability_in_words(p) for p in (result.p_outside, result.p_outside_worst))
        if of_all == worst:
            return message(
                f"probability of false acceptance{' if the customer accepts:' if result.left_open else ''} {worst}"
            )
        return message(
            f"probability of false acceptance{' if the customer accepts:' if result.left_open else ''} "
            f"{of_all} ({worst} at the worst point)"
        )
    if result.rejected:
        return message(f"probability of false rejection {probability_in_words(1.0 - result.p_outside)}")
    return ""


def verdict_line(name: str, result: Verification) -> str:
    """Return the verdict on the source `name` in one line: outcome, basis, and number of missing points."""
    count = result.missing
    missing = (
        message(f"{count} verification point{' is' if count == 1 else 's are'} missing") if count else ""
    )
    return outcome_in_words(
        name, result, "".join(f", {one}" for one in (basis_in_words(result), missing) if one)
    )


def outcome_in_words(name: str, result: Verification, then: str = "") -> str:
    """Return the verdict on the source `name`, with the largest |Δg|, its U, and the limit, followed by `then`."""
    worst = result.worst
    return message(
        f"{name}: {headline(result, upper=True)}: worst |Δg| = {abs(worst.delta_g) * 1e6:.1f} µg "
        f"± {worst.U * 1e6:.1f} µg (U, k = {worst.k:.3g}), limit {result.limit_g * 1e6:.4g} µg{then}"
    )


def basis_in_words(result: Verification) -> str:
    """Return in words the rule of a verdict, its test uncertainty ratio and the risk of the decision."""
    rule, risk = result.decision.words, risk_in_words(result)
    if not risk:
        return message(f"rule: {rule}, TUR {result.tur:.2g}")
    return message(f"rule: {rule}, TUR {result.tur:.2g}, {risk}")


def advice(result: Verification) -> tuple[str, ...]:
    """Return sentences that explain each kind of statement in the result, and name possible remedies."""
    number = {s: sum(p.statement is s for p in result.points) for s in Statement}
    sentences = {
        Statement.FAIL: message(
            "|Δg| exceeds the limit by more than the guard band; 'bench diagnose' finds the cause in "
            "block, stand or procedure"
        ),
        Statement.INCONCLUSIVE: message(
            f"U, up to {result.expanded * 1e6:.0f} µg, is larger than the limit of "
            f"{result.limit_g * 1e6:.4g} µg, so conformity cannot be decided; reduce U by more passes, a "
            "better voltmeter or a better known stand ('bench budget' shows the largest part)"
        ),
        Statement.CONDITIONAL_FAIL: message(
            "|Δg| exceeds the limit by less than the guard band: the block may still conform; reduce U to "
            "decide ('bench budget' shows its largest part)"
        ),
        Statement.CONDITIONAL_PASS: message(
            "|Δg| is within the limit by less than the guard band: the block may still not conform; reduce "
            "U to decide ('bench budget' shows its largest part)"
        ),
    }
    points = len(result.points)
    found = [
        message(f"at {number[s]} of {points} verification points, {sentence}")
        for s, sentence in sentences.items()
        if number[s]
    ]
    if result.missing:
        found.append(
            message(
                f"{result.missing} verification point{' is' if result.missing == 1 else 's are'} missing; "
                "measure what is missing, as nothing is accepted without it"
            )
        )
    return (*filter(None, [result.contradiction]), *found, *_to_pass(result))


def _to_pass(result: Verification) -> Iterator[str]:
    """Yield a sentence on how the verification could pass, with the largest contributions to u."""
    needed = result.to_pass
    if needed is None:
        return
    point = needed.point
    at = result.points.index(point)
    parts = {name: math.sqrt(max(part[at, at], 0.0)) for name, part in result.contributions.items()}
    most = sorted(parts, key=lambda name: -parts[name])[:_MOST]
    of_which = ", ".join(
        message(f"{parts[name] * 1e6:.0f} µg from {name.replace('_', ' ')}") for name in most
    )
    of_which = f": {of_which}" if most else ""
    smaller = (
        message("no reduction of u suffices")
        if needed.u_times is None
        else message(f"reduce u(Δg) to {needed.u_times * point.u * 1e6:.3g} µg")
    )
    yield message(
        f"to pass: {smaller} at {place_in_words(point)} (now {point.u * 1e6:.3g} µg"
        f"{of_which}), or agree on a limit of at least {math.ceil(needed.limit_g * 1e6)} µg"
    )


def global_risk_in_words(result: Verification) -> tuple[str, ...]:
    """Return a sentence on the global risks for the stated population; empty if no population is stated."""
    risk, population = result.global_risk_of_all, result.population
    if risk is None or population is None:
        return ()
    return (
        message(
            f"of all blocks with Δg of mean {population.mean * 1e6:.3g} µg and standard deviation "
            f"{population.standard_deviation * 1e6:.3g} µg, as stated, this check accepts "
            f"{probability_in_words(risk.false_accept)} without conforming and does not accept "
            f"{probability_in_words(risk.false_reject)} that conform (global risks of all points); the "
            "risks of this block are those of one of them that was measured so (JCGM 106:2012, A.4)"
        ),
    )
