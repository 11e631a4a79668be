"""The numbers of the plots of a run: those of its results, as JSON and as tables that read back to the same."""

import csv
import io
import json
import shutil

import numpy as np
import openpyxl
import pytest

from bench.panel.folder import RunsFolder
from bench.panel.pages.verdict import plots_of
from bench.run.folder import Run
from bench.services.calibration import calibration_of
from bench.services.source import Request, load_sources
from tests.support.pages import ROOT
from tests.support.panel_client import Browser, stranger
from tests.support.plotted_runs import make_plotted

pytestmark = pytest.mark.slow
NAMES = ("residuals", "delta-g", "diagnosis", "diagnosis-delta-g", "held-out", "ranking")


@pytest.fixture(scope="module")
def plotted(tmp_path_factory):
    """Runs that many tests look at."""
    return make_plotted(tmp_path_factory.mktemp("plotted"))


@pytest.fixture
def runs(plotted, tmp_path):
    """A copy of them, to be written to."""
    shutil.copytree(plotted, tmp_path / "runs")
    return tmp_path / "runs"


@pytest.fixture(scope="module")
def anna(plotted):
    return Browser(plotted, "anna")


@pytest.fixture(scope="module")
def told(anna):
    return anna.get("/runs/later/plots/data").json()


def rows_of(reply):
    lines = [line for line in reply.text.splitlines() if not line.startswith("#")]
    return list(csv.DictReader(io.StringIO("\n".join(lines))))


def test_the_residuals_are_those_of_the_calibration(told, plotted):
    (source,) = load_sources(Request([str(plotted / "later")], plotted))
    found = calibration_of(source).calibration
    points = told["residuals"]["points"]
    assert np.allclose([p["residual"] for p in points], found.residuals, rtol=1e-5, atol=0)
    assert np.allclose([p["angle_deg"] for p in points], np.degrees(found.fitted.angle_rad))
    assert [p["time_s"] for p in points] == found.fitted.time_s.tolist()
    assert np.all(np.array([p["u"] for p in points]) >= found.noise.by_channel.min() * 0.9)
    assert told["trouble"] == []


def test_delta_g_and_the_previous_run_are_those_of_their_results(told, plotted):
    for part, run in ((told, "later"), (told["previous"], "earlier")):
        verify = json.loads((plotted / run / "verify.json").read_text())
        assert part["delta_g"]["limit_g"] == verify["limit_g"]
        for mine, its in zip(part["delta_g"]["points"], verify["points"], strict=True):
            assert all(mine[name] == its[name] for name in ("delta_g", "u", "U", "angle_deg", "passed"))
            assert mine["time_s"] > 0
    assert told["previous"]["run"] == "earlier"
    assert len(told["previous"]["residuals"]["points"]) == len(told["residuals"]["points"])


def test_what_the_diagnosis_draws_is_in_its_result_and_plotted_from_there(told, plotted):
    result = json.loads((plotted / "later" / "diagnose.json").read_text())
    diagnosis = told["diagnosis"]
    assert diagnosis["residuals"] == result["residuals"]
    assert diagnosis["held_out"][0]["before"] == result["gap"]["held_out"][0]["before"]
    assert diagnosis["ranking"][0]["found"] == "quadratic_nonlinearity"
    for model in ("before", "after"):
        its = [point["delta_g"] for point in result["simulation"][model]["delta_g"]]
        assert [point["delta_g"] for point in diagnosis["delta_g"][model]] == its
    readings = result["residuals"]["readings"]
    before, after, simulated = (
        np.array([one[name] for one in readings]) for name in ("before", "after", "simulated")
    )
    mine = [point["residual"] for point in told["residuals"]["points"]]
    assert np.allclose(before, mine, rtol=1e-4, atol=1e-9)
    assert np.std(before[:, 1]) > 3 * np.std(after[:, 1])
    assert np.std(simulated[:, 1]) == pytest.approx(np.std(after[:, 1]), rel=0.5)


