"""Text in CSV cells: a spreadsheet keeps it as text, a terminal does not obey it, our import has it back."""

import csv
import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.base.text import visible
from bench.readings.columns import as_cell, of_cell
from bench.readings.csv import format_csv, read_csv

HEADER = "installation,pass,point,angle_deg,ux_v,uy_v,uz_v"


@pytest.mark.parametrize(
    "text",
    ["=1+1", "+A1", "-A1", "@SUM(A1)", "\t=1", "\n=1", " =1", "＝1", "'=1", "-", "-inf", "+1,5", "=-1"],
)
def test_what_a_spreadsheet_would_compute_is_text(text):
    assert as_cell(text).startswith("'")
    assert of_cell(as_cell(text)) == text


@pytest.mark.parametrize(
    "text", ["-1.5", "+3", "1e-3", " -0.25 ", "-.5E+3", "", "Li, M.", "a=b", "it's", "'"]
)
def test_numbers_stay_numbers_and_plain_text_stays_as_it_is(text):
    assert as_cell(text) == text == of_cell(text)


@pytest.mark.parametrize("cell", [r"C:\x1bfoo\bar", "'plain", r"C:\data", r"\U00110000"])
def test_cells_of_others_come_back_as_they_are(cell):
    assert of_cell(cell) == cell


awkward = st.text(st.sampled_from("\\\\'=+-@\t\r\nxu1b0a2\x1b\x9b\u202e\u2028\ud800 "), max_size=12)


@given(awkward | st.text(st.characters(exclude_categories=())))
def test_every_text_comes_back_and_none_acts(text):
    cell = as_cell(text)
    assert of_cell(cell) == text
    assert visible(cell) == cell
    cell.encode()


def test_a_file_of_readings_is_safe_and_reads_back(tmp_path):
    note = '=HYPERLINK("http://a")\x1b[2J'
    out = io.StringIO()
    csv.writer(out).writerows(
        [[*HEADER.split(","), "=note"], ["1", "1", "1", "-45", "-0.1", "0.2", "0.3", note]]
    )
    (tmp_path / "r.csv").write_text(out.getvalue(), encoding="utf-8", newline="")
    table = read_csv(tmp_path / "r.csv", ["1", "2"])
    written = format_csv(table)
    head, cells = csv.reader(io.StringIO(written, newline=""))
    assert "'=note" in head
    assert not any(cell.startswith(("=", "+", "@", "\t")) for cell in cells if cell != "+0")
    assert "\x1b" not in written
    assert float(cells[head.index("ux_v")]) == -0.1
    (tmp_path / "again.csv").write_text(written, encoding="utf-8", newline="")
    again = read_csv(tmp_path / "again.csv", ["1", "2"])
    assert again.extra["=note"].tolist() == [note]
    assert np.array_equal(again.signal, table.signal)
