"""A diagnosis of free positions alone: |a| = 1 g in any orientation, as everybody measures who has no head.

What turns a or the sensor cannot be seen, and whatever an upper triangular K takes up is none of it. Seen are:
readings that stand apart, drift and warm-up, squares and cubes of the sensor, temperature, and zeros or scale
factors that differ between records; of several sensors side by side also what of that is common to them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from scipy import special

from bench.analysis.calibration.design import FIXED, UPPER
from bench.analysis.diagnosis.applied import applied_of
from bench.analysis.diagnosis.between_records import BetweenRecords, between_records
from bench.analysis.diagnosis.candidates import ZERO_BY_RUN
from bench.analysis.diagnosis.evidence import KNOWN_SIZE, Data, Search, Whitened
from bench.analysis.diagnosis.free_candidates import COMMON, make_free_candidates
from bench.analysis.diagnosis.free_gap import free_gap
from bench.analysis.diagnosis.free_noise import grid_of, scatter, stated, without_outliers
from bench.analysis.diagnosis.free_records import FreeRows, make_rows
from bench.analysis.diagnosis.free_result import FreeDiagnosis, FreeFit, FreeFound, place_of
from bench.analysis.diagnosis.naming import Found, Naming, name
from bench.analysis.diagnosis.posterior import NoiseSize
from bench.analysis.diagnosis.result import UNNAMED_WORDS, EffectValue
from bench.analysis.diagnosis.threshold import Threshold, fit_tail, total_evidence
from bench.base.arrays import CHANNELS, Floats
from bench.model import CATALOGUE, AppliedEffect, Block, ForwardModel
from bench.readings.table import FREE, Readings

CHANCE: Final = 0.01
"""What chance gives more often than that goes again, once all that was found stands beside it."""
NULLS: Final = 2000
SEED: Final = 20260
LISTED: Final = 8


def all_free(tables: Sequence[Readings]) -> bool:
    """Whether there are free positions and nothing else in these tables."""
    return bool(tables) and all(len(table) and np.all(table.installation == FREE) for table in tables)


def diagnose_free(
    tables: Sequence[Readings], one_sensor: bool | None = None, model: ForwardModel | None = None
) -> FreeDiagnosis:
    """Diagnose tables of free positions, each of one sensor in one record.

    Effects of a model given are taken off at their values and estimated anew beside the coefficients. Raises
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
    """Return the scatter of a position beside all that was found."""
    data: Data = whitened.reduce(rows.response[:, None])
    left = Search.beside(whitened, naming.columns).left_over(data).square[0, 0]
    chosen = list(naming.columns)
    gram = whitened.among(0, chosen)
    rank = int(np.linalg.matrix_rank(gram, hermitian=True)) if chosen else 0
    freedom = whitened.grid.freedom - rank
    return NoiseSize(whitened.grid.sigma * float(np.sqrt(left / max(freedom, 1))), 0.0, freedom)


def _fit(rows: FreeRows, effects: Floats, noise: float) -> FreeFit:
    """Fit the coefficients and columns of effects (N, p) in plausible sizes, known as widely as in the search."""
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
    """Says of each thing found what it is, how large, and how likely by chance."""

    rows: FreeRows
    whitened: Whitened
    naming: Naming
    noise: NoiseSize
    limit: Threshold
    between: BetweenRecords | None

    def found(self, one: Found) -> FreeFound:
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
            values=tuple(value for each in applied for value in _values(each)),
            p=p,
            p_all_looks=max(p, self.limit.p(one.total)),
            rho=rho,
            words=self._words(one),
            applied=applied,
        )

    def _sizes(self, one: Found) -> tuple[Floats, Floats]:
        """Return the values of its columns, in plausible sizes, and their u."""
        columns = list(self.naming.columns)
        gram = self.whitened.among(0, columns) + np.eye(len(columns)) / KNOWN_SIZE**2
        covariance = np.linalg.inv(gram)
        along = self.whitened.reduce(self.rows.response[:, None]).along[0, columns, 0]
        place = next(p for f, p in self.naming.parts() if f is one)
        u = np.sqrt(np.diag(covariance))[place] * self.noise.reading / self.whitened.grid.sigma
        return (covariance @ along)[place], u

    def _words(self, one: Found) -> str:
        family = one.variant.family
        if one.variant.named:
            words = CATALOGUE[family].sentence
        else:
            words = UNNAMED_WORDS[family].replace("run", "record")
            if family == ZERO_BY_RUN and self.between is not None:
                words += f": {self.between.in_words()}"
        return words + (f" ({COMMON})" if one.variant.where == COMMON and self.between is None else "")


def _values(applied: AppliedEffect) -> list[EffectValue]:
    """Return the values of an effect with u, in the catalogue's unit; of a shape there is none."""
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
    """Return where |a| disagrees: records and sensors in which it scatters more, the largest first."""
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
