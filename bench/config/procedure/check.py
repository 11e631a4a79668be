"""Checks of a plan against a bench before anything moves; the work and disk space that the plan needs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from bench.base.arrays import HOUR, Floats
from bench.base.languages import message
from bench.base.text import APPROACH, duration
from bench.config.bench_file.file import BenchFile
from bench.config.devices.registry import UnknownVoltmeter
from bench.config.procedure.plan import (
    SWITCHED_ON,
    Ask,
    Level,
    Mount,
    Plan,
    Power,
    Read,
    SelectInput,
    SetTemperature,
    Settle,
    Turn,
)
from bench.config.procedure.steps import in_scan_order, read_order
from bench.model.geometry import COEFFICIENTS, hidden_axes
from bench.readings.table import UNORIENTED, VERIFICATION

ROUNDING_RAD: Final = 1e-9

_DAY: Final = 24 * HOUR
LONGEST_S: Final = 366 * _DAY
"""A plan that may take longer is rejected as a typing error."""

_BYTES_OF_REPORT: Final = 1_500_000
_BYTES_OF_STEP: Final = 800
_BYTES_OF_READING: Final = 800
_BYTES_OF_SAMPLE: Final = 40
"""Sizes in bytes of a report, a step, a reading, and a sample of three channels; from dry runs, rounded up."""


def check(plan: Plan, bench: BenchFile, *, dry_run: bool = False) -> list[str]:
    """Return every reason why a plan cannot be carried out on a bench, one sentence each.

    A dry run cannot answer a prompt without a default; such a prompt is then a reason, too.
    """
    return [*_installation_problems(plan, bench), *_reading_problems(plan, bench), *_scan_problems(plan, bench),
            *_turn_problems(plan, bench), *_signal_problems(plan, bench), *_temperature_problems(plan, bench),
            *_settling_problems(plan, bench), *_level_problems(plan, bench), *_time_problems(plan),
            *_power_problems(plan, bench),
            *(prompts_without_default(plan) if dry_run else ())]  # fmt: skip


def _time_problems(plan: Plan) -> Iterator[str]:
    if not plan.longest_duration_s() < LONGEST_S:
        yield message(
            f"the procedure may take more than {LONGEST_S / _DAY:.0f} days: check its times and counts"
        )


def _installation_problems(plan: Plan, bench: BenchFile) -> Iterator[str]:
    known = bench.installation_models()
    first = {step.installation: step.key for step in reversed(plan.steps) if isinstance(step, Mount)}
    for label, key in reversed(first.items()):
        if label not in known:
            listed = ", ".join(known)
            yield message(
                f"step {key}: the bench file has no installation {label} (it has {listed}); add it there"
            )


def _reading_problems(plan: Plan, bench: BenchFile) -> Iterator[str]:
    if any(isinstance(meter, UnknownVoltmeter) for meter in bench.instruments.voltmeters):
        return  # in a recorded run, drivers may be missing
    nplc: dict[float, str] = {}
    samples: dict[int, str] = {}
    for step in plan.steps:
        if isinstance(step, Read):
            nplc.setdefault(step.nplc, step.key)
            samples.setdefault(step.samples, step.key)
    for value, key in nplc.items():
        if value not in bench.nplc_supported:
            listed = ", ".join(f"{n:g}" for n in bench.nplc_supported)
            yield message(
                f"step {key}: the voltmeters cannot integrate over {value:g} NPLC; choose from {listed}"
            )
    for count, key in samples.items():
        if count > bench.most_samples:
            yield message(
                f"step {key}: {count} samples exceed the {bench.most_samples} that a voltmeter stores"
            )
        elif count < bench.least_samples:
            yield message(
                f"step {key}: {count} samples are fewer than the {bench.least_samples} that a voltmeter needs"
            )


def _level_problems(plan: Plan, bench: BenchFile) -> Iterator[str]:
    """For a plan with levelling, check that the bench has a level and that its head may go to 0°."""
    first = next((step for step in plan.steps if isinstance(step, Level)), None)
    if first is None:
        return
    if bench.instruments.level is None:
        yield message(
            f"step {first.key}: the procedure levels the platform, but the bench file has no level; add "
            "one under instruments, or remove 'level' in a copy of the procedure"
        )
    low_rad, high_rad = bench.head_limits_rad or (-bench.head_backoff_rad, 0.0)
    if low_rad > -bench.head_backoff_rad + ROUNDING_RAD or high_rad < -ROUNDING_RAD:
        yield message(
            f"step {first.key}: the level is read with the head at 0°, approached with rising angle, but "
            f"the limits of the head are {np.degrees(low_rad):g}° to {np.degrees(high_rad):g}°"
        )


def _scan_problems(plan: Plan, bench: BenchFile) -> Iterator[str]:
    """Check that the bench can follow the scan orders: a multiplexer reads channels in ascending order only."""
    scans = {step.scan: step.key for step in reversed(plan.steps) if isinstance(step, Read) and step.scan}
    for scan, key in reversed(scans.items()):
        order = read_order(in_scan_order(bench.instruments.voltmeters, scan))
        if order != scan:
            yield message(
                f"step {key}: the procedure reads the channels in the order {scan}, but this bench's "
                "multiplexer can only use "
                f"{order} alone; remove 'scans' in a copy of the procedure"
            )


def _turn_problems(plan: Plan, bench: BenchFile) -> Iterator[str]:
    """Check that each target, and the angle where a motorised head's approach to it begins, is within limits."""
    if bench.head_limits_rad is None:
        return
    low_rad, high_rad = bench.head_limits_rad
    looked_at: set[tuple[float, int]] = set()
    for step in plan.steps:
        if not isinstance(step, Turn) or (step.target_rad, step.direction) in looked_at:
            continue
        looked_at.add((step.target_rad, step.direction))
        start_rad = step.target_rad - step.direction * bench.head_backoff_rad
        lowest, highest = sorted((step.target_rad, start_rad))
        if lowest < low_rad - ROUNDING_RAD or highest > high_rad + ROUNDING_RAD:
            yield (
                f"step {step.key}: the head may go from {np.degrees(low_rad):g}° to {np.degrees(high_rad):g}°, but "
                f"{APPROACH[step.direction]} to {np.degrees(step.target_rad):g}° needs "
                f"{np.degrees(lowest):g}° to {np.degrees(highest):g}°"
            )


