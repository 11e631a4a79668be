"""The wire log: what a line holds, a disk that is full, several threads, and what is replayed."""

import random
import re
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

import pytest

from bench.cli.app import main as bench_main
from drivers.chambers import ChamberLimits
from drivers.clock import Clock
from drivers.instruments.agilent_34401a import Agilent34401A
from drivers.instruments.espec import EspecChamber
from drivers.instruments.keysight_34461a import Keysight34461A
from drivers.instruments.zaber import ZaberHead
from drivers.interfaces import BadReading, BenchError, InstrumentLost, VoltmeterSettings
from drivers.motion import Travel
from drivers.wire.replay import (
    Deviation,
    Replay,
    WireLog,
    WireLogError,
    escaped,
    exchanges,
    logged_wire,
    main,
    read_log,
    replayed,
)
from drivers.wire.visa import MessageSession
from sim.agilent_34401a import Agilent34401A as SimulatedMeter
from sim.world.world import Terminals
from tests.drivers.wire.test_faulty_wire import CHAMBERS, DEG, HEADS, at_random, dialect
from tests.support.patience import PATIENCE_S, together
from tests.support.scripted_session import ScriptedSession
from tests.support.simulated_stand import a_world, served

FULL = Path("/dev/full")
LINE = re.compile(
    r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{6}\+00:00 voltmeter\.[xyz] [<>] [^\x00-\x1f\x7f]+", re.ASCII
)


class Now:
    """A clock that goes on by half a second each time it is asked."""

    def __init__(self) -> None:
        self.time = datetime(2026, 11, 21, 9, 15, 41, 500000, tzinfo=UTC)

    def __call__(self) -> datetime:
        self.time += timedelta(seconds=0.5)
        return self.time


def test_a_line_is_time_instrument_direction_text(tmp_path: Path) -> None:
    file = tmp_path / "wire.log"
    log = WireLog(file, Now())
    log("voltmeter.x", ">", "*IDN?")
    log("voltmeter.x", "<", "HEWLETT-PACKARD,34401A,0,11-5-2")
    assert file.read_text() == (  # before it is closed: each line is written at once
        "2026-11-21T09:15:42.000000+00:00 voltmeter.x > *IDN?\n"
        "2026-11-21T09:15:42.500000+00:00 voltmeter.x < HEWLETT-PACKARD,34401A,0,11-5-2\n"
    )
    log.close()
    log.close()
    log("voltmeter.x", ">", "after the end")
    assert len(file.read_text().splitlines()) == 2


def test_control_characters_do_not_break_a_line(tmp_path: Path) -> None:
    assert escaped("a\r\nb\x03\x1b[31m\u2028é µ") == "a\\r\\nb\\x03\\x1b[31m\\u2028é µ"
    log = WireLog(tmp_path / "wire.log", Now())
    log("head", "<", "@01 0\n2026 forged > line\x7f")
    log.close()
    (line,) = (tmp_path / "wire.log").read_text(encoding="utf-8").splitlines()
    assert line.endswith("head < @01 0\\n2026 forged > line\\x7f")


def test_a_log_that_is_there_is_added_to(tmp_path: Path) -> None:
    for text in ("first", "second"):
        with logged_wire(tmp_path / "wire.log") as log:
            assert log is not None
            log("head", ">", text)
    assert [line.split()[-1] for line in (tmp_path / "wire.log").read_text().splitlines()] == [
        "first",
        "second",
    ]
    with logged_wire(None) as none:
        assert none is None


def test_lines_of_several_threads_stay_whole(tmp_path: Path) -> None:
    log = WireLog(tmp_path / "wire.log")
    together(*(lambda c=c: [log(f"voltmeter.{c}", ">", c * 200) for _ in range(50)] for c in "xyz"))
    log.close()
    lines = (tmp_path / "wire.log").read_text().splitlines()
    assert len(lines) == 150
    assert all(LINE.fullmatch(line) for line in lines)


