"""`bench learn` from runs to the file, and what a calibration makes of it; voltmeters that were exchanged."""

import contextlib
import io
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

import bench as program
from bench.cli.app import main
from bench.readings.csv import write_csv
from bench.validation.paper_bench import ARCSEC
from tests.support.commands import printed, refused
from tests.support.exchanged_meters import GAIN, bench_text, leave, of_one_block, today
from tests.support.learning_bench import Bench, simulate
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


@pytest.mark.slow
def test_from_runs_to_a_smaller_honest_u(bench, runs):
    out = printed(learn(bench, runs, "--json", "learn.json"))
    assert out.index("r4.csv contradicts the others") < out.index("axis_tilt.mean")
    result = json.loads(Path("learn.json").read_text(encoding="utf-8"))
    keeps_to("learn", result)
    assert [one["run"] for one in result["contradicting"]] == ["r4.csv"]
    assert abs(result["sizes"]["mounting_error.mean"]["value"] - 40.0) < 4 * 4.0
    written = yaml.safe_load(Path("learned.yaml").read_text(encoding="utf-8"))
    assert [run["name"] for run in written["runs"]] == ["r1.csv", "r2.csv", "r3.csv", "r5.csv"]
    before = program.calibrate("r6.csv", bench="plain.yaml")
    after = program.calibrate("r6.csv", bench="mine.yaml")
    assert any("replaces the stated limits" in note for note in after.notes)
    told = after.to_dict()["stand"]
    assert told["alpha3[1]"]["value"] == pytest.approx(40.0, abs=4 * 4.5)
    assert after.coefficients["Kyx"].u_readings < before.coefficients["Kyx"].u_readings


@pytest.mark.slow
def test_runs_that_calibrate_does_not_accept_are_named(empty_folder):
    """Seed 22: four waves per turn of 1 mV in each of three runs, so that none contradicts the others."""
    tables = simulate(np.random.default_rng(22), TRUTH, 3).tables()
    for number, table in enumerate(tables, start=1):
        write_csv(table, Path(f"good-{number}.csv"))
        wave = 1e-3 * np.cos(4.0 * table.angle_rad)[:, None]
        write_csv(replace(table, signal=table.signal + wave), Path(f"poor-{number}.csv"))
    poor, good = (
        program.learn([f"{kind}-{k}.csv" for k in (1, 2, 3)], bench="paper-stand")
        for kind in ("poor", "good")
    )
    assert poor.notes[-1].startswith(
        "poor-1.csv, poor-2.csv and poor-3.csv: 'bench calibrate' does not accept"
    )
    assert not any("does not accept" in note for note in good.notes)


@pytest.mark.slow
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


@pytest.mark.slow
def test_what_the_file_is_not_for_is_refused_or_told(bench, runs):
    learn(bench, runs)
    refused(learn(bench, runs), "is not overwritten")
    text = Path("mine.yaml").read_text(encoding="utf-8")
    Path("other.yaml").write_text(text.replace("limit: 90 arcsec", "limit: 60 arcsec"), encoding="utf-8")
    refused(
        bench("calibrate", "r6.csv", "--bench", "other.yaml"),
        "learned of bench paper-stand with another stand",
    )
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
        (["--expires", "2020-01-01"], "is not after"),
    ],
)
def test_mistakes_are_one_sentence(bench, runs, options, told):
    refused(learn(bench, runs[:2], *options), told)
    refused(learn(bench, [runs[0], runs[0]]))


TRUE = GAIN["23"] - GAIN["22"]


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory):
    """Seed 31: three runs of one block with each meter on each channel, a fourth one with the learned file.

    Its folder, what the command printed, and the true coefficients.
    """
    folder = tmp_path_factory.mktemp("exchanged")
    printed = io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(printed):
        made = of_one_block(np.random.default_rng(31), 4)
        orders = ("xyz", "yzx", "zxy")
        names = [leave(f"r{k}", made.tables()[k - 1], order, today()) for k, order in enumerate(orders, 1)]
        leave("r4", made.tables()[3], "xyz", today(), bench_text("xyz", "learned.yaml"))
        with pytest.raises(SystemExit) as ended:
            main(["learn", *names, "--json", "learn.json"])
    assert not ended.value.code
    return folder, printed.getvalue(), made.truths[0]


@pytest.fixture
def learned(laboratory, empty_folder):
    """The files of that laboratory in a folder of their own, what was printed, and the truth."""
    folder, printed, truth = laboratory
    shutil.copytree(folder, ".", dirs_exist_ok=True)
    for beside in Path().glob("*.csv.json"):
        told = beside.read_text(encoding="utf-8").replace(str(folder), str(Path.cwd()))
        beside.write_text(told, encoding="utf-8")
    return printed, truth


