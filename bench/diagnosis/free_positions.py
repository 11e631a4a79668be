"""The diagnosis of free positions alone, its gap on held-out readings, and the confirmation of a model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from scipy import special

from bench.base.arrays import CHANNELS, Floats, Mask
from bench.base.arrays import rms as root_mean_square
from bench.calibration.design import FIXED, UPPER
from bench.calibration.result import CalibrationError
from bench.diagnosis.candidates import ZERO_BY_RUN, Candidates
from bench.diagnosis.confirm import STILL_SEEN, Confirmation, EstimatedEffects, Model, judged, square
from bench.diagnosis.evidence import KNOWN_SIZE, Data, Search, Threshold, Whitened, fit_tail, total_evidence
from bench.diagnosis.free_records import (
    OWN,
    BetweenRecords,
    FreeDiagnosis,
    FreeFit,
    FreeFound,
    FreeRows,
    between_records,
    make_rows,
    place_of,
)
from bench.diagnosis.free_search import (
    COMMON,
    LEAST_FREEDOM,
    grid_of,
    make_free_candidates,
    scatter,
    stated,
    without_outliers,
)
from bench.diagnosis.gap import Fold, Gap, HeldOut
from bench.diagnosis.naming import FoundEffect, Naming, name
from bench.diagnosis.posterior import NoiseSize, applied_of
from bench.diagnosis.result import UNNAMED_WORDS, EffectValue
from bench.model.effects import CATALOGUE, AppliedEffect
from bench.model.forward import ForwardModel
from bench.model.geometry import Block
from bench.readings.table import FREE, Readings

FOLDS: Final = 5


def free_gap(
    rows: FreeRows,
    candidates: Candidates,
    sigma: float,
    limit: Threshold,
    noise: NoiseSize,
    named: Sequence[str],
) -> Gap:
    """Return the gap on held-out readings.

    `sigma` is the noise used in the search, and `named` are the names found in all readings.
    """
    fold_of = np.arange(len(rows)) % FOLDS
    folds, undetermined = [], []
    for number in range(FOLDS):
        train = fold_of != number
        label = f"positions {number + 1}, {number + FOLDS + 1}, …"
        if grid_of(rows, sigma, train).freedom < LEAST_FREEDOM:
            undetermined.append(label)
        else:
            folds.append(_fold(rows, candidates, sigma, limit, noise, train, label))
    return Gap(tuple(folds), noise, "g", noise.freedom, tuple(named), tuple(undetermined))


def _fold(
    rows: FreeRows,
    candidates: Candidates,
    sigma: float,
    limit: Threshold,
    noise: NoiseSize,
    train: Mask,
    label: str,
) -> Fold:
    part = Candidates(candidates.columns[train], candidates.kinds, candidates.scale, candidates.variants)
    kept = Whitened.of(grid_of(rows, sigma, train), part)
    found = name(kept, kept.reduce(rows.response[train][:, None]), limit).found

    def held_out(but: str | None) -> HeldOut:
        chosen = [i for one in found if one.variant.family != but for i in one.variant.columns]
        return _predicted(rows, candidates.columns[:, chosen], train, noise.reading)

    after = held_out(None)
    gains = {one.variant.family: held_out(one.variant.family).chi2 - after.chi2 for one in found}
    before = _predicted(rows, candidates.columns[:, :0], train, noise.reading)
    return Fold(label, gains, before, after, "")


def _predicted(rows: FreeRows, effects: Floats, train: Mask, noise: float) -> HeldOut:
    design = np.column_stack([rows.fixed, effects])
    prior = np.concatenate([np.zeros(rows.fixed.shape[1]), np.full(effects.shape[1], 1 / KNOWN_SIZE**2)])
    normal = design[train].T @ design[train] / noise**2 + np.diag(prior)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    covariance = np.linalg.pinv(normal * np.outer(scale, scale), hermitian=True) * np.outer(scale, scale)
    mean = covariance @ (design[train].T @ rows.response[train]) / noise**2
    held = design[~train]
    error = rows.response[~train] - held @ mean
    spread = noise**2 * np.eye(len(error)) + held @ covariance @ held.T
    chi2 = float(error @ np.linalg.solve(spread, error))
    return HeldOut(error, error, np.sqrt(np.diag(spread)), chi2)


CHANCE: Final = 0.01
"""A find with a larger p-value, beside all other finds, is dropped."""
NULLS: Final = 2000
SEED: Final = 20260
LISTED: Final = 8


def all_free(tables: Sequence[Readings]) -> bool:
    """Return whether these tables have free positions and nothing else."""
    return bool(tables) and all(len(table) and np.all(table.installation == FREE) for table in tables)


def diagnose_free(
    tables: Sequence[Readings], one_sensor: bool | None = None, model: ForwardModel | None = None
) -> FreeDiagnosis:
    """Return the diagnosis of tables of free positions, each table from one sensor in one record.

    Effects of a given model are subtracted at their values and estimated again with the coefficients. Raises
    `CalibrationError` where the positions of a sensor do not determine its nine coefficients.
    """
    sorted_out = without_outliers(make_rows(tables, one_sensor, model))
    rows = sorted_out.rows
    sigma = scatter(rows)
    candidates = make_free_candidates(rows, sigma)
    whitened = Whitened.of(grid_of(rows, sigma), candidates)
    limit = _threshold(whitened, len(rows))
    naming = name(whitened, whitened.reduce(rows.response[:, None]), limit)
    between = between_records(rows, tables) if len(np.unique(rows.record)) > 1 else None
    noise = _noise(rows, whitened, naming)
    teller = _Teller(rows, whitened, naming, noise, limit, between)
    told = [(one, teller.found(one)) for one in naming.found]
    # what is left of it beside the others may be no more than chance
    naming = replace(naming, found=tuple(one for one, found in told if found.p_all_looks < CHANCE))
    found = tuple(found for _, found in told if found.p_all_looks < CHANCE)
    return FreeDiagnosis(
        source=" + ".join(table.source for table in tables),
        rows=rows,
        apart=sorted_out.apart,
        left_out=sorted_out.origin,
        found=found,
        columns=tuple(candidates.columns[:, list(one.variant.columns)] for one in naming.found),
        gap=free_gap(rows, candidates, sigma, limit, noise, [one.name for one in found]),
        noise_g=noise.reading,
        stated_g=stated(rows),
        freedom=noise.freedom,
        threshold=limit.value,
        before=_fit(rows, candidates.columns[:, :0], noise.reading),
        after=_fit(rows, candidates.columns[:, list(naming.columns)], noise.reading),
        between=between,
        where=_where(rows, whitened, naming, noise.reading),
        notes=(*sorted_out.doubtful, *(note for table in rows.tables for note in table.notes)),
    )


def _threshold(whitened: Whitened, count: int) -> Threshold:
    rng = np.random.default_rng(SEED)
    nulls = rng.standard_normal((count, NULLS)) * whitened.grid.sigma
    scores = Search.beside(whitened, ()).score(whitened.reduce(nulls))
    return fit_tail(total_evidence(scores, whitened))


def _noise(rows: FreeRows, whitened: Whitened, naming: Naming) -> NoiseSize:
    """Return the noise of a position with all finds in the model."""
    data: Data = whitened.reduce(rows.response[:, None])
    left = Search.beside(whitened, naming.columns).left_over(data).square[0, 0]
    chosen = list(naming.columns)
    gram = whitened.among(0, chosen)
    rank = int(np.linalg.matrix_rank(gram, hermitian=True)) if chosen else 0
    freedom = whitened.grid.freedom - rank
    return NoiseSize(whitened.grid.sigma * float(np.sqrt(left / max(freedom, 1))), 0.0, freedom)


def _fit(rows: FreeRows, effects: Floats, noise: float) -> FreeFit:
    """Fit the coefficients and effects' columns (N, p) in plausible sizes, with the prior `KNOWN_SIZE`."""
    design = np.column_stack([rows.fixed, effects])
    size = np.linalg.norm(design, axis=0)
    size[size == 0.0] = 1.0
    prior = np.zeros(design.shape[1])
    prior[rows.fixed.shape[1] :] = (noise / KNOWN_SIZE) ** 2
    inverse = np.linalg.pinv((design.T @ design + np.diag(prior)) / np.outer(size, size), hermitian=True)
    mean = inverse @ (design.T @ rows.response / size) / size
    spread = noise * np.sqrt(np.maximum(np.diag(inverse), 0.0)) / size
    blocks, u = [], np.zeros((rows.sensors, FIXED))
    for sensor, block in enumerate(rows.block):
        vector = block.vector.copy()
        vector[UPPER] += mean[place_of(sensor)]
        blocks.append(Block.from_vector(vector))
        u[sensor, UPPER] = spread[place_of(sensor)]
    return FreeFit(tuple(blocks), u, rows.response - design @ mean)


