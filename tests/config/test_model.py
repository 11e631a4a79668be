"""Model files: effects by name with values in any unit of their dimension."""

from pathlib import Path

import numpy as np
import pytest

from bench.base.arrays import ARCSEC
from bench.base.yaml_files import FileMistakes
from bench.calibration.design import make_problem
from bench.config.bench_file.file import load_bench
from bench.config.model_file import load_model, write_model_file
from bench.model import CATALOGUE, AppliedEffect, Block, Conditions, ForwardModel
from bench.model.effects import Seen

GOOD = """\
model_file: 1
name: with curvature
data_sha256: 00ff
evidence: {p: 1e-9, found in: run 7}
effects:
  - name: quadratic_nonlinearity
    parameters:
      K2: {x: 60 ug/g^2, z: {value: -0.03 mg/g^2, u: 4 ug/g^2}}
  - name: head_eccentricity
    parameters: {cosine: 8 arcsec, sine: {value: 0.1 arcmin, u: 1 arcsec}}
"""


def load(tmp_path, text):
    path = tmp_path / "model.yaml"
    path.write_text(text, encoding="utf-8")
    return load_model(path)


def test_values_become_si(tmp_path):
    model = load(tmp_path, GOOD)
    assert (model.name, model.parent, model.evidence["p"]) == ("with curvature", "paper", "1e-9")
    curvature, eccentricity = model.applied_effects()
    assert curvature.effect is CATALOGUE["quadratic_nonlinearity"]
    assert curvature.values["K2"] == pytest.approx([60e-6, 0, -30e-6])
    assert curvature.u["K2"] == pytest.approx([0, 0, 4e-6])
    assert eccentricity.values["cosine"] == pytest.approx(8 * ARCSEC)
    assert eccentricity.values["sine"] == pytest.approx(6 * ARCSEC)
    assert list(eccentricity.u) == ["sine"]


def test_one_value_is_for_the_channels_that_are_named(tmp_path):
    text = "model_file: 1\nname: m\neffects:\n  - name: quadratic_nonlinearity\n    channels: [x, z]\n"
    (effect,) = load(tmp_path, text + "    parameters: {K2: 5 ug/g^2}\n").applied_effects()
    assert effect.values["K2"] == pytest.approx([5e-6, 0, 5e-6])
    assert effect.channels == ("x", "z")


def test_all_mistakes_are_told_with_their_lines(tmp_path):
    bad = (
        GOOD.replace("model_file: 1", "model_file: 2")
        .replace("x: 60 ug/g^2", "w: 60 ug/g^2, x: 60 ug")
        .replace("u: 4 ug/g^2", "uu: 4 ug/g^2")
        .replace("cosine", "cosin")
        .replace("u: 1 arcsec", "u: -1 arcsec")
    )
    with pytest.raises(FileMistakes) as error:
        load(tmp_path, bad)
    told = [f"{m.line} {m.place}: {m.text}" for m in error.value.mistakes]
    expected = [
        "1 model_file: expected 1, got '2'",
        "8 effects[1].parameters.K2.w: unknown channel 'w'",
        "8 effects[1].parameters.K2.x: expected a value of K2 such as '30 ug/g^2', got '60 ug'",
        "8 effects[1].parameters.K2.z.uu: unknown key 'uu'; did you mean 'u'?",
        "10 effects[2].parameters.cosin: unknown parameter of head_eccentricity 'cosin'; did you mean 'co",
        "10 effects[2].parameters.sine.u: the standard uncertainty is negative; state 0 or more",
    ]
    assert len(told) == len(expected), told
    for mistake, text in zip(told, expected, strict=True):
        assert mistake.startswith(text)


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ("{cosine: {x: 8 arcsec}}", "cosine has one value, not one for each channel"),
        ("{cosine: {u: 8 arcsec}}", "'value' is missing"),
        ("{cosine: [1, 2]}", "expected a value of cosine such as '8 arcsec', got a list"),
    ],
)
def test_a_parameter_of_the_wrong_form_is_a_mistake(tmp_path, parameters, text):
    head = "model_file: 1\nname: m\neffects:\n  - name: head_eccentricity\n    parameters: "
    with pytest.raises(FileMistakes) as error:
        load(tmp_path, head + parameters + "\n")
    assert text in str(error.value)


def test_a_channel_that_the_effect_does_not_have_has_no_value(tmp_path):
    head = "model_file: 1\nname: m\neffects:\n  - name: quadratic_nonlinearity\n    channels: [x]\n"
    with pytest.raises(FileMistakes, match="channel y is not among 'channels'"):
        load(tmp_path, head + "    parameters: {K2: {y: 1 ug/g^2}}\n")


