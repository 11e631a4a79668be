"""A run as on a real bench: bench file with addresses, a person who types, instruments that fail."""

import re
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest

from bench.config.bench_file.file import load_bench
from bench.model import ForwardModel
from bench.run.folder import Run
from bench.services import execution
from drivers.instruments.manual import ManualHead
from sim.bench import SimulatedBench
from sim.wires.session import WireFault
from sim.world.clock import VirtualClock
from sim.world.world import World, WorldSettings
from tests.cli.test_instruments import write_bench_file
from tests.support.procedure_texts import TWO_INSTALLATIONS
from tests.support.runner_bench import interrupt_at
from tests.support.simulated_stand import a_34401a

SHIPPED = Path(__file__).parents[2] / "config" / "paper-stand.yaml"
PROCEDURE = """\
procedure: short
title: Two points
reading: {samples: 2, nplc: 1, settle: 0 s}
steps:
  - installation:
      label: 1
      steps:
        - turn: {angles: [0 deg, 90 deg]}
"""
ANSWERS = "yes\n23.0\n0 0 2\n89 59 58\n"
"""Mounted; temperature; the two angles read."""


@pytest.fixture
def served(empty_folder, monkeypatch):
    """A folder with a procedure and a bench file whose meters are simulated ones on loopback."""
    Path("short.yaml").write_text(PROCEDURE)
    file = load_bench(SHIPPED)
    model = ForwardModel(file.installation_models())
    world = World(WorldSettings(file.simulated_block(), model, {}, seed=1), VirtualClock())
    meters = {f"voltmeter.{c}": a_34401a(c, interface="gpib") for c in "xyz"}
    move = ManualHead.move

    def hand(head, target_rad, direction, key):
        """Turn the world's head to what the person types, or leave it where it is."""
        position = move(head, target_rad, direction, key)
        if not Path("forgotten").exists():
            world.turn(position.angle_rad, direction)
        return position

    monkeypatch.setattr(ManualHead, "move", hand)
    with SimulatedBench(world, meters) as simulated:
        write_bench_file(simulated.resources)
        yield simulated


def start(bench, answers=ANSWERS, name="run"):
    return bench("run", "short.yaml", "--bench", "bench.yaml", "--name", name, stdin=answers)


def test_no_mistakes_are_found_once_the_instruments_are_checked_too(served, bench):
    status, out, _ = bench("check", "short.yaml", "--bench", "bench.yaml", "--instruments")
    assert status == 0
    assert out.index("voltmeter.x") < out.index("no mistakes found")


def test_typed_answers_make_readings(served, bench):
    status, out, err = start(bench)
    # two points of one installation do not make a calibration: the run is done all the same
    assert (status, err) == (0, "")
    assert "no calibration from it: 2 readings do not determine" in out
    readings = Run(Path("runs/run")).readings()
    assert np.degrees(readings.angle_rad) == pytest.approx([2 / 3600, 90 - 2 / 3600], abs=1e-9)
    assert readings.temperature_c.tolist() == [23.0, 23.0]
    assert "Mount the block in installation 1" in out
    assert "0°00′00″" in out


def test_a_slip_is_asked_again(served, bench):
    _, out, _ = start(bench, answers="yes\n23\n1 0 2\n0 0 2\n90 10 1\n90 0 1\n")
    assert len(re.findall(r"probably\s+the", out)) == 2
    degrees = np.degrees(Run(Path("runs/run")).readings().angle_rad)
    assert degrees == pytest.approx([2 / 3600, 90 + 1 / 3600], abs=1e-9)


def test_when_the_answers_end_the_run_stops_and_goes_on_later(served, bench):
    status, _, err = start(bench, answers="yes\n23\n0 0 2\n")
    assert status == 2
    assert "the input ended before an answer to" in err
    assert "1 reading is kept" in err
    assert len(Run(Path("runs/run")).readings()) == 1
    assert "interrupted" not in bench("runs")[1]
    assert bench("resume", "run", stdin="untouched\n89 59 58\n")[0] == 0
    run = Run(Path("runs/run"))
    assert run.history.state == "finished"
    assert run.readings().point.tolist() == [1, 2]