def command(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        bench_main([str(argument) for argument in arguments])
    return int(str(ended.value.code))


@pytest.mark.skipif(not FULL.exists(), reason="this system has no /dev/full")
def test_a_run_outlives_its_log_and_a_log_that_cannot_be_is_said_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "short.yaml").write_text(
        "procedure: short\nreading: {samples: 1, nplc: 1, settle: 0 s}\nsteps:\n"
        "  - installation: {label: 1, steps: [turn: {angles: [0 deg]}]}\n"
    )
    run = ("run", "short.yaml", "--dry-run", "--bench", "paper-stand")
    assert command(*run, "--name", "full", "--wire-log", FULL) == 0
    out, err = capsys.readouterr()
    note = "note: the wire log /dev/full ends here (No space left on device); the run continues\n"
    assert [line for line in err.splitlines(keepends=True) if "wire log" in line] == [note]
    assert "wire log" not in out
    assert command(*run, "--name", "nowhere", "--wire-log", "no-folder/wire.log") == 2
    err = capsys.readouterr().err
    assert "no-folder/wire.log: No such file or directory" in err
    assert "Traceback" not in err
    assert not (tmp_path / "runs" / "nowhere").exists()


# --- replay -----------------------------------------------------------------------------------------
# A wire log gone through again: what was read and what failed comes again, what differs is said with its line.

SAMPLE = Path(__file__).parents[2] / "data" / "session-wire.log"
TWO_SAMPLES = VoltmeterSettings(range_v=10.0, nplc=1.0, samples=2)
SEED = 20261122
START = datetime(2026, 11, 21, 9, tzinfo=UTC)


def tried(*calls: Callable[[], object]) -> list[object]:
    """What each call returned, or the text of its error."""
    outcomes: list[object] = []
    for call in calls:
        try:
            outcomes.append(call())
        except BenchError as error:
            outcomes.append(str(error))
    return outcomes


class Stand:
    """What a driver of these tests is made over: a clock, on which time passes between its calls."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock

    def wait(self, duration_s: float) -> None:
        if isinstance(self.clock, Replay):
            self.clock.catch_up()
        else:
            self.clock.sleep(duration_s)


def use_meter(session: MessageSession, stand: Stand) -> list[object]:
    """Over RS-232, where the meter is told to be remote again after it was left alone for a while."""
    meter = Agilent34401A("instrument", "x", session, stand.clock, interface="rs232")
    outcomes = tried(meter.open, lambda: meter.configure(TWO_SAMPLES))
    for _ in range(3):
        stand.wait(400.0)
        outcomes += tried(meter.start, meter.fetch)
    meter.close()
    return outcomes


def use_head(kind: str, session: MessageSession, stand: Stand) -> list[object]:
    head = HEADS[kind](session, stand)  # type: ignore[arg-type]
    outcomes = tried(head.open)
    for target_deg, direction in ((45, 1), (10, -1), (360, 1)):
        outcomes += tried(partial(head.move, target_deg * DEG, direction, "turn"), head.open)  # type: ignore[arg-type]
    head.close()
    return outcomes


def use_chamber(kind: str, session: MessageSession, stand: Stand) -> list[object]:
    chamber = CHAMBERS[kind](session, stand)  # type: ignore[arg-type]
    outcomes = tried(chamber.open)
    for target_c in (-20.0, 60.0):
        outcomes += tried(partial(chamber.set_temperature, target_c, "temperature"))
        stand.wait(3 * 3600.0)
        outcomes += tried(partial(chamber.temperature, "read"), chamber.open)
    outcomes += tried(chamber.make_safe)
    chamber.close()
    return outcomes


USES: dict[str, Callable[[MessageSession, Stand], list[object]]] = {
    "34401a": use_meter,
    **{kind: partial(use_head, kind) for kind in HEADS},
    **{kind: partial(use_chamber, kind) for kind in CHAMBERS},
}


def patience_s(fault_probability: float) -> float:
    """How long a reply is waited for, in real time: where none is lost, as long as a busy machine may need."""
    return 0.05 if fault_probability else PATIENCE_S


def record(kind: str, file: Path, fault_probability: float) -> list[object]:
    """Use a simulated instrument, keep the log of it in bench time; return what came of it."""
    world = a_world()
    world.mount("1")
    simulated = (
        SimulatedMeter(Terminals(world, "x"), world.clock) if kind == "34401a" else dialect(kind, world)
    )
    log = WireLog(file, lambda: START + timedelta(seconds=world.clock.now_s()))
    spoil = at_random(fault_probability, random.Random(SEED), [])  # noqa: S311
    timeout_s = patience_s(fault_probability)
    with served(simulated, "instrument", world, fault=spoil, timeout_s=timeout_s, wire=log) as session:
        return USES[kind](session, Stand(world.clock))


def said(file: Path) -> list[str]:
    """What was sent and what failed, without times."""
    lines = file.read_text(encoding="utf-8").splitlines()
    return [line.split(" ", 1)[1] for line in lines if " < " not in line]


@pytest.mark.slow
@pytest.mark.parametrize("kind", USES)
@pytest.mark.parametrize("fault_probability", [0.0, 0.2])
def test_a_session_gives_the_same_again_faults_and_all(
    kind: str, fault_probability: float, tmp_path: Path
) -> None:
    file, again = tmp_path / "wire.log", tmp_path / "again.log"
    outcomes = record(kind, file, fault_probability)
    assert any(" ! " in body for body in said(file)) == (fault_probability > 0.0)
    assert len(outcomes) > 5
    timeout_s = patience_s(fault_probability)
    with replayed(file, "instrument", timeout_s=timeout_s, wire=WireLog(again)) as (session, clock):
        assert USES[kind](session, Stand(clock)) == outcomes
        assert clock.left == deque()
    assert said(again) == said(file)


# --- the log of a whole run -------------------------------------------------------------------------


def read_twice(session: MessageSession, clock: Clock) -> list[object]:
    """The meter's part in the run of the sample: two readings, the second one lost and taken again."""
    meter = Keysight34461A("voltmeter.x", "x", session, clock)
    outcomes = tried(meter.open, partial(meter.configure, TWO_SAMPLES))
    for _ in range(3):
        outcomes += tried(meter.start, meter.fetch)
    meter.close()
    return outcomes


