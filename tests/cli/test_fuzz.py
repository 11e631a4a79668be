"""Unusual inputs (seed 20261122), and that the good inputs behind them are taken and the judges see."""

import json
from pathlib import Path

import pytest

from tests.support import fuzz, fuzz_inputs
from tests.support.campaigns import seeds
from tests.support.fuzz import called, own_folder, tried
from tests.support.fuzz_inputs import as_csv, as_yaml, readings, result, shipped

SEED = 20261122
QUICK = 3


@pytest.mark.slow
@pytest.mark.parametrize("seed", seeds(SEED))
@pytest.mark.parametrize("kind", fuzz.KINDS)
def test_a_few_inputs_of_each_kind_bring_sentences_alone(kind: str, seed: int, tmp_path: Path) -> None:
    for number in range(QUICK):
        with own_folder(tmp_path):
            assert tried(kind, seed, number) == []


@pytest.mark.slow
def test_the_inputs_are_made_of_good_ones(tmp_path: Path) -> None:
    good = {
        "r.csv": as_csv(readings()),
        "b.yaml": as_yaml(shipped("config")[0]),
        "p.yaml": as_yaml(shipped("procedures")[0]),
        "m.yaml": as_yaml(fuzz_inputs.MODEL),
        "c.json": json.dumps(result()).encode(),
    }
    with own_folder(tmp_path):
        for name, content in good.items():
            Path(name).write_bytes(content)
        for command in (
            ["calibrate", "r.csv", "--model", "m.yaml"],
            ["verify", "r.csv", "--coefficients", "c.json"],
            ["check", "p.yaml", "--bench", "b.yaml"],
        ):
            status, _, err = called(command)
            assert (status < 2, err) == (True, "")


def test_what_is_made_is_made_again_from_seed_and_number() -> None:
    for kind, make in fuzz.MAKERS.items():
        one, two = (make(fuzz.generator(kind, SEED, 7)) for _ in "ab")
        assert one == two


@pytest.mark.parametrize(
    ("out", "err", "status", "what"),
    [
        ("", "bench: unexpected KeyError: 'x'", 2, "unforeseen"),
        ("", "Traceback (most recent call last):", 2, "unforeseen"),
        ("a\x1b[2J", "", 0, "obeyed"),
        ("", "", 2, "silent"),
        ("", "bench: no", 3, "status"),
        ('{"covariance": [[1, 2], [2, 1]]}', "", 0, "result"),
        ('{"u": NaN}', "", 0, "result"),
    ],
)
def test_a_broken_promise_is_seen(out: str, err: str, status: int, what: str) -> None:
    case = fuzz_inputs.Case([["calibrate", "r.csv", "--json", "-"]])
    out = out or ("{}" if status == 0 else "")
    assert what in {kind for kind, _ in fuzz.judged(case, status, out, err, 0)}


def test_what_must_be_refused_and_is_not_is_seen() -> None:
    case = fuzz_inputs.Case([["check", "p.yaml"]], refuse="a key that stands twice")
    assert [what for what, _ in fuzz.judged(case, 0, "fine", "", 0)] == ["accepted"]
    assert [what for what, _ in fuzz.judged(case, 2, "", "bench: no", 0)] == []
