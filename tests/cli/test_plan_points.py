"""`bench plan-points`: the file that it writes, what it prints, what it refuses."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from bench.config.bench_file.file import load_bench
from bench.config.procedure.check import check as check_against
from bench.config.procedure.load import load_procedure
from bench.config.shipped import find_bench
from bench.planning.settings import fitted, settings_of, verifying


@pytest.mark.slow
@pytest.mark.parametrize("stand", ["paper-stand", "bench-motorised", "bench-rate-table"])
def test_the_file_that_is_written_is_a_procedure_of_the_bench(bench, stand):
    out = Path("short.yaml")
    status, text, err = bench(
        "plan-points",
        "--bench",
        stand,
        "--u",
        "all=1e-4",
        "--out",
        out,
        "--angles",
        12,
        "--json",
        "plan.json",
    )
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
    assert bench("check", out, "--bench", stand)[0] == 0
    assert all(goal["u"] <= goal["asked_u"] * (1 + 1e-9) for goal in found["goals"])
    before = out.read_bytes()
    status, _, err = bench("plan-points", "--bench", stand, "--u", "all=1e-4", "--out", out)
    assert status == 2
    assert "exists and is not overwritten" in err
    assert out.read_bytes() == before


@pytest.mark.slow
def test_a_run_of_the_plan_signs_what_it_promised(bench):
    """About 20 degrees of freedom tell the noise, and most of u is what no reading shows: within 20 %, seed 3."""
    asked = ("--u", "all=1e-4", "--angles", 12, "--bench", "paper-stand")
    assert bench("plan-points", *asked, "--out", "plan.yaml", "--json", "plan.json")[0] == 0
    assert (
        bench("run", "plan.yaml", "--dry-run", "--seed", 3, "--name", "made", "--bench", "paper-stand")[0]
        == 0
    )
    assert bench("calibrate", "made", "--json", "made.json")[0] == 0
    plan, found = (json.loads(Path(f"{name}.json").read_text(encoding="utf-8")) for name in ("plan", "made"))
    signed = [found["coefficients"][name]["u"] for name in found["order"]]
    np.testing.assert_allclose(np.sqrt(np.diag(plan["covariance"])), signed, rtol=0.2)


@pytest.mark.slow
def test_a_time_that_is_too_short_for_the_goal_is_said(bench):
    status, out, _ = bench("plan-points", "--time", "3.5 h", "--delta-g", "4.8e-5")
    assert status == 1
    assert "NOT REACHED in 3.5 h: Δg at verification point" in out
    status, out, _ = bench("plan-points", "--time", "3.5 h", "--json", "-")
    found = json.loads(out)
    assert status == 0
    assert found["time_s"] <= 3.5 * 3600
    assert found["reached"] is None
    assert found["lack_of_fit_tested"] is False
    assert "too few repeats" in bench("plan-points", "--time", "3.5 h")[1]


def test_the_third_mounting_angle_wants_a_further_installation(bench):
    """It counts as large as the mounting error: 1 and 2 leave Kyz to it, and 1T90 is among what may be chosen."""
    asked = ("plan-points", "--bench", "paper-stand", "--u", "Kyz=2e-4")
    status, _, err = bench(*asked, "--installations", "1,2")
    assert status == 2
    assert "cannot be reached by any number of settings" in err
    assert "most of it for Kyz: mounting roll 311 µV/g" in err
    status, out, _ = bench(*asked, "--angles", 8, "--json", "-")
    assert status == 0
    assert set(json.loads(out)["mountings"]) & {"1T90", "2T90"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "say what is to be reached"),
        (("--u", "Kyx"), "--u Kyx: a name and its value, such as Kyx=20e-6"),
        (("--u", "Kyx=2 kg"), "--u 2 kg: expected a scale factor"),
        (("--u", "Kyx=-1e-6"), "is a positive number, not -1e-06"),
        (("--u", "Kq=1e-6"), "no coefficient 'Kq'"),
        (("--time", "soon"), "--time soon: expected a duration"),
        (("--time", "1 h"), "1 h are too short for a calibration: the shortest takes"),
        (("--u", "all=1e-4", "--installations", "1"), "no choice of these installations determines"),
        (("--u", "all=1e-4", "--installations", "1,9"), "has no installation 9 for a calibration"),
        (("--u", "all=1e-4", "--angles", "2"), "--angles 2: between 3 and 72"),
        (("--u", "all=1e-4", "--least", "effort"), "--least is time or settings"),
        (("--u", "all=1e-4", "--up-to", "5"), "--up-to belongs to --modulus"),
        (("--u", "all=1e-4", "--out", "nowhere/p.yaml"), "there is no such folder"),
        (("--u", "all=1e-5"), "cannot be reached by any number of settings"),
        (
            ("--u", "all=9e-5", "--most-settings", "12"),
            "not reached with 12 settings, though installations 1, 2",
        ),
        (("--u", "all=1e-4", "--cost-setting", "0 s"), "--cost-setting: a setting takes some time"),
    ],
)
def test_what_cannot_be_planned_is_said_in_a_sentence(bench, arguments, words):
    status, out, err = bench("plan-points", *arguments)
    assert (status, out) == (2, "")
    assert words in err
    assert "Traceback" not in err
    assert err.count("\n") == 1


def test_goals_have_units_in_the_table(bench):
    status, out, _ = bench(
        "plan-points", "--u", "U0x=60 uV", "--modulus", "1e-3", "--up-to", "5", "--no-verify", "--angles", 8
    )
    assert status == 0
    lines = [line.split() for line in out.splitlines()]
    (bias,) = (line for line in lines if line[:1] == ["U0x"])
    assert bias[1] == "60"
    assert bias[-1] == "µV"
    assert float(bias[2]) <= 60
    assert any(line[:4] == ["|a|", "at", "5", "g"] and line[-1] == "µg" for line in lines)