@dataclass(frozen=True)
class _Teller:
    """Builder of the `FreeFound` of each find: its name, parameters and p-values."""

    rows: FreeRows
    whitened: Whitened
    naming: Naming
    noise: NoiseSize
    limit: Threshold
    between: BetweenRecords | None

    def found(self, one: FoundEffect) -> FreeFound:
        variant, candidates = one.variant, self.whitened.candidates
        applied: tuple[AppliedEffect, ...] = ()
        if variant.named:
            applied = applied_of(candidates, variant, *self._sizes(one))
        # the first estimate of the noise may have had in it what was found since
        rho = one.size * self.whitened.grid.sigma / self.noise.reading
        count = len(variant.columns)
        p = float(special.fdtrc(count, self.noise.freedom, rho**2 / count))
        return FreeFound(
            name=variant.family,
            channels=tuple(CHANNELS[c] for c in variant.channels),
            cannot_tell_from=one.ties,
            parameters=tuple(value for each in applied for value in _values(each)),
            p=p,
            p_all_looks=max(p, self.limit.p(one.total)),
            rho=rho,
            words=self._words(one),
            applied=applied,
        )

    def _sizes(self, one: FoundEffect) -> tuple[Floats, Floats]:
        """Return the amplitudes of a find's columns, in plausible sizes, and their u."""
        columns = list(self.naming.columns)
        gram = self.whitened.among(0, columns) + np.eye(len(columns)) / KNOWN_SIZE**2
        covariance = np.linalg.inv(gram)
        along = self.whitened.reduce(self.rows.response[:, None]).along[0, columns, 0]
        place = next(p for f, p in self.naming.parts() if f is one)
        u = np.sqrt(np.diag(covariance))[place] * self.noise.reading / self.whitened.grid.sigma
        return (covariance @ along)[place], u

    def _words(self, one: FoundEffect) -> str:
        family = one.variant.family
        if one.variant.named:
            words = CATALOGUE[family].sentence
        else:
            words = UNNAMED_WORDS[family].replace("run", "record")
            if family == ZERO_BY_RUN and self.between is not None:
                words += f": {self.between.in_words()}"
        return words + (f" ({COMMON})" if one.variant.where == COMMON and self.between is None else "")


