"""The sources of a bench file: sizes, what each is common to, and what it must do to the coefficients."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml

from bench.calibration import CalibrationError
from bench.calibration.budget.coefficients import MeasuredReadings, make_budget, make_setup, parts_of
from bench.calibration.budget.propagation import coverage_factor
from bench.calibration.budget.sources import bench_sources, effect_sources, hidden_sources, stand_source
from bench.config.bench_file.file import FileMistakes, load_bench
from bench.config.devices.registry import devices
from bench.config.devices.sections import VoltmeterKind
from bench.config.procedure.load import load_procedure
from bench.config.shipped import find_bench, find_procedure
from bench.model import CATALOGUE, AppliedEffect, Distribution
from bench.model.geometry import Block
from bench.readings.table import make_readings
from bench.validation.paper_bench import ARCSEC, TRUTH, K
from tests.support.budget_bench import COEFFICIENTS, paper_setup, stand

PLAN = load_procedure(find_procedure("paper")).expand()
SHIPPED = load_bench(find_bench("paper-stand"))
K_PART = np.concatenate([np.ones(9), np.zeros(3)])


def edited(tmp_path, **sections):
    data = yaml.safe_load(Path(find_bench("paper-stand")).read_text(encoding="utf-8"))
    for name, content in sections.items():
        both = isinstance(data.get(name), dict) and isinstance(content, dict)
        data[name] = {**data[name], **content} if both else content
    file = tmp_path / "bench.yaml"
    file.write_text(yaml.safe_dump(data, allow_unicode=True), encoding="utf-8")
    return load_bench(file)


def by_name(bench, setup=None):
    return {s.name: s for s in bench_sources(bench, setup or make_setup(PLAN, bench))}


def contribution(name, setup=None, **changes):
    source = dataclasses.replace(by_name(SHIPPED)[name], **changes)
    budget = make_budget(setup or paper_setup(), [*stand(), source])
    return budget.contribution(name)


# --- sizes ------------------------------------------------------------------------------------------


def test_the_shipped_bench():
    found = by_name(SHIPPED)
    assert found["mounting_error"].u == pytest.approx(30 * ARCSEC)
    assert found["voltmeter_error"].u == pytest.approx(1e-4)
    # nobody states the third mounting angle: it is as large as the other
    assert found["mounting_roll"].u == found["mounting_error"].u
    # 20 ppm of the reading and 5 ppm of 10 V as rectangular limits
    assert found["voltmeter_gain"].u == pytest.approx(20e-6 / np.sqrt(3))
    assert found["voltmeter_offset"].u == pytest.approx(50e-6 / np.sqrt(3))
    assert found["voltmeter_linearity"].u == pytest.approx((2e-6 * 2.18 + 1e-5) / np.sqrt(3))
    assert found["gravity"].u == pytest.approx(5e-4 / SHIPPED.gravity_m_s2)
    assert found["K2"].u == pytest.approx(30e-6)
    assert [s.name for s in found.values() if s.prior] == [
        "mounting_roll", "voltmeter_gain", "voltmeter_offset", "voltmeter_linearity", "reference_noise", "gravity",
        "temperature", "K2", "K3",
    ]  # fmt: skip


def test_the_meters_limits_are_those_of_their_manuals():
    """34401A User's Guide, chapter 8; 34970A data sheet: the specification of 90 days."""
    told = {d.name: VoltmeterKind.of(d.section.facts).accuracy for d in devices().of("voltmeter")}
    assert told["agilent-34401a"][10.0] == told["keysight-34970a"][10.0] == (20e-6, 5e-6)
    assert told["agilent-34401a"][1000.0] == (35e-6, 10e-6)
    assert told["keysight-34970a"][300.0] == (35e-6, 20e-6)
    assert told["keysight-34461a"][0.1] == (40e-6, 35e-6)


