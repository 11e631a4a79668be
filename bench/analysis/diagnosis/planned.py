"""Readings that a procedure would give, as a table like any other: what a run would tell is known before it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bench.base.arrays import Floats
from bench.model import Block, Conditions, ForwardModel
from bench.procedure.plan import Plan, Read, SelectInput, SetTemperature
from bench.readings.joined import JoinedPart, together
from bench.readings.table import REFERENCE, REFERENCE_V, SHORTED, UNORIENTED, Readings, make_readings


def planned_readings(
    plan: Plan,
    model: ForwardModel,
    block: Block,
    *,
    temperature_c: float = float("nan"),
    line_hz: float = 50.0,
    unit: str = "V",
) -> Readings:
    """Return the readings that a plan would give on a stand without errors, in the order of measurement.

    Times are those of the plan's estimate; `temperature_c` holds until the plan sets another.
    The signals are those of `block` in `model`, in its unit, at the planned angles. Raises `KeyError` for an
    installation that the model lacks.
    """
    reads: list[Read] = []
    time_s: list[float] = []
    warmth: list[float] = []
    volts: list[float] = []
    now_s, now_v = 0.0, float("nan")
    for step in plan.steps:
        match step:
            case Read():
                reads.append(step)
                time_s.append(now_s)
                warmth.append(temperature_c)
                volts.append(now_v)
            case SetTemperature():
                temperature_c = step.target_c
            case SelectInput():
                now_v = {"signal": float("nan"), "short": 0.0}.get(step.source, step.reference_v or 0.0)
        now_s += plan.step_duration_s(step, line_hz)
    angle_rad = np.array([np.nan if r.target_rad is None else r.target_rad for r in reads])
    table = make_readings(
        [r.installation for r in reads],
        [r.pass_number for r in reads],
        [r.point for r in reads],
        angle_rad,
        np.zeros((len(reads), 3)),
        source=plan.name,
        unit=unit,
        target_rad=angle_rad,
        series=[r.series for r in reads],
        direction=[r.direction or 0 for r in reads],
        time_s=np.array(time_s),
        temperature_c=np.array(warmth),
        samples=[r.samples for r in reads],
        scan_order=[r.scan for r in reads] if any(r.scan for r in reads) else None,
    )
    if any(label == REFERENCE for label in table.installation):
        stated = ["" if r.installation != REFERENCE else repr(v) for r, v in zip(reads, volts, strict=True)]
        table = replace(table, extra={**table.extra, REFERENCE_V: np.array(stated, dtype=np.str_)})
    return replace(table, signal=_signals(table, model, block, np.array(volts)))


def _signals(table: Readings, model: ForwardModel, block: Block, volts: Floats) -> Floats:
    first = next(iter(model.installations))
    inputs = np.isin(table.installation, [SHORTED, REFERENCE])
    placed = replace(
        table,
        installation=np.where(inputs, first, table.installation),
        angle_rad=np.where(np.isfinite(table.angle_rad), table.angle_rad, 0.0),
    )
    conditions: Conditions = placed.conditions()
    force = replace(model, effects=()).specific_force(
        conditions, np.zeros((len(conditions.mounts), 5)), block
    )
    return np.where(inputs[:, None], volts[:, None], block.output(force))


def following(first: Readings, plan: Plan, model: ForwardModel, block: Block, line_hz: float) -> Readings:
    """Return the readings `first` together with those of a plan that is carried out after them.

    The temperature stays as it was last.
    """
    known = first.temperature_c[np.isfinite(first.temperature_c)]
    warmth = float(known[-1]) if len(known) else float("nan")
    planned = planned_readings(plan, model, block, temperature_c=warmth, line_hz=line_hz, unit=first.unit)
    both = together([JoinedPart(first), JoinedPart(planned)])
    # after a run the clock goes on: what is settled by then stays so
    return both if first.began_s is not None else replace(both, began_s=None)


def reads_inputs(plan: Plan) -> bool:
    """Whether a plan reads a shorted or a reference input, which is in volts."""
    return any(isinstance(s, Read) and s.installation in UNORIENTED for s in plan.steps)
