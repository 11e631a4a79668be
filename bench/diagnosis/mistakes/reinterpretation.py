"""Suppositions that the table misstates how the readings were taken.

Each supposition is one mistake in the record: channels are exchanged, reversed or in another unit; the head
counted the other way, or was several stops off; the installation label or the axes of the block are wrong; or
readings belong to a neighbouring stop (angle) of the head. It applies to the whole run, to one mounting, or to one
pass.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations, product
from typing import Final

import numpy as np

from bench.base.arrays import ARCSEC, CHANNELS, Floats, Ints, Labels, Mask
from bench.base.languages import message
from bench.calibration.mistakes import PREFIX, PREFIXES, in_another_unit
from bench.diagnosis.levels import CLEARLY_LARGER, MARK_DEG, MOSTLY, ONE_DIRECTION
from bench.model import Mounting
from bench.readings.corrected import EXCHANGED, REVERSED, RIGHT, MistakeName
from bench.readings.table import REFERENCE, SHORTED, VERIFICATION, Readings


@dataclass(frozen=True)
class OrientedRows:
    """The n oriented readings of a table, or its readings at verification points.

    `rows` (n,) are indices in the table, `mount` (n,) indices in `mounts`; `label` (n,) are installations; `signal`
    (n, 3) is in `unit`.
    """

    rows: Ints
    mounts: tuple[Mounting, ...]
    mount: Ints
    pass_number: Ints
    label: Labels
    angle_rad: Floats
    signal: Floats
    unit: str

    @classmethod
    def of(cls, readings: Readings, *, verification: bool = False) -> OrientedRows:
        """Return the oriented readings of a table or, if `verification`, its readings at verification points."""
        rows = readings.installation == VERIFICATION if verification else readings.is_oriented
        chosen = readings.select(rows)
        conditions = chosen.conditions()
        return cls(
            np.flatnonzero(rows),
            conditions.mounts,
            conditions.mount,
            chosen.pass_number,
            chosen.installation,
            chosen.angle_rad,
            chosen.signal,
            readings.unit,
        )

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def every(self) -> Mask:
        """A mask of all rows."""
        return np.ones(len(self), dtype=bool)

    @property
    def labels(self) -> list[str]:
        """The labels of the installations that occur, in order of appearance."""
        return list(dict.fromkeys(self.label.tolist()))


@dataclass(frozen=True)
class Scope:
    """The part of a run to which a supposition applies: the rows in `mask` (n,).

    `mounts` are its mountings (empty: all), `pass_number` is its pass (None: all).
    """

    mask: Mask
    mounts: tuple[Mounting, ...] = ()
    pass_number: int | None = None

    @property
    def whole(self) -> bool:
        """Whether the supposition applies to the whole run."""
        return not self.mounts and self.pass_number is None

    def __str__(self) -> str:
        if self.whole:
            return message("in the whole run")
        if not self.mounts:
            return message(f"in pass {self.pass_number}")
        mounts = " and ".join(str(mount) for mount in self.mounts)
        if self.pass_number is None:
            return message(f"in installation {mounts}")
        return message(f"in installation {mounts}, pass {self.pass_number}")


@dataclass(frozen=True)
class Reinterpretation:
    """A supposed mistake in the record of n readings; a field with its default states no mistake.

    `label` and `angle_rad` (n,) are the true installations and head angles. The true signals of reading i stand in
    row `source[i]` of the record (-1: they were not recorded). `turns` maps installations to rotations (3, 3) from
    stated to true block axes. `matrix` (3, 3) converts recorded to true signals in `scope`. `words` is a sentence.
    `turns_half` means that the head was half a turn off in a whole mounting.
    """

    name: str
    scope: Scope
    words: str
    matrix: Floats = field(default_factory=lambda: np.eye(3))
    label: Labels | None = None
    angle_rad: Floats | None = None
    source: Ints | None = None
    turns: Mapping[str, Floats] = field(default_factory=dict)
    turns_half: bool = False

    @property
    def factor(self) -> Floats:
        """The factor (3,) by which `matrix` multiplies the absolute signal of each channel."""
        return np.asarray(np.sum(np.abs(self.matrix), axis=1))

    @property
    def scales(self) -> bool:
        """Whether the supposition is that a channel was recorded in another unit."""
        return bool(np.any(self.factor != 1.0))

    @property
    def log_jacobian(self) -> float:
        """ln of the Jacobian determinant of the correction of all signals; at most 0 for a part of the run."""
        size = float(np.count_nonzero(self.scope.mask) * np.sum(np.log(self.factor)))
        return size if self.scope.whole else min(size, 0.0)

    @property
    def moves(self) -> bool:
        """Whether the supposition is that angles or installations were recorded wrongly."""
        return self.label is not None or self.angle_rad is not None

    @property
    def channels(self) -> tuple[str, ...]:
        """The names of the channels that are exchanged, reversed, or in another unit."""
        return tuple(
            c for c, own, right in zip(CHANNELS, self.matrix, np.eye(3), strict=True) if (own != right).any()
        )

    def signal(self, table: OrientedRows) -> Floats:
        """Return the true signals (n, 3); where `source` is -1, those of the first row stand in their place."""
        moved = table.signal if self.source is None else table.signal[np.maximum(self.source, 0)]
        return np.where(self.scope.mask[:, None], moved @ self.matrix.T, moved)

    def correct(self, readings: Readings, table: OrientedRows) -> Readings:
        """Return a corrected copy of `readings`, of which `table` are the oriented rows.

        A supposition about the whole run also corrects wiring and sense of rotation in the other rows. The
        sign of a reference voltage is known, and stays. Readings whose signals were not recorded are omitted.
        """
        signal, spread, samples = readings.signal.copy(), readings.signal_sd.copy(), readings.samples.copy()
        angle, target = readings.angle_rad.copy(), readings.target_rad.copy()
        direction = readings.direction.copy()
        inside = table.rows[self.scope.mask]
        others = np.setdiff1d(np.arange(len(readings)), table.rows) if self.scope.whole else inside[:0]
        if self.source is not None:
            taken = table.rows[np.maximum(self.source, 0)]
            signal[table.rows], spread[table.rows] = readings.signal[taken], readings.signal_sd[taken]
            samples[table.rows] = readings.samples[taken]
        wired = np.concatenate([inside, others])
        scaled = np.concatenate([wired, self._also_scaled(readings, table)])
        reference = (readings.installation[scaled] == REFERENCE)[:, None]
        right, size = signal[scaled] @ self.matrix.T, np.abs(self.matrix)
        signal[scaled] = np.where(reference, signal[scaled] @ size.T, right)
        spread[scaled] = spread[scaled] @ size.T
        if self.angle_rad is not None:
            angle[table.rows] = self.angle_rad
        if self.name == MistakeName.REVERSED_ROTATION:
            angle[others] = -angle[others]
            target[wired], direction[wired] = -target[wired], -direction[wired]
        installation = readings.installation.astype(object)
        if self.label is not None:
            installation[table.rows] = self.label
        corrected = replace(
            readings,
            signal=signal,
            signal_sd=spread,
            samples=samples,
            angle_rad=angle,
            target_rad=target,
            direction=direction,
            installation=installation.astype(np.str_),
            resolution_read=None if self.scales else readings.resolution_read,
        )
        if self.source is None:
            return corrected
        return corrected.select(~np.isin(np.arange(len(readings)), table.rows[self.source < 0]))

    def _also_scaled(self, readings: Readings, table: OrientedRows) -> Ints:
        """Return the other rows in the same wrong unit: the factor brings their signals close to those of `table`.

        Other rows are verification rows and free positions. The result is empty if the supposition is about the
        whole run.
        """
        if not self.scales or self.scope.whole:
            return np.zeros(0, dtype=np.int64)
        usual = float(np.median(np.linalg.norm(self.signal(table), axis=1)))
        known = np.isin(readings.installation, [REFERENCE, SHORTED]) | readings.is_oriented
        sizes = [np.linalg.norm(readings.signal * factor, axis=1) for factor in (np.ones(3), self.factor)]
        as_read, scaled = (np.abs(np.log(np.maximum(size, 1e-300) / usual)) for size in sizes)
        clearly = as_read > 0.5 * float(np.max(np.abs(np.log(self.factor))))
        return np.flatnonzero(~known & (scaled < as_read) & clearly)


def suppositions(table: OrientedRows, *, units: bool = False) -> list[Reinterpretation]:
    """Return every supposition to compare, the simpler ones first; `units` adds other units and ranges."""
    scopes = _scopes(table)
    found: list[Reinterpretation] = []
    for make in (_swapped_channels, _reversed_polarity, _reversed_rotation, _other_label, _shifted):
        found += [supposition for scope in scopes for supposition in make(table, scope)]
    found += _swapped_installations(table)
    passes = np.unique(table.pass_number).tolist() if len(table.mounts) > 1 else []
    scopes[1:1] = [Scope(table.pass_number == p, (), p) for p in passes if len(passes) > 1]
    for make in (_turned_head, *([_other_unit] if units else [])):
        found += [supposition for scope in scopes for supposition in make(table, scope)]
    return found


def other_wirings(points: OrientedRows) -> list[Reinterpretation]:
    """Return the suppositions that channels were exchanged or reversed at the verification points `points`."""
    scope = Scope(points.every, points.mounts)
    return [*_swapped_channels(points, scope), *_reversed_polarity(points, scope)]


def nothing(table: OrientedRows) -> Reinterpretation:
    """Return the supposition that all was recorded correctly."""
    return Reinterpretation("", Scope(table.every), "")


def losses_of(table: OrientedRows) -> list[Reinterpretation]:
    """Return suppositions that one reading, pass or mounting has no usable signals."""
    scopes = [Scope(row) for row in np.eye(len(table), dtype=bool)]
    scopes += [scope for scope in _scopes(table) if not scope.whole]
    rows = np.arange(len(table))
    return [Reinterpretation("", scope, "", source=np.where(scope.mask, -1, rows)) for scope in scopes]


def _scopes(table: OrientedRows) -> list[Scope]:
    scopes = [Scope(table.every)]
    for number, mount in enumerate(table.mounts):
        own = table.mount == number
        if len(table.mounts) > 1:
            scopes.append(Scope(own, (mount,)))
        passes = np.unique(table.pass_number[own]).tolist()
        if len(passes) > 1:
            scopes += [Scope(own & (table.pass_number == p), (mount,), p) for p in passes]
    return scopes


def _swapped_channels(_: OrientedRows, scope: Scope) -> Iterator[Reinterpretation]:
    for wiring in EXCHANGED:
        *first, last = wiring.channels
        channels = f"{', '.join(first)} and {last}" + (f" ({wiring.shown})" if len(first) > 1 else "")
        words = message(f"the channels {channels} are exchanged {scope}")
        words += "; " + message("the copy has their signals put back")
        yield Reinterpretation(MistakeName.SWAPPED_CHANNELS, scope, words, wiring.matrix)


def _reversed_polarity(_: OrientedRows, scope: Scope) -> Iterator[Reinterpretation]:
    for wiring in REVERSED:
        (channel,) = wiring.channels
        words = message(f"channel {channel} has the wrong sign {scope}, as with its wires reversed")
        words += "; " + message("the copy has it turned")
        yield Reinterpretation(MistakeName.REVERSED_POLARITY, scope, words, wiring.matrix)


IN_UNIT_OF_FILE: Final = message("the copy has them in the unit of the file")


def _other_unit(table: OrientedRows, scope: Scope) -> Iterator[Reinterpretation]:
    where = "" if scope.whole else str(scope).removeprefix("in ")
    # all channels, a single one, or two
    sets = [chosen for size in (3, 1, 2) for chosen in combinations(range(3), size)]
    # a wrong unit by one or two prefixes, or a decimal point moved by one or two digits
    for chosen, digits, many in product(sets, (round(PREFIX), 1), filter(None, PREFIXES)):
        tens = digits * many
        factor = np.ones(3)
        factor[list(chosen)] = 10.0**-tens
        said = in_another_unit([CHANNELS[i] for i in chosen], where, table.unit, tens)
        words = f"{said}; {IN_UNIT_OF_FILE}"
        yield Reinterpretation(MistakeName.WRONG_UNIT, scope, words, np.diag(factor))


def _reversed_rotation(table: OrientedRows, scope: Scope) -> Iterator[Reinterpretation]:
    angle = np.where(scope.mask, -table.angle_rad, table.angle_rad)
    words = message(f"the head counts the other way {scope}")
    words += "; " + message("the copy has its angles negated")
    yield Reinterpretation(MistakeName.REVERSED_ROTATION, scope, words, angle_rad=angle)


def _other_label(table: OrientedRows, scope: Scope) -> Iterator[Reinterpretation]:
    if scope.whole:
        return
    own = scope.mounts[0].installation
    for other in table.labels:
        if other != own:
            label = np.where(scope.mask, other, table.label)
            words = message(f"the block sat in installation {other} and not {scope}")
            words += "; " + message("the copy says so")
            yield Reinterpretation(MistakeName.SWAPPED_INSTALLATIONS, scope, words, label=label)


def _swapped_installations(table: OrientedRows) -> list[Reinterpretation]:
    found = []
    passes = np.unique(table.pass_number).tolist()
    for one, other in combinations(table.labels, 2):
        pair = np.isin(table.label, [one, other])
        exchanged = np.where(table.label == one, other, np.where(table.label == other, one, table.label))
        for number in [None, *(passes if len(passes) > 1 else [])]:
            mask = pair if number is None else pair & (table.pass_number == number)
            mounts = tuple(sorted(table.mounts[i] for i in np.unique(table.mount[mask])))
            scope = Scope(mask, mounts, number)
            where = "" if number is None else message(f" in pass {number}")
            words = message(f"installations {one} and {other} are exchanged{where}")
            words += "; " + message("the copy has them put back")
            label = np.where(mask, exchanged, table.label)
            found.append(Reinterpretation(MistakeName.SWAPPED_INSTALLATIONS, scope, words, label=label))
    return found


def _shifted(table: OrientedRows, scope: Scope) -> Iterator[Reinterpretation]:
    """Yield suppositions that, pass by pass, readings are a row late or early, or the head one stop off."""
    runs = table.mount * (table.pass_number.max() + 1) + table.pass_number
    for step in (1, -1):
        words = message(f"the readings stand one stop too {'late' if step > 0 else 'early'} {scope}")
        words += "; " + message("the copy has them moved back, without the stop that has none")
        source = _rows_aside(runs, scope.mask, step)
        if np.mean(source[scope.mask] >= 0) > MOSTLY:  # with too few rows left, any supposition fits
            yield Reinterpretation(MistakeName.SHIFTED_POINTS, scope, words, source=source)
    stop = _stop_rad(table, scope.mask)
    if stop is not None:
        for sign in (-1, 1):
            off = sign * stop
            words = message(f"the head stood one stop {'behind' if sign < 0 else 'ahead'} {scope}")
            words += "; " + message("the copy has the corrected angles")
            angle = np.where(scope.mask, table.angle_rad + off, table.angle_rad)
            yield Reinterpretation(MistakeName.SHIFTED_POINTS, scope, words, angle_rad=angle)


def _turned_head(table: OrientedRows, scope: Scope) -> Iterator[Reinterpretation]:
    """Yield suppositions that the head stood quarter turns, or several wide stops, from where it says.

    Wide stops are clearly farther apart than the marks of the head; with narrow ones any angle would do.
    """
    stops, offs_deg = _stop_rad(table, scope.mask), {90.0, -90.0, 180.0}
    stop_deg = 0.0 if stops is None else round(float(np.degrees(np.max(np.abs(stops[scope.mask])))), 6)
    if stop_deg > CLEARLY_LARGER * MARK_DEG:
        several = np.round(np.arange(2.0, 180.0 / stop_deg) * stop_deg, 5).tolist()
        offs_deg |= {sign * off for off in several for sign in (1.0, -1.0)}
        offs_deg -= {stop_deg, -stop_deg}  # `_shifted` has these
    if scope.whole:  # 180° in all readings looks like all signals reversed
        offs_deg.discard(180.0)
    for off in sorted(offs_deg, key=lambda off: (abs(off), off)):
        angle = np.where(scope.mask, table.angle_rad + np.radians(off), table.angle_rad)
        words = head_was_off(off, f" {scope}")
        half = off == 180.0 and scope.pass_number is None
        yield Reinterpretation(MistakeName.WRONG_SETTING, scope, words, angle_rad=angle, turns_half=half)


def head_was_off(off_deg: float, where: str = "", also: str = "") -> str:
    """Return a sentence: how far (`off_deg`) and `where` the head was off, and that the copy is corrected.

    `also` says in brackets what would look the same.
    """
    words = message(
        f"the signals stand as if the head had been {off_deg:+.4g}° from where it says{where}: its zero or its "
        "index was read wrong"
    )
    return words + "; " + message(f"the copy has the corrected angles{also}")


def _rows_aside(runs: Ints, mask: Mask, step: int) -> Ints:
    """Return, for each row, the index of the row `step` later in its pass (`runs`), -1 if there is none."""
    source = np.arange(len(runs))
    for run in np.unique(runs[mask]):
        places = np.flatnonzero((runs == run) & mask)
        moved = np.full(len(places), -1)
        if step > 0:
            moved[:-1] = places[1:]
        else:
            moved[1:] = places[:-1]
        source[places] = moved
    return source


def _stop_rad(table: OrientedRows, mask: Mask) -> Floats | None:
    """Return each row's signed angle (n,) between stops in its pass, rad; None unless all intervals are equal."""
    stops = np.zeros(len(table))
    widths: list[float] = []
    for mount, number in dict.fromkeys(zip(table.mount[mask], table.pass_number[mask], strict=True)):
        own = mask & (table.mount == mount) & (table.pass_number == number)
        steps = np.diff(table.angle_rad[own])
        if not len(steps):
            continue
        # rounded to minutes of arc, which removes the scatter of the settings; without scatter, as it is
        stop = float(np.median(steps))
        in_minutes = 60.0 * ARCSEC * round(stop / (60.0 * ARCSEC))
        stops[own] = stop if np.ptp(steps) < ARCSEC < abs(stop - in_minutes) else in_minutes
        widths += [*np.abs(steps), float(np.abs(np.median(steps)))]
        if np.ptp(np.sign(steps)):
            return None
    if not widths or np.ptp(widths) > ONE_DIRECTION or min(widths) < ONE_DIRECTION:
        return None
    return stops


def other_mountings(table: OrientedRows) -> list[Reinterpretation]:
    """Return the suppositions that the block was mounted along other axes: 23 rotations for each installation."""
    found = []
    for label in table.labels:
        mask = table.label == label
        scope = Scope(mask, tuple(mount for mount in table.mounts if mount.installation == label))
        for turn in _rotations():
            found.append(Reinterpretation(MistakeName.OTHER_MOUNTING, scope, "", turns={label: turn}))
    return found


def _rotations() -> list[Floats]:
    """Return the 23 rotations of a cube other than the identity."""
    signs = list(product((1.0, -1.0), repeat=3))
    turns = [np.diag(sign) @ wiring.matrix for wiring in (RIGHT, *EXCHANGED) for sign in signs]
    return [turn for turn in turns if np.linalg.det(turn) > 0 and not np.allclose(turn, np.eye(3))]
