"""Pages of results: what was found, rounded as a metrologist rounds; each stands alone."""

import re
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from html.parser import HTMLParser

import numpy as np
import pytest

from bench.base.numbers import concise, fixed, rounded, scale_for
from bench.calibration import calibrate
from bench.calibration.verification import verify
from bench.history.control_chart import CheckRun, control_chart
from bench.model import ForwardModel
from bench.model.geometry import COEFFICIENTS, INSTALLATION_1, INSTALLATION_2
from bench.readings.table import make_readings
from bench.results import plots
from bench.results.control_chart import CheckBlockChart, render_chart
from bench.results.page import render_report
from bench.results.records import render_commissioning
from bench.stats.control_charts import ChartDesign
from bench.validation.paper_bench import STAND_U, TRUTH, simulate
from bench.validation.registry import REFERENCE

MODEL = ForwardModel({"1": INSTALLATION_1, "2": INSTALLATION_2})


class Text(HTMLParser):
    """The text of a page, and every address that it refers to."""

    def __init__(self, page):
        super().__init__()
        self.words, self.addresses = [], []
        self.feed(page)

    def handle_data(self, data):
        self.words.append(data)

    def handle_starttag(self, tag, attributes):
        self.addresses += [
            value for name, value in attributes if name in {"src", "href", "xlink:href", "data"}
        ]

    @property
    def text(self):
        return " ".join("".join(self.words).split())


@pytest.fixture(scope="module")
def calibration():
    return calibrate(simulate(np.random.default_rng([5, 1]), 1e-4), MODEL, STAND_U, 9.81)


def report(calibration, verification=None, *, title="T", **given):
    others = {"compared": None, "provenance": {}, "notes": (), "skipped": (), "simulated": False}
    return render_report(title, calibration, verification, **(others | given))


def verification_of(calibration, delta_g=0.0, missing=0, limit=3e-4, rule=None):
    angle = np.radians([45.0, 135.0, 225.0, 315.0])
    turned = np.stack([np.sin(angle) / np.sqrt(2), -np.sin(angle) / np.sqrt(2), np.cos(angle)], axis=1)
    signal = calibration.block.output(turned * (1 + delta_g))
    rows = make_readings(["V"] * 4, [1] * 4, [1, 2, 3, 4], angle, signal)
    rows = replace(rows, verification_missing=missing)
    known = calibration.block, calibration.covariance, calibration.noise.reading
    return verify(rows, *known, limit, rule=rule)


def test_coefficients_stand_there_rounded_to_two_digits_of_u(calibration):
    text = Text(report(calibration)).text
    for name, value, u in zip(COEFFICIENTS, calibration.block.vector, calibration.u, strict=True):
        decimals = 1 - int(np.floor(np.log10(u)))
        # independent of the page's own rounding: Python's format and the digits of u
        expected = f"{value:.{decimals}f}".replace("-", "−") + f"({round(u * 10**decimals)})"
        assert expected in text, name


def test_the_verdict_is_said_first_and_in_words(calibration):
    passed = report(calibration, verification_of(calibration, 1e-4))
    failed = report(calibration, verification_of(calibration, 5e-4))
    assert "Verification passed" in passed
    assert "Verification failed" in failed
    assert "outside the limit: 4 of 4 verification points." in failed
    assert failed.index("Verification failed") < failed.index("Model and coefficients")
    missing = report(calibration, verification_of(calibration, missing=2))
    assert "Verification not complete" in missing
    assert "2 verification points are missing" in missing


def test_a_verdict_that_is_not_sure_says_so_in_words(calibration):
    result = verification_of(calibration, 2.8e-4, rule="simple")
    page = Text(report(calibration, result)).text
    assert "✓ Verification: conditional pass, accepted" in page
    assert f"Probability of false acceptance {result.p_outside:.2g}" in page
    assert "t 4 of 4 verification points, |Δg| is within the limit by less than the guard band" in page
    unstated = verification_of(calibration, 2.8e-4)
    page = Text(report(calibration, unstated)).text
    assert "– Verification: conditional pass, the customer decides" in page
    assert "non-binary (false acceptance ≤ 5 % a point)" in page
    assert "reduce u(Δg) to" in page
    nothing = verification_of(calibration, 1e-5, limit=5e-5)
    page = Text(report(calibration, nothing)).text
    assert "– Verification inconclusive" in page
    assert "larger than the limit of 50 µg, so conformity cannot be decided" in page


def test_without_verification_points_nothing_is_claimed(calibration):
    text = Text(report(calibration)).text
    assert "Not verified" in text
    assert "so there is no verdict" in text


def test_what_a_user_wrote_cannot_become_markup(calibration):
    page = report(calibration, title="<b>T</b>", provenance={"operator": "<script>alert(1)</script>"})
    assert "<script>" not in page
    assert "<script>alert(1)</script>" in Text(page).text
    assert "<b>T</b>" in Text(page).text


@pytest.mark.slow(6)
@pytest.mark.figures
def test_the_page_stands_alone_and_draws_every_reading_and_the_same_each_time(calibration):
    """54 readings of three channels, each drawn once against the angle: a marker is a <use> in the drawing."""
    page = report(calibration, verification_of(calibration), simulated=True)
    drawing = plots.residuals_by_angle(calibration)
    assert drawing in page
    assert len(re.findall(r"<use ", drawing)) >= 3 * len(calibration.fitted)
    outside = [a for a in Text(page).addresses if a and not a.startswith(("#", "data:"))]
    assert outside == []
    assert "url(http" not in page
    assert len(page) < 1_000_000


