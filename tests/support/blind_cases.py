"""Cases of the blind trial selected by what they hide, and made-up diagnoses of them."""

from typing import Any

from benchmarks.blind_trial.cases import Answer, Case, Row, make_case
from benchmarks.blind_trial.effects import CATALOGUE
from benchmarks.blind_trial.stand import Floats

SEED = 20261122
NOISE_V = 15e-6
CLOSES = {"before": 2.0, "after": 1.0, "before_rms": 4e-5, "after_rms": 3e-5}


def mistaken(name: str, wanted: str) -> tuple[Floats, Case, Answer]:
    """Return the first case of the mistake `name` whose place contains `wanted`: signal, case and answer."""
    for index in range(200):
        case, answer = make_case(SEED, Row(f"mistake:{name}"), index)
        if wanted in answer.place:
            return case.readings.signal, case, answer
    raise AssertionError(f"no {name} at {wanted}")


def single(name: str, design: str = "paper") -> tuple[Case, Answer]:
    turn = list(CATALOGUE).index(name)
    for index in range(turn, 20 * len(CATALOGUE), len(CATALOGUE)):
        case, answer = make_case(SEED, Row("single", design, 10), index)
        if answer.names == (name,) and len(answer.effects[0].channels) <= 1:
            return case, answer
    raise AssertionError(f"no {name}")


def said(verdict: str, *effects: tuple[str, list[str]], hidden: tuple[str, ...] = ()) -> dict[str, Any]:
    found = [{"name": name, "cannot_tell_from": others} for name, others in effects]
    return {"verdict": verdict, "effects": found, "hidden": list(hidden), "gap": dict(CLOSES)}
