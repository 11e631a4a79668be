"""`bench check`, `require` and `plan-points`: what they print, their JSON, the file, what they refuse."""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from bench.config.bench_file.file import load_bench
from bench.config.procedure.check import check as check_against
from bench.config.procedure.load import load_procedure
from bench.config.shipped import find_bench
from bench.planning.requirements import fitted, settings_of, verifying
from tests.support.commands import printed, refused
from tests.support.pages import ROOT


@pytest.fixture
def result(bench):
    """Run a command with JSON on standard output; return its status and the result."""

    def call(*arguments):
        status, out, _ = bench(*arguments, "--json", "-")
        return status, json.loads(out, parse_constant=pytest.fail)

    return call


# --- check --------------------------------------------------------------------------------------------


def test_a_bench_file_without_gravity_is_named_before_the_run_and_in_no_copy_after_it(bench, result):
    text = (ROOT / "config" / "paper-stand.yaml").read_text(encoding="utf-8")
    Path("mine.yaml").write_text(re.sub(r"(?m)^gravity:.*\n", "", text), encoding="utf-8")
    _, found = result("check", "quick", "--bench", "mine.yaml")
    assert [hint for hint in found["hints"] if "states no local gravity" in hint]
    status, out, err = bench("run", "quick", "--bench", "mine.yaml", "--dry-run", "--name", "a")
    assert status == 2
    assert "the bench file states no local gravity" in out
    assert "runs/a: its bench file gave no local gravity; give --g" in err
    printed(bench("calibrate", "a", "--g", "9.81"))


@pytest.mark.parametrize("stated", [True, False])
def test_a_serial_port_without_its_interface_is_told(bench, result, stated):
    text = (ROOT / "config" / "bench-rs232.yaml").read_text(encoding="utf-8")
    assert "      interface: rs232\n" in text
    Path("mine.yaml").write_text(
        text if stated else text.replace("      interface: rs232\n", ""), encoding="utf-8"
    )
    status, out, err = bench("check", "quick", "--bench", "mine.yaml")
    assert (status, err) == (0, "")
    assert out.count("state 'interface: rs232'") == (0 if stated else 3)
    assert len(result("check", "quick", "--bench", "mine.yaml")[1]["hints"]) == (0 if stated else 3)


def test_the_dry_run_that_is_offered_has_the_folder_of_devices(bench):
    Path("mine").mkdir()
    offered = bench("check", "quick", "--devices", "mine")[1].splitlines()[-1]
    assert offered.endswith("bench run quick --devices mine --dry-run")
    assert bench("check", "quick")[1].splitlines()[-1].endswith("bench run quick --dry-run")


def test_the_dry_run_that_is_offered_has_the_goals_and_the_folder_of_runs(bench):
    asked = ("--until", "all=2e-4", "--until", "time=8h", "--runs", "their runs")
    offered = bench("check", "calibration", *asked)[1].splitlines()[-1]
    assert offered.endswith(
        "bench run calibration --until all=2e-4 --until time=8h --runs 'their runs' --dry-run"
    )


# --- require ------------------------------------------------------------------------------------------


@pytest.fixture
def without_alternatives(monkeypatch):
    """Other procedures take most of the time of a requirement."""
    monkeypatch.setattr("bench.services.planning.PROCEDURES", ())


def one_sigma():
    """The paper's bench with its limits as one standard deviation, and verification points at psi = 0."""
    text = find_bench("paper-stand").read_text(encoding="utf-8")
    text = text.replace("k: 3}", "k: 1}").replace("turned: 45 deg", "turned: 0 deg")
    Path("one.yaml").write_text(text, encoding="utf-8")
    return "--bench", "one.yaml"


PAPER = ("--procedure", "paper")
QUICK = ("--procedure", "quick")
CLOSED = ("--estimator", "closed-form", *PAPER)


@pytest.mark.slow
def test_the_command_gives_the_example(bench, without_alternatives):
    status, out, err = bench("require", "--accuracy", "3e-4", *CLOSED, *one_sigma())
    assert (status, err) == (1, "")
    rows = {line.split()[0]: line for line in out.splitlines() if line.strip()}
    assert "66.9″" in rows["mounting_error"] or "67" in rows["mounting_error"]
    assert "cannot be reached" in rows["axis_tilt"]
    assert "NOT KEPT" in out
    gls = next(line for line in out.splitlines() if line.startswith("gls") and " paper " in line)
    assert gls.rstrip().endswith("no limit")


