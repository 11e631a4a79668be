"""Learned files: what is written is read back, what does not hold together or is of another stand is refused."""

import datetime
from pathlib import Path

import numpy as np
import pytest
import yaml

from bench.base.arrays import ARCSEC
from bench.base.yaml_files import FileMistakes
from bench.config.bench_file.file import load_bench
from bench.config.bench_file.learned import arcsec, learned_for, load_learned, write_learned

SHIPPED = Path(__file__).parents[3] / "config" / "paper-stand.yaml"
BENCH = load_bench(SHIPPED)
SIZE = {"size": 5e-5, "dof": 40.0}
CONTENT = {
    "bench": BENCH.name,
    "learned_for": learned_for(BENCH),
    "made": "2024-05-01",
    "expires": "2024-11-01",
    "simulated": True,
    "runs": [{"name": "day-1", "head": "abc", "readings": "111"}, {"name": "r2.csv", "readings": "222"}],
    "stand": {
        "means": [
            {"angle": "axis_tilt", "value": arcsec(-0.7 * ARCSEC), "u": arcsec(0.2 * ARCSEC)},
            {"angle": "mounting_error", "value": arcsec(12 * ARCSEC), "u": arcsec(3 * ARCSEC)},
        ],
        "covariance_rad2": [[1e-12, 2e-13], [2e-13, 2e-10]],
        "remount": {"axis_tilt": arcsec(0.5 * ARCSEC), "mounting_error": arcsec(4 * ARCSEC)},
    },
    "noise": {
        "unit": "V", "x": {**SIZE}, "y": {**SIZE}, "z": {**SIZE},
        "setting": {"size": arcsec(2 * ARCSEC), "dof": 12.0},
    },
}  # fmt: skip


@pytest.fixture
def path(tmp_path):
    return tmp_path / "learned.yaml"


def changed(path, **parts):
    path.write_text(yaml.safe_dump({"learned_file": 1, **CONTENT, **parts}), encoding="utf-8")
    return path


def test_what_is_written_is_read_back(path):
    write_learned(path, CONTENT, ())
    file = load_learned(path, BENCH)
    assert [mean.angle for mean in file.stand.means] == ["axis_tilt", "mounting_error"]
    np.testing.assert_allclose([mean.value for mean in file.stand.means], [-0.7 * ARCSEC, 12 * ARCSEC])
    np.testing.assert_array_equal(file.stand.covariance, CONTENT["stand"]["covariance_rad2"])
    assert file.noise.setting.size == pytest.approx(2 * ARCSEC)
    assert file.simulated
    assert not file.applied_effects()


def test_it_knows_the_runs_behind_it_by_head_and_by_readings(path):
    write_learned(path, CONTENT, ())
    file = load_learned(path, BENCH)
    assert file.has("abc", ["999"])
    assert file.has("", ["999", "222"])
    assert not file.has("", ["999"])  # a run without a head is not every run without one
    assert not file.has("abd", [])


def test_it_holds_to_the_end_of_its_last_day(path):
    write_learned(path, CONTENT, ())
    file = load_learned(path, BENCH)
    assert not file.expired(datetime.date(2024, 11, 1))
    assert file.expired(datetime.date(2024, 11, 2))


@pytest.mark.parametrize(
    ("part", "told"),
    [
        ({"covariance_rad2": [[1e-12, 2e-13]]}, "is not symmetric, 2 by 2"),
        ({"covariance_rad2": [[1e-12, 0.0], [2e-13, 2e-10]]}, "is not symmetric, 2 by 2, for 2 means"),
        ({"covariance_rad2": [[1e-12, 1e-10], [1e-10, 2e-10]]}, "is not a covariance"),
        ({"remount": {"axis_tilt": "1 arcsec"}}, "remount lacks mounting_error"),
    ],
)
def test_angles_that_do_not_hold_together_are_refused(path, part, told):
    with pytest.raises(FileMistakes, match=told):
        load_learned(changed(path, stand={**CONTENT["stand"], **part}), BENCH)


def test_of_another_stand_it_is_refused(path, tmp_path):
    other = tmp_path / "other.yaml"
    text = SHIPPED.read_text(encoding="utf-8")
    other.write_text(text.replace("limit: 90 arcsec", "limit: 60 arcsec"), encoding="utf-8")
    write_learned(path, CONTENT, ())
    with pytest.raises(FileMistakes, match="with another stand, head, installations or meters"):
        load_learned(path, load_bench(other))


def test_noise_of_no_size_is_a_mistake(path):
    with pytest.raises(FileMistakes, match="noise"):
        load_learned(changed(path, noise={**CONTENT["noise"], "x": {"size": 0.0, "dof": 40.0}}), BENCH)
