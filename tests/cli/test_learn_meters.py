"""Differences of voltmeters from runs of one block with them exchanged, to the calibrations that take them."""

import contextlib
import io
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

import bench as program
from bench.cli.app import main
from tests.support.exchanged_meters import GAIN, bench_text, leave, of_one_block, today
from tests.support.schemas import keeps_to

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
    assert any("not who read here: it does not count" in note for note in unknown.notes)
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
    status, out, err = bench("learn", *names)
    assert status == 0, err
    words = " ".join(out.split())
    assert "the runs with voltmeters exchanged are too few" in words
    assert (
        "no record has their serial numbers, so that a voltmeter at another address passes for another"
        in words
    )
