"""The cases of the third trial: the hidden effect or mistake of each, its noise, and the readings that follow."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.third_trial.forms import HIDDEN, OUTSIDE, SCATTER, hidden
from benchmarks.third_trial.stand import (
    AS_SAID,
    DAYS,
    NOISES,
    Day,
    Floats,
    Form,
    K,
    Rng,
    Truth,
    day,
    read,
    rho,
)

Mask = NDArray[np.bool_]
SHARES: Final = {"null": 0.16, "catalogue": 0.42, "outside": 0.42}
"""Frequencies of the groups in the main trial; the names in a group are equally frequent, ln rho is uniform."""
_HUNDRED: Final = [group for group, share in SHARES.items() for _ in range(round(100 * share))]
SMALLEST: Final = 6.0
LARGEST: Final = 40.0


@dataclass(frozen=True)
class Case:
    """A case made from its seed and number, with the readings (n, 3), V, that the program receives."""

    seed: int
    number: int
    group: str
    name: str
    rho: float
    noise: str
    day: int
    signal: Floats
    form: Form | None = None
    words: tuple[str, ...] = ()
    """Words of which a headline must contain one as the place; for a mistake, its right names."""


def _draw(seed: int, number: int, what: int) -> Rng:
    return np.random.default_rng([seed, what, number])


def main_case(seed: int, number: int) -> Case:
    """Return a case of the main trial; the groups are shuffled, and the names in a group are used in turn."""
    order = np.random.default_rng([seed, 9, number // 100]).permutation(100)
    group = _HUNDRED[order[number % 100]]
    earlier = [_HUNDRED[k] for k in order[: number % 100]].count(group)
    turn = earlier + (number // 100) * _HUNDRED.count(group)
    return _case(seed, number, group, turn)


def null_case(seed: int, number: int) -> Case:
    """Return a case of the trial of nulls: a complete model; the kinds of noise as often as in the main trial."""
    return _case(seed, number, "null", number)


def form_case(seed: int, number: int) -> Case:
    """Return a case of the trial of forms: an effect outside the catalogue whose mean is not zero."""
    return _case(seed, number, "form", number)


def _case(seed: int, number: int, group: str, turn: int) -> Case:
    rng = _draw(seed, number, 1)
    kind = str(rng.choice(list(NOISES), p=list(NOISES.values())))
    size = float(np.exp(rng.uniform(np.log(SMALLEST), np.log(LARGEST))))
    on, drawn = int(rng.integers(DAYS)), int(rng.integers(2**31))
    if group == "null":
        return Case(seed, number, group, "", 0.0, kind, on, read(day(on), kind, rng))
    names = list(HIDDEN if group == "catalogue" else OUTSIDE)
    names = [name for name in names if group != "form" or name not in SCATTER]
    name = names[turn % len(names)]
    form = hidden(name, size, on, drawn)
    return Case(seed, number, group, name, size, kind, on, read(day(on), kind, rng, [form]), form)


def far_case(seed: int, number: int) -> Case:
    """Return a case in which a verification point, a reading or a channel is off by 8 to 40 u."""
    rng = _draw(seed, number, 2)
    on, units = int(rng.integers(DAYS)), float(rng.uniform(8, 40))
    the, kind = day(on), str(rng.choice(list(NOISES)))
    channel, what = int(rng.integers(3)), ("V", "reading", "channel of a pass", "noisy channel")[number % 4]
    row, shape = int(rng.choice(np.flatnonzero(the.fitted != (what == "V")))), np.zeros((len(the), 3))
    words = tuple(f"{word} {'xyz'[channel]}" for word in ("channel", "of", "in"))
    if what == "V":
        shape[row], words = (
            K @ rng.normal(size=3),
            ("verification", "V point", "installation V", "V,", "V pass"),
        )
    elif what == "reading":
        shape[row, channel], words = 1.0, (*words, f"point {the.point[row]}")
    else:
        shape[the.sweep == the.sweep[row] if what == "channel of a pass" else the.sweep >= 0, channel] = 1.0
    signal = read(the, kind, rng)
    if what == "noisy channel":
        # this channel is four to twenty times as noisy as the others
        signal += units / 2 * 15e-6 * shape * rng.normal(size=(len(the), 1))
    else:
        signal += shape * units / rho(shape, on) * rng.choice([-1, 1])
    return Case(seed, number, "far", what, units, kind, on, signal, words=words)


# --- mistakes -------------------------------------------------------------------------------------------


def _part(rng: Rng, on: Day) -> Mask:
    return np.asarray(on.label == str(rng.integers(1, 3)))


def _pass(rng: Rng, on: Day) -> Mask:
    return np.asarray(on.sweep == rng.integers(6))


def _row(rng: Rng, on: Day) -> int:
    """Draw a row of installation 1 or 2 that is not the first of a pass."""
    return int(rng.choice(np.flatnonzero(on.fitted & (on.point > 1))))


def _every(_: Rng, on: Day) -> Mask:
    return np.ones(len(on), dtype=bool)


def _channel(rng: Rng, rows: Mask) -> Mask:
    """Draw a channel, as a mask (n, 3) for some rows."""
    return np.outer(rows, np.arange(3) == rng.integers(3))


def _order(rng: Rng) -> list[int]:
    return [[1, 0, 2], [2, 1, 0], [0, 2, 1], [1, 2, 0], [2, 0, 1]][rng.integers(5)]


def _angle_off(rng: Rng, on: Day, degrees: float, rows: Mask) -> Truth:
    return Truth(angle=on.angle + rows * np.radians(degrees) * rng.choice([-1, 1]))


def _angle_before(on: Day, rows: NDArray[np.int64]) -> Truth:
    """Return a `Truth` with the head, in these rows, still at the angle of the preceding row."""
    angle = on.angle.copy()
    angle[rows] = on.angle[rows - 1]
    return Truth(angle=angle)


def _exchanged(on: Day, one: str, other: str) -> Truth:
    label = np.where(on.label == one, other, np.where(on.label == other, one, on.label))
    return Truth(label=label)


def _labelled(on: Day, label: str) -> Truth:
    return Truth(label=np.where(on.label == "2", label, on.label))


def _points(rng: Rng, on: Day, signal: Floats) -> Floats:
    row, order = _row(rng, on), np.arange(len(on))
    order[[row - 1, row]] = row, row - 1
    return signal[order]


def _stuck(rng: Rng, on: Day, signal: Floats) -> Floats:
    rows, channel = np.flatnonzero(_pass(rng, on)), rng.integers(3)
    signal[rows, channel] = signal[rows[0], channel]
    return signal


def _meters(rng: Rng, on: Day, signal: Floats) -> Floats:
    """Return the signals as after two meters were exchanged in a part of the run."""
    rows, channel = _part(rng, on), int(rng.integers(3))
    sign = np.eye(3)[channel] - np.eye(3)[(channel + 1) % 3]
    gain, zero = 80e-6 * rng.standard_normal(), 400e-6 * rng.standard_normal()
    return np.asarray(signal + rows[:, None] * sign * (gain * signal + zero))


def _outlier(rng: Rng, on: Day, signal: Floats) -> Floats:
    signal[_row(rng, on), rng.integers(3)] += rng.choice([-1, 1]) * rng.uniform(1e-3, 0.1)
    return signal


_UNIT = ("wrong_unit", "wrong_range")
_SLIP = ("head_zero_shift", "block_slip", "wrong_setting")
TRUE: Final[dict[str, tuple[tuple[str, ...], Callable[[Rng, Day], Truth]]]] = {
    "reversed rotation": (("reversed_rotation", "reversed_polarity"), lambda _, on: Truth(angle=-on.angle)),
    "installations exchanged": (("swapped_installations",), lambda _, on: _exchanged(on, "1", "2")),
    "points late": (("shifted_points",), lambda r, on: _angle_before(on, np.flatnonzero(_part(r, on))[1:])),
    "head not turned": (("not_turned", "wrong_setting"), lambda r, on: _angle_before(on, np.array([_row(r, on)]))),
    "1° at a point": (("wrong_setting",), lambda r, on: _angle_off(r, on, 1.0, np.arange(len(on)) == _row(r, on))),
    "10′ at a point": (
        ("wrong_setting",), lambda r, on: _angle_off(r, on, 1 / 6, np.arange(len(on)) == _row(r, on))
    ),
    "1° in a pass": (_SLIP, lambda r, on: _angle_off(r, on, 1.0, _pass(r, on))),
    "10′ in a pass": (_SLIP, lambda r, on: _angle_off(r, on, 1 / 6, _pass(r, on))),
    "wrong orientation": (("other_mounting",), lambda _, on: _labelled(on, "2T180")),
    "not remounted": (("not_remounted", "swapped_installations"), lambda _, on: _labelled(on, "1")),
    "another block in a pass": (("another_block", "other_block"), lambda r, on: Truth(other_block=_pass(r, on))),
}  # fmt: skip
"""For each mistake, its right names and the function that draws the true angles and labels."""
READ: Final[dict[str, tuple[tuple[str, ...], Callable[[Rng, Day, Floats], Floats]]]] = {
    "swapped channels": (("swapped_channels",), lambda r, _, u: u[:, _order(r)]),
    "swapped channels of an installation": (
        ("swapped_channels",), lambda r, on, u: np.where(_part(r, on)[:, None], u[:, _order(r)], u)
    ),
    "reversed polarity": (
        ("reversed_polarity", "reversed_rotation"), lambda r, on, u: np.where(_channel(r, _every(r, on)), -u, u)
    ),
    "reversed polarity of an installation": (
        ("reversed_polarity",), lambda r, on, u: np.where(_channel(r, _part(r, on)), -u, u)
    ),
    "points exchanged": (("exchanged_points", "swapped_points", "wrong_setting", "shifted_points"), _points),
    "mV for V": (_UNIT, lambda _, __, u: 1000 * u),
    "mV for V in a channel of a pass": (_UNIT, lambda r, on, u: np.where(_channel(r, _pass(r, on)), 1000 * u, u)),
    "decimal of a channel of a pass": (_UNIT, lambda r, on, u: np.where(_channel(r, _pass(r, on)), 10 * u, u)),
    "stuck channel": (("stuck_channel", "stuck"), _stuck),
    "meters exchanged": (("meters_exchanged",), _meters),
    "outlier": (("outlier",), _outlier),
}  # fmt: skip
"""For each mistake, its right names and the function that changes the signals."""
MISTAKES: Final = (*TRUE, *READ)


def mistake_case(seed: int, number: int) -> Case:
    """Return a case with a mistake, the kinds in turn."""
    rng = _draw(seed, number, 3)
    name, on = MISTAKES[number % len(MISTAKES)], int(rng.integers(DAYS))
    truth = TRUE[name][1](rng, day(on)) if name in TRUE else AS_SAID
    signal = read(day(on), "normal", rng, truth=truth)
    signal = READ[name][1](rng, day(on), signal) if name in READ else signal
    return Case(seed, number, "mistake", name, 0.0, "normal", on, signal, words=(TRUE | READ)[name][0])
