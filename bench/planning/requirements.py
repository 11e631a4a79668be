"""Settings of the head in a plan, the unknowns that they leave undetermined, and points that would help."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Literal, NamedTuple

import numpy as np

from bench.base.arrays import Floats
from bench.base.languages import message
from bench.calibration.budget.assessment import delta_g_variances, directions, measured
from bench.calibration.budget.coefficients import Budget, Setup, make_budget
from bench.calibration.budget.error_source import ErrorSource
from bench.calibration.design import make_problem
from bench.calibration.observability import (
    DirectionKind,
    Observability,
    axis_in_words,
    observability,
    with_angles,
)
from bench.calibration.result import CalibrationError
from bench.config.procedure.plan import Plan, Read, Turn, Wait
from bench.model.conditions import Conditions, Mounting
from bench.model.forward import ForwardModel
from bench.model.geometry import COEFFICIENTS, Block, Installation
from bench.readings.table import UNORIENTED, VERIFICATION


class Setting(NamedTuple):
    """One reading of a mounted block: mounting, pass and point, head angle, and direction of approach."""

    mount: Mounting
    pass_number: int
    point: int
    angle_rad: float
    direction: int


def conditions_of(settings: Sequence[Setting]) -> Conditions:
    """Return the conditions of readings at these settings, without times and temperatures."""
    return Conditions.of(
        [s.mount.installation for s in settings],
        [s.angle_rad for s in settings],
        series=[s.mount.series for s in settings],
        pass_number=[s.pass_number for s in settings],
        point=[s.point for s in settings],
        direction=[s.direction for s in settings],
    )


def settings_of(plan: Plan) -> list[Setting]:
    """Return the settings at which a plan reads the mounted block, including verification points."""
    return [
        Setting(
            Mounting(step.series, step.installation),
            step.pass_number,
            step.point,
            step.target_rad,
            step.direction or 0,
        )
        for step in plan.steps
        if isinstance(step, Read) and step.target_rad is not None and step.installation not in UNORIENTED
    ]


def mountings_of(plan: Plan) -> dict[Mounting, int]:
    """Return the number of the mounting to which each series of a plan belongs."""
    steps = zip(plan.steps, plan.mountings, strict=True)
    return {
        Mounting(step.series, step.installation): number for step, number in steps if isinstance(step, Read)
    }


def fitted(settings: Iterable[Setting]) -> list[Setting]:
    """Return the settings whose readings take part in the fit of a calibration."""
    return [s for s in settings if s.mount.installation != VERIFICATION]


def verifying(settings: Iterable[Setting]) -> list[Setting]:
    """Return the settings at verification points."""
    return [s for s in settings if s.mount.installation == VERIFICATION]


@dataclass(frozen=True)
class Cost:
    """Expected bench time, s: of a setting with its reading, of a mounting, and of tasks done once."""

    setting_s: float
    mount_s: float
    once_s: float = 0.0

    @classmethod
    def of_plan(cls, plan: Plan, line_hz: float = 50.0) -> Cost:
        """Return the time of an additional setting and of an additional mounting in a plan; `once_s` is 0."""
        reading_s = next((plan.step_duration_s(s, line_hz) for s in plan.steps if isinstance(s, Read)), 0.0)
        setting_s = plan.operator_time.turn_s + _settling_s(plan) + reading_s
        return cls(setting_s, plan.operator_time.mount_s)

    def total_s(self, settings: int, mounts: int) -> float:
        """Return the expected time of a number of settings in a number of mountings, s."""
        return self.once_s + settings * self.setting_s + mounts * self.mount_s

    def settings_within(self, time_s: float, mounts: int) -> int:
        """Return how many settings in `mounts` mountings fit into `time_s`, at least 0."""
        return max(int((time_s - self.total_s(0, mounts)) / self.setting_s + 1e-9), 0)


def _settling_s(plan: Plan) -> float:
    """Return the settling time of the plan's first reading after a turn, s."""
    seconds = 0.0
    turned = False
    for step in plan.steps:
        if isinstance(step, Read) and turned:
            break
        turned = turned or isinstance(step, Turn)
        if isinstance(step, Wait) and turned:
            seconds += step.duration_s
    return seconds


ANGLES: Final = ("axis_tilt", "zero_offset", "mounting_error", "mounting_roll")
"""The stand angles that every mounting has, whatever their size."""

