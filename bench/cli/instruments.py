"""instruments, simulate: test or commission the instruments of a bench; serve simulated ones."""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Final

from bench.base.files import read_regular
from bench.base.languages import message, translated
from bench.cli import printing
from bench.cli.options import JsonOption, command
from bench.services.errors import Refused, refusing
from bench.services.requests.measuring import InstrumentsRequest, SimulateRequest

if TYPE_CHECKING:
    from bench.config.bench_file.file import BenchFile
    from bench.run.assembly.served import Serving

_LOOK_S: Final = 0.5
_CONTROL_TIMEOUT_S: Final = 10.0


@command("bench instruments --bench my-bench.yaml")
def instruments(request: InstrumentsRequest, json: JsonOption = None) -> int:
    """Test all instruments of a bench: identity, self-test, reading."""
    if request.commission:
        if request.discover:
            raise Refused("--commission excludes --discover; remove one of them")
        if request.wire_log is not None:
            raise Refused(
                "--commission excludes --wire-log, as its folder holds a wire log; remove --wire-log"
            )
        _named(request.bench)
        return _commission(request, json)
    for option, given in (("--dry-run", request.dry_run), ("--out", request.out is not None)):
        if given:
            raise Refused(f"{option} needs --commission; add --commission, or remove {option}")
    return _offers(json) if request.discover else look(request.bench, json, request.wire_log)


def _named(bench: str | None) -> str | None:
    """Return `bench`, or None if BENCH_FILE names a bench file. Raises `Refused` if neither names one."""
    if not (bench or os.environ.get("BENCH_FILE")):
        raise Refused(
            "no bench file named; give --bench FILE or set BENCH_FILE (--discover lists what is connected)"
        )
    return bench


def look(bench: str | None, target: str | None = None, wire_log: Path | None = None) -> int:
    """Open, test and read all instruments; return the exit status.

    The status is 0 if no instrument has a fault, 2 if one could not be opened or was lost, else 1. `target`
    is the file of the JSON result. Raises `FileMistakes` for an invalid bench file, `Refused` without a bench
    file, and `OSError` if the wire log cannot be written.
    """
    from bench.config.bench_file.file import load_bench
    from bench.results.records import InstrumentsResult
    from bench.run.interrupts import Interrupts
    from bench.services.bench_selection import bench_path
    from bench.services.instruments import look_at
    from bench.services.traceability import remarks
    from drivers.wire.replay import logged_wire

    file = load_bench(bench_path(_named(bench)))
    with logged_wire(wire_log) as wire, Interrupts() as interrupts:
        rows = look_at(file, wire, interrupts.haste)
    failures = [failure for row in rows for failure in row.failures]
    result = InstrumentsResult(bench=file.name, passed=not failures, instruments=[row.part for row in rows])
    printing.write_json([result.to_dict()], target)
    if target != "-":
        result.print_on(printing.console())
        serials = {row.name: row.identity.serial for row in rows if row.identity is not None}
        printing.notes_on(printing.console(), remarks(file, serials))
    printing.aside(*(f"bench: {failure}" for failure in failures))
    if any(row.absent for row in rows):
        return 2
    return 1 if failures else 0


def _offers(target: str | None) -> int:
    """List the resources that the interfaces offer, without addressing an instrument; return 0."""
    from drivers.wire.resources import discover

    offer = discover()
    printing.write_json([asdict(offer)], target)
    if target == "-":
        return 0
    out = printing.console()
    table = printing.table("resource", "what it is", no_wrap=True)
    for resource in offer.resources:
        table.add_row(resource, "")
    for port in offer.serial_ports:
        table.add_row(port.resource, message(f"serial port {port.device} {port.description}").rstrip())
    out.print(table if table.row_count else "nothing was found: check power, cables and addresses")
    printing.notes_on(out, offer.notes)
    return 0


def _commission(request: InstrumentsRequest, target: str | None) -> int:
    """Commission a bench and print the findings.

    Return 0 if everything works, 1 after a deviation, 2 if a check or the whole session was not completed.
    Raises `Refused` if there is no terminal or the folder cannot be used, `FileMistakes`.
    """
    from bench.base.text import visible
    from bench.config.bench_file.file import load_bench
    from bench.results.records import VERDICTS
    from bench.run.commission.session import WISHES
    from bench.run.terminal import TerminalPerson
    from bench.services.bench_selection import bench_path
    from bench.services.instruments import PAGE, CommissioningPlan, commission, free_folder

    if not request.dry_run and not sys.stdin.isatty():
        raise Refused(
            "commissioning asks a person and moves the head; start it in a terminal, or try it with --dry-run"
        )
    path = bench_path(request.bench)
    file = load_bench(path)
    console = printing.console(json=target)
    folder = request.out or free_folder("commissioning")
    printing.in_words(
        console,
        message(
            f"commissioning of {file.name} ({path}), {'SIMULATED' if request.dry_run else 'on the bench'}; "
            "type :skip REASON at a question to leave out a check, :abort to end; Ctrl-C makes the bench safe"
        ),
    )
    person = None if request.dry_run else TerminalPerson(sys.stdin, console, wishes=WISHES)

    def tell(line: str) -> None:
        printing.in_words(console, visible(line))

    result = commission(CommissioningPlan(file, path, folder, person, request.seed, tell))
    printing.write_json([result], target)
    for name, what in result["to_do"].items():
        printing.aside(f"bench: still to do: {translated(name)}: {translated(what)}")
    if result["ended"]:
        printing.aside(f"bench: ended early: {result['ended']}")
    console.print(VERDICTS[result["status"]][1])
    printing.written("page", folder / PAGE, console)
    return int(result["status"])


# --- simulated instruments --------------------------------------------------------------------------


