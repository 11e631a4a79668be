"""A driver's defect is named with its place, and no wrong value of a driver becomes a reading."""

from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest

from bench.config.bench_file.file import load_bench
from bench.config.shipped import find_bench
from bench.run.assembly.instruments import Surroundings, instruments_of
from bench.run.driver_checks import (
    checked_inclination,
    checked_position,
    checked_states,
    checked_temperature,
    named_fault,
)
from bench.run.folder import Run
from drivers.instruments.agilent_34401a import Agilent34401A
from drivers.instruments.manual import ManualHead
from drivers.interfaces import (
    BadReading,
    BenchError,
    HeadPosition,
    Identity,
    Inclination,
    LimitExceeded,
    NoAnswer,
    OutputSettings,
    OutputState,
)
from drivers.wire.visa import MessageSession
from sim.scpi import ScpiInstrument
from sim.world.clock import VirtualClock
from tests.support.runner_bench import Bench, Head, Meter, Person, make_runner, new_record, recorded

SETTINGS = OutputSettings(5.0, 1.0)


@pytest.fixture
def stopped(tmp_path):
    """Carry out the plan until a driver's defect stops it; return error, readings and failed instrument."""

    def carry_out():
        with pytest.raises(BenchError) as failure:
            make_runner(Bench(), new_record(tmp_path)).run()
        history, _, readings = recorded(tmp_path / "run")
        failed = next(event for event in history.events if event.type == "run_failed")
        return str(failure.value), readings, failed.data["instrument"]

    return carry_out


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize("command", [b"*IDN?", b"FETC?"])
def test_a_dry_run_names_the_simulation_that_failed_and_not_its_wire(bench, monkeypatch, command):
    handle = ScpiInstrument.handle

    def mistaken(meter, message, interrupted):
        return {}["no such key"] if message == command else handle(meter, message, interrupted)

    monkeypatch.setattr(ScpiInstrument, "handle", mistaken)
    status, _, err = bench("run", "quick", "--dry-run", "--name", "broken", "--bench", "paper-stand")
    assert status == 2
    cause = f"voltmeter.x: its simulation failed at {command.decode()} with KeyError: 'no such key'"
    assert cause in err
    assert "broke the connection" not in err
    failed = next(e for e in Run(Path("runs/broken")).history.events if e.type == "run_failed")
    assert failed.data["error"].startswith(cause)


@pytest.mark.parametrize(
    ("samples", "words"),
    [
        (("1.0", "2.0"), "its driver returns '1.0' from fetch, not a number"),
        ((1.0,), "its driver returns 1 instead of 2 samples of x"),
        ((1.0, 2.0, 3.0), "its driver returns 3 instead of 2 samples of x"),
        ((True, False), "its driver returns True from fetch, not a number"),
        ((Decimal(1), Decimal(2)), "its driver returns Decimal('1') from fetch, not a number"),
        ("12", "its driver returns '12' from fetch, not samples of x"),
        (1.0, "its driver returns 1.0 from fetch, not samples of x"),
        ((float("nan"), 1.0), "channel x reads nan V on the 10 V range"),
        ((1000.0, 1000.0), "channel x reads 1000 V on the 10 V range"),
        ((9.9e37, 1.0), "channel x reads 9.9e+37 V on the 10 V range"),
    ],
)
def test_wrong_samples_are_refused_and_never_recorded(stopped, monkeypatch, samples, words):
    monkeypatch.setattr(Meter, "fetch", lambda meter: {meter.channel: samples})
    error, readings, instrument = stopped()
    assert error.startswith(f"voltmeter.x: {words}; ")
    assert (readings, instrument) == ([], "voltmeter.x")


@pytest.mark.parametrize("fetched", [None, [1.0, 2.0], {}, {"y": (1.0, 2.0)}, {"X": (1.0, 2.0)}])
def test_samples_of_other_channels_are_refused(stopped, monkeypatch, fetched):
    monkeypatch.setattr(Meter, "fetch", lambda meter: fetched)
    error, readings, _ = stopped()
    assert "from fetch, not samples of x; correct the driver" in error
    assert readings == []


def test_samples_of_numpy_are_recorded_as_numbers(tmp_path, monkeypatch):
    monkeypatch.setattr(Meter, "fetch", lambda meter: {meter.channel: np.array([1.0, 2.0], np.float32)})
    make_runner(Bench(), new_record(tmp_path)).run()
    assert recorded(tmp_path / "run")[2][0]["samples"] == {c: [1.0, 2.0] for c in "xyz"}


@pytest.mark.parametrize(
    ("kind", "method"), [(Meter, "open"), (Meter, "configure"), (Meter, "start"), (Head, "move")]
)
def test_an_exception_in_a_driver_names_instrument_file_and_line(stopped, monkeypatch, kind, method):
    def broken(self, *_):
        return {}["nplc"]

    broken.__code__ = broken.__code__.replace(co_name=method)
    monkeypatch.setattr(kind, method, broken)
    error, _, instrument = stopped()
    line = broken.__code__.co_firstlineno + 1
    place = f"(run/test_driver_checks.py:{line}) with KeyError: 'nplc'"
    assert f"its driver failed in {method} {place}" in error
    assert instrument in {"head", "voltmeter.x", "voltmeter.x, voltmeter.y, voltmeter.z"}


