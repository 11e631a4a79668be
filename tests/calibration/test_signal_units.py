"""Signals in mV where the file says V: all, a channel, a pass, an installation; and none where they are right."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.calibration import CalibrationError
from bench.calibration.mistakes import refuse_mixed_units, sheet_of, wrong_unit
from bench.diagnosis.mistakes.search import find_mistakes
from bench.model import ForwardModel
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2
from bench.readings.csv import read_csv
from bench.readings.table import stacked

SHEET = (-2.18, -2.14, -2.14)
MODEL = ForwardModel({"1": INSTALLATION_1, "2": INSTALLATION_2})


@pytest.fixture(scope="module")
def readings():
    """Two passes of the paper's points, with the verification points in the first."""
    file = Path(__file__).parents[1] / "data" / "records" / "readings.csv"
    one = read_csv(file, ("1", "2", "V"))
    two = replace(one, pass_number=one.pass_number + 1)
    return replace(stacked([one, two]), source="r.csv", began_s=None, block=None)


def scaled(readings, rows=True, channels=(0, 1, 2), factor=1e3):
    signal = readings.signal.copy()
    mask = np.zeros(signal.shape, dtype=bool)
    mask[np.ix_(np.flatnonzero(np.broadcast_to(rows, len(readings))), channels)] = True
    signal[mask] *= factor
    return replace(readings, signal=signal)


CASES = {
    "all signals seem to be in mV": ({}, {}),
    "all signals seem to be in µV": ({"factor": 1e6}, {}),
    "the signals of channel y seem to be in mV": ({"channels": (1,)}, {}),
    "the signals of channel x, z seem to be in another unit": ({"channels": (0, 2), "factor": 1e-3}, {}),
    "all signals of pass 2 seem to be in mV": ({}, {"pass_number": 2}),
    "the signals of channel z of pass 2 seem to be in mV": ({"channels": (2,)}, {"pass_number": 2}),
    "all signals of installation 2 seem to be in mV": ({}, {"installation": "2"}),
    "the signals of channel y of installation 1 seem to be in mV": (
        {"channels": (1,)},
        {"installation": "1"},
    ),
}


@pytest.mark.parametrize("words", CASES)
@pytest.mark.parametrize("sheet", [SHEET, None])
def test_another_unit_is_named_and_put_right(readings, words, sheet):
    how, where = CASES[words]
    rows = np.ones(len(readings), dtype=bool)
    for name, value in where.items():
        rows &= getattr(readings, name) == value
    spoilt = scaled(readings, rows, **how)
    found = wrong_unit(spoilt, MODEL, sheet)
    if sheet is None and (not where and len(how.get("channels", (0, 1, 2))) == 3):
        assert found is None  # only the data sheet shows it
        return
    if sheet is None and how.get("factor") == 1e-3:
        words = "the signals of channel y seem to be in mV"  # the smallest are taken to be right
    assert found is not None
    assert found.words.startswith(words)
    corrected = found.corrected(spoilt).signal
    factor = 1e-3 if sheet is None and how.get("factor") == 1e-3 else 1.0
    np.testing.assert_allclose(corrected, readings.signal * factor, rtol=1e-12)


@pytest.mark.parametrize("words", [w for w in CASES if not w.startswith("all signals seem")])
def test_a_calibration_refuses_signals_in_two_units_and_a_diagnosis_names_them(readings, words):
    how, where = CASES[words]
    rows = np.ones(len(readings), dtype=bool)
    for name, value in where.items():
        rows &= getattr(readings, name) == value
    spoilt = scaled(readings, rows, **how)
    with pytest.raises(CalibrationError, match=rf"r\.csv: {words}.*write them in one unit"):
        refuse_mixed_units(spoilt, MODEL, SHEET)
    first, *_ = find_mistakes(spoilt, MODEL, {}, np.array(SHEET)).mistakes
    assert first.name == "wrong_unit"
    assert first.words.startswith(words)
    assert first.pass_number == where.get("pass_number")
    assert first.evidence.after < 1e-2 * first.evidence.before or how.get("factor") == 1e-3


def test_the_p_of_a_wrong_unit_comes_of_its_odds(readings):
    """More readings make longer odds; a marker would be the same for all."""
    few = readings.select(readings.point <= 3)
    spoilt = scaled(few, channels=(1,), factor=1e-3)
    (unit,) = find_mistakes(spoilt, MODEL, {}, np.array(SHEET)).mistakes
    more = find_mistakes(scaled(readings, channels=(1,), factor=1e-3), MODEL, {}, np.array(SHEET)).mistakes[0]
    assert unit.name == "wrong_unit"
    assert unit.p > more.p > sys.float_info.min


def test_where_the_units_are_right_nothing_is_said(readings):
    """Blocks with scale factors drawn within a factor of 1.8 of the sheet, biases to 2 g, one axis reversed."""
    draw = np.random.default_rng(20261123)
    assert wrong_unit(readings, MODEL, SHEET) is None
    for _ in range(50):
        scale = np.exp(draw.uniform(-0.58, 0.58, 3)) * draw.choice((1.0, -1.0), 3)
        other = replace(readings, signal=readings.signal * scale + draw.uniform(-4.0, 4.0, 3))
        assert wrong_unit(other, MODEL, SHEET) is None
        assert wrong_unit(other, MODEL, None) is None


def test_one_position_says_nothing_of_units(readings):
    few = readings.select((readings.point == 1) & (readings.installation == "1"))
    assert len(few) == 2
    assert wrong_unit(scaled(few), MODEL, SHEET) is None


def test_what_a_data_sheet_says_in_each_unit():
    assert sheet_of("V", SHEET) == SHEET
    assert sheet_of("g", SHEET) == (1.0, 1.0, 1.0)
    assert sheet_of("counts", SHEET) is None