def test_a_simulated_run_is_marked(calibration):
    page = report(calibration, title="Блок 17", simulated=True)
    assert "SIMULATED" in page
    assert "Блок 17" in page
    assert "SIMULATED" not in report(calibration)


def test_what_the_data_do_not_tell_is_marked(calibration):
    text = Text(report(calibration)).text
    assert "no better known than before" in text  # alpha2: held by its limits alone
    assert "mounting_roll" in text
    assert "−10.4 µV/g" in text


def test_other_units_and_notes(calibration):
    counts = replace(calibration, unit="counts")
    text = Text(report(counts, notes=("run unfinished",), skipped=("line 4",))).text
    assert "counts/g" in text
    assert "run unfinished" in text
    assert "line 4" in text


def test_the_comparison_with_another_estimator_is_shown(calibration):
    other = calibrate(calibration.fitted, MODEL, STAND_U, 9.81, "closed-form")
    page = report(calibration, compared=other)
    assert "Comparison with another estimator" in page
    assert "Comparison with another estimator" not in report(calibration, compared=calibration)


def test_numbers_are_rounded_as_the_guide_says():
    """JCGM 100:2008, 7.2.6: two digits of u, the value to the same place."""
    assert concise(-2.1770871, 0.0000204) == "−2.177087(20)"
    assert rounded(33102.2239, 123.4) == "33100"
    assert fixed(-0.00001, 3) == "0.000"
    assert scale_for(9.8e-5, "V").unit == "µV"


@pytest.mark.slow
def test_free_positions_alone_have_no_stand_and_no_block_that_nobody_named(bench, tmp_path):
    """The page of readings without a bench file does not name the block of the shipped one."""
    file = REFERENCE / "xsens-38.csv"
    assert bench("report", file, "--g", "9.81744", "--out", "o")[0] == 0
    page = (tmp_path / "o" / "xsens-38.html").read_text(encoding="utf-8")
    assert "triaxial block of the paper" not in page
    assert "No reading had a known orientation" in page
    assert "Setting error" not in page
    assert page.count("by convention") >= 3
    assert "0.000000000" not in page


def result(status, *findings, **more):
    return {
        "bench": "b<ench>", "bench_file": "bench.yaml", "simulated": False, "status": status, "ended": "",
        "began": "2026-11-22T20:00:00+00:00", "took_s": 780.0, "findings": list(findings), "to_do": {},
        "instruments": [{"name": "head", "address": "by hand", "identity": None}], "wire_log": "wire.log",
        "versions": {}, **more,
    }  # fmt: skip


def finding(state, said, remedy=""):
    figure = {"what": "took", "value": 1.23456, "unit": "s", "expected": "1 s"}
    told = {"state": state, "said": said, "figures": [figure], "remedy": remedy}
    return {"check": "stop", "instrument": "head", **told}


def test_what_is_wrong_stands_first_with_what_to_do_and_is_escaped():
    findings = finding("works", "fine"), finding("other", "<script>", "do <b>this</b>")
    page = render_commissioning(result(1, *findings, to_do={"head": "off"}))
    assert "<script>" not in page
    assert "b&lt;ench&gt;" in page
    assert page.index("&lt;script&gt;") < page.index("Every check") < page.index("fine")
    assert "Do &lt;b&gt;this" in page
    assert "1 do not work as expected" in page
    assert "head: off" in page
    assert "took 1.235 s (1 s)" in page
    assert "SIMULATED" not in page


def test_an_evening_that_ended_early_says_why():
    page = render_commissioning(result(2, ended="stopped by a signal"))
    assert "Ended early: stopped by a signal." in page
    assert "could not be tested" in page


NOTHING = np.zeros((12, 12))
U = 1e-4


def check_run(day: int, shift: float = 0.0) -> CheckRun:
    rng = np.random.default_rng(day)
    value = TRUTH + U * rng.normal(size=12)
    value[3] += shift * U
    when = datetime(2026, 3, 1, tzinfo=UTC) + timedelta(days=day)
    covariance = U**2 * np.eye(12)
    own = np.full(12, U / 2), 1e-4, 36.0, "plan", (), NOTHING, NOTHING
    return CheckRun(f"<check-{day}>", when, value, covariance, *own)


def page(later: list[CheckRun]) -> str:
    baseline = [check_run(day) for day in range(8)]
    nine = control_chart([run.in_nine() for run in baseline], [run.in_nine() for run in later], ChartDesign())
    twelve = control_chart(baseline, later, ChartDesign())
    return render_chart(CheckBlockChart(nine, twelve, "a block <1>", "V", 9.81, True, ("a note",)))


@pytest.mark.slow
def test_the_page_shows_the_verdict_the_charts_and_what_is_behind_them():
    html = page([check_run(8), check_run(9, shift=20.0)])
    assert "✗ Out of control" in html
    assert "SIMULATED" in html
    assert "<check-9>" not in html
    assert "&lt;check-9&gt;" in html
    assert len(re.findall("<svg ", html)) == 2
    assert not re.findall(r"(?:src|href)=\"http", html)
    assert "Short term and long term" in html
    assert re.search(r'class="bad"><th scope="row"><i>θ</i><sub>xy</sub>', html)
    assert re.search(r'class="bad"><th scope="row"><i>K</i><sub>yx</sub>', html)


def test_without_a_run_to_judge_there_is_no_chart():
    html = page([])
    assert "No verdict yet" in html
    assert "NO VERDICT yet: &lt;check-7&gt; is the first" in html
    assert "<svg " not in html