def test_the_place_of_a_session_s_refusal_is_the_line_of_the_driver(monkeypatch):
    session = MessageSession("head", "TCPIP0::192.0.2.1::1::SOCKET")

    def move(self, *_):
        session.write("SET 40 °C")

    monkeypatch.setattr(Head, "move", move)
    head = Head(Bench())
    with pytest.raises(ValueError, match="ASCII") as raised:
        head.move(0.5, 1, "key")
    line = move.__code__.co_firstlineno + 1
    place = f"failed in move (run/test_driver_checks.py:{line}) with ValueError: a session sends ASCII"
    assert place in str(named_fault(raised.value, [head]))


def test_an_identity_that_is_none_is_refused(stopped, monkeypatch):
    monkeypatch.setattr(Head, "open", lambda head: "a head")
    assert stopped()[0].startswith("head: its driver returns 'a head' from open, not Identity; ")


def test_an_identity_with_a_number_is_refused(stopped, monkeypatch):
    monkeypatch.setattr(Head, "open", lambda head: Identity("Turnwell", 3))
    error = stopped()[0]
    assert error.startswith("head: its driver returns Identity(")
    assert "from open, not an Identity of texts; " in error


@pytest.mark.parametrize("position", [0.5, None, HeadPosition(float("nan"), 1), HeadPosition(0.5, 0)])
def test_a_position_without_angle_or_direction_is_refused(stopped, monkeypatch, position):
    monkeypatch.setattr(Head, "move", lambda *_: position)
    assert "head: its driver returns " in stopped()[0]


@pytest.mark.parametrize("shown_c", [float("nan"), float("inf"), 296.15, 9999.0, -273.15])
def test_an_implausible_temperature_names_its_thermometer(shown_c):
    with pytest.raises(BadReading, match=r"head: shows .* °C, and only -100 to 200 °C are plausible"):
        checked_temperature(Head(Bench()), "block_c", shown_c)


@pytest.mark.parametrize("shown", ["23.0", None, (23.0,), True])
def test_a_temperature_that_is_no_number_is_refused(shown):
    with pytest.raises(BenchError, match="from block_c, not a number; correct the driver"):
        checked_temperature(Head(Bench()), "block_c", shown)


@pytest.mark.parametrize("found", [None, 1e-5, Inclination(float("nan"), 0.0), Inclination("0", 0.0)])
def test_an_inclination_that_is_none_is_refused(found):
    with pytest.raises(BenchError, match="from inclination"):
        checked_inclination(Head(Bench()), found)


@pytest.mark.parametrize(
    ("states", "words"),
    [
        ([5.0], r"returns \[5.0\] from state, not the state of each output"),
        ({"P6V": 5.0}, "returns 5.0 from state, not OutputState"),
        (
            {"P6V": OutputState(True, OutputSettings(5.0, 1.0), "5.0", 0.1)},
            "returns '5.0' from state, not a number",
        ),
    ],
)
def test_a_state_of_a_supply_that_is_none_is_refused(states, words):
    with pytest.raises(BenchError, match=words):
        checked_states(Head(Bench()), states)


def test_numbers_of_numpy_become_plain(tmp_path):
    position = checked_position(Head(Bench()), HeadPosition(np.float32(0.5), np.int64(-1)))
    assert (type(position.angle_rad), type(position.direction)) == (float, int)
    state = OutputState(True, SETTINGS, np.float32(15.0), np.float32(0.05))
    state = checked_states(Head(Bench()), {"P25V": state})["P25V"]
    assert (type(state.voltage_v), type(state.current_a)) == (float, float)
    assert type(checked_temperature(Head(Bench()), "block_c", np.float32(23.0))) is float


def test_what_does_not_arise_in_a_driver_is_not_blamed_on_it():
    head = Head(Bench(trouble=ZeroDivisionError("a mistake"), at=0))
    with pytest.raises(ZeroDivisionError) as raised:
        head.move(0.5, 1, "key")
    assert named_fault(raised.value, [Head(Bench())]) is None
    assert named_fault(NoAnswer("operator", "none", "answer"), [head]) is None
    assert "ZeroDivisionError: a mistake" in str(named_fault(raised.value, [head]))


def made():
    bench, clock = load_bench(find_bench("paper-stand")), VirtualClock()
    return instruments_of(bench, Surroundings(Person(Bench()), clock, 50.0))


def test_a_driver_that_lacks_a_method_is_refused_before_the_run(monkeypatch):
    monkeypatch.delattr(ManualHead, "move")
    with pytest.raises(BenchError, match=r"its driver has no move; add what DividingHead in .* demands"):
        made()


def test_a_driver_with_other_arguments_is_refused_before_the_run(monkeypatch):
    monkeypatch.setattr(Agilent34401A, "__init__", lambda meter, name: None)
    with pytest.raises(
        BenchError, match=r"voltmeter\.x: its driver cannot be made \(TypeError: .* correct drivers"
    ):
        made()


def test_what_a_driver_itself_refuses_keeps_its_remedy(monkeypatch):
    def refuse(meter, name, *given, **options):
        raise LimitExceeded(name, "cannot do channel 99", "correct its lines in the bench file")

    monkeypatch.setattr(Agilent34401A, "__init__", refuse)
    with pytest.raises(LimitExceeded, match=r"^voltmeter\.x: cannot do channel 99; correct its lines"):
        made()
