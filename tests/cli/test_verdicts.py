"""One verdict wherever it is told: limit and rule of the bench file, or those that the command names."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.readings.csv import read_csv, write_csv
from bench.readings.table import make_readings, stacked
from bench.validation.paper_bench import ARCSEC, U0, K, simulate, specific_force
from tests.cli.test_app import edited_stand
from tests.support.commands import printed, refused
from tests.support.schemas import keeps_to

THETA = np.radians([45.0, 135.0, 225.0, 315.0])


@pytest.fixture
def unit(bench):
    """Coefficients in unit.json, and verification points in check.csv of which the second is out by 130 µg."""
    write_csv(simulate(np.random.default_rng(2), 1e-4), Path("unit.csv"))
    signal = specific_force(["V"] * 4, THETA, psi=np.radians(45.0)) @ K.T + U0
    signal[1, 2] += 4e-4
    write_csv(make_readings(["V"] * 4, [1] * 4, [1, 2, 3, 4], THETA, signal), Path("check.csv"))
    assert bench("calibrate", "unit.csv", "--json", "unit.json")[0] == 0
    return ("verify", "check.csv", "--coefficients", "unit.json", "--json", "-")


def told(bench, *arguments):
    status, out, _ = bench(*arguments)
    result = json.loads(out)
    keeps_to("verify", result)
    return status, result


@pytest.mark.slow
def test_residuals_above_the_stated_noise_are_named_beside_a_verdict(bench):
    """Seed 2: one pass by a head with 300 arcsec of eccentricity, and four verification points."""
    one = simulate(np.random.default_rng(2), 1e-4, passes=1, eccentricity_rad=(300 * ARCSEC, 0.0))
    check = specific_force(["V"] * 4, THETA, psi=np.radians(45.0)) @ K.T + U0
    table = make_readings(
        [*one.installation, *["V"] * 4], [1] * (len(one) + 4), [*one.point, 1, 2, 3, 4],
        np.concatenate([one.angle_rad, THETA]), np.concatenate([one.signal, check]),
    )  # fmt: skip
    write_csv(table, Path("one.csv"))
    for command in ("calibrate", "verify"):
        said = json.loads(bench(command, "one.csv", "--json", "-")[1])
        assert sum("repeat passes, and check the head or the model" in note for note in said["notes"]) == 1


@pytest.mark.slow
def test_the_bench_file_says_how_a_verdict_is_found(bench, unit):
    file = edited_stand(
        **{"limit: 3e-4 g   # Δg_A": "limit: 240 ug\n  rule: guarded\n  guard_band: 0.5\n"
           "  population: {standard_deviation: 100 ug}"}
    )  # fmt: skip
    status, result = told(bench, *unit, "--bench", file)
    assert (result["rule"], result["guard_band"]) == ("guarded", 0.5)
    assert (result["limit_g"], result["statement"]) == (pytest.approx(2.4e-4), "pass")
    assert (status, result["passed"]) == (0, True)
    assert result["global_risk"]["population"] == {"mean": 0.0, "standard_deviation": pytest.approx(1e-4)}
    for point in result["points"]:
        assert point["accepted_up_to"] == pytest.approx(2.4e-4 - 0.5 * point["U"])
    # what the command names goes before
    status, result = told(bench, *unit, "--bench", file, "--rule", "guarded", "--guard-band", "1")
    assert (status, result["guard_band"], result["statement"]) == (1, 1.0, "conditional pass")
    status, result = told(bench, *unit, "--bench", file, "--rule", "simple")
    assert (status, result["rule"], result["statement"]) == (0, "simple acceptance", "conditional pass")
    status, result = told(bench, *unit, "--bench", file, "--limit", "5e-5")
    assert (status, result["statement"], result["p_false_accept"]) == (1, "inconclusive", None)


def test_all_that_is_wrong_with_a_question_is_told_at_once(bench, unit):
    err = refused(
        bench(*unit, "--limit", "-1", "--rule", "guarded", "--guard-band", "-2", "--population", "0", "0")
    )
    for problem in ("--limit -1.0", "a guard band of -2 U", "the second above 0"):
        assert problem in err
    refused(bench(*unit, "--rule", "simple", "--guard-band", "0.5"), "simple acceptance has no guard band")


@pytest.mark.slow
def test_a_rule_that_nobody_states_accepts_five_per_cent_of_false_acceptance(bench, unit):
    """Pass, conditional and fail as the limit nears; simple acceptance is there for who says so."""
    status, result = told(bench, *unit)
    assert (status, result["rule"], result["false_acceptance"]) == (0, "non-binary", 0.05)
    worst = max(result["points"], key=lambda p: abs(p["delta_g"]))
    at = abs(worst["delta_g"]) + 1.6449 * worst["u"]
    for limit, expected in ((1.001 * at, (0, "pass")), (0.99 * at, (1, "conditional pass"))):
        status, result = told(bench, *unit, "--limit", str(limit))
        assert (status, result["statement"]) == expected
        assert result["passed"] is (status == 0)
    assert any(note.startswith("to pass: reduce u(Δg) to") for note in result["notes"])
    assert any(
        f"or agree on a limit of at least {int(np.ceil(1e6 * at))} µg" in note for note in result["notes"]
    )
    status, result = told(bench, *unit, "--limit", str(0.99 * at), "--rule", "simple")
    assert (status, result["false_acceptance"], result["guard_band"]) == (0, None, 1.0)
    status, result = told(bench, *unit, "--limit", str(0.99 * at), "--guard-band", "0.5")
    assert (status, result["rule"], result["guard_band"]) == (0, "non-binary", 0.5)
    # who names the rule, and no guard band, gets the one that it has always had
    assert told(bench, *unit, "--rule", "non-binary")[1]["guard_band"] == 1.0


@pytest.mark.slow
def test_readings_that_contradict_the_model_are_not_accepted(bench, unit):
    """Two channels exchanged in one installation: status 1, beside readings that agree too, and the diagnosis."""
    swapped = simulate(np.random.default_rng(2), 1e-4)
    first = swapped.installation == "1"
    swapped.signal[first] = swapped.signal[first][:, [1, 0, 2]]
    write_csv(swapped, Path("swapped.csv"))
    note = "note: not accepted: the readings contradict the model (p < 0.0001); 'bench diagnose swapped.csv'"
    out = printed(bench("calibrate", "unit.csv", "swapped.csv"), note, status=1)
    assert "robust" not in out
    assert bench("report", "swapped.csv")[0] == 1


def _whole():
    return stacked([read_csv(Path(name), ("1", "2", "V")) for name in ("unit.csv", "check.csv")])


def _exchanged_labels(rows):
    labels = {"1": "2", "2": "1", "V": "V"}
    return replace(rows, installation=np.array([labels[one] for one in rows.installation]))


def _exchanged_at_v(rows):
    at_v = rows.installation == "V"
    return replace(rows, signal=np.where(at_v[:, None], rows.signal[:, [1, 0, 2]], rows.signal))


def _copied(rows):
    signal, first = rows.signal.copy(), np.flatnonzero((rows.installation == "1") & (rows.pass_number == 1))
    signal[rows.installation == "V"] = signal[first[1:8:2]]
    return replace(rows, signal=signal)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "statement", "words"),
    [
        (lambda rows: rows, "pass", ""),
        (_exchanged_labels, "does not fit", "verification points are up to"),
        (
            lambda rows: replace(rows, angle_rad=-rows.angle_rad),
            "does not fit",
            "what the bench file states for V",
        ),
        (_copied, "does not fit", "and agree with installation 1; mount"),
        (_exchanged_at_v, "fail", "channels x, y exchanged"),
    ],
)
def test_verification_points_off_their_stated_orientation_verify_nothing(
    bench, unit, change, statement, words
):
    """All but the last keep |a| = 1 g at the points, which therefore pass by themselves."""
    rows = change(_whole())
    rows.signal[rows.installation == "V"] = np.round(rows.signal[rows.installation == "V"], 9)
    write_csv(rows, Path("whole.csv"))
    status, result = told(bench, "verify", "whole.csv", "--json", "-")
    assert (status, result["statement"]) == (int(bool(words)), statement)
    assert any("off the orientation" in note and words in note for note in result["notes"]) == bool(words)


@pytest.mark.slow
def test_another_unit_than_the_data_sheets_stands_beside_the_verdict(bench, unit):
    rows = _whole()
    write_csv(replace(rows, signal=1e3 * rows.signal, signal_sd=1e3 * rows.signal_sd), Path("whole.csv"))
    _, result = told(bench, "verify", "whole.csv", "--json", "-")
    assert any("perhaps the signals are in mV" in note for note in result["notes"])
    assert bench("report", "whole.csv")[0] == 0
    box = Path("report/whole.html").read_text("utf-8").partition('class="facts"')[0]
    assert "perhaps the signals are in mV" in box


@pytest.mark.slow
def test_a_verdict_rests_on_coefficients_that_are_accepted(bench, unit):
    """The points pass by a wide limit, but the coefficients of the same readings are not accepted."""
    curved = simulate(np.random.default_rng(2), 1e-4)
    curved.signal[:, 1] += 2e-3 * (curved.signal[:, 1] / K[1, 1]) ** 2
    write_csv(curved, Path("curved.csv"))
    points = Path("check.csv").read_text().splitlines()
    rows = Path("curved.csv").read_text().splitlines()
    assert points[0] == rows[0]
    Path("curved.csv").write_text("\n".join([*rows, *points[1:]]))
    status, result = told(bench, "verify", "curved.csv", "--limit", "0.01", "--json", "-")
    assert (status, result["passed"], result["statement"]) == (1, False, "does not fit")
    assert any("bench diagnose curved.csv" in note for note in result["notes"])
    # the file of these coefficients accepts no point of another day, either
    assert bench("calibrate", "curved.csv", "--json", "curved.json")[0] == 1
    status, result = told(bench, *unit, "--coefficients", "curved.json")
    assert (status, result["passed"], result["statement"]) == (1, False, "does not fit")
    assert "contradict the model: no point is accepted" in " ".join(result["notes"])
    # by coefficients of another day it is the points alone that count
    assert told(bench, "verify", "curved.csv", "--limit", "0.01", *unit[2:])[0] == 0


@pytest.mark.parametrize(
    ("written", "problem"),
    [
        ("rule: lenient", "rule"),
        ("rule: simple acceptance\n  guard_band: 0.5", "simple acceptance has no guard band"),
        ("rule: guarded\n  guard_band: 0", "guard_band"),
        ("population: {standard_deviation: 0 g}", "state a standard deviation above zero"),
    ],
)
def test_a_bench_file_with_a_rule_that_is_none(bench, unit, written, problem):
    file = edited_stand(**{"limit: 3e-4 g   # Δg_A": f"limit: 3e-4 g\n  {written}"})
    refused(bench(*unit, "--bench", file), problem)


@pytest.mark.slow
def test_run_verify_report_and_list_tell_one_verdict(bench):
    """Guarded by 3 U the run is not accepted, and says so everywhere; a what-if stays aside."""
    file = edited_stand(**{"limit: 3e-4 g   # Δg_A": "limit: 3e-4 g\n  rule: guarded\n  guard_band: 3"})
    run = ("run", "quick", "--dry-run", "--bench", file, "--name", "one", "--seed", "3")
    status, out, _ = bench(*run)
    own = json.loads(Path("runs/one/verify.json").read_text(encoding="utf-8"))
    assert (status, own["passed"], own["statement"]) == (1, False, "conditional pass")
    assert "one (SIMULATED): CONDITIONAL PASS, not accepted: worst" in out
    assert "rule: guarded (w = 3 U)" in out
    assert "at 4 of 4 verification points, |Δg| is within the limit by less than the guard band" in out
    assert told(bench, "verify", "one", "--json", "-") == (1, own)
    assert not Path("runs/one/what-if").exists()
    status, out, _ = bench("report", "one", "--json", "-")
    assert (status, json.loads(out)["verification"]) == (1, own)
    page = Path("runs/one/report.html").read_text(encoding="utf-8")
    assert "Verification: conditional pass, not accepted" in page
    assert "CONDITIONAL PASS" in bench("runs")[1]
    # by another rule it is a what-if, and the run's own stays
    status, out, _ = bench("report", "one", "--rule", "simple", "--json", "-")
    assert (status, json.loads(out)["verification"]["passed"]) == (0, True)
    assert json.loads(out)["report"] == "runs/one/what-if/report.html"
    assert Path("runs/one/report.html").read_text(encoding="utf-8") == page
    assert bench("verify", "one", "--rule", "simple")[0] == 0
    assert json.loads(Path("runs/one/verify.json").read_text(encoding="utf-8")) == own


@pytest.mark.slow
def test_a_run_is_judged_as_it_was_begun(bench):
    """What `run` is asked goes into the record, and is the run's own; another rule is a what-if."""
    run = "run quick --dry-run --name one --seed 3 --limit 4e-4 --rule guarded --guard-band 3"
    status, out, _ = bench(*run.split())
    own = json.loads(Path("runs/one/verify.json").read_text(encoding="utf-8"))
    assert (status, own["limit_g"], own["rule"], own["guard_band"]) == (1, 4e-4, "guarded", 3.0)
    assert "limit 400 µg\n" in out
    assert "rule: guarded (w = 3 U)" in out
    chosen = "the shipped one, because no file was named"
    assert own["bench"]["why"] == f"as the run recorded it; chosen at the start as {chosen}"
    shown = printed(bench("show", "one", "--verify"), "hashes complete", "verdict: conditional pass", chosen)
    assert re.search(r"^limit and rule of the run: .*guarded", shown, re.MULTILINE)
    assert told(bench, "verify", "one", "--json", "-") == (1, own)
    assert not Path("runs/one/what-if").exists()
    assert told(bench, "verify", "one", "--rule", "simple", "--json", "-")[1]["limit_g"] == 4e-4
    assert Path("runs/one/what-if/verify.json").exists()


def test_a_run_with_a_rule_that_is_none_is_not_begun(bench):
    for options in (("--rule", "kind"), ("--rule", "simple", "--guard-band", "0.5"), ("--limit", "0")):
        assert bench("run", "quick", "--dry-run", "--name", "one", *options)[0] == 2
        assert not Path("runs/one").exists()


@pytest.mark.slow
def test_a_budget_asks_by_the_rule_of_its_bench(bench):
    file = edited_stand(**{"limit: 3e-4 g   # Δg_A": "limit: 1 mg\n  rule: guarded\n  guard_band: 0.83"})
    status, out, _ = bench("budget", "--bench", file, "--trials", "0", "--json", "-")
    check = json.loads(out)["verification"]
    assert (status, check["rule"], check["guard_band"]) == (0, "guarded", 0.83)
    for point in check["points"]:
        assert point["accepted_up_to"] == pytest.approx(1e-3 - 0.83 * point["U"])