def _values(applied: AppliedEffect) -> list[EffectValue]:
    """Return the values of an effect with u, in the catalogue's unit; a shape has no u."""
    told: list[EffectValue] = []
    mounts = "+".join(applied.installations)
    for of in applied.effect.parameters:
        if of.name not in applied.values:
            continue
        value = np.asarray(applied.values[of.name]) / of.si_per_unit
        if of.is_shape:
            told.append(EffectValue(of.name, "", mounts, float(value), None, of.unit))
            continue
        u = np.asarray(applied.u[of.name]) / of.si_per_unit
        told += [
            EffectValue(of.name, channel, mounts, float(value[i]), float(u[i]), of.unit)
            for channel in applied.channels
            for i in [CHANNELS.index(channel)]
        ]
    return told


def _where(rows: FreeRows, whitened: Whitened, naming: Naming, sigma: float) -> tuple[Mapping[str, Any], ...]:
    """Return the records and sensors in which |a| scatters significantly more, the largest first."""
    found = list(naming.columns)
    places: list[dict[str, Any]] = []
    white = whitened.grid.white[0] @ rows.response
    if not found and not np.any(np.abs(white) > 4 * sigma):
        return ()
    for sensor in range(rows.sensors):
        for record in np.unique(rows.record[rows.sensor == sensor]):
            mine = (rows.sensor == sensor) & (rows.record == record)
            chi2 = float(white[mine] @ white[mine]) / sigma**2
            p = float(special.chdtrc(int(mine.sum()), chi2))
            places.append(
                {
                    "channel": "modulus",
                    "installation": FREE,
                    "pattern": f"sensor {sensor + 1}, record {record + 1}",
                    "size": float(np.sqrt(np.mean(white[mine] ** 2))),
                    "unit": "g",
                    "p": min(1.0, p * rows.sensors * len(np.unique(rows.record))),
                }
            )
    shown = [place for place in places if place["p"] < 0.01]
    return tuple(sorted(shown, key=lambda place: -place["size"])[:LISTED])


