"""`bench coefficients`: forms and what they lose; `bench certificate verify`."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import bench as face
from bench.exchange.forms import FORMS
from bench.services.coefficients import coefficients_of
from bench.validation.registry import REFERENCE
from tests.support.certificates import ORDER, copy_run, write_files
from tests.support.commands import printed, refused
from tests.support.pages import ROOT
from tests.support.schemas import keeps_to

RECORDS = ROOT / "tests" / "data" / "records"


@pytest.fixture
def finished(bench):
    shutil.copytree(RECORDS / "finished", "runs/finished")
    return bench


def test_a_run_in_every_form_each_in_its_folder_with_what_it_loses(finished):
    status, out, err = finished("coefficients", "finished", "--as", "all", "--json", "here.json")
    assert (status, err) == (0, "")
    assert out.splitlines()[0].startswith("bench file: paper-stand")
    assert "SIMULATED" in out
    plain = " ".join(out.split())
    assert "nonlinearity, 30 ug/g^2 a^2 and 20 ug/g^3 a^3 of each axis" in plain
    assert (
        "block temperature stated here, which has u = 0.289 K (no band stated: +-0.5 K; 17.3 ug/K and"
        in plain
    )
    written = {path.name for path in Path("runs/finished").glob("coefficients*")}
    assert written == {f"coefficients{form.suffix}" for form in FORMS.values()}
    assert out.count("|a| is off by up to 13 mg, the vector a by up to 22 mg") == 2
    result = json.loads(Path("here.json").read_text(encoding="utf-8"))
    keeps_to("coefficients", result)
    assert result == json.loads(Path("runs/finished/coefficients.json").read_text(encoding="utf-8"))
    assert result["simulated"]
    assert "alpha_yx" in out
    N = np.array([entry["value"] for entry in result["inverse"]["values"].values()])[:9].reshape(3, 3)
    K = np.array([entry["value"] for entry in result["coefficients"].values()])[:9].reshape(3, 3)
    assert pytest.approx(np.eye(3), abs=1e-14) == N @ K


@pytest.mark.slow
def test_a_result_and_the_readings_that_it_is_of_give_the_same_numbers(bench):
    shutil.copy(RECORDS / "readings.csv", "r.csv")
    assert bench("calibrate", "r.csv", "--json", "result.json")[0] == 0
    assert bench("coefficients", "r.csv", "--json", "a.json")[0] == 0
    assert bench("coefficients", "result.json", "--json", "b.json")[0] == 0
    of_readings, of_result = (json.loads(Path(name).read_text()) for name in ("a.json", "b.json"))
    assert of_readings == of_result
    keeps_to("coefficients", of_result)
    assert Path("coefficients/r.json").is_file()
    assert Path("coefficients/result.json").is_file()


def test_what_the_result_says_of_its_uncertainty_is_passed_on(bench):
    """A result with a combined covariance, a k of its own and the part that the readings show."""
    given = json.loads((RECORDS / "calibrate.json").read_text(encoding="utf-8"))
    given = given[0] if isinstance(given, list) else given
    readings = np.array(given["covariance"])
    given.update(covariance=(4 * readings).tolist(), covariance_readings=readings.tolist())
    held = {"certificate": "C-17", "laboratory": "a lab", "date": "2025-01-02", "expired": True}
    given["corrections"] = [{"instrument": "voltmeter.x", **held}]
    for entry in given["coefficients"].values():
        entry.update(k=2.13, U=2.13 * entry["u"], dof=17.0)
    Path("whole.json").write_text(json.dumps(given), encoding="utf-8")
    printed(
        bench("coefficients", "whole.json", "--json", "out.json", "--as", "csv"),
        "combined: the stand",
        "certificates: voltmeter.x C-17 (a lab, 2025-01-02, EXPIRED)",
    )
    result = json.loads(Path("out.json").read_text(encoding="utf-8"))
    keeps_to("coefficients", result)
    assert result["combined"]
    assert result["k"] == 2.13
    assert result["coefficients"]["Kxx"]["U"] == given["coefficients"]["Kxx"]["U"]
    nxx = result["inverse"]["values"]["Nxx"]
    assert nxx["U"] == pytest.approx(2.13 * nxx["u"])
    assert result["covariance_readings"] == given["covariance_readings"]


def test_several_results_in_one_file_are_numbered(bench):
    one = json.loads((RECORDS / "calibrate.json").read_text(encoding="utf-8"))
    one = one[0] if isinstance(one, list) else one
    Path("two.json").write_text(json.dumps([one, one]), encoding="utf-8")
    assert bench("coefficients", "two.json", "--as", "csv")[0] == 0
    assert {path.name for path in Path("coefficients").iterdir()} == {"two-1.csv", "two-2.csv"}


def test_free_positions_in_counts_have_the_scale_factors_that_are_asked_for(bench):
    asked = "--g 9.81744 --out . --as ardupilot --nominal 4063,4040,4065"
    out = printed(bench("coefficients", REFERENCE / "xsens-38.csv", *asked.split()))
    assert "S = (4063.0, 4040.0, 4065.0) counts/g" in Path("xsens-38-ardupilot.param").read_text()
    assert "INS_ACCOFFS_X = 79.95 is outside -3.5 to 3.5, the limits of ArduPilot" in out


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (
            ("finished", "--as", "matlab"),
            "--as matlab: choose from json, csv, c, excel, kalibr, px4, ardupilot, all",
        ),
        (("finished", "--nominal", "2,2"), "--nominal 2,2: give three scale factors"),
        (("finished", "--nominal", "2.18,-2.14,-2.14"), "has scale factors of other signs"),
        (("result.json", "--g", "9.81"), "result.json: is a result with its own bench"),
        (("finished", "finished"), "two sources would write"),
        (("broken.json",), "broken.json: not a result of 'bench calibrate --json'"),
        (("odd.json",), "odd.json: the covariance is not symmetric"),
        (("flat.json",), "flat.json: the matrix K of the result cannot be inverted"),
        (("huge.json",), "huge.json: the result has numbers beyond 1e+12"),
    ],
)
def test_mistakes_are_one_line_each(finished, arguments, told):
    shutil.copy(RECORDS / "calibrate.json", "result.json")
    Path("broken.json").write_text("{", encoding="utf-8")
    one = json.loads((RECORDS / "calibrate.json").read_text(encoding="utf-8"))
    one = one[0] if isinstance(one, list) else one
    one["covariance_readings"] = np.triu(np.array(one["covariance"])).tolist()
    Path("odd.json").write_text(json.dumps(one), encoding="utf-8")
    for name, value in (("flat.json", 0.0), ("huge.json", 1e300)):
        one = json.loads((RECORDS / "calibrate.json").read_text(encoding="utf-8"))
        one["coefficients"]["Kyy"]["value"] = value
        Path(name).write_text(json.dumps(one), encoding="utf-8")
    refused(finished("coefficients", *arguments), told)


def test_from_python_a_form_is_written_and_what_it_loses_is_returned(empty_folder):
    shutil.copy(RECORDS / "readings.csv", "r.csv")
    result = face.calibrate("r.csv")
    assert result.write("all.json", "json") == ()
    read = json.loads(Path("all.json").read_text(encoding="utf-8"))
    assert [
        entry["value"] for entry in read["inverse"]["values"].values()
    ] == result.derived.inverse.values.tolist()
    lost = result.write("unit.params", "px4", nominal=(-2.0, -2.1, -2.1))
    assert "|a| is off by up to" in lost[1]
    assert "S = (-2.0, -2.1, -2.1) V/g" in Path("unit.params").read_text(encoding="utf-8")
    with pytest.raises(face.Refused, match="'matlab': choose from json, csv, c"):
        result.write("unit.m", "matlab")


@pytest.mark.slow
def test_what_is_issued_and_signed_is_intact_until_it_is_changed(bench):
    copy_run(Path("runs"))
    laboratory, order = write_files(Path(), None, ORDER)
    assert bench("key", "keys/lab.pem", "--certificate", "Laboratory of Tests")[0] == 0
    status, out, err = bench(
        "certificate", "finished", "--laboratory", laboratory, "--order", order,
        "--authorised-by", "A. Example", "--key", "keys/lab.pem", "--json", "issued.json",
    )  # fmt: skip
    assert status == 0, err
    files = json.loads(Path("issued.json").read_text())["certificates"][0]["files"]
    (pdf,) = (one for one in files if one.endswith(".pdf"))
    printed(
        bench("certificate", "verify", pdf, "--json", "verdict.json"),
        "intact, signer unknown",
        "SIMULATED",
        "Kxx",
        "the same result to the last digit",
        "not proved: who signed",
    )
    keeps_to("certificate-verify", json.loads(Path("verdict.json").read_text()))
    for file in files:
        trusted = bench("certificate", "verify", file, "--trust", "keys/lab.pem.crt")
        assert "signed by Laboratory of Tests" in trusted[1]
    Path(pdf).write_bytes(Path(pdf).read_bytes() + b"\n")
    out = printed(bench("certificate", "verify", pdf, "--json", "verdict.json"), "CHANGED", status=1)
    assert "Kxx" not in out
    keeps_to("certificate-verify", json.loads(Path("verdict.json").read_text()))
    assert bench("certificate", "verify", "none.pdf")[0] == 2


@pytest.mark.slow
def test_a_result_that_used_temperature_is_written_without_it_only_on_request(bench, tmp_path):
    told = json.loads((RECORDS / "calibrate.json").read_text())
    told["temperature_effects"] = ["thermal_bias"]
    (tmp_path / "warm.json").write_text(json.dumps(told))
    status, _, err = bench("coefficients", "warm.json", "--as", "csv")
    assert status == 2
    assert "corrected for temperature (thermal_bias" in err
    assert "--without-temperature" in err
    status, out, _ = bench("coefficients", "warm.json", "--as", "csv", "--without-temperature")
    assert status == 0
    assert "WITHOUT TEMPERATURE, as asked: thermal_bias" in out
    assert "WITHOUT TEMPERATURE" in (tmp_path / "coefficients" / "warm.csv").read_text()


def test_an_unfit_calibration_is_written_as_such_and_not_accepted(bench):
    """The engineer who takes the file alone sees that the readings contradict the model."""
    told = json.loads((RECORDS / "calibrate.json").read_text())
    told |= {
        "fits": False,
        "notes": ["readings span 75 K"],
        "effects": {"quadratic_nonlinearity.K2[x]": _effect(400.0, "ug/g^2")},
    }
    Path("unfit.json").write_text(json.dumps(told))
    status, out, _ = bench("coefficients", "unfit.json", "--as", "c", "--json", "out.json")
    assert status == 1
    header = Path("coefficients/unfit.h").read_text()
    for text in (out, header):
        assert "NOT ACCEPTED" in text
        assert "quadratic_nonlinearity.K2[x] = 400 ug/g^2" in text
        assert "note 1: readings span 75 K" in text
    result = json.loads(Path("out.json").read_text())
    keeps_to("coefficients", result)
    assert not result["fits"]
    assert result["effects"]["quadratic_nonlinearity.K2[x]"]["value"] == 400.0


def test_an_effect_without_a_value_in_a_result_is_named_all_the_same(bench):
    """A file that was edited, or comes from another program."""
    told = json.loads((RECORDS / "calibrate.json").read_text())
    told["effects"] = {"quadratic_nonlinearity.K2[x]": {"unit": "ug/g^2"}}
    Path("edited.json").write_text(json.dumps(told))
    out = printed(bench("coefficients", "edited.json", "--json", "out.json"))
    assert "leaves out what the model has beside K and U0: quadratic_nonlinearity.K2[x]\n" in out
    assert (
        json.loads(Path("out.json").read_text())["effects"]["quadratic_nonlinearity.K2[x]"]["value"] is None
    )


def _effect(value, unit):
    return {"value": value, "u": 18.0, "unit": unit, "told_by_data": True}


@pytest.mark.parametrize(
    ("effects", "listed", "holds"),
    [
        (["thermal_scale.k_T[x]"], ["thermal_scale"], 20.0),
        (["thermal_misalignment.m_j[x]"], [], 20.0),  # a result of a version that did not list it
        (["thermal_emf.emf[x]"], ["thermal_emf"], None),
    ],
)
def test_coefficients_without_temperature_state_the_temperature_at_which_they_hold(
    bench, effects, listed, holds
):
    told = json.loads((RECORDS / "calibrate.json").read_text())
    told |= {"temperature_c": 31.5, "temperature_effects": listed}
    told["effects"] = {name: _effect(100.0, "ppm/K") for name in effects}
    told.pop("holds_at_c", None)
    Path("warm.json").write_text(json.dumps(told))
    refused(bench("coefficients", "warm.json"), "--without-temperature")
    assert bench("coefficients", "warm.json", "--without-temperature", "--json", "out.json")[0] == 0
    assert json.loads(Path("out.json").read_text())["temperature_c"] == holds


@pytest.mark.parametrize(("effect", "known"), [("thermal_misalignment", True), ("thermal_scale", False)])
def test_biases_and_scale_factors_of_a_model_without_their_temperature_hold_at_that_of_the_readings(
    effect, known
):
    """`verify` at another temperature then adds what the coefficients may have changed since."""
    told = json.loads((RECORDS / "calibrate.json").read_text()) | {"temperature_c": 31.5}
    told["temperature_effects"] = [effect]
    assert np.isfinite(coefficients_of(told, "it").temperature_c) == known


@pytest.mark.parametrize(
    ("effect", "parameters", "holds", "named"),
    [
        ("thermal_misalignment", "{m_j: {value: 20 urad/K, u: 1 urad/K}}", 20.0, True),
        ("thermal_bias", "{b_T: {value: 50 ug/K, u: 1 ug/K}}", 20.0, True),
        ("quadratic_nonlinearity", "{K2: {value: 0 ug/g^2, u: 30 ug/g^2}}", 23.0, False),
    ],
)
def test_a_calibration_states_the_temperature_at_which_its_coefficients_hold(
    empty_folder, effect, parameters, holds, named
):
    """The mean of the readings is 23 °C; an effect of temperature takes the coefficients to its reference."""
    shutil.copytree(RECORDS / "finished", "runs/finished")
    text = f"model_file: 1\nname: warm\neffects:\n  - name: {effect}\n    parameters: {parameters}\n"
    Path("warm.yaml").write_text(text)
    result = face.calibrate("finished", model="warm.yaml").to_dict()
    keeps_to("calibrate", result)
    assert result["temperature_c"] == pytest.approx(23.0, abs=0.5)
    assert result["holds_at_c"] == pytest.approx(holds, abs=0.5 if holds > 20 else 0)
    assert result["temperature_effects"] == ([effect] if named else [])
    assert any(f"corrected by {effect} hold at 20 °C" in note for note in result["notes"]) == named


def test_the_offset_of_an_axis_with_a_negative_scale_factor_is_not_taken_for_its_bias(bench):
    """b is U0/S, of the sign of the signal; the bias K0 that `bench tumble` states has the sign of a."""
    shutil.copy(RECORDS / "readings.csv", "r.csv")
    out = printed(bench("calibrate", "r.csv", "--json", "a.json"), "negative (x, y, z), the bias of a is −b")
    result = json.loads(Path("a.json").read_text(encoding="utf-8"))
    assert "U in V" in out
    assert "+1 on an axis that points up; K in V/g, U0 in V" in result["equation"]
    assert bench("tumble", "r.csv", "--terms", "K2", "--json", "t.json")[0] == 0
    K0 = json.loads(Path("t.json").read_text(encoding="utf-8"))["axes"]["x"]["quantities"]["K0"]["value"]
    bx = result["intrinsic"]["values"]["bx"]["value"]
    assert pytest.approx(-bx, rel=0.01) == K0
