"""The verdict on verification points, and the limit and rule on which it is based."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console

from bench.base.arrays import Floats
from bench.base.languages import message
from bench.base.tables import as_html, as_text
from bench.calibration import Calibration, CalibrationError, LackOfFit
from bench.calibration.budget.sources import hidden_sources
from bench.calibration.budget.whole import delta_g_contributions, delta_g_elsewhere, without_meters
from bench.calibration.components import note_on_excess
from bench.calibration.conformity import SIMPLE, DecisionRule, Population
from bench.calibration.mistakes import implausible
from bench.calibration.noise import ONE_TEMPERATURE_K, drifted
from bench.calibration.verification import StatedOrientation, Verification, points_of
from bench.calibration.verification import verify as check
from bench.config.bench_file.file import BenchFile
from bench.readings.corrected import VOLTS
from bench.results import verification as shown
from bench.run.events import VerdictAsked
from bench.run.folder import Run
from bench.services.coefficients import Coefficients
from bench.services.errors import Refused
from bench.services.requests.evaluation import Judging
from bench.services.source import Source, time_of


@dataclass(frozen=True)
class VerdictOptions:
    """Options of a verdict that replace the values of the bench file; None keeps a value.

    `limit_g` is the limit of |Δg| in g, `rule` the name of the decision rule, `guard_band` its guard band in
    multiples of U. `population` is the mean and the standard deviation of Δg over many blocks, in g.
    """

    limit_g: float | None = None
    rule: str | None = None
    guard_band: float | None = None
    population: tuple[float, float] | None = None

    @classmethod
    def of(cls, request: Judging) -> VerdictOptions:
        """Return the verdict options of a request. Raises `Refused` for invalid ones."""
        asked = cls(request.limit, request.rule, request.guard_band, request.population)
        asked.check()
        return asked

    @classmethod
    def of_run(cls, run: Run | None) -> VerdictOptions:
        """Return the verdict options with which a run was begun; no options without a run."""
        recorded = {} if run is None else run.manifest.get("verdict", {})
        return cls(recorded.get("limit_g"), recorded.get("rule"), recorded.get("guard_band"))

    def recorded(self) -> VerdictAsked:
        """Return limit, rule and guard band, if set, for a run's record. Raises `Refused` for invalid options."""
        self.check()
        record: VerdictAsked = {}
        if self.limit_g is not None:
            record["limit_g"] = self.limit_g
        if self.rule is not None:
            record["rule"] = DecisionRule.of(self.rule).name
        if self.guard_band is not None:
            record["guard_band"] = self.guard_band
        return record

    def check(self) -> None:
        """Raise `Refused` with all invalid values among limit, rule, guard band and population."""
        mistakes = []
        if self.limit_g is not None and not (math.isfinite(self.limit_g) and self.limit_g > 0):
            mistakes.append(message(f"--limit {self.limit_g}: give a positive limit in g, such as 3e-4"))
        try:
            DecisionRule.of(self.rule, self.guard_band)
        except CalibrationError as mistake:
            mistakes.append(str(mistake))
        try:
            if self.population is not None:
                Population(*self.population)
        except CalibrationError as mistake:
            mistakes.append(str(mistake))
        if mistakes:
            raise Refused("; ".join(mistakes))


NOTHING_ASKED: Final = VerdictOptions()
NOBODY_STATED_ONE: Final = DecisionRule()


@dataclass(frozen=True)
class Judgement:
    """The basis of a verdict: limit of |Δg| in g, decision rule, and the population of Δg over many blocks."""

    limit_g: float
    rule: DecisionRule
    population: Population | None

    def but(self, asked: VerdictOptions) -> Judgement:
        """Return this basis changed by the options `asked`; a new decision rule discards the old guard band."""
        rule = self.rule
        if asked.guard_band is not None:
            rule = DecisionRule.of(asked.rule or rule.name, asked.guard_band)
        elif asked.rule is not None:
            named = DecisionRule.of(asked.rule)
            rule = rule if named.name == rule.name and rule.guard_band is not None else named
        return Judgement(
            self.limit_g if asked.limit_g is None else asked.limit_g,
            rule,
            self.population if asked.population is None else Population(*asked.population),
        )


def judgement_of(
    bench: BenchFile, *asked: VerdictOptions, default: DecisionRule = NOBODY_STATED_ONE
) -> Judgement:
    """Return the basis of a verdict: values of the bench file, replaced by the options `asked`.

    Later options override earlier ones. If no decision rule is named, it is `default`. Raises `Refused` for invalid
    options, and `CalibrationError` for a guard band with a rule that has none.
    """
    stated, known = bench.verification, bench.verification.population
    judgement = Judgement(
        stated.limit,
        DecisionRule.of(stated.rule, stated.guard_band) if stated.names_a_rule else default,
        None if known is None else Population(known.mean, known.standard_deviation),
    )
    for one in asked:
        one.check()
        judgement = judgement.but(one)
    return judgement


