"""What readings can show: hidden effects, the separation of two explanations, patterns of residuals."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby, product
from typing import Final, NamedTuple

import numpy as np
from scipy import special

from bench.base.arrays import CHANNELS, Floats, Mask
from bench.base.languages import message
from bench.base.text import LISTED
from bench.diagnosis.candidates import ROUND, Candidates, Variant, plausible_columns
from bench.diagnosis.evidence import BEYOND_BELIEF, KNOWN_SIZE, Search, Threshold, Whitened
from bench.diagnosis.levels import ALIKE, BY_CHANCE, CHUNK, FAR, INSEPARABLE, MARK_DEG, NEGLIGIBLE
from bench.diagnosis.linear import MODULUS, LinearSystem
from bench.diagnosis.noise_grid import NoiseGrid, Whitener, make_whitener
from bench.diagnosis.noise_kinds import TAIL_DOF
from bench.diagnosis.posterior import NoiseSize
from bench.model.effects import CATALOGUE, AppliedEffect, Parameter
from bench.model.effects.voltmeter import LOW_RANGE_V
from bench.readings.table import VERIFICATION


def detectable(whitened: Whitened, threshold: Threshold, ratio: int) -> dict[str, float]:
    """Return, for each effect, the amplitude at which half of all runs find it, in plausible sizes.

    The form that shows best counts; the amplitude is infinite if no run would find it. `ratio` is the index
    of the noise ratio.
    """
    variants = whitened.candidates.variants
    square = dict.fromkeys(CATALOGUE, 0.0)
    for group in Search.beside(whitened, ()).groups:
        largest = group.values[ratio].max(axis=1)
        for number, seen in zip(group.members.tolist(), largest.tolist(), strict=True):
            if variants[number].named and variants[number].is_plain:
                square[variants[number].family] = max(square[variants[number].family], seen)
    half = half_power(whitened, threshold.value)
    return {name: half / seen**0.5 if seen > NEGLIGIBLE else float("inf") for name, seen in square.items()}


def half_power(whitened: Whitened, threshold: float) -> float:
    """Return the signal-to-noise ratio rho at which half of all runs find an effect of one parameter.

    ln of the evidence, about rho^2/2 minus a cost of parameters, forms and families, then equals `threshold`.
    """
    looks = np.log(len(whitened.candidates.families)) + 1.5
    return float(np.sqrt(2.0 * max(threshold + looks + 2.0, 1.0)))


@dataclass(frozen=True)
class Smallest:
    """The joint amplitude of the `parameters` of one `unit`, at which half of all runs find their effect.

    `size` is the root of the sum of squares of the parameters. If `part`, the readings do not show some proportions
    of the parameters at any credible amplitude.
    """

    parameters: tuple[str, ...]
    size: float
    unit: str
    part: bool = False


def smallest(whitened: Whitened, threshold: Threshold, ratio: int) -> dict[str, tuple[Smallest, ...]]:
    """Return, for effects with several amplitudes, the joint amplitude that half of all runs find, by unit.

    Amplitudes of one unit (there may be only one) are joined. The best channel, mounting and shape count, and
    the worst proportions of the amplitudes (the phase of a wave). The arguments are those of `detectable`.
    """
    half = half_power(whitened, threshold.value)
    candidates = whitened.candidates
    found: dict[str, dict[str, Smallest]] = {}
    seen: set[tuple[int, ...]] = set()
    for variant in candidates.variants:
        judged = variant.named and variant.is_plain
        sized = [p for p in CATALOGUE[variant.family].parameters if p.is_size] if judged else []
        for unit in dict.fromkeys(p.unit for p in sized) if len(sized) > 1 else ():
            of = {p.name: p for p in sized if p.unit == unit}
            cells: dict[object, dict[str, int]] = {}
            for column in variant.sizes:
                kind = candidates.kinds[column]
                if kind.parameter in of:
                    cells.setdefault((kind.channel, kind.mounts), {})[kind.parameter] = column
            known = found.setdefault(variant.family, {})
            for own in (own for own in cells.values() if len(own) == len(of)):
                columns = tuple(own.values())
                if columns in seen:
                    continue  # another variant has the same parameters in this channel
                seen.add(columns)
                one = _smallest_of(whitened.among(ratio, columns), [of[name] for name in own], half)
                best = known.get(unit)
                if one is not None and (best is None or (one.part, one.size) < (best.part, best.size)):
                    known[unit] = one
    return {name: tuple(of_unit.values()) for name, of_unit in found.items() if of_unit}


def _smallest_of(gram: Floats, own: Sequence[Parameter], half: float) -> Smallest | None:
    scale = np.array([p.plausible / p.si_per_unit for p in own])
    shows, directions = np.linalg.eigh(gram / np.outer(scale, scale))
    # in plausible sizes, so that the judgement does not depend on the unit
    reach = half / np.sqrt(np.maximum(shows, 1e-300))
    beyond = reach * np.linalg.norm(directions / scale[:, None], axis=0) > BEYOND_BELIEF
    if np.all(beyond):
        return None
    names = tuple(p.name for p in own)
    return Smallest(names, float(reach[~beyond].max()), own[0].unit, bool(beyond.any()))


def hidden(
    whitened: Whitened, threshold: Threshold, ratio: int, sizes: Mapping[str, float]
) -> dict[str, tuple[str, ...]]:
    """Return the effects that these readings could not show, each with its hidden parts.

    A part is one phase of a wave; without parts, the whole effect is hidden. `sizes` is the result of `detectable`;
    `ratio` is the index of the noise ratio.
    """
    candidates = whitened.candidates
    seen = (
        np.sqrt(np.maximum(whitened.products.square[ratio], 0.0))
        * BEYOND_BELIEF
        / half_power(whitened, threshold.value)
    )
    best: dict[tuple[str, str, str], float] = {}
    for variant in (one for one in candidates.variants if one.named and one.is_plain):
        shape = ", ".join(f"{name} {value:g}" for name, value in variant.shape)
        for column in variant.sizes:
            key = (variant.family, candidates.kinds[column].parameter, f" ({shape})" if shape else "")
            best[key] = max(best.get(key, 0.0), float(seen[column]))
    unseen: dict[str, tuple[str, ...]] = {}
    for name in CATALOGUE:
        parts = [(of, shape) for (family, of, shape), size in best.items() if family == name and size < 1.0]
        if sizes[name] > BEYOND_BELIEF:
            unseen[name] = ()
        elif any(parameter.endswith(ROUND) for parameter, _ in parts):
            unseen[name] = tuple(parameter + shape for parameter, shape in parts)
    return unseen


class EffectPart(NamedTuple):
    """One parameter of an effect at its plausible size, in a channel and in mountings.

    `channel` None is all channels, empty `mounts` are all mountings; `shape` has names and SI values.
    """

    family: str
    parameter: str
    shape: tuple[tuple[str, float], ...]
    mounts: tuple[str, ...]
    channel: int | None


Form = tuple[EffectPart, ...]
"""A form that an effect may have, as the tuple of its parameters."""


def form_of(candidates: Candidates, variant: Variant) -> Form:
    """Return a variant as a form, without columns of these readings, to compare it in other readings."""
    kinds = [candidates.kinds[place] for place in variant.sizes]
    return tuple(EffectPart(variant.family, k.parameter, variant.shape, k.mounts, k.channel) for k in kinds)


def forms_of(candidates: Candidates, family: str) -> tuple[Form, ...]:
    """Return every form that a family has among the candidates."""
    return tuple(form_of(candidates, v) for v in candidates.variants if v.family == family and v.is_plain)


def forms_everywhere(family: str, mounts: tuple[str, ...] = ()) -> tuple[Form, ...]:
    """Return a form for each shape of an effect, in all channels and in `mounts` (empty: all)."""
    parameters = CATALOGUE[family].parameters
    grids = [[(p.name, value) for value in p.grid] for p in parameters if p.grid]
    return tuple(
        tuple(
            EffectPart(family, p.name, shape, mounts, channel)
            for p in parameters
            if p.is_size
            for channel in ((0, 1, 2) if p.per_channel else (None,))
        )
        for shape in product(*grids)
    )


class ReadingDesign:
    """Readings, measured or planned, in which two explanations are compared.

    `others` are forms of further effects, which act with unknown amplitudes of a wide prior.
    """

    def __init__(self, linear: LinearSystem, noise: NoiseSize, others: Sequence[Form] = ()) -> None:
        self.linear = linear
        self._noise = noise
        self._unseen: dict[EffectPart, Floats] = {}
        self._seen: dict[EffectPart, Floats] = {}
        self._known = [self._column(part) * KNOWN_SIZE for form in others for part in form]

    def remounted(self, families: Sequence[str], before: Sequence[str]) -> None:
        """Add an error of unknown amplitude for each of `families` in each mounting that is not in `before`.

        The prior u of the amplitude is the plausible size. Effects that do not differ between mountings are
        ignored. Call this method before `seen`.
        """
        labels = [str(m) for m in self.linear.moved.mounts if m.installation != VERIFICATION]
        effects = [CATALOGUE[family] for family in families]
        of_mounts = [effect.name for effect in effects if effect.per_mount and not effect.lasts]
        self._known += [
            self._column(part)
            for family in of_mounts
            for label in labels
            if label not in before
            for part in forms_everywhere(family, (label,))[0]
        ]

    @cached_property
    def _white(self) -> Whitener:
        """The map that projects out the coefficients and, up to their priors, stand angles and known columns."""
        rows = self.linear.with_random(*self._known)
        return make_whitener(rows, self._noise.reading, self._noise.setting_rad)

    def _left(self, columns: Floats) -> Floats:
        """Return the whitened columns (N, m) with the free columns projected out."""
        return self._white @ (columns / self._noise.reading)

    def _column(self, part: EffectPart) -> Floats:
        if part not in self._unseen:
            effect = CATALOGUE[part.family]
            parameter = next(p for p in effect.parameters if p.name == part.parameter)
            columns = plausible_columns(self.linear, effect, parameter, part.shape, part.mounts)
            for channel, column in columns.items():
                self._unseen[part._replace(channel=channel)] = column
        return self._unseen[part]

    def seen(self, form: Form) -> Floats:
        """Return the whitened changes (N, parts) by each part of a form, with free unknowns projected out."""
        new = [part for part in dict.fromkeys(form) if part not in self._seen]
        if new:
            left = self._left(np.column_stack([self._column(part) for part in new]))
            self._seen.update(zip(new, left.T, strict=True))
        return np.array([self._seen[part] for part in form]).T

    def divergence(self, found: Sequence[AppliedEffect], rivals: Sequence[Form]) -> float:
        """Return the divergence D of an effect `found` from the most similar of `rivals`.

        D is the expected ln of the odds of the effect against this rival.
        """
        total = np.sum([self.linear.effect_column(applied) for applied in found], axis=0)
        one = self._left(total[:, None])[:, 0]
        least = float(one @ one)
        self.seen(tuple(part for form in rivals for part in form))
        for _, forms in groupby(sorted(rivals, key=len), len):
            basis, size, _ = np.linalg.svd([self.seen(form) for form in forms], full_matrices=False)
            along = (size > 1e-9 * size[:, :1]) * (one @ basis)
            left = one - np.sum(basis * along[:, None], axis=2)
            least = min(least, float(np.min(np.sum(left**2, axis=1))))
        return least / 2.0

    def visible(self, *forms: Form) -> float:
        """Return the signal-to-noise ratio of a plausible size in the best of `forms`, given free unknowns."""
        return float(np.linalg.svd([self.seen(form) for form in forms], compute_uv=False).max())


# --- patterns of the residuals: where readings and model disagree ------------------------------------

HARMONICS: Final = (
    "constant",
    message("once per turn"),
    message("twice per turn"),
    message("three times per turn"),
    message("four times per turn"),
)


@dataclass(frozen=True)
class ResidualPattern:
    """One pattern of the residuals, in a channel and an installation, with its amplitude in `unit`.

    The p-value `p` is corrected for the number of patterns; `p_local` is not.
    """

    channel: str
    installation: str
    pattern: str
    size: float
    unit: str
    p: float
    p_local: float


Look = tuple[str, str, str, Floats]
"""A tuple of the channel, the installation, the pattern in words, and the columns (N, 1 or 2) of the pattern."""


def find_places(
    linear: LinearSystem, grid: NoiseGrid, ratio: int, sigma: float, freedom: int
) -> tuple[ResidualPattern, ...]:
    """Return the significant patterns of the residuals, the most significant first, at most `LISTED`.

    `ratio` is the index of the noise ratio; `sigma`, unit of the signal, is the noise from repeats, with `freedom`
    degrees of freedom. p-values are corrected for the number of patterns.
    """
    looks = list(_looks(linear))
    wide = np.array([columns.shape[1] for *_, columns in looks])
    used = np.arange(2) < wide[:, None]
    left = grid.white[ratio] @ linear.response
    # (N, looks, 2): a pattern of one column has a second one of zeros
    seen = np.zeros((len(left), *used.shape))
    seen[:, used] = grid.white[ratio] @ np.concatenate([columns for *_, columns in looks], axis=1)
    seen = np.moveaxis(seen, 1, 0)
    whole = np.min(np.linalg.norm(seen, axis=1), axis=1, where=used, initial=np.inf)
    places: list[ResidualPattern] = []
    while len(places) < LISTED:
        bases, of_each = np.linalg.qr(seen)
        square = np.sum((left @ bases) ** 2, axis=1, where=used) / sigma**2
        p_each = special.fdtrc(wide, freedom, square / wide)
        # leave out patterns that the earlier ones explain
        least = np.min(np.abs(np.diagonal(of_each, axis1=1, axis2=2)), axis=1, where=used, initial=np.inf)
        p_each[least**2 <= INSEPARABLE * whole**2] = np.inf
        # if p underflows, the size of the statistic decides
        best = int(np.lexsort((-square / wide, p_each))[0])
        p = float(p_each[best])
        if p * len(looks) > BY_CHANCE:
            break
        channel, installation, pattern, columns = looks[best]
        q, r = bases[best, :, : wide[best]], of_each[best, : wide[best], : wide[best]]
        size = float(np.max(np.abs(columns @ np.linalg.solve(r, q.T @ left))))
        p_all = min(1.0, p * len(looks))
        places.append(ResidualPattern(channel, installation, pattern, size, linear.readings.unit, p_all, p))
        left = left - q @ (q.T @ left)
        seen = seen - q @ (q.T @ seen)
    return tuple(places)


def _looks(linear: LinearSystem) -> Iterator[Look]:
    rows, readings = linear.rows, linear.readings
    label = readings.installation[rows.reading]
    run = readings.run[rows.reading]
    # with several runs, patterns common to all of them
    series = np.ones_like(run) if run.any() else readings.series[rows.reading]
    mounts = np.array([i if s == 1 else f"{i}/{s}" for s, i in zip(series, label, strict=True)])
    oriented = linear.setting >= 0
    for c, channel in enumerate(CHANNELS):
        own = oriented & (rows.channel == c)
        for mount in dict.fromkeys(mounts[own].tolist()):
            for pattern, columns in _in_mount(linear, own & (mounts == mount)):
                yield channel, mount, pattern, columns
        for pattern, columns in _over_run(linear, own):
            yield channel, "all", pattern, columns
        for number in np.unique(run) if run.any() else ():
            yield channel, "all", f"run {number + 1}", _rows(own & (run == number))
    modulus = rows.channel == MODULUS
    if modulus.any():
        yield "modulus", "V", "constant", _rows(modulus)
    for row in () if run.any() else range(len(linear)):
        i = rows.reading[row]
        pattern = message(f"single reading: pass {readings.pass_number[i]}, point {readings.point[i]}")
        at = str(mounts[row] if oriented[row] else label[row])
        yield _CHANNEL[rows.channel[row]], at, pattern, _rows(np.arange(len(linear)) == row)


def _rows(of: Mask) -> Floats:
    """Return a column (N, 1) with the same value in each row of the mask."""
    return of[:, None].astype(np.float64)


def _in_mount(linear: LinearSystem, own: Mask) -> Iterator[tuple[str, Floats]]:
    """Yield the patterns over the angles, passes and directions in some rows of a mounting."""
    readings, reading = linear.readings, linear.rows.reading
    angle, passes = readings.angle_rad[reading], readings.pass_number[reading]
    direction = readings.direction[reading].astype(np.float64)
    waves = {
        k: np.where(own[:, None], np.column_stack([np.cos(k * angle), np.sin(k * angle)]), 0.0)
        for k in range(1, len(HARMONICS))
    }
    yield HARMONICS[0], _rows(own)
    for k, wave in waves.items():
        yield HARMONICS[k], wave
    numbers = sorted(set(passes[own].tolist()))
    for number in numbers if len(numbers) > 1 else ():
        yield f"pass {number}", _rows(own & (passes == number))
    if len(set(direction[own].tolist())) > 1:
        yield message("direction of approach"), _rows(own) * direction[:, None]
        yield message("direction of approach, once per turn"), waves[1] * direction[:, None]


def _over_run(linear: LinearSystem, own: Mask) -> Iterator[tuple[str, Floats]]:
    """Yield the patterns over the time, the temperature and the voltage in the rows of a channel."""
    readings, reading = linear.readings, linear.rows.reading
    signal = readings.signal[reading, np.minimum(linear.rows.channel, 2)]
    for pattern, values in (
        (message("time"), readings.time_s),
        (message("temperature"), readings.temperature_c),
    ):
        at = values[reading]
        if np.all(np.isfinite(at[own])) and np.ptp(at[own]) > 0:
            run = np.where(own, (at - np.mean(at[own])) / np.ptp(at[own]), 0.0)
            yield message(f"{pattern}, bias"), run[:, None]
            scale = run * signal
            yield message(f"{pattern}, scale factor"), scale[:, None] / max(np.max(np.abs(scale)), 1e-300)
    if readings.unit == "V":
        low = own & (np.abs(signal) < LOW_RANGE_V)
        if low.any() and (own & ~low).any():
            yield message("signals below 1.2 V"), _rows(low)


@dataclass(frozen=True)
class FarReading:
    """A reading that is `size_u` standard uncertainties from its prediction by all other readings.

    `channel` is x, y, z, "modulus", or "setting" for the direction of a setting error. The p-value `p` is corrected
    for the number of readings.
    """

    installation: str
    pass_number: int
    point: int
    channel: str
    size_u: float
    p: float

    @property
    def words(self) -> str:
        """A clause with the place of the reading and its distance."""
        of = {"modulus": "|a|", "setting": message("the angle")}.get(
            self.channel, message(f"channel {self.channel}")
        )
        return message(
            f"{of} in installation {self.installation}, pass {self.pass_number}, point {self.point} is "
            f"{self.size_u:.0f} u off"
        )


def far_readings(linear: LinearSystem, effects: Floats, noise: NoiseSize) -> tuple[FarReading, ...]:
    """Return the readings that are far from the model with the columns `effects` (N, m), farthest first.

    Distances are deletion residuals: Cook and Weisberg, Residuals and Influence in Regression, 1982, 2.2.
    """
    heavy = linear.by_row is not None
    rows = replace(linear.with_random(KNOWN_SIZE * effects), by_row=None)
    white = make_whitener(rows, noise.reading, noise.setting_rad)
    pull = white.weigh(linear.response) / noise.reading
    size = np.abs(pull) / np.sqrt(np.maximum(white.diagonal, 1e-12))
    off = [
        (float(of), int(reading), _CHANNEL[channel])
        for of, reading, channel in zip(size, linear.rows.reading, linear.rows.channel, strict=True)
    ]
    for start in range(0, linear.settings, CHUNK):
        numbers = np.arange(start, min(start + CHUNK, linear.settings))
        own = np.where(linear.setting[:, None] == numbers, linear.slope[:, None], 0.0)
        along, seen = np.abs(pull @ own), np.sum(own * white.weigh(own), axis=0)
        first = linear.rows.reading[np.argmax(linear.setting[:, None] == numbers, axis=0)]
        known = seen > 0.0
        of_settings = zip((along[known] / np.sqrt(seen[known])).tolist(), first[known].tolist(), strict=True)
        off += [(of, reading, "setting") for of, reading in of_settings]
    told: dict[int, FarReading] = {}
    readings, looks = linear.readings, len(size) + linear.settings
    for of, i, channel in sorted((one for one in off if one[0] >= FAR), key=lambda one: -one[0]):
        scaled = of * np.sqrt(TAIL_DOF / (TAIL_DOF - 2.0))
        p = 2.0 * float(special.stdtr(TAIL_DOF, -scaled) if heavy else special.ndtr(-of))
        place = (str(readings.installation[i]), int(readings.pass_number[i]), int(readings.point[i]))
        told.setdefault(i, FarReading(*place, channel, of, float(-np.expm1(looks * np.log1p(-min(p, 0.5))))))
    return tuple(told.values())


_CHANNEL: Final = (*CHANNELS, "modulus")


def looking_like(angle_rad: Floats, order: int) -> tuple[int, ...]:
    """Return the periods per turn that the angles (n,) do not distinguish from `order` periods per turn.

    The largest is one period per mark of the head. Order 0 is a constant, which the coefficients absorb. The
    angles are rounded to 0.1 deg; those that then differ only by whole turns count as one.
    """
    tenths = np.round(np.degrees(angle_rad[np.isfinite(angle_rad)]) * 10.0) % 3600.0
    angles = np.radians(np.unique(tenths) / 10.0)
    others = [k for k in range(1, round(360.0 / MARK_DEG) + 1) if k != order]
    waves = np.concatenate([_waves(angles, k) for k in others], axis=1)
    left = _left(waves, _waves(angles, order)).reshape(-1, 2).max(axis=1)
    return tuple(k for k, most in zip(others, left.tolist(), strict=True) if most < ALIKE)


def order_of(applied: AppliedEffect) -> int | None:
    """Return the number of periods per turn of an effect; None if it is not a wave of the head angle."""
    order: int | None = getattr(applied.effect, "order", None)
    if order is not None:
        return order
    harmonic = applied.complete_values().get("harmonic")
    return None if harmonic is None else round(float(harmonic))


def _waves(angle_rad: Floats, order: int) -> Floats:
    """Return cosine and sine (n, 2) of a number of periods per turn, or a constant (n, 1) if it is 0."""
    if order == 0:
        return np.ones((len(angle_rad), 1))
    return np.stack([np.cos(order * angle_rad), np.sin(order * angle_rad)], axis=1)


def _left(waves: Floats, own: Floats) -> Floats:
    """Return the fraction of the square of each of the `waves` (n, k) that the `own` waves leave unexplained."""
    size = np.maximum(np.sum(waves**2, axis=0), 1e-12 * len(waves))
    fitted = own @ np.linalg.lstsq(own, waves, rcond=INSEPARABLE)[0]
    return np.asarray(np.sum((waves - fitted) ** 2, axis=0) / size)
