"""Every instrument of the bench file over its simulated wire: commissioned, and with faults on the wire."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import partial
from typing import Final

from bench.base.languages import message
from bench.config.devices.device import WiredForm
from bench.run.assembly.served import dry_bench
from bench.run.workbench import QUICK_NPLC
from bench.services.errors import sentence
from bench.services.instruments import CommissioningPlan, commission
from bench.services.own_effects import simulated_truth
from bench.validation.registry import Context, Finding, raised_at
from bench.validation.registry import check as enter
from drivers.interfaces import BenchError, Voltmeter, VoltmeterSettings
from sim.bench import SimulatedBench
from sim.scpi import never
from sim.wires.faults import Fault, FaultKind

check = partial(enter, family=message("instruments of this bench file, simulated"))

_WELL: Final = ("works", "slower")
_PATIENCE_S: Final = 0.3
"""Longest wait for a silent instrument, s; the timeouts of the drivers would take minutes in all."""


@check("commissioning", "6.4.4", "works", place="drivers, sim")
def commissioned(context: Context) -> Iterator[Finding]:
    """Commission the bench on its simulated instruments: identities, settings, readings, motion, pulled cables."""
    folder = context.scratch / "commissioning"
    result = commission(CommissioningPlan(context.bench, context.bench_path, folder, None))
    drivers = {section.name: section.driver for section in context.bench.instruments.all()}
    for one in result["findings"]:
        name, state = one["instrument"], one["state"]
        figures = "; ".join(f"{f['what']} {f['value']:.4g} {f['unit']}" for f in one["figures"])
        words = f"{one['said']}" + (f" ({figures})" if figures else "")
        of, where = f"{name}, {one['check']}", f"{name}, driver {drivers.get(name, 'unknown')}"
        expected = state if state in _WELL else "works"
        yield Finding(state in _WELL, words, of=of, where=where, expected=expected)
    if result["ended"]:
        yield Finding(False, result["ended"], of="the whole session", expected="goes to its end")


_FAULTS: Final = {
    FaultKind.SILENCE: "an instrument that does not answer",
    FaultKind.GARBLE: "replies of which every character is wrong",
    FaultKind.CUT: "replies that break off",
}
_STRANGER: Final = b"ACME,COFFEE-MAKER,0,1.0"


@check("faults on the wire", "6.4.4", "refused, with the instrument's name", place="drivers")
def wire_faults(context: Context) -> Iterator[Finding]:
    """Open each instrument with a wire that is silent, garbles or cuts replies, or leads to another instrument."""
    wired = [one for one in context.bench.instruments.all() if isinstance(one, WiredForm)]
    for section in wired:
        name, driver = section.name, section.driver
        for kind, words in _FAULTS.items():
            fault = Fault(kind, probability=1.0, instrument=name)
            yield _refused(context, name, driver, words, partial(SimulatedBench.arm, fault=fault))
        yield _refused(context, name, driver, "another instrument", partial(_put_stranger, name=name))
    if not wired:
        yield Finding(True, "no instrument has a wire")


def _put_stranger(bench: SimulatedBench, name: str) -> None:
    def answer(message: bytes, interrupted: Callable[[], bool] = never) -> bytes | None:
        return _STRANGER

    bench.faulty[name].handle = answer  # type: ignore[method-assign]


def _refused(
    context: Context, name: str, driver: str, words: str, spoil: Callable[[SimulatedBench], None]
) -> Finding:
    """Open an instrument on a spoiled wire; the finding demands a refusal with name and remedy."""
    of, where = f"{name}, {words}", f"{name}, driver {driver}"
    with dry_bench(context.bench, simulated_truth(context.bench, None), 1) as assembly:
        if assembly.simulated is None:
            return Finding(False, "there is no simulated bench", of=of, where=where)
        try:
            spoil(assembly.simulated)
        except ValueError as why:  # on a bus, the wire is the adapter's
            return Finding(True, f"does not apply: {why}", of=of)
        assembly.sessions[name].timeout_s = _PATIENCE_S
        instrument = next(one for one in assembly.instruments.all() if one.name == name)
        try:
            identity = instrument.open()
        except BenchError as refusal:
            return Finding(
                refusal.instrument == name and bool(refusal.remedy), str(refusal), of=of, where=where
            )
        except Exception as error:  # not a refusal that a run could report
            return Finding(False, sentence(error), of=of, where=f"{where}; raised in {raised_at(error)}")
        finally:
            instrument.close()
        return Finding(False, f"was opened as {identity}", of=of, where=where)


_NUMBER: Final = re.compile(rb"(?<=[ ,])[+-]?\d+(?:\.\d+)?")


@check("settings", "6.4.4", "refused, with the meter's name", place="drivers")
def other_settings(context: Context) -> Iterator[Finding]:
    """Let each voltmeter apply another number than the one sent: the program must notice the wrong setting."""
    bench = context.bench
    settings = VoltmeterSettings(bench.voltmeter_range_v, 10.0, bench.least_samples + 1)
    for meter, simulated in _voltmeters(context):
        _mishear(simulated, meter.name)
        try:
            meter.configure(settings)
            yield Finding(False, "were taken as made", of=meter.name, where=meter.name)
        except BenchError as refusal:
            yield _refused_by(meter, refusal)


def _voltmeters(context: Context) -> Iterator[tuple[Voltmeter, SimulatedBench]]:
    """Yield each voltmeter of the bench, open, and the simulated bench."""
    with dry_bench(context.bench, simulated_truth(context.bench, None), 1) as assembly:
        for meter in assembly.instruments.voltmeters:
            if (simulated := assembly.simulated) is None:
                continue
            meter.open()
            try:
                yield meter, simulated
            finally:
                meter.close()


def _refused_by(meter: Voltmeter, refusal: BenchError) -> Finding:
    return Finding(refusal.instrument == meter.name, str(refusal), of=meter.name, where=meter.name)


def _mishear(bench: SimulatedBench, name: str) -> None:
    """Let an instrument read 1 for each number in a command; queries reach it unchanged."""
    hear = bench.faulty[name].handle

    def mishear(message: bytes, interrupted: Callable[[], bool] = never) -> bytes | None:
        return hear(message if b"?" in message else _NUMBER.sub(b"1", message), interrupted)

    bench.faulty[name].handle = mishear  # type: ignore[method-assign]


@check("overload", "7.7.1", "refused, with the meter's name", place="drivers")
def overload(context: Context) -> Iterator[Finding]:
    """Overload the input of each voltmeter during a reading: the program must not accept the samples as numbers."""
    bench = context.bench
    settings = VoltmeterSettings(bench.voltmeter_range_v, QUICK_NPLC, bench.least_samples)
    for meter, simulated in _voltmeters(context):
        meter.configure(settings)
        simulated.arm(Fault(FaultKind.OVERLOAD, probability=1.0, instrument=meter.name))
        try:
            meter.start()
            yield Finding(False, str(meter.fetch()), of=meter.name, where=meter.name)
        except BenchError as refusal:
            yield _refused_by(meter, refusal)