LOST = (
    "voltmeter.x: TCPIP0::127.0.0.1::46735::SOCKET did not answer FETC? within 5.15 s; "
    "check that it is on and set to this interface, and that the cable sits"
)


def test_the_instruments_of_a_run_give_their_readings_again() -> None:
    with replayed(SAMPLE, "voltmeter.x") as (session, clock):
        outcomes = read_twice(session, clock)
        assert clock.now_s() > 5.0  # the silence has passed, on this clock
    assert str(outcomes[0]) == "Keysight Technologies 34461A MY53200001 A.02.17-02.40-02.17-00.52-04-01"
    readings = [{"x": (-0.00024, -0.00021)}, LOST, {"x": (-0.37197, -0.37194)}]
    assert outcomes[1:] == [None, None, readings[0], None, readings[1], None, readings[2]]

    travel = Travel(-5 * DEG, 365 * DEG, 5 / 3600 * DEG, 10 * DEG, backoff_rad=DEG, settle_s=0.5)
    with replayed(SAMPLE, "head", read_termination="\r\n") as (session, clock):
        head = ZaberHead("head", session, clock, travel, steps_per_degree=4266.6667)
        assert str(head.open()) == "Zaber 50952 73021 7.38"
        assert [head.move(t * DEG, 1, "turn").angle_rad / DEG for t in (0, 10)] == pytest.approx(
            [0, 10], abs=1e-4
        )
        head.stop()

    with replayed(SAMPLE, "chamber") as (session, clock):
        chamber = EspecChamber("chamber", session, clock, ChamberLimits(-40.0, 85.0))
        assert str(chamber.open()) == "ESPEC P300 P30012.03"
        chamber.set_temperature(25.0, "temperature")
        assert [chamber.temperature("read") for _ in range(3)] == [25.0, 25.0, 25.0]
        chamber.make_safe()


def altered(folder: Path, old: str, new: str) -> Path:
    text = SAMPLE.read_text(encoding="utf-8")
    assert old in text
    (folder / "wire.log").write_text(text.replace(old, new, 1), encoding="utf-8")
    return folder / "wire.log"


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            "> CONF:VOLT:DC 10\n",
            "> CONF:VOLT:DC 1\n",
            "'> CONF:VOLT:DC 1' was expected, but '> CONF:VOLT:DC 10' was sent",
        ),
        ("voltmeter.x > *CLS\n", "voltmeter.x > *RST\n", "'> *RST' was expected, but '> *CLS' was sent"),
    ],
)
def test_what_is_sent_otherwise_is_said_with_its_line(
    old: str, new: str, expected: str, tmp_path: Path
) -> None:
    log = altered(tmp_path, old, new)
    number = log.read_text(encoding="utf-8").partition(new)[0].count("\n") + 1
    assert deviation(log, "voltmeter.x", read_twice) == f"line {number}: {expected}"


