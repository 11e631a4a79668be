"""Choice of what to measure next, judged on the readings that each procedure would give."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import count
from pathlib import Path
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import Floats
from bench.base.computing import tracked
from bench.base.languages import message
from bench.config.bench_file.file import BenchFile
from bench.config.procedure.check import check
from bench.config.procedure.load import Procedure, load_procedure
from bench.config.procedure.plan import Plan, Read, SelectInput, SetTemperature
from bench.config.shipped import PROCEDURES, shipped_folder
from bench.diagnosis.gap import LEAST_FALL
from bench.diagnosis.levels import NEGLIGIBLE, OFTEN
from bench.diagnosis.linear import LinearSystem, make_linear
from bench.diagnosis.naming import ALIAS
from bench.diagnosis.result import Diagnosis
from bench.diagnosis.visibility import ReadingDesign, form_of, forms_everywhere, forms_of, half_power
from bench.model.conditions import Conditions
from bench.model.effects import CATALOGUE
from bench.model.forward import ForwardModel
from bench.model.geometry import Block
from bench.readings.table import (
    REFERENCE,
    REFERENCE_V,
    SHORTED,
    UNORIENTED,
    JoinedPart,
    Readings,
    make_readings,
    together,
)


def planned_readings(
    plan: Plan,
    model: ForwardModel,
    block: Block,
    *,
    temperature_c: float = float("nan"),
    line_hz: float = 50.0,
    unit: str = "V",
) -> Readings:
    """Return the readings that a plan would give on a stand without errors, in the order of measurement.

    Times are expected ones, at the mains frequency `line_hz`, Hz. The temperature is `temperature_c`, °C, until the
    plan sets another. The signals are those of `block` without effects, in `unit`. Raises `KeyError` if the model
    lacks an installation of the plan.
    """
    reads: list[Read] = []
    states: list[tuple[float, float, float]] = []
    now_s, now_v = 0.0, float("nan")
    for step in plan.steps:
        match step:
            case Read():
                reads.append(step)
                states.append((now_s, temperature_c, now_v))
            case SetTemperature():
                temperature_c = step.target_c
            case SelectInput():
                now_v = {"signal": float("nan"), "short": 0.0}.get(step.source, step.reference_v or 0.0)
        now_s += plan.step_duration_s(step, line_hz)
    time_s, warmth_c, volts = np.array(states).T
    angle_rad = np.array([np.nan if r.target_rad is None else r.target_rad for r in reads])
    table = make_readings(
        [r.installation for r in reads],
        [r.pass_number for r in reads],
        [r.point for r in reads],
        angle_rad,
        np.zeros((len(reads), 3)),
        source=plan.name,
        unit=unit,
        target_rad=angle_rad,
        series=[r.series for r in reads],
        direction=[r.direction or 0 for r in reads],
        time_s=time_s,
        temperature_c=warmth_c,
        samples=[r.samples for r in reads],
        scan_order=[r.scan for r in reads] if any(r.scan for r in reads) else None,
    )
    if any(label == REFERENCE for label in table.installation):
        stated = [
            "" if r.installation != REFERENCE else repr(v) for r, v in zip(reads, volts.tolist(), strict=True)
        ]
        table = replace(table, extra={**table.extra, REFERENCE_V: np.array(stated, dtype=np.str_)})
    return replace(table, signal=_signals(table, model, block, volts))


def _signals(table: Readings, model: ForwardModel, block: Block, volts: Floats) -> Floats:
    first = next(iter(model.installations))
    inputs = np.isin(table.installation, [SHORTED, REFERENCE])
    placed = replace(
        table,
        installation=np.where(inputs, first, table.installation),
        angle_rad=np.where(np.isfinite(table.angle_rad), table.angle_rad, 0.0),
    )
    conditions: Conditions = placed.conditions()
    force = replace(model, effects=()).specific_force(
        conditions, np.zeros((len(conditions.mounts), 5)), block
    )
    return np.where(inputs[:, None], volts[:, None], block.output(force))


def following(first: Readings, plan: Plan, model: ForwardModel, block: Block, line_hz: float) -> Readings:
    """Return the readings `first` and then those of a plan (`planned_readings`).

    The temperature stays at its last value in `first` until the plan sets another.
    """
    known = first.temperature_c[np.isfinite(first.temperature_c)]
    warmth = float(known[-1]) if len(known) else float("nan")
    planned = planned_readings(plan, model, block, temperature_c=warmth, line_hz=line_hz, unit=first.unit)
    both = together([JoinedPart(first), JoinedPart(planned)])
    # the clock continues after the first run, so that effects which have settled stay settled
    return both if first.began_s is not None else replace(both, began_s=None)


MENU: Final = (
    "verification", "calibration", "inputs", "return", "turn-12", "remount-180", "remount-90", "discerning",
    "turn-24",
)  # fmt: skip
"""Names of the shipped procedures that may be proposed."""

SEPARATED: Final = 2.0 * LEAST_FALL
"""Least divergence D of two explanations that count as separated; it corresponds to four standard deviations.