@pytest.mark.slow
def test_json_has_everything_and_no_infinity(result):
    status, found = result("require", "--accuracy", "3e-4 g", *PAPER, *one_sigma())
    assert status == 0
    assert found["kept"] is True
    assert (found["estimator"], found["unit"], found["k"]) == ("gls", "g", 3.0)
    alone = {one["name"]: one for one in found["alone"]}
    assert (alone["mounting_error"]["verdict"], alone["mounting_error"]["u"]) == ("no limit", None)
    # nobody states it: it is as large as the other angle of the mounting
    assert alone["mounting_roll"]["u_now"] == alone["mounting_error"]["u_now"]
    assert sum(one["part"] for one in found["alone"]) == pytest.approx(1.0)
    others = {(one["estimator"], one["procedure"]): one for one in found["alternatives"]}
    closed = others["closed-form", "paper"]
    assert closed["kept"] is False
    assert closed["reached"] == pytest.approx(371e-6, rel=0.005)
    assert ("gls", "turn-24") in others
    assert found["not_counted"] > 0


@pytest.mark.slow
@pytest.mark.usefixtures("without_alternatives")
def test_every_error_can_be_counted_and_the_priors_of_the_block_rule_at_5_g(bench, result):
    at_5_g = ("--up-to", "5g", "--all-errors", "--of")
    status, found = result("require", "--accuracy", "3e-4", *QUICK, *at_5_g, "acceleration")
    assert status == 1
    parts = {one["name"]: one["part"] for one in found["alone"]}
    assert parts["gravity"] > parts["voltmeter_error"] > parts["axis_tilt"]
    assert found["not_counted"] > found["reached"]  # the nonlinearity of the reading in use
    assert {one["verdict"] for one in found["alone"]} == {"cannot be reached"}
    status, whole = result("require", "--accuracy", "2e-3", *QUICK, *at_5_g, "modulus", "--with-reading")
    assert status == 1
    assert next(one["part"] for one in whole["alone"] if one["name"] == "K3") > 0.85
    assert whole["not_counted"] == 0.0
    # the coefficients alone keep to it, and what they leave out is said to be more than it
    asked = ("--accuracy", "2e-3", "--of", "modulus", "--up-to", "5g", *QUICK)
    status, out, _ = bench("require", *asked, "--json", "part.json")
    part = json.loads(Path("part.json").read_text())
    assert status == 0
    assert np.hypot(part["reached"], part["not_counted"]) == pytest.approx(whole["reached"])
    assert "MORE THAN THE ACCURACY" in out


@pytest.mark.slow
@pytest.mark.usefixtures("without_alternatives")
def test_with_every_error_a_coefficient_is_what_a_calibration_signs(result):
    """Coefficients are stated per local g: of them gravity is no error."""
    asked = ("--procedure", "quick", "--bench", "paper-stand")
    found = result("require", "--accuracy", "100 uV/g", "--of", "Kxx", "--all-errors", "--k", 1, *asked)[1]
    budget = result("budget", *asked, "--trials", 0)[1]
    assert found["reached"] == pytest.approx(budget["per_local_g"]["u"][0], rel=1e-6)


@pytest.mark.slow
@pytest.mark.usefixtures("without_alternatives")
def test_the_limits_that_are_printed_keep_to_the_accuracy_in_a_bench_file(bench, result):
    """Rounded down, as what must not be exceeded, and without powers of ten."""
    asked = ("require", "--accuracy", "3e-4", *CLOSED)
    _, out, _ = bench(*asked)
    assert "e+0" not in out
    printed = {line.split()[0]: line.split("  ")[-1].strip() for line in out.splitlines() if line.strip()}
    text = find_bench("paper-stand").read_text(encoding="utf-8")
    # the third mounting angle is left out in the file
    text = text.replace(
        "  setting_error:",
        "  mounting_roll: {limit: 0 arcsec, distribution: normal, k: 3}\n  setting_error:",
    )
    stand = "axis_tilt", "zero_offset", "mounting_error", "mounting_roll", "setting_error", "voltmeter_error"
    for name in stand:
        size = printed[name].replace("″", " arcsec").replace("µV", "uV")
        text = re.sub(rf"({name}: {{limit: )[^,]+,", rf"\g<1>{size},", text)
    Path("balanced.yaml").write_text(text, encoding="utf-8")
    status, found = result(*asked, "--bench", "balanced.yaml")
    assert status == 0
    assert 0.99 * 3e-4 < found["reached"] <= 3e-4


