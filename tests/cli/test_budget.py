"""`bench budget` as its user types it."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from bench.calibration.budget.coefficients import make_budget
from bench.readings.csv import write_csv
from bench.validation.paper_bench import simulate
from tests.cli.test_app import edited_stand
from tests.support.budget_bench import COEFFICIENTS, paper_setup, stand
from tests.support.commands import refused

ONE_SIGMA = {
    "limit: 5 arcsec, distribution: normal, k: 3": "limit: 5 arcsec, distribution: normal, k: 1",
    "limit: 90 arcsec, distribution: normal, k: 3": "limit: 90 arcsec, distribution: normal, k: 1",
    "limit: 10 arcsec, distribution: normal, k: 3": "limit: 10 arcsec, distribution: normal, k: 1",
    "limit: 0.3 mV, distribution: normal, k: 3": "limit: 0.3 mV, distribution: normal, k: 1",
    # the paper leaves the third mounting angle out
    "  setting_error:": "  mounting_roll: {limit: 0 arcsec, distribution: rectangular}\n  setting_error:",
}


def result_of(bench, *arguments, status=0):
    code, out, err = bench("budget", *arguments, "--json", "-")
    assert (code, err) == (status, "")
    return json.loads(out)


@pytest.mark.slow
def test_the_table_of_the_paper_from_a_bench_file(bench):
    """The same numbers as from the parts themselves, through file, procedure and JSON."""
    file = edited_stand(**ONE_SIGMA)
    for estimator in ("gls", "closed-form", "ols"):
        arguments = ("--bench", file, "--procedure", "paper", "--estimator", estimator, "--trials", 0)
        told = result_of(bench, *arguments)
        expected = make_budget(paper_setup(), stand(), estimator)
        np.testing.assert_allclose(told["groups"]["stand"]["covariance"], expected.combined.covariance, rtol=1e-6,
                                   atol=1e-18)  # fmt: skip
        for contribution in expected.contributions:
            found = told["sources"][contribution.source.name]["contribution_u"]
            np.testing.assert_allclose(found, contribution.u, rtol=1e-6, atol=1e-12)
        assert told["order"] == COEFFICIENTS
        assert told["monte_carlo"] is None


def test_json_adds_up(bench):
    told = result_of(bench, "--trials", 2500)
    total = sum(np.array(source["covariance"]) for source in told["sources"].values())
    np.testing.assert_allclose(told["covariance"], total, rtol=1e-9, atol=1e-24)
    for i, name in enumerate(COEFFICIENTS):
        one = told["coefficients"][name]
        assert one["u"] == pytest.approx(np.sqrt(total[i, i]))
        assert one["U"] == pytest.approx(one["k"] * one["u"])
        assert one["u"] ** 2 == pytest.approx(sum(u**2 for u in one["by_source"].values()))
    without_g = total - np.array(told["sources"]["gravity"]["covariance"])
    np.testing.assert_allclose(told["per_local_g"]["u"], np.sqrt(np.diag(without_g)), rtol=1e-6)
    assert [row["magnitude_g"] for row in told["acceleration"]["magnitudes"]] == [1, 2, 5, 10]
    check = told["verification"]
    assert (check["rule"], check["false_acceptance"], check["capable"]) == ("non-binary", 0.05, False)
    for point in check["points"]:
        assert point["accepted_up_to"] == pytest.approx(3e-4 - 1.64485 * point["u"], rel=0.01)
    assert len(told["verification"]["points"]) == 4
    # each point passes with 92 %; 300 runs simulated elsewhere, 80 ± 2 % of which passed all four
    assert min(point["passes"] for point in check["points"]) == pytest.approx(0.92, abs=0.01)
    assert check["passes"] == pytest.approx(0.80, abs=0.03)
    assert told["monte_carlo"]["trials"] == 2500
    assert len(told["monte_carlo"]["outputs"]) == 16
    assert told["coefficients"]["Kxy"]["dof"] is None


def test_printed_for_a_person(bench):
    code, out, err = bench("budget", "--trials", 2500)
    assert (code, err) == (0, "")
    for told in (
        "mounting_error",
        "combined u",
        "U (k = 2.00, 95.45 %)",
        "10 g",
        "rule: non-binary (false acceptance ≤ 5 % a point): CANNOT BE PASSED with 95.45 %",
        "passes all points together with 8",
        "clause 8",
    ):
        assert told in out
    assert re.search(r"from 5 g on K2 and K3 dominate \(9\d % of the variance", out)
    assert max(len(line) for line in out.splitlines() if not line.startswith(("note", "Monte"))) <= 150


@pytest.mark.slow
def test_the_words_on_the_mounting_roll_are_those_of_the_table(bench):
    """What the table counts, no note calls zero: not stated, as stated, and as zero because somebody says so."""
    silent = result_of(bench, "--bench", "paper-stand", "--trials", 0)
    assert silent["coefficients"]["Kyz"]["by_source"]["mounting_roll"] == pytest.approx(311e-6, rel=0.01)
    (note,) = (note for note in silent["notes"] if "mounting_roll" in note)
    assert "not stated in the bench file, assumed as large as mounting_error" in note
    stated = result_of(bench, "--bench", "bench-motorised", "--trials", 0)
    assert not any("mounting_roll" in note for note in stated["notes"])
    assert not any("zero" in note for note in (*silent["notes"], *stated["notes"]))


@pytest.mark.slow
def test_a_page_with_figures(bench):
    code, _, _ = bench("budget", "--trials", 2500, "--out", "page", "--rule", "simple")
    assert code == 0
    page = Path("page/budget.html").read_text(encoding="utf-8")
    assert page.count("<svg") == 2
    assert "http" not in page.replace("http://www.w3.org", "")
    assert "The check can be passed" in page
    assert {f.name for f in Path("page").iterdir()} == {
        "budget.html", "budget-coefficients.svg", "budget-coefficients.png", "budget-acceleration.svg",
        "budget-acceleration.png",
    }  # fmt: skip
    assert Path("page/budget-coefficients.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_the_rule_decides_the_exit_status_where_one_is_asked_for(bench):
    file = edited_stand(**ONE_SIGMA)
    simple = ("--bench", file, "--trials", 0, "--limit", 2e-4)
    assert result_of(bench, *simple)["verification"]["capable"] is False
    assert (
        result_of(bench, *simple, "--rule", "simple", status=1)["verification"]["rule"] == "simple acceptance"
    )
    assert result_of(bench, *simple, "--rule", "guarded", status=1)["verification"]["rule"] == "guarded"
    loose = ("--trials", 0, "--rule", "guarded", "--limit", 6e-4)
    assert result_of(bench, *loose)["verification"]["capable"] is True


def test_a_model_file_adds_its_effects(bench):
    Path("model.yaml").write_text(
        "model_file: 1\nname: found\neffects:\n  - name: quadratic_nonlinearity\n    channels: [x]\n"
        "    parameters: {K2: {x: {value: 60 ug/g^2, u: 4 ug/g^2}}}\n",
        encoding="utf-8",
    )
    told = result_of(bench, "--trials", 0, "--model", "model.yaml", "--estimator", "least-squares")
    source = told["sources"]["quadratic_nonlinearity.K2[x]"]
    assert source["shown"] == "4 ug/g^2"
    assert source["u"] == pytest.approx(4e-6)
    assert source["contribution_u"][COEFFICIENTS.index("U0x")] > 0
    prior = told["sources"]["K2"]["contribution_u"]
    assert prior[COEFFICIENTS.index("U0x")] == pytest.approx(0.0, abs=1e-15)
    assert prior[COEFFICIENTS.index("U0y")] > 1e-6


def test_coefficients_of_a_calibration_take_the_place_of_the_bench_files(bench):
    write_csv(simulate(np.random.default_rng(1), 1e-4), Path("unit.csv"))
    assert bench("calibrate", "unit.csv", "--json", "unit.json")[0] == 0
    told = result_of(bench, "--trials", 0, "--coefficients", "unit.json")
    assert told["about"] == "unit.json"
    calibrated = json.loads(Path("unit.json").read_text())["coefficients"]
    assert told["coefficients"]["Kyy"]["value"] == calibrated["Kyy"]["value"]


def test_a_singular_block_has_no_budget(bench):
    write_csv(simulate(np.random.default_rng(1), 1e-4), Path("unit.csv"))
    assert bench("calibrate", "unit.csv", "--json", "unit.json")[0] == 0
    result = json.loads(Path("unit.json").read_text())
    for name in "Kyx", "Kyy", "Kyz":
        result["coefficients"][name] = result["coefficients"]["Kx" + name[2]]
    Path("unit.json").write_text(json.dumps(result))
    refused(
        bench("budget", "--coefficients", "unit.json", "--trials", 0),
        "unit.json: K is singular: channels x and y respond equally",
    )


@pytest.mark.slow
def test_a_procedure_of_several_temperatures_says_what_its_budget_takes_for_granted(bench):
    told = result_of(bench, "--procedure", "temperature", "--trials", 0)
    assert any("5 temperatures, and the coefficients are assumed" in note for note in told["notes"])
    assert not any("temperatures," in note for note in result_of(bench, "--trials", 0)["notes"])


def test_robust_counts_as_generalised_least_squares(bench):
    assert result_of(bench, "--trials", 0, "--estimator", "robust")["estimator"] == "gls"


@pytest.mark.slow
def test_a_bench_without_gravity_is_told(bench):
    file = edited_stand(**{"gravity: {latitude: 50.449 deg, height: 180 m}": "# none"})
    refused(bench("budget", "--bench", file), "give --g 9.81")
    assert result_of(bench, "--bench", file, "--g", "9.8105", "--trials", 0)["g_m_s2"] == 9.8105
