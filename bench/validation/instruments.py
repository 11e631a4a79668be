"""Every instrument of the bench file over its simulated wire: commissioned, and with faults on the wire."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Final

from bench.config.devices.device import WiredForm
from bench.run.assembly.served import dry_bench
from bench.services.instruments import CommissioningPlan, commission
from bench.services.own_effects import simulated_truth
from bench.validation.registry import Context, Finding
from bench.validation.registry import check as enter
from drivers.interfaces import BenchError, InstrumentLost, InstrumentRefused
from sim.wires.faults import Fault, FaultKind

check = partial(enter, family="instruments of this bench file, simulated")

_WELL: Final = ("works", "slower")
_PATIENCE_S: Final = 0.3
"""Time (s) for which a silent instrument is waited for; its own timeout would take minutes in all."""


@check("commissioning", "6.4.4", "works", place="drivers, sim")
def commissioned(context: Context) -> Iterator[Finding]:
    """Commission the bench on its simulated instruments: identities, settings, readings, motion, pulled cables."""
    folder = context.scratch / "commissioning"
    result = commission(CommissioningPlan(context.bench, context.bench_path, folder, None))
    drivers = {section.name: section.driver for section in context.bench.instruments.all()}
    for one in result["findings"]:
        name, figures = (
            one["instrument"],
            "; ".join(f"{f['what']} {f['value']:.4g} {f['unit']}" for f in one["figures"]),
        )
        words = f"{one['said']}" + (f" ({figures})" if figures else "")
        where = f"{name}, driver {drivers.get(name, 'unknown')}"
        yield Finding(
            one["state"] in _WELL, words, of=f"{name}, {one['check']}", where=where, expected=one["state"]
            if one["state"] in _WELL else "works",
        )  # fmt: skip
    if result["ended"]:
        yield Finding(False, result["ended"], of="the whole session", expected="goes to its end")


_FAULTS: Final = {
    FaultKind.SILENCE: "an instrument that does not answer",
    FaultKind.GARBLE: "replies of which every character is wrong",
    FaultKind.CUT: "replies that break off",
}


@check("faults on the wire", "6.4.4", "refused, with the instrument's name", place="drivers")
def wire_faults(context: Context) -> Iterator[Finding]:
    """Open each instrument with a wire that is silent, garbles or cuts every reply: it must be refused by name."""
    bench = context.bench
    wired = [section for section in bench.instruments.all() if isinstance(section, WiredForm)]
    for section in wired:
        for kind, words in _FAULTS.items():
            yield _with_fault(context, section.name, section.driver, kind, words)
    if not wired:
        yield Finding(True, "no instrument has a wire", expected="refused, with the instrument's name")


def _with_fault(context: Context, name: str, driver: str, kind: FaultKind, words: str) -> Finding:
    bench, of, where = context.bench, f"{name}, {words}", f"{name}, driver {driver}"
    with dry_bench(bench, simulated_truth(bench, None), 1) as assembly:
        if assembly.simulated is None:
            return Finding(False, "there is no simulated bench", of=of, where=where)
        try:
            assembly.simulated.arm(Fault(kind, probability=1.0, instrument=name))
        except ValueError as why:  # on a bus, the wire is the adapter's
            return Finding(True, f"does not apply: {why}", of=of)
        assembly.sessions[name].timeout_s = _PATIENCE_S
        instrument = next(one for one in assembly.instruments.all() if one.name == name)
        try:
            identity = instrument.open()
        except BenchError as refusal:
            named = refusal.instrument == name and bool(refusal.remedy)
            kindly = isinstance(refusal, InstrumentLost | InstrumentRefused) or named
            return Finding(named and kindly, str(refusal), of=of, where=where)
        finally:
            instrument.close()
        return Finding(False, f"was opened as {identity}", of=of, where=where)
