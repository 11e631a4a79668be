"""Every form, read and evaluated as its consumer does: the same accelerations as ours, or off by what it says."""

import csv
import io
import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import yaml
from openpyxl import load_workbook

from bench.exchange.autopilots import diagonal, lower_triangular, sensor_of
from bench.exchange.forms import FORMS
from bench.exchange.result import NOT_ACCEPTED, SIMULATED, BlockResult, FittedEffect
from bench.model.geometry import Block
from bench.validation.paper_bench import U0, K
from tests.support.specific_force import specific_force_covariance

G = 9.810547
ROOT = np.random.default_rng(3).normal(size=(12, 12))
COVARIANCE = 2.5e-9 * ROOT @ ROOT.T / 12
RESULT = BlockResult(
    Block(K, U0), COVARIANCE, "V", G, "runs/17 */ x\\", "QA", "=1+1 */\n#error", "2026-03-01T08:00:00+00:00",
    {"name": "my-bench"},
)  # fmt: skip


@pytest.fixture(scope="module")
def drawn():
    """Signals (200, 3) for 1 g in directions all round, and our accelerations, m/s^2 (seed 4)."""
    a = np.random.default_rng(4).normal(size=(200, 3))
    a /= np.linalg.norm(a, axis=1)[:, None]
    return RESULT.block.output(a), G * a


def text_of(form, result=RESULT, nominal=None):
    return FORMS[form].write(result, nominal)


def in_ms2(text, signal):
    """The signals as the head of the file says that they are fed."""
    factors = re.search(r"^# S = \((.*)\) V/g", text, re.MULTILINE)[1]
    return 9.80665 * signal / np.array([float(part) for part in factors.split(",")])


# --- PX4 and ArduPilot ------------------------------------------------------------------------------


def px4(text, signal):
    """Correct() of PX4: (data - offset) times scale, in single precision."""
    rows = [line.split("\t") for line in text.splitlines() if not line.startswith("#")]
    assert {(row[0], row[1], row[4]) for row in rows} == {("1", "1", "9")}
    values = {row[2]: np.float32(row[3]) for row in rows}
    offset = np.array([values[f"CAL_ACC0_{axis}OFF"] for axis in "XYZ"])
    scale = np.array([values[f"CAL_ACC0_{axis}SCALE"] for axis in "XYZ"])
    assert len(rows) == 6
    return (in_ms2(text, signal).astype(np.float32) - offset) * scale


def ardupilot(text, signal):
    """_rotate_and_correct_accel() of ArduPilot: the offset off, then times the scale."""
    rows = dict(line.split(",") for line in text.splitlines() if not line.startswith("#"))
    offset = np.array([np.float32(rows.pop(f"INS_ACCOFFS_{axis}")) for axis in "XYZ"])
    scale = np.array([np.float32(rows.pop(f"INS_ACCSCAL_{axis}")) for axis in "XYZ"])
    assert not rows
    return (in_ms2(text, signal).astype(np.float32) - offset) * scale


AUTOPILOTS = {"px4": px4, "ardupilot": ardupilot}


@pytest.mark.parametrize("form", AUTOPILOTS)
@pytest.mark.parametrize("nominal", [None, np.array([-2.0, -2.1, -2.2])])
def test_an_autopilot_is_off_by_what_the_file_says_and_no_more(form, nominal, drawn):
    signal, ours = drawn
    text = text_of(form, nominal=nominal)
    found = AUTOPILOTS[form](text, signal)
    modulus = np.abs(np.linalg.norm(found, axis=1) - G) / G
    vector = np.linalg.norm(found - ours, axis=1) / G
    told = re.search(r"\|a\| is off by up to (\d+) mg, the vector a by up to (\d+) mg", text)
    most = [float(number) * 1e-3 for number in told.groups()]
    assert 0.9 * most[0] < modulus.max() < most[0] + 0.5e-3
    assert 0.9 * most[1] < vector.max() < most[1] + 0.5e-3


