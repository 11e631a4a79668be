"""The result of a control chart as JSON has it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from bench.base.arrays import Floats
from bench.base.numbers import finite_or_none
from bench.model.block import COEFFICIENTS

if TYPE_CHECKING:
    from bench.analysis.control_charts.chart import ControlChart


def chart_json(chart: ControlChart) -> dict[str, Any]:
    """Return the promised form: deviations and u in unit/g and unit, `z` in u, NaN and infinity as null."""
    centre, design = chart.centre, chart.design
    last = chart.verdicts[-1] if chart.verdicts else None
    return {
        "design": {
            "arl": design.arl,
            "arl_of_each": design.each_arl,
            "smoothing": design.smoothing,
            "limits_from": design.basis,
        },
        "baseline": [run.name for run in chart.baseline],
        "reference": None if chart.reference is None else chart.reference.name,
        "centre": _by_name(centre.value, np.sqrt(np.diag(centre.covariance) * centre.scale)),
        "scale": float(np.sqrt(centre.scale)),
        "dof": finite_or_none(centre.dof),
        "limits": {
            "t2": chart.limit_t2,
            "ewma_t2": chart.limit_ewma,
            "single": chart.limit_single,
            "single_ewma": chart.limit_single_ewma,
        },
        "runs": [_run_json(chart, row) for row in range(len(chart.later))],
        "components": _components_json(chart),
        "drift": _drift_json(chart),
        "baseline_alone_p": None if chart.alone is None else chart.alone.tolist(),
        "in_control": chart.in_control,
        "last": None if last is None else last.run,
        "notes": list(chart.notes),
    }


def _run_json(chart: ControlChart, row: int) -> dict[str, Any]:
    verdict, run, short = chart.verdicts[row], chart.later[row], chart.short
    return {
        "run": verdict.run,
        "when": verdict.when.isoformat(),
        "accepted": verdict.accepted,
        "reasons": list(verdict.reasons),
        "t2": float(chart.shewhart.t2[row]),
        "p": float(chart.shewhart.p_joint[row]),
        "ewma_t2": finite_or_none(float(chart.ewma.t2[row])),
        "ewma_p": finite_or_none(float(chart.ewma.p_joint[row])),
        "short_term": {
            "s": run.s,
            "dof": run.s_dof,
            "f": None if short is None else float(short.f[row]),
            "p": None if short is None else float(short.p[row]),
        },
        "coefficients": {
            name: {
                "deviation": float(chart.shewhart.deviation[row, k]),
                "u": float(chart.shewhart.u[row, k]),
                "z": float(chart.shewhart.z[row, k]),
                "ewma": finite_or_none(float(chart.ewma.deviation[row, k])),
                "ewma_u": finite_or_none(float(chart.ewma.u[row, k])),
                "ewma_z": finite_or_none(float(chart.ewma.z[row, k])),
            }
            for k, name in enumerate(COEFFICIENTS)
        },
    }


def _components_json(chart: ControlChart) -> dict[str, Any] | None:
    found = chart.components
    if found is None:
        return None
    columns = {
        "noise": found.noise,
        "stated": found.stated,
        "scatter": found.scatter,
        "f": found.f,
        "p": found.p,
        "between": found.between,
        "between_most": found.between_most,
    }
    return {
        "coefficients": {
            name: {title: float(column[k]) for title, column in columns.items()}
            for k, name in enumerate(COEFFICIENTS)
        },
        "runs": found.runs,
        "birge": float(np.sqrt(found.birge2)),
        "birge_dof": found.birge_dof,
        "birge_p": found.birge_p,
        "alike_p": found.alike_p,
        "short_term": None
        if chart.short is None
        else {"s": chart.short.pooled, "dof": chart.short.pooled_dof},
    }


def _drift_json(chart: ControlChart) -> dict[str, Any] | None:
    if chart.drift is None:
        return None
    rows = zip(COEFFICIENTS, chart.drift.per_year, chart.drift.u, chart.drift.p, strict=True)
    return {name: {"per_year": float(value), "u": float(u), "p": float(p)} for name, value, u, p in rows}


def _by_name(values: Floats, u: Floats) -> dict[str, dict[str, float]]:
    rows = zip(COEFFICIENTS, values.tolist(), u.tolist(), strict=True)
    return {name: {"value": value, "u": own} for name, value, own in rows}