THIRD: Final = Installation.from_axes("3", ("y", "z", "x"))
"""The installation with the block's x along the shaft, which the paper does not use."""

MOST_MOUNTINGS: Final = 24

_PASS_RAD: Final = tuple(np.radians(45.0) * np.arange(9))
_VERIFICATION_RAD: Final = tuple(np.radians([45.0, 135.0, 225.0, 315.0]))
_SHIPPED: Final[Mapping[str, str]] = {
    "1T90": "remount-90", "2T90": "remount-90", "1T180": "remount-180", "2T180": "remount-180",
}  # fmt: skip


@dataclass(frozen=True)
class Remedy:
    """An additional measurement, described in `text`; `cost_s` is its bench time, s."""

    text: str
    cost_s: float


@dataclass(frozen=True)
class Outlook:
    """What planned readings determine, and remedies for coefficients and angles that they leave open.

    `remedies` are the additional measurements that resolve an undetermined direction, cheapest first.
    """

    found: Observability
    remedies: tuple[Remedy, ...]

    @property
    def turns(self) -> list[str]:
        """Axes about which all block axes may rotate together: a convention that no mounting can determine."""
        return [axis_in_words(d.axis) for d in self.found.directions if d.kind is DirectionKind.TURN]

    @property
    def open(self) -> list[str]:
        """The directions in the null space of the fit, other than `turns`, as text."""
        return [d.text() for d in self.found.directions if d.kind is not DirectionKind.TURN]


@dataclass(frozen=True)
class _Candidate:
    text: str
    settings: tuple[Setting, ...] = ()
    modulus: tuple[Setting, ...] = ()
    cost_s: float = 0.0


def outlook(settings: Sequence[Setting], model: ForwardModel, block: Block, cost: Cost) -> Outlook:
    """Return which coefficients and stand angles these settings determine, and remedies for the rest.

    The stand angles are `ANGLES` of each mounting; effects of the model are unknowns, too. If there are more
    than `MOST_MOUNTINGS` mountings, only the first mounting in each installation is analysed. Raises
    `KeyError` for an installation that the model lacks.
    """
    settings = _distinct(settings)
    own = fitted(settings)
    found = _observability(own, (), model, block)
    remedies = []
    if any(d.kind is not DirectionKind.TURN for d in found.directions):
        wider = ForwardModel({**model.installations, THIRD.label: THIRD}, model.effects, model.name)
        for more in _menu(settings, model, cost):
            then = _observability([*own, *more.settings], more.modulus, wider, block)
            if _open_of(then, found.names) < found.null.shape[1]:
                remedies.append(Remedy(more.text, more.cost_s))
    return Outlook(found, tuple(sorted(remedies, key=lambda r: r.cost_s)))


def _distinct(settings: Sequence[Setting]) -> list[Setting]:
    """Return the settings without repeats, which do not increase the rank.

    Of more than `MOST_MOUNTINGS` mountings, only the first in each installation is kept.
    """
    distinct = list({(s.mount, s.angle_rad): s for s in reversed(settings)}.values())[::-1]
    if len({s.mount for s in distinct}) <= MOST_MOUNTINGS:
        return distinct
    first = {s.mount.installation: s.mount for s in reversed(distinct)}
    return [s for s in distinct if s.mount == first[s.mount.installation]]


def _observability(
    settings: Sequence[Setting], modulus: Sequence[Setting], model: ForwardModel, block: Block
) -> Observability:
    problem = with_angles(make_problem(model, conditions_of(settings), {}), ANGLES)
    return observability(problem, block, modulus=conditions_of(modulus) if modulus else None)


def _open_of(found: Observability, names: Sequence[str]) -> int:
    """Return the number of undetermined directions among the unknowns `names`.

    Unknowns of added mountings do not count.
    """
    rows = [found.names.index(name) for name in names]
    return int(np.sum(np.linalg.svd(found.null[rows], compute_uv=False) > 1e-3))


