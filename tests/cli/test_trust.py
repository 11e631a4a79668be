"""What must never be believed silently: missing points, another gravity, swapped wires, copies."""

import json
import os
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.readings.csv import write_csv
from bench.run.folder import Run
from bench.services.bodies import whole_body
from bench.services.requests.evaluation import Diagnose
from tests.support.commands import printed, refused


@pytest.fixture
def measured(bench, paper_run):
    """A run "good", and its readings."""
    Path("runs/run").rename("runs/good")
    return Run(Path("runs/good")).readings()


@pytest.mark.slow
def test_a_verification_point_that_is_missing_is_not_passed_over(bench, measured):
    write_csv(measured, Path("r.csv"))
    lines = Path("r.csv").read_text().splitlines()
    lines[-2] = re.sub(r",-?\d+\.\d+,", ",9.9E37,", lines[-2], count=1)
    lines[-2] = ",".join([*lines[-2].split(",")[:10], "9.9E37", *lines[-2].split(",")[11:]])
    Path("v.csv").write_text("\n".join(lines))
    printed(bench("verify", "v.csv", "--skip-bad-rows"), "1 verification point is missing", status=1)
    assert json.loads(bench("verify", "v.csv", "--skip-bad-rows", "--json", "-")[1])["missing"] == 1


@pytest.mark.slow
def test_a_run_that_stopped_before_its_last_points_is_not_verified(bench, monkeypatch):
    from bench.run.runner import Recorder

    original = Recorder.emit

    def emit(self, kind, **data):
        original(self, kind, **data)
        if data.get("key", "").endswith("read/V.1.2") and kind == "step_done":
            raise KeyboardInterrupt

    monkeypatch.setattr(Recorder, "emit", emit)
    assert bench("run", "quick", "--dry-run", "--name", "part")[0] == 2
    printed(
        bench("verify", "part"),
        "2 verification points are missing",
        "the run is interrupted: 20 of 22 planned readings were taken",
        status=1,
    )
    assert bench("report", "part")[0] == 1
    assert "20 of 22 planned readings" in Path("runs/part/report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_coefficients_of_another_place_are_compared_with_the_gravity_here(bench, measured):
    """A block calibrated where g is 9.81 m/s² measures 9.7803/9.81 of that at the equator; closed form."""
    bench("calibrate", "good", "--g", "9.81", "--json", "c.json")
    scale = 9.7803 / 9.81
    bias = np.array([0.071469, -0.196485, -0.411789])
    write_csv(replace(measured, signal=(measured.signal - bias) * scale + bias), Path("equator.csv"))
    out = printed(bench("verify", "equator.csv", "--coefficients", "c.json", "--g", "9.7803", "--json", "-"))
    assert abs(json.loads(out)["points"][0]["delta_g"]) < 2e-4
    assert bench("verify", "equator.csv", "--coefficients", "c.json", "--g", "9.81")[0] == 1


@pytest.mark.slow
def test_swapped_and_reversed_wires_are_named(bench, measured):
    write_csv(replace(measured, signal=measured.signal[:, [1, 0, 2]]), Path("swapped.csv"))
    write_csv(replace(measured, signal=measured.signal * [-1, 1, 1]), Path("reversed.csv"))
    for file, says in (
        ("swapped", "perhaps two channels or installations are swapped"),
        ("reversed", "wires is reversed"),
    ):
        printed(bench("calibrate", f"{file}.csv", "--strict"), says, status=1)
        assert bench("calibrate", f"{file}.csv")[0] == 0
    assert (
        "are swapped" in bench("calibrate", "swapped.csv", "--json", "-")[2]
    )  # standard output is JSON alone


def test_readings_rounded_coarsely_do_not_make_a_small_uncertainty(bench, measured):
    """Rounded to 10 mV the noise is at least 10 mV/sqrt(12), however equal the repeats are."""
    write_csv(replace(measured, signal=np.round(measured.signal, 2)), Path("coarse.csv"))
    result = json.loads(bench("calibrate", "coarse.csv", "--json", "-")[1])
    assert result["noise"]["reading_v"] >= 0.01 / np.sqrt(12) * 0.999
    truth = {"Kxy": -0.018243, "Kyx": 0.026542, "U0x": 0.071469}
    for name, value in truth.items():
        found = result["coefficients"][name]
        assert abs(found["value"] - value) < 5 * found["u"]


@pytest.mark.slow
def test_the_bench_file_of_the_run_is_used_unless_another_is_typed(bench, measured, monkeypatch):
    own = json.loads(bench("calibrate", "good", "--json", "-")[1])
    monkeypatch.setenv("BENCH_FILE", "bench-gpib")
    assert json.loads(bench("calibrate", "good", "--json", "-")[1])["g_m_s2"] == own["g_m_s2"]
    _, _, err = bench("calibrate", "good", "--bench", "bench-gpib", "--json", "-")
    assert "instead of the bench file that the run recorded" in err
    events = Path("runs/good/events.jsonl")
    events.write_text(events.read_text().replace('"samples_taken": 10', '"samples_taken": 9', 1))
    assert bench("calibrate", "good", "--bench", "bench-gpib")[0] == 2


@pytest.mark.slow
@pytest.mark.parametrize("manifest", ["{bad", "[]", '{"created": 5, "files": 3}', '{"imported": "x"}'])
def test_one_damaged_run_does_not_hide_the_others(bench, measured, manifest):
    Path("runs/broken").mkdir()
    Path("runs/broken/run.json").write_text(manifest)
    out = printed(bench("runs"))
    assert re.search(r"good .*finished", out)
    assert "broken" in out
    assert bench("calibrate", "nosuch")[0] == 2
    assert "no unfinished run" in bench("resume")[2] or "broken" in bench("runs")[1]


def test_readings_that_come_through_a_pipe_are_kept_whole(bench, measured):
    write_csv(measured, Path("r.csv"))
    reader, writer = os.pipe()
    with ThreadPoolExecutor(1) as pool, os.fdopen(writer, "wb") as into:
        pool.submit(lambda: (into.write(Path("r.csv").read_bytes()), into.close()))
        assert bench("import", f"/dev/fd/{reader}", "--name", "piped")[0] == 0
    os.close(reader)
    assert Path("runs/piped/readings.csv").read_bytes() == Path("r.csv").read_bytes()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names")
def test_a_pipe_to_which_nobody_writes_is_named(bench):
    """That no command waits for one, `test_special_files` shows."""
    os.mkfifo("pipe.csv")
    told = bench("import", "pipe.csv", "--name", "piped")
    refused(told, "pipe.csv: cannot be read (the pipe has no writer); check the command that writes into it")


def test_an_imported_run_is_not_taken_for_an_interrupted_one(bench, measured):
    write_csv(measured, Path("r.csv"))
    assert bench("import", "r.csv", "--name", "hand")[0] == 0
    assert "no unfinished run" in bench("resume")[2]
    assert "imported" in bench("resume", "hand")[2]
    assert bench("import", "r.csv", "--name", "../evil")[0] == 2
    assert not Path("evil").exists()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("calibrate", "good", "--g", "0"), "local gravity between"),
        (("calibrate", "good", "--g", "nan"), "local gravity between"),
        (("verify", "good", "--limit", "-1"), "give a positive limit"),
        (("verify", "good", "--limit", "nan"), "give a positive limit"),
        (("calibrate", "good", "--json", "nowhere/c.json"), "no such folder; create it or name another"),
        (("calibrate", "good", "runs/good", "--out", "x"), "two sources would write"),
        (("run", "quick", "--dry-run", "--name", "-x"), "a run's name begins"),
    ],
)
def test_arguments_that_make_no_sense_are_refused_before_anything_is_written(
    bench, measured, arguments, says
):
    before = sorted(Path().rglob("*"))
    refused(bench(*arguments), says)
    assert sorted(Path().rglob("*")) == before


