"""Exports prove themselves: check vectors and a test in each, which passes as written and not after a change."""

import io
import re

import numpy as np
import pytest
from openpyxl import load_workbook

from bench.exchange.checks import COUNT, POSITIONS, TOLERANCE
from bench.exchange.forms import FORMS
from bench.exchange.result import BlockResult
from bench.model.geometry import Block
from bench.services.coefficients import require_temperature, write_form
from bench.services.errors import Refused
from bench.validation.paper_bench import U0, K
from tests.support.self_tests import compiled_test, own_test, with_a_digit_changed

RESULT = BlockResult(Block(K, U0), 1e-10 * np.eye(12), "V", 9.81, "run-17", "QA", "1")
COMMENTED = ("csv", "kalibr", "px4", "ardupilot")


def test_positions_are_one_g_all_round():
    assert POSITIONS.shape == (COUNT, 3)
    assert np.linalg.norm(POSITIONS, axis=1) == pytest.approx(np.ones(COUNT), rel=1e-15)
    assert pytest.approx(np.eye(3) * COUNT / 3, abs=1e-14) == POSITIONS.T @ POSITIONS
    assert RESULT.check[1] == pytest.approx(POSITIONS, abs=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("form", ["json", *COMMENTED])
def test_the_test_of_a_file_passes_and_fails_when_a_digit_of_it_changes(form, tmp_path):
    file = tmp_path / f"x{FORMS[form].suffix}"
    write_form(RESULT, file, form, None)
    assert own_test(file) == 0
    text = file.read_text(encoding="utf-8")
    number = {
        "json": r'"Nyx": \{\s*"value": -?', "csv": r"\nNyx,-?", "kalibr": r"M:\s*- \[?-?", "px4": r"YOFF\t-?",
        "ardupilot": r"INS_ACCSCAL_Z,",
    }[form]  # fmt: skip
    places = [re.search(number, text).end()]
    check = re.search(r"^# check: -?", text, re.MULTILINE) or re.search(r'"raw": \[\s*\[\s*-?|\n1,-?', text)
    for at in (*places, check.end()):
        file.write_text(with_a_digit_changed(text, at), encoding="utf-8")
        assert own_test(file) != 0


@pytest.mark.parametrize("of", ["coefficients_n", "coefficients_u0", "coefficients_check"])
def test_the_self_test_of_the_header_passes_and_fails_when_a_digit_changes(of, tmp_path):
    text = FORMS["c"].write(RESULT, None)
    assert compiled_test(tmp_path, "coefficients", text) == 0
    at = re.search(rf"static const double {of}(\[\w+\])+ = \{{\s*\{{?-?", text).end()
    assert compiled_test(tmp_path, "coefficients", with_a_digit_changed(text, at)) > 0


def test_the_workbook_computes_its_check_vectors(tmp_path):
    book = load_workbook(io.BytesIO(FORMS["excel"].write(RESULT, None)))
    sheet, inverse = book["check"], book["inverse"]
    for row in (3, 22):
        for column in "HIJ":
            text = sheet[f"{column}{row}"].value[1:].replace("$", "")
            text = re.sub(r"inverse!(\w+)", lambda m: repr(inverse[m[1]].value), text)
            text = re.sub(r"\b([B-D]\d+)\b", lambda m: repr(sheet[m[1]].value), text)
            stated = sheet[f"{chr(ord(column) - 3)}{row}"].value
            assert eval(text) == pytest.approx(stated, abs=TOLERANCE)  # noqa: S307 - our own formulas
    assert "K3:K22" in sheet["B1"].value


@pytest.mark.parametrize("form", FORMS)
def test_every_form_draws_its_signs_and_says_that_temperature_is_left_out(form, tmp_path):
    warm = BlockResult(Block(K, U0), 1e-10 * np.eye(12), "V", 9.81, "run-17", temperature="thermal_bias")
    with pytest.raises(Refused, match=r"corrected for temperature .*without.temperature"):
        write_form(warm, tmp_path / "x", form, None)
    assert not (tmp_path / "x").exists()
    write_form(warm, tmp_path / "x", form, None, without_temperature=True)
    made = (tmp_path / "x").read_bytes()
    if form == "excel":
        sheets = load_workbook(io.BytesIO(made)).worksheets
        text = "\n".join(str(cell.value) for sheet in sheets for row in sheet.iter_rows() for cell in row)
    else:
        text = made.decode()
    assert "WITHOUT TEMPERATURE, as asked: thermal_bias" in text
    assert "the axis that points up reads +1 g" in text
    require_temperature([RESULT], without=False)
