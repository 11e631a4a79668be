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
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Final

import typer

from bench.base.files import read_regular
from bench.cli import printing
from bench.cli.options import BenchOption, ModelOption, app
from bench.services.errors import Refused

if TYPE_CHECKING:
    from bench.config.bench_file.file import BenchFile
    from bench.run.assembly.served import Serving

_LOOK_S: Final = 0.5
_CONTROL_TIMEOUT_S: Final = 10.0


@app.command(epilog="Example: bench simulate --bench my-bench.yaml --port 5025 --ready-file ready.json")
def simulate(
    command: Annotated[
        str | None,
        typer.Argument(help="With --control: what to do on a bench that is served, such as 'turn 45 deg'."),
    ] = None,
    bench: BenchOption = None,
    model: ModelOption = None,
    seed: Annotated[int, typer.Option(help="Random numbers of the simulated bench.", min=0)] = 1,
    speed: Annotated[float, typer.Option(help="How many times faster than real time it goes.")] = 1.0,
    host: Annotated[str, typer.Option(help="Address to listen on; loopback keeps others out.")] = "127.0.0.1",
    port: Annotated[
        int | None, typer.Option(help="First TCP port, the others follow (default: free ones).")
    ] = None,
    ready_file: Annotated[
        Path | None,
        typer.Option(
            "--ready-file", metavar="FILE", help="JSON with all addresses, once everything listens."
        ),
    ] = None,
    no_pty: Annotated[bool, typer.Option("--no-pty", help="TCP alone, no pseudo-terminals.")] = False,
    control: Annotated[
        str | None,
        typer.Option("--control", metavar="HOST:PORT", help="Send COMMAND to a bench that is served."),
    ] = None,
) -> int:
    """Serve the simulated instruments of a bench file until Ctrl-C, or command a bench that is served."""
    if control is not None or command is not None:
        return _command(control, command)
    return _serve(bench, model, seed, speed, host, port, ready_file, with_terminals=not no_pty)


def _serve(
    bench: str | None,
    model: Path | None,
    seed: int,
    speed: float,
    host: str,
    port: int | None,
    ready_file: Path | None,
    *,
    with_terminals: bool,
) -> int:
    """Serve until Ctrl-C, SIGTERM or the end of the terminal, then end with 0.

    Raises `Refused` for a speed or port that there is not, `BenchError` for a port that is taken.
    """
    from bench.config.bench_file.file import load_bench
    from bench.run.assembly.served import served_bench
    from bench.services.bench_selection import bench_path
    from bench.services.simulated_truth import simulated_truth

    if not 0.0 < speed < math.inf:
        raise Refused(f"--speed {speed:g}: a clock runs at a positive speed such as 1 or 60")
    if port is not None and not 0 <= port <= 65535:
        raise Refused(f"--port {port}: ports are numbers from 1 to 65535 (0: free ones)")
    file = load_bench(bench_path(bench))
    with (
        _ended_by_signal() as ended,
        _held(host, port),
        served_bench(
            file,
            simulated_truth(file, model),
            seed,
            speed=speed,
            host=host,
            first_port=port or 0,
            with_terminals=with_terminals,
        ) as serving,
        _announced(serving, ready_file),
    ):
        _show(file, serving)
        while not ended.wait(_LOOK_S):  # in slices: on Windows a signal does not end a wait
            pass
    return 0


def _command(control: str | None, text: str | None) -> int:
    """Send a command to a bench that is served: print the answer, a line of JSON.

    Raises `Refused` when nobody answers, or the command is refused.
    """
    if control is None or text is None:
        raise Refused("a bench that is served takes: bench simulate --control HOST:PORT 'turn 45 deg'")
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
            f"no simulated bench answers at {control} ({error.strerror or error}); see its ready file"
        ) from error
    except ValueError as error:
        raise Refused(f"{control} is not the control of a simulated bench") from error
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
        out.print(f"{' and '.join(by_hand)}: without a wire of its own, set through the control")
    out.print(f"control: bench simulate --control {serving.control} 'turn 45 deg' ('help' lists all)")
    out.print("serving until Ctrl-C")


@contextmanager
def _held(host: str, port: int | None) -> Iterator[None]:
    """Hold the first of the ports that were chosen: who would serve there as well is told who does."""
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
        raise Refused(f"{ready_file}: cannot be written ({error.strerror}); choose another place") from error
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            if ordinary and read_regular(ready_file).decode() == text:
                ready_file.unlink()


@contextmanager
def _ended_by_signal() -> Iterator[threading.Event]:
    """Yield what Ctrl-C, SIGTERM and a closed terminal set in place of ending the program."""
    from bench.run.listening import SIGNALS

    ended = threading.Event()

    def end(number: int, frame: FrameType | None) -> None:
        ended.set()

    before = {number: signal.signal(number, end) for number in SIGNALS}
    try:
        yield ended
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