Noise then makes the wrong one likelier in 2.3 % of runs, as often as it gives a decrease by `LEAST_FALL`.
"""


@dataclass(frozen=True)
class Separation:
    """Divergence D of an effect from one that the readings do not exclude, before and after a procedure.

    D is the expected ln of the odds of the true effect against the other; a larger D separates them better.
    """

    effect: str
    other: str
    before: float
    after: float

    @property
    def settled(self) -> bool:
        """Whether the readings distinguish the two effects after the procedure: D is at least `SEPARATED`."""
        return self.after >= SEPARATED


@dataclass(frozen=True)
class Chance:
    """The `hours` that a procedure takes, and the probability `answers` that it settles all names.

    The name of an effect is settled if one candidate reaches a posterior probability of 1 - `OFTEN`.
    """

    procedure: str
    hours: float
    answers: float


def answers(odds: Mapping[str, float], gained: Mapping[str, float], first: str) -> float:
    """Return the probability that further readings decide between the name of an effect found and its rivals.

    They decide if a name reaches a posterior probability of 1 - `OFTEN`. `odds` maps the name found, `first`,
    and its rivals to their present probabilities. `gained` maps rivals to the increase d of their divergence
    from `first` (-inf: never distinguished). ln of the odds of the true name increases by a normal number of
    mean d and variance 2 d. If `first` is true, only the rival that is hardest to separate counts.
    """
    enough = math.log((1.0 - OFTEN) / OFTEN)

    def reached(one: str, other: str, d: float) -> float:
        if d == -math.inf:
            return 0.0
        mean, spread = math.log(odds[one] / odds[other]) + d, math.sqrt(2.0 * max(d, NEGLIGIBLE))
        return float(special.ndtr((mean - enough) / spread) + special.ndtr((-enough - mean) / spread))

    rivals = [name for name in gained if odds.get(name, 0.0) > 0.0]
    told = odds[first] * min((reached(first, other, gained[other]) for other in rivals), default=1.0)
    told += sum(odds[other] * reached(other, first, gained[other]) for other in rivals)
    return told / (odds[first] + sum(odds[other] for other in rivals))


@dataclass(frozen=True)
class Proposal:
    """The procedure proposed as the next measurement: its file `source`, its duration, and the reason `why`.

    `settles` are pairs of effects that it separates better; `shows` are hidden effects that it would show.
    `left_out` maps procedures not considered to reasons. `written` is the path of a copy that begins with
    `why` (`write`). With `settles`, `chances` has durations and probabilities of the procedures, best first.
    """

    why: str
    source: Path
    minutes: float
    settles: tuple[Separation, ...] = ()
    shows: tuple[str, ...] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)
    written: Path | None = None
    chances: tuple[Chance, ...] = ()

    @property
    def surer(self) -> Chance | None:
        """The entry of the proposed procedure in `chances`; None if `chances` is empty."""
        return next((one for one in self.chances if one.procedure == self.name), None)

    @property
    def name(self) -> str:
        """The name of the procedure."""
        return self.source.stem

    @property
    def procedure(self) -> Path:
        """The file to carry out: the written copy if there is one, otherwise the original procedure."""
        return self.written or self.source

    def write(self, path: Path) -> Proposal:
        """Write a copy of the procedure that begins with the reason to `path`; return the proposal with its path.

        If the file exists with other contents, a number is added to its name. Raises `OSError` if the copy cannot
        be written.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = textwrap.wrap(f"Proposed: {self.why}", 108, break_on_hyphens=False)
        head = "".join(f"# {line}\n" for line in lines)
        text = f"{head}#\n{self.source.read_text(encoding='utf-8')}"
        for number in count(1):
            free = path if number == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}")
            try:
                with free.open("x", encoding="utf-8") as file:
                    file.write(text)
            except FileExistsError:
                if not free.is_file() or free.read_bytes() != text.encode():
                    continue
            break
        return replace(self, written=free)


