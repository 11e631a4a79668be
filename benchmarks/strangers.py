"""Test the drivers of PyMeasure, QCoDeS and dcps on the simulated meter and supplies.

    python -m venv VENV && VENV/bin/pip install pymeasure qcodes dcps pyvisa-py pyserial
    VENV/bin/python -m benchmarks.strangers --bench-program .venv/bin/bench

The shipped bench is served with its meters set to `lan`, then with each supply in turn. Each published driver is
used over TCP and over the pseudo-terminal: every property is set or read, and none may cause an instrument error.
A table and every disagreement are printed; the exit status is 1 if there is one. Packages that are not installed
are skipped. Over its serial port an E3631A must first be set to remote, which these drivers leave to their users.
"""

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
from itertools import product
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SPEED = 200
Accept = Callable[[Any], bool]


class Exchange:
    """A sequence of operations on a driver, and the faults found."""

    def __init__(self, errors: Callable[[], list[str]]) -> None:
        self.errors = errors
        self.tried = 0
        self.wrong: list[str] = []

    def check(self, what: str, action: Callable[[], Any], accept: Accept | Any = None) -> None:
        """Do one operation; it must return an acceptable value and leave no error in the queue.

        `accept` is the expected value, or a function that judges the value.
        """
        self.tried += 1
        try:
            answer = action()
            left = self.errors()
        except Exception as error:  # the libraries of the clients raise exceptions of any kind
            self.wrong.append(f"{what}: {type(error).__name__}: {error}")
            return
        if left:
            self.wrong.append(f"{what}: the error queue held {left}")
        elif not (accept(answer) if callable(accept) else answer == accept):
            self.wrong.append(f"{what}: answered {answer!r}")

    def put(self, holder: Any, name: str, value: Any, back: Any = None) -> None:
        """Set a property and read it back."""

        def action() -> Any:
            setattr(holder, name, value)
            return getattr(holder, name)

        self.check(f"{name} = {value!r}", action, value if back is None else back)

    def get(self, holder: Any, name: str, accept: Accept | Any = None) -> None:
        """Read a property; it must be a number, unless `accept` says otherwise."""
        self.check(name, lambda: getattr(holder, name), number if accept is None else accept)


def number(value: Any) -> bool:
    return isinstance(value, float)


def near(wanted: float) -> Accept:
    return lambda value: number(value) and abs(value - wanted) < 0.05


def scpi_errors(ask: Callable[[str], str]) -> list[str]:
    found = []
    while "No error" not in (answer := ask("SYST:ERR?")):
        found.append(answer)
    return found


def tti_errors(ask: Callable[[str], str]) -> list[str]:
    """Return the errors in *ESR? and EER?, except the bit for power on."""
    event, error = int(ask("*ESR?")) & ~128, int(ask("EER?"))
    return [f"*ESR? {event}, EER? {error}"] if event or error else []


def by_pymeasure(cls: str, resource: str, line_end: str) -> Any:
    from pymeasure.instruments import aimtti, hp, keysight

    warnings.simplefilter("ignore", FutureWarning)
    made = next(getattr(room, cls) for room in (hp, keysight, aimtti) if hasattr(room, cls))
    return made(
        resource, visa_library="@py", read_termination=line_end, write_termination="\n", timeout=10_000
    )


# --- the meter --------------------------------------------------------------------------------------

RANGES = {
    "DCV": (0.1, 1, 10, 100, 1000), "ACV": (0.1, 1, 10, 100, 750), "DCI": (0.01, 0.1, 1, 3), "ACI": (1, 3),
    "R2W": (100, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8), "R4W": (100, 1e3, 1e4), "FREQ": (0.1, 1, 10),
    "PERIOD": (0.1, 1, 10),
}  # fmt: skip


def of_functions() -> Iterator[tuple[str, str, Any, Any]]:
    """Yield function, property, value and value read back, for each property that only some functions have."""
    for function, ranges in RANGES.items():
        yield from ((function, "range_", wanted, wanted) for wanted in ranges)
        yield from ((function, "range_", "MIN", ranges[0]), (function, "autorange", True, True))
        yield function, "autorange", False, False
    for function, nplc in product(("DCV", "DCI", "R2W", "R4W"), (0.02, 0.2, 1, 10, 100)):
        yield function, "nplc", nplc, nplc
    for function, wanted, size in (("DCV", 1, 1e-4), ("ACV", 1, 1e-4), ("DCI", 1, 1e-4), ("R2W", 100, 0.01)):
        yield from ((function, "range_", wanted, wanted), (function, "resolution", size, size))
    for function, gate_s in product(("FREQ", "PERIOD"), (0.01, 0.1, 1)):
        yield function, "gate_time", gate_s, gate_s
    for band_hz in (3, 20, 200):
        yield "PERIOD", "detector_bandwidth", band_hz, band_hz


