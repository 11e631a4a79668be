"""The forward model: geometry of the stand, the block, effects. One definition serves simulation and fit."""

from bench.model.conditions import REFERENCE_C, Conditions, Mounting
from bench.model.effects import CATALOGUE, AppliedEffect, Effect, Parameter, Stage, Subsystem
from bench.model.forward import ForwardModel
from bench.model.geometry import STAND_ANGLES, Block, Distribution, Installation, stand_errors

__all__ = [
    "CATALOGUE",
    "REFERENCE_C",
    "STAND_ANGLES",
    "AppliedEffect",
    "Block",
    "Conditions",
    "Distribution",
    "Effect",
    "ForwardModel",
    "Installation",
    "Mounting",
    "Parameter",
    "Stage",
    "Subsystem",
    "stand_errors",
]