def test_a_model_is_written_once_and_read_back_as_it_was(tmp_path):
    rng = np.random.default_rng(7)
    k2, u = rng.normal(0, 3e-5, 3), np.abs(rng.normal(0, 1e-6, 3))
    effects = [
        AppliedEffect(CATALOGUE["quadratic_nonlinearity"], {"K2": k2}, u={"K2": u}),
        AppliedEffect(CATALOGUE["head_eccentricity"], {"cosine": np.array(3.3 * ARCSEC)}),
    ]
    path = tmp_path / "found.yaml"
    write_model_file(path, "found", effects, parent="paper", data_sha256="ab", evidence={"p": 1e-9})
    model = load_model(path)
    assert (model.name, model.data_sha256, model.evidence) == ("found", "ab", {"p": "1e-09"})
    first, second = model.applied_effects()
    assert first.values["K2"] == pytest.approx(k2, rel=1e-14)
    assert first.u["K2"] == pytest.approx(u, rel=1e-14)
    assert second.values["cosine"] == pytest.approx(3.3 * ARCSEC, rel=1e-14)
    before = path.read_bytes()
    with pytest.raises(FileMistakes, match="exists and was not overwritten"):
        write_model_file(path, "other", [])
    assert path.read_bytes() == before


HEAD = "model_file: 1\nname: m\neffects:\n"


def test_mountings_and_shapes(tmp_path):
    text = HEAD + "  - name: turn_on_shift\n    installations: ['2', 1/3]\n    parameters: {step: 60 ug}\n"
    text += "  - name: warm_up\n    parameters: {A: 150 ug, tau: 900 s}\n"
    text += "  - name: axis_wobble\n    parameters: {sine: 5 arcsec, harmonic: 2}\n"
    shift, warm, wobble = load(tmp_path, text.replace("harmonic: 2", "harmonic: '2'")).applied_effects()
    assert shift.installations == ("2", "1/3")
    assert warm.installations == ()
    assert float(warm.complete_values()["tau"]) == 900.0
    assert warm.shapes_text() == "tau 15 min"
    assert float(wobble.complete_values()["harmonic"]) == 2.0


@pytest.mark.parametrize(
    ("effect", "told"),
    [
        ("warm_up\n    parameters: {tau: 0 min}", "expected tau to be above 0, got '0 min'"),
        ("warm_up\n    parameters: {tau: -5 min}", "expected tau to be above 0, got '-5 min'"),
        ("warm_up\n    parameters: {tau: 5 uV}", "expected a value of tau such as '20 min', got '5 uV'"),
        ("warm_up\n    parameters: {tau: {value: 5 min, u: 1 min}}", "tau is a shape, which a fit keeps fixed"),
        ("warm_up\n    parameters: {tau: {x: 5 min}}", "tau has one value, not one for each channel"),
        ("thermal_bias\n    parameters: {lag: -1 min}", "expected lag to be 0 or more, got '-1 min'"),
        ("hysteresis\n    installations: 2\n    parameters: {}", "installations"),
        ("voltmeter_gain\n    channels: [y]\n    parameters: {gain: 30 ppm}", "acts on all channels alike"),
    ],
)  # fmt: skip
def test_a_shape_or_mounting_that_cannot_be_is_a_mistake(tmp_path, effect, told):
    with pytest.raises(FileMistakes) as error:
        load(tmp_path, HEAD + f"  - name: {effect}\n")
    assert len(error.value.mistakes) == 1
    assert told in str(error.value)


@pytest.mark.parametrize(
    ("first", "second", "allowed"),
    [
        ("warm_up", "warm_up", False),
        ("warm_up\n    channels: [x]", "warm_up\n    channels: [y, z]", True),
        ("warm_up\n    channels: [x]", "warm_up\n    channels: [x, z]", False),
        ("warm_up\n    parameters: {tau: 10 min}", "warm_up\n    parameters: {tau: 600 s}", False),
        ("warm_up\n    parameters: {tau: 10 min}", "warm_up\n    parameters: {tau: 20 min}", True),
        ("warm_up\n    parameters: {tau: 20 min}", "warm_up", False),
        ("backlash", "backlash", False),
        ("mounting_offset\n    installations: ['1']", "mounting_offset\n    installations: ['2']", True),
    ],
)
def test_an_effect_stands_once(tmp_path, first, second, allowed):
    entries = "".join(
        f"  - name: {one}\n" + ("" if "parameters" in one else "    parameters: {}\n")
        for one in (first, second)
    )
    if allowed:
        assert len(load(tmp_path, HEAD + entries).applied_effects()) == 2
    else:
        with pytest.raises(FileMistakes, match="appears twice for the same channel"):
            load(tmp_path, HEAD + entries)


