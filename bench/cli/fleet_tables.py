"""Tables of `bench fleet`, for a person."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from bench.base.arrays import u_of
from bench.base.numbers import MINUS, fixed, places, quantity
from bench.cli import printing
from bench.model.geometry import COEFFICIENTS

if TYPE_CHECKING:
    from rich.console import Console

    from bench.catalogue.values import Compared
    from bench.history.bench_or_block import BenchOrBlock
    from bench.history.capability import Capability
    from bench.history.drift import UnitDrift
    from bench.history.prior import Prior

MOST_SHOWN: Final = 12
"""Benches or units that are named in a terminal; the JSON has all."""


def effects(found: BenchOrBlock, out: Console) -> None:
    """Print sizes of what units, benches and time bring, and who stands out."""
    c = found.counts
    out.print(
        f"{c['calibrations']} calibrations of {c['units']} units ({c['types']} types) on {c['benches']} benches; "
        f"{c['units_on_several_benches']} units measured on several"
    )
    shown = printing.table(
        "coefficient",
        ">units differ",
        ">benches differ",
        ">at most",
        ">p, all looks",
        ">excess",
        ">p",
        ">stated u",
        "",
    )
    for name, s in zip(COEFFICIENTS, found.sizes, strict=True):
        sizes = (s.unit.value, s.bench.value, s.bench.most)
        shown.add_row(
            name, *(quantity(size, found.signal) for size in sizes), f"{s.bench.p_all_looks:.2g}",
            quantity(s.excess.value, found.signal), f"{s.excess.p_all_looks:.2g}",
            quantity(s.stated, found.signal), "BENCHES DIFFER" if s.bench.shown else "",
        )  # fmt: skip
    out.print(shown)
    for what, apart in (("bench", found.benches_apart), ("unit", found.units_apart)):
        for one in apart[:MOST_SHOWN]:
            size = quantity(abs(one.effect), found.signal)
            sign = MINUS if one.effect < 0 else "+"
            u = quantity(one.u, found.signal)
            out.print(f"{what} {one.name} stands out in {one.coefficient}: {sign}{size}, u {u}")
        if len(apart) > MOST_SHOWN:
            out.print(f"… and {len(apart) - MOST_SHOWN} more, in the JSON")


def compared(found: Compared, out: Console) -> None:
    """Print consistency and the worst bench of each coefficient."""
    out.print(
        f"{len(found.benches)} benches on {len(found.units)} common units, {found.calibrations} calibrations; "
        "d = bench less reference, U with k=2"
    )
    if found.alone:
        out.print(f"not compared, no unit joins them: {', '.join(found.alone)}")
    shown = printing.table(
        "coefficient", ">chi2", ">dof", ">Birge", ">dark", "reference", ">worst bench", ">d", ">U", ">E_n"
    )
    for name, one in zip(COEFFICIENTS, found.found, strict=True):
        worst = int(one.en.argmax())
        d = float(one.degree[worst])
        shown.add_row(
            name, f"{one.chi2:.1f}", str(one.dof), f"{one.birge:.2f}", quantity(one.dark, found.signal), one.method,
            found.benches[worst], (MINUS if d < 0 else "+") + quantity(abs(d), found.signal),
            quantity(2 * float(one.u_degree[worst]), found.signal), f"{one.en[worst]:.2f}",
        )  # fmt: skip
    out.print(shown)


def together(found: Compared, out: Console) -> None:
    """Print which benches, and pairs of them, differ in all twelve coefficients taken together."""
    benches = [(name, one) for name, one in zip(found.benches, found.together, strict=True) if one.apart]
    pairs = [
        (f"{found.benches[pair.first]} and {found.benches[pair.second]}", one)
        for pair, one in zip(found.pairs[0], found.pairs_together, strict=True)
        if one.apart
    ]
    told = sorted([*benches, *pairs], key=lambda row: row[1].p_all_looks)
    for name, one in told[:MOST_SHOWN]:
        out.print(
            f"all twelve together, {name}: chi2 {one.chi2:.1f} for {one.dof}, p {one.p_all_looks:.2g} in all looks"
        )
    if not told:
        out.print("all twelve together: no bench and no pair differs beyond its covariance (5 %, all looks)")


def prior(found: Prior, out: Console) -> None:
    """Print what a further unit of a type is expected to be."""
    out.print(
        f"type {found.kind}: {len(found.units)} units, {found.calibrations} calibrations on {len(found.benches)} "
        f"benches; {found.dof} degrees of freedom, correlations shrunk by {100 * found.shrunk:.0f} %"
    )
    shown = printing.table(
        "coefficient", ">mean", ">u of a further unit", ">units differ by", ">u of the mean"
    )
    for row in zip(
        COEFFICIENTS, found.mean, u_of(found.covariance), found.between, found.mean_u, strict=True
    ):
        name, *sizes = row
        digits = places(float(sizes[1]))
        shown.add_row(name, *(fixed(float(size), digits) for size in sizes))
    out.print(shown)


def drift(found: UnitDrift, expected: Sequence[Any] | None, at: str | None, out: Console) -> None:
    """Print rates, scatter and walk, and what is expected at a date."""
    headings = [
        "coefficient",
        ">per year",
        ">u",
        ">p, all looks",
        ">scatter",
        ">at most",
        ">walk in a year",
        ">at most",
        "",
    ]
    if expected is not None:
        headings += [f">at {at}", ">u"]
    shown = printing.table(*headings)
    for k, name in enumerate(COEFFICIENTS):
        digits = places(float(found.u_rate[k]))
        sizes = (found.between[k], found.between_most[k], found.walk[k], found.walk_most[k])
        row = [name, fixed(found.rate[k], digits, sign=True), fixed(found.u_rate[k], digits)]
        row += [f"{found.p_all_looks[k]:.2g}", *(fixed(size, digits) for size in sizes)]
        row.append("DRIFTS" if found.shown[k] else "")
        if expected is not None:
            value, u = expected[0][k], expected[1][k]
            row += [fixed(value, places(float(u))), fixed(u, places(float(u)))]
        shown.add_row(*row)
    out.print(shown)


def capability(found: Capability, out: Console) -> None:
    """Print the statement of capability."""
    c = found.counts
    out.print(
        f"{'SIMULATED: ' if found.simulated else ''}calibration and measurement capability: coefficients of "
        "triaxial accelerometer blocks by gravity, U with k=2"
    )
    out.print(
        f"from {c['calibrations']} calibrations of {c['units']} units on {len(c['benches'])} benches, {c['first']} "
        f"to {c['last']}; stated u that {100 * found.quantile:.0f} % of them reach, with what it has not in it"
    )
    shown = printing.table(
        "coefficient", ">U (k=2)", ">stated u", ">scatter over time", ">at most", ">between benches", ">state less",
        "",
    )  # fmt: skip
    for k, name in enumerate(COEFFICIENTS):
        per = "" if name.startswith("U0") else "/g"
        between = float(found.bench[k])
        shown.add_row(
            name, quantity(float(found.U[k]), found.signal) + per, quantity(float(found.stated[k]), found.signal),
            quantity(float(found.scatter[k]), found.signal), quantity(found.apart[k].scatter_most, found.signal),
            "–" if math.isnan(between) else quantity(between, found.signal), f"{found.below[k]:.0f}",
            "units drift" if found.apart[k].shown else "",
        )  # fmt: skip
    out.print(shown)
