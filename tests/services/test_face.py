"""`import bench`: what a notebook does with it, beside what the commands answer."""

import errno
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import bench as program
from bench.readings.csv import write_csv
from bench.services.errors import in_python, refusing
from bench.validation.paper_bench import K
from tests.support.diagnosis_bench import paper_run
from tests.support.honest_runs import simulate_few


@pytest.fixture
def readings(empty_folder):
    """A readings file in the working folder."""
    write_csv(paper_run(np.random.default_rng(3)), Path("r.csv"))
    return Path("r.csv")


def test_a_calibration_is_that_of_the_command(bench, readings):
    result = program.calibrate(readings, estimator="robust", g=9.81)
    status, out, _ = bench("calibrate", "r.csv", "--estimator", "robust", "--g", "9.81", "--json", "-")
    assert (status, result.to_dict()) == (0, json.loads(out))
    first = result.coefficients["Kxx"]
    written = result.to_dict()["coefficients"]["Kxx"]
    assert [getattr(first, name) for name in ("value", "u", "u_readings", "U", "k")] == [
        written[name] for name in ("value", "u", "u_readings", "U", "k")
    ]
    assert first.dof == written["dof"]
    assert 0 < first.u_readings < first.u == first.U / 2
    assert abs(first.value - K[0, 0]) < 4 * first.u
    assert (first.unit, result.coefficients["U0x"].unit) == ("V/g", "V")
    assert result.covariance.shape == (12, 12)
    assert np.allclose(np.sqrt(np.diag(result.covariance)), [c.u for c in result.coefficients.values()])


def test_a_calibration_of_a_frame_is_five_lines(readings, monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")  # a narrow terminal cuts no table
    import pandas as pd

    frame = pd.read_csv("r.csv")
    result = program.calibrate(frame)
    assert np.array_equal(result.covariance, program.calibrate(readings).covariance)
    assert "paper-stand, the shipped one, because no file was named" in repr(result)
    assert "Calibration of DataFrame: gls" in repr(result)
    html = result._repr_html_()
    for coefficient in result.coefficients:
        assert f"\n{coefficient} " in repr(result)
        assert f">{coefficient}</td>" in html
    named = program.calibrate(frame, bench=program.load_bench("paper-stand"))
    assert named.bench == "paper-stand, as given"


def test_a_frame_is_read_as_strictly_as_its_file(readings):
    import pandas as pd

    frame = pd.read_csv("r.csv")
    frame["direction"] = frame["direction"].astype(float)
    frame.loc[0, "direction"] = np.nan
    frame.loc[0, "time_s"] = None
    read = program.read_readings(frame)
    assert read.direction[0] == 0
    assert np.isnan(read.time_s[0])
    assert read.installation.tolist() == program.read_readings(readings).installation.tolist()
    only_one = frame[frame["installation"] == "1"].copy()
    only_one["installation"] = 1.0
    assert set(program.read_readings(only_one).installation) == {"1"}
    frame.loc[2, "ux_v"] = 9.9e37
    with pytest.raises(program.ReadingsError, match=r"DataFrame, line 4, column ux_v: the voltmeter"):
        program.read_readings(frame)
    assert len(program.read_readings(frame, skip_bad_rows=True)) == len(frame) - 1


def test_a_frame_with_a_column_twice_is_refused_and_a_missing_value_of_pandas_is_an_empty_cell(readings):
    import pandas as pd

    frame = pd.read_csv("r.csv")
    with pytest.raises(program.ReadingsError, match="column ux_v appears more than once; keep one"):
        program.calibrate(pd.concat([frame, 2 * frame[["ux_v"]]], axis=1))
    missing = frame.convert_dtypes()
    missing.loc[2, "time_s"] = pd.NA
    missing.loc[len(missing)] = pd.NA
    read = program.read_readings(missing)
    assert np.flatnonzero(np.isnan(read.time_s)).tolist() == [2]
    assert np.array_equal(read.signal, program.read_readings(readings).signal)


@pytest.mark.slow
def test_a_table_that_contradicts_others_in_memory_is_left_out_alone(empty_folder):
    import pandas as pd

    frames = []
    for seed in range(4):
        write_csv(paper_run(np.random.default_rng(seed)), Path("r.csv"))
        frames.append(pd.read_csv("r.csv"))
    frames[2]["ux_v"] += 3e-3 * np.random.default_rng(5).normal(size=len(frames[2]))
    found = program.learn(frames, bench="paper-stand").learned
    assert found.runs == ("DataFrame 1", "DataFrame 2", "DataFrame 4")
    assert {one.run for one in found.contradicting} == {"DataFrame 3"}


@pytest.mark.slow
def test_a_verification_is_that_of_the_command(bench, readings):
    verdict = program.verify(readings, rule="guarded", limit=2e-4)
    _, out, _ = bench("verify", "r.csv", "--rule", "guarded", "--limit", "2e-4", "--json", "-")
    assert verdict.to_dict() == json.loads(out)
    assert verdict.passed == verdict.to_dict()["passed"]
    assert "limit 200 µg, rule: guarded" in repr(verdict)


def test_coefficients_of_another_day_are_a_result_or_its_file(readings):
    before = program.calibrate(readings)
    Path("c.json").write_text(json.dumps(before.to_dict()), encoding="utf-8")
    write_csv(paper_run(np.random.default_rng(4)), Path("later.csv"))
    by_result = program.verify("later.csv", coefficients=before).to_dict()
    assert by_result == program.verify("later.csv", coefficients="c.json").to_dict()
    assert by_result != program.verify("later.csv").to_dict()


@pytest.mark.slow
def test_a_budget_is_that_of_the_command(bench):
    found = program.budget(procedure="paper", trials=0, estimator="closed-form")
    _, out, _ = bench(
        "budget", "--procedure", "paper", "--trials", "0", "--estimator", "closed-form", "--json", "-"
    )
    assert json.loads(json.dumps(found.to_dict())) == json.loads(out)
    assert "combined u" in repr(found)
    assert "mounting_error" in found._repr_html_()


@pytest.mark.slow
def test_a_dry_run_leaves_nothing_and_is_that_of_the_command(bench):
    done = program.dry_run("quick", seed=5)
    assert list(Path().iterdir()) == []
    bench("run", "quick", "--dry-run", "--seed", "5", "--name", "typed")
    typed = program.calibrate("typed")
    assert np.array_equal(done.readings.signal, typed.source.readings.signal)
    assert np.array_equal(done.calibration.covariance, typed.covariance)
    assert done.verification.passed
    assert "paper-stand, as the run recorded it" in repr(done)
    assert typed.bench == "paper-stand, as the run recorded it"
    kept = program.dry_run("quick", name="kept", runs="mine")
    assert kept.run.folder == Path("mine/kept")
    assert program.calibrate("kept", runs="mine").to_dict()["simulated"] is True


@pytest.mark.slow
def test_a_page_is_written_where_it_is_asked_for_and_nothing_else_is(readings, capsys):
    result = program.calibrate(readings)
    result.report("page.html")
    program.budget(trials=0).report(Path("budget.html"))
    assert "Calibration of r.csv" in Path("page.html").read_text(encoding="utf-8")
    assert "combined u" in Path("budget.html").read_text(encoding="utf-8")
    assert sorted(p.name for p in Path().iterdir()) == ["budget.html", "page.html", "r.csv"]
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("call", "error", "text"),
    [
        (lambda: program.calibrate("r.csv", g=12.0), program.Refused, r"^g=12: give local gravity"),
        (lambda: program.calibrate("no.csv"), program.Refused, "no such readings file"),
        (lambda: program.calibrate("no-run"), program.RecordError, "no-run"),
        (lambda: program.calibrate("r.csv", bench="no-bench"), program.FileMistakes, "shipped are"),
        (lambda: program.calibrate("r.csv", estimator="best"), program.CalibrationError, "gls"),
        (lambda: program.verify("r.csv", limit=-1.0), program.Refused, r"^limit=-1.0: give a positive limit"),
        (lambda: program.dry_run("no-procedure"), program.FileMistakes, "shipped are"),
    ],
)
def test_what_cannot_be_done_says_why(readings, call, error, text):
    with pytest.raises(error, match=text):
        call()