def _menu(settings: Sequence[Setting], model: ForwardModel, cost: Cost) -> list[_Candidate]:
    """Return the additions to try: verification points in the fit, other installations, a return to the first."""
    menu = []
    there = verifying(settings)
    if there:
        text = message("let the verification points join the fit by |a| = 1 g")
        menu.append(_Candidate(text, modulus=tuple(there)))
    elif VERIFICATION in model.installations:
        points = _one_pass(Mounting(1, VERIFICATION), _VERIFICATION_RAD)
        text = message("four verification points (installation V) that join the fit by |a| = 1 g")
        menu.append(_Candidate(text, modulus=points, cost_s=cost.total_s(len(points), 1)))
    visited = {s.mount.installation for s in settings}
    labels = [label for label in model.installations if label not in {VERIFICATION, *visited}]
    for label in dict.fromkeys([*labels, THIRD.label]):
        if label in visited:
            continue
        text = message(f"one pass in installation {label}")
        if label in _SHIPPED:
            text = message(f"{text}, as in the procedure '{_SHIPPED[label]}'")
        elif label not in model.installations:
            text = message(f"{text} (axes [y, z, x]: x along the shaft), to be defined in the bench file")
        menu.append(_with_pass(text, Mounting(1, label), cost))
    if visited - {VERIFICATION}:
        first = next(s.mount.installation for s in settings if s.mount.installation != VERIFICATION)
        series = 1 + max(s.mount.series for s in settings if s.mount.installation == first)
        text = message(f"a return to installation {first}, as in the procedure 'return'")
        menu.append(_with_pass(text, Mounting(series, first), cost))
    return menu


def _with_pass(text: str, mount: Mounting, cost: Cost) -> _Candidate:
    points = _one_pass(mount, _PASS_RAD)
    return _Candidate(text, settings=points, cost_s=cost.total_s(len(points), 1))


def _one_pass(mount: Mounting, angles_rad: Sequence[float]) -> tuple[Setting, ...]:
    return tuple(Setting(mount, 1, point, angle, 1) for point, angle in enumerate(angles_rad, start=1))


Target = Callable[[Budget], Floats]
"""A function from an error budget to the variances (points, sources) of the required quantity.

The sources are in the order of the budget's contributions. Each point (a verification point, a direction) has to
meet the accuracy.
"""

BEYOND: Final[Mapping[str, float]] = {"rad": math.radians(5.0), "V": 10.0, "K": 100.0, "1": 1.0}
"""Standard uncertainties larger than those of any bench, by unit; a larger limit counts as infinite."""
_DIRECTIONS: Final = 100
_PRECISE: Final = 1e-8
_ROUNDS: Final = 60
_DECADES: Final = 5
_ROUNDING: Final = 1e-6
_SETTLED: Final = 1e-4
_LEAST_PART: Final = 1e-9
_NO_BALANCE: Final = message("no balanced set of sizes was found; use the limits of each error alone")


def of_delta_g(*, reading: bool) -> Target:
    """Return a function for the variances of Δg at the verification points by source, (points, sources).

    With `reading`, they include the errors of the readings at these points.
    """

    def variances(budget: Budget) -> Floats:
        found = delta_g_variances(budget, reading=reading)
        if not len(found):
            raise CalibrationError("the procedure has no verification point to show Δg; choose one with some")
        return found

    return variances


def of_coefficient(name: str) -> Target:
    """Return a function for the variances of the coefficient `name` by source, shape (1, sources).

    Raises `CalibrationError` for an unknown name.
    """
    if name not in COEFFICIENTS:
        raise CalibrationError(f"no coefficient {name!r}; choose from {', '.join(COEFFICIENTS)}")
    index = COEFFICIENTS.index(name)
    return lambda budget: np.array([[c.u[index] ** 2 for c in budget.contributions]])


def of_acceleration(magnitude_g: float, *, reading: bool, modulus: bool) -> Target:
    """Return a function for the variances of a measured acceleration by source, (directions, sources).

    They are sums over three components or, with `modulus`, variances of the modulus; with `reading`, they
    include the errors of the reading. They are convex in `magnitude_g`, so smaller magnitudes are covered.
    """
    force = magnitude_g * directions(_DIRECTIONS)

    def variances(budget: Budget) -> Floats:
        found = measured(budget, force, reading=reading)
        by_source = found.by_source.values()
        if modulus:
            return np.stack([found.modulus_variance(c) for c in by_source], axis=1)
        return np.stack([np.trace(c, axis1=1, axis2=2) for c in by_source], axis=1)

    return variances


