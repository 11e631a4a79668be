"""What a plan promises is what a calibration of its readings signs, everything counted once, on several benches."""

import numpy as np
import pytest

from bench.calibration import calibrate
from bench.calibration.budget.sources import assumed_stand
from bench.calibration.budget.whole import delta_g_contributions, sign
from bench.calibration.noise import LEAST_REPEATS
from bench.calibration.result import Noise
from bench.config.bench_file.file import load_bench
from bench.config.bench_file.stand import AngleError, TemperatureError
from bench.config.procedure.load import load_procedure
from bench.config.shipped import find_bench, find_procedure
from bench.model import ForwardModel
from bench.model.geometry import COEFFICIENTS
from bench.planning.optimal_design import checks_of, coefficient_goals, repeats, widening
from bench.planning.requirements import conditions_of, fitted, settings_of
from bench.readings.table import make_readings
from bench.services.planning import delta_g_of, stand_of
from drivers.clock import utc_now


def shipped(name):
    return load_bench(find_bench(name))


def edited(section, **stated):
    bench = shipped("paper-stand")
    return bench.model_copy(update={section: getattr(bench, section).model_copy(update=stated)})


def measured_roll():
    return edited("stand", mounting_roll=AngleError(limit="10 arcsec", distribution="rectangular"))


def foundation():
    return edited("stand", foundation=AngleError(limit="60 arcsec", distribution="normal", k=2))


def wandering():
    stated = TemperatureError(limit="1 K", distribution="rectangular", correlation_time="30 min")
    return edited("uncertainty", temperature=stated)


BENCHES = {
    "paper": lambda: shipped("paper-stand"),
    "stand": lambda: shipped("bench-stand"),
    "multiplexer": lambda: shipped("bench-multiplexer"),
    "roll": measured_roll,
    "foundation": foundation,
    "wandering": wandering,
}


@pytest.mark.parametrize("name", BENCHES)
@pytest.mark.parametrize("procedure", ["quick", "remount-90"])
def test_what_is_promised_is_what_is_signed(name, procedure):
    """To 1 %, of each coefficient and of delta g: readings without errors, noise as the plan widens it."""
    bench = BENCHES[name]()
    model = ForwardModel(bench.installation_models())
    stand = stand_of(bench, model, day=utc_now().date())
    settings = fitted(settings_of(load_procedure(find_procedure(procedure)).plan))
    goals = [*coefficient_goals({"all": 1e-4}), *delta_g_of(stand, 1e-3, "--delta-g")]
    promise = stand.promise(settings, goals)

    whole = stand.budget([*settings, *checks_of(goals)]).setup
    conditions = whole.conditions
    labels = [conditions.mounts[m].installation for m in conditions.mount]
    readings = make_readings(
        labels, conditions.pass_number.tolist(), conditions.point.tolist(), conditions.angle_rad, whole.signal,
        series=[conditions.mounts[m].series for m in conditions.mount], direction=conditions.direction.tolist(),
    )  # fmt: skip
    own = conditions_of(settings)
    again = repeats(own)
    freedom = 3 * again if again >= LEAST_REPEATS else 3 * len(own) - stand.unknowns(len(own.mounts))
    wider = widening(freedom)
    noise = Noise(wider * stand.noise.reading, wider * stand.noise.setting_rad, np.inf, "given")
    stated = {key: size.u for key, size in bench.stand_distributions().items()}
    assumed = {key: size.u for key, size in assumed_stand(bench).items()}
    found = calibrate(readings, model, stated, 9.81, noise=noise, assumed_u=assumed)
    signed = sign(found, readings, bench, model, utc_now().date())

    u = [goal.u(promise.readings) for goal in promise.goals]
    np.testing.assert_allclose(u[: len(COEFFICIENTS)], signed.u, rtol=0.01)
    np.testing.assert_allclose(np.sqrt(np.diag(promise.combined)), signed.u, rtol=0.01)
    at_points = sum(delta_g_contributions(signed, readings, bench, model, utc_now().date()).values())
    np.testing.assert_allclose(u[len(COEFFICIENTS) :], np.sqrt(np.diag(at_points)), rtol=0.02)
