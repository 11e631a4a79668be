"""The discerning procedure: the paper's settings in another order; and the scan order, from file to reading."""

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import subspace_angles

from bench.base.yaml_files import FileMistakes
from bench.config.bench_file.file import load_bench
from bench.config.procedure.check import check
from bench.config.procedure.load import load_procedure
from bench.config.procedure.plan import Plan, Read, SelectInput
from bench.config.shipped import find_bench, find_procedure
from bench.diagnosis.linear import make_linear
from bench.diagnosis.next_measurement import planned_readings
from bench.diagnosis.posterior import NoiseSize
from bench.diagnosis.visibility import EffectPart, ReadingDesign
from bench.model import CATALOGUE, AppliedEffect, ForwardModel
from bench.run.folder import Run

BENCH = load_bench(find_bench("paper-stand"))
MODEL = ForwardModel(BENCH.installation_models())


def plan_of(name):
    return load_procedure(find_procedure(name)).plan


# --- what it measures -------------------------------------------------------------------------------


def settings(plan):
    return [s for s in plan.steps if isinstance(s, Read) and s.installation not in {"V", "S", "R"}]


def test_it_has_the_papers_settings_a_third_of_them_turned():
    """Each angle as often as in the paper, in each of its two installations as it is or turned by 180°."""
    paper = Counter((s.installation, round(math.degrees(s.target_rad))) for s in settings(plan_of("paper")))
    own = settings(plan_of("discerning"))
    assert Counter((s.installation[0], round(math.degrees(s.target_rad))) for s in own) == paper
    assert Counter(s.installation for s in own) == {"1": 18, "1T180": 9, "2": 18, "2T180": 9}
    verified = [s for s in plan_of("discerning").steps if isinstance(s, Read) and s.installation == "V"]
    assert [round(math.degrees(s.target_rad)) for s in verified] == [45, 135, 225, 315]


def test_both_directions_and_both_scan_orders_are_in_each_installation():
    passes = Counter(
        (s.installation, s.pass_number, s.direction, s.scan) for s in settings(plan_of("discerning"))
    )
    assert passes == {
        ("1", 1, 1, "xyz"): 9,
        ("1", 2, -1, "zyx"): 9,
        ("1T180", 1, 1, ""): 9,
        ("2", 1, 1, "zyx"): 9,
        ("2", 2, -1, "xyz"): 9,
        ("2T180", 1, 1, ""): 9,
    }


def test_short_and_reference_of_both_signs_stand_before_each_pass_and_at_the_end():
    switched = [(s.source, s.reference_v) for s in plan_of("discerning").steps if isinstance(s, SelectInput)]
    once = [("short", None), ("reference", 2.0), ("reference", -2.0), ("signal", None)]
    assert switched == once * 7


SEPARATED_BY_ORDER = [
    (EffectPart("backlash", "play", (), (), None), EffectPart("zero_offset", "angle", (), (), None), 0.5),
    (
        EffectPart("mounting_error", "angle", (), ("1",), None),
        EffectPart("mounting_offset", "angle", (), ("2",), None),
        0.1,
    ),
    (EffectPart("voltmeter_drift", "rate", (), (), None), None, 0.5),
    (EffectPart("voltmeter_nonlinearity", "q2", (), (), None), None, 0.7),
]
RIVALS = {
    "voltmeter_drift": ("bias_drift", "rate"),
    "voltmeter_nonlinearity": ("quadratic_nonlinearity", "K2"),
}


@pytest.mark.parametrize(("one", "other", "at_most"), SEPARATED_BY_ORDER)
def test_it_breaks_ties_of_the_papers_order(one, other, at_most):
    stand_u = {name: d.u for name, d in BENCH.stand_distributions().items() if name != "voltmeter_error"}
    family, parameter = RIVALS.get(one.family, ("", ""))
    rival = (other,) if other else tuple(EffectPart(family, parameter, (), (), c) for c in range(3))
    angle = {}
    for name in ("paper", "discerning"):
        planned = planned_readings(plan_of(name), MODEL, BENCH.simulated_block())
        linear = make_linear(planned.select(planned.installation != "V"), MODEL, stand_u)
        design = ReadingDesign(linear, NoiseSize(15e-6, stand_u["setting_error"], 42))
        angle[name] = subspace_angles(design.seen((one,)), design.seen(rival)).min()
    assert np.cos(angle["paper"]) > 0.999
    assert np.cos(angle["discerning"]) < at_most