@pytest.mark.parametrize("form", AUTOPILOTS)
def test_an_autopilot_has_our_accelerations_of_a_block_without_cross_axis_terms(form, drawn):
    plain = BlockResult(Block(np.diag(np.diag(K)), U0), COVARIANCE, "V", G, "run")
    signal = plain.block.output(drawn[1] / G)
    assert AUTOPILOTS[form](text_of(form, plain), signal) == pytest.approx(drawn[1], abs=4e-6)


def test_what_leaving_out_costs_is_the_worst_of_all_directions():
    """Against a search over directions: 20,000 drawn (seed 5), then the best of them improved."""
    sensor = sensor_of(RESULT)
    _, modulus_g, vector_g = diagonal(sensor)
    scaled = sensor.M / np.diag(sensor.M)[:, None]
    a = np.random.default_rng(5).normal(size=(20_000, 3))
    a /= np.linalg.norm(a, axis=1)[:, None]
    modulus = np.abs(np.linalg.norm(a @ scaled.T, axis=1) - 1)
    vector = np.linalg.norm(a @ scaled.T - a, axis=1)
    assert modulus.max() <= modulus_g <= 1.002 * modulus.max()
    assert vector.max() <= vector_g <= 1.002 * vector.max()


def test_the_uncertainty_of_gravity_is_in_scales_of_m_s2_and_in_no_number_per_g():
    given = BlockResult(Block(K, U0), np.zeros((12, 12)), "V", G, "run", gravity_u=1e-5)
    text = text_of("px4", given)
    assert "of the scales: 2e-05, 2e-05, 2e-05, relative" in text
    assert "(u = 9.8e-05 m/s^2, which is in no number per g)" in text
    assert {row.u for row in given.inverse.rows} == {0.0}


def test_a_covariance_of_the_readings_that_is_the_whole_one_is_not_combined():
    alone = BlockResult(Block(K, U0), COVARIANCE, "g", G, "run", covariance_readings=COVARIANCE.copy())
    assert not alone.combined
    assert "of these readings alone" in text_of("c", alone)


def test_what_a_program_would_refuse_is_told():
    counts = BlockResult(Block(K, U0 + 5.0), COVARIANCE, "V", G, "run")
    assert any(
        "INS_ACCOFFS_X = " in line and "outside -3.5 to 3.5" in line
        for line in text_of("ardupilot", counts).splitlines()
    )
    assert any(
        "INS_ACCSCAL_Y" in line for line in FORMS["ardupilot"].loses(RESULT, np.array([-2.1, -3.0, -2.1]))
    )
    assert not any("outside" in line for line in FORMS["px4"].loses(RESULT, None))


# --- Kalibr -----------------------------------------------------------------------------------------


def test_kalibr_has_the_modulus_and_with_bias_and_turn_our_accelerations(drawn):
    signal, ours = drawn
    text = text_of("kalibr")
    imu = yaml.safe_load(text)["imu0"]
    assert imu["model"] == "scale-misalignment"
    M, bias, C = (np.array(imu["accelerometers"][name]) for name in ("M", "bias", "C_accel_block"))
    assert np.array_equal(M, np.tril(M))
    # Kalibr: z = M (C a) + b
    on_its_axes = np.linalg.solve(M, (in_ms2(text, signal) - bias).T).T
    assert np.linalg.norm(on_its_axes, axis=1) == pytest.approx(G, rel=1e-12)
    assert on_its_axes @ C == pytest.approx(ours, abs=1e-11)
    worst = np.linalg.norm(on_its_axes - ours, axis=1).max() / G
    assert worst == pytest.approx(float(re.search(r"off by up to ([\d.]+) mg", text)[1]) * 1e-3, rel=0.05)


