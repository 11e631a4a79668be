"""The page of a control chart."""

import re
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from bench.history.control_chart import CheckRun, control_chart
from bench.results.control_chart import CheckBlockChart, render_chart
from bench.stats.control_charts import ChartDesign
from bench.validation.paper_bench import TRUTH

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