def deviation(log: Path, instrument: str, use: Callable[[MessageSession, Clock], object]) -> str:
    """What differs from the log, without the name of its file."""

    def go_through() -> None:
        with replayed(log, instrument) as (session, clock):
            session.open()
            use(session, clock)

    with pytest.raises(Deviation) as caught:
        go_through()
    return str(caught.value).removeprefix(f"{log}, ")


def test_what_the_driver_leaves_over_or_lets_pass_is_a_deviation(tmp_path: Path) -> None:
    assert deviation(SAMPLE, "voltmeter.x", lambda session, _: session.query("*IDN?")) == (
        "line 3: '> *CLS' was expected, but nothing more was sent"
    )

    def let_pass(session: MessageSession, _: Clock) -> None:
        with suppress(BaseException):
            session.write("*CLS")

    assert (
        deviation(SAMPLE, "voltmeter.x", let_pass) == "line 1: '> *IDN?' was expected, but '> *CLS' was sent"
    )
    log = altered(tmp_path, "voltmeter.x < +0\n", "voltmeter.x < +32\n")  # an error with a reading
    assert deviation(log, "voltmeter.x", read_twice).endswith(
        "'> FUNC?' was expected, but '> SYST:ERR?' was sent"
    )
    with pytest.raises(ValueError, match="the test's own"), replayed(SAMPLE, "head"):
        raise ValueError("the test's own")


# --- what a log holds -------------------------------------------------------------------------------


def a_log(folder: Path, *bodies: str) -> Path:
    """Write a log, a line each 2 s."""
    stamps = (
        (START + timedelta(seconds=2 * n)).isoformat(timespec="microseconds") for n in range(len(bodies))
    )
    lines = [f"{stamp} {body}\n" for stamp, body in zip(stamps, bodies, strict=True)]
    (folder / "wire.log").write_text("".join(lines), encoding="utf-8")
    return folder / "wire.log"


REFUSED = "connecting: InstrumentLost: it refused; the connection; see whether it is on"


def test_failures_come_when_they_came(tmp_path: Path) -> None:
    log = a_log(
        tmp_path,
        f"m ! {REFUSED}",
        "m > A?",
        "m < 1",
        "m ! before sending: InstrumentLost: it closed the connection; see its power",
        "m > B?",
        "m < 2.",
        "m ! after sending: BadReading: it was cut short; again",
        "m > C",
        "m ! after sending: KeyboardInterrupt",
    )
    with replayed(log, "m") as (session, clock):
        with pytest.raises(InstrumentLost) as refused:
            session.open()
        assert (refused.value.cause, refused.value.remedy) == (
            "it refused; the connection",
            "see whether it is on",
        )
        assert session.query("A?", pattern="1") == "1"
        assert clock.now_s() == 4.0
        with pytest.raises(InstrumentLost, match="closed"):
            session.write("B?")
        assert session.connection is None
        with pytest.raises(BadReading, match="cut short"):
            session.query("B?")
        with pytest.raises(KeyboardInterrupt):
            session.write("C")
    made = exchanges(read_log(log, "m"))
    assert [(e.line, e.sent) for e in made] == [(1, None), (2, "A?"), (4, None), (5, "B?"), (8, "C")]
    assert made[1].answered == "1"
    assert made[3].answered_at == START + timedelta(seconds=12)
    assert isinstance(made[4].answered, KeyboardInterrupt)


def test_in_a_log_without_failures_no_reply_is_silence_and_said_to_be_a_guess(tmp_path: Path) -> None:
    log = a_log(tmp_path, "m > A?", "m > B?", "m < 2", "m < 3", "m > C")

    def use(session: MessageSession, clock: Clock) -> None:
        with pytest.raises(InstrumentLost, match=r"did not answer A\? within 3 s"):
            session.query("A?")
        assert clock.now_s() == 3.0
        assert session.query("B?") == "2"
        with pytest.raises(BadReading, match="'3' came unasked before C"):
            session.write("C")
        session.write("D")

    expected = "line 5: '> C' was expected, but '> D' was sent"
    assert deviation(log, "m", use) == f"{expected} (the reply of line 4 was not read)"

    def ask_twice(session: MessageSession, _: Clock) -> None:
        with pytest.raises(InstrumentLost):
            session.query("A?")
        session.query("A?")

    assert deviation(log, "m", ask_twice) == (
        "line 2: '> B?' was expected, but '> A?' was sent "
        "(before that, a reply was awaited; the log has neither the reply nor a failure)"
    )