def test_the_section_uncertainty_is_used(tmp_path):
    bench = edited(
        tmp_path,
        uncertainty={
            "voltmeter_gain": {"limit": "35 ppm", "distribution": "normal", "k": 1, "dof": 12},
            "voltmeter_offset": {"limit": "20 uV", "distribution": "rectangular"},
            "voltmeter_linearity": {"limit": "5 uV", "distribution": "rectangular"},
            "reference_noise": {"limit": "0.3 ppm", "distribution": "normal", "k": 1},
            "gravity": {"limit": "2e-5 m/s^2", "distribution": "normal", "k": 2},
            "temperature": {"limit": "0.1 K", "distribution": "rectangular"},
            "bias_temperature_coefficient": {"limit": "15 ug/K", "distribution": "normal", "k": 1},
            "scale_temperature_coefficient": {"limit": "120 ppm/K", "distribution": "normal", "k": 2},
            "K2": {"limit": "10 ug/g^2", "distribution": "normal", "k": 2},
            "K3": {"limit": "1 ug/g^3", "distribution": "normal", "k": 1},
        },
    )
    found = by_name(bench)
    u = {name: source.u for name, source in found.items()}
    assert u["voltmeter_gain"] == pytest.approx(35e-6)
    assert found["voltmeter_gain"].dof == 12
    assert u["voltmeter_offset"] == pytest.approx(20e-6 / np.sqrt(3))
    assert u["reference_noise"] == pytest.approx(0.3e-6)
    assert u["gravity"] == pytest.approx(1e-5 / bench.gravity_m_s2)
    assert u["temperature"] == pytest.approx(0.1 / np.sqrt(3))
    assert found["temperature"].factors == pytest.approx({"bias": 15e-6, "scale": 60e-6})
    assert (u["K2"], u["K3"]) == pytest.approx((5e-6, 1e-6))
    assert [name for name, source in found.items() if source.prior] == ["mounting_roll"]


def test_a_stated_roll_and_offset_are_sources(tmp_path):
    size = {"limit": "90 arcsec", "distribution": "normal", "k": 3}
    found = by_name(edited(tmp_path, stand={"mounting_roll": size, "mounting_offset": {**size}}))
    assert found["mounting_roll"].u == found["mounting_offset"].u == pytest.approx(30 * ARCSEC)


@pytest.mark.parametrize(("written", "u"), [("9.81 m/s^2", 5e-3 / np.sqrt(3)), ("9.810512 m/s^2", 1e-5)])
def test_gravity_as_a_number_is_known_to_its_last_digit(tmp_path, written, u):
    bench = edited(tmp_path, gravity=written)
    assert by_name(bench)["gravity"].u * bench.gravity_m_s2 == pytest.approx(u)


def test_mistakes_in_the_section_are_told(tmp_path):
    with pytest.raises(FileMistakes, match=r"voltmeter_gain.*a normal distribution needs 'k'"):
        edited(tmp_path, uncertainty={"voltmeter_gain": {"limit": "35 ppm", "distribution": "normal"}})
    wrong = {"bias_temperature_coefficient": {"limit": "30 ug", "distribution": "rectangular"}}
    with pytest.raises(FileMistakes, match="temperature coefficient of the bias"):
        edited(tmp_path, uncertainty=wrong)


def test_an_installation_that_the_bench_lacks_is_told():
    plan = load_procedure(find_procedure("remount-90")).expand()
    bare = SHIPPED.model_copy(update={"installations": {}})
    with pytest.raises(CalibrationError, match="no installation 1T90"):
        make_setup(plan, bare)


# --- what they do -----------------------------------------------------------------------------------


def test_gain_scales_every_coefficient_of_its_channel():
    """u of row i is u(gain) times the row: 35 ppm is 75 µV/g of Kyy."""
    found = contribution("voltmeter_gain", distribution=Distribution(35e-6))
    np.testing.assert_allclose(found.u, 35e-6 * np.abs(TRUTH), rtol=1e-9)
    assert 1e6 * found.u[4] == pytest.approx(75, abs=0.5)
    correlation = found.covariance / np.outer(found.u, found.u)
    assert abs(correlation[0, 1]) == pytest.approx(1.0)
    assert correlation[0, 4] == pytest.approx(0.0, abs=1e-12)


