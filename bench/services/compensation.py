"""Whole uncertainty of coefficients over temperature and of a tumble."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.base.files import from_text, read_regular
from bench.base.text import repeated
from bench.calibration.budget.sources import assumed_stand
from bench.calibration.budget.whole import sign
from bench.calibration.calibrate import calibrate
from bench.calibration.result import SourceOfError
from bench.calibration.temperature.model import TemperatureModel
from bench.calibration.tumble import DEFAULT, TumbleView, combine, tumble_view
from bench.exchange.result import BlockResult
from bench.model.geometry import COEFFICIENTS
from bench.run.events import MANIFEST
from bench.services.calibration import calibration_of
from bench.services.coefficients import block_result
from bench.services.errors import Refused
from bench.services.source import Request, Source, load_sources

OVER_TEMPERATURE: Final = ("temperature", "thermometer")
"""Errors that a model over temperature does not have as one of a single temperature has them."""


@dataclass(frozen=True)
class SignedModel:
    """A temperature model with the combined covariance, and without what cancels for the same meters.

    `sources` are the errors that no reading shows; they stand in the terms at the reference temperature, for they
    are the same at each.
    """

    combined: TemperatureModel
    same_meters: TemperatureModel
    sources: tuple[SourceOfError, ...]


def sign_model(model: TemperatureModel, source: Source) -> SignedModel:
    """Return a model with the errors of the bench that its readings do not show, as `source` has them.

    The block at one temperature stands for all: they act on the readings there as anywhere.
    """
    assumed = {name: size.u for name, size in assumed_stand(source.bench).items()}
    found = calibrate(
        source.readings, source.model, source.stand_u, source.g_m_s2, assumed_u=assumed, find_shared=False
    )
    signed = sign(found, source.readings, source.bench, source.model, source.traced.day, source.known_meters)
    sources = tuple(s for s in signed.sources if s.name not in OVER_TEMPERATURE)
    return SignedModel(
        _with(model, sources), _with(model, tuple(s for s in sources if not s.cancels)), sources
    )


def _with(model: TemperatureModel, sources: tuple[SourceOfError, ...]) -> TemperatureModel:
    hidden = sum((s.covariance for s in sources), np.zeros((len(COEFFICIENTS),) * 2))
    constant = np.arange(len(COEFFICIENTS)) * model.values.shape[1]
    covariance: Floats = model.covariance.copy()
    covariance[np.ix_(constant, constant)] += hidden
    return replace(model, covariance=covariance)


def tumble_of(source: Source, terms: Sequence[str] = DEFAULT) -> TumbleView:
    """Return each axis of a source in the terms asked for. Raises `CalibrationError` where that cannot be."""
    assumed = {name: size.u for name, size in assumed_stand(source.bench).items()}
    view = tumble_view(source.readings, source.model, source.stand_u, source.g_m_s2, terms, assumed_u=assumed)
    return combine(view, source.bench, source.model, terms, source.traced.day)


# --- for a navigation computer ------------------------------------------------------------------------


@dataclass(frozen=True)
class Given:
    """A calibration to be written: `result`, and where its files go; `source` is None for a JSON file's."""

    result: BlockResult
    stem: Path
    source: Source | None

    def file(self, suffix: str) -> Path:
        """Return the file whose name ends so."""
        if self.source is None:
            return self.stem.with_name(self.stem.name + suffix)
        return self.source.output("coefficients", suffix, what_if=self.source.what_if)


def results_of(request: Request) -> list[Given]:
    """Calibrate what is to be calibrated and read what is a result already. Raises `Refused`."""
    names = [name for name in request.sources if isinstance(name, str) and _is_result(Path(name))]
    asked = (request.bench, request.model, request.g_m_s2)
    if names and (any(value is not None for value in asked) or request.skip_bad_rows):
        raise Refused(
            f"{names[0]}: is a result already, made with its own bench file, model and gravity; leave out --bench, "
            "--model, --g and --skip-bad-rows, or give its readings"
        )
    found: list[Given] = []
    for name in request.sources:
        if name in names:
            found += _read(Path(str(name)), request.out)
        else:
            (source,) = load_sources(replace(request, sources=[name]))
            found.append(Given(calibration_of(source).derived, Path(), source))
    files = [given.file("") for given in found]
    for file in repeated(map(str, files)):
        raise Refused(f"--out: two sources would write {file}*; give each a folder of its own")
    return found


def _is_result(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() == ".json" and path.name != MANIFEST


def _read(path: Path, out: Path | None) -> list[Given]:
    try:
        data = from_text(read_regular(path).decode())
    except OSError as error:
        raise Refused(f"{path}: cannot be read ({error.strerror}); check the name") from error
    except ValueError as error:
        raise Refused(f"{path}: not a result of 'bench calibrate --json' ({error})") from error
    results = data if isinstance(data, list) else [data]
    many = len(results) > 1
    stem = (out or path.parent / "coefficients") / path.stem
    return [
        Given(
            block_result(one, f"{path}, result {k}" if many else str(path)),
            stem.with_name(f"{stem.name}-{k}") if many else stem,
            None,
        )
        for k, one in enumerate(results, 1)
    ]