@dataclass(frozen=True)
class Limit:
    """The largest standard uncertainty `u` of an error source with which the accuracy is still met.

    `u` is infinite if the accuracy is met with any u of the source, and None if it is not met even without the
    source.
    """

    source: ErrorSource
    u: float | None

    @property
    def verdict(self) -> Literal["limit", "no limit", "cannot be reached"]:
        """The kind of limit: "no limit" for an infinite `u`, "cannot be reached" for None."""
        if self.u is None:
            return "cannot be reached"
        return "no limit" if math.isinf(self.u) else "limit"

    @property
    def stated(self) -> float | None:
        """The limit as in a bench file, half-width or k standard deviations; None unless `u` is finite."""
        if self.u is None or math.isinf(self.u):
            return None
        return self.u / replace(self.source.distribution, limit=1.0).u


@dataclass(frozen=True)
class Requirement:
    """A requirement: `k` standard uncertainties of a quantity must not exceed `accuracy`, in its unit.

    `target` returns the variances of the quantity by point and source, for coefficients that `estimator`
    finds from the readings of `setup`.
    """

    setup: Setup
    sources: tuple[ErrorSource, ...]
    estimator: str
    target: Target
    accuracy: float
    k: float

    def __post_init__(self) -> None:
        for name, value in ((message("the accuracy"), self.accuracy), ("k", self.k)):
            if not (math.isfinite(value) and value > 0):
                raise CalibrationError(f"{name} must be a positive number, not {value:g}")

    @property
    def allowed2(self) -> float:
        """The variance of the target that the accuracy permits."""
        return (self.accuracy / self.k) ** 2

    def by_point(self, sizes: Mapping[str, float]) -> Floats:
        """Return the variances of the target at each point by source, (points, sources).

        `sizes` holds standard uncertainties by name of source. A source without an entry keeps its u from the bench
        file. The estimator weights the readings by these uncertainties.
        """
        sized = [s.sized(sizes[s.name]) if s.name in sizes else s for s in self.sources]
        return self.target(make_budget(self.setup, sized, self.estimator))

    def variances(self, sizes: Mapping[str, float]) -> Floats:
        """Return the variances by source (s,) at the worst point; for `sizes` see `by_point`."""
        found = self.by_point(sizes)
        return np.asarray(found[int(np.argmax(found.sum(axis=1)))])

    def reached(self, sizes: Mapping[str, float] | None = None) -> float:
        """Return k u of the target at the worst point; for `sizes` see `by_point` (None: empty)."""
        if not sizes:
            return self.k * math.sqrt(float(self._own.sum()))
        return self.k * math.sqrt(float(self.variances(sizes).sum()))

    @cached_property
    def _own(self) -> Floats:
        return self.variances({})

    def keeps(self, reached: float) -> bool:
        """Return whether `reached` (k u) is at most the accuracy plus a margin for rounding."""
        return reached <= self.accuracy * (1.0 + _ROUNDING)

    def shares(self) -> dict[str, float]:
        """Return each source's fraction of the variance at the worst point, for the u in the bench file."""
        total = float(self._own.sum())
        return {s.name: float(v) / total for s, v in zip(self.sources, self._own, strict=True)}

    # --- each alone ---------------------------------------------------------------------------------

    def alone(self, source: ErrorSource) -> Limit:
        """Return the limit of one source while all other sources keep their u from the bench file."""

        def excess(u: float) -> float:
            return float(self.variances({source.name: u}).sum()) / self.allowed2 - 1.0

        beyond = BEYOND.get(source.unit, 1.0)
        if excess(beyond) <= 0.0:
            return Limit(source, math.inf)
        start = min(source.u or 1e-6 * beyond, beyond / 2)
        # a larger error may be less harmful, because an estimator that assumes perfect readings overweights them
        sizes = [start, *(start / 10**i for i in range(1, _DECADES)), 0.0]
        kept = next((size for size in sizes if excess(size) <= 0.0), None)
        if kept is None:
            return Limit(source, None)
        low, high = self._bracket(excess, kept, kept or sizes[-2], beyond)
        from scipy.optimize import brentq  # takes long to import, and each `bench check` needs this module

        u = math.exp(brentq(lambda x: excess(math.exp(x)), math.log(low), math.log(high), xtol=_PRECISE))
        return Limit(source, u)

    @staticmethod
    def _bracket(
        excess: Callable[[float], float], kept: float, size: float, beyond: float
    ) -> tuple[float, float]:
        """Return two u, a factor of ten apart or less, at which `excess` has opposite signs."""
        if kept == 0.0:
            while excess(size / 10) > 0.0:
                size /= 10
            return size / 10, size
        while size * 10 < beyond and excess(size * 10) <= 0.0:
            size *= 10
        return size, min(size * 10, beyond)

    # --- all together -------------------------------------------------------------------------------

    def balanced(self, names: Sequence[str], weights: Mapping[str, float] | None = None) -> list[Limit]:
        """Return standard uncertainties of the named sources with which the accuracy is just met.

        Without weights, each named source receives an equal part of the variance that the unnamed sources leave,
        judged at the point where it contributes most. With weights (default 1), the cost of a source is its
        weight divided by the ratio of its new u to its u in the bench file. The total cost is least for parts
        in proportion to (weight × present contribution)^(2/3). A source that stays below its part at any u
        has no limit; the remaining sources share its part. Raises `CalibrationError` if nothing is left to
        share.
        """
        own = {s.name: s for s in self.sources}
        parts = self._parts(names, weights)
        sizes = {name: own[name].u or 1e-3 * BEYOND.get(own[name].unit, 1.0) for name in names}
        free: set[str] = set()
        for _ in range(_ROUNDS):
            points = self.by_point(sizes)
            fixed = [i for i, name in enumerate(own) if name not in names or name in free]
            left = self.allowed2 - float(points[:, fixed].sum(axis=1).max())
            found = dict(zip(own, points.max(axis=0), strict=True))
            if left <= 0.0:
                raise CalibrationError(_NO_BALANCE if free else self._exceeded(names))
            bound = [name for name in names if name not in free]
            total = sum(parts[name] for name in bound)
            factors = {n: _factor(found[n], left * parts[n] / total) for n in bound}
            beyond = {n for n in bound if sizes[n] * factors[n] >= BEYOND.get(own[n].unit, 1.0)}
            sizes |= {n: sizes[n] * factors[n] for n in bound}
            sizes |= {n: BEYOND.get(own[n].unit, 1.0) for n in beyond}
            free |= beyond
            moved = math.inf if beyond else max((abs(math.log(f)) for f in factors.values()), default=0.0)
            if moved < _SETTLED:
                break
        return self._settled(own, sizes, free)

    def _exceeded(self, names: Sequence[str]) -> str:
        return message(
            f"{self.accuracy:.3g} cannot be reached for any size of {', '.join(names)}: the other errors alone "
            "exceed it; 'bench budget' shows them"
        )

    def _parts(self, names: Sequence[str], weights: Mapping[str, float] | None) -> dict[str, float]:
        if weights is None:
            return dict.fromkeys(names, 1.0)
        now = np.sqrt(self.by_point({}).max(axis=0))
        cost = {s.name: weights.get(s.name, 1.0) * float(u) for s, u in zip(self.sources, now, strict=True)}
        least = _LEAST_PART * max(cost.values())
        return {name: max(cost[name], least) ** (2 / 3) for name in names}

    def _settled(
        self, own: Mapping[str, ErrorSource], sizes: dict[str, float], free: set[str]
    ) -> list[Limit]:
        """Return all limits after scaling their u by a common factor, so that the accuracy is just met."""

        def excess(log_factor: float) -> float:
            scaled = {n: u if n in free else u * math.exp(log_factor) for n, u in sizes.items()}
            return float(self.variances(scaled).sum()) / self.allowed2 - 1.0

        if len(free) < len(sizes):
            width = 0.01
            while excess(-width) > 0.0 or excess(width) < 0.0:
                width *= 2.0
                if width > 50.0:
                    raise CalibrationError(_NO_BALANCE)
            from scipy.optimize import brentq

            factor = math.exp(brentq(excess, -width, width, xtol=_PRECISE))
            sizes = {n: u if n in free else u * factor for n, u in sizes.items()}
        return [Limit(own[n], math.inf if n in free else u) for n, u in sizes.items()]


def _factor(variance: float, allowed: float) -> float:
    """Return the factor by which the u of a source must change so that its variance becomes `allowed`."""
    return math.sqrt(allowed / variance) if variance > 0.0 else math.inf
