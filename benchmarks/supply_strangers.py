"""Are other people's drivers at home on the simulated power supplies? PyMeasure's, and dcps's for the Aim-TTi.

    python -m venv /tmp/strangers && /tmp/strangers/bin/pip install pymeasure dcps pyvisa-py pyserial
    /tmp/strangers/bin/python -m benchmarks.supply_strangers --bench-program .venv/bin/bench

Serves a bench with each supply in turn; each driver, as published, does a full exchange over TCP and over the
pseudo-terminal: every property that it has, and no error reported after each. Prints a table and every
disagreement; exit status 1 when there is one. What is not installed is skipped. Over its serial port an E3631A must
be told to be remote first, which these drivers leave to their users: here it is sent before the driver begins.
"""

from __future__ import annotations

import argparse
import importlib.util
import shutil
import sys
import time
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.strangers import ROOT, Exchange, number, same, served

LEAST_V = 0.05


def supply_bench(section: str) -> str:
    """Return the shipped bench file with a power supply."""
    shipped = (ROOT / "config" / "paper-stand.yaml").read_text(encoding="utf-8")
    return shipped.replace("\ninstruments:\n", f"\ninstruments:\n  power_supply: {{{section}}}\n", 1)


def near(wanted: float) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, float) and abs(value - wanted) < LEAST_V


# --- PyMeasure --------------------------------------------------------------------------------------


def of_pymeasure(cls: str, resource: str, line_end: str) -> Any:
    from pymeasure.instruments import aimtti, keysight

    warnings.simplefilter("ignore", FutureWarning)
    made = getattr(keysight, cls, None) or getattr(aimtti, cls)
    return made(
        resource, visa_library="@py", read_termination=line_end, write_termination="\n", timeout=10_000
    )


def put(exchange: Exchange, holder: Any, name: str, value: Any) -> None:
    """Set a property and read it back."""

    def action() -> Any:
        setattr(holder, name, value)
        return getattr(holder, name)

    exchange.check(f"{name} = {value!r}", action, near(value) if isinstance(value, float) else same(value))


def scpi_errors(ask: Callable[[str], str]) -> list[str]:
    found = []
    while "No error" not in (answer := ask("SYST:ERR?")):
        found.append(answer)
    return found


def pymeasure_e3631a(resource: str, line_end: str) -> Exchange:
    """Every property of pymeasure.instruments.keysight.KeysightE3631A but the switches of single outputs.

    It sends these with a channel list, which an E3631A does not know: it has one switch.
    """
    supply = of_pymeasure("KeysightE3631A", resource, line_end)
    if resource.startswith("ASRL"):
        supply.write("SYST:REM")
    exchange = Exchange(partial(scpi_errors, supply.ask))
    exchange.check("reset", supply.reset, same(None))
    for tracking in (True, False):
        put(exchange, supply, "tracking_enabled", tracking)
    for channel, volts in ((1, 5.0), (2, 15.0), (3, -15.0)):
        put(exchange, supply.channels[channel], "voltage_setpoint", volts)
        put(exchange, supply.channels[channel], "current_limit", 0.25)
    put(exchange, supply, "output_enabled", True)
    for channel, volts in ((1, 5.0), (2, 15.0), (3, -15.0)):
        exchange.check(
            f"voltage {channel}", partial(getattr, supply.channels[channel], "voltage"), near(volts)
        )
        exchange.check(f"current {channel}", partial(getattr, supply.channels[channel], "current"), number)
    put(exchange, supply, "output_enabled", False)
    exchange.check("voltage off", lambda: supply.ch_2.voltage, near(0.0))
    return exchange


def pymeasure_e36312a(resource: str, line_end: str) -> Exchange:
    """Every property of pymeasure.instruments.keysight.KeysightE36312A."""
    supply = of_pymeasure("KeysightE36312A", resource, line_end)
    exchange = Exchange(partial(scpi_errors, supply.ask))
    exchange.check("id", lambda: supply.ask("*IDN?"), lambda text: "E36312A" in text)
    for number_, volts in ((1, 5.0), (2, 15.0), (3, 12.0)):
        channel = supply.channels[number_]
        put(exchange, channel, "voltage_setpoint", volts)
        put(exchange, channel, "current_limit", 0.25)
        put(exchange, channel, "output_enabled", True)
        exchange.check(f"voltage {number_}", partial(getattr, channel, "voltage"), near(volts))
        exchange.check(f"current {number_}", partial(getattr, channel, "current"), number)
        put(exchange, channel, "output_enabled", False)
    return exchange


def tti_errors(ask: Callable[[str], str]) -> list[str]:
    """Return what *ESR? and EER? tell but for the power having been switched on."""
    event, error = int(ask("*ESR?")) & ~128, int(ask("EER?"))
    return [f"*ESR? {event}, EER? {error}"] if event or error else []