@pytest.mark.parametrize("name", NAMES)
def test_a_table_reads_back_to_the_numbers_of_the_json(anna, told, name):
    reply = anna.get(f"/runs/later/plots/{name}.csv")
    assert reply.headers["content-disposition"] == "attachment"
    assert reply.text.startswith("# SIMULATED")
    rows = rows_of(reply)
    flat = {
        "residuals": [
            p["residual"][1] for one in (told, told["previous"]) for p in one["residuals"]["points"]
        ],
        "delta-g": [p["delta_g"] for one in (told, told["previous"]) for p in one["delta_g"]["points"]],
        "diagnosis": [p["after"][1] for p in told["diagnosis"]["residuals"]["readings"]],
        "diagnosis-delta-g": [p["U"] for m in ("before", "after") for p in told["diagnosis"]["delta_g"][m]],
        "held-out": [fold["after"] for fold in told["diagnosis"]["held_out"]],
        "ranking": [one["ln_odds"] for each in told["diagnosis"]["ranking"] for one in each["rivals"]],
    }[name]
    column = {"residuals": "residual_y", "delta-g": "delta_g", "diagnosis": "after_y"}.get(name)
    column = column or {"diagnosis-delta-g": "U", "held-out": "after", "ranking": "ln_odds"}[name]
    assert [float(row[column]) for row in rows] == flat
    workbook = anna.get(f"/runs/later/plots/{name}.xlsx").content
    sheet = openpyxl.load_workbook(io.BytesIO(workbook))[name]
    head, *cells = sheet.iter_rows(values_only=True)
    assert list(head) == list(rows[0])
    assert [row[head.index(column)] for row in cells] == pytest.approx(flat, rel=1e-14, abs=0)
    assert sheet.oddHeader.center.text == "SIMULATED"


def test_the_live_plot_has_its_table_and_the_previous_runs_points(anna):
    rows = rows_of(anna.get("/runs/later/plots/live.csv"))
    assert len(rows) == 58
    assert float(rows[-1]["u_x"]) > 0
    earlier = anna.get("/runs/later/plots/previous").json()
    assert (earlier["run"], len(earlier["points"])) == ("earlier", 58)
    assert anna.get("/runs/earlier/plots/previous").json()["points"] == []


@pytest.mark.parametrize("path", ["plots", "plots/data", "plots/previous", "plots/residuals.csv"])
def test_only_who_is_signed_in_sees_numbers(plotted, path):
    reply = stranger(plotted).get(f"/runs/later/{path}", headers={"accept": "application/json"})
    assert reply.status_code == 401
    assert "residual" not in reply.text


@pytest.mark.parametrize("path", ["else.csv", "residuals.pdf", "held-out.csv"])
def test_a_table_that_is_not_there_is_not_found(anna, path):
    assert anna.get(f"/runs/earlier/plots/{path}").status_code == 404


def test_pages_lead_to_the_plots_and_a_run_without_results_says_so(runs):
    bert = Browser(runs, "bert")
    assert 'href="/runs/later/plots"' in bert.get("/runs/later/verdict").text
    assert 'href="/runs/later/plots">Plots</a>' in bert.get("/runs/later/").text
    assert "being computed" in bert.get("/runs/later/plots").text
    shutil.copytree(ROOT / "tests" / "data" / "records" / "finished", runs / "none")
    assert "no results to plot yet" in bert.get("/runs/none/plots").text
    told = bert.get("/runs/none/plots/data").json()
    assert told["residuals"] is told["delta_g"] is told["diagnosis"] is told["previous"] is None
    assert told["trouble"] == ["none has no calibration yet."]


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("verify.json", "["),
        ("verify.json", '{"points": 1}'),
        ("diagnose.json", '{"verdict": 1, "simulation": {"before": 3}}'),
    ],
)
def test_a_damaged_result_is_said_to_be_one(runs, file, text):
    (runs / "later" / file).write_text(text)
    told = plots_of(Run(runs / "later"), RunsFolder(runs))
    assert [words for words in told["trouble"] if f"{file}: cannot be read" in words]
    assert told["residuals"]["points"]


def test_a_diagnosis_without_residuals_is_plotted_as_far_as_it_goes(runs):
    file = runs / "later" / "diagnose.json"
    result = json.loads(file.read_text())
    del result["residuals"]
    file.write_text(json.dumps(result))
    told = plots_of(Run(runs / "later"), RunsFolder(runs))
    assert told["diagnosis"]["residuals"] is None
    assert told["diagnosis"]["older"]
    assert told["diagnosis"]["delta_g"]["after"]