def test_coefficients_of_a_simulation_are_told_from_those_of_a_block(bench, measured):
    write_csv(measured, Path("r.csv"))
    given = ("verify", "r.csv", "--coefficients", "runs/good/calibrate.json")
    assert "simulated" in bench(*given)[1]
    assert "simulated" in bench(*given, "--json", "-")[2]
    assert bench("verify", "good", "--coefficients", "runs/good/calibrate.json")[2] == ""


def test_the_closed_form_takes_360_degrees_written_as_0(bench, measured):
    wrapped = np.where(measured.angle_rad > 6.2, measured.angle_rad - 2 * np.pi, measured.angle_rad)
    write_csv(replace(measured, angle_rad=wrapped), Path("wrap.csv"))
    one = json.loads(bench("calibrate", "wrap.csv", "--estimator", "closed-form", "--json", "-")[1])
    two = json.loads(bench("calibrate", "good", "--estimator", "closed-form", "--json", "-")[1])
    assert one["coefficients"]["Kzz"]["value"] == pytest.approx(
        two["coefficients"]["Kzz"]["value"], abs=1e-12
    )


def test_a_runs_folder_that_cannot_be_written_is_one_sentence(bench):
    Path("runs").write_text("in the way")
    refused(bench("run", "quick", "--dry-run"), "cannot be written")


@pytest.mark.slow
def test_points_verified_at_another_temperature_are_named(bench, paper_run):
    """Of two files that are diagnosed together, the diagnosis says so."""
    measured = Run(Path("runs/run")).readings()
    points = measured.installation == "V"
    warm = replace(measured, temperature_c=np.where(points, 33.0, 23.0))
    write_csv(replace(measured, temperature_c=np.where(points, 23.8, 23.0)), Path("alike.csv"))
    write_csv(warm, Path("warm.csv"))
    write_csv(warm.select(~points), Path("settings.csv"))
    write_csv(warm.select(points), Path("points.csv"))
    named = "installation V was measured at 33.0 °C, the others at 23.0 °C"
    for command in ("calibrate", "verify"):
        assert named in " ".join(bench(command, "warm.csv")[1].split())
        assert "was measured at" not in bench(command, "alike.csv")[1]
    both = whole_body(Diagnose(source=("settings.csv", "points.csv"))).source.readings
    assert sum(named in note for note in both.notes) == 1


@pytest.mark.slow
def test_a_pass_that_equals_another_in_every_digit_is_named(bench, paper_run):
    measured = Run(Path("runs/run")).readings()
    write_csv(measured, Path("own.csv"))
    assert "in every digit" not in printed(bench("calibrate", "own.csv"))
    signal = measured.signal.copy()
    one = measured.installation == "1"
    signal[one & (measured.pass_number == 3)] = signal[one & (measured.pass_number == 2)]
    write_csv(replace(measured, signal=signal), Path("copied.csv"))
    named = "pass 3 of series 1 in installation 1 equals pass 2 of series 1 in every digit"
    for command in ("calibrate", "verify"):
        assert named in " ".join(bench(command, "copied.csv")[1].split())
    # with coarse digits, repeats of one value are no copies
    write_csv(replace(measured, signal=np.round(signal, 3)), Path("coarse.csv"))
    assert "in every digit" not in bench("calibrate", "coarse.csv")[1]
