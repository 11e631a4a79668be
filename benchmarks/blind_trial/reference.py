"""The true coefficients of a case at the temperature from which a model counts."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from benchmarks.blind_trial.cases import Row, hidden_in
from benchmarks.blind_trial.designs import REFERENCE_TEMPERATURE_C
from benchmarks.blind_trial.geometry import Floats
from benchmarks.blind_trial.signals import U0, K

MODEL_COUNTS_FROM_C: Final = 20.0
"""Where an effect of temperature of the application is nothing."""


def coefficients_at(temperature_c: float, seed: int, row: Row, index: int) -> Floats:
    """Return K row by row and U0, shape (12,), V/g and V, as they are at a temperature.

    The trial's effects of temperature are nothing at `REFERENCE_TEMPERATURE_C`. What they do at another one, from
    which a model counts, is a part of its coefficients.
    """
    run, truths = hidden_in(seed, row, index)
    weather = replace(run.weather, start=run.weather.start + temperature_c - REFERENCE_TEMPERATURE_C)
    there = run.with_weather(weather)
    force = np.resize(np.concatenate([np.eye(3), -np.eye(3)]), (len(run.time_s), 3))
    moved = np.zeros_like(force)
    for truth in truths:
        if truth.stage == "block" and truth.act is not None:
            moved += truth.act(there, force, truth.amplitude) - truth.act(run, force, truth.amplitude)
    columns = np.column_stack([force, np.ones(len(force))])
    added = np.linalg.lstsq(columns, moved, rcond=None)[0].T * np.diag(K)[:, None]
    return np.concatenate([(K + added[:, :3]).ravel(), U0 + added[:, 3]])
