"""The only module of the trial that calls the program under test."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from bench.calibration.design import FIXED
from bench.config.bench_file.file import BenchFile, load_bench
from bench.config.formulas import load_effects
from bench.config.shipped import find_bench
from bench.diagnosis import Threshold, ThresholdCache, diagnose
from bench.diagnosis.evidence import Whitened
from bench.diagnosis.free_positions import diagnose_free
from bench.diagnosis.linear import LinearSystem
from bench.diagnosis.posterior import posterior
from bench.diagnosis.show import Simulation, show
from bench.model import CATALOGUE, Effect, ForwardModel, Installation
from bench.results.diagnosis import found_result
from bench.results.free_diagnosis import result_of
from benchmarks.blind_trial.cases import Case
from benchmarks.blind_trial.outside import FORMULAS

LOCAL_GRAVITY = 9.81
"""Local gravity of the trial, m/s²; the coefficients are per local g, so that any value would do."""
STATED_BENCH = "paper-stand"
"""The bench file that the diagnosis is given; the noise that it states is replaced by that of each case."""


class _ByDesign(ThresholdCache):
    """A cache that uses one threshold for all cases of a design and kind of noise.

    Their temperatures hardly affect the threshold.
    """

    def __init__(self) -> None:
        super().__init__(None)
        self.known: dict[tuple[object, ...], Threshold] = {}
        self.key = ("", 0.0)

    def threshold(self, linear: LinearSystem, whitened: Whitened, setting_rad: float) -> Threshold:
        """Return the threshold of the present design, computed from its first case."""
        # readings with the same rounding share random columns, and their noise counts as known
        of_noise = (linear.random.shape[1], whitened.grid.known)
        size = (len(linear), linear.fixed.shape[1])
        key = (*self.key, *size, *of_noise)
        if key not in self.known:
            self.known[key] = super().threshold(linear, whitened, setting_rad)
        return self.known[key]


def _points(simulation: Simulation | None) -> list[tuple[float, float]]:
    return [] if simulation is None else [(point.delta_g, point.u) for point in simulation.points]


@cache
def _bench() -> tuple[BenchFile, ForwardModel, dict[str, float], _ByDesign]:
    bench = load_bench(find_bench(STATED_BENCH))
    stand_u = {name: d.u for name, d in bench.stand_distributions().items()}
    return bench, ForwardModel(bench.installation_models()), stand_u, _ByDesign()


@cache
def _own() -> tuple[Effect, ...]:
    return load_effects(FORMULAS)


def forget_thresholds() -> None:
    """Discard the thresholds of all designs, because something on which they depend has changed."""
    _bench()[3].known.clear()


def diagnose_case(case: Case) -> dict[str, Any]:
    """Return the diagnosis of a case (see `_diagnosed`); a case with user formulas is diagnosed with these."""
    if case.free:
        return result_of(diagnose_free(case.free, one_sensor=True)).to_dict()
    with CATALOGUE.also(_own() if case.own else ()):
        return _diagnosed(case)


def _diagnosed(case: Case) -> dict[str, Any]:
    """Return the members of `bench diagnose --json` for the readings of a case, and the coefficients.

    The coefficients are estimated without and with the effects found, each with its covariance. If the effect was
    named, the result also has the error of the modulus at the verification points, g, with its u.
    """
    bench, model, stand_u, thresholds = _bench()
    thresholds.key = (f"{case.design}{' own' * case.own}", case.reading_noise_v)
    if case.stated_psi_deg is not None:
        stated = Installation.from_axes("V", ("x", "y", "z"), np.radians(case.stated_psi_deg), "z")
        model = replace(model, installations={**model.installations, "V": stated})
        thresholds.key = (f"{case.design}, another psi", case.reading_noise_v)
    nominal = np.array(bench.unit_under_test.scale_factors.values)
    found = diagnose(case.readings, model, stand_u, nominal, thresholds)
    points = None
    several = found.linear.readings.block is not None
    if found.verdict == "named" and not several:
        shown = show(found.mistakes.corrected, found.linear.model, found.applied, stand_u, LOCAL_GRAVITY)
        points = {"before": _points(shown.before), "after": _points(shown.after)}
    if several:
        # each block has coefficients of its own
        return found_result(found).to_dict() | {"delta_g": None}
    nothing = found.candidates.columns[:, :0]
    without = posterior(found.linear, nothing, found.noise)
    return found_result(found).to_dict() | {
        "delta_g": points,
        "coefficients": {
            name: {
                "value": (found.linear.block.vector + fitted.mean[:FIXED]).tolist(),
                "covariance": fitted.covariance[:FIXED, :FIXED].tolist(),
            }
            for name, fitted in (("before", without), ("after", found.fitted))
        },
    }
