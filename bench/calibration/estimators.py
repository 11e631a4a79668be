"""The registry of estimators, which `calibrate`, `budget`, `require` and their help texts use.

To add an estimator, write a module in this folder with an `ESTIMATOR` and add its name to `MODULES`.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Final

from bench.calibration.gls import Estimator
from bench.calibration.result import CalibrationError

GLS: Final = "gls"
"""Name of the default estimator."""
CLOSED_FORM: Final = "closed-form"
ROBUST: Final = "robust"

MODULES: Final = ("gls", "closed_form", "linear", "outliers")
"""The modules that define an estimator, in the order of the help texts."""


def _of(module: str) -> Estimator:
    estimator: Estimator = import_module(f"bench.calibration.{module}").ESTIMATOR
    return estimator


ESTIMATORS: Final[Mapping[str, Estimator]] = {found.name: found for found in map(_of, MODULES)}


def find_estimator(asked: str) -> Estimator:
    """Return the estimator with this name or alias. Raises `CalibrationError` for an unknown name."""
    for estimator in ESTIMATORS.values():
        if asked in {estimator.name, *estimator.also}:
            return estimator
    raise CalibrationError(f"no estimator {asked!r}; choose from {', '.join(ESTIMATORS)}")


def in_a_budget(asked: str) -> Estimator:
    """Return the estimator that a budget uses in place of the one `asked` for.

    Raises `CalibrationError` for an unknown name.
    """
    estimator = find_estimator(asked)
    return ESTIMATORS[estimator.counts_as or estimator.name]


def estimators_in_words(*, budget: bool = False) -> str:
    """Return a help text that lists the estimators; `budget` adds, for each, the one that a budget uses instead."""
    phrases = [f"{' or '.join((e.name, *e.also))} ({e.phrase})" for e in ESTIMATORS.values()]
    text = f"{', '.join(phrases[:-1])}, or {phrases[-1]}"
    counted = [f"{e.name} counts as {e.counts_as}" for e in ESTIMATORS.values() if e.counts_as]
    return f"{text}; without outliers, {', '.join(counted)}." if budget and counted else f"{text}."
