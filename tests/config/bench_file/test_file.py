"""Bench files: what they give, and all mistakes at once with their lines."""

import math
import re
import textwrap

import numpy as np
import pytest

from bench.base.arrays import ARCSEC
from bench.base.yaml_files import FileMistakes, sha256_of_file
from bench.config.bench_file.file import STAND_ERRORS, load_bench, load_recorded_bench
from bench.config.devices.registry import devices
from bench.config.devices.sections import VoltmeterKind
from bench.config.model_file import load_model
from bench.config.shipped import find_bench


@pytest.fixture
def paper_text():
    return find_bench("paper-stand").read_text(encoding="utf-8")


@pytest.fixture
def line_of(paper_text):
    """Return the line (1…) of the paper's bench file that holds a text."""

    def find(text):
        lines = [n for n, line in enumerate(paper_text.splitlines(), start=1) if text in line]
        assert len(lines) == 1, text
        return lines[0]

    return find


@pytest.mark.parametrize("name", ["axis_tilt", "zero_offset", "mounting_error", "setting_error"])
def test_an_error_of_the_stand_that_is_no_small_angle_is_refused(mistakes, paper_text, name):
    absurd = re.sub(rf"({name}: {{limit: )[^,]*", r"\g<1>5 deg", paper_text)
    (told,) = mistakes(absurd)
    assert f"stand.{name}.limit: an error of 5 deg is too large for a limit of a bench" in told


def test_the_paper_stand_is_the_papers():
    bench = load_bench(find_bench("paper-stand"))
    block = bench.simulated_block()
    assert np.array_equal(
        block.K,
        [[-2.177087, -0.018243, 0.025027], [0.026542, -2.139892, 0.032755], [0.006754, 0.006026, -2.144367]],
    )
    assert np.array_equal(block.U0, [0.071469, -0.196485, -0.411789])
    stand = bench.stand_distributions()
    assert tuple(stand) == STAND_ERRORS
    arcsec = [
        stand[name].u / ARCSEC for name in ("axis_tilt", "zero_offset", "mounting_error", "setting_error")
    ]
    assert arcsec == pytest.approx([5 / 3, 5 / 3, 30, 10 / 3])
    assert stand["voltmeter_error"].u == pytest.approx(1e-4)
    assert stand["mounting_roll"].u == stand["mounting_offset"].u == 0.0
    assert bench.gravity_m_s2 == pytest.approx(9.8105, abs=1e-3)
    assert bench.verification.limit == 3e-4
    assert bench.voltmeter_range_v == 10.0
    assert bench.unit_under_test.scale_factors.values == (-2.18, -2.14, -2.14)
    assert [meter.name for meter in bench.instruments.voltmeters] == [f"voltmeter.{c}" for c in "xyz"]
    assert bench.instruments.head.tolerance == pytest.approx(30 * ARCSEC)


def test_installations_are_the_papers_two_and_the_stated_ones():
    models = load_bench(find_bench("paper-stand")).installation_models()
    assert list(models) == ["1", "2", "V", "1T90", "2T90", "1T180", "2T180"]
    assert np.array_equal(models["1"].block_from_platform, np.eye(3))
    assert np.array_equal(models["2"].block_from_platform, [[-1, 0, 0], [0, 0, 1], [0, 1, 0]])
    half = math.sqrt(0.5)
    assert models["V"].block_from_platform == pytest.approx(
        np.array([[half, half, 0], [-half, half, 0], [0, 0, 1]])
    )


@pytest.mark.parametrize(
    ("driver", "highest_v", "nplc", "memory_readings"),
    [
        ("agilent-34401a", 1000.0, (0.02, 0.2, 1.0, 10.0, 100.0), 512),
        ("keysight-34461a", 1000.0, (0.02, 0.2, 1.0, 10.0, 100.0), 10_000),
        ("keysight-34970a", 300.0, (0.02, 0.2, 1.0, 2.0, 10.0, 20.0, 100.0, 200.0), 50_000),
    ],
)
def test_voltmeters_can_what_their_manuals_say(driver, highest_v, nplc, memory_readings):
    limits = VoltmeterKind.of(devices().get(driver).section.facts).limits
    assert limits.ranges_v == (0.1, 1.0, 10.0, 100.0, highest_v)
    assert (limits.nplc, limits.most_samples) == (nplc, memory_readings)


def test_what_is_left_out_has_its_default(tmp_path, paper_text):
    path = tmp_path / "b.yaml"
    text = paper_text[: paper_text.index("# What follows is the truth")]
    path.write_text("\n".join(line for line in text.splitlines() if not line.startswith("gravity")))
    bench = load_bench(path)
    assert bench.gravity_m_s2 is None
    assert np.array_equal(bench.simulated_block().K, np.diag([-2.18, -2.14, -2.14]))
    assert bench.applied_effects() == ()
    assert sha256_of_file(path) != sha256_of_file(find_bench("paper-stand"))


