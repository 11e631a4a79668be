"""A diagnosis of free positions alone: |a| = 1 g in any orientation, as everybody measures who has no head.

What turns a or the sensor cannot be seen, and whatever an upper triangular K takes up is none of it. Seen are:
readings that stand apart, drift and warm-up, squares and cubes of the sensor, temperature, and zeros or scale
factors that differ between records; of several sensors side by side also what of that is common to them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from scipy import special

from bench.analysis.diagnosis.applied import applied_of
from bench.analysis.diagnosis.between_records import BetweenRecords, between_records
from bench.analysis.diagnosis.candidates import ZERO_BY_RUN, Candidates
from bench.analysis.diagnosis.evidence import KNOWN_SIZE, Search, Whitened
from bench.analysis.diagnosis.free_candidates import COMMON, make_free_candidates
from bench.analysis.diagnosis.free_noise import scatter, stated, without_outliers
from bench.analysis.diagnosis.free_records import OWN, FreeRows, make_rows
from bench.analysis.diagnosis.naming import Found, Naming, name
from bench.analysis.diagnosis.noise_grid import NoiseGrid, Whitener
from bench.analysis.diagnosis.result import UNNAMED_WORDS
from bench.analysis.diagnosis.threshold import Threshold, fit_tail, total_evidence
from bench.base.arrays import CHANNELS, Floats, Mask
from bench.base.numbers import without_infinity
from bench.model import CATALOGUE, AppliedEffect, Parameter
from bench.readings.table import FREE, Readings

CHANCE: Final = 0.01
"""What chance gives more often than that goes again, once all that was found stands beside it."""
NULLS: Final = 2000
SEED: Final = 20260
LISTED: Final = 8


@dataclass(frozen=True)
class FreeFound:
    """What was found: an effect of the catalogue, or what has no name."""

    name: str
    channels: tuple[str, ...]
    cannot_tell_from: tuple[str, ...]
    parameters: Mapping[str, Any]
    p: float
    p_all_looks: float
    rho: float
    words: str


@dataclass(frozen=True)
class FreeDiagnosis:
    """The diagnosis of free positions.

    `noise_g` is the scatter of a position beside what was found, `stated_g` what its samples imply, NaN where not
    given.
    """

    source: str
    rows: FreeRows
    apart: tuple[str, ...]
    found: tuple[FreeFound, ...]
    gap: Mapping[str, Any]
    noise_g: float
    stated_g: float
    freedom: int
    threshold: float
    between: BetweenRecords | None
    where: tuple[Mapping[str, Any], ...]
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        """One of agrees, mistake, named, confounded, unknown."""
        if self.apart:
            return "mistake"
        if any(one.name not in CATALOGUE for one in self.found):
            return "unknown"
        if any(one.cannot_tell_from for one in self.found):
            return "confounded"
        return "named" if self.found else "agrees"

    def to_dict(self) -> dict[str, Any]:
        """Return the promised result; what free positions alone cannot have is null or empty."""
        outliers: list[dict[str, Any]] = [
            {
                "name": "outlier",
                "channels": [],
                "cannot_tell_from": [],
                "parameters": {},
                "p": None,
                "p_all_looks": None,
                "words": words,
            }
            for words in self.apart
        ]
        whole: dict[str, Any] = {
            "verdict": self.verdict,
            "where": [dict(one) for one in self.where],
            "effects": [*outliers, *(asdict(one) for one in self.found)],
            "next_measurement": None,
            "hidden": [name for name, effect in CATALOGUE.items() if effect.subsystem.value != "block"],
            "gap": dict(self.gap),
            "model": None,
            "noise": {"reading": self.noise_g, "unit": "g", "stated": self.stated_g, "dof": self.freedom},
            "between_records": None if self.between is None else self.between.to_dict(),
            "sensors": self.rows.sensors,
            "records": len(np.unique(self.rows.record)),
            "threshold": self.threshold,
            "notes": list(self.notes),
            "source": self.source,
        }
        return {key: without_infinity(value) for key, value in whole.items()}


def all_free(tables: Sequence[Readings]) -> bool:
    """Whether there are free positions and nothing else in these tables."""
    return bool(tables) and all(len(table) and np.all(table.installation == FREE) for table in tables)


def diagnose_free(tables: Sequence[Readings], one_sensor: bool | None = None) -> FreeDiagnosis:
    """Diagnose tables of free positions, each of one sensor in one record.

    Raises `CalibrationError` where the positions of a sensor do not determine its nine coefficients.
    """
    rows = make_rows(tables, one_sensor)
    rows, apart, doubtful = without_outliers(rows)
    sigma = scatter(rows)
    candidates = make_free_candidates(rows, sigma)
    grid = _grid(rows, sigma)
    whitened = Whitened.of(grid, candidates)
    limit = _threshold(whitened, len(rows))
    data = whitened.reduce(rows.response[:, None])
    naming = name(whitened, data, limit)
    left = Search.beside(whitened, naming.columns).left_over(data).square[0, 0]
    freedom = grid.freedom - _rank(whitened, naming)
    noise = sigma * float(np.sqrt(left / max(freedom, 1)))
    between = between_records(rows, tables) if len(np.unique(rows.record)) > 1 else None
    found = [
        _found(candidates, whitened, naming, one, limit, rows, noise, freedom, between)
        for one in naming.found
    ]
    return FreeDiagnosis(
        source=" + ".join(table.source for table in tables),
        rows=rows,
        apart=apart,
        found=tuple(one for one in found if one.p_all_looks < CHANCE),
        gap=_gap(rows, candidates, whitened, naming, limit, noise, between),
        noise_g=noise,
        stated_g=stated(rows),
        freedom=freedom,
        threshold=limit.value,
        between=between,
        where=_where(rows, whitened, naming),
        notes=(*doubtful, *(note for table in rows.tables for note in table.notes)),
    )


def _grid(rows: FreeRows, sigma: float, kept: Mask | None = None) -> NoiseGrid:
    mine = np.ones(len(rows), dtype=bool) if kept is None else kept
    fixed = rows.fixed[mine] / sigma
    basis, size, _ = np.linalg.svd(fixed, full_matrices=False)
    basis = basis[:, size > 1e-10 * size[0]]
    each = tuple((np.array([i]), np.eye(1)) for i in range(len(fixed)))
    white = Whitener(each, basis, np.zeros(basis.shape[1]))
    return NoiseGrid((white,), np.zeros(1), np.zeros(1), np.zeros(1), sigma, len(fixed) - basis.shape[1])


def _threshold(whitened: Whitened, count: int) -> Threshold:
    rng = np.random.default_rng(SEED)
    nulls = rng.standard_normal((count, NULLS)) * whitened.grid.sigma
    scores = Search.beside(whitened, ()).score(whitened.reduce(nulls))
    return fit_tail(total_evidence(scores, whitened))


def _rank(whitened: Whitened, naming: Naming) -> int:
    chosen = list(naming.columns)
    gram = whitened.among(0, chosen)
    return int(np.linalg.matrix_rank(gram, hermitian=True)) if chosen else 0


def _found(
    candidates: Candidates,
    whitened: Whitened,
    naming: Naming,
    one: Found,
    limit: Threshold,
    rows: FreeRows,
    noise: float,
    freedom: int,
    between: BetweenRecords | None,
) -> FreeFound:
    variant = one.variant
    columns = list(naming.columns)
    gram = whitened.among(0, columns) + np.eye(len(columns)) / KNOWN_SIZE**2
    covariance = np.linalg.inv(gram)
    along = whitened.reduce(rows.response[:, None]).along[0, columns, 0]
    place = next(p for f, p in naming.parts() if f is one)
    value = (covariance @ along)[place]
    u = np.sqrt(np.diag(covariance))[place] * noise / whitened.grid.sigma
    parameters: dict[str, Any] = {}
    if variant.named:
        for applied in applied_of(candidates, variant, value, u):
            values: dict[str, Any] = {}
            for of in applied.effect.parameters:
                if of.name in applied.values:
                    values[of.name] = _values(of, applied)
            where = "+".join(applied.installations)
            parameters |= {where: values} if where else values
        words = CATALOGUE[variant.family].sentence
    else:
        words = UNNAMED_WORDS[variant.family].replace("run", "record")
        if variant.family == ZERO_BY_RUN and between is not None:
            words += f": {between.in_words()}"
    # the first estimate of the noise may have had in it what was found since
    rho = one.size * whitened.grid.sigma / noise
    p = float(special.fdtrc(len(variant.columns), freedom, rho**2 / len(variant.columns)))
    return FreeFound(
        variant.family,
        tuple(CHANNELS[c] for c in variant.channels),
        one.ties,
        parameters,
        p,
        max(p, limit.p(one.total)),
        rho,
        words + (f" ({COMMON})" if variant.where == COMMON and between is None else ""),
    )


def _values(of: Parameter, applied: AppliedEffect) -> dict[str, Any]:
    """Return a parameter's value, or those of its channels with u, in the catalogue's unit."""
    value = np.asarray(applied.values[of.name]) / of.si_per_unit
    if of.is_shape:
        return {"value": float(value), "unit": of.unit}
    u = np.asarray(applied.u[of.name]) / of.si_per_unit
    at = {channel: CHANNELS.index(channel) for channel in applied.channels}
    return {c: {"value": float(value[i]), "u": float(u[i]), "unit": of.unit} for c, i in at.items()}


def _gap(
    rows: FreeRows,
    candidates: Candidates,
    whitened: Whitened,
    naming: Naming,
    limit: Threshold,
    noise: float,
    between: BetweenRecords | None,
) -> dict[str, Any]:
    """Hold out every fifth position in turn, name and fit without it, and predict it."""
    before = after = 0.0
    squares = np.zeros(2)
    named: list[list[str]] = []
    folds = np.arange(len(rows)) % 5
    for fold in range(5):
        train = folds != fold
        part = Candidates(candidates.columns[train], candidates.kinds, candidates.scale, candidates.variants)
        kept = Whitened.of(_grid(rows, whitened.grid.sigma, train), part)
        found = name(kept, kept.reduce(rows.response[train][:, None]), limit)
        named.append([one.variant.family for one in found.found])
        for number, chosen in enumerate(((), found.columns)):
            error, chi2 = _predicted(rows, candidates.columns[:, list(chosen)], train, noise)
            squares[number] += float(error @ error)
            if number == 0:
                before += chi2
            else:
                after += chi2
    count = len(rows)
    return {
        "before": before / count,
        "after": after / count,
        "floor": 1.0,
        "p_after": float(special.chdtrc(count, after)),
        "before_rms": float(np.sqrt(squares[0] / count)),
        "after_rms": float(np.sqrt(squares[1] / count)),
        "noise_rms": noise,
        "unit": "g",
        "held_out": [
            {"what": f"every fifth position from {i + 1} on", "named_without_it": names}
            for i, names in enumerate(named)
        ],
    }


def _predicted(rows: FreeRows, effects: Floats, train: Mask, noise: float) -> tuple[Floats, float]:
    design = np.column_stack([rows.fixed, effects])
    prior = np.concatenate(
        [np.zeros(OWN * rows.sensors), np.full(effects.shape[1], (noise / KNOWN_SIZE) ** 2)]
    )
    normal = design[train].T @ design[train] / noise**2 + np.diag(prior / noise**2)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    covariance = np.linalg.pinv(normal * np.outer(scale, scale), hermitian=True) * np.outer(scale, scale)
    mean = covariance @ (design[train].T @ rows.response[train]) / noise**2
    held = design[~train]
    error = rows.response[~train] - held @ mean
    spread = noise**2 * np.eye(len(error)) + held @ covariance @ held.T
    return error, float(error @ np.linalg.solve(spread, error))


def _where(rows: FreeRows, whitened: Whitened, naming: Naming) -> tuple[dict[str, Any], ...]:
    """Return where |a| disagrees: records and sensors in which it scatters more, the largest first."""
    found = list(naming.columns)
    sigma = whitened.grid.sigma
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