def test_the_triangle_of_kalibr_is_one_for_any_block():
    rng = np.random.default_rng(6)
    for _ in range(20):
        block = Block(np.diag([2.0, -3.0, 1.5]) + 0.1 * rng.normal(size=(3, 3)), U0)
        sensor = sensor_of(BlockResult(block, COVARIANCE, "V", G, "run"))
        M, R, _ = lower_triangular(sensor)
        assert pytest.approx(sensor.M, abs=1e-14) == M @ R
        assert pytest.approx(np.eye(3), abs=1e-14) == R @ R.T
        assert np.linalg.det(R) == pytest.approx(1.0)
        assert np.all(np.diag(M) > 0)


@pytest.mark.parametrize(("unit", "factor"), [("m/s^2", 1.0), ("g", 9.80665)])
def test_signals_that_are_accelerations_need_no_scale_factor(unit, factor):
    """A sensor that gives m/s^2, or g of 9.80665 m/s^2, true to 1 %."""
    K_own = np.array([[1.01, 0, 0], [0, 0.99, 0.01], [0, 0, 1.0]]) * G / factor
    result = BlockResult(Block(K_own, np.array([0.1, 0.0, -0.2])), COVARIANCE, unit, G, "run")
    sensor = sensor_of(result)
    a = np.array([[0.3, 0.2, 1.4]])
    signal = result.block.output(a)
    assert sensor.signal(signal) == pytest.approx(factor * signal)
    assert sensor.signal(signal)[0] == pytest.approx(sensor.M @ (G * a[0]) + sensor.b)


# --- data and source text ---------------------------------------------------------------------------


def test_json_and_csv_hold_every_number_to_the_last_digit():
    read = json.loads(text_of("json"))
    rows = list(csv.reader(line for line in io.StringIO(text_of("csv")) if not line.startswith("#")))
    table = {row[0]: row[1:] for row in rows[1 : rows.index(next(r for r in rows if r[0] == "covariance"))]}
    parts = (read, read["inverse"], read["misalignments"], read["intrinsic"])
    whole = {**read["coefficients"]}
    for part in parts[1:]:
        whole |= part["values"]
    assert len(whole) == len(table) == 36
    for name, entry in whole.items():
        *numbers, unit = table[name]
        assert [float(number) for number in numbers] == [entry["value"], entry["u"], entry["U"]]
        assert unit == entry["unit"]
    tables = [at for at, row in enumerate(rows) if row[0] == "covariance"]
    for at, part in zip(tables, parts, strict=True):
        size = len(part["order"])
        assert rows[at][1:] == part["order"]
        body = rows[at + 1 : at + 1 + size]
        assert [row[0] for row in body] == part["order"]
        assert np.array([row[1:] for row in body], dtype=float).tolist() == part["covariance"]
    assert np.array(read["covariance"]).tolist() == COVARIANCE.tolist()


MAIN = """
#include <stdio.h>
#include "coefficients.h"

int main(void)
{
    double u[3], a[3], c[3][3];

    while (scanf("%lf %lf %lf", &u[0], &u[1], &u[2]) == 3) {
        coefficients_specific_force(u, a);
        coefficients_force_covariance(u, c);
        printf("%.17g %.17g %.17g %.17g %.17g\\n", a[0], a[1], a[2], c[0][0], c[1][2]);
    }
    return 0;
}
"""


def test_the_header_compiles_and_computes_accelerations_and_their_covariance(drawn, tmp_path):
    compiler = shutil.which("gcc")
    if compiler is None:
        pytest.skip("no gcc here to compile the header with")
    signal, ours = drawn
    (tmp_path / "coefficients.h").write_text(text_of("c"))
    (tmp_path / "main.c").write_text(MAIN)
    strict = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O1"]
    subprocess.run([compiler, *strict, "-o", tmp_path / "main", tmp_path / "main.c"], check=True)  # noqa: S603
    text = "\n".join(" ".join(map(repr, row)) for row in signal.tolist())
    done = subprocess.run([tmp_path / "main"], input=text, capture_output=True, text=True, check=True)  # noqa: S603
    found = np.array([line.split() for line in done.stdout.splitlines()], dtype=float)
    assert G * found[:, :3] == pytest.approx(ours, abs=1e-12)
    covariance = specific_force_covariance(RESULT.inverse, signal)
    assert found[:, 3] == pytest.approx(covariance[:, 0, 0], rel=1e-9)
    assert found[:, 4] == pytest.approx(covariance[:, 1, 2], rel=1e-7, abs=1e-18)