@pytest.mark.slow
@pytest.mark.usefixtures("without_alternatives")
def test_costs_shift_the_limits(result):
    base = ("require", "--accuracy", "1e-4", "--of", "Kyx", *CLOSED, "--share", "cost")
    status, found = result(*base)
    plain = {one["name"]: one["u"] for one in found["together"]}
    assert status == 1
    dear = {one["name"]: one["u"] for one in result(*base, "--cost", "mounting_error=20")[1]["together"]}
    assert dear["mounting_error"] > plain["mounting_error"]
    assert dear["voltmeter_error"] < plain["voltmeter_error"]


# --- plan-points --------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("stand", ["paper-stand", "bench-motorised", "bench-rate-table"])
def test_the_file_that_is_written_is_a_procedure_of_the_bench(bench, stand):
    out = Path("short.yaml")
    asked = ("plan-points", "--bench", stand, "--u", "all=1e-4", "--angles", 12, "--out", out)
    status, text, err = bench(*asked, "--json", "plan.json")
    assert (status, err) == (0, "")
    found = json.loads(Path("plan.json").read_text(encoding="utf-8"))
    # the third mounting angle counts, stated or not, and a third installation shows it
    assert f"{found['settings']} settings in 3 mountings" in text
    plan = load_procedure(out).plan
    planned = [
        (s.mount.installation, s.pass_number, s.point, round(math.degrees(s.angle_rad), 6), s.direction)
        for s in fitted(settings_of(plan))
    ]
    assert planned == [
        (p["installation"], p["pass"], p["point"], round(p["angle_deg"], 6), p["direction"])
        for p in found["points"]
    ]
    assert len(verifying(settings_of(plan))) == 4
    assert plan.expected_duration_s() == pytest.approx(found["time_s"])
    assert check_against(plan, load_bench(find_bench(stand))) == []
    assert all(goal["u"] <= goal["asked_u"] * (1 + 1e-9) for goal in found["goals"])
    before = out.read_bytes()
    refused(bench(*asked), "exists and was not overwritten")
    assert out.read_bytes() == before


@pytest.mark.slow
def test_a_run_of_the_plan_signs_what_it_promised(bench, result):
    """Only the estimated noise may differ from the promise: as chi-square allows in 99.8 %, seed 3.

    With ν degrees of freedom its variance in u is larger by ν/(ν − 2) (scaled t distribution).
    """
    stand = ("--bench", "paper-stand")
    status, plan = result("plan-points", "--u", "all=1e-4", "--angles", 12, *stand, "--out", "plan.yaml")
    assert status == 0
    assert bench("run", "plan.yaml", "--dry-run", "--seed", 3, "--name", "made", *stand)[0] == 0
    status, found = result("calibrate", "made")
    assert status == 0
    u, of_readings = (
        np.array([found["coefficients"][name][member] for name in found["order"]])
        for member in ("u", "u_readings")
    )
    promised = np.diag(plan["covariance"]) - (u**2 - of_readings**2)
    dof = found["noise"]["dof"]
    ratio = of_readings**2 / promised * (dof - 2.0)
    assert np.all((stats.chi2.ppf(0.001, dof) <= ratio) & (ratio <= stats.chi2.ppf(0.999, dof)))


@pytest.mark.slow
def test_a_time_that_is_too_short_for_the_goal_is_said(bench):
    printed(
        bench("plan-points", "--time", "3.5 h", "--delta-g", "4.8e-5"),
        "NOT REACHED in 3.5 h: Δg at verification point",
        status=1,
    )
    status, out, _ = bench("plan-points", "--time", "3.5 h", "--json", "plan.json")
    found = json.loads(Path("plan.json").read_text(encoding="utf-8"))
    assert status == 0
    assert found["time_s"] <= 3.5 * 3600
    assert found["reached"] is None
    assert found["lack_of_fit_tested"] is False
    assert "too few repeats" in out


def test_the_third_mounting_angle_wants_a_further_installation(bench, result):
    """It counts as large as the mounting error: 1 and 2 leave Kyz to it, and 1T90 is among what may be chosen."""
    asked = ("plan-points", "--bench", "paper-stand", "--u", "Kyz=2e-4")
    refused(
        bench(*asked, "--installations", "1,2"),
        "cannot be reached by any number of settings",
        "most of it for Kyz: mounting roll 311 µV/g",
    )
    status, found = result(*asked, "--angles", 8)
    assert status == 0
    assert set(found["mountings"]) & {"1T90", "2T90"}


