"""simulate: the simulated instruments of a bench file for any other program, and commands to them."""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Final

from rich.table import Table

from bench.assembly.served import Serving, served_bench
from bench.cli import CommandError, printing
from bench.cli.source import bench_path
from bench.files.bench.file import BenchFile, load_bench
from bench.files.model import load_model
from bench.model import ForwardModel

_LOOK_S: Final = 0.5
_CONTROL_TIMEOUT_S: Final = 10.0


@dataclass(frozen=True)
class Request:
    """What `bench simulate` was asked to serve."""

    bench: str | None
    model: Path | None
    seed: int
    speed: float
    host: str
    port: int | None
    ready_file: Path | None
    with_terminals: bool


def serve(request: Request) -> int:
    """Carry out `bench simulate`: serve until Ctrl-C or SIGTERM, then end with 0.

    Raises `CommandError` for a speed or port that there is not, `BenchError` for a port that is taken.
    """
    if not 0.0 < request.speed < math.inf:
        raise CommandError(f"--speed {request.speed:g}: a clock runs at a positive speed such as 1 or 60")
    if request.port is not None and not 0 <= request.port <= 65535:
        raise CommandError(f"--port {request.port}: ports are numbers from 1 to 65535 (0: free ones)")
    bench = load_bench(bench_path(request.bench))
    with (
        _ended_by_signal() as ended,
        served_bench(
            bench,
            _truth(bench, request.model),
            request.seed,
            speed=request.speed,
            host=request.host,
            first_port=request.port or 0,
            with_terminals=request.with_terminals,
        ) as serving,
        _announced(serving, request.ready_file),
    ):
        _show(bench, serving)
        while not ended.wait(_LOOK_S):  # in slices: on Windows a signal does not end a wait
            pass
    return 0


def command(control: str | None, text: str | None) -> int:
    """Carry out `bench simulate --control HOST:PORT COMMAND`: print the answer, a line of JSON.

    Raises `CommandError` when nobody answers, or the command is refused.
    """
    if control is None or text is None:
        raise CommandError("a bench that is served takes: bench simulate --control HOST:PORT 'turn 45 deg'")
    host, _, port = control.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise CommandError(f"--control {control}: expected HOST:PORT as 'bench simulate' shows it")
    line = " ".join(text.split())
    try:
        with socket.create_connection((host, int(port)), timeout=_CONTROL_TIMEOUT_S) as connection:
            connection.sendall(f"{line or 'help'}\n".encode())
            with connection.makefile("r", encoding="utf-8") as lines:
                answer = lines.readline()
        told = json.loads(answer)
    except OSError as error:
        raise CommandError(
            f"no simulated bench answers at {control} ({error.strerror or error}); see its ready file"
        ) from error
    except ValueError as error:
        raise CommandError(f"{control} is not the control of a simulated bench") from error
    if not isinstance(told, dict) or not told.get("ok"):
        raise CommandError(str(told.get("error", answer)) if isinstance(told, dict) else answer)
    printing.console().out(answer.strip(), highlight=False)
    return 0


def _truth(bench: BenchFile, model: Path | None) -> ForwardModel:
    """Return the model that the world obeys: effects of the bench file and of the model file."""
    effects = bench.applied_effects()
    if model is not None:
        effects += load_model(model, bench.installation_models()).applied_effects()
    return ForwardModel(bench.installation_models(), effects)


def _show(bench: BenchFile, serving: Serving) -> None:
    out = printing.console()
    table = Table(box=None, pad_edge=False)
    for heading in ("instrument", "model", "TCP", "pseudo-terminal"):
        table.add_column(heading, no_wrap=True)
    for served in serving.instruments:
        table.add_row(served["name"], served["model"], served["tcp"], served["pty"] or "none")
    out.print(table)
    by_hand = [section.name for section in bench.instruments.all() if section.by_hand]
    if by_hand:
        out.print(f"{' and '.join(by_hand)}: without a wire of its own, set through the control")
    out.print(f"control: bench simulate --control {serving.control} 'turn 45 deg' ('help' lists all)")
    out.print("serving until Ctrl-C")


@contextmanager
def _announced(serving: Serving, ready_file: Path | None) -> Iterator[None]:
    """Write the ready file, whole from its first moment; take it away again when it is still ours."""
    if ready_file is None:
        yield
        return
    content = {"instruments": [dict(served) for served in serving.instruments], "control": serving.control}
    text = json.dumps(content, indent=1) + "\n"
    ordinary = not ready_file.exists() or ready_file.is_file()
    try:
        if ordinary:
            unready = ready_file.with_name(f".{ready_file.name}.{os.getpid()}")
            unready.write_text(text, encoding="utf-8")
            unready.replace(ready_file)
        else:
            ready_file.write_text(text, encoding="utf-8")
    except OSError as error:
        raise CommandError(
            f"{ready_file}: cannot be written ({error.strerror}); choose another place"
        ) from error
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            if ordinary and ready_file.read_text(encoding="utf-8") == text:
                ready_file.unlink()


@contextmanager
def _ended_by_signal() -> Iterator[threading.Event]:
    """Yield what Ctrl-C and SIGTERM set in place of ending the program."""
    ended = threading.Event()

    def end(number: int, frame: FrameType | None) -> None:
        ended.set()

    before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield ended
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
