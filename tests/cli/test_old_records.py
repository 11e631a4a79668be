"""Records of an earlier version (see data/README.md): they are believed, evaluated as then, and gone on with."""

import json
import re
import shutil
from pathlib import Path
from typing import Final

import pytest

from bench.run.folder import Run
from tests.support.commands import printed

pytestmark = pytest.mark.slow

LONG: Final = re.compile(r"-?\d+\.\d*(0000000|9999999)\d*")
RECORDS = Path(__file__).parents[1] / "data" / "records"


@pytest.fixture(params=["finished", "interrupted"])
def recorded(request, bench):
    """The name of an old record in the folder of runs, brought to its end."""
    shutil.copytree(RECORDS / request.param, Path("runs") / request.param)
    if request.param == "interrupted":
        assert Run(Path("runs/interrupted")).history.state == "interrupted"
        assert bench("resume", request.param)[0] == 0
    return request.param


def comparable(value, of_float=float):
    """A result without what belongs to one run or program, `of_float` taken of its numbers."""
    if isinstance(value, dict):
        own = {"source", "made_at", "versions", "record", "bench"}
        return {key: comparable(part, of_float) for key, part in value.items() if key not in own}
    if isinstance(value, list):
        return [comparable(part, of_float) for part in value]
    return of_float(value) if isinstance(value, float) else value


def as_then(value, expected):
    """A result without the members that results did not have then."""
    if isinstance(value, dict):
        return {key: as_then(part, expected[key]) for key, part in value.items() if key in expected}
    if isinstance(value, list):
        return [as_then(*pair) for pair in zip(value, expected, strict=True)]
    return value


def within_rounding(value):
    return pytest.approx(value, rel=1e-7, abs=1e-15)


def test_an_old_record_is_whole_and_has_its_readings(bench, recorded):
    run = Run(Path("runs") / recorded)
    assert run.history.problems == ()
    assert run.history.state == "finished"
    assert "chain of hashes complete" in bench("show", recorded, "--verify")[1]
    then = (RECORDS / "readings.csv").read_bytes().decode()
    now = bench("export", recorded, "--csv", "-")[1]
    assert without_last_digits_of_scatter(now) == without_last_digits_of_scatter(
        without_what_sums_round(then)
    )


def without_last_digits_of_scatter(table):
    """A file whose standard deviations have ten digits: the last of sixteen are the processor's own."""
    lines = [line.split(",") for line in table.split("\r\n")]
    scatter = [k for k, name in enumerate(lines[0]) if "_sd_" in name]
    assert len(scatter) == 3
    rows = [
        [f"{float(c):.10g}" if k in scatter and c else c for k, c in enumerate(line)] for line in lines[1:]
    ]
    return "\r\n".join(",".join(line) for line in (lines[0], *rows))


def without_what_sums_round(table):
    """The file as it was, its numbers of more than 15 digits after a sum of five replies as the sum means them."""

    def plain(cell):
        return repr(float(f"{float(cell):.12g}")) if LONG.fullmatch(cell) else cell

    lines = [line.split(",") for line in table.split("\r\n")]
    signals = [k for k, name in enumerate(lines[0]) if name in {"ux_v", "uy_v", "uz_v"}]
    rows = [[plain(c) if k in signals else c for k, c in enumerate(line)] for line in lines[1:]]
    return "\r\n".join(",".join(line) for line in (lines[0], *rows))


SINCE: Final = {
    "not_observable", "coefficients_per_ms2", "covariance", "u", "U", "stand", "noise", "points", "residual",
}  # fmt: skip
"""What is known better since then: u is the combined one, and holds what nobody stated."""


def test_an_old_record_evaluates_to_what_it_did(bench, recorded):
    """Readings, fit and verdict; what u was then is u_readings now, but for channels told apart in their noise."""
    for command in ("calibrate", "verify"):
        out = printed(bench(command, recorded, "--json", "-"))
        expected = json.loads((RECORDS / f"{command}.json").read_text(encoding="utf-8"))
        found = json.loads(out)
        for name, then in expected.get("coefficients", {}).items():
            now = found["coefficients"][name]
            assert now["value"] == pytest.approx(then["value"], abs=0.5 * then["u"])
            assert now["u_readings"] == pytest.approx(then["u"], rel=0.35)
            assert now["u"] > then["u"]
        for now, then in zip(found.get("points", []), expected.get("points", []), strict=True):
            assert now["delta_g"] == pytest.approx(then["delta_g"], abs=then["u"])
            assert (now["angle_deg"], now["passed"]) == (then["angle_deg"], then["passed"])
        assert set(expected.pop("notes", [])) <= set(found["notes"])
        expected.pop("coefficients", None)
        same = {name: part for name, part in expected.items() if name not in SINCE}
        assert as_then(comparable(found), same) == comparable(same, within_rounding)