def test_a_run_whose_instruments_are_missing_gives_one_advice_how_to_continue(served, bench):
    start(bench, answers="yes\n23\n0 0 2\n")
    for server in served.servers.values():
        server.refuse()
    status, _, err = bench("resume", "run")
    assert status == 2
    assert "refused the connection" in err
    assert "resume with 'bench resume run'" in err
    assert "start again" not in err


@pytest.mark.parametrize(("set_s", "jumps_s"), [(-3600.0, [-3600.0]), (0.0, [])])
def test_a_clock_set_back_while_a_run_was_stopped_is_on_record(served, bench, monkeypatch, set_s, jumps_s):
    """The time since the stop is then unknown: bench time continues where it stopped, and the record says why."""
    assert start(bench, answers="yes\n23.0\n0 0 2\n")[0] == 2
    now = execution.utc_now
    monkeypatch.setattr(execution, "utc_now", lambda: now() + timedelta(seconds=set_s))
    status, out, _ = bench("resume", "run", stdin="untouched\n89 59 58\n")
    assert status == 0
    events = [*Run(Path("runs/run")).history.events]
    jumped = [event for event in events if event.type == "clock_jumped"]
    assert [round(event.data["ahead_s"], -1) for event in jumped] == jumps_s
    assert ("the computer's clock went" in out) == bool(jumps_s)
    times = [event.bench_s for event in events]
    assert times == sorted(times)


def test_a_reading_that_was_redone_is_counted_once(served, bench):
    status, _, err = start(bench, answers="yes\n23\n0 0 2\n:redo\n0 0 3\n")
    assert status == 2
    assert "; 1 reading is kept in runs/run" in err
    assert len(Run(Path("runs/run")).history.taken) == 2
    assert re.search(r"^run .* failed +1 ", bench("runs")[1], re.MULTILINE)
    assert "\nreadings: 1\n" in bench("show", "run")[1]


def test_at_the_question_of_a_resumed_run_a_pause_waits_and_the_end_ends(served, bench):
    start(bench, answers="yes\n23\n0 0 2\n")
    status, out, err = bench("resume", "run", stdin=":pause\n:redo\n?\n\n:abort no use\n")
    assert status == 2
    assert "aborted: no use" in err
    assert "redo is not possible: no step is running yet" in out
    assert out.count("Has nobody touched it since?") == 5
    assert ":skip" not in out
    assert Run(Path("runs/run")).history.state == "aborted"


def test_a_head_that_was_not_turned_stops_the_run_which_asks_and_takes_the_point_again(served, bench):
    """Answers end at the question: status 2 with the cause; the resumed run asks it first."""
    Path("forgotten").touch()
    status, out, err = start(bench)
    assert status == 2
    assert "the head was not turned: the signals are those of the point before, at 0°00′02″" in err
    assert "nobody chose how to continue" in err
    assert "bench resume run" in err
    Path("forgotten").unlink()
    answers = "untouched\ngo on\n:skip it\n?\nredo point\n90 0 1\n"
    status, out, _ = bench("resume", "run", stdin=answers)
    assert status == 0
    assert "Answer one of redo point, redo pass, mount again, go on REASON, not 'go on'" in out
    assert "skip is not possible: first answer the question about the reading in doubt" in out
    run = Run(Path("runs/run"))
    assert run.history.state == "finished"
    assert np.degrees(run.readings().angle_rad) == pytest.approx([2 / 3600, 90 + 1 / 3600], abs=1e-9)
    assert abs(run.readings().signal[1, 0]) > 2.0  # x is up only at the second try


@pytest.mark.slow
def test_a_second_stop_at_a_point_after_its_redo_says_so_and_proposes_the_pass(served, bench):
    """The head is forgotten at the redo, too; the resumed run remembers."""
    Path("forgotten").touch()
    status, out, err = start(bench, answers=f"{ANSWERS}redo point\n90 0 1\n")
    assert status == 2
    assert "(the reading was measured again and is still in doubt); nobody chose how to continue" in err
    assert "answer redo pass, redo point, mount again, go on REASON" in err
    Path("forgotten").unlink()
    status, out, _ = bench("resume", "run", stdin="untouched\n?\nredo pass\n0 0 2\n90 0 1\n")
    assert status == 0
    told = " ".join(out.split())
    assert (
        "The reading was measured again and is still in doubt: an earlier setting of the pass may be wrong"
        in told
    )
    assert "redo the pass (try this first), redo the point, mount" in told
    run = Run(Path("runs/run"))
    assert run.history.state == "finished"
    assert np.degrees(run.readings().angle_rad) == pytest.approx([2 / 3600, 90 + 1 / 3600], abs=1e-9)