def test_an_effect_of_a_mounting_that_the_bench_does_not_have_is_a_mistake(tmp_path):
    path = tmp_path / "model.yaml"
    entry = "  - name: mounting_offset\n    parameters: {angle: 90 arcsec}\n    installations: "
    path.write_text(HEAD + entry + "[1, 2/3]\n", encoding="utf-8")
    assert load_model(path, {"1", "2"}).effects[0].installations == ("1", "2/3")
    path.write_text(HEAD + entry + "[1, 7, 2/1, 2/b]\n", encoding="utf-8")
    load_model(path)
    with pytest.raises(FileMistakes) as error:
        load_model(path, {"1", "2"})
    told = [m.text for m in error.value.mistakes]
    series = "expected a series from 2 on after the slash, such as '2/2', got"
    assert told == ["unknown installation '7'; known: 1, 2", f"{series} '2/1'", f"{series} '2/b'"]


def test_a_bench_file_tells_the_line_of_such_a_mounting(tmp_path):
    shipped = (Path(__file__).parents[2] / "config" / "paper-stand.yaml").read_text(encoding="utf-8")
    entry = "  - name: turn_on_shift\n    installations: [3]\n    parameters: {step: 60 ug}\n"
    path = tmp_path / "bench.yaml"
    path.write_text(shipped + "\neffects:\n" + entry, encoding="utf-8")
    line = path.read_text(encoding="utf-8").splitlines().index("    installations: [3]") + 1
    with pytest.raises(FileMistakes, match=rf":{line}: .*unknown installation '3'; known: 1, "):
        load_bench(path)
    path.write_text(path.read_text(encoding="utf-8").replace("[3]", "[2]"), encoding="utf-8")
    assert load_bench(path).applied_effects()[0].installations == ("2",)


# --- what is left open of a shape -------------------------------------------------------------------

OPEN = """\
model_file: 1
name: warm
effects:
  - {name: warm_up, channels: [x], parameters: {A: 300 ug, tau: 20 min}}
left_open:
  - of: warm_up
    times: -0.5
    u: 1
    changes:
      - {name: warm_up, channels: [x], parameters: {A: -40 ug, tau: 20 min}}
      - {name: warm_up, channels: [x], parameters: {A: 60 ug, tau: 10 min}}
"""


def test_what_is_open_of_a_shape_is_told_with_its_sizes(tmp_path):
    """Each change as large as it is in the sum, -0.5 of -40 and 60 ug, with the u that a u of 1 gives it."""
    _, left_open = load(tmp_path, OPEN).applied_effects()
    path = tmp_path / "again.yaml"
    write_model_file(path, "again", [left_open])
    (entry,) = load_model(path).left_open
    assert (entry.of, entry.times, entry.u) == ("warm_up", -0.5, 1.0)
    assert entry.says == (
        "what warm_up may be besides, larger or smaller all at once: "
        "with tau 20 min: A in x 20 ± 40 ug; with tau 10 min: A in x -30 ± 60 ug"
    )
    lines = path.read_text(encoding="utf-8").splitlines()
    assert sum(line.startswith("  - {name: warm_up, ") for line in lines) == 2
    conditions = Conditions.of(["1"] * 3, np.zeros(3), time_s=[0.0, 600.0, 3600.0])
    seen = Seen(np.zeros((3, 3)), conditions, Block(-2.0 * np.eye(3), np.zeros(3)))
    t = conditions.time_s / 60.0
    expected = -2.0 * (20e-6 * np.exp(-t / 20) - 30e-6 * np.exp(-t / 10))
    np.testing.assert_allclose(left_open.addition(seen), np.outer(expected, [1, 0, 0]), atol=1e-15)


def test_a_wrong_unit_in_an_open_shape_is_named_by_its_place(tmp_path):
    with pytest.raises(FileMistakes, match=r"left_open\[1\]\.changes\[2\]\.parameters\.A: expected"):
        load(tmp_path, OPEN.replace("60 ug", "60 uV"))


def test_a_result_names_what_is_open_in_words(tmp_path):
    model = ForwardModel({}, load(tmp_path, OPEN).applied_effects())
    names = make_problem(model, Conditions.of(["1", "2"], [0.0, 1.0]), {}).names()
    assert names == ["warm_up.A[x]", "warm_up in other shapes (1)"]