def test_differences_are_told_with_u_and_who_they_are_of(learned):
    out, _ = learned
    assert "voltmeter 1: HEWLETT-PACKARD 34401A 0 11-5-2 at GPIB0::22::INSTR of paper-stand" in " ".join(
        out.split()
    )
    result = json.loads(Path("learn.json").read_text(encoding="utf-8"))
    keeps_to("learn", result)
    meters = [name.split("GPIB0::")[1][:2] for name in result["meters"]["meters"]]
    for b in (1, 2):
        size = result["sizes"][f"voltmeter_gain[{b + 1}-1]"]
        true = (GAIN[meters[b]] - GAIN[meters[0]]) * 1e6
        assert abs(size["value"] - true) < 4 * size["u"]
        assert size["u"] < 10.0
        assert size["dof"] > 2
    assert result["meters"]["runs"] == ["r1.csv", "r2.csv", "r3.csv"]
    assert any("absolute gain" in words for words in result["not_identified"])
    assert not any("differences between" in words for words in result["not_identified"])


def test_a_calibration_takes_them_for_what_channels_have_between_them(learned):
    """The ratio of two scale factors gets truer and surer; each by itself is as sure as the limits are."""
    plain = Path("plain.yaml")
    plain.write_text(bench_text("xyz"), encoding="utf-8")
    before, after = program.calibrate("r4.csv", bench="plain.yaml"), program.calibrate("r4.csv")
    assert any(
        "readings corrected by the differences learned from exchanged voltmeters" in n for n in after.notes
    )
    # logarithm of Kxx over Kyy
    slope = np.zeros(12)
    K = after.calibration.block.K
    slope[[0, 4]] = 1 / K[0, 0], -1 / K[1, 1]
    truth = np.log(learned[1][0] / learned[1][4])
    sizes = [float(np.sqrt(slope @ one.covariance @ slope)) for one in (before, after)]
    assert sizes[1] < 0.9 * sizes[0]  # what is left is the priors of K3
    z = (np.log(K[0, 0] / K[1, 1]) - truth) / sizes[1]
    assert abs(z) < 3.5
    gains = [
        next(s for s in one.calibration.sources if s.name == "voltmeter_gain") for one in (before, after)
    ]
    of_gains = [float(np.sqrt(slope @ one.covariance @ slope)) for one in gains]
    assert of_gains[1] < 0.5 * of_gains[0]
    np.testing.assert_allclose(
        np.diag(gains[1].covariance)[[0, 4, 8]], np.diag(gains[0].covariance)[[0, 4, 8]], rtol=1e-3
    )
    assert "differences learned from exchanged voltmeters" in gains[1].origin
    assert after.source.meters != before.source.meters  # their errors cancel no longer between the two


def test_whoever_read_must_be_known_and_a_run_behind_the_file_takes_nothing(learned):
    """With a bench file in place of the recorded one the record still says which meter read which channel."""
    Path("mine.yaml").write_text(bench_text("xyz", "learned.yaml"), encoding="utf-8")
    asked, own = program.calibrate("r4.csv", bench="mine.yaml"), program.calibrate("r4.csv")
    np.testing.assert_array_equal(asked.covariance, own.covariance)
    Path("r4.csv.json").unlink()
    unknown = program.calibrate("r4.csv", bench="mine.yaml")
    assert any("do not name their voltmeters: not used" in note for note in unknown.notes)
    behind = program.calibrate("r1.csv", bench="mine.yaml")
    assert any("is not used: these readings are among them" in note for note in behind.notes)
    assert behind.source.known_meters is None


def test_after_ninety_days_nothing_is_left_of_them(learned):
    file = yaml.safe_load(Path("learned.yaml").read_text(encoding="utf-8"))
    file["meters"]["day"] = today(-100).date().isoformat()
    Path("learned.yaml").write_text(yaml.safe_dump(file), encoding="utf-8")
    old = program.calibrate("r4.csv")
    assert old.source.known_meters is None
    assert any("in 90 days voltmeters may drift through their limits" in note for note in old.notes)


def test_learning_anew_is_not_from_what_was_learned(learned, bench):
    """A run whose bench file names the file counts as certificates have it: its differences are not taken twice."""
    status, _, err = bench("learn", "r4.csv", "r2.csv", "r3.csv", "--out", "anew.yaml", "--json", "anew.json")
    assert status == 0, err
    sizes = json.loads(Path("anew.json").read_text(encoding="utf-8"))["sizes"]
    assert abs(sizes["voltmeter_gain[2-1]"]["value"] - TRUE * 1e6) < 4 * sizes["voltmeter_gain[2-1]"]["u"]


@pytest.mark.slow
def test_too_few_runs_say_by_what_the_voltmeters_are_known(bench, empty_folder):
    """Two runs of one block, seed 31: no serial number stands in their records."""
    made = of_one_block(np.random.default_rng(31), 2)
    names = [
        leave(f"r{k}", table, order, today())
        for k, (table, order) in enumerate(zip(made.tables(), ("xyz", "yzx"), strict=True))
    ]
    out = printed(bench("learn", *names))
    words = " ".join(out.split())
    assert "too few runs with exchanged voltmeters" in words
    assert "no record has their serial numbers, so each address counts as another voltmeter" in words