def test_messages_name_arguments_of_python(readings):
    text = Path("r.csv").read_text().splitlines()
    Path("bad.csv").write_text("\n".join([*text, text[-1]]) + "\n")
    with pytest.raises(program.ReadingsError, match=r"skip them with skip_bad_rows=True$"):
        program.calibrate("bad.csv")
    program.dry_run("quick", name="a", runs="mine")
    with pytest.raises(program.RecordError, match=r"exists; choose another with name$"):
        program.dry_run("quick", name="a", runs="mine")


@pytest.mark.parametrize("path", ["no/such/r.html", None])
def test_a_path_that_cannot_be_written_is_named_in_an_error_of_the_library(readings, path):
    result = program.calibrate("r.csv")
    for write in (result.report, lambda to: result.write(to, "c"), program.budget(trials=0).report):
        with pytest.raises(program.RecordError, match=f"^{path or 'path=None'}: "):
            write(path)


def test_without_gravity_nothing_is_believed(readings):
    stand = program.load_bench("paper-stand").model_copy(update={"gravity": None})
    with pytest.raises(program.Refused, match=r"paper-stand: gives no local gravity; .*give g=9\.81"):
        program.calibrate(readings, bench=stand)
    assert program.calibrate(readings, bench=stand, g=9.8).g_m_s2 == 9.8


def test_few_readings_rest_on_the_bench_file_where_it_states_their_noise(empty_folder):
    """Four readings leave nothing over: in V the bench file has their noise, in m/s² nobody has."""
    few = simulate_few(np.random.default_rng(1), "2+2", 1e-4)
    write_csv(few, Path("volts.csv"))
    assert program.calibrate("volts.csv").calibration.noise.reading == pytest.approx(1e-4)
    write_csv(replace(few, unit="m/s^2"), Path("other.csv"))
    with pytest.raises(program.CalibrationError, match="state voltmeter_error in the bench file"):
        program.calibrate("other.csv")


@pytest.mark.parametrize("number", [errno.EPIPE, errno.EFBIG, errno.ENOSPC])
def test_a_failed_writing_keeps_the_remedy_of_its_place(number):
    with pytest.raises(program.Refused, match=r"; the run is kept$"), refusing("the run is kept"):
        raise OSError(number, os.strerror(number), "file")


@pytest.mark.parametrize(
    "command",
    [
        "bench show a --verify",
        "bench fleet effects type='block A' --strict",
        """bench show 'it'"'"'s' --runs 'my runs'""",
    ],
)
def test_a_command_in_a_message_stays_as_typed(command):
    assert in_python(f"use '{command}' with --g 9.81") == f"use '{command}' with g=9.81"
