"""What a reader of a calibration should know of its noise, a sentence each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from bench.analysis.calibration.components import ANGLE, DRIFT, Component, Shared
from bench.analysis.calibration.result import Noise, NoisePrior
from bench.base.arrays import ARCSEC, CHANNELS
from bench.base.numbers import scale_for

UNEQUAL_P: Final = 0.001
"""Channels of different noise, and heavy tails, are told from here on: not in every hundredth run."""

DISAGREES_P: Final = 0.05
"""Few readings seldom contradict a statement: a doubt is told early."""

_SHARED_BY: Final = {
    "setting": "the readings at a setting (installation and point) in all passes",
    ANGLE: "the readings at a setting (installation and point) in all passes",
    "visit": "the readings of one stay at a setting",
    "pass": "the readings of one pass",
}


def notes_on_noise(noise: Noise, tails: float, shared: Shared, birge: float, unit: str) -> tuple[str, ...]:
    """Return the sentences; `tails` is the probability of such tails, `birge` by how much u was widened."""
    notes = [*note_on_prior(noise, unit)]
    if noise.channels is not None and noise.p_equal < UNEQUAL_P:
        sizes = ", ".join(f"{c} {size:.2g} {unit}" for c, size in zip(CHANNELS, noise.channels, strict=True))
        notes.append(f"the channels differ in noise ({sizes}; p = {noise.p_equal:.1g}): each has its own")
    if tails < UNEQUAL_P:
        notes.append(
            f"the noise has heavy tails (p = {tails:.1g}): u holds for its standard deviation, and the estimator "
            "'robust' leaves out what is far off"
        )
    notes += _on_components(shared.components, unit)
    if shared.drift is not None:
        notes.append(
            f"U0 is the bias at the mean of the run of {shared.drift.hours:.2g} h; at any one time it is less "
            "certain by as much as it wanders"
        )
    if birge > 1.0:
        notes.append(
            f"the model leaves more than the noise explains: u is {birge:.2g} times what the noise alone gives "
            "(Birge ratio)"
        )
    return tuple(notes)


def note_on_prior(noise: Noise, unit: str) -> tuple[str, ...]:
    """Say where u rests on a statement, and whether the readings agree with it."""
    return () if noise.prior is None else (_on_prior(noise.prior, unit),)


def _on_prior(prior: NoisePrior, unit: str) -> str:
    where = "the bench file states" if prior.stated else "other runs told"
    scale = scale_for(prior.reading, unit)
    rests = (
        f"u rests on the sizes of the noise that {where} (reading {prior.reading / scale.size:.3g} {scale.unit}, "
        f"setting {prior.setting_rad / ARCSEC:.2g} arcsec, {prior.dof:.2g} degrees of freedom)"
    )
    if not prior.readings_dof > 0:
        return f"{rests}: so few readings leave nothing over that would show the noise"
    scatter = f"they scatter {prior.ratio:.2g} times as much"
    if prior.p < DISAGREES_P:
        return f"{rests}, and the readings disagree: {scatter} (p = {prior.p:.1g}); measure more points"
    return f"{rests}: so few readings show little of it, and {scatter} (p = {prior.p:.2g})"


def _on_components(components: Sequence[Component], unit: str) -> Iterator[str]:
    for what in dict.fromkeys(c.what for c in components):
        own = [c for c in components if c.what == what]
        if what == ANGLE:
            sizes = f"{own[0].size / ARCSEC:.2g} arcsec of the head"
        elif own[0].channels == "all":
            sizes = f"{own[0].size:.2g} {unit}"
        else:
            sizes = ", ".join(f"{c.channels} {c.size:.2g} {unit}" for c in own)
        if what == DRIFT:
            yield f"the biases seem to wander over the run by {sizes} rms about their means: u holds it"
        else:
            yield f"{_SHARED_BY[what]} seem to share an error ({sizes}), which repeats do not average: u holds it"