def formulas(book):
    """Evaluate the formulas of the sheet that converts: references, + - * / ^, SQRT, SUMPRODUCT."""

    def value(sheet, cell):
        content = book[sheet][cell].value
        return (
            evaluate(sheet, content[1:]) if isinstance(content, str) and content.startswith("=") else content
        )

    def cells(sheet, first, last):
        return [value(sheet, cell.coordinate) for row in book[sheet][f"{first}:{last}"] for cell in row]

    def sumproduct(sheet, found):
        other, *ends = found.group(3, 4, 5)
        here = cells(sheet, *found.group(1, 2))
        return repr(float(np.dot(here, cells(other, *ends))))

    def evaluate(sheet, text):
        text = text.replace("$", "")
        text = re.sub(
            r"SUMPRODUCT\((\w+):(\w+),'([\w ]+)'!(\w+):(\w+)\)", lambda m: sumproduct(sheet, m), text
        )
        text = re.sub(r"(\w+)!([A-Z]\d+)", lambda m: repr(value(m[1], m[2])), text)
        text = re.sub(r"\b([A-Z]\d+)\b", lambda m: f"({value(sheet, m[1])!r})", text)
        return eval(text.replace("SQRT", "np.sqrt").replace("^", "**"), {"np": np})  # noqa: S307 - our own formulas

    return lambda cell: float(value("a from U", cell))


@pytest.mark.slow
def test_the_workbook_computes_a_and_u_of_its_modulus_from_signals_that_are_typed(drawn):
    signal, ours = drawn
    book = load_workbook(io.BytesIO(text_of("excel")))
    sheet = book["a from U"]
    assert [formulas(book)(cell) for cell in ("B4", "C4", "D4")] == pytest.approx([0, 0, 1], abs=1e-12)
    for row, a in zip(signal[:2], ours[:2], strict=True):
        sheet["B2"], sheet["C2"], sheet["D2"] = row.tolist()
        cell = formulas(book)
        assert [G * cell(at) for at in ("B4", "C4", "D4")] == pytest.approx(a, abs=1e-11)
        covariance = specific_force_covariance(RESULT.inverse, row[None])[0]
        along = a / np.linalg.norm(a)
        assert cell("B6") == pytest.approx(2 * np.sqrt(along @ covariance @ along), rel=1e-9)
    names = [row[0].value for row in book["misalignments"].iter_rows(min_row=2)]
    assert names == list(RESULT.misalignments.names)
    first = [cell.value for cell in book["covariance K U0"][2][1:]]
    assert first == pytest.approx(COVARIANCE[0].tolist(), rel=1e-15)


# --- what every form carries ------------------------------------------------------------------------


def seen(form, result):
    """All text of a form."""
    made = text_of(form, result)
    if isinstance(made, bytes):
        book = load_workbook(io.BytesIO(made))
        return "\n".join(str(cell.value) for sheet in book for row in sheet.iter_rows() for cell in row)
    return made


@pytest.mark.parametrize("form", FORMS)
def test_every_form_says_of_which_block_when_with_which_g_and_what_its_u_holds(form):
    about = {"name": "my-bench"}
    simulated = BlockResult(
        Block(K, U0), COVARIANCE, "V", G, "run-17", "QA", "0815", "2026-03-01", about, simulated=True, k=2.13
    )
    text = seen(form, simulated)
    for part in ("run-17", "0815", "2026-03-01", "my-bench", repr(G), "2.13"):
        assert part in text, part
    assert (SIMULATED in text) or '"simulated": true' in text
    assert "alone" in text or '"combined": false' in text
    combined = seen(
        form, BlockResult(Block(K, U0), COVARIANCE, "V", G, "r", covariance_readings=COVARIANCE / 4)
    )
    assert "combined: the stand" in combined or '"combined": true' in combined
    assert SIMULATED not in combined