def pymeasure_34401a(resource: str, line_end: str) -> Exchange:
    """Test every property and method of pymeasure.instruments.hp.HP34401A."""
    meter = by_pymeasure("HP34401A", resource, line_end)
    exchange = Exchange(meter.check_errors)
    put, get = partial(exchange.put, meter), partial(exchange.get, meter)
    meter.write("*CLS")
    meter.write("*RST")
    get("id", lambda text: text.split(",")[1] == "34401A")
    get("complete", "1")
    get("status", lambda byte: int(byte) == 0)
    for function in meter.FUNCTIONS:
        put("function_", function)
        get("reading")
    for function, name, value, back in of_functions():
        meter.function_ = function
        put(name, value, back)
    meter.write("*RST")
    for name in ("autozero_enabled", "auto_input_impedance_enabled", "display_enabled", "beeper_enabled"):
        for flag in (False, True):
            put(name, flag)
    for name in ("remote_control_enabled", "remote_lock_enabled"):
        for flag in (True, False):
            exchange.check(f"{name} = {flag}", partial(setattr, meter, name, flag))
    exchange.check("trigger_single_autozero", meter.trigger_single_autozero)
    get("terminals_used", lambda side: side in {"FRONT", "REAR"})
    for source in ("BUS", "EXT", "IMM"):
        put("trigger_source", source)
    put("trigger_delay", 1.5)
    put("trigger_delay", "MIN", 0.0)
    put("trigger_auto_delay_enabled", True)
    put("sample_count", 10)
    put("trigger_count", "INF", 9.9e37)
    put("trigger_count", 1)
    get("reading", lambda values: len(values) == 10)
    exchange.check("init_trigger", meter.init_trigger)
    get("stored_reading", lambda values: len(values) == 10)
    get("stored_readings_count", 10.0)
    put("displayed_text", "Hello World")
    exchange.check("beep", meter.beep)
    get("scpi_version", lambda version: version > 1990)
    get("self_test_result", 0.0)
    for name in ("voltage_ac", "current_dc", "current_ac", "resistance", "resistance_4w"):
        get(name)
    exchange.check("shutdown", meter.shutdown)
    return exchange


def qcodes_34401a(resource: str, line_end: str) -> Exchange:
    """Test every parameter and method of qcodes.instrument_drivers.agilent.Agilent34401A."""
    from qcodes.instrument_drivers.agilent import Agilent34401A

    meter = Agilent34401A(f"dmm_{abs(hash(resource))}", resource, visalib="@py", timeout=10)
    meter.visa_handle.read_termination = line_end
    exchange = Exchange(partial(scpi_errors, meter.ask))
    exchange.check("reset", meter.reset)
    exchange.check("IDN", meter.IDN.get, lambda idn: idn["model"] == "34401A")
    settings: dict[str, tuple[Any, ...]] = {
        "range": (0.1, 1.0, 100.0, 1000.0, 10.0), "NPLC": (0.02, 0.2, 1, 10, 100, 1),
        "resolution": (1e-3, 1e-4, 3e-5, 1e-5, 3e-6), "range_auto": ("on", "off"),
    }  # fmt: skip
    for name, values in settings.items():
        for value in values:
            exchange.check(f"{name} {value}", partial(_put_and_get, getattr(meter, name), value), value)
    exchange.check("terminals", meter.terminals.get, lambda side: side in {"FRON", "REAR"})
    exchange.check("volt", meter.volt.get, lambda volts: 0.1 < abs(volts) < 3.0)
    exchange.check("init_measurement", meter.init_measurement)
    exchange.check("fetch", meter.fetch.get, lambda volts: 0.1 < abs(volts) < 3.0)
    exchange.check("display_text", partial(_put_and_get, meter.display_text, "QCoDeS"), '"QCoDeS"')
    exchange.check("display_clear", meter.display_clear)
    exchange.check("snapshot", lambda: meter.snapshot(update=True), lambda told: "volt" in told["parameters"])
    exchange.check("clear_errors", meter.clear_errors)
    meter.close()
    return exchange


def _put_and_get(parameter: Callable[..., Any], value: Any) -> Any:
    parameter(value)
    return parameter()


# --- supplies ---------------------------------------------------------------------------------------


