"""How long does `write; query` take through the drivers' transport, against a raw socket? Promised: under 2 times.

    python -m benchmarks.wire_speed --exchanges 2000 --rounds 7

Both talk to the same simulated meter, in turns, in one run; the meter is served by a process of its own. The
exchange is a setting and its query, `VOLT:NPLC 10` and `VOLT:NPLC?`. The median of the rounds counts. Exit
status 1 when the promise is broken.
"""

from __future__ import annotations

import multiprocessing
import socket
import statistics
import sys
import time
from collections.abc import Callable
from multiprocessing.connection import Connection

from benchmarks.campaign import arguments
from drivers.wire.visa import MessageSession

COMMAND, QUERY = "VOLT:NPLC 10", "VOLT:NPLC?"
NUMBER = r"[+-]\d\.\d{6}E[+-]\d\d"
PROMISE = 2.0


def serve(pipe: Connection) -> None:
    """Serve one meter; send its port, and end when something comes back."""
    from bench.config.bench_file.file import load_bench
    from bench.config.shipped import find_bench
    from bench.model import ForwardModel
    from bench.run.assembly.served import served_bench

    bench = load_bench(find_bench("paper-stand"))
    with served_bench(bench, ForwardModel(bench.installation_models()), 1, with_terminals=False) as serving:
        pipe.send(str(serving.instruments[0]["tcp"]))
        pipe.recv()


def through_transport(address: str) -> Callable[[], None]:
    host, port = address.split(":")
    session = MessageSession("voltmeter.x", f"TCPIP0::{host}::{port}::SOCKET")
    session.open()

    def exchange() -> None:
        session.write(COMMAND)
        session.query(QUERY, pattern=NUMBER)

    return exchange


def through_socket(address: str) -> Callable[[], None]:
    host, port = address.split(":")
    raw = socket.create_connection((host, int(port)))
    raw.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def exchange() -> None:
        raw.sendall(f"{COMMAND}\n".encode())
        raw.sendall(f"{QUERY}\n".encode())
        reply = b""
        while not reply.endswith(b"\n"):
            reply += raw.recv(4096)

    return exchange


def time_of(exchange: Callable[[], None], count: int) -> float:
    """Return the mean time of one exchange, s."""
    start = time.perf_counter()
    for _ in range(count):
        exchange()
    return (time.perf_counter() - start) / count


def main() -> int:
    given = arguments(__doc__, exchanges=(2000, "in one round"), rounds=7)
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    server = context.Process(target=serve, args=(there,))
    server.start()
    address = here.recv()
    kinds = {"raw socket": through_socket(address), "transport": through_transport(address)}
    times_s: dict[str, list[float]] = {name: [] for name in kinds}
    for _ in range(given.rounds):
        for name, exchange in kinds.items():
            times_s[name].append(time_of(exchange, given.exchanges))
    here.send("end")
    server.join()
    raw_s, own_s = (statistics.median(times_s[name]) for name in kinds)
    for name, measured in times_s.items():
        print(f"{name:12}{statistics.median(measured) * 1e6:8.1f} µs for one write; query")
    ratio = own_s / raw_s
    print(f"ratio       {ratio:8.2f}    promised: under {PROMISE:g}")
    return 0 if ratio < PROMISE else 1


if __name__ == "__main__":
    sys.exit(main())
