"""`bench learn` from runs to the file, and what a calibration makes of it."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

import bench as program
from bench.readings.csv import write_csv
from tests.support.learning_bench import Bench, simulate
from tests.support.paper_bench import ARCSEC
from tests.support.schemas import keeps_to

SHIPPED = Path(__file__).parents[2] / "config" / "paper-stand.yaml"
TRUTH = Bench(
    np.array([1.0, -1.2, 40.0, 0.0]) * ARCSEC, np.array([0.8, 0.8, 4.0, 4.0]) * ARCSEC,
    np.array([5e-5, 7e-5, 6e-5]), 2.5 * ARCSEC,
)  # fmt: skip


@pytest.fixture
def runs(empty_folder):
    """Five readings files of one bench, seed 21; the fourth has K2 of its own."""
    tables = simulate(np.random.default_rng(21), TRUTH, 6, K2={3: 4e-4}).tables()
    for number, table in enumerate(tables, start=1):
        write_csv(table, Path(f"r{number}.csv"))
    text = SHIPPED.read_text(encoding="utf-8")
    Path("mine.yaml").write_text(f"learned: learned.yaml\n{text}", encoding="utf-8")
    Path("plain.yaml").write_text(text, encoding="utf-8")
    return [f"r{number}.csv" for number in range(1, 6)]


def learn(bench, runs, *options):
    return bench("learn", *runs, "--bench", "plain.yaml", *options)


def test_from_runs_to_a_smaller_honest_u(bench, runs):
    status, out, err = learn(bench, runs, "--json", "learn.json")
    assert status == 0, err
    assert out.index("r4.csv contradicts the others") < out.index("axis_tilt.mean")
    result = json.loads(Path("learn.json").read_text(encoding="utf-8"))
    keeps_to("learn", result)
    assert [one["run"] for one in result["contradicting"]] == ["r4.csv"]
    assert abs(result["sizes"]["mounting_error.mean"]["value"] - 40.0) < 4 * 4.0
    written = yaml.safe_load(Path("learned.yaml").read_text(encoding="utf-8"))
    assert [run["name"] for run in written["runs"]] == ["r1.csv", "r2.csv", "r3.csv", "r5.csv"]
    before = program.calibrate("r6.csv", bench="plain.yaml")
    after = program.calibrate("r6.csv", bench="mine.yaml")
    assert any("stands in place of the stated limits" in note for note in after.notes)
    told = after.to_dict()["stand"]
    assert told["alpha3[1]"]["value"] == pytest.approx(40.0, abs=4 * 4.5)
    assert after.coefficients["Kyx"].u_readings < before.coefficients["Kyx"].u_readings


def test_a_run_behind_the_file_never_uses_it_wherever_it_lies(bench, runs):
    learn(bench, runs)
    Path("elsewhere.csv").write_bytes(Path("r2.csv").read_bytes())
    plain = program.calibrate("r2.csv", bench="plain.yaml").to_dict()
    for name in ("r2.csv", "elsewhere.csv"):
        own = program.calibrate(name, bench="mine.yaml")
        assert any("is not used: these readings are among them" in note for note in own.notes)
        assert own.to_dict()["coefficients"] == plain["coefficients"]
    # the one that contradicted is not behind it
    other = program.calibrate("r4.csv", bench="mine.yaml")
    assert not any("is not used" in note for note in other.notes)


def test_what_the_file_is_not_for_is_refused_or_told(bench, runs):
    learn(bench, runs)
    status, _, err = learn(bench, runs)
    assert status == 2
    assert "is not overwritten" in err
    text = Path("mine.yaml").read_text(encoding="utf-8")
    Path("other.yaml").write_text(text.replace("limit: 90 arcsec", "limit: 60 arcsec"), encoding="utf-8")
    status, _, err = bench("calibrate", "r6.csv", "--bench", "other.yaml")
    assert status == 2
    assert "learned of bench paper-stand with another stand" in err
    learned = Path("learned.yaml").read_text(encoding="utf-8")
    expires = yaml.safe_load(learned)["expires"]
    Path("learned.yaml").write_text(
        learned.replace(f"expires: '{expires}'", "expires: '2020-01-01'"), encoding="utf-8"
    )
    old = program.calibrate("r6.csv", bench="mine.yaml")
    assert any("it expired on 2020-01-01" in note for note in old.notes)
    assert (
        old.to_dict()["coefficients"]
        == program.calibrate("r6.csv", bench="plain.yaml").to_dict()["coefficients"]
    )


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--expires", "soon"], "expected a date"),
        (["--expires", "2020-01-01"], "is past"),
    ],
)
def test_mistakes_are_one_sentence(bench, runs, options, told):
    status, _, err = learn(bench, runs[:2], *options)
    assert status == 2
    assert told in err
    assert "Traceback" not in err
    status, _, err = learn(bench, [runs[0], runs[0]])
    assert status == 2