def pymeasure_e3631a(resource: str, line_end: str) -> Exchange:
    """Test every property of pymeasure.instruments.keysight.KeysightE3631A, except the switches of single outputs.

    The driver sends these with a channel list, which an E3631A does not know, because it has one switch.
    """
    supply = by_pymeasure("KeysightE3631A", resource, line_end)
    if resource.startswith("ASRL"):
        supply.write("SYST:REM")
    exchange = Exchange(partial(scpi_errors, supply.ask))
    exchange.check("reset", supply.reset)
    for tracking in (True, False):
        exchange.put(supply, "tracking_enabled", tracking)
    volts = {1: 5.0, 2: 15.0, 3: -15.0}
    for channel, volt in volts.items():
        exchange.put(supply.channels[channel], "voltage_setpoint", volt, near(volt))
        exchange.put(supply.channels[channel], "current_limit", 0.25, near(0.25))
    exchange.put(supply, "output_enabled", True)
    for channel, volt in volts.items():
        exchange.get(supply.channels[channel], "voltage", near(volt))
        exchange.get(supply.channels[channel], "current")
    exchange.put(supply, "output_enabled", False)
    exchange.get(supply.ch_2, "voltage", near(0.0))
    return exchange


def _by_channel(exchange: Exchange, channels: dict[Any, float]) -> None:
    """Set, switch on, measure and switch off each of these outputs."""
    for channel, volt in channels.items():
        exchange.put(channel, "voltage_setpoint", volt, near(volt))
        exchange.put(channel, "current_limit", 0.25, near(0.25))
        exchange.put(channel, "output_enabled", True)
        exchange.get(channel, "voltage", near(volt))
        exchange.get(channel, "current")
        exchange.put(channel, "output_enabled", False)


def pymeasure_e36312a(resource: str, line_end: str) -> Exchange:
    """Test every property of pymeasure.instruments.keysight.KeysightE36312A."""
    supply = by_pymeasure("KeysightE36312A", resource, line_end)
    exchange = Exchange(partial(scpi_errors, supply.ask))
    exchange.check("id", lambda: supply.ask("*IDN?"), lambda text: "E36312A" in text)
    _by_channel(exchange, {supply.channels[k]: volt for k, volt in ((1, 5.0), (2, 15.0), (3, 12.0))})
    return exchange


def pymeasure_pl303(resource: str, line_end: str) -> Exchange:
    """Test every property and method of pymeasure.instruments.aimtti.PL303QMDP."""
    supply = by_pymeasure("PL303QMDP", resource, line_end)
    exchange = Exchange(partial(tti_errors, supply.ask))
    exchange.check("reset", lambda: supply.write("*RST"))
    exchange.check("id", lambda: supply.ask("*IDN?"), lambda text: "PL303QMD-P" in text)
    channels = {supply.ch_1: 5.0, supply.ch_2: 24.0}
    for channel in channels:
        for current_range in ("LOW", "HIGH"):
            exchange.put(channel, "current_range", current_range)
    _by_channel(exchange, channels)
    for on in (True, False):
        exchange.check(f"all {on}", partial(setattr, supply, "all_outputs_enabled", on), lambda _: True)
        exchange.get(supply.ch_1, "output_enabled", on)
    exchange.check("local", supply.local)
    return exchange


def dcps_pl303(resource: str, line_end: str) -> Exchange:
    """Test every method of an output in dcps.AimTTiPLP.AimTTiPLP."""
    from dcps.AimTTiPLP import AimTTiPLP

    supply = AimTTiPLP(resource, wait=0.0)
    supply.open()
    exchange = Exchange(partial(tti_errors, supply._instQuery))
    for channel, volt in ((1, 5.0), (2, 24.0)):
        exchange.check("setVoltage", partial(supply.setVoltage, volt, channel))
        exchange.check("queryVoltage", partial(supply.queryVoltage, channel), near(volt))
        exchange.check("setCurrent", partial(supply.setCurrent, 0.25, channel))
        exchange.check("queryCurrent", partial(supply.queryCurrent, channel), near(0.25))
        exchange.check("outputOn", partial(supply.outputOn, channel))
        exchange.check("isOutputOn", partial(supply.isOutputOn, channel), True)
        exchange.check("measureVoltage", partial(supply.measureVoltage, channel), near(volt))
        exchange.check("measureCurrent", partial(supply.measureCurrent, channel), number)
        exchange.check("outputOff", partial(supply.outputOff, channel))
        exchange.check("isOutputOn", partial(supply.isOutputOn, channel), False)
    for action in ("outputOnAll", "outputOffAll", "setRemote", "setLocal"):
        exchange.check(action, getattr(supply, action))
    return exchange


