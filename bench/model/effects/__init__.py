"""The catalogue of effects: every effect that the model knows, by name."""

from bench.model.effects.base import CHANNELS, AppliedEffect, Effect, Parameter, Stage
from bench.model.effects.block import QuadraticNonlinearity
from bench.model.effects.stand import HeadEccentricity

CATALOGUE: dict[str, Effect] = {
    effect.name: effect
    for effect in (
        QuadraticNonlinearity(),
        HeadEccentricity(),
    )
}

__all__ = ["CATALOGUE", "CHANNELS", "AppliedEffect", "Effect", "Parameter", "Stage"]
