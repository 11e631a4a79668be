"""The whole uncertainty of a tumble: what its readings show, and the errors of the bench that they do not.

As for a calibration: each error acts on the readings that were taken, and through the map of the fit on the
quantities. So linearity of the meters is in K2 and K3, their gain in K1, the block's warmth in all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import date
from typing import Final

from bench.analysis.budget.coefficients import parts_of
from bench.analysis.budget.setup import meters_of
from bench.analysis.budget.sources import hidden_sources
from bench.analysis.budget.whole import GRAVITY, VOLTS, Taken
from bench.analysis.tumble.view import TumbleView, sized, with_terms
from bench.files.bench.file import BenchFile
from bench.model.forward import ForwardModel

NOT_IN_VOLTS: Final = (
    "the readings are in {unit}, so the errors of this bench's meters are in no uncertainty here: u is what these "
    "readings show"
)


def combine(
    view: TumbleView, bench: BenchFile, model: ForwardModel, terms: Sequence[str], day: date | None = None
) -> TumbleView:
    """Return the view with the combined covariance; `terms` are those asked for, of which no prior counts.

    `day` is that of the readings: what a certificate states has drifted since its own. The meters' errors are in
    volts, and so in no result of readings in another unit.
    """
    if view.unit != VOLTS:
        return replace(view, notes=(*view.notes, NOT_IN_VOLTS.format(unit=view.unit)))
    meters = meters_of([m.channels for m in bench.instruments.voltmeters])
    taken = Taken(view.fitted, view.block, meters, view.slope)
    covariance = view.covariance.copy()
    for error in hidden_sources(bench, with_terms(replace(model, effects=()), terms), day):
        if error.name != GRAVITY:
            parts = parts_of(error, taken, view.gain)
            covariance += parts @ parts.T
    axes = sized(view.axes, covariance, view.covariance_readings)
    return replace(view, axes=axes, covariance=covariance, combined=True)