def test_many_mistakes_are_told_at_once_with_their_lines(mistakes, paper_text, line_of):
    changes = {
        "latitude: 50.449 deg": "latitude: 95 deg",
        "GPIB0::23": "GPIB0::22",
        "channels: [z]": "channels: [x]",
        "tolerance: 30 arcsec": "tolerence: 30 arcsec",
        "{limit: 5 arcsec, distribution: normal, k: 3}       #": "{limit: 5 mV, distribution: norml, k: 3}  #",
        "axes: [x, y, z]": "axes: [x, z, y]",
        "limit: 3e-4 g": "limit: 3e-4",
        "noise: yes": "noise: maybe",
    }
    lines = {old: line_of(old) for old in changes}
    changed = paper_text
    for old, new in changes.items():
        changed = changed.replace(old, new)
    voltmeters = line_of("  voltmeters:")
    told = mistakes(changed)
    expected = [
        (lines["latitude: 50.449 deg"], "gravity.latitude: state a latitude between -90° and 90°"),
        (voltmeters, "instruments.voltmeters: no voltmeter reads channel z"),
        (lines["GPIB0::23"], "instruments.voltmeters[2].resource: 'GPIB0::22::INSTR' is voltmeter 1"),
        (lines["channels: [z]"], "instruments.voltmeters[3].channels: channel x is carried by voltmeter 1"),
        (lines["tolerance: 30 arcsec"], "unknown key 'tolerence'; did you mean 'tolerance'?"),
        (line_of("zero_offset:"), "expected normal or rectangular, got 'norml'; did you mean 'normal'?"),
        (
            line_of("zero_offset:"),
            "stand.zero_offset.limit: expected an angle such as '90 arcsec', got '5 mV'",
        ),
        (lines["axes: [x, y, z]"], "installations.V.axes: the axes x, z, y are not"),
        (lines["limit: 3e-4 g"], "verification.limit: expected an acceleration in local gravity"),
        (lines["noise: yes"], "simulation.voltmeter.noise: expected yes or no, got 'maybe'"),
    ]
    assert len(told) == len(expected), told
    for mistake, (line, text) in zip(told, expected, strict=True):
        assert mistake.startswith(f"{line} ")
        assert text in mistake


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("x: -2.18 V/g", "x: -218 V/g",
         "scale_factors.x: 1 g gives 218 V, but the voltmeters read no more than 12 V"),
        ("-2.177087 V/g", "-11.99 V/g", "simulation.block.K[1]: channel x reaches 12.1 V in a turn"),
        ("-2.177087 V/g, ", "", "simulation.block.K[1]: expected a list of at least 3, got a list of 2"),
        ("x: -2.18 V/g", "x: 0 V/g", "the scale factor is 0; state another number"),
        ("  V: {axes", "  S: {axes", "installations.S: F (free), S (shorted), R (reference)"),
        ("about: z}", "about: w}", "expected x, y or z, got 'w'"),
        ("turned: 45 deg", "turned: 45", "got '45' without a unit"),
        ("minimum: -40 degC, maximum: 60 degC", "minimum: 60 degC, maximum: -40 degC",
         "the minimum 60 °C must be below"),
        ("limit: 90 arcsec, distribution: normal, k: 3", "limit: 90 arcsec, distribution: normal", "add 'k'"),
        ("limit: 90 arcsec, distribution: normal", "limit: 90 arcsec, distribution: rectangular", "has no 'k'"),
        ("limit: 90 arcsec", "limit: -90 arcsec", "not negative"),
        ("line_frequency: 50 Hz", "line_frequency: 55 Hz", "state 50 Hz or 60 Hz"),
        ('"GPIB0::22::INSTR"', "address 22", "expected a VISA resource such as 'GPIB0::22::INSTR'"),
        ("gravity: {latitude: 50.449 deg, height: 180 m}", "gravity: 8.9 m/s^2",
         "gravity: state local gravity between"),
        ("name: paper-stand\n", "", ": 'name' is missing"),
        ("name: paper-stand", "name: [a, b]", "name: expected a text, got a list of 2"),
        ("resolution: 1 arcsec", "resolution: 0 arcsec", "state the resolution of the scale"),
        ("slip_probability: 0.01 ", "slip_probability: 2 ", "expected less than 1.0, got '2'"),
    ],
)  # fmt: skip
def test_each_mistake_is_one_sentence(mistakes, paper_text, old, new, text):
    assert paper_text.count(old) == 1
    told = mistakes(paper_text.replace(old, new))
    assert len(told) == 1, told
    assert text in told[0]


