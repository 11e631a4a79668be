"""The catalogue of effects: every effect that the model knows, by name."""

from bench.model.effects import head, hysteresis, nonlinear, stand, thermal, voltmeter
from bench.model.effects.base import AppliedEffect, Effect, Parameter, Stage, Subsystem

CATALOGUE: dict[str, Effect] = {
    effect.name: effect
    for effect in (
        nonlinear.QuadraticNonlinearity(),
        nonlinear.CubicNonlinearity(),
        nonlinear.OddQuadraticNonlinearity(),
        nonlinear.ScaleAsymmetry(),
        nonlinear.CrossCoupling(),
        nonlinear.CrossQuadratic(),
        hysteresis.Hysteresis(),
        thermal.ThermalBias(),
        thermal.ThermalScale(),
        thermal.WarmUp(),
        thermal.BiasDrift(),
        thermal.ScaleDrift(),
        thermal.TurnOnShift(),
        stand.AxisTilt(),
        stand.ZeroOffset(),
        stand.MountingError(),
        stand.MountingOffset(),
        stand.MountingRoll(),
        head.HeadEccentricity(),
        head.HeadEllipticity(),
        head.HeadGraduation(),
        head.Backlash(),
        stand.AxisWobble(),
        stand.BracketTilt(),
        stand.FoundationTilt(),
        voltmeter.VoltmeterNonlinearity(),
        voltmeter.VoltmeterDrift(),
        voltmeter.RangeOffset(),
        voltmeter.ChannelCrosstalk(),
        voltmeter.VoltmeterGain(),
        voltmeter.VoltmeterOffset(),
        voltmeter.ThermalEmf(),
        voltmeter.WrongGravity(),
    )
}

__all__ = ["CATALOGUE", "AppliedEffect", "Effect", "Parameter", "Stage", "Subsystem"]
