"""Compensation tables: their error against the polynomials, and the C header compiled and run."""

import csv
import json
import shutil
import subprocess

import numpy as np
import pytest

from bench.calibration import CalibrationError
from bench.calibration.temperature import c_header, inverse_entries, make_table, table_csv
from bench.calibration.temperature_fit import temperature_model
from bench.results.compensation import table_part
from tests.support.paper_bench import STAND_U
from tests.support.thermal_bench import MODEL, simulate, truth

SEED = 77
REACH_G = 10.0


@pytest.fixture(scope="module")
def model():
    rng = np.random.default_rng(SEED)
    return temperature_model([simulate(rng, truth(rng))], MODEL, STAND_U, 9.81)


@pytest.fixture(scope="module")
def table(model):
    return make_table(model, REACH_G)


@pytest.fixture(scope="module")
def drawn(model):
    """Accelerations, temperatures and signals that no table was made of, with the exact answer."""
    rng = np.random.default_rng([SEED, 1])
    temperature = rng.uniform(model.minimum_c, model.maximum_c, 2000)
    force = rng.normal(size=(2000, 3))
    force *= (rng.uniform(0.0, REACH_G, 2000) / np.linalg.norm(force, axis=1))[:, None]
    coefficients = model.coefficients(temperature)
    signal = np.einsum("nij,nj->ni", coefficients[:, :9].reshape(-1, 3, 3), force) + coefficients[:, 9:]
    return force, temperature, signal


def allowed_g(table, force):
    size = np.linalg.norm(force, axis=1)[:, None]
    return table.error.bias + table.error.per_g * size + table.error.single


def test_accelerations_out_of_the_table_are_as_close_as_it_says(table, drawn):
    force, temperature, signal = drawn
    off = np.abs(table.specific_force(signal, temperature) - force)
    # single precision was looked at on 26 directions; others may come out a little worse
    assert np.all(off <= 1.5 * allowed_g(table, force))
    assert np.max(off / allowed_g(table, force)) > 0.2


def test_the_table_is_fine_enough_for_its_own_uncertainty(model, table):
    signal = model.block(23.0).output(np.eye(3))
    assert table.error.bias + table.error.per_g < 0.11 * np.min(model.compensate(signal, 23.0).u)
    coarse = make_table(model, REACH_G, step_k=30.0)
    assert coarse.nodes == 4
    assert coarse.error.per_g > 10 * table.error.per_g


def test_nodes_hold_the_inverse_of_the_polynomials(model, table):
    exact = inverse_entries(model, table.temperatures_c)
    assert table.entries == pytest.approx(exact, rel=1e-6)
    k = model.coefficients(table.temperatures_c)[:, :9].reshape(-1, 3, 3)
    assert exact[:, :9].reshape(-1, 3, 3) @ k == pytest.approx(
        np.tile(np.eye(3), (table.nodes, 1, 1)), abs=1e-12
    )


@pytest.mark.parametrize("step_k", [0.0, -1.0, 1e-4, 200.0, float("nan")])
def test_a_step_that_is_none_is_refused(model, step_k):
    with pytest.raises(CalibrationError, match=r"a step of .* does not suit a table from -2"):
        make_table(model, REACH_G, step_k)


def test_csv_and_json_hold_the_same_entries(model, table):
    text = table_csv(model, table, "block 1")
    comments = [line for line in text.splitlines() if line.startswith("#")]
    assert f"{table.error.per_g:.1e} for each g" in " ".join(comments)
    rows = list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
    assert len(rows) == table.nodes
    first = np.array([rows[0][name] for name in ("Nxx", "Nzz", "U0z")], dtype=np.float32)
    assert np.array_equal(first, table.entries[0, [0, 8, 11]])
    plain = json.loads(json.dumps(table_part(table).to_dict()))
    assert np.array_equal(np.array(plain["rows"], dtype=np.float32), table.entries)
    assert plain["approximation"]["up_to_g"] == REACH_G


MAIN = """#include <stdio.h>
#include "compensation.h"
int main(void)
{
    float u[3], t, a[3];
    while (scanf("%f %f %f %f", &t, &u[0], &u[1], &u[2]) == 4) {
        int status;
        a[0] = a[1] = a[2] = -1.0f;
        status = compensation_specific_force(u, t, a);
        printf("%d %.9g %.9g %.9g\\n", status, (double)a[0], (double)a[1], (double)a[2]);
    }
    return 0;
}
"""


@pytest.fixture(scope="module")
def compiled(model, table, tmp_path_factory):
    compiler = shutil.which("gcc")
    if compiler is None:
        pytest.skip("no gcc here to compile the header with")
    folder = tmp_path_factory.mktemp("c")
    (folder / "compensation.h").write_text(c_header(model, table, "block */ 1\\\n#error"))
    (folder / "main.c").write_text(MAIN)
    strict = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O1"]
    subprocess.run([compiler, *strict, "-o", folder / "main", folder / "main.c"], check=True)  # noqa: S603

    def run(temperature, signal):
        rows = np.column_stack([temperature, signal])
        text = "\n".join(" ".join(repr(float(v)) for v in row) for row in rows)
        done = subprocess.run([folder / "main"], input=text, capture_output=True, text=True, check=True)  # noqa: S603
        found = np.array([line.split() for line in done.stdout.splitlines()], dtype=float)
        return found[:, 0].astype(int), found[:, 1:]

    return run


def test_the_header_compiles_and_computes_what_the_table_says(compiled, table, drawn):
    force, temperature, signal = drawn
    status, found = compiled(temperature, signal)
    assert np.all(status == 0)
    assert np.all(np.abs(found - force) <= 1.5 * allowed_g(table, force))
    # the same arithmetic in numpy; a fused multiplication may differ in the last digits of 10 g
    assert found == pytest.approx(table.specific_force(signal, temperature), abs=4e-6)


def test_the_header_tells_a_temperature_outside_and_one_that_is_none(compiled, model):
    signal = np.tile(model.block(model.maximum_c).output(np.array([[0.0, 0.0, 1.0]])), (4, 1))
    status, found = compiled([model.maximum_c + 20.0, model.minimum_c - 5.0, np.nan, model.maximum_c], signal)
    assert status.tolist() == [1, 1, -1, 0]
    assert found[0] == pytest.approx([0.0, 0.0, 1.0], abs=3e-6)
    assert found[2].tolist() == [-1.0, -1.0, -1.0]