def test_a_gap_that_nobody_let_pass_is_named(tmp_path: Path) -> None:
    log = a_log(tmp_path, "m > A", *["other > B"] * 200, "m > SYST:REM")

    def use(session: MessageSession, _: Clock) -> None:
        session.write("A")
        session.write("INIT")

    expected = "line 202: '> SYST:REM' was expected, but '> INIT' was sent"
    assert deviation(log, "m", use) == f"{expected} (402 s after the line before: 'catch_up' lets them pass)"


def test_control_characters_come_back(tmp_path: Path) -> None:
    file = tmp_path / "wire.log"
    log = WireLog(file)
    log("m", ">", "A\t?")
    log("m", "<", "a\x03b\\xffc")
    log.close()
    with replayed(file, "m") as (session, _):
        session.open()
        assert session.query("A\t?", pattern=".*") == "a\x03b\\xffc"


@pytest.mark.parametrize(
    ("line", "mistake"),
    [
        (b"", "'' is not a line of a log; write 'time instrument > text', or < or ! instead of >"),
        (b"2026-11-21T09:00:00+00:00 m = A", "'2026-11-21T09:00:00+00:00 m = A' is not"),
        (b"2026-11-21T09:00:00+00:00 m > \xc3\xa9", "is not a line of a log"),
        (b"2026-11-21T09:00:00+00:00 m > \xff", "can't decode byte 0xff"),
        (b"2026-11-21T09:00:00 m > A", "'2026-11-21T09:00:00' has no UTC offset"),
        (b"2026-13-21T09:00:00+00:00 m > A", "month must be in 1..12"),
        (
            b"2026-11-21T09:00:00+00:00 m ! it fell off the bench",
            "'it fell off the bench' is no failure; write it as 'after sending: ",
        ),
    ],
)
def test_each_mistake_of_a_log_is_said_with_its_line(line: bytes, mistake: str, tmp_path: Path) -> None:
    file = tmp_path / "wire.log"
    good = b"2026-11-21T09:00:00+00:00 m > A\n"
    file.write_bytes(good + line + b"\n" + good + line + b"\n" + good.rstrip())
    with pytest.raises(WireLogError) as caught:
        read_log(file, "m")
    second, fourth, fifth = str(caught.value).splitlines()
    assert second.startswith(f"{file}, line 2: ")
    assert mistake in second
    assert fourth.startswith(f"{file}, line 4: ")
    assert fifth == f"{file}, line 5: the line is incomplete; if the log broke off here, delete it"


# --- the pairs --------------------------------------------------------------------------------------


def test_the_printed_pairs_are_a_protocol_test(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(SAMPLE), "--instrument", "voltmeter.x"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    script = ScriptedSession(eval(out, {"InstrumentLost": InstrumentLost}))  # noqa: S307 - our own output
    outcomes = read_twice(script, script.clock)  # type: ignore[arg-type]
    assert script.left == []
    with replayed(SAMPLE, "voltmeter.x") as (session, clock):
        assert read_twice(session, clock) == outcomes


def test_the_command_says_what_is_missing_and_what_is_wrong(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = a_log(tmp_path, f"m ! {REFUSED}", "m > A?", "m > B")
    assert main([str(log), "--instrument", "m"]) == 0
    out, err = capsys.readouterr()
    assert err == f"note: {log}, line 2: no reply or failure follows\n"
    failure = "InstrumentLost('m', 'it refused; the connection', 'see whether it is on')"
    assert out == f"[\n    # nothing was sent: {failure}\n    ('A?', None),\n    ('B', None),\n]\n"
    assert main([str(log), "--instrument", "n"]) == 2
    assert capsys.readouterr().err == f"{log}: no line of n; choose from m\n"
    assert main([str(tmp_path / "none.log"), "--instrument", "m"]) == 2
    assert "No such file" in capsys.readouterr().err