@pytest.mark.slow
def test_goals_have_units_in_the_table(bench):
    goals = ("--u", "U0x=60 uV", "--modulus", "1e-3", "--up-to", "5")
    out = printed(bench("plan-points", *goals, "--no-verify", "--angles", 8))
    lines = [line.split() for line in out.splitlines()]
    (bias,) = (line for line in lines if line[:1] == ["U0x"])
    assert (bias[1], bias[-1]) == ("60", "µV")
    assert float(bias[2]) <= 60
    assert any(line[:4] == ["|a|", "at", "5", "g"] and line[-1] == "µg" for line in lines)


# --- what is refused ----------------------------------------------------------------------------------

REFUSED = (
    ("require --accuracy soon", "--accuracy soon: expected an acceleration in local gravity"),
    ("require --accuracy -1", "the accuracy must be a positive number"),
    ("require --accuracy 3e-4 --of Kq", "--of Kq: delta-g, acceleration, modulus or a coefficient"),
    ("require --accuracy 3e-4 --up-to 5g", "--up-to needs --of acceleration"),
    ("require --accuracy 3e-4 --of modulus --up-to 0", "give an acceleration above 0"),
    ("require --accuracy 3e-4 --share fair", "--share: give equal or cost"),
    ("require --accuracy 3e-4 --cost axis_tilt=2", "--cost needs --share cost; add it"),
    ("require --accuracy 3e-4 --share cost --cost rent=2", "no error 'rent' to share"),
    ("require --accuracy 3e-4 --share cost --cost axis_tilt=no", "give a positive weight"),
    ("require --accuracy 3e-4 --estimator guess", "no estimator 'guess'"),
    ("require --accuracy 3e-4 --procedure stability", "do not determine"),
    ("require --accuracy 3e-4 --procedure turn-12 --estimator closed-form", "the closed form (8) covers"),
    ("plan-points", "no goal given"),
    ("plan-points --u Kyx", "--u Kyx: give a name and its value, such as Kyx=20e-6"),
    ("plan-points --u Kyx=2kg", "--u 2kg: expected a scale factor"),
    ("plan-points --u Kyx=-1e-6", "must be a positive number, not -1e-06"),
    ("plan-points --u Kq=1e-6", "no coefficient 'Kq'"),
    ("plan-points --time soon", "--time soon: expected a duration"),
    ("plan-points --time 1h", "1 h are too short for a calibration: the shortest takes"),
    ("plan-points --u all=1e-4 --installations 1", "no choice of these installations determines"),
    ("plan-points --u all=1e-4 --installations 1,9", "has no installation 9 for a calibration"),
    ("plan-points --u all=1e-4 --angles 2", "--angles 2: give a number of angles from 3 to 72"),
    ("plan-points --u all=1e-4 --least effort", "--least effort: choose from time, settings"),
    ("plan-points --u all=1e-4 --up-to 5", "--up-to needs --modulus"),
    ("plan-points --u all=1e-4 --out nowhere/p.yaml", "no such folder; create it or name another"),
    ("plan-points --u all=1e-5", "cannot be reached by any number of settings"),
    (
        "plan-points --u all=9e-5 --most-settings 12",
        "not reached with 12 settings, though installations 1, 2",
    ),
    (
        "plan-points --u all=1e-4 --cost-setting 0s",
        "--cost-setting: a setting takes no time; give at least 1 s",
    ),
    ("budget --estimator kalman", "no estimator 'kalman'"),
    ("budget --rule lenient", "unknown decision rule 'lenient'"),
    ("budget --limit -1", "give a positive limit in g"),
    ("budget --trials 10", "--trials: 10 trials are too few"),
    ("budget --g 98", "local gravity between"),
    ("budget --procedure turn-12 --estimator closed-form", "the closed form (8)"),
    ("budget --procedure stability", "do"),
    ("budget --procedure nothing.yaml", "nothing.yaml"),
    ("budget --json no/such/folder.json", "no such folder"),
)


@pytest.mark.slow
@pytest.mark.parametrize(("typed", "words"), REFUSED, ids=[typed for typed, _ in REFUSED])
def test_what_cannot_be_done_is_one_line(bench, typed, words):
    answer = bench(*typed.split())
    refused(answer, words)
    assert answer[1] == ""
