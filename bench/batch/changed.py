"""What changed between two calibrations of the same readings: in units of the u that was stated."""

from __future__ import annotations

import numpy as np

from bench.base.arrays import Floats
from bench.batch.columns import Row
from bench.batch.stored import Found
from bench.model.block import COEFFICIENTS


def changes(before: Found | None, now: Found) -> Row:
    """Return the columns of what was, what is and what changed; without a result before, of what is alone.

    Readings are the same, so that the change is no deviation by chance: it is in units of the u that was stated,
    of what had none (fixed by convention) in units of the u that it has now. Where neither has one it is zero
    or unknown, and results in different units of the signals are not compared.
    """
    row: Row = {**_columns(now, ""), **({} if before is None else _columns(before, "_stored"))}
    if before is None:
        return row
    row["fit_differs"] = before.fit != now.fit
    if before.unit != now.unit:
        return row
    change = change_in_u(before, now)
    row |= {f"{name}_change_in_u": _known(x) for name, x in zip(COEFFICIENTS, change, strict=True)}
    if not np.all(np.isnan(change)):
        largest = int(np.nanargmax(np.abs(change)))
        row |= {
            "largest_change_in_u": abs(float(change[largest])),
            "largest_change_of": COEFFICIENTS[largest],
        }
    both = (before.u > 0) & (now.u > 0)
    if np.any(both):
        ratio = now.u[both] / before.u[both]
        row |= {"least_u_ratio": float(ratio.min()), "most_u_ratio": float(ratio.max())}
    return row


def change_in_u(before: Found, now: Found) -> Floats:
    """Return how far each coefficient went, (12,), in units of its u; NaN where it went and has none."""
    moved = now.values - before.values
    unit = np.where(before.u > 0, before.u, now.u)
    with np.errstate(divide="ignore", invalid="ignore"):
        change: Floats = np.where(unit > 0, moved / unit, np.where(moved == 0, 0.0, np.nan))
    return change


def _columns(found: Found, suffix: str) -> Row:
    return {
        f"estimator{suffix}": found.estimator,
        f"model{suffix}": found.model,
        f"signal_unit{suffix}": found.unit,
        f"g{suffix}_m_s2": found.g_m_s2,
        f"fit{suffix}": found.fit,
        f"p{suffix}": found.p,
        **{f"{name}{suffix}": x for name, x in zip(COEFFICIENTS, found.values.tolist(), strict=True)},
        **{f"u_{name}{suffix}": x for name, x in zip(COEFFICIENTS, found.u.tolist(), strict=True)},
    }


def _known(x: float) -> float | None:
    return None if np.isnan(x) else float(x)