def propose(diagnosis: Diagnosis, bench: BenchFile, menu: Sequence[Path] | None = None) -> Proposal | None:
    """Return the procedure to carry out next after a diagnosis; None if none helps.

    For the verdict "confounded", it is the shortest that separates the most pairs of effects between which the
    readings do not decide. If none separates a pair, it is the one that increases D (`Separation`) most per minute.
    For "named" and "agrees", it is the shortest that shows the most hidden effects. For "mistake" and "unknown",
    nothing is proposed. `menu` (default: `MENU`) are files of procedures; a file that includes others is ignored.
    """
    if diagnosis.verdict in {"mistake", "unknown"}:
        return None
    folder = shipped_folder(PROCEDURES)
    paths = [folder / f"{name}.yaml" for name in MENU] if menu is None else menu
    bill = _Bill(diagnosis, bench, paths)
    return bill.settling() if diagnosis.verdict == "confounded" else bill.showing()


class _Bill:
    """The procedures that a bench can carry out, each with the readings that it would add."""

    def __init__(self, diagnosis: Diagnosis, bench: BenchFile, menu: Sequence[Path]) -> None:
        self._diagnosis = diagnosis
        self._bench = bench
        linear = diagnosis.linear
        self._model = replace(
            linear.model, installations={**bench.installation_models(), **linear.model.installations}
        )
        self._stand_u = {name: spread.u for name, spread in bench.stand_distributions().items()}
        self._forms = [form_of(diagnosis.candidates, f.variant) for f in diagnosis.naming.found]
        self._mounts = [str(mount) for mount in linear.moved.mounts]
        self.left_out: dict[str, str] = {}
        self.plans = dict(self._possible(menu))
        self.minutes = {
            path: plan.expected_duration_s(bench.line_frequency) / 60.0 for path, plan in self.plans.items()
        }

    def _possible(self, menu: Sequence[Path]) -> Iterator[tuple[Path, Plan]]:
        in_volts = self._diagnosis.linear.readings.unit == "V"
        for path in menu:
            procedure = _loaded(path, path.stat().st_mtime_ns)
            problems = check(procedure.plan, self._bench)
            if problems:
                self.left_out[procedure.name] = problems[0]
            elif len(procedure.files) > 1:
                self.left_out[procedure.name] = message("it includes other files")
            elif not in_volts and any(
                isinstance(s, Read) and s.installation in UNORIENTED for s in procedure.plan.steps
            ):
                self.left_out[procedure.name] = message(
                    "it reads voltages, and the readings are in another unit"
                )
            else:
                yield path, procedure.plan

    def _linear(self, plan: Plan | None) -> LinearSystem:
        linear = self._diagnosis.linear
        if plan is None:
            return linear
        both = following(linear.readings, plan, self._model, linear.block, self._bench.line_frequency)
        return make_linear(both, self._model, self._stand_u)

    # --- ties ---------------------------------------------------------------------------------------

    def settling(self) -> Proposal | None:
        """Return the procedure that separates most pairs, else most per minute; None if none helps."""
        before = self._divergences(None)
        bills, chances = [], []
        for path, plan in self.plans.items():
            after = self._divergences(plan)
            chances.append(Chance(path.stem, self.minutes[path] / 60.0, self._answers(before, after)))
            pairs = [Separation(*pair, before[pair], after[pair]) for pair in before]
            helped = tuple(s for s in pairs if s.after - s.before >= ALIAS**2 / 2.0)
            if helped:
                bills.append((path, self.minutes[path], helped))
        if not bills:
            return None
        most = max(_settled(helped) for _, _, helped in bills)
        if most:
            path, minutes, settles = min((b for b in bills if _settled(b[2]) == most), key=lambda b: b[1])
        else:
            path, minutes, settles = max(bills, key=lambda b: sum(s.after - s.before for s in b[2]) / b[1])
        why = _why_settles(settles, path.stem, minutes) + self._without()
        # rounded, so that rounding errors do not decide between equal prospects
        chances.sort(key=lambda one: (-round(one.answers, 9), one.hours))
        return Proposal(why, path, minutes, settles, left_out=self.left_out, chances=tuple(chances))

    def _answers(
        self, before: Mapping[tuple[str, str], float], after: Mapping[tuple[str, str], float]
    ) -> float:
        """Return the probability that all names are settled, from divergences D `before` and `after`."""
        whole = 1.0
        for effect in self._diagnosis.effects:
            gained = {
                other: after[pair] - before[pair] if after[pair] > ALIAS**2 / 2.0 else -math.inf
                for pair in before
                for name, other in [pair]
                if name == effect.name
            }
            odds = {one.name: one.probability for one in effect.odds}
            if gained and odds.get(effect.name, 0.0) > 0.0:
                whole *= answers(odds, gained, effect.name)
        return whole

    def _divergences(self, plan: Plan | None) -> dict[tuple[str, str], float]:
        """Return the divergence D by (effect found, one of its ties); a `plan` adds its readings."""
        diagnosis, linear = self._diagnosis, self._linear(plan)
        result = {}
        for index, effect in enumerate(diagnosis.effects):
            # a family outside the catalogue has no forms with which to predict a further run
            others = [other for other in effect.cannot_tell_from if other in CATALOGUE]
            if not others or not effect.in_catalogue:
                continue
            design = ReadingDesign(linear, diagnosis.noise, self._forms[:index] + self._forms[index + 1 :])
            if plan is not None:
                design.remounted((effect.name, *others), self._mounts)
            for other in others:
                rivals = forms_of(diagnosis.candidates, other)
                result[effect.name, other] = design.divergence(effect.applied, rivals)
        return result

    # --- what is hidden -----------------------------------------------------------------------------

    def showing(self) -> Proposal | None:
        """Return the shortest of the procedures that show the most hidden effects; None if none shows any.

        Effects with plausible sizes below the noise count as hidden, too. A procedure shows an effect if half
        of all runs then find it at twice its plausible size.
        """
        diagnosis = self._diagnosis
        half = half_power(diagnosis.whitened, diagnosis.registered.threshold)
        known = {applied.effect.name for applied in diagnosis.linear.model.effects}
        blind = [
            name
            for name, size in diagnosis.detectable.items()
            if name in CATALOGUE.keys() - known and (name in diagnosis.hidden or size > half)
        ]
        bills = []
        plans = sorted(self.plans.items(), key=lambda item: self.minutes[item[0]]) if blind else []
        for path, plan in tracked(plans, "what to measure next"):
            design = ReadingDesign(self._linear(plan), diagnosis.noise, self._forms)
            forms = {name: forms_everywhere(name) for name in blind}
            design.seen(tuple(part for own in forms.values() for form in own for part in form))
            shown = [name for name, own in forms.items() if design.visible(*own) >= half / 2.0]
            if shown:
                bills.append((path, self.minutes[path], tuple(shown)))
            if len(shown) == len(blind):
                break  # every other procedure takes longer
        if not bills:
            return None
        path, minutes, names = min(bills, key=lambda b: (-len(b[2]), b[1]))
        listed = ", ".join(names)
        why = message(
            f"these readings hardly or never show {listed}; together with the procedure '{path.stem}' "
            f"(about {minutes:.0f} min) they show each of them from twice its plausible size"
        )
        return Proposal(why + self._without(), path, minutes, shows=names, left_out=self.left_out)

    def _without(self) -> str:
        listed = "; ".join(f"{name} ({why})" for name, why in self.left_out.items())
        return message(f". Not possible on this bench: {listed}") if listed else ""


