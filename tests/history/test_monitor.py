"""Monitors of two and four positions: closed forms of their numbers, false alarms, and what they find."""

import io
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from rich.console import Console

from bench.calibration.result import CalibrationError
from bench.history.monitor_chart import monitor_chart, monitor_run
from bench.results.monitor import monitor_result, print_monitor
from bench.services.history import check_run
from bench.services.source import Request, load_sources
from bench.validation.paper_bench import U0, K, specific_force

BEGAN = datetime(2026, 3, 1, tzinfo=UTC)
NOISE_V = 2e-5


def run(rng, day, degrees=(0, 90, 180, 270), bias_v=0.0, head_rad=0.0):
    phi = np.radians(np.tile(degrees, 2)) + head_rad
    signal = specific_force(["1"] * len(phi), phi) @ K.T + U0 + bias_v
    signal = signal + rng.normal(0.0, NOISE_V, signal.shape)
    nominal = specific_force(["1"] * len(phi), phi - head_rad)
    return monitor_run(f"day {day}", BEGAN + timedelta(days=day), signal, nominal)


def test_two_positions_give_half_sum_and_half_difference():
    quiet = np.random.default_rng(1)
    one = run(quiet, 0, (90, 270))
    assert one.names == ("bx", "Sx")
    assert one.value == pytest.approx([U0[0] / abs(K[0, 0]), abs(K[0, 0])], abs=1e-4)
    assert one.value[1] * one.value[0] == pytest.approx(U0[0], abs=4 * NOISE_V)


def test_an_error_of_the_heads_zero_changes_no_number_of_four_positions():
    here, turned = (run(np.random.default_rng(2), 0, head_rad=r) for r in (0.0, 1e-3))
    assert here.names == ("bx", "Sx", "bz", "Sz", "theta_xz")
    assert np.all(np.abs(turned.value - here.value) < 6 * np.sqrt(np.diag(here.covariance)))
    rows = K[[0, 2]][:, [0, 2]]
    angle = np.degrees(np.arccos(rows[0] @ rows[1] / np.prod(np.linalg.norm(rows, axis=1))))
    assert here.value[4] == pytest.approx(angle, abs=6 * here.covariance[4, 4] ** 0.5)


@pytest.mark.slow
def test_u_is_the_scatter_between_runs():
    """Seed 3, 400 runs: standard deviation over stated u within 4 sqrt(1/800)."""
    rng = np.random.default_rng(3)
    runs = [run(rng, day) for day in range(400)]
    stated = np.sqrt(np.mean([np.diag(one.covariance) for one in runs], axis=0))
    ratio = np.std([one.value for one in runs], axis=0, ddof=1) / stated
    assert ratio == pytest.approx(1.0, abs=4 / np.sqrt(800))


@pytest.mark.slow
def test_u_knows_an_error_of_settings_from_noise():
    """Seed 7, 200 runs of 1 µV and 3.3″: a setting scatters the angle and the biases, not the scale factors."""
    rng = np.random.default_rng(7)
    runs = []
    for day in range(200):
        phi = np.radians(np.tile((0, 90, 180, 270), 4))
        nominal = specific_force(["1"] * 16, phi)
        signal = specific_force(["1"] * 16, phi + rng.normal(0.0, 1.6e-5, 16)) @ K.T + U0
        signal += rng.normal(0.0, 1e-6, signal.shape)
        runs.append(monitor_run(f"day {day}", BEGAN + timedelta(days=day), signal, nominal))
    stated = np.sqrt(np.mean([np.diag(one.covariance) for one in runs], axis=0))
    ratio = np.std([one.value for one in runs], axis=0, ddof=1) / stated
    assert ratio == pytest.approx(1.0, abs=4 / np.sqrt(400))
    chart = monitor_chart(runs[:60], 5)
    assert sum(not verdict.accepted for verdict in chart.verdicts) <= 2


def test_positions_that_are_never_repeated_have_the_scatter_of_the_residuals():
    phi = np.radians(np.arange(0, 360, 45))
    force = specific_force(["1"] * 8, phi)
    signal = force @ K.T + U0 + np.random.default_rng(8).normal(0.0, NOISE_V, (8, 3))
    one = monitor_run("once", BEGAN, signal, force)
    assert one.s_dof == pytest.approx(10.0)
    assert one.s == pytest.approx(NOISE_V, rel=0.5)


def test_a_shift_is_found_and_quiet_days_are_not():
    rng = np.random.default_rng(4)
    quiet = [run(rng, day) for day in range(25)]
    chart = monitor_chart(quiet, 8)
    assert sum(not verdict.accepted for verdict in chart.verdicts) <= 1
    shifted = monitor_chart([*quiet, run(rng, 25, bias_v=15 * NOISE_V)], 8)
    assert not shifted.in_control
    assert "bx" in " ".join(shifted.verdicts[-1].reasons)


def test_what_is_no_monitor_is_refused():
    with pytest.raises(CalibrationError, match="one or two axes up and down, twice"):
        run(np.random.default_rng(5), 0, (0, 45))
    runs = [run(np.random.default_rng(6), 0), run(np.random.default_rng(6), 1, (90, 270))]
    with pytest.raises(CalibrationError, match="different axes"):
        monitor_chart(runs)


@pytest.mark.parametrize(("label", "taken"), [("1", True), ("F", False)])
def test_rows_without_an_orientation_are_no_part_of_a_monitor(tmp_path, label, taken):
    """A short of the inputs between the positions counts for nothing; free positions alone are refused."""
    phi = np.radians(np.tile((0, 90, 180, 270), 2))
    signal = specific_force(["1"] * 8, phi) @ K.T + U0 + np.random.default_rng(5).normal(0.0, NOISE_V, (8, 3))
    lines = ["installation,pass,point,angle_deg,ux_v,uy_v,uz_v", "S,1,1,,0,0,0"]
    for row, (angle, volts) in enumerate(zip(np.degrees(phi), signal, strict=True)):
        at = f"{angle}" if taken else ""
        lines.append(f"{label},{1 + row // 4},{1 + row % 4},{at}," + ",".join(map(str, volts)))
    (tmp_path / "one.csv").write_text("\n".join(lines))
    (source,) = load_sources(Request([str(tmp_path / "one.csv")], tmp_path))
    if taken:
        assert check_run(source).names == ("bx", "Sx", "bz", "Sz", "theta_xz")
    else:
        with pytest.raises(CalibrationError, match="run monitor-2"):
            check_run(source)


def test_too_few_runs_for_limits_are_refused_in_a_sentence():
    rng = np.random.default_rng(7)
    with pytest.raises(CalibrationError, match=r"^2 runs are too few to set the limits; name 3 runs or more"):
        monitor_chart([run(rng, day) for day in range(2)])


def test_the_unit_of_the_signals_is_printed():
    rng, out = np.random.default_rng(8), io.StringIO()
    result = monitor_result(monitor_chart([run(rng, day) for day in range(4)], 3), "m/s^2")
    print_monitor(result, Console(file=out, width=200))
    assert "Sx / (m/s²)/g" in out.getvalue()
    assert "V/g" not in out.getvalue()
