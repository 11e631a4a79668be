"""Whole uncertainty of coefficients over temperature and of a tumble."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.calibration.budget.sources import assumed_stand
from bench.calibration.budget.whole import sign
from bench.calibration.calibrate import calibrate
from bench.calibration.result import SourceOfError
from bench.calibration.temperature.model import TemperatureModel
from bench.calibration.tumble.terms import DEFAULT
from bench.calibration.tumble.view import TumbleView, combine, tumble_view
from bench.model.geometry import COEFFICIENTS
from bench.services.source import Source

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
