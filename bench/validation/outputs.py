"""What leaves the program: statements of conformity, and the numbers and units of exported files."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any, Final

import numpy as np
from openpyxl import load_workbook
from scipy import stats

from bench.base.arrays import CHANNELS
from bench.calibration.conformity import DecisionRule, MeasuredValues, probability_outside
from bench.exchange.forms import FORMS
from bench.exchange.result import BlockResult
from bench.model.geometry import COEFFICIENTS, Block
from bench.validation.paper_bench import U0, K
from bench.validation.reference import agreement
from bench.validation.registry import Context, Finding
from bench.validation.registry import check as enter

check = partial(enter, family="results given out")

DIODE_FAR_V: Final = 100.0
"""A limit on the other side, which the example does not have and this one does not reach."""
_SAID: Final = "pass, conditional pass, conditional fail, fail"


@check("conformity", "7.8.6", "", place="bench/calibration/conformity.py",
       source="JCGM 106:2012, 7.3, 7.4, 8.3.2; distributions of scipy.stats")  # fmt: skip
def conformity(context: Context) -> Iterator[Finding]:
    """Compute the conformance probabilities of two published examples, and the acceptance limits of the rules."""
    diode = 1.0 - probability_outside(DIODE_FAR_V - 0.07, 0.05, DIODE_FAR_V)
    yield agreement("diode, 1.4 u within one limit, printed 0.92", diode, 0.92, 0.005)
    oil = 1.0 - probability_outside(13.6 - 14.4, 1.8, 1.9)
    yield agreement("oil, viscosity within two limits, printed 0.66", oil, 0.66, 0.005)
    for dof in (np.inf, 5.0):
        of_u = stats.norm() if np.isinf(dof) else stats.t(dof)
        factor = of_u.ppf(stats.norm.cdf(2.0))
        known = MeasuredValues(np.ones(4), np.full(4, factor), np.full(4, dof))
        limit = 20.0
        for rule, expected in (
            (DecisionRule.of(None), limit - of_u.ppf(0.95)),
            (DecisionRule.of("guarded"), limit - factor),
            (DecisionRule.of("simple"), limit),
        ):
            words = "5 % risk" if rule.guard_band is None else rule.name
            found = rule.acceptance_limit(limit, known)
            yield agreement(f"acceptance limit, {words}, {dof:g} degrees of freedom", found, expected, 2e-3)
        guard = of_u.ppf(0.95)
        beside = np.array([at + side for at in (limit - guard, limit + guard) for side in (-0.01, 0.01)])
        said = ", ".join(DecisionRule.of(None).statements(beside, limit, known))
        yield Finding(said == _SAID, said, of=f"statements, {dof:g} degrees of freedom", expected=_SAID)


OF_K, OF_U0, OF_N = "V/g", "V", "g/V"
U: Final = 1e-6 * np.arange(1.0, 13.0)
"""The u of the twelve coefficients, all different, so that an exchange of two is noticed."""


def expected() -> dict[str, tuple[float, float | None, str]]:
    """Return value, U (None: not compared) and unit of each exported number of the paper's block, by name."""
    unit = [OF_K] * 9 + [OF_U0] * 3
    own = zip(COEFFICIENTS, [*K.ravel(), *U0], 2.0 * U, unit, strict=True)
    inverse = zip(COEFFICIENTS[:9], np.linalg.inv(K).ravel(), strict=True)
    return {
        **{name: (float(value), float(expanded), of) for name, value, expanded, of in own},
        **{f"N{name[1:]}": (float(value), None, OF_N) for name, value in inverse},
    }


def as_expected(of: str, rows: Iterable[tuple[Any, ...]]) -> Finding:
    """Return the finding on rows of name, value, U and unit of an exported file."""
    found = {str(name): (float(value), float(u), str(unit)) for name, value, u, unit in rows}
    wrong = []
    for name, (value, expanded, unit) in expected().items():
        mine = found.get(name, (np.nan, np.nan, "missing"))
        same = np.isclose(mine[0], value, rtol=1e-12, atol=0.0) and mine[2] == unit
        if not same or (expanded is not None and not np.isclose(mine[1], expanded, rtol=1e-12, atol=0.0)):
            wrong.append(f"{name} {mine[0]:.9g} {mine[2]}, U {mine[1]:.3g}")
    return Finding(not wrong, "; ".join(wrong[:3]) or f"{len(expected())} numbers", of=of)


@check("exports", "7.11.6", "values, U and units as given", place="bench/exchange",
       source="(11), its matrix inverted by numpy; readers of CSV, JSON and workbooks")  # fmt: skip
def exports(context: Context) -> Iterator[Finding]:
    """Export the paper's coefficients in each form, and read names, values, U and units back by separate code."""
    result = BlockResult(Block(K, U0), np.diag(U**2), "V", 9.80665, "validation")
    text = {name: FORMS[name].write(result, None) for name in ("csv", "json", "c", "excel")}
    rows = [row for row in csv.reader(io.StringIO(str(text["csv"]))) if len(row) == 5 and row[0][0] in "KNU"]
    yield as_expected("CSV", ((name, value, expanded, unit) for name, value, _, expanded, unit in rows))
    told = json.loads(text["json"])
    both = {**told["inverse"]["values"], **told["coefficients"]}
    yield as_expected("JSON", ((name, one["value"], one["U"], one["unit"]) for name, one in both.items()))
    book = load_workbook(io.BytesIO(bytes(text["excel"])))  # type: ignore[arg-type]
    cells = [
        row for sheet in ("inverse", "coefficients") for row in book[sheet].iter_rows(2, values_only=True)
    ]
    yield as_expected("workbook", ((row[0], row[1], row[3], row[4]) for row in cells if row[0]))
    for name, wanted in (("n", np.linalg.inv(K).ravel()), ("u0", U0)):
        body = re.search(rf"static const double coefficients_{name}\[[^=]*= (\{{[^;]*\}});", str(text["c"]))
        found = re.findall(r"-?\d[\d.e+-]*", body[1]) if body else [np.nan] * len(wanted)
        yield agreement(f"C header, {name}", np.array(found, float), wanted, 1e-12)
    yield from parameters()


PARAMETERS: Final = {
    "px4": ("CAL_ACC0_{}OFF", "CAL_ACC0_{}SCALE", r"{}\s+(\S+)"),
    "ardupilot": ("INS_ACCOFFS_{}", "INS_ACCSCAL_{}", r"{}[,\s]+(\S+)"),
}
"""For each autopilot, the names of an axis's offset and scale, and the pattern of a line of its file."""


def parameters() -> Iterator[Finding]:
    """Yield the findings on autopilots: with their parameters, an axis that points up must read 1 g in m/s²."""
    g, nominal = 9.80665, np.array([-2.0, -2.1, -2.2])
    own = np.diag(K)
    result = BlockResult(Block(np.diag(own), U0), np.diag(U**2), "V", g, "validation")
    for name, (offset, scale, line) in PARAMETERS.items():
        text = str(FORMS[name].write(result, nominal))

        def read(parameter: str, text: str = text, line: str = line) -> float:
            found = re.search(rf"(?m)^[^#\n]*{line.format(parameter)}", text)
            return float(found[1]) if found else np.nan

        bias, gain = (
            np.array([read(one.format(axis.upper())) for axis in CHANNELS]) for one in (offset, scale)
        )
        up, down = (((sign * own + U0) * g / nominal - bias) * gain for sign in (1.0, -1.0))
        # the parameters are single precision
        yield agreement(FORMS[name].words, [*up, *down], [g] * 3 + [-g] * 3, 1e-5)