LEAST_FREEDOM_TO_CONFIRM: Final = 1


def confirm_free(tables: Sequence[Readings], model: ForwardModel) -> Confirmation:
    """Compare free positions with a model with effects, and diagnose them for further effects.

    Raises `CalibrationError` where the positions do not determine the coefficients, or could not show the
    effects.
    """
    diagnosis = diagnose_free(tables, None, model)
    rows, noise = diagnosis.rows, diagnosis.noise_g
    unknowns = rows.unknowns
    plausible = np.array([_plausible(model, u.effect, u.parameter) for u in unknowns])
    found = np.array([unknown.prior_mean for unknown in unknowns]) / plausible
    u = np.array([unknown.prior_u if unknown.stated else 0.0 for unknown in unknowns]) / plausible
    freedom = len(rows) - OWN * rows.sensors
    if freedom < LEAST_FREEDOM_TO_CONFIRM:
        raise CalibrationError(
            f"{len(rows)} free positions leave nothing to hold a model against; measure more"
        )
    before, _ = _left(rows, rows.response + rows.of_model @ found, noise, 0.0 * u)
    after, chi2 = _left(rows, rows.response, noise, u)
    change, covariance = _estimated(rows, noise, found, diagnosis.columns)
    return Confirmation(
        before=before,
        after=after,
        p_after=float(special.fdtrc(freedom, diagnosis.freedom, chi2 / freedom)),
        effects=judged(model, unknowns, EstimatedEffects(plausible, found, u, change, covariance)),
        diagnosis=diagnosis,
    )


def _plausible(model: ForwardModel, effect: int, parameter: str) -> float:
    return next(p.plausible for p in model.effects[effect].effect.parameters if p.name == parameter)


def _left(rows: FreeRows, response: Floats, noise: float, u: Floats) -> tuple[Model, float]:
    """Return the residuals of the coefficients and the effects with prior `u`, and their chi-square."""
    design = np.column_stack([rows.coefficients, rows.of_model * u])
    prior = np.concatenate([np.zeros(rows.coefficients.shape[1]), np.full(len(u), noise**2)])
    covariance = _inverse(design.T @ design + np.diag(prior))
    mean = covariance @ (design.T @ response)
    error = response - design @ mean
    chi2 = float(error @ error / noise**2 + np.sum(mean[rows.coefficients.shape[1] :] ** 2))
    expected = noise * np.sqrt(np.maximum(1.0 - np.einsum("ni,ij,nj->n", design, covariance, design), 0.0))
    freedom = len(rows) - OWN * rows.sensors
    return Model(chi2 / freedom, root_mean_square(error), root_mean_square(expected)), chi2


def _estimated(
    rows: FreeRows, noise: float, found: Floats, beside: Sequence[Floats]
) -> tuple[Floats, Floats]:
    """Return the change of the effects from the values `found`, in plausible sizes, and its covariance.

    Further finds are estimated as well. One that would hide the model's effects is left out, as it then
    represents their change.
    """
    mine = slice(rows.coefficients.shape[1], rows.fixed.shape[1])

    def fitted(design: Floats) -> tuple[Floats, Floats]:
        prior = np.zeros(design.shape[1])
        prior[mine.start :] = (noise / KNOWN_SIZE) ** 2
        covariance = _inverse(design.T @ design + np.diag(prior))
        mean = covariance @ (design.T @ rows.response)
        return mean[mine], noise**2 * covariance[mine, mine]

    design = rows.fixed
    estimate = fitted(design)
    for columns in beside:
        more = np.column_stack([design, columns])
        again = fitted(more)
        if square(found, again[1]) >= STILL_SEEN * square(found, estimate[1]):
            design, estimate = more, again
    return estimate


def _inverse(normal: Floats) -> Floats:
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    return np.asarray(np.linalg.pinv(normal / np.outer(size, size), hermitian=True) / np.outer(size, size))
