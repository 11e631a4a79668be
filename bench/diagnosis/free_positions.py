"""The diagnosis of free positions alone, tested by predictions of held-out positions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np
from scipy import special, stats

from bench.base.arrays import Floats, Ints
from bench.base.languages import message
from bench.base.text import LISTED
from bench.calibration.design import FIXED, UPPER
from bench.calibration.result import CalibrationError
from bench.diagnosis.candidates import (
    SCALE_BY_RUN,
    SLOW_IN_TIME,
    SUBSETS,
    ZERO_BY_RUN,
    Candidates,
    Collector,
    Column,
    Variant,
    make_candidates,
)
from bench.diagnosis.evidence import NULLS, SEED, Search, Threshold, Whitened, fit_tail, total_evidence
from bench.diagnosis.free_records import (
    SCALES,
    ZEROS,
    BetweenRecords,
    FreeDiagnosis,
    FreeFit,
    FreeRows,
    FreeSystem,
    between_records,
    make_rows,
    make_system,
    place_of,
)
from bench.diagnosis.gap import measure_gap
from bench.diagnosis.levels import BY_CHANCE, FAR, FOLDS, HARDLY_EVER, LEAST_FREEDOM
from bench.diagnosis.linear import LinearSystem
from bench.diagnosis.multi_run_system import elapsed_part
from bench.diagnosis.naming import Naming, name
from bench.diagnosis.noise_grid import NoiseGrid, make_noise_grid
from bench.diagnosis.pipeline import effects_of, verdict_of
from bench.diagnosis.posterior import NoiseSize, Posterior, fit_found, noise_size, posterior
from bench.diagnosis.residual_dictionary import FASTEST
from bench.diagnosis.result import UNNAMED_WORDS, NamedEffect
from bench.diagnosis.visibility import ResidualPattern, far_readings
from bench.model.effects import CATALOGUE, Effect
from bench.model.effects.base import Subsystem
from bench.model.forward import ForwardModel
from bench.model.geometry import Block
from bench.readings.table import FREE, Readings


def diagnose_free(
    tables: Sequence[Readings], one_sensor: bool | None = None, model: ForwardModel | None = None
) -> FreeDiagnosis:
    """Diagnose free positions of one or several sensors, from which only |a| = 1 g is known.

    Each table is of one sensor in one record; `one_sensor` is as in `make_rows`. The effects of `model` are
    subtracted with their values, and the remainders are estimated together with the coefficients. Raises
    `CalibrationError` if the positions do not determine the nine coefficients of a sensor.
    """
    rows, apart, left_out = without_outliers(make_rows(tables, one_sensor, model))
    linear = make_system(rows)
    whitened = Whitened.of(*_prepared(linear))
    candidates, data = whitened.candidates, whitened.reduce(linear.response[:, None])
    limit = _threshold(whitened, len(rows))
    naming = name(whitened, data, limit)
    noise = noise_size(whitened, data, naming.columns)
    fitted = fit_found(linear, candidates, naming, noise)
    between = between_records(rows) if len(np.unique(rows.record)) > 1 else None
    effects = effects_of(candidates, naming, fitted, limit)
    number = np.arange(len(rows)) % FOLDS
    parts = [(f"positions {n + 1}, {n + FOLDS + 1}, …", number == n) for n in range(FOLDS)]
    gap = measure_gap(linear, whitened, naming, noise, limit, 0.0, parts=parts)
    columns = candidates.columns[:, list(naming.columns)]
    return FreeDiagnosis(
        source=" + ".join(table.source for table in tables),
        linear=linear,
        candidates=candidates,
        naming=naming,
        apart=apart,
        left_out=left_out,
        of_copy=verdict_of(effects, (), gap),
        effects=tuple(_of_records(one, between) for one in effects),
        gap=gap,
        noise=noise,
        stated_g=stated(rows),
        threshold=limit.value,
        before=_fit(linear, columns[:, :0], posterior(linear, columns[:, :0], noise)),
        after=_fit(linear, columns, fitted),
        between=between,
        where=_where(linear, whitened, naming, noise),
        notes=(
            *(message(f"{one.words}, and stays in") for one in far_readings(linear, columns, noise)),
            *(note for table in rows.tables for note in table.notes),
        ),
    )


def _threshold(whitened: Whitened, count: int) -> Threshold:
    nulls = np.random.default_rng(SEED).standard_normal((count, NULLS)) * whitened.grid.sigma
    scores = Search.beside(whitened, ()).score(whitened.reduce(nulls))
    return fit_tail(total_evidence(scores, whitened))


def _of_records(effect: NamedEffect, between: BetweenRecords | None) -> NamedEffect:
    """Return the effect; its `words` say "record", not "run", and give the sizes of unnamed zero changes."""
    if effect.in_catalogue:
        return effect
    if effect.name != ZERO_BY_RUN or between is None:
        return replace(effect, words=effect.words.replace("run", "record"))
    return replace(
        effect, words=f"{UNNAMED_WORDS[ZERO_BY_RUN].replace('run', 'record')}: {between.in_words()}"
    )


def _fit(linear: FreeSystem, effects: Floats, fitted: Posterior) -> FreeFit:
    rows, spread = linear.positions, np.sqrt(np.diag(fitted.covariance))
    blocks, u = [], np.zeros((rows.sensors, FIXED))
    for sensor, block in enumerate(rows.block):
        vector = block.vector.copy()
        vector[UPPER] += fitted.mean[place_of(sensor)]
        blocks.append(Block.from_vector(vector))
        u[sensor, UPPER] = spread[place_of(sensor)]
    return FreeFit(tuple(blocks), u, linear.response - linear.design(effects) @ fitted.mean)


def _where(
    linear: FreeSystem, whitened: Whitened, naming: Naming, noise: NoiseSize
) -> tuple[ResidualPattern, ...]:
    """Return the records and sensors where |a| scatters significantly more than elsewhere, largest first."""
    rows, white = linear.positions, whitened.grid.white[0] @ linear.response
    if not naming.found and not np.any(np.abs(white) > 4 * noise.reading):
        return ()
    cells = sorted(set(zip(rows.sensor.tolist(), rows.record.tolist(), strict=True)))
    places = []
    for sensor, record in cells:
        own = white[(rows.sensor == sensor) & (rows.record == record)]
        p = float(special.chdtrc(len(own), float(own @ own) / noise.reading**2))
        size = float(np.sqrt(np.mean(own**2)))
        pattern = message(f"sensor {sensor + 1}, record {record + 1}")
        places.append(ResidualPattern("modulus", FREE, pattern, size, "g", min(1.0, p * len(cells)), p))
    shown = [place for place in places if place.p < BY_CHANCE]
    return tuple(sorted(shown, key=lambda place: -place.size)[:LISTED])


# --- candidates ---------------------------------------------------------------------------------------

FINE_G: Final = 10e-6
"""Noise of a sensor, g, up to which the plausible sizes of the catalogue apply; they grow with larger noise."""
COMMON: Final = message("common to the sensors")


def _candidates(linear: FreeSystem, sigma: float) -> Candidates:
    unseen = [
        effect.name
        for effect in CATALOGUE.values()
        if effect.subsystem is not Subsystem.BLOCK or effect.needs_path or effect.per_mount or effect.per_pass
    ]
    add_unnamed = partial(_add_unnamed, linear.positions)
    told = make_candidates(linear, sigma, _sensor_sets, add_unnamed, absent=unseen)
    named = sorted({column for one in told.variants if one.named for column in one.columns})
    size = np.ones(len(told.kinds))
    size[named] = max(1.0, sigma / FINE_G)
    return Candidates(told.columns * size, told.kinds, told.scale * size, told.variants)


def _sensor_sets(linear: LinearSystem, effect: Effect) -> Iterator[tuple[tuple[str, ...], ...]]:
    """Yield the groups of sensors that may share values of an effect: all as one group, then each alone."""
    assert isinstance(linear, FreeSystem)  # noqa: S101 - no other has sensors
    yield ((),)
    if linear.positions.sensors > 1:
        yield tuple((f"sensor {number + 1}",) for number in range(linear.positions.sensors))


def _add_unnamed(rows: FreeRows, collector: Collector, unit: float) -> None:
    """Add unnamed families: zeros and scale factors by record, and zeros that wander.

    Zeros and scale factors are those of each sensor, or common to all sensors.
    """
    records = np.unique(rows.record)
    several = [s for s in range(rows.sensors) if len(np.unique(rows.record[rows.sensor == s])) > 1]
    for family, coefficients in ((ZERO_BY_RUN, ZEROS), (SCALE_BY_RUN, SCALES)):
        own: list[tuple[int, ...]] = []
        common: list[tuple[int, ...]] = []
        for channel in range(3):
            each = [unit * rows.change(coefficients, sensor, channel) for sensor in several]
            for columns, places in ((each, own), ([sum(each)] if len(each) > 1 else [], common)):
                by_record = [np.asarray(one * (rows.record == r)) for one in columns for r in records]
                kind = Column(family, channel)
                places.append(tuple(collector.add(one, kind, 1.0) for one in by_record if np.any(one)))
        for channels in SUBSETS:
            alone, alike = (tuple(i for c in channels for i in of[c]) for of in (own, common))
            forms = [(alone, ""), (alike, COMMON), (alike + alone if alike else (), COMMON)]
            collector.variants += [
                Variant(family, columns, channels, where=where) for columns, where in forms if columns
            ]
    time = np.concatenate([table.conditions().elapsed_s for table in rows.tables])
    phase = elapsed_part(time, rows.record)
    waves = [
        (rows.record == record) * np.cos(np.pi * k * phase)
        for record in records
        for k in range(1, FASTEST // 2 + 1)
    ]
    for channel in range(3):
        zero = unit * np.sum([rows.change(ZEROS, sensor, channel) for sensor in range(rows.sensors)], axis=0)
        collector.add_free(SLOW_IN_TIME, (channel,), [zero * wave for wave in waves])


# --- noise and outliers -------------------------------------------------------------------------------


def _prepared(linear: FreeSystem) -> tuple[NoiseGrid, Candidates]:
    """Return the noise grid and the candidates; the noise is the scatter of a fit of each record by itself."""
    left, _, freedom = _loose(linear)
    if freedom < LEAST_FREEDOM:
        raise CalibrationError(
            f"{len(linear)} free positions are too few to show the noise: {max(freedom, 0)} degrees of "
            f"freedom remain after the fit; measure {LEAST_FREEDOM - freedom} more positions, in all "
            "directions"
        )
    sigma = max(float(np.sqrt(left @ left / freedom)), 1e-9)
    return make_noise_grid(linear, sigma, 0.0), _candidates(linear, sigma)


def _loose(linear: FreeSystem, *, drifting: bool = False) -> tuple[Floats, Floats, int]:
    """Fit zeros and scale factors of each record; `drifting` zeros also change linearly with the row.

    Return the residuals (N,), the fraction (N,) of each error that remains in its residual, and the degrees of
    freedom.
    """
    rows = linear.positions
    cells = sorted(set(zip(rows.sensor.tolist(), rows.record.tolist(), strict=True)))
    late = np.concatenate([np.arange(len(table)) / len(table) for table in rows.tables])
    more = []
    for sensor, record in cells:
        mine = rows.record == record
        more += [rows.change(of, sensor, c) * mine for of in (ZEROS, SCALES) for c in range(3)]
        more += [rows.change(ZEROS, sensor, c) * mine * late for c in range(3) if drifting]
    u, size, _ = np.linalg.svd(np.column_stack([linear.fixed, linear.random, *more]), full_matrices=False)
    u = u[:, size > 1e-9 * size[0]]
    left = linear.response - u @ (u.T @ linear.response)
    return left, np.maximum(1.0 - np.sum(u**2, axis=1), 1e-9), len(left) - u.shape[1]


def without_outliers(rows: FreeRows) -> tuple[FreeRows, tuple[str, ...], Ints]:
    """Return the positions without outliers, a sentence for each outlier, and their tables and rows (k, 2).

    One after the other, the position with the largest residual is compared with its prediction from all
    others. An outlier is off by 2 `FAR` standard deviations or more, twice the limit in runs: sensors have
    heavy tails.
    """
    apart: list[str] = []
    origin: list[Ints] = []
    while True:
        left, free, freedom = _loose(make_system(rows), drifting=True)
        freedom -= 1
        if freedom < LEAST_FREEDOM:
            break
        without = np.maximum(left @ left - left**2 / free, 1e-300) / freedom
        t = np.abs(left) / np.sqrt(free * without)
        row = int(np.argmax(t))
        if t[row] < 2.0 * FAR or 2.0 * float(stats.t.sf(t[row], freedom)) * len(rows) > HARDLY_EVER:
            break
        table, at = rows.tables[rows.sensor[row]], int(np.sum(rows.sensor[:row] == rows.sensor[row]))
        place = f"{rows.place(row)}pass {table.pass_number[at]}, " + message(f"point {table.point[at]}")
        apart.append(
            f"{place}: "
            + message(
                f"|a| is {left[row] / free[row] * 1e3:+.3g} mg off what the others let expect ({t[row]:.1f} "
                "standard deviations); not at rest? It is left out"
            )
        )
        origin.append(rows.origin[row])
        rows = rows.without(np.arange(len(rows)) == row)
    return rows, tuple(apart), np.array(origin, dtype=np.int64).reshape(-1, 2)


def stated(rows: FreeRows) -> float:
    """Return the u of |a| at one position, g, from the scatter of its samples, which count as independent.

    It is the root mean square over positions and channels; NaN if a table has no `signal_sd`.
    """
    sizes = []
    for block, table in zip(rows.block, rows.tables, strict=True):
        scale = np.abs(np.diag(block.K))
        sizes.append(np.mean((table.signal_sd / scale) ** 2, axis=1) / np.maximum(table.samples, 1))
    return float(np.sqrt(np.mean(np.concatenate(sizes))))