def test_a_person_may_go_on_in_spite_of_an_early_sign_and_says_why(served, bench):
    Path("forgotten").touch()
    status, _, _ = start(bench, answers=ANSWERS + "go on this head has no block on it\n")
    assert status == 0
    went_on = [e.data for e in Run(Path("runs/run")).history.events if e.type == "went_on"]
    assert [data["reason"] for data in went_on] == ["this head has no block on it"]
    assert "not turned" in went_on[0]["causes"][0]


def test_a_bench_file_changed_since_is_told_and_asked_about(served, bench):
    start(bench, answers="yes\n23\n0 0 2\n")
    Path("bench.yaml").write_text(
        Path("bench.yaml").read_text().replace("limit: 5 arcsec", "limit: 50 arcsec")
    )
    status, out, err = bench("resume", "run", stdin="no\n")
    assert status == 2
    assert "bench.yaml was changed since the run began" in out
    assert "answered no" in err
    assert bench("resume", "run", stdin="yes\nuntouched\n89 59 58\n")[0] == 0
    assert Run(Path("runs/run")).history.state == "finished"


def test_all_absent_meters_are_named_at_once(served, bench):
    for server in served.servers.values():
        server.stop()
    status, _, err = start(bench)
    assert status == 2
    assert all(f"voltmeter.{c}" in err for c in "xyz")
    assert err.count("refused") == 3
    assert Run(Path("runs/run")).history.problems == ()


def cut(request, reply):
    return WireFault.cut(reply, 9) if reply and request.startswith(b"FETC") else None


def drop(request, reply):
    return WireFault(drop=True) if request.startswith(b"FETC") else None


def overload(request, reply):
    return WireFault(raw=b"+9.90000000E+37,+9.90000000E+37\n") if request.startswith(b"FETC") else None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "says"), [(cut, "voltmeter.y"), (drop, "voltmeter.y"), (overload, "overload")]
)
def test_a_fault_on_the_wire_stops_with_the_record_whole_and_is_repaired_by_resume(
    served, bench, fault, says
):
    served.servers["voltmeter.y"].fault = fault
    status, _, err = start(bench)
    assert status == 2
    assert says in err.lower()
    assert "voltmeter.y" in err
    run = Run(Path("runs/run"))
    assert run.history.problems == ()
    assert run.history.state == "failed"
    assert not any("reading" in e.data for e in run.history.events)
    served.servers["voltmeter.y"].fault = None
    bench("resume", "run", stdin="untouched\n0 0 2\n89 59 58\n")
    run = Run(Path("runs/run"))
    assert run.history.state == "finished"
    assert run.readings().point.tolist() == [1, 2]


@pytest.mark.slow
def test_interrupted_anywhere_a_dry_run_resumes_to_the_undisturbed_readings(bench):
    """Reading for reading: the world's random numbers belong to the step, bench time goes on."""
    Path("two.yaml").write_text(TWO_INSTALLATIONS, encoding="utf-8")
    bench("run", "two.yaml", "--dry-run", "--name", "whole", "--seed", 5)
    whole = Run(Path("runs/whole")).readings()
    for moment, event in enumerate((5, 12, 13, 14, 40, 66)):
        name = f"cut{moment}"
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("bench.run.runner.Recorder.emit", interrupt_at(event))
            status, _, err = bench("run", "two.yaml", "--dry-run", "--name", name, "--seed", 5)
        assert status == 2
        assert f"bench resume {name}" in err
        assert bench("resume", name)[0] == 0
        resumed = Run(Path("runs") / name).readings()
        assert np.array_equal(resumed.signal, whole.signal)
        assert np.array_equal(resumed.angle_rad, whole.angle_rad)
        assert np.array_equal(resumed.time_s, whole.time_s)
