"""What a diagnosis takes for granted, what it could not look for, where readings and bench file contradict."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from bench.analysis.diagnosis.candidates import in_volts
from bench.analysis.diagnosis.linear import LinearSystem
from bench.model import CATALOGUE, REFERENCE_C, Effect
from bench.model.conditions import REMOUNT_S, SETTING_S
from bench.model.effects import FormulaEffect
from bench.model.effects.expression import names_in

OF_TEMPERATURE = ("thermal_bias", "thermal_scale")


def at_reference(found: Iterable[Effect]) -> Iterator[str]:
    """Yield at which temperature the coefficients are those that are told, where effects of it are beside them."""
    names = [effect.name for effect in found if _of_temperature(effect)]
    if names:
        yield f"the coefficients are those at {REFERENCE_C:g} °C, from which {' and '.join(names)} counts"


def _of_temperature(effect: Effect) -> bool:
    return effect.name in OF_TEMPERATURE or (
        isinstance(effect, FormulaEffect) and "temperature" in names_in(effect.expression)
    )


def assumed(linear: LinearSystem) -> Iterator[str]:
    """Yield sentences on what the readings do not say, or say otherwise than the bench file."""
    readings = linear.readings
    yield from (f"not looked for: {trouble}" for trouble in CATALOGUE.troubles)
    if linear.orientation is not None and linear.orientation.contradicts:
        yield linear.orientation.in_words()
    if not np.isfinite(readings.time_s).any():
        yield (
            f"no times in the readings: {SETTING_S / 60:g} min a setting and {REMOUNT_S / 60:g} min for a remount "
            "are taken, and every rate and time constant rests on that"
        )
    if not np.isfinite(readings.temperature_c).any():
        yield f"no temperatures in the readings: {' and '.join(OF_TEMPERATURE)} cannot be looked for"
    if readings.unit != "V":
        names = ", ".join(name for name, effect in CATALOGUE.items() if in_volts(effect))
        yield f"signals in {readings.unit} are not voltages: effects stated in volts are not looked for ({names})"