def _signal_problems(plan: Plan, bench: BenchFile) -> Iterator[str]:
    """Check reference voltages against the voltmeters' range, and accelerations against the block's range."""
    range_v = bench.voltmeter_range_v
    references = {s.reference_v: s.key for s in reversed(plan.steps) if isinstance(s, SelectInput)}
    for reference_v, key in reversed(references.items()):
        if reference_v is not None and abs(reference_v) > range_v:
            yield (
                f"step {key}: the reference of {reference_v:g} V exceeds the voltmeters' range of "
                f"{range_v:g} V; choose a smaller one"
            )
    largest_g = max((float(np.max(np.abs(f))) for f in orientations(plan, bench).values()), default=0.0)
    if largest_g > bench.unit_under_test.range:
        yield (
            message(
                f"the block is given {largest_g:.3g} g along an axis, but measures no more than "
                f"{bench.unit_under_test.range:g} g; change its range in the bench file or the angles"
            )
        )


def _temperature_problems(plan: Plan, bench: BenchFile) -> Iterator[str]:
    demands = {s.target_c: s.key for s in reversed(plan.steps) if isinstance(s, SetTemperature)}
    chamber = bench.instruments.chamber
    if demands and chamber is None:
        key = demands[next(reversed(demands))]
        yield message(
            f"step {key}: the procedure sets temperatures, but the bench file has no chamber; add one"
        )
    limits = {message("the block"): bench.unit_under_test.temperature} | (
        {message("the chamber"): chamber} if chamber else {}
    )
    for target_c, key in reversed(demands.items()):
        for what, allowed in limits.items():
            if not allowed.minimum <= target_c <= allowed.maximum:
                span = f"{allowed.minimum:g} to {allowed.maximum:g} °C"
                yield message(
                    f"step {key}: {target_c:g} °C exceeds the limits of {what}, {span}; change the temperature"
                )


def _settling_problems(plan: Plan, bench: BenchFile) -> Iterator[str]:
    first = next((s for s in plan.steps if isinstance(s, Settle) and s.what == "temperature"), None)
    chamber = bench.instruments.chamber
    if first is None:
        return
    if chamber is None:
        yield message(
            f"step {first.key}: the procedure waits for a temperature, but the bench file has no chamber; add one"
        )
    elif chamber.by_hand:
        yield (
            message(
                f"step {first.key}: the procedure waits for a temperature, but a person reads it; state "
                "a plain soak"
            )
        )


def switched_before(plan: Plan, bench: BenchFile) -> str | None:
    """Return the description of the power-on with which the run begins; None if the run begins without one."""
    supply = bench.unit_under_test.supply
    if supply is None or not plan.begins_on():
        return None
    warm = (
        duration(supply.warm_up)
        if isinstance(supply.warm_up, float)
        else f"until settled, {duration(supply.warm_up_s)} to {duration(supply.longest_warm_up_s)}"
    )
    return f"{SWITCHED_ON.describe()} ({warm})"