@lru_cache(maxsize=64)
def _loaded(path: Path, modified_ns: int) -> Procedure:
    """Read a procedure once in a process, and again only when its file changes."""
    return load_procedure(path)


def _settled(separations: Sequence[Separation]) -> int:
    return sum(s.settled for s in separations)


def _why_settles(separations: Sequence[Separation], name: str, minutes: float) -> str:
    ties = "; ".join(
        _from_others(effect, [s for s in separations if s.effect == effect])
        for effect in dict.fromkeys(s.effect for s in separations)
    )
    settled = _settled(separations)
    verb = (
        message("separates") if settled == len(separations) else message("separates better, but not surely")
    )
    if 0 < settled < len(separations):
        verb = message("separates some of these")
    return message(
        f"the procedure '{name}' (about {minutes:.0f} min), together with these readings, {verb}: {ties}; "
        f"D is the divergence of two names, and {SEPARATED:g} means four standard deviations"
    )


def _from_others(effect: str, separations: Sequence[Separation]) -> str:
    """Return in words from which other names a procedure separates an effect."""
    first, *rest = separations
    more = "".join(f", {s.other} (D {s.before:.1f} → {s.after:.1f})" for s in rest)
    return message(f"{effect} from {first.other} (D {first.before:.1f} → {first.after:.1f}){more}")
