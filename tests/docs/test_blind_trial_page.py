"""The tables of the blind trial on the page are those of the stored result, and a trial can write them."""

import json

import pytest

from benchmarks.blind_trial import page, run
from benchmarks.blind_trial.run import FULL
from docs.generators import PAGES


@pytest.fixture(scope="module")
def result():
    return json.loads(page.STORED.read_text(encoding="utf-8"))


def test_the_stored_result_is_of_every_row_of_the_trial(result):
    rows = run.of_share(FULL, result["share"])
    assert [row["row"] for row in result["rows"]] == [row.key for row in rows]
    assert result["cases"] == sum(row.count for row in rows)
    for row, stored in zip(rows, result["rows"], strict=True):
        assert stored["rho"] == row.rho
        assert all(0 <= right <= of <= row.count for right, of in stored["score"].values())


def test_a_result_is_stored_and_its_counts_stand_in_the_tables(result, tmp_path):
    result = json.loads(json.dumps(result))
    result["rows"][0]["score"]["agrees"] = [700, 800]
    page.write(result, tmp_path / "stored.json")
    assert json.loads((tmp_path / "stored.json").read_text(encoding="utf-8")) == result
    assert "| paper 15 uV | 0.875 (700/800; " in page.part(result)


def test_the_site_shows_the_stored_result(result):
    assert PAGES["_blind-trial.md"]() == page.part(result)


def test_a_part_of_the_trial_cannot_be_written_into_the_page(capsys):
    for part in (["--short"], ["--rows", "3"], ["--only", "null"]):
        with pytest.raises(SystemExit):
            run.main(["--page", *part])
        assert "--page is for the whole trial" in capsys.readouterr().err
