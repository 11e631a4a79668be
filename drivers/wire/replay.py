"""Replay of a recorded wire log to a driver: a protocol test without the instrument.

    from drivers.wire.replay import replayed

    def test_a_session_of_a_34401a() -> None:
        with replayed(Path("wire.log"), "voltmeter.x") as (session, clock):
            meter = Agilent34401A("voltmeter.x", "x", session, clock)
            assert meter.open().model == "34401A"

`session` is a complete `MessageSession`, with its checks and reconnections, over the log instead of a wire. The
driver must send the logged commands in order, and receives the logged replies and failures. A different command, or
an unused line at the end, raises `Deviation`. Nothing is opened and nothing sleeps: `clock` advances with the lines
of the log; `clock.catch_up()` advances it to the next line before a call of the driver.

    python -m drivers.wire.replay wire.log --instrument voltmeter.x

prints pairs of (sent, answered), for other tests. A log of an earlier version has no `!` lines: a query
without reply then counts as silence, every reply as complete, every connection as made. No log holds the driver's
settings, or the loss of the link by another instrument on the same GPIB adapter. The log of a dry run has the
computer's time, not the bench's. In a reply, `\\x` with two hex digits, `\\n`, `\\r` and `\\t` are unescaped.
"""

from __future__ import annotations

import argparse
import contextlib
import re
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from drivers.clock import utc_now
from drivers.interfaces import BadReading, BenchError, InstrumentLost
from drivers.wire.pyvisa_connection import Connection
from drivers.wire.visa import AFTER_SENDING, BEFORE_SENDING, CONNECTING, MessageSession

# --- the wire log -----------------------------------------------------------------------------------


class WireLog:
    r"""A file that logs the messages of `drivers.wire.visa.MessageSession`; thread-safe.

    A line has the time (UTC), the instrument, `>` (sent) or `<` (received), and the text with its control
    characters escaped. A failure has `!`, its phase (`connecting`, `before sending`, `after sending`) and the
    error:

        2026-11-21T09:15:41.123456+00:00 voltmeter.x > *IDN?
        2026-11-21T09:15:44.123456+00:00 voltmeter.x ! after sending: InstrumentLost: … did not answer …; check …

    An existing file is appended to. Each line is written, unbuffered, before the session continues. If a line
    cannot be written (a full disk), a note goes to standard error, the log ends, and the run continues. Raises
    `OSError` if the file cannot be opened.
    """

    def __init__(self, path: Path, now: Callable[[], datetime] = utc_now) -> None:
        self.path = path
        self._now = now
        self._lock = threading.Lock()
        self._file = path.open("ab", buffering=0)
        self._ended = False

    def __call__(self, instrument: str, direction: str, text: str) -> None:
        """Write one message. Never raises."""
        with self._lock:
            if self._ended:
                return
            stamp = self._now().isoformat(timespec="microseconds")
            line = f"{stamp} {instrument} {direction} {escaped(text)}\n".encode()
            try:
                while line:
                    line = line[self._file.write(line) :]
            except OSError as error:
                self._ended = True
                print(
                    f"note: the wire log {self.path} ends here ({error.strerror or error}); the run continues",
                    file=sys.stderr,
                )

    def close(self) -> None:
        """End the log. Never raises, may be called twice."""
        with self._lock, contextlib.suppress(OSError):
            self._ended = True
            self._file.close()


