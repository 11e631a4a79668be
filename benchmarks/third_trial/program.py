"""The only module of the third trial that calls the program, for diagnoses and for predictions of its models."""

import tempfile
import time
from functools import cache
from pathlib import Path
from typing import Any, Final
from unittest import mock

import numpy as np

import bench
from bench.config.model_file import load_model
from bench.model import ForwardModel
from bench.model.geometry import COEFFICIENTS, Block
from benchmarks.third_trial.cases import Case
from benchmarks.third_trial.forms import NAMES, ROUGHLY, left_by, signature
from benchmarks.third_trial.stand import DAYS, U0, Floats, Form, K, day, left, read, rho, table, volts

FREQUENCIES: Final = (0.375, 0.125, 0.5)
"""Frequencies in the trial, in the order of the program's `KIND_PRIOR`: half of the effects have no name."""
TRUE: Final = dict(zip(COEFFICIENTS, [*K.ravel(), *U0], strict=True))


def diagnosed(case: Case, *, new_day: bool = False) -> dict[str, Any]:
    """Return the program's diagnosis of a case and its marks, as a line of JSON.

    With `new_day`, the readings of another day are calibrated without and with the model that was found.
    """
    record: dict[str, Any] = {
        "group": case.group, "number": case.number, "seed": case.seed, "name": case.name, "day": case.day,
        "rho": round(case.rho, 2), "noise": case.noise, "right": case.words, "names": [], "ties": [],
    }  # fmt: skip
    begun = time.process_time()
    try:
        result = bench.diagnose(table(day(case.day), case.signal))
        found, text = result.to_dict(), repr(result)
    except (ValueError, RuntimeError, ArithmeticError, LookupError, AttributeError) as error:
        return record | {"verdict": "error", "headline": f"{type(error).__name__}: {error}"}
    effects = found["effects"]
    record |= {
        "cpu": round(time.process_time() - begun, 2), "verdict": found["verdict"], "headline": headline(text),
        "names": [one["name"] for one in effects], "ties": [one["cannot_tell_from"] for one in effects],
        "found_rho": [one.get("rho") for one in effects], "odds": _odds(effects),
        "gap": {key: (found["gap"] or {}).get(key) for key in ("before", "after", "shrinks")},
        "kinds": [one["what"] for one in (found["noise"] or {}).get("kinds", [])],
        "words": [one["words"] for one in effects],
    }  # fmt: skip
    if found["coefficients"]:
        rows = {name: found["coefficients"][name] for name in COEFFICIENTS}
        record["off"] = {
            when: [round((row[when] - TRUE[name]) / row[f"u_{when}"], 2) for name, row in rows.items()]
            for when in ("before", "after")
        }
    if case.form is None or not isinstance(result, bench.DiagnosisResult):
        return record | ({"text": text} if case.group == "far" else {})
    seen = left(signature(case.form, case.day), case.day)
    # a larger family that contains the true effect is no rival, because the smaller family is named
    larger = {
        case.name,
        "head_graduation",
        "cross_quadratic" if case.name == "quadratic_nonlinearity" else "",
    }
    rivals = {name: left_by([name], seen, case.day) for name in NAMES if name not in larger}
    record["rival"] = [nearest := min(rivals, key=lambda name: rivals[name]), round(rivals[nearest], 2)]
    known = [name for name in record["names"] if name in NAMES and name not in ROUGHLY]
    record["leaves"] = {name: round(left_by([name], seen, case.day), 2) for name in known}
    record["left"] = round(left_by(known, seen, case.day), 2) if known else None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.yaml"
        try:
            result.write_model(path, accept_first=True)
        except bench.Refused:
            return record
        other = (case.day + 1) % DAYS
        if not case.form.scatter:
            record["closed"] = round(closed(case.form, path, other), 3)
        if new_day:
            record["new_day"] = _calibrated(case, case.form, path, other)
    return record


def diagnosed_with_its_frequencies(case: Case) -> dict[str, Any]:
    """Return the program's diagnosis of a case if its prior of named and unnamed effects is that of the trial."""
    with (
        mock.patch("bench.diagnosis.candidates.KIND_PRIOR", FREQUENCIES),
        mock.patch("bench.diagnosis.evidence.KIND_PRIOR", FREQUENCIES),  # in the key of cached thresholds
    ):
        return diagnosed(case)


def headline(text: str) -> str:
    """Return the sentence in which a diagnosis sums up its result."""
    lines = text.splitlines()
    return [*(line for line in reversed(lines) if line.startswith("DataFrame")), lines[0]][0]


@cache
def _conditions(number: int) -> Any:
    installations = bench.load_bench("paper-stand").installation_models()
    return installations, bench.read_readings(table(day(number), volts(day(number)))).conditions()


def predicted(path: Path, number: int) -> Floats:
    """Return the effect of a model file on the readings of a day, (n, 3), V."""
    installations, conditions = _conditions(number)
    given = Block(K, U0), conditions, np.zeros((len(conditions.mounts), 5))
    effects = load_model(path).applied_effects()
    return ForwardModel(installations, effects).readings(*given) - ForwardModel(installations).readings(
        *given
    )


def closed(form: Form, path: Path, number: int) -> float:
    """Return the expected fraction of the gap on another day that the model closes (the true form: 1)."""
    true = signature(form, number)
    return 1.0 - (rho(true - predicted(path, number), number) / rho(true, number)) ** 2


def _calibrated(case: Case, form: Form, path: Path, number: int) -> dict[str, list[float]]:
    """Return the errors of the coefficients on another day without and with the model, in units of u without it."""
    rng = np.random.default_rng([case.seed, 7, case.number])
    frame = table(day(number), read(day(number), "normal", rng, [form]))
    both = {"before": bench.calibrate(frame), "after": bench.calibrate(frame, model=path)}
    u = {name: both["before"].coefficients[name].u for name in COEFFICIENTS}
    return {
        when: [round((one.coefficients[name].value - TRUE[name]) / u[name], 2) for name in COEFFICIENTS]
        for when, one in both.items()
    }


def _odds(effects: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the stated probabilities of the names, if a single effect was found."""
    odds = effects[0].get("odds", []) if len(effects) == 1 else []
    return [{"names": [one["name"]], "probability": one["probability"]} for one in odds]
