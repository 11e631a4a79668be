"""Check vectors of exported files, the tests by which files check themselves, and the drawing of signs and axes.

    $ python -c "$(sed -n 's/^# test: //p' unit-17.csv)" unit-17.csv

A test is three lines of Python that need no package except a reader of the form. The test computes the
corrected accelerations of the check vectors from the numbers in the file. The test fails if one acceleration
is off by more than `TOLERANCE` of 1 g. Numbers that are not used to compute accelerations, such as u and
covariances, are not tested.
"""

from __future__ import annotations

from itertools import product
from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.base.text import double

TOLERANCE: Final = 1e-12
"""Largest accepted error of a corrected acceleration in a test, as a fraction of 1 g."""
COUNT: Final = 20
MARK: Final = "test: "
"""First word of each line of a file's own test, after the comment sign."""

GOLDEN: Final = (1.0 + 5.0**0.5) / 2.0
_CORNERS: Final = [
    *product((-1.0, 1.0), repeat=3),
    *(
        tuple(np.roll([0.0, p / GOLDEN, q * GOLDEN], turn).tolist())
        for turn in range(3)
        for p, q in product((-1.0, 1.0), repeat=2)
    ),
]
POSITIONS: Final[Floats] = np.array(_CORNERS) / np.sqrt(3.0)
"""Specific forces (20, 3) of the check vectors, 1 g each: the corners of a dodecahedron."""


def picture(unit: str) -> list[str]:
    """Return lines that draw the axes, and state signs, order and units of `a` and `U`."""
    return [
        "        +z    up     at rest the axis that points up reads +1 g:",
        "         |   ^       z up:     a = ( 0,  0, +1)   z down: a = ( 0,  0, -1)",
        "         |   |       x up:     a = (+1,  0,  0)   y up:   a = ( 0, +1,  0)",
        "         o------ +y  right-handed axes of the block; a: specific force in local g",
        "        /            order everywhere: x, y, z",
        f"      +x             U = (Ux, Uy, Uz) in {unit}",
    ]


def own_test(name: str, test: tuple[str, str, str], needs: str = "") -> list[str]:
    """Return comment lines with the test of an exported file `name`.

    They state how to run the test and what it `needs`; the three lines of the test follow, each after `MARK`.
    """
    of = "the numbers that give a, and of the check vectors (not of u and covariances)"
    how = f"""test of {of}: python -c "$(sed -n 's/^# {MARK}//p' {name})" {name}"""
    return [f"{how}{needs}", *(f"{MARK}{line}" for line in test)]


def check_lines(raw: Floats, corrected: Floats, names: str, unit: str) -> list[str]:
    """Return check vectors as lines: signals `raw` (n, 3), accelerations `corrected` (n, 3) in `unit`."""
    rows = np.hstack([raw, corrected]).tolist()
    return [f"check vectors: {names} in {unit}", *(f"check: {' '.join(map(repr, row))}" for row in rows)]


READ_CHECKS: Final = (
    "c = [[float(x) for x in l[9:].split()] for l in open(sys.argv[1]) if l.startswith('# check: ')]"
)
"""The statement of a test that reads the lines of `check_lines`."""


def judged(g: str = "1.0", at: int = 3, count: int = COUNT) -> str:
    """Return the last line of a test, which asserts that the accelerations agree with the check vectors.

    The test has a function `a`, which maps the first `at` numbers of a check vector to an acceleration; `g`
    is 1 g in the unit of that acceleration. `count` is the number of check vectors that the file must have.
    """
    worst = (
        f"max([abs(p - q) for r in c for p, q in zip(a(r[:{at}]), r[{at}:])] + [9e9] * (len(c) != {count}))"
    )
    failed = "FAILED: numbers that give a, or check vectors, are not as written"
    return f"assert {worst} <= {TOLERANCE:g} * {g}, {failed!r}"


def c_self_test(prefix: str, rows: Floats, call: str) -> str:
    """Return the check vectors `rows` (n, m) and the function `<prefix>_self_test` in C.

    The last three columns of `rows` are the corrected accelerations; the statement `call` computes `a` from `row`.
    """
    listed = ",\n".join("    {" + ", ".join(double(value) for value in row) + "}" for row in rows)
    at = rows.shape[1] - 3
    upper = prefix.upper()
    return f"""#define {upper}_CHECKS {len(rows)}

/* check vectors: {"temperature in deg C, " if at > 3 else ""}Ux, Uy, Uz, then ax, ay, az in local g */
static const double {prefix}_check[{upper}_CHECKS][{rows.shape[1]}] = {{
{listed}
}};

/* Returns how many check vectors are not met to {TOLERANCE:g} g: 0 when all numbers for a are as written. */
static inline int {prefix}_self_test(void)
{{
    int i, k, wrong, failed = 0;

    for (i = 0; i < {upper}_CHECKS; i++) {{
        const double *row = {prefix}_check[i];
        double a[3];

        {call}
        wrong = 0;
        for (k = 0; k < 3; k++)
            if (!(a[k] - row[{at} + k] <= {TOLERANCE:g} && row[{at} + k] - a[k] <= {TOLERANCE:g}))
                wrong = 1;
        failed += wrong;
    }}
    return failed;
}}
"""