def _power_problems(plan: Plan, bench: BenchFile) -> Iterator[str]:
    """Check that a switched block has a supply, and that no signal is read while the block is off."""
    first = next((step for step in plan.steps if isinstance(step, Power)), None)
    if first is not None and bench.unit_under_test.supply is None:
        yield (
            message(
                f"step {first.key}: the block is switched, but the bench file does not say how it is "
                "supplied; state 'supply' under unit_under_test, and its power_supply under instruments"
            )
        )
    on, off_key, input_source = plan.begins_on(), "", "signal"
    for step in plan.steps:
        if isinstance(step, Power):
            on, off_key = step.switch != "off", step.key
        elif isinstance(step, SelectInput):
            input_source = step.source
        elif not on and input_source == "signal" and isinstance(step, Read | Settle):
            if isinstance(step, Settle) and step.what != "signals":
                continue
            since = f"step {off_key} has switched it off" if off_key else "nothing has switched it on"
            yield message(
                f"step {step.key}: the block is off here, {since}; switch it on before with 'power: on'"
            )
            return


def prompts_without_default(plan: Plan) -> Iterator[str]:
    """Yield a sentence for each prompt that a dry run cannot answer."""
    for step in plan.steps:
        if isinstance(step, Ask) and step.default is None:
            yield message(
                f"step {step.key}: the prompt '{step.text}' has no default, which a dry run needs; state one"
            )


# --- effort -----------------------------------------------------------------------------------------


def operator_actions(plan: Plan, bench: BenchFile) -> int:
    """Return the number of actions of the operator on this bench; motorised actions do not count.

    At each mounting, every thermometer that a person reads counts as one action. If the block has no thermometer,
    reading a chamber that a person sets counts as one.
    """
    chamber = bench.instruments.chamber
    turned = bench.instruments.head.turned_by_hand
    heated = chamber is not None and chamber.by_hand
    thermometer = bench.instruments.thermometer
    told = [heated if thermometer is None else thermometer.by_hand]
    told += [around.by_hand for around in bench.instruments.around.values()]
    level = bench.instruments.level
    by_bubble = level is not None and level.by_hand
    actions = 0
    for step in plan.steps:
        match step:
            case Mount():
                actions += 1 + sum(told)
            case Turn():
                actions += turned
            case SetTemperature():
                actions += heated
            case SelectInput() | Ask():
                actions += 1
            case Level():
                actions += step.settings * (turned + (4 if by_bubble else 2)) + (step.within_rad is not None)
    return actions


def largest_signal_v(plan: Plan, bench: BenchFile) -> float:
    """Return the largest signal, V, at the orientations of a plan, for nominal scale factors."""
    scale_v_g = np.array(bench.unit_under_test.scale_factors.values)
    return max(
        (float(np.max(np.abs(f * scale_v_g))) for f in orientations(plan, bench).values()), default=0.0
    )


def disk_needed_bytes(plan: Plan) -> int:
    """Return the approximate disk space of a run: plan and events, all samples, the report."""
    reads = [step for step in plan.steps if isinstance(step, Read)]
    samples = sum(step.samples for step in reads) + sum(
        int(step.timeout_s / step.interval_s) + 1 for step in plan.steps if isinstance(step, Settle)
    )
    return (
        _BYTES_OF_REPORT
        + _BYTES_OF_STEP * len(plan.steps)
        + _BYTES_OF_READING * len(reads)
        + _BYTES_OF_SAMPLE * samples
    )


# --- what a calibration can determine ----------------------------------------------------------------


def orientations(plan: Plan, bench: BenchFile) -> dict[float | None, Floats]:
    """Return the nominal specific forces, in g, of the readings that a calibration would use.

    The keys are the chamber temperatures that the plan sets (None before the first), the values are arrays (n, 3).
    Each orientation occurs once. Verification points and installations missing from the bench file are omitted.
    """
    turns = {
        label: known.block_from_platform
        for label, known in bench.installation_models().items()
        if label not in {VERIFICATION, *UNORIENTED}
    }
    found: dict[float | None, dict[tuple[str, float], Floats]] = {}
    at_c: float | None = None
    for step in plan.steps:
        if isinstance(step, SetTemperature):
            at_c = step.target_c
        elif isinstance(step, Read) and step.target_rad is not None and step.installation in turns:
            place = step.installation, step.target_rad
            forces = found.setdefault(at_c, {})
            if place not in forces:
                on_platform = np.array([np.sin(step.target_rad), 0.0, np.cos(step.target_rad)])
                forces[place] = turns[step.installation] @ on_platform
    return {temperature: np.array([*forces.values()]) for temperature, forces in found.items()}


def undetermined(force: Floats) -> tuple[str, ...]:
    """Return the coefficients that readings at these specific forces (n, 3) do not determine; () if none."""
    hidden = hidden_axes(force)
    return tuple(name for name in COEFFICIENTS if ("0" if name.startswith("U0") else name[-1]) in hidden)
