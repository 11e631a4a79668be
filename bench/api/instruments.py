"""Everything on a bench opened at once: what it is, whether it is well, what it reads."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, Protocol, runtime_checkable

from bench.assembly.served import real_bench
from bench.base.arrays import ARCSEC
from bench.devices.chambers import ChamberForm
from bench.devices.heads import HeadForm
from bench.devices.supplies import SupplyForm
from bench.files.bench.file import BenchFile
from bench.run.workbench import QUICK_NPLC
from drivers.angles import format_dms
from drivers.clock import Clock
from drivers.interfaces import (
    Answer,
    BenchError,
    Identity,
    Instrument,
    InstrumentLost,
    Level,
    NoAnswer,
    PowerSupply,
    Prompt,
    SelfTesting,
    ThermalChamber,
    Thermometer,
    Voltmeter,
    VoltmeterSettings,
)
from drivers.making_safe import let_go
from drivers.wire.haste import Haste
from drivers.wire.log import WireLog

_LONGEST_S: Final = 180.0
"""Every driver gives up by its own timeouts; one that does not is told of after this time."""

_BY_HAND: Final = "manual"
_NO_TEST: Final = "none"
_PASSED: Final = "passed"


@runtime_checkable
class _HasScale(Protocol):
    """A head that can be asked where it stands without being moved."""

    def position_rad(self) -> float:
        """Return the angle read back."""
        ...


class _Nobody:
    """A `Person` who is not asked: manual instruments are left alone."""

    def ask(self, prompt: Prompt) -> Answer:
        """Raise `NoAnswer`."""
        raise NoAnswer("operator", "nobody is asked here", "carry out a run to be asked")


@dataclass
class InstrumentLook:
    """What is known of one instrument; `failure` is the first thing that went wrong with it.

    `samples` is how many a voltmeter is asked for, `to_do` what a person must do where it was not left safe.
    """

    name: str
    address: str
    settings: str
    identity: Identity | None = None
    self_test: str = ""
    shows: str = ""
    value: dict[str, float] | float | None = None
    failure: BenchError | None = None
    samples: int = 1
    to_do: str = ""

    @property
    def test_failed(self) -> bool:
        """Whether the self-test found something."""
        return self.self_test not in ("", _NO_TEST, _BY_HAND, _PASSED)

    @property
    def failures(self) -> list[BenchError]:
        """All that is wrong, the self-test included."""
        found = [self.failure] if self.failure is not None else []
        if self.test_failed:
            remedy = "take the cables off its input and test again; if it fails again, have it serviced"
            found.append(BenchError(self.name, f"its self-test failed: {self.self_test}", remedy))
        if self.to_do:
            found.append(BenchError(self.name, "it was not left safe", self.to_do))
        return found

    @property
    def absent(self) -> bool:
        """Whether it could not be opened, or was lost while it was looked at."""
        return self.failure is not None and (
            self.identity is None or isinstance(self.failure, InstrumentLost)
        )

    def to_json(self) -> dict[str, Any]:
        """Return the row as JSON values; `value` in V by channel or output, rad, or °C."""
        return {
            "name": self.name,
            "address": self.address,
            "identity": None if self.identity is None else asdict(self.identity),
            "settings": self.settings,
            "self_test": self.self_test,
            "value": self.value,
            "shows": self.shows,
            "failures": [{"cause": f.cause, "remedy": f.remedy} for f in self.failures],
        }


def look_at(file: BenchFile, wire: WireLog | None, haste: Haste | None = None) -> list[InstrumentLook]:
    """Open, test, read and close every instrument of a bench at once; what goes wrong stands in its row.

    In `haste` those that do not answer are waited for no longer.
    """
    assembly = real_bench(file, _Nobody(), wire, haste)
    instruments = assembly.instruments.all()
    rows = [_row(file, instrument) for instrument in instruments]
    _look_at_all(instruments, rows, file.voltmeter_range_v, assembly.clock)
    return rows


def _row(file: BenchFile, instrument: Instrument) -> InstrumentLook:
    """Return the row of an instrument with what the bench file says of it."""
    section = next(section for section in file.instruments.all() if section.name == instrument.name)
    address = getattr(section, "resource", None)
    settings = ""
    if isinstance(section, HeadForm):
        settings = f"within {format_dms(section.tolerance)}"
    elif isinstance(section, ChamberForm):
        settings = f"{section.minimum:g} to {section.maximum:g} °C"
    elif isinstance(section, SupplyForm) and section.limits is not None:
        settings = f"outputs {', '.join(section.limits.outputs)}"
    where = "by hand" if address is None else str(address)
    return InstrumentLook(instrument.name, where, settings, samples=file.least_samples)


# --- looking ----------------------------------------------------------------------------------------


def _look_at_all(
    instruments: Sequence[Instrument], rows: Sequence[InstrumentLook], range_v: float, clock: Clock
) -> None:
    """Look at every instrument in a thread of its own, so that none waits for another."""
    threads = [
        threading.Thread(target=_look_at, args=(instrument, row, range_v), name=row.name, daemon=True)
        for instrument, row in zip(instruments, rows, strict=True)
    ]
    deadline_s = clock.now_s() + _LONGEST_S
    for thread in threads:
        thread.start()
    try:
        try:
            for thread, row in zip(threads, rows, strict=True):
                thread.join(max(0.0, deadline_s - clock.now_s()))
                if thread.is_alive():
                    row.failure = InstrumentLost(
                        row.name, f"did not come to an end within {_LONGEST_S:g} s", "switch it off and on"
                    )
        finally:
            for thread, instrument, row in zip(threads, instruments, rows, strict=True):
                if thread.is_alive():
                    row.to_do = let_go(instrument)
    except KeyboardInterrupt:
        if to_do := [f"{row.name} {row.to_do}" for row in rows if row.to_do]:
            raise BenchError(
                "instruments", "stopped, and not everything was left safe", "; ".join(to_do)
            ) from None
        raise


def _look_at(instrument: Instrument, row: InstrumentLook, range_v: float) -> None:
    """Open, test, read and close one instrument; whatever goes wrong stands in its row."""
    try:
        row.identity = instrument.open()
        if row.identity.maker == _BY_HAND:
            row.self_test = row.shows = _BY_HAND
            return
        row.self_test = _NO_TEST
        if isinstance(instrument, SelfTesting):
            row.self_test = ""
            row.self_test = instrument.self_test() or _PASSED
        _read(instrument, row, range_v)
    except BenchError as error:
        row.failure = error
    except Exception as error:  # one driver's mistake must not hide what the others show
        cause = f"the driver failed with {type(error).__name__} ({error})"
        row.failure = BenchError(row.name, cause, "repeat it with --wire-log FILE and report what that shows")
    finally:
        row.to_do = let_go(instrument)


def _read(instrument: Instrument, row: InstrumentLook, range_v: float) -> None:
    """Take one reading: a voltmeter's, the position of a head, a temperature, volts of a supply, a level's."""
    if isinstance(instrument, Voltmeter):
        instrument.configure(VoltmeterSettings(range_v, QUICK_NPLC, row.samples))
        row.settings = f"{range_v:g} V, {QUICK_NPLC:g} NPLC"
        instrument.start()
        row.value = {channel: samples[0] for channel, samples in instrument.fetch().items()}
        row.shows = ", ".join(f"{channel} {value:+.6f} V" for channel, value in row.value.items())
    elif isinstance(instrument, ThermalChamber):
        row.value = instrument.temperature("instruments")
        row.shows = f"{row.value:.1f} °C"
    elif isinstance(instrument, PowerSupply):
        states = instrument.state("instruments")
        row.value = {output: state.voltage_v for output, state in states.items()}
        row.shows = ", ".join(
            f"{output} {f'{state.voltage_v:.3f} V {state.current_a:.4f} A' if state.on else 'off'}"
            for output, state in states.items()
        )
    elif isinstance(instrument, Thermometer):
        row.value = instrument.block_c("instruments")
        row.shows = f"{row.value:.2f} °C, {instrument.sensor}"
    elif isinstance(instrument, Level):
        found = instrument.inclination("instruments", turned=False)
        row.value = {"along": found.along_rad, "across": found.across_rad}
        row.shows = ", ".join(f"{axis} {value / ARCSEC:+.1f} arcsec" for axis, value in row.value.items())
    elif isinstance(instrument, _HasScale):
        row.value = instrument.position_rad()
        row.shows = format_dms(row.value)
