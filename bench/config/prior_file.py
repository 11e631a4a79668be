"""Prior files: what `bench fleet prior` writes of a type of unit, and `bench calibrate --prior` takes."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from bench.base.yaml_files import FileModel, Place, load_validated, part
from bench.model.geometry import COEFFICIENTS

Row = Annotated[tuple[float, ...], Field(min_length=len(COEFFICIENTS), max_length=len(COEFFICIENTS))]


class PriorCoefficient(FileModel):
    """One coefficient of a further unit: its mean, u, what units differ by, and the u of the mean."""

    mean: float
    u: Annotated[float, Field(gt=0)]
    between_units: Annotated[float, Field(ge=0)]
    u_mean: Annotated[float, Field(ge=0)]


class PriorFile(FileModel):
    """A prior file, validated. Scale factors are per g of `per_g_m_s2`, in the unit of the signal."""

    type: str
    signal: str
    per_g_m_s2: Annotated[float, Field(gt=0)]
    simulated: bool
    units: Annotated[tuple[str, ...], Field(min_length=1)]
    benches: Annotated[tuple[str, ...], Field(min_length=1)]
    calibrations: Annotated[int, Field(gt=0)]
    last: str
    dof: Annotated[int, Field(gt=0)]
    shrunk: Annotated[float, Field(ge=0, le=1)]
    coefficients: dict[str, PriorCoefficient]
    covariance: Annotated[tuple[Row, ...], Field(min_length=len(COEFFICIENTS), max_length=len(COEFFICIENTS))]
    notes: tuple[str, ...] = ()

    @classmethod
    def cross_checks(cls, data: Any) -> Iterable[tuple[Place, str]]:
        """Yield coefficients that are missing or none, and a covariance that is none."""
        named = part(data, "coefficients")
        if isinstance(named, dict):
            missing = [name for name in COEFFICIENTS if name not in named]
            if missing or len(named) > len(COEFFICIENTS):
                yield ("coefficients",), f"expected {', '.join(COEFFICIENTS)}, each once"
        try:
            matrix = np.array(part(data, "covariance"), dtype=float)
            size = np.sqrt(np.diag(matrix))
            usable = bool(np.all(size > 0)) and np.allclose(matrix, matrix.T, rtol=1e-9, atol=0.0)
            usable = usable and bool(np.linalg.eigvalsh(matrix / np.outer(size, size))[0] > 0)
        except (TypeError, ValueError):
            return  # its form is told
        if not usable:
            yield (
                ("covariance",),
                "is no covariance: not symmetric, or not positive; take the file as it was written",
            )


def load_prior(path: Path) -> PriorFile:
    """Read a prior file. Raises `FileMistakes` with every mistake in it."""
    return load_validated(path, PriorFile)