# --- the scan order ---------------------------------------------------------------------------------

SCANNED = """\
procedure: scanned
title: two scan orders
reading: {samples: 2, nplc: 1, settle: 1 s}
steps:
  - installation:
      label: 1
      steps:
        - repeat:
            times: 2
            scans: [XYZ, zyx]
            steps:
              - turn: {angles: {from: 0 deg, step: 90 deg, count: 4}}
        - turn: {angles: [45 deg], first_point: 9}
"""


@pytest.fixture
def scanned(tmp_path):
    path = tmp_path / "scanned.yaml"
    path.write_text(SCANNED)
    return path


def test_each_pass_has_its_scan_order_and_a_plan_keeps_it(scanned):
    plan = load_procedure(scanned).plan
    orders = [step.scan for step in plan.steps if isinstance(step, Read)]
    assert orders == ["xyz"] * 4 + ["zyx"] * 4 + [""]
    assert Plan.from_json(plan.to_json()) == plan
    written = [step for step in plan.to_json()["steps"] if step["step"] == "read"]
    assert [step.get("scan") for step in written] == ["xyz"] * 4 + ["zyx"] * 4 + [None]
    described = [step.describe() for step in plan.steps if isinstance(step, Read)]
    assert described[4].endswith(", the channels in the order z, y, x")
    assert "order" not in described[-1]


@pytest.mark.parametrize(
    ("scans", "told"),
    [
        ("[xyz]", "state an order in 'scans' for each pass: 2, not 1"),
        ("[xyz, zzy]", "such as xyz or zyx, got 'zzy'"),
    ],
)
def test_a_scan_order_that_is_none_is_a_mistake(scanned, scans, told):
    scanned.write_text(SCANNED.replace("[XYZ, zyx]", scans))
    with pytest.raises(FileMistakes, match=r"scanned\.yaml:") as error:
        load_procedure(scanned)
    assert told in str(error.value)


def test_a_run_triggers_the_meters_in_that_order_and_its_readings_say_so(bench, scanned, tmp_path):
    """A crosstalk large enough to be seen alone: each channel keeps a part of the one triggered before it."""
    model = tmp_path / "model.yaml"
    model.write_text(
        "model_file: 1\nname: hidden\neffects:\n"
        "  - {name: channel_crosstalk, parameters: {fraction: 20000 ppm}}\n"
    )
    status, _, err = bench("run", scanned, "--dry-run", "--name", "a", "--model", model)
    assert (status, err) == (0, "")
    readings = Run(tmp_path / "runs" / "a").readings()
    assert readings.extra["scan_order"].tolist() == ["xyz"] * 4 + ["zyx"] * 4 + ["xyz"]
    crosstalk = AppliedEffect(CATALOGUE["channel_crosstalk"], {"fraction": np.asarray(0.02)})
    hidden = ForwardModel(BENCH.installation_models(), (crosstalk,))
    conditions = readings.conditions()
    expected = hidden.readings(BENCH.simulated_block(), conditions, np.zeros((1, 5)))
    # 90″ of mounting error are 1 mV, a slip of the operator 10′ at most; crosstalk is 40 mV
    np.testing.assert_allclose(readings.signal, expected, atol=8e-3)
    unsaid = replace(conditions, scan_order=np.tile([0, 1, 2], (9, 1)))
    wrong = hidden.readings(BENCH.simulated_block(), unsaid, np.zeros((1, 5)))
    assert np.max(np.abs(readings.signal - wrong)[4:8]) > 0.02


def test_a_multiplexer_refuses_another_order_than_its_own(scanned):
    plan = load_procedure(scanned).plan
    (problem,) = check(plan, load_bench(find_bench("bench-multiplexer")))
    assert problem == (
        "step 0016/read/1.2.1: the procedure reads the channels in the order zyx, but this bench's "
        "multiplexer can only use "
        "xyz alone; remove 'scans' in a copy of the procedure"
    )
    assert check(plan, BENCH) == []
