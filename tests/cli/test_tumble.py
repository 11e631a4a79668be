"""bench tumble: a run of many points in a turn in the words of IEEE Std 1293."""

import json
from pathlib import Path

import numpy as np
import pytest

from bench.readings.csv import write_csv
from tests.support.schemas import keeps_to
from tests.support.tumble_bench import Terms, tumble

SEED = 8
TERMS = Terms(K2=np.array([200e-6, 0.0, 0.0]))


@pytest.fixture
def readings(empty_folder):
    for points in (8, 12):
        write_csv(tumble(np.random.default_rng(SEED), 1e-4, TERMS, points=points), Path(f"turn-{points}.csv"))


def test_a_square_is_found_and_what_is_not_separable_is_said(bench, readings):
    status, out, err = bench("tumble", "turn-8.csv", "--json", "r.json")
    assert (status, err) == (0, "")
    assert out.splitlines()[0].startswith("bench file: paper-stand")
    result = json.loads(Path("r.json").read_text(encoding="utf-8"))
    keeps_to("tumble", result)
    assert result == json.loads(Path("tumble/turn-8.json").read_text(encoding="utf-8"))
    square = result["axes"]["x"]["quantities"]["K2"]
    assert abs(square["value"] - 200e-6) < 4 * square["u"] < 100e-6
    assert [axis["rank"] for axis in result["axes"].values()] == [6, 6, 6]
    assert out.count("Koq cannot be separated") == 3
    assert "x  K3 + 0.586 Koq" in out


def test_twelve_points_separate_and_say_how_little(bench, readings):
    out = bench("tumble", "turn-12.csv", "--strict")[1]
    assert out.count("7 of 7 terms are determined") == 3
    assert out.count("hang together (r = -0.99") == 3
    assert "taken as zero in channel x: 1 µg/g² of Kpp moves K0 by +0.50" in out
    assert "u, readings" in out


def test_terms_that_are_left_out_show_as_lack_of_fit(bench, readings):
    status, out, _ = bench("tumble", "turn-12.csv", "--terms", "K3,Koq", "--strict")
    assert status == 1
    # a prior of K2 is in the uncertainty, one of Kpp is not
    assert "not fitted, but in u, in channel x: 1 µg/g² of K2 moves" in out
    assert "taken as zero in channel x: 1 µg/g² of Kpp moves" in out


def test_a_mistake_is_one_line(bench, readings):
    status, _, err = bench("tumble", "turn-12.csv", "--terms", "K2,K9")
    assert (status, err.count("\n")) == (2, 1)
    assert "terms K9: each once, of K2, K3, Koq" in err
