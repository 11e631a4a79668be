"""What a diagnosis says of what it does not know: values known together, assumptions, a contradicted model."""

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from markupsafe import escape

from bench.base.arrays import ARCSEC
from bench.config.bench_file.file import load_bench
from bench.config.shipped import find_bench
from bench.diagnosis import NamedEffect, diagnose
from bench.diagnosis.candidates import Candidates, Column, Variant
from bench.diagnosis.next_measurement import propose
from bench.diagnosis.posterior import known_together
from bench.diagnosis.show import CoefficientChange, contradicted
from bench.model import CATALOGUE, AppliedEffect
from bench.readings.csv import write_csv
from bench.results.diagnosis_words import less_certain, p_in_column, p_in_words, parameters_in_words
from tests.support.diagnosis_bench import MODEL, STAND, OneThreshold, paper_run

K2_STATED = """\
model_file: 1
name: stated
effects:
  - {name: quadratic_nonlinearity, channels: [y], parameters: {K2: {value: 100 ug/g^2, u: 8 ug/g^2}}}
"""


@pytest.fixture(autouse=True, scope="module")
def no_bench_file():
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("BENCH_FILE", raising=False)
        yield


def measured(name, **hidden):
    write_csv(paper_run(np.random.default_rng(3), directions=(1, -1, 1), **hidden), Path(name))
    return name


def result_of(path):
    return json.loads(Path(path).read_text(encoding="utf-8"))


# --- values known together --------------------------------------------------------------------------


def roll_in_both(covariance, value=(1.0, 1.2)):
    """What is known of a mounting roll in installations 1 and 2, plausible size 90 arcsec."""
    kinds = (Column("angle", None, ("1",)), Column("angle", None, ("2",)))
    variant = Variant("mounting_roll", (0, 1), (0, 1, 2), ("1", "2"))
    candidates = Candidates(np.zeros((1, 2)), kinds, np.full(2, 90 * ARCSEC), (variant,))
    return known_together(candidates, variant, np.array(value), np.array(covariance))


@pytest.mark.parametrize(
    ("correlation", "combination", "value"), [(-0.995, "sum", 198.0), (0.995, "difference", -18.0)]
)
def test_a_sum_or_difference_is_told_where_it_alone_is_known(correlation, combination, value):
    (known,) = roll_in_both([[0.5, 0.5 * correlation], [0.5 * correlation, 0.5]])
    assert (known.combination, known.of) == (combination, ("installation 1", "installation 2"))
    assert known.value == pytest.approx(value)
    assert known.u == pytest.approx(90.0 * np.sqrt(2 * 0.5 * (1 - 0.995)))
    assert known.unit == "arcsec"
    effect = NamedEffect("mounting_roll", (), ("1", "2"), (), (), (), 0.0, 0.0, 1.0, "", together=(known,))
    (line,) = parameters_in_words(effect)
    assert line.startswith(f"{combination} of angle of installation 1 and installation 2 = ")


def test_values_that_are_known_one_by_one_are_told_so():
    assert roll_in_both([[0.5, -0.3], [-0.3, 0.5]]) == ()
    assert roll_in_both([[0.5, 0.0], [0.0, 0.5]]) == ()


def test_coefficients_that_are_known_worse_with_the_effect_are_named():
    u_after = {"Kxx": 1.1e-5, "Kyz": 2.5e-3, "U0x": 3e-5}
    changes = {name: CoefficientChange(1.0, 1e-5, 1.0, u) for name, u in u_after.items()}
    assert less_certain(changes) == ["Kyz (u 250 times)", "U0x (u 3.0 times)"]


def test_probabilities_far_out_are_not_told_to_the_last_power():
    assert p_in_words(0.0034) == "p = 0.003"
    assert p_in_words(0.4734, 2) == "p = 0.47"
    assert p_in_words(4e-217) == p_in_words(0.0) == "p < 1e-09"
    assert (p_in_column(0.0), p_in_column(0.02)) == ("< 1e-09", "0.02")


# --- what is taken for granted ----------------------------------------------------------------------


def diagnosed(readings, model=MODEL):
    return diagnose(readings, model, STAND, None, OneThreshold())