@command("bench simulate --bench my-bench.yaml --port 5025 --ready-file ready.json")
def simulate(request: SimulateRequest) -> int:
    """Serve the simulated instruments of a bench file until Ctrl-C.

    With --control, send a command to a served bench.
    """
    if request.control is not None or request.command:
        return _command(request.control, " ".join(request.command or ()))
    return _serve(request)


def _serve(request: SimulateRequest) -> int:
    """Serve the simulated instruments until Ctrl-C, SIGTERM or the terminal is closed; return 0.

    Raises `Refused` for an invalid speed or port, `BenchError` for a port in use.
    """
    from bench.config.bench_file.file import load_bench
    from bench.run.assembly.served import served_bench
    from bench.services.bench_selection import bench_path
    from bench.services.own_effects import simulated_truth

    speed, host, port = request.speed, request.host, request.port
    if not 0.0 < speed < math.inf:
        raise Refused(f"--speed {speed:g}: give a positive speed such as 1 or 60")
    if port is not None and not 0 <= port <= 65535:
        raise Refused(f"--port {port}: give a port from 1 to 65535, or 0 for free ports")
    file = load_bench(bench_path(request.bench))
    with (
        _ended_by_signal() as ended,
        _held(host, port),
        served_bench(
            file,
            simulated_truth(file, None if request.model is None else Path(request.model)),
            request.seed,
            speed=speed,
            host=host,
            first_port=port or 0,
            with_terminals=not request.no_pty,
            hands=request.hands,
            tell=lambda line: printing.console().out(f"hands: {line}", highlight=False),
        ) as serving,
        _announced(serving, request.ready_file),
    ):
        _show(file, serving)
        while not ended.wait(_LOOK_S):  # in slices: on Windows a signal does not end a wait
            pass
    return 0


def _command(control: str | None, text: str) -> int:
    """Send a command to a served bench and print its JSON answer; return 0. Raises `Refused` otherwise."""
    if control is None or not text:
        raise Refused(
            "--control needs an address and a command for the served bench; give both: bench simulate "
            "--control HOST:PORT 'turn 45 deg'"
        )
    host, _, port = control.rpartition(":")
    if not host or not port.isascii() or not port.isdecimal() or int(port) > 65535:
        raise Refused(f"--control {control}: expected HOST:PORT as 'bench simulate' shows it")
    line = " ".join(text.split())
    try:
        with socket.create_connection((host, int(port)), timeout=_CONTROL_TIMEOUT_S) as connection:
            connection.sendall(f"{line or 'help'}\n".encode())
            with connection.makefile("r", encoding="utf-8") as lines:
                answer = lines.readline()
        reply = json.loads(answer)
    except OSError as error:
        raise Refused(
            f"no simulated bench answers at {control} ({error.strerror or error}); take the address "
            "that 'bench simulate' shows"
        ) from error
    except ValueError as error:
        raise Refused(
            f"{control} is not the control of a simulated bench; take the address that 'bench simulate' shows"
        ) from error
    if not isinstance(reply, dict) or not reply.get("ok"):
        raise Refused(str(reply.get("error", answer)) if isinstance(reply, dict) else answer)
    printing.console().out(answer.strip(), highlight=False)
    return 0


def _show(bench: BenchFile, serving: Serving) -> None:
    out = printing.console()
    table = printing.table("instrument", "model", "TCP", "pseudo-terminal", no_wrap=True)
    for served in serving.instruments:
        table.add_row(served["name"], served["model"], served["tcp"], served["pty"] or "none")
    out.print(table)
    by_hand = [section.name for section in bench.instruments.all() if section.by_hand]
    if by_hand:
        out.print(f"{' and '.join(by_hand)}: no wire; set it through the control")
    out.print(f"control: bench simulate --control {serving.control} 'turn 45 deg' ('help' lists all)")
    out.print("serving until Ctrl-C")


@contextmanager
def _held(host: str, port: int | None) -> Iterator[None]:
    """Lock the first `port`, if chosen, so that a second program gets an error that names this program."""
    from bench.base.files import cache_folder
    from bench.run.assembly.served import HELD
    from drivers.wire.resources import Holding

    if not port:
        yield
        return
    holding, place = Holding(cache_folder(HELD)), f"{host}:{port}"
    holding.take("simulation", f"serving {place}", called=place)
    try:
        yield
    finally:
        holding.release(f"serving {place}")


@contextmanager
def _announced(serving: Serving, ready_file: Path | None) -> Iterator[None]:
    """Write the ready file atomically; delete it at the end, unless another program has replaced it."""
    from bench.results.records import ReadyResult, ServedPart

    if ready_file is None:
        yield
        return
    served = [ServedPart(**dict(one)) for one in serving.instruments]
    ready = ReadyResult(instruments=served, control=serving.control)
    text = json.dumps(ready.to_dict(), indent=1) + "\n"
    ordinary = not ready_file.exists() or ready_file.is_file()
    with refusing("choose another place", ready_file):
        if ordinary:
            unready = ready_file.with_name(f".{ready_file.name}.{os.getpid()}")
            unready.write_text(text, encoding="utf-8")
            unready.replace(ready_file)
        else:
            ready_file.write_text(text, encoding="utf-8")
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            if ordinary and read_regular(ready_file).decode() == text:
                ready_file.unlink()


@contextmanager
def _ended_by_signal() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C, SIGTERM or a closed terminal sets, instead of ending the program."""
    from bench.run.interrupts import SIGNALS

    ended = threading.Event()

    def end(number: int, frame: FrameType | None) -> None:
        ended.set()

    before = {number: signal.signal(number, end) for number in SIGNALS}
    try:
        yield ended
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