def test_ranges_are_those_of_the_meter_and_the_same_for_all(mistakes, paper_text):
    first, rest = paper_text.split("range: 10 V", 1)
    told = mistakes(first + "range: 20 V" + rest)
    assert len(told) == 3
    assert (
        "voltmeters[1].range: the agilent-34401a has no range of 20 V; choose from 0.1 V, 1 V, 10 V"
        in told[0]
    )
    assert (
        "voltmeters[2].range: this voltmeter has the range 10 V, the first 20 V; give all the same range"
        in told[1]
    )


def test_effects_are_checked_and_applied(tmp_path, mistakes, paper_text):
    effects = """
effects:
  - name: quadratic_nonlinearity
    channels: [y]
    parameters: {K2: 60 ug/g^2}
"""
    path = tmp_path / "good.yaml"
    path.write_text(paper_text + effects, encoding="utf-8")
    (applied,) = load_bench(path).applied_effects()
    assert applied.values["K2"] == pytest.approx([0, 60e-6, 0])
    line = paper_text.count("\n") + 3
    (told,) = mistakes(paper_text + effects.replace("quadratic_nonlin", "quadratic_nonlim"))
    assert told.startswith(
        f"{line} effects[1].name: unknown effect 'quadratic_nonlimearity'; did you mean 'quad"
    )


HIDDEN = """
  formulas:
    - name: fourth_power
      sentence: the output has a part with the fourth power
      stage: block output
      expression: K4 * a**4
      parameters: {K4: {plausible: 20 ug/g^4}}
  effects:
    - name: quadratic_nonlinearity
      channels: [y]
      parameters: {K2: 60 ug/g^2}
    - name: fourth_power
      parameters: {K4: {x: 50 ug/g^4}}
  left_open:
    - of: quadratic_nonlinearity
      times: 0.5
      u: 1
      changes:
        - {name: quadratic_nonlinearity, channels: [z], parameters: {K2: 10 ug/g^2}}
"""


def test_the_simulation_has_effects_as_a_model_file_states_them(tmp_path, mistakes, paper_text):
    """The lists of a model file stand in the section `simulation`; no evaluation of readings knows of them."""
    assert paper_text.rstrip().splitlines()[-1].startswith("  ")  # of the section simulation
    path = tmp_path / "good.yaml"
    text = paper_text.rstrip() + HIDDEN
    path.write_text(text, encoding="utf-8")
    bench = load_bench(path)
    quadratic, fourth, left_open = bench.applied_effects()
    assert quadratic.values["K2"] == pytest.approx([0, 60e-6, 0])
    assert fourth.values["K4"] == pytest.approx([50e-6, 0, 0])
    assert left_open.values["part"] == 0.5
    assert bench.own_effects() == ()
    model = f"model_file: 1\nname: same{textwrap.dedent(HIDDEN)}"
    (tmp_path / "model.yaml").write_text(model, encoding="utf-8")
    same = load_model(tmp_path / "model.yaml").applied_effects()
    assert [str(a) for a in same] == [str(a) for a in bench.applied_effects()]
    assert load_recorded_bench(path).applied_effects() == ()
    line = text[: text.index("K2: 60 ug")].count("\n") + 1
    (told,) = mistakes(text.replace("K2: 60 ug/g^2", "K2: 60 ug"))
    assert told.startswith(f"{line} simulation.effects[1].parameters.K2: expected a value of K2 such as")
    twice = text + "effects:\n  - {name: bias_drift, parameters: {rate: 3 ug/h}}\n"
    (told,) = mistakes(twice)
    assert "move all of them there" in told


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"", "the file is empty"),
        (b"# nothing\n", "the file is empty"),
        (b"name: x\nserial: caf\xe9\n", ":2: the file is not UTF-8 text"),
        (b"name: x\n\tstand: 1\n", ":2: this is not YAML"),
        (b"name: a: b\n", "put a text with a colon in quotes"),
        (b"- a\n- b\n", ":1: expected keys with values, got a list of 2"),
        (b"a: &x 1\nb: *x\n", "anchors and aliases"),
        (b"a: !!python/object:os.system x\n", "is not allowed"),
        (b"[" * 5000, "this is not YAML"),
    ],
)
def test_a_file_that_is_no_bench_file_is_told_in_words(tmp_path, content, text):
    path = tmp_path / "b.yaml"
    path.write_bytes(content)
    with pytest.raises(FileMistakes) as error:
        load_bench(path)
    assert text in str(error.value)


def test_a_file_that_is_not_there_is_told_in_one_sentence(tmp_path):
    with pytest.raises(FileMistakes, match=r"nothing\.yaml: there is no such file"):
        load_bench(tmp_path / "nothing.yaml")
    with pytest.raises(FileMistakes, match="this is a folder"):
        load_bench(tmp_path)