@pytest.mark.slow
def test_readings_without_times_say_so():
    readings = paper_run(np.random.default_rng(3))
    (note,) = diagnosed(replace(readings, time_s=np.full(len(readings), np.nan))).notes
    assert "no times in the readings: 2 min a setting and 20 min for a remount" in note


@pytest.mark.slow
def test_signals_in_g_are_no_voltages_and_no_procedure_is_proposed_to_show_volts():
    readings = paper_run(np.random.default_rng(3))
    found = diagnosed(replace(readings, unit="g", signal=readings.signal / 2.14))
    assert (
        "stated in volts are not searched for (meters_exchanged, voltmeter_nonlinearity, " in found.notes[-1]
    )
    assert np.isinf(found.detectable["voltmeter_nonlinearity"])
    proposal = propose(found, load_bench(find_bench("paper-stand")))
    assert not {"voltmeter_nonlinearity", "voltmeter_offset", "thermal_emf"} & set(proposal.shows)


def with_references(table, *stated):
    """The table with two readings of a reference at its end, 2 V and -2 V, of the values stated."""
    rows = np.append(np.arange(len(table)), [0, 1])
    longer = {
        f.name: getattr(table, f.name)[rows]
        for f in fields(table)
        if isinstance(getattr(table, f.name), np.ndarray)
    }
    longer["installation"] = np.append(table.installation, ["R", "R"])
    longer["angle_rad"][-2:] = np.nan
    longer["signal"][-2:] = [[2.0] * 3, [-2.0] * 3]
    voltages = np.array([""] * len(table) + list(stated))
    return replace(table, **longer, extra={"reference_v": voltages})


@pytest.mark.slow
def test_a_reference_whose_value_nobody_stated_shows_no_gain():
    plain = paper_run(np.random.default_rng(3))
    known, unknown = diagnosed(with_references(plain, "2", "-2")), diagnosed(with_references(plain, "", ""))
    assert not any("no times" in note for note in known.notes)
    # 100 ppm is what the reference itself is known to: some hundreds of ppm are found, which is 10 plausible sizes
    assert 3 < known.detectable["voltmeter_gain"] < 30
    assert "voltmeter_gain" not in known.hidden
    assert unknown.detectable["voltmeter_gain"] > 1000
    assert "voltmeter_gain" in unknown.hidden


# --- a model that was given -------------------------------------------------------------------------


def stated(value, u):
    return AppliedEffect(
        CATALOGUE["quadratic_nonlinearity"],
        {"K2": np.array([0, value, 0])},
        ("y",),
        {"K2": np.array([0, u, 0])},
    )


def test_a_stated_value_is_contradicted_by_what_the_readings_add():
    # prior 100 +- 8, readings 20 +- 6 (independent): weighted mean and u by hand; they differ by 80/10 = 8 u
    weight = np.array([1 / 8**2, 1 / 6**2])
    mean, u = float(weight @ [100, 20] / weight.sum()), float(1 / np.sqrt(weight.sum()))
    (text,) = contradicted([stated(100e-6, 8e-6)], [stated(mean * 1e-6, u * 1e-6)])
    assert "K2 of y" in text
    assert "by 8.0 u" in text
    weight = float(weight @ [100, 75] / weight.sum())
    assert list(contradicted([stated(100e-6, 8e-6)], [stated(weight * 1e-6, u * 1e-6)])) == []


@pytest.mark.slow
def test_a_model_of_another_block_is_told_and_the_page_is_written(bench):
    Path("stated.yaml").write_text(K2_STATED, encoding="utf-8")
    status, _, err = bench("diagnose", measured("null.csv"), "--model", "stated.yaml", "--json", "d.json")
    found = result_of("d.json")
    assert (status, err) == (0, "")
    (note,) = [note for note in found["notes"] if "contradict" in note]
    assert "K2 of y of quadratic_nonlinearity as 100" in note
    assert str(escape(note)) in Path(found["report"]).read_text(encoding="utf-8")
    # what the model has is no effect that could never show
    assert "quadratic_nonlinearity" not in found["hidden"]
    assert "voltmeter_gain" in found["hidden"]


def test_a_file_where_the_folder_should_be_is_told_before_the_work(bench):
    Path("taken").write_text("", encoding="utf-8")
    status, _, err = bench("diagnose", measured("null.csv"), "--out", "taken")
    assert (status, err.strip()) == (2, "bench: --out taken: this is a file; name a folder")
