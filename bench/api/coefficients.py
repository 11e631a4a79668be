"""Coefficients of another day: the result of `bench calibrate --json`, read back."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.api.errors import Refused
from bench.base.arrays import Floats
from bench.model.block import COEFFICIENTS, Block


@dataclass(frozen=True)
class Coefficients:
    """A block with its covariance (12, 12), the noise of a reading, the gravity that is its unit (m/s²).

    `simulated` tells that they were found on simulated instruments.
    """

    block: Block
    covariance: Floats
    noise: float
    g_m_s2: float
    unit: str
    simulated: bool = False


def read_coefficients(path: Path, unit: str) -> Coefficients:
    """Read a result of `calibrate --json`.

    Raises `Refused` when the file is not one, holds what is no number, or has another unit than the
    readings.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise Refused(f"{path}: cannot be read ({error.strerror}); check the name") from error
    except ValueError as error:
        raise Refused(f"{path}: not a result of 'bench calibrate --json' ({error})") from error
    taken = coefficients_of(data, str(path))
    if taken.unit != unit:
        raise Refused(f"{path}: coefficients in {taken.unit}/g, but the readings are in {unit}")
    return taken


def coefficients_of(data: Any, where: str) -> Coefficients:
    """Take the coefficients out of a result of `calibrate --json`, whatever their unit.

    Raises `Refused` that names `where` when it is not one, or holds what is no number.
    """
    try:
        values = np.array([data["coefficients"][name]["value"] for name in COEFFICIENTS], dtype=np.float64)
        by_name = {name: i for i, name in enumerate(data["order"])}
        order = [by_name[name] for name in COEFFICIENTS]
        covariance = np.array(data["covariance"], dtype=np.float64)[np.ix_(order, order)]
        noise, g_m_s2 = float(data["noise"]["reading_v"]), float(data["g_m_s2"])
        theirs = str(data["unit"])
    except KeyError as error:
        raise Refused(
            f"{where}: not a result of 'bench calibrate --json': it has no {error}; give a file that "
            "calibrate wrote"
        ) from error
    except (ValueError, TypeError, IndexError) as error:
        raise Refused(f"{where}: not a result of 'bench calibrate --json' ({error})") from error
    numbers = [*values, *covariance.ravel(), noise, g_m_s2]
    if not np.all(np.isfinite(numbers)) or np.any(np.diag(covariance) < 0) or noise < 0 or g_m_s2 <= 0:
        raise Refused(f"{where}: holds what is no number, or a negative variance; calibrate again")
    simulated = bool(data.get("simulated", False))
    return Coefficients(Block.from_vector(values), covariance, noise, g_m_s2, theirs, simulated)