def test_one_meter_for_three_channels_correlates_them():
    found = contribution("voltmeter_gain", paper_setup(meters=(0, 0, 0)))
    assert found.covariance[0, 4] == pytest.approx(found.u[0] * found.u[4])


def test_offset_goes_into_the_biases_alone():
    found = contribution("voltmeter_offset", distribution=Distribution(50e-6))
    np.testing.assert_allclose(found.u, 50e-6 * (1 - K_PART), atol=1e-15)


def test_gravity_scales_k_and_no_bias():
    found = contribution("gravity", distribution=Distribution(51e-6))
    np.testing.assert_allclose(found.u, 51e-6 * np.abs(TRUTH) * K_PART, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("name", ["voltmeter_linearity", "voltmeter_gain", "temperature"])
def test_what_passes_do_not_average(name):
    source = by_name(SHIPPED)[name]
    u = [make_budget(paper_setup(passes=p), [source], "closed-form").combined.u for p in (1, 4)]
    np.testing.assert_allclose(u[1], u[0], rtol=1e-9)


@pytest.mark.parametrize("name", ["setting_error", "voltmeter_error"])
def test_what_passes_average(name):
    source = stand_source(name, Distribution(1e-5))
    u = [make_budget(paper_setup(passes=p), [source], "closed-form").combined.u for p in (1, 4)]
    np.testing.assert_allclose(u[1], u[0] / 2, rtol=1e-6, atol=1e-12)


def test_linearity_is_the_same_where_the_voltage_is():
    """Points 1 and 9 are one orientation: (u1 + u9 - 2 u5)/4 has the error (2 e1 - 2 e5)/4, u/sqrt(2)."""
    source = dataclasses.replace(by_name(SHIPPED)["voltmeter_linearity"], distribution=Distribution(1e-5))
    found = make_budget(paper_setup(), [source], "closed-form").combined.u
    assert found[COEFFICIENTS.index("Kxz")] == pytest.approx(1e-5 / np.sqrt(2))


def test_a_temperature_that_stays_in_closed_form():
    """A limit alone is an offset throughout the run: K goes with the scale and U0 with the bias, k uT |K|."""
    source = by_name(SHIPPED)["temperature"]
    found = make_budget(paper_setup(), [source], "closed-form").combined.u
    scale, bias = source.factors["scale"] * source.u, source.factors["bias"] * source.u
    assert found[COEFFICIENTS.index("Kxz")] == pytest.approx(scale * abs(K[0, 2]), rel=1e-6)
    assert found[COEFFICIENTS.index("U0x")] == pytest.approx(bias * abs(K[0, 0]), rel=1e-3)


def test_a_temperature_that_wanders_in_full(tmp_path):
    """Its course has the covariance u^2 exp(-|t1 - t2|/1 h): the same sum without its shapes, written out."""
    wanders = {"limit": "0.5 K", "distribution": "rectangular", "correlation_time": "1 h"}
    source = by_name(edited(tmp_path, uncertainty={"temperature": wanders}))["temperature"]
    assert source.common == "time"
    assert "correlation time 1 h" in source.origin
    setup = paper_setup()
    budget = make_budget(setup, [source], "gls", stated={"voltmeter_error": 1e-4})
    time_s = setup.conditions.elapsed_s
    course = source.u**2 * np.exp(-np.abs(np.subtract.outer(time_s, time_s)) / 3600)
    sensed = setup.force @ setup.block.K.T
    for j, channel in ((0, 0), (4, 1), (9, 0), (11, 2)):
        row = budget.gain[j, :, channel]
        by_bias = row * setup.block.K[channel, channel] * source.factors["bias"]
        by_scale = row * sensed[:, channel] * source.factors["scale"]
        variance = by_bias @ course @ by_bias + by_scale @ course @ by_scale
        assert budget.combined.u[j] == pytest.approx(np.sqrt(variance), rel=2e-2)


SUPPLY = {
    "rails": [
        {
            "name": "p15",
            "output": "P25V",
            "voltage": "15 V",
            "tolerance": "0.3 V",
            "current": {"minimum": "10 mA", "maximum": "60 mA"},
            "limits": {"minimum": "0 V", "maximum": "18 V", "current": "0.2 A"},
            "current_limit": "0.1 A",
        }
    ],
    "warm_up": "30 min",
    "when_unsafe": "off",
}


def fed(tmp_path, **uncertainty):
    """The shipped bench whose block has a rail that a person switches."""
    by_hand = {"driver": "manual-supply", "outputs": {"P25V": {"maximum": "25 V", "current": "1 A"}}}
    instruments, unit = {"power_supply": by_hand}, {"supply": SUPPLY}
    return edited(tmp_path, instruments=instruments, unit_under_test=unit, uncertainty=uncertainty)


def test_what_feeds_the_block_is_two_lines(tmp_path):
    """The tolerance of a rail is a rectangle; a bench that nobody says to switch the block has neither."""
    assert not {"turn_on", "supply_voltage[p15]"} & by_name(SHIPPED).keys()
    usual = by_name(fed(tmp_path))
    assert usual["supply_voltage[p15]"].u == pytest.approx(0.3 / np.sqrt(3))
    assert usual["supply_voltage[p15]"].prior
    assert usual["turn_on"].prior
    stated = {
        "supply_voltage": {"limit": "20 mV", "distribution": "normal", "k": 2},
        "bias_supply_coefficient": {"limit": "8 ug/V", "distribution": "normal", "k": 1},
        "scale_supply_coefficient": {"limit": "30 ppm/V", "distribution": "normal", "k": 2},
        "turn_on_repeatability": {"limit": "12 ug", "distribution": "normal", "k": 1},
    }
    found = by_name(fed(tmp_path, **stated))
    assert found["supply_voltage[p15]"].u == pytest.approx(0.01)
    assert found["supply_voltage[p15]"].factors == pytest.approx({"bias": 8e-6, "scale": 15e-6, "rail": 1})
    assert found["turn_on"].u == pytest.approx(12e-6)
    assert not found["turn_on"].prior


def test_a_foundation_that_the_bench_file_states_is_a_line(tmp_path):
    """60 arcsec a day with k = 2, along and across; `test_promise` holds it against what is signed."""
    assert "foundation" not in by_name(SHIPPED)
    stated = edited(tmp_path, stand={"foundation": {"limit": "60 arcsec", "distribution": "normal", "k": 2}})
    source = by_name(stated)["foundation"]
    assert source.shown == "30 arcsec a day"
    u = make_budget(paper_setup(), [source], "closed-form").combined.u
    assert u[COEFFICIENTS.index("Kyx")] > 1e-6


def test_meters_follow_the_room_late(tmp_path):
    """A lag far longer than the run is one gain of each meter; a short one averages."""
    room = {"limit": "2 K", "distribution": "normal", "k": 2}
    coefficient = {"limit": "0.8 ppm/K", "distribution": "normal", "k": 1}

    def u_of_gain(**lag):
        bench = edited(
            tmp_path,
            uncertainty={"room_temperature": room | lag, "voltmeter_temperature_coefficient": coefficient},
        )
        source = by_name(bench)["room_temperature"]
        assert (source.u, source.factors) == (pytest.approx(1.0), {"scale": pytest.approx(0.8e-6)})
        return make_budget(paper_setup(), [source], "closed-form").combined.u[0] / abs(TRUTH[0])

    assert "room_temperature" not in by_name(SHIPPED)
    assert u_of_gain(lag="10000 h") == pytest.approx(0.8e-6, rel=1e-3)
    assert u_of_gain(lag="10 min") < u_of_gain() < 0.8e-6
    usual = by_name(edited(tmp_path, uncertainty={"room_temperature": room}))["room_temperature"]
    assert usual.prior
    assert "1 ppm/K (1σ), 100 min late" in usual.origin


def test_a_recorded_temperature_of_the_meters_takes_the_place_of_any_course(tmp_path):
    bench = edited(
        tmp_path,
        uncertainty={"room_temperature": {"limit": "2 K", "distribution": "normal", "k": 2, "lag": "1 s"}},
    )
    source, setup = by_name(bench)["room_temperature"], paper_setup()

    def with_meter_c(meter_c):
        return dataclasses.replace(setup, conditions=dataclasses.replace(setup.conditions, meter_c=meter_c))

    steady = with_meter_c(np.full(len(setup.conditions), 25.0))
    assert np.all(make_budget(steady, [source], "closed-form").combined.u == 0.0)
    course = 23.0 + np.arange(len(setup.conditions)) * 0.01
    assert np.any(make_budget(with_meter_c(course), [source], "closed-form").combined.u > 1e-9)


@pytest.mark.parametrize(("name", "unit", "of"), [("gain", 1e-6, "Kxx"), ("offset", 1e-6, "U0x")])
def test_a_model_without_a_temperature_leaves_what_the_unknown_temperature_does(tmp_path, name, unit, of):
    """A lag far longer than the run makes the unknown temperature one number: coefficient × limit × signal."""
    value, u, of_room = 3.0, 4.0, {"limit": "2 K", "distribution": "normal", "k": 2}
    lag = {"lag": np.array(1e9)}
    effect = AppliedEffect(
        CATALOGUE[f"voltmeter_thermal_{name}"], {name: np.full(3, value * unit)} | lag, ("x",),
        {name: np.full(3, u * unit)},
    )  # fmt: skip
    setup = paper_setup()
    setup = dataclasses.replace(setup, model=dataclasses.replace(setup.model, effects=(effect,)))
    place, other = COEFFICIENTS.index(of), COEFFICIENTS.index(of.replace("x", "y"))
    scale = abs(TRUTH[0]) if name == "gain" else 1.0

    def found(**uncertainty):
        bench = edited(tmp_path, uncertainty=uncertainty) if uncertainty else SHIPPED
        (source,) = (one for one in hidden_sources(bench, setup.model) if one.kind == "meter_temperature")
        return source, make_budget(setup, [source], "closed-form").combined.u

    source, u_stated = found(room_temperature=of_room)
    assert not source.prior
    assert u_stated[place] == pytest.approx(np.hypot(value, u) * unit * scale, rel=1e-4)
    assert u_stated[other] < 1e-12
    presumed, u_presumed = found()
    assert presumed.prior
    assert u_presumed[place] == pytest.approx(5.0 / np.sqrt(3.0) * u_stated[place], rel=1e-9)
    assert not [one for one in effect_sources(setup) if one.effect]
    known = np.full(len(setup.conditions), 25.0)
    read = dataclasses.replace(setup, conditions=dataclasses.replace(setup.conditions, meter_c=known))
    assert np.all(make_budget(read, [source], "closed-form").combined.u == 0.0)
    assert [one.name for one in effect_sources(read)]


def test_a_model_replaces_the_room_in_its_channels(tmp_path):
    gain = AppliedEffect(CATALOGUE["voltmeter_thermal_gain"], {"gain": np.full(3, 1e-6)}, channels=("x",))
    bench = edited(
        tmp_path, uncertainty={"room_temperature": {"limit": "1 K", "distribution": "normal", "k": 2}}
    )
    model = dataclasses.replace(paper_setup().model, effects=(gain,))
    found = {one.kind: one for one in hidden_sources(bench, model)}
    assert found["room_temperature"].channels == ("y", "z")
    assert found["meter_temperature"].correlation_s == 6000.0


def test_noise_of_a_reference_has_its_size_per_decade(tmp_path):
    """Each wave of a meter has the variance of the spectrum 1/(f ln 10) in a band of half a period of the run."""
    size = {"limit": "0.3 ppm", "distribution": "normal", "k": 1}
    source = by_name(edited(tmp_path, uncertainty={"reference_noise": size}))["reference_noise"]
    setup = paper_setup()
    rng = np.random.default_rng(3)
    functional = rng.normal(size=(1, len(setup.conditions), 3))
    time_s = setup.conditions.elapsed_s
    lowest_hz = 0.5 / np.ptp(time_s)
    variance = 0.0
    for k in range(1, 17):  # the integral of 1/(f ln 10) over a band of the width of the lowest frequency
        wave = np.cos(2.0 * np.pi * k * lowest_hz * (time_s - time_s[0]))
        by_meter = np.einsum("ni,n->i", functional[0] * setup.signal, wave)
        variance += 2.0 / (k * np.log(10.0)) * np.sum((0.3e-6 * by_meter) ** 2)
    parts = parts_of(source, setup, functional)
    assert np.sum(parts**2) == pytest.approx(variance, rel=1e-9)


def test_a_correlation_time_is_more_than_nothing(tmp_path):
    never = {"limit": "0.5 K", "distribution": "rectangular", "correlation_time": "0 s"}
    with pytest.raises(FileMistakes, match=r"correlation_time: state a value above 0"):
        edited(tmp_path, uncertainty={"temperature": never})


def test_a_supply_that_stays_in_closed_form(tmp_path):
    """K goes with the scale and U0 with the bias, and a turn-on with the bias alone."""
    found = by_name(fed(tmp_path))
    source = found["supply_voltage[p15]"]
    u = make_budget(paper_setup(), [source], "closed-form").combined.u
    scale, bias = source.factors["scale"] * source.u, source.factors["bias"] * source.u
    assert u[COEFFICIENTS.index("Kxz")] == pytest.approx(scale * abs(K[0, 2]), rel=1e-6)
    assert u[COEFFICIENTS.index("U0x")] == pytest.approx(bias * abs(K[0, 0]), rel=1e-3)
    u = make_budget(paper_setup(), [found["turn_on"]], "closed-form").combined.u
    assert u[COEFFICIENTS.index("U0y")] == pytest.approx(20e-6 * abs(K[1, 1]), rel=1e-9)
    assert u[COEFFICIENTS.index("Kyy")] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(("coefficient", "part"), [("Kxx", 0.7071), ("Kyy", 0.75), ("Kzz", 0.75)])
def test_a_cubic_term_leaks_into_the_scale_factors(coefficient, part):
    """a_x^3 gives 0.7071 K3 to Kxx by (7), a_y^3 and a_z^3 give 0.75 K3."""
    source = by_name(SHIPPED)["K3"]
    found = make_budget(paper_setup(), [source], "closed-form").combined.u
    i = COEFFICIENTS.index(coefficient)
    assert found[i] == pytest.approx(part * source.u * abs(TRUTH[i]), rel=1e-4)


def test_mounting_roll_costs_what_it_is_known_to_cost():
    """90 arcsec in installation 1 put 934 µV/g into Kyz, in 2 into Kzy; no estimator sees it."""
    roll = stand_source("mounting_roll", Distribution(90 * ARCSEC))
    for estimator in ("closed-form", "gls"):
        found = make_budget(paper_setup(), [*stand(), roll], estimator).contribution("mounting_roll")
        assert 1e6 * found.u[COEFFICIENTS.index("Kyz")] == pytest.approx(934, rel=0.01)
        assert 1e6 * found.u[COEFFICIENTS.index("Kzy")] == pytest.approx(934, rel=0.01)


def test_effects_of_a_model_are_sources_and_replace_the_prior_of_their_channels():
    known = AppliedEffect(
        CATALOGUE["quadratic_nonlinearity"],
        {"K2": np.array([60e-6, 0, 0])},
        ("x",),
        {"K2": np.array([4e-6, 0, 0])},
    )
    setup = paper_setup(effects=[known])
    found = by_name(SHIPPED, setup)
    assert found["K2"].channels == ("y", "z")
    source = found["quadratic_nonlinearity.K2[x]"]
    assert (source.u, source.prior, source.shown) == (pytest.approx(4e-6), False, "4 ug/g^2")
    # (7): level of x at 0 and 180 degrees sees a_x = 0, so nothing; least squares spreads it on U0x
    closed = make_budget(setup, [source], "closed-form").combined.u
    assert np.max(closed) < 1e-3 * 4e-6 * abs(K[0, 0])
    plain = make_budget(setup, [source], "least-squares").combined.u
    assert plain[COEFFICIENTS.index("U0x")] > 0.3 * 4e-6 * abs(K[0, 0])


def test_an_effect_without_u_has_the_plausible_size_and_says_so():
    known = AppliedEffect(CATALOGUE["quadratic_nonlinearity"], {"K2": np.full(3, 60e-6)})
    source = by_name(SHIPPED, paper_setup(effects=[known]))["quadratic_nonlinearity.K2[y]"]
    assert source.prior
    assert "states no u" in source.origin
    assert source.u == pytest.approx(CATALOGUE["quadratic_nonlinearity"].parameters[0].plausible)


def test_effective_dof_of_a_source_that_dominates():
    """Kyx of the closed form is alpha3 almost alone: its ten degrees of freedom, more by what else there is."""
    budget = make_budget(paper_setup(), stand(dof={"mounting_error": 10}), "closed-form")
    kyx = COEFFICIENTS.index("Kyx")
    share = (budget.contribution("mounting_error").u[kyx] / budget.combined.u[kyx]) ** 2
    assert budget.combined.dof[kyx] == pytest.approx(10 / share**2)
    assert 10 < budget.combined.dof[kyx] < 11
    assert np.isinf(budget.combined.dof[COEFFICIENTS.index("Kxy")])
    assert 2.25 < coverage_factor(budget.combined.dof[kyx]) < 2.28  # t for 10 degrees of freedom: 2.28


def test_gls_weighs_by_what_is_stated():
    """A bench that states a tenth of its mounting error makes GLS worse than one that states it right."""
    setup = paper_setup()
    believed = {"axis_tilt": 5 * ARCSEC, "zero_offset": 5 * ARCSEC, "mounting_error": 9 * ARCSEC,
                "setting_error": 10 * ARCSEC, "voltmeter_error": 3e-4}  # fmt: skip
    right = make_budget(setup, stand()).combined.u
    wrong = make_budget(setup, stand(), stated=believed).combined.u
    assert wrong[COEFFICIENTS.index("Kyx")] > 1.5 * right[COEFFICIENTS.index("Kyx")]


def test_unknown_estimator_and_too_few_orientations_are_refused():
    with pytest.raises(CalibrationError, match="choose from gls, closed-form, least-squares"):
        make_budget(paper_setup(), stand(), "kalman")
    with pytest.raises(CalibrationError, match="every test point; missing"):
        make_budget(paper_setup(points=8), stand(), "closed-form")


def test_neighbours_of_a_fine_sweep_are_not_one_orientation():
    """At steps of 0.25°, next forces differ by 4.4 mg; all as one would make u of K by linearity zero."""
    angle = np.radians(np.repeat(np.arange(0.0, 360.0, 0.25), 2))
    force = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], axis=1)
    points = np.arange(1, len(angle) + 1)
    rows = make_readings(["1"] * len(angle), [1] * len(angle), points, angle, force)
    found = MeasuredReadings(rows, Block(np.eye(3), np.zeros(3)), (0, 1, 2), force).orientation
    assert np.array_equal(found[::2], found[1::2])
    assert np.max(np.bincount(found)) <= 8