def pymeasure_pl303(resource: str, line_end: str) -> Exchange:
    """Every property and method of pymeasure.instruments.aimtti.PL303QMDP."""
    supply = of_pymeasure("PL303QMDP", resource, line_end)
    exchange = Exchange(partial(tti_errors, supply.ask))
    exchange.check("reset", lambda: supply.write("*RST"), same(None))
    exchange.check("id", lambda: supply.ask("*IDN?"), lambda text: "PL303QMD-P" in text)
    for channel, volts in ((supply.ch_1, 5.0), (supply.ch_2, 24.0)):
        for current_range in ("LOW", "HIGH"):
            put(exchange, channel, "current_range", current_range)
        put(exchange, channel, "voltage_setpoint", volts)
        put(exchange, channel, "current_limit", 0.25)
        put(exchange, channel, "output_enabled", True)
        exchange.check("voltage", partial(getattr, channel, "voltage"), near(volts))
        exchange.check("current", partial(getattr, channel, "current"), number)
        put(exchange, channel, "output_enabled", False)
    for on in (True, False):
        exchange.check(f"all {on}", partial(setattr, supply, "all_outputs_enabled", on), lambda _: True)
        exchange.check("output", lambda: supply.ch_1.output_enabled, same(on))
    exchange.check("local", supply.local, same(None))
    return exchange


# --- dcps -------------------------------------------------------------------------------------------


def dcps_pl303(resource: str, line_end: str) -> Exchange:
    """Every method of dcps.AimTTiPLP.AimTTiPLP that an output has."""
    from dcps.AimTTiPLP import AimTTiPLP

    supply = AimTTiPLP(resource, wait=0.0)
    supply.open()
    exchange = Exchange(partial(tti_errors, supply._instQuery))
    for channel, volts in ((1, 5.0), (2, 24.0)):
        exchange.check("setVoltage", partial(supply.setVoltage, volts, channel), same(None))
        exchange.check("queryVoltage", partial(supply.queryVoltage, channel), near(volts))
        exchange.check("setCurrent", partial(supply.setCurrent, 0.25, channel), same(None))
        exchange.check("queryCurrent", partial(supply.queryCurrent, channel), near(0.25))
        exchange.check("outputOn", partial(supply.outputOn, channel), same(None))
        exchange.check("isOutputOn", partial(supply.isOutputOn, channel), same(True))
        exchange.check("measureVoltage", partial(supply.measureVoltage, channel), near(volts))
        exchange.check("measureCurrent", partial(supply.measureCurrent, channel), number)
        exchange.check("outputOff", partial(supply.outputOff, channel), same(None))
        exchange.check("isOutputOn", partial(supply.isOutputOn, channel), same(False))
    for action in ("outputOnAll", "outputOffAll", "setRemote", "setLocal"):
        exchange.check(action, getattr(supply, action), same(None))
    return exchange


E3631A = "driver: keysight-e3631a, resource: 'ASRL/dev/ttyUSB9::INSTR', interface: {}"
E36312A = "driver: keysight-e36300, model: E36312A, resource: 'TCPIP0::192.0.2.70::5025::SOCKET'"
PL303 = "driver: aim-tti, model: PL303QMD-P, resource: 'TCPIP0::192.0.2.71::9221::SOCKET'"

EXCHANGES: tuple[tuple[str, str, str, tuple[str, ...], Callable[[str, str], Exchange]], ...] = (
    ("pymeasure", "E3631A", E3631A.format("gpib"), ("TCP",), pymeasure_e3631a),
    ("pymeasure", "E3631A", E3631A.format("rs232"), ("pty",), pymeasure_e3631a),
    ("pymeasure", "E36312A", E36312A, ("TCP", "pty"), pymeasure_e36312a),
    ("pymeasure", "PL303QMD-P", PL303, ("TCP", "pty"), pymeasure_pl303),
    ("dcps", "PL303QMD-P", PL303, ("TCP", "pty"), dcps_pl303),
)
"""Of each: package, supply, its section of the bench file, over which wires, the exchange."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    own = Path(sys.executable).with_name("bench")
    found = shutil.which("bench") or str(own if own.exists() else ROOT / ".venv" / "bin" / "bench")
    parser.add_argument("--bench-program", default=found, help="the bench program that serves")
    program = str(Path(parser.parse_args().bench_program).resolve())
    wrong = []
    print(f"{'client':11}{'supply':12}{'wire':6}{'exchanges':>10}{'wrong':>7}{'time':>9}")
    for package, supply, section, wires, run in EXCHANGES:
        if importlib.util.find_spec(package) is None:
            print(f"{package:11}{supply:12}skipped: not installed here (see --help)")
            continue
        line_ends = {"TCP": "\r\n" if supply.startswith("PL") else "\n", "pty": "\r\n"}
        with served(program, supply_bench(section)) as content:
            instrument = next(i for i in content["instruments"] if i["name"] == "power_supply")
            host, port = instrument["tcp"].split(":")
            resources = {"TCP": f"TCPIP0::{host}::{port}::SOCKET", "pty": f"ASRL{instrument['pty']}::INSTR"}
            for wire in wires:
                start = time.perf_counter()
                exchange = run(resources[wire], line_ends[wire])
                taken_s = time.perf_counter() - start
                print(
                    f"{package:11}{supply:12}{wire:6}{exchange.tried:10}{len(exchange.wrong):7}{taken_s:7.1f} s"
                )
                wrong += [f"{package} on {supply} over {wire}: {text}" for text in exchange.wrong]
    print("\n".join(wrong or ["every exchange was answered as the driver expects, and left no error"]))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