def escaped(text: str) -> str:
    r"""Return the text with unprintable characters as escapes: `\x03`, `\r`, `\u2028`."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


@contextmanager
def logged_wire(path: Path | None) -> Iterator[WireLog | None]:
    """Yield a wire log that is open during the context; None if `path` is None. Raises `OSError`."""
    if path is None:
        yield None
        return
    log = WireLog(path)
    try:
        yield log
    finally:
        log.close()


# --- replay -----------------------------------------------------------------------------------------

_LINE: Final = re.compile(r"(\S+) (\S+) (?:([<>])(?: ([\x20-\x7e]*))?|! (.+))")
_FAILURE: Final = re.compile(
    rf"({CONNECTING}|{BEFORE_SENDING}|{AFTER_SENDING}): "
    r"(?:(InstrumentLost|BadReading): (.+); (.+?)|KeyboardInterrupt|SystemExit)"
)
_LONG_S: Final = 60.0
_ESCAPE: Final = re.compile(rb"\\(?:x[0-9a-f]{2}|[nrt])")


class WireLogError(ValueError):
    """A wire log that cannot be parsed; the message lists the mistakes with file and line, one per line."""


class Deviation(AssertionError):
    """The driver deviated from the log; the message gives the line and what was expected."""


class _Stopped(BaseException):
    """Raised when the driver deviates; a `BaseException`, so that no driver handles it as a transport failure."""


@dataclass(frozen=True, slots=True)
class Logged:
    """One line of a log. `way` is `>`, `<` or `!`; a `!` line also has the phase, `when`, and the `failure`."""

    line: int
    time: datetime
    way: str
    text: str
    when: str = ""
    failure: BaseException | None = None

    @property
    def data(self) -> bytes:
        """The bytes on the wire, unescaped, without the line end."""
        return _ESCAPE.sub(
            lambda m: m[0].decode("unicode_escape").encode("latin-1"), self.text.encode("ascii")
        )


@dataclass(frozen=True, slots=True)
class Exchange:
    """A command with its reply or its failure (None if the log has neither).

    The command is None for a failure or data that no command preceded.
    """

    line: int
    sent: str | None
    answered: str | BaseException | None
    answered_at: datetime | None


def read_log(path: Path, instrument: str) -> list[Logged]:
    """Return the lines of one instrument in a wire log. Raises `WireLogError` for any malformed line, `OSError`."""
    mistakes: list[str] = []
    logged: dict[str, list[Logged]] = {}
    *lines, rest = path.read_bytes().split(b"\n")
    for number, data in enumerate(lines, start=1):
        try:
            name, entry = _read_line(number, data.decode("utf-8").removesuffix("\r"))
            logged.setdefault(name, []).append(entry)
        except ValueError as error:  # includes `UnicodeDecodeError`
            mistakes.append(f"{path}, line {number}: {error}")
    if rest:
        mistakes.append(
            f"{path}, line {len(lines) + 1}: the line is incomplete; if the log broke off here, delete it"
        )
    if not mistakes and instrument not in logged:
        mistakes.append(
            f"{path}: no line of {instrument}; choose from {', '.join(sorted(logged)) or 'another log'}"
        )
    if mistakes:
        raise WireLogError("\n".join(mistakes))
    return logged[instrument]


def _read_line(number: int, text: str) -> tuple[str, Logged]:
    match = _LINE.fullmatch(text)
    if match is None:
        raise ValueError(
            f"{escaped(text)[:60]!r} is not a line of a log; write 'time instrument > text', or < or ! instead of >"
        )
    stamp, instrument, way, message, failed = match.groups()
    time = datetime.fromisoformat(stamp)
    if time.tzinfo is None:
        raise ValueError(f"the time {stamp!r} has no UTC offset; add it, such as +00:00")
    entry = Logged(number, time, way or "!", message or failed or "")
    if not failed:
        return instrument, entry
    match = _FAILURE.fullmatch(failed)
    if match is None:
        raise ValueError(
            f"{failed[:60]!r} is no failure; write it as '{AFTER_SENDING}: InstrumentLost: cause; remedy'"
        )
    when, kind, cause, remedy = match.groups()
    failure: BaseException = SystemExit() if failed.endswith("SystemExit") else KeyboardInterrupt()
    if kind:
        failure = (BadReading if kind == "BadReading" else InstrumentLost)(instrument, cause, remedy)
    return instrument, replace(entry, when=when, failure=failure)


def exchanges(lines: Iterable[Logged]) -> list[Exchange]:
    """Return the lines grouped into exchanges; a failure replaces the part of the reply received before it."""
    made: list[Exchange] = []
    for entry in lines:
        answer = entry.failure or entry.data.decode("ascii", "backslashreplace")
        if entry.way == ">":
            made.append(Exchange(entry.line, str(answer), None, None))
        elif made and (entry.when == AFTER_SENDING or (entry.way == "<" and made[-1].answered is None)):
            made[-1] = replace(made[-1], answered=answer, answered_at=entry.time)
        else:
            made.append(Exchange(entry.line, None, answer, entry.time))
    return made


@contextmanager
def replayed(log: Path, instrument: str, **settings: Any) -> Iterator[tuple[MessageSession, Replay]]:
    """Yield a session that replays one instrument's lines of a log, and its clock.

    `settings` are arguments of `MessageSession`, such as `timeout_s` or `serial`. Raises `Deviation` if the driver
    deviated (even if it caught the error) or lines are unused; also `WireLogError`, `OSError`.
    """
    replay = Replay(f"{log}", instrument, read_log(log, instrument), settings.get("read_termination", "\n"))
    session = _ReplayedSession(replay, **settings)
    try:
        yield session, replay
    except _Stopped:
        pass
    except BaseException as error:
        if replay.deviation:
            raise Deviation(replay.deviation) from error
        raise
    finally:
        session.close()
    if not replay.deviation and replay.left:
        replay.deviate("nothing more was sent")
    if replay.deviation:
        raise Deviation(replay.deviation)


class Replay(Connection):
    """The replay of a log: a `Connection` for the session and the `Clock` for the driver.

    `left` holds the lines not yet used. The time is that of the last used line, plus the driver's sleeps since
    then.
    """

    def __init__(self, log: str, instrument: str, lines: Sequence[Logged], read_termination: str) -> None:
        self.left = deque(lines)
        self.deviation = ""
        self.by_bytes = True
        self.instrument = instrument
        self._log = log
        self._read_end = read_termination.encode("ascii")
        self._start = lines[0].time
        self._time_s = 0.0
        self._when = BEFORE_SENDING
        self._remark = ""

    def now_s(self) -> float:
        """Return the time since the first line, s."""
        return self._time_s

    def sleep(self, duration_s: float) -> None:
        """Advance the clock without waiting."""
        self._time_s += max(0.0, duration_s)

    def catch_up(self) -> None:
        """Advance the clock to the time of the next line, for a pause between two calls of the driver."""
        if self.left:
            self._time_s = max(self._time_s, self._of_log_s(self.left[0]))

    def deviate(self, what: str) -> None:
        """Record a deviation from the log; only the first is kept."""
        due = self.left[0] if self.left else None
        expected = f"line {due.line}: '{due.way} {due.text}'" if due else "the end"
        if due and (later_s := self._of_log_s(due) - self._time_s) > _LONG_S:
            self._remark += f" ({later_s:.0f} s after the line before: 'catch_up' lets them pass)"
        self.deviation = self.deviation or f"{self._log}, {expected} was expected, but {what}{self._remark}"

    def fail(self, when: str) -> None:
        """Raise the failure in the next line of the log, if that line is a failure of the phase `when`."""
        if self.left and self.left[0].when == when and (failure := self._next().failure):
            raise failure

    # --- the connection -----------------------------------------------------------------------------

    def close(self) -> None:
        """Do nothing: nothing is open."""

    def interrupt(self) -> None:
        """Do nothing: no thread waits."""

    def send(self, data: bytes, timeout_s: float) -> bool:
        """Compare a command with the next line of the log, and raise the failure that follows it, if any.

        Returns True. Ends the replay with `_Stopped` if the command differs.
        """
        sent = escaped(data.decode("ascii").rstrip("\r\n"))
        due = self.left[0] if self.left else None
        if self.deviation or due is None or (due.way, due.text) != (">", sent):
            self.deviate(f"'> {sent}' was sent")
            raise _Stopped
        self._next()
        self.fail(AFTER_SENDING)
        return True

    def wait(self, timeout_s: float) -> bool:
        """Return whether the next line of the log is data; raise a failure of this phase that it contains.

        A wait with `timeout_s` 0, before a command is sent, finds unsolicited data. Without data, the clock
        advances by `timeout_s`.
        """
        self._when = AFTER_SENDING if timeout_s > 0.0 else BEFORE_SENDING
        self.fail(self._when)
        if self.left and self.left[0].way == "<":
            return True
        if timeout_s > 0.0:
            self.sleep(timeout_s)
            self._remark = " (before that, a reply was awaited; the log has neither the reply nor a failure)"
        return False

    def take(self) -> tuple[bytes, bool]:
        """Return the next reply of the log, and whether more bytes follow.

        If a failure follows the reply in the log (it was truncated, doubled or unsolicited), raise the failure
        instead.
        """
        reply = self._next()
        self.fail(self._when)
        if self._when == BEFORE_SENDING:
            self._remark = f" (the reply of line {reply.line} was not read)"
        return reply.data + self._read_end, reply.data.endswith(b"\n")

    def take_all(self) -> bytes:
        """Return the next reply as logged: what `take` returns, without the line end that it adds."""
        return self.take()[0].removesuffix(self._read_end)

    def resynchronise(self, device_clear: bytes, timeout_s: float) -> bool:
        """Return True: a log has no late replies."""
        return True

    def _next(self) -> Logged:
        self.catch_up()
        return self.left.popleft()

    def _of_log_s(self, entry: Logged) -> float:
        return (entry.time - self._start).total_seconds()


class _ReplayedSession(MessageSession):
    def __init__(self, replay: Replay, **settings: Any) -> None:
        super().__init__(replay.instrument, "the log", **settings)
        self._clock = self._replay = replay

    def _open(self) -> Connection:
        self._replay.fail(CONNECTING)
        return self._replay


# --- the command line -------------------------------------------------------------------------------


def as_pairs(made: Iterable[Exchange]) -> str:
    """Return exchanges as a Python list literal of pairs (sent, answered).

    An exchange without a command becomes a comment.
    """
    lines = []
    for exchange in made:
        answered, shown = exchange.answered, repr(exchange.answered)
        if isinstance(answered, BenchError):
            words = (answered.instrument, answered.cause, answered.remedy)
            shown = f"{type(answered).__name__}{words!r}"
        sent = f"({exchange.sent!r}, {shown}),"
        lines.append(f"    {sent}" if exchange.sent is not None else f"    # nothing was sent: {shown}")
    return "\n".join(["[", *lines, "]"])


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the exchanges of one instrument in a wire log as a Python list of pairs (sent, answered).

    A query without a reply gets a note on standard error. Returns the exit status: 0, or 2 for an unreadable log.
    """
    parser = argparse.ArgumentParser(
        prog="python -m drivers.wire.replay", description="Print a wire log as pairs of (sent, answered)."
    )
    parser.add_argument("log", type=Path)
    parser.add_argument("--instrument", required=True, help="its name in the log, such as voltmeter.x")
    given = parser.parse_args(arguments)
    try:
        made = exchanges(read_log(given.log, given.instrument))
    except (OSError, WireLogError) as error:
        print(error, file=sys.stderr)
        return 2
    for exchange in made:
        if exchange.answered is None and "?" in (exchange.sent or ""):
            print(f"note: {given.log}, line {exchange.line}: no reply or failure follows", file=sys.stderr)
    print(as_pairs(made))
    return 0


if __name__ == "__main__":
    sys.exit(main())