@pytest.mark.parametrize("form", FORMS)
def test_every_form_names_a_misfit_and_the_effects_that_it_leaves_out(form):
    effect = FittedEffect("quadratic_nonlinearity.K2[x]", 390.135, 18.1, "ug/g^2")
    about = {"fits": False, "effects": (effect,), "temperature_c": 20.0, "notes": ("readings span 75 K",)}
    text = seen(form, BlockResult(Block(K, U0), COVARIANCE, "V", G, "r", **about))
    assert "readings span 75 K" in text
    assert "quadratic_nonlinearity.K2[x]" in text
    assert "390.135" in text
    assert NOT_ACCEPTED in text or '"fits": false' in text
    assert "block temperature: 20.0 deg C" in text or "20.0" in text
    assert NOT_ACCEPTED not in seen(form, RESULT)


@pytest.mark.parametrize("form", FORMS)
def test_every_form_says_that_u_holds_up_to_1_g(form):
    """At 10 g the covariance gives 0.4 mg, where K3 = 20 µg/g³ alone is 20 mg."""
    result = BlockResult(Block(K, U0), COVARIANCE, "V", G, "r", nonlinearity=("30 ug/g^2", "20 ug/g^3"))
    sizes = {"K2": {"u": 3e-5, "unit": "g/g^2"}, "K3": {"u": 2e-5, "unit": "g/g^3"}}
    assert result.to_dict()["nonlinearity"] == sizes
    assert replace(result, nonlinearity=("", "unknown")).to_dict()["nonlinearity"] == {}
    for of, terms in ((result, "30 ug/g^2 a^2 and 20 ug/g^3 a^3"), (RESULT, "K2 a^2 and K3 a^3")):
        said = " ".join(re.sub(r"[*#]", " ", seen(form, of)).split())
        assert f"up to 1 g; above, add the block's nonlinearity, {terms} of each axis" in said


def test_the_header_in_c_says_whether_the_calibration_was_accepted():
    assert "#define COEFFICIENTS_ACCEPTED 1\n" in text_of("c")
    unfit = BlockResult(Block(K, U0), COVARIANCE, "V", G, "r", fits=False)
    assert "#define COEFFICIENTS_ACCEPTED 0\n" in text_of("c", unfit)


def test_kalibr_s_file_states_u_of_the_numbers_it_has():
    line = next(one for one in text_of("kalibr").splitlines() if "U of the bias" in one)
    first = float(line.split("bias: ")[1].split(",")[0])
    assert first == pytest.approx(2 * np.sqrt(COVARIANCE[9, 9]) * 9.80665 / 2.18, rel=0.06)


@pytest.mark.parametrize("form", [name for name in FORMS if name != "json"])
def test_a_name_from_outside_is_text_in_every_form(form):
    """It ends no comment, begins no line, and is no formula."""
    made = text_of(form)
    if isinstance(made, bytes):
        cells = [cell for row in load_workbook(io.BytesIO(made))["about"].iter_rows() for cell in row]
        assert {cell.data_type for cell in cells if cell.value} == {"s"}
        assert any("=1+1" in str(cell.value) for cell in cells)
        return
    assert not [line for line in made.splitlines() if line.startswith("#error")]
    assert made.count("*/") == (0 if form != "c" else 8)


def test_the_header_in_c_rounds_no_uncertainty_down():
    """It wrote 0.0001 for a U of 0.0001045, and called U of N that of the coefficients."""
    result = replace(RESULT, covariance=COVARIANCE / COVARIANCE[9, 9] * (0.0001045 / 2) ** 2)
    line = next(one for one in text_of("c", result).splitlines() if "U of N and U0: " in one)
    assert "U0x 0.00011, " in line
