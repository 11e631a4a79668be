"""Are other people's drivers at home on the simulated meter? PyMeasure's HP34401A and QCoDeS's Agilent34401A.

    python -m venv /tmp/strangers && /tmp/strangers/bin/pip install pymeasure qcodes pyvisa-py pyserial
    /tmp/strangers/bin/python -m benchmarks.strangers --bench-program .venv/bin/bench

Serves the shipped bench with its meters set to `lan` and lets each driver, as published, do a full exchange
over TCP and over the pseudo-terminal: every property that it has, and an empty error queue after each. Prints
a table and every disagreement; exit status 1 when there is one. What is not installed is skipped.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SPEED = 200
ANGLE_COMMAND = "turn 45 deg"


class Exchange:
    """Counts what was tried and keeps what went wrong."""

    def __init__(self, errors: Callable[[], list[str]]) -> None:
        self.errors = errors
        self.tried = 0
        self.wrong: list[str] = []

    def check(self, what: str, action: Callable[[], Any], accept: Callable[[Any], bool]) -> None:
        """Do one thing; it must answer acceptably and leave no error in the queue."""
        self.tried += 1
        try:
            answer = action()
            left = self.errors()
        except Exception as error:  # the clients' libraries raise anything
            self.wrong.append(f"{what}: {type(error).__name__}: {error}")
            return
        if left:
            self.wrong.append(f"{what}: the error queue held {left}")
        elif not accept(answer):
            self.wrong.append(f"{what}: answered {answer!r}")


def number(value: Any) -> bool:
    return isinstance(value, float)


def put_and_get(parameter: Callable[..., Any], value: Any) -> Callable[[], Any]:
    def action() -> Any:
        parameter(value)
        return parameter()

    return action


def same(wanted: Any) -> Callable[[Any], bool]:
    return lambda value: value == wanted


@contextmanager
def served(program: str, written: str) -> Iterator[dict[str, Any]]:
    """Serve the bench of a bench file's text, its head turned to 45°; yield the ready file's content."""
    with tempfile.TemporaryDirectory() as folder:
        bench_file, ready = Path(folder) / "bench.yaml", Path(folder) / "ready.json"
        bench_file.write_text(written, encoding="utf-8")
        files = ["--bench", str(bench_file), "--ready-file", str(ready)]
        command = [program, "simulate", *files, "--speed", str(SPEED)]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)  # noqa: S603 - our own program
        try:
            while not ready.exists():
                if process.poll() is not None:
                    sys.exit(f"{program} does not serve")
                time.sleep(0.05)
            content = json.loads(ready.read_text(encoding="utf-8"))
            turn = [program, "simulate", "--control", content["control"], ANGLE_COMMAND]
            subprocess.run(turn, check=True, stdout=subprocess.DEVNULL)  # noqa: S603 - our own program
            yield content
        finally:
            process.terminate()
            if process.wait() != 0:
                print(f"the server ended with status {process.returncode}")


# --- PyMeasure --------------------------------------------------------------------------------------

RANGES = {
    "DCV": (0.1, 1, 10, 100, 1000), "ACV": (0.1, 1, 10, 100, 750), "DCI": (0.01, 0.1, 1, 3), "ACI": (1, 3),
    "R2W": (100, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8), "R4W": (100, 1e3, 1e4), "FREQ": (0.1, 1, 10),
    "PERIOD": (0.1, 1, 10),
}  # fmt: skip


def pymeasure(resource: str, line_end: str) -> Exchange:
    """Every property and method of pymeasure.instruments.hp.HP34401A."""
    from pymeasure.instruments.hp import HP34401A

    warnings.simplefilter("ignore", FutureWarning)
    meter = HP34401A(
        resource, visa_library="@py", read_termination=line_end, write_termination="\n", timeout=10_000
    )
    exchange = Exchange(meter.check_errors)

    def put(name: str, value: Any, back: Any = None) -> None:
        def action() -> Any:
            setattr(meter, name, value)
            return getattr(meter, name)

        exchange.check(f"{name} = {value!r}", action, same(value if back is None else back))

    def get(name: str, accept: Callable[[Any], bool] = number) -> None:
        exchange.check(name, lambda: getattr(meter, name), accept)

    meter.write("*CLS")
    meter.write("*RST")
    get("id", lambda text: text.split(",")[1] == "34401A")
    get("complete", lambda text: text == "1")
    get("status", lambda byte: int(byte) == 0)
    for function in HP34401A.FUNCTIONS:
        put("function_", function)
        get("reading")
    pymeasure_ranges(meter, put)
    meter.write("*RST")
    for name in ("autozero_enabled", "auto_input_impedance_enabled", "display_enabled", "beeper_enabled"):
        for flag in (False, True):
            put(name, flag)
    for name in ("remote_control_enabled", "remote_lock_enabled"):
        for flag in (True, False):
            exchange.check(f"{name} = {flag}", partial(setattr, meter, name, flag), same(None))
    exchange.check("trigger_single_autozero", meter.trigger_single_autozero, same(None))
    get("terminals_used", lambda side: side in {"FRONT", "REAR"})
    pymeasure_triggering(meter, exchange, put, get)
    put("displayed_text", "Hello World")
    exchange.check("beep", meter.beep, same(None))
    get("scpi_version", lambda version: version > 1990)
    get("self_test_result", same(0.0))
    for name in ("voltage_ac", "current_dc", "current_ac", "resistance", "resistance_4w"):
        get(name)
    exchange.check("shutdown", meter.shutdown, same(None))
    return exchange


def pymeasure_ranges(meter: Any, put: Callable[..., None]) -> None:
    """Ranges, integration, resolution, gate time and bandwidth of each function that has them."""
    for function, ranges in RANGES.items():
        meter.function_ = function
        for wanted in ranges:
            put("range_", wanted)
        put("range_", "MIN", ranges[0])
        put("autorange", True)
        put("autorange", False)
    for function in ("DCV", "DCI", "R2W", "R4W"):
        meter.function_ = function
        for nplc in (0.02, 0.2, 1, 10, 100):
            put("nplc", nplc)
    for function in ("DCV", "ACV", "DCI", "R2W"):
        meter.function_ = function
        meter.range_ = 1 if function != "R2W" else 100
        put("resolution", 0.0001 if function != "R2W" else 0.01)
    for function in ("FREQ", "PERIOD"):
        meter.function_ = function
        for gate_s in (0.01, 0.1, 1):
            put("gate_time", gate_s)
    for band_hz in (3, 20, 200):
        put("detector_bandwidth", band_hz)


def pymeasure_triggering(
    meter: Any, exchange: Exchange, put: Callable[..., None], get: Callable[..., None]
) -> None:
    """Trigger settings, readings at once and from memory."""
    for source in ("BUS", "EXT", "IMM"):
        put("trigger_source", source)
    put("trigger_delay", 1.5)
    put("trigger_delay", "MIN", 0.0)
    put("trigger_auto_delay_enabled", True)
    put("sample_count", 10)
    put("trigger_count", "INF", 9.9e37)
    put("trigger_count", 1)
    get("reading", lambda values: len(values) == 10)
    exchange.check("init_trigger", meter.init_trigger, same(None))
    get("stored_reading", lambda values: len(values) == 10)
    get("stored_readings_count", same(10.0))


# --- QCoDeS -----------------------------------------------------------------------------------------


def qcodes(resource: str, line_end: str) -> Exchange:
    """Every parameter and method of qcodes.instrument_drivers.agilent.Agilent34401A."""
    from qcodes.instrument_drivers.agilent import Agilent34401A

    meter = Agilent34401A(f"dmm_{abs(hash(resource))}", resource, visalib="@py", timeout=10)
    meter.visa_handle.read_termination = line_end

    def errors() -> list[str]:
        found = []
        while "No error" not in (answer := meter.ask("SYST:ERR?")):
            found.append(answer)
        return found

    exchange = Exchange(errors)
    exchange.check("reset", meter.reset, same(None))
    exchange.check("IDN", meter.IDN.get, lambda idn: idn["model"] == "34401A")
    for range_v in (0.1, 1.0, 100.0, 1000.0, 10.0):
        exchange.check(f"range {range_v}", put_and_get(meter.range, range_v), same(range_v))
    for nplc in (0.02, 0.2, 1, 10, 100, 1):
        exchange.check(f"NPLC {nplc}", put_and_get(meter.NPLC, nplc), same(nplc))
    for resolution_v in (1e-3, 1e-4, 3e-5, 1e-5, 3e-6):
        exchange.check(
            f"resolution {resolution_v}",
            put_and_get(meter.resolution, resolution_v),
            same(resolution_v),
        )
    for word in ("on", "off"):
        exchange.check(f"range_auto {word}", put_and_get(meter.range_auto, word), same(word))
    exchange.check("terminals", meter.terminals.get, lambda side: side in {"FRON", "REAR"})
    exchange.check("volt", meter.volt.get, lambda volts: 0.1 < abs(volts) < 3.0)
    exchange.check("init_measurement", meter.init_measurement, same(None))
    exchange.check("fetch", meter.fetch.get, lambda volts: 0.1 < abs(volts) < 3.0)
    exchange.check(
        "display_text",
        put_and_get(meter.display_text, "QCoDeS"),
        same('"QCoDeS"'),
    )
    exchange.check("display_clear", meter.display_clear, same(None))
    exchange.check("snapshot", lambda: meter.snapshot(update=True), lambda told: "volt" in told["parameters"])
    exchange.check("clear_errors", meter.clear_errors, same(None))
    meter.close()
    return exchange


STRANGERS = {"pymeasure": pymeasure, "qcodes": qcodes}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    own = Path(sys.executable).with_name("bench")
    found = shutil.which("bench") or str(own if own.exists() else ROOT / ".venv" / "bin" / "bench")
    parser.add_argument("--bench-program", default=found, help="the bench program that serves")
    program = str(Path(parser.parse_args().bench_program).resolve())
    present = {name: run for name, run in STRANGERS.items() if importlib.util.find_spec(name)}
    for name in [name for name in STRANGERS if name not in present]:
        print(
            f"skipped: {name} is not installed here; install it into an environment of its own (see --help)"
        )
    if not present:
        return 0
    wrong = []
    shipped = (ROOT / "config" / "paper-stand.yaml").read_text(encoding="utf-8")
    with served(program, shipped.replace("interface: gpib", "interface: lan")) as content:
        print(f"{'client':12}{'wire':6}{'exchanges':>10}{'wrong':>7}{'time':>9}")
        for name, run in present.items():
            meter = content["instruments"][0 if name == "pymeasure" else 1]
            host, port = meter["tcp"].split(":")
            wires = {"TCP": (f"TCPIP0::{host}::{port}::SOCKET", "\n")}
            if meter["pty"]:
                wires["pty"] = (f"ASRL{meter['pty']}::INSTR", "\r\n")
            for wire, (resource, line_end) in wires.items():
                start = time.perf_counter()
                exchange = run(resource, line_end)
                taken_s = time.perf_counter() - start
                print(f"{name:12}{wire:6}{exchange.tried:10}{len(exchange.wrong):7}{taken_s:7.1f} s")
                wrong += [f"{name} over {wire}: {text}" for text in exchange.wrong]
    print("\n".join(wrong or ["every exchange was answered as the driver expects, and left no error"]))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
