"""The shipped bench files: each passes a dry run, and its head can be turned as the procedures demand."""

import io
import json
from contextlib import redirect_stderr, redirect_stdout
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from bench.cli.app import main
from bench.config.bench_file.file import load_bench
from bench.config.procedure.load import load_procedure
from bench.config.procedure.plan import Turn
from bench.config.shipped import find_bench, find_procedure
from bench.run.folder import Run

BENCHES = sorted(path.stem for path in find_bench("paper-stand").parent.glob("*.yaml"))
SHORT = """\
procedure: short
reading: {samples: 5, nplc: 10, settle: 5 s}
steps:
  - installation: {label: 1, steps: [turn: {angles: {from: 0 deg, step: 90 deg, count: 4}}]}
  - installation: {label: 2, steps: [turn: {angles: {from: 0 deg, step: 90 deg, count: 4}}]}
  - installation: {label: V, steps: [turn: {angles: [45 deg, 225 deg]}]}
"""
MOTORISED = ("bench-motorised", "bench-rate-table", "bench-stand")


@pytest.fixture(scope="module")
def run_on(tmp_path_factory):
    """Return a function that makes a dry run on a shipped bench, once: its status, what it printed, its folder.

    The report is left out: it is the same on every bench, and drawing it takes ten times as long as the run.
    """
    folder = tmp_path_factory.mktemp("benches")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bench.results.page.render_report", lambda *_, **__: "")
        patch.delenv("BENCH_FILE", raising=False)
        patch.chdir(folder)
        Path("short.yaml").write_text(SHORT, encoding="utf-8")

        @cache
        def call(name):
            words = f"run short.yaml --dry-run --bench {name} --name {name} --seed 3 --rule simple"
            out, err = io.StringIO(), io.StringIO()
            with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as end:
                main(words.split())
            assert err.getvalue() == ""
            return end.value.code, out.getvalue(), folder / "runs" / name

        yield call


@pytest.mark.slow
@pytest.mark.parametrize("name", BENCHES)
def test_a_dry_run_passes(run_on, name):
    status, out, folder = run_on(name)
    assert status == 0
    said = f"{name} (SIMULATED)"
    assert f"{said}: PASSED" in out or f"{said}: CONDITIONAL PASS, accepted" in out
    readings = Run(folder).readings()
    targets = [step.target_rad for step in Run(folder).plan.steps if isinstance(step, Turn)]
    file = load_bench(find_bench(name))
    assert np.abs(readings.angle_rad - targets).max() <= file.instruments.head.tolerance
    # 5 σ: of 9 coefficients on 8 benches none is outside by chance.
    result = json.loads((folder / "calibrate.json").read_text())["coefficients"]
    truth = file.simulated_block()
    for row, i in enumerate("xyz"):
        for column, j in enumerate("xyz"):
            told = result[f"K{i}{j}"]
            assert abs(told["value"] - truth.K[row, column]) < 5 * told["u"]


@pytest.mark.parametrize("name", MOTORISED)
def test_every_turn_of_the_shipped_procedures_lies_within_the_motorised_heads(name):
    file = load_bench(find_bench(name))
    lowest, highest = file.head_limits_rad
    for path in find_procedure("paper").parent.glob("*.yaml"):
        for step in load_procedure(path).plan.steps:
            if isinstance(step, Turn):
                begins = step.target_rad - step.direction * file.head_backoff_rad
                assert lowest <= min(begins, step.target_rad)
                assert max(begins, step.target_rad) <= highest


def test_installations_are_the_same_on_every_bench():
    models = [load_bench(find_bench(name)).installation_models() for name in BENCHES]
    assert {tuple(known) for known in models} == {("1", "2", "V", "1T90", "2T90", "1T180", "2T180")}
    for known in models:
        for label, installation in known.items():
            assert np.array_equal(installation.block_from_platform, models[0][label].block_from_platform)


@pytest.mark.slow
def test_the_wire_does_not_show_in_the_readings(run_on):
    """Three 34401A over GPIB, a GPIB adapter and serial ports: the same seed, the same world, the same values."""
    told = []
    for name in ("bench-gpib", "bench-prologix", "bench-rs232"):
        readings = Run(run_on(name)[2]).readings()
        told.append(np.column_stack([readings.signal, readings.angle_rad]))
    assert np.array_equal(told[0], told[1])
    assert np.array_equal(told[0], told[2])