# --- the exchanges ----------------------------------------------------------------------------------

E3631A = "driver: keysight-e3631a, resource: 'ASRL/dev/ttyUSB9::INSTR', interface: {}"
E36312A = "driver: keysight-e36300, model: E36312A, resource: 'TCPIP0::192.0.2.70::5025::SOCKET'"
PL303 = "driver: aim-tti, model: PL303QMD-P, resource: 'TCPIP0::192.0.2.71::9221::SOCKET'"
TCP, PTY, BOTH = ("TCP",), ("pty",), ("TCP", "pty")

EXCHANGES: tuple[tuple[str, str, str, str, tuple[str, ...], Callable[[str, str], Exchange]], ...] = (
    ("pymeasure", "34401A", "voltmeter.x", "", BOTH, pymeasure_34401a),
    ("qcodes", "34401A", "voltmeter.y", "", BOTH, qcodes_34401a),
    ("pymeasure", "E3631A", "power_supply", E3631A.format("gpib"), TCP, pymeasure_e3631a),
    ("pymeasure", "E3631A", "power_supply", E3631A.format("rs232"), PTY, pymeasure_e3631a),
    ("pymeasure", "E36312A", "power_supply", E36312A, BOTH, pymeasure_e36312a),
    ("pymeasure", "PL303QMD-P", "power_supply", PL303, BOTH, pymeasure_pl303),
    ("dcps", "PL303QMD-P", "power_supply", PL303, BOTH, dcps_pl303),
)
"""Exchanges: package, instrument, its name on the bench, section of the supply, wires, and function."""


@contextmanager
def served(program: str, supply: str) -> Iterator[dict[str, Any]]:
    """Serve the shipped bench with a power supply and its head at 45°; yield the content of the ready file."""
    text = (ROOT / "config" / "paper-stand.yaml").read_text(encoding="utf-8")
    if supply:
        text = text.replace("\ninstruments:\n", f"\ninstruments:\n  power_supply: {{{supply}}}\n", 1)
    else:
        text = text.replace("interface: gpib", "interface: lan")
    with tempfile.TemporaryDirectory() as folder:
        bench_file, ready = Path(folder) / "bench.yaml", Path(folder) / "ready.json"
        bench_file.write_text(text, encoding="utf-8")
        files = ["--bench", str(bench_file), "--ready-file", str(ready)]
        command = [program, "simulate", *files, "--speed", str(SPEED)]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)  # noqa: S603 - our own program
        try:
            while not ready.exists():
                if process.poll() is not None:
                    sys.exit(f"{program} does not serve")
                time.sleep(0.05)
            content = json.loads(ready.read_text(encoding="utf-8"))
            turn = [program, "simulate", "--control", content["control"], "turn 45 deg"]
            subprocess.run(turn, check=True, stdout=subprocess.DEVNULL)  # noqa: S603 - our own program
            yield content
        finally:
            process.terminate()
            if process.wait() != 0:
                print(f"the server ended with status {process.returncode}")


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    own = Path(sys.executable).with_name("bench")
    found = shutil.which("bench") or str(own if own.exists() else ROOT / ".venv" / "bin" / "bench")
    parser.add_argument("--bench-program", default=found, help="the bench program that serves")
    program = str(Path(parser.parse_args().bench_program).absolute())
    wrong = []
    print(f"{'client':11}{'instrument':12}{'wire':6}{'exchanges':>10}{'wrong':>7}{'time':>9}")
    for package, model, name, supply, wires, run in EXCHANGES:
        if importlib.util.find_spec(package) is None:
            print(f"{package:11}{model:12}skipped: not installed here (see --help)")
            continue
        ends = {"TCP": "\r\n" if model.startswith("PL") else "\n", "pty": "\r\n"}
        with served(program, supply) as content:
            instrument = next(one for one in content["instruments"] if one["name"] == name)
            host, port = instrument["tcp"].split(":")
            resources = {"TCP": f"TCPIP0::{host}::{port}::SOCKET", "pty": f"ASRL{instrument['pty']}::INSTR"}
            for wire in (wire for wire in wires if wire == "TCP" or instrument["pty"]):
                start = time.perf_counter()
                exchange = run(resources[wire], ends[wire])
                told = f"{exchange.tried:10}{len(exchange.wrong):7}{time.perf_counter() - start:7.1f} s"
                print(f"{package:11}{model:12}{wire:6}{told}", flush=True)
                wrong += [f"{package} on {model} over {wire}: {text}" for text in exchange.wrong]
    print("\n".join(wrong or ["every exchange was answered as the driver expects, and left no error"]))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