def own_judgement(
    source: Source, asked: VerdictOptions | None = None, agreed: DecisionRule | None = None
) -> Judgement:
    """Return the basis of a source's verdict: the options `asked`, else those of its run, else its bench file.

    If none of them names a decision rule, it is `agreed` or, if that is None, the run's default rule.
    """
    options = (VerdictOptions.of_run(source.run), asked or NOTHING_ASKED)
    return judgement_of(source.bench, *options, default=agreed or _default_of(source.run))


def _default_of(run: Run | None) -> DecisionRule:
    """Return the rule that was the default when a run was begun; without a run, the present default."""
    if run is None:
        return NOBODY_STATED_ONE
    recorded = run.manifest.get("default_rule")
    return DecisionRule.of(SIMPLE) if recorded is None else DecisionRule.of_json(recorded)


@dataclass(frozen=True)
class VerificationResult:
    """Δg at the verification points of a source against the limit.

    `warnings` are sentences on unsuitable coefficients and overruled early warnings, `said` sentences on the
    uncertainty. `fit` is the lack-of-fit test of coefficients from the same readings, None for coefficients
    of another calibration.
    """

    source: Source
    verification: Verification
    warnings: tuple[str, ...] = ()
    said: tuple[str, ...] = ()
    fit: LackOfFit | None = None

    @property
    def accepted(self) -> bool:
        """The same as `passed`."""
        return self.passed

    @property
    def passed(self) -> bool:
        """Whether every point was measured and accepted; no point is accepted if the model does not fit."""
        return self.verification.passed

    @property
    def statement(self) -> str:
        """The overall statement: pass, conditional pass, conditional fail, fail, or why there is none.

        The statement is "inconclusive" if U exceeds the limit, "not complete" if a point was not measured, and
        "does not fit" if the readings of the calibration contradict the model.
        """
        return str(self.verification.statement)

    @property
    def otherwise(self) -> bool:
        """Whether limit, rule or population differ from the source's own: those of its run or bench file."""
        own, found = own_judgement(self.source), self.verification
        return Judgement(found.limit_g, found.decision, found.population) != own

    @property
    def bench(self) -> str:
        """The name of the bench file that states limit, rule, stand errors and gravity, and why it was chosen."""
        return self.source.taken.words

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on the meaning of the statements, on remedies, and on the global risk of the rule."""
        return (*shown.advice(self.verification), *shown.global_risk_in_words(self.verification))

    @property
    def _against(self) -> tuple[str, ...]:
        """Sentences on the lack of fit, if the coefficients were estimated from the same readings."""
        return () if self.fit is None else self.fit.diagnose(self.source.typed)

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the reader of the result, a sentence each."""
        return (*self.said, *self.source.readings.notes, *self.source.readings.skipped, *self.sentences)

    def result(self) -> shown.VerifyResult:
        """Return the result of `bench verify`."""
        return shown.verify_result(
            self.verification,
            notes=[*self.warnings, *self.said, *self.sentences, *self._against],
            warnings=[*self.warnings],
            bench=self.source.taken.part(),
            corrections=self.source.traced.parts(),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the result as `bench verify --json` writes it."""
        return self.result().to_dict()

    def verdict(self) -> str:
        """Return the verdict in one line, with the objections to the coefficients, if any."""
        line = shown.verdict_line(self.source.name, self.verification)
        return "; ".join((line, *self._against, *self.warnings))

    def print_on(self, out: Console) -> None:
        """Print Δg at each verification point, and the notes."""
        shown.print_verification(self.verification, self.notes, out)

    def __repr__(self) -> str:
        """Return the points and the verdict."""

        def print_on(out: Console) -> None:
            out.print(shown.verification_table(self.verification))
            for line in self._below():
                out.print(line)

        return as_text(print_on)

    def _repr_html_(self) -> str:
        return as_html([], shown.verification_table(self.verification)) + as_html(self._below())

    def _below(self) -> list[str]:
        return [f"bench: {self.bench}", *(f"note: {note}" for note in self.notes), self.verdict()]


def judged(
    source: Source,
    judgement: Judgement,
    taken: Coefficients,
    own: Calibration | None = None,
    warnings: tuple[str, ...] = (),
) -> VerificationResult:
    """Verify a source with the coefficients `taken`; `own` is their calibration if it used the same readings.

    Raises `CalibrationError` if there is no verification point.
    """
    points_of(source.readings)
    said = without_meters(source.readings.unit)
    warnings = (*warnings, *overruled_in(source.run))
    if own is None:
        covariance, of_day = _of_another_day(taken, source)
        said = (*said, *of_day)
        joint = {"coefficients and readings": covariance}
    else:
        said = (*said, *note_on_excess(own.noise))
        warnings = (*implausible(own, source.bench.unit_under_test.scale_factors.values), *warnings)
        joint = delta_g_contributions(
            own, source.readings, source.bench, source.model, source.traced.day, source.known_meters
        )
    verdict = check(
        source.readings,
        taken.block,
        taken.covariance,
        taken.noise,
        judgement.limit_g,
        taken.g_m_s2 / source.g_m_s2,
        judgement.rule,
        joint=joint,
        population=judgement.population,
        fits=taken.fits,
        stated=StatedOrientation.of(
            source.model, {**source.stand_u, **source.assumed_u}, taken.block, taken.covariance
        ),
    )
    return VerificationResult(source, verdict, warnings, said, None if own is None else own.lack_of_fit)


def overruled_in(run: Run | None) -> tuple[str, ...]:
    """Return a sentence for each early warning that a person overruled and whose readings were not repeated."""
    overruled = [] if run is None else run.history.not_repaired()[1]
    if not overruled:
        return ()
    from bench.run.sentences import sentence

    return tuple(map(sentence, overruled))


def _of_another_day(taken: Coefficients, source: Source) -> tuple[Floats, tuple[str, ...]]:
    """Return the covariance of |a| at the points by coefficients of an earlier day, and a sentence on it.

    Errors of the same meters cancel. The longer ago the calibration was, the less they cancel, because meters
    drift.
    """
    known = taken.covariance if taken.same_meters is None else taken.same_meters
    known_c = np.isfinite(source.readings.verification().temperature_c).any()
    at_c = taken.temperature_c if known_c and math.isfinite(taken.temperature_c) else None
    part = drifted((taken.meters, time_of(taken.made_at)), (source.meters, time_of(source.made_at)))
    noise = np.full(3, taken.noise) if taken.channel_noise is None else taken.channel_noise
    joint, said = np.zeros((0, 0)), ""
    for covariance, same, weight in ((known, True, 1.0 - part), (taken.covariance, False, part)):
        found = delta_g_elsewhere(
            taken.block, covariance, noise, source.readings, source.bench, source.model,
            same_meters=same, day=source.traced.day, block_terms=taken.block_terms,
            meters=source.known_meters, calibrated_c=at_c, shared=taken.shared, wander=taken.wander,
        )  # fmt: skip
        joint = weight * found if same else joint + weight * found
    if taken.same_meters is None:
        said = message(
            "the coefficients are from an earlier version: their uncertainty covers the readings alone"
        )
    elif source.readings.unit != VOLTS:
        said = ""  # no meters of the bench read these signals
    elif part == 0.0:
        said = message("the same meters as at the calibration, on one day: their gain and offset cancel")
    elif part < 1.0:
        said = message(
            f"the same meters as at the calibration: {part:.0%} of their limits is included, for their drift"
        )
    else:
        said = message("perhaps other meters than at the calibration: u includes gain and offset of both")
    if taken.g_m_s2 != source.g_m_s2:
        there = {error.name: error.u for error in hidden_sources(source.bench, source.model)}.get(
            "gravity", 0.0
        )
        joint = joint + taken.gravity_u**2 + there**2
    return joint, (*filter(None, [said]), *_on_temperature(taken, source))


def _on_temperature(taken: Coefficients, source: Source) -> Iterator[str]:
    """Yield a sentence if the block was at another temperature than at its calibration."""
    at_c = source.readings.verification().temperature_c
    if not np.isfinite(at_c).any() or not math.isfinite(taken.temperature_c):
        return
    now_c = float(np.nanmean(at_c))
    if abs(now_c - taken.temperature_c) > ONE_TEMPERATURE_K:
        yield (
            f"calibrated at {taken.temperature_c:.1f} °C, verified at {now_c:.1f} °C: u contains the temperature "
            "coefficients of the block for this difference"
        )


def unsuitable(taken: Coefficients, name: str, source: Source) -> Iterator[str]:
    """Yield a warning for coefficients of the calibration `name` that do not suit the readings of a source.

    Raises `Refused` if they were fitted to the verification points that are to be judged.
    """
    if taken.joined and _same_readings(taken, source):
        raise Refused(
            f"{name}: the verification points of {source.name} joined the fit of these coefficients and cannot "
            "verify them; calibrate without --join-verification"
        )
    if taken.block_name and source.block_name not in ("", taken.block_name):
        yield (
            f"THE COEFFICIENTS ARE OF ANOTHER BLOCK, as recorded: {name} is of '{taken.block_name}', "
            f"{source.name} of '{source.block_name}'"
        )
    if not taken.fits:
        yield f"the readings that gave the coefficients in {name} contradict the model: no point is accepted"
    if taken.simulated and not source.simulated:
        yield f"the coefficients in {name} were found on simulated instruments"


def _same_readings(taken: Coefficients, source: Source) -> bool:
    """Return whether coefficients were fitted to the readings of a source.

    They were if both were begun at the same time or, without a time, if both name the same file.
    """
    if taken.made_at:
        return taken.made_at == source.made_at
    return Path(taken.joined).resolve() == Path(source.name).resolve()
