"""A complete simulated bench: instruments on real wires, coupled by one world and one clock."""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

from drivers.interfaces import BenchError
from sim.scpi import ScpiInstrument
from sim.wires.faults import OF_INSTRUMENT, FaultyInstrument
from sim.wires.prologix import GpibAdapter
from sim.wires.server import TcpServer, TerminalServer
from sim.wires.session import ServedInstrument, Traffic
from sim.world.clock import VirtualClock

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Sequence
    from types import TracebackType

    from drivers.clock import Clock
    from drivers.interfaces import Channel
    from sim.wires.faults import Fault
    from sim.wires.session import Dialect
    from sim.world.world import World


@dataclass(frozen=True)
class SimulatedMeter:
    """A voltmeter to simulate: its constructor, the channels of the block at its inputs, its options.

    The constructor `make` is called with the wiring, the clock and the `options`. The wiring is the terminals of
    one channel or, for a meter with several inputs, a dict from input number to signal. For such a meter `inputs`
    maps channels to input numbers, and `probes` maps further input numbers to temperature sensors.
    """

    make: Callable[..., ScpiInstrument]
    inputs: Channel | Mapping[Channel, int]
    options: Mapping[str, Any] = field(default_factory=dict)
    probes: Mapping[int, Any] = field(default_factory=dict)

    def on(self, world: World, clock: Clock | None = None) -> ScpiInstrument:
        """Return the meter, wired to its channels of a world; `clock` defaults to the world's clock."""
        wiring: object
        if isinstance(self.inputs, str):
            wiring = world.terminals(self.inputs)
        else:
            wiring = {number: world.terminals(channel) for channel, number in self.inputs.items()} | dict(
                self.probes
            )
        return self.make(wiring, clock or world.clock, **self.options)


class Elsewhere:
    """The world of a thermometer that is not at the block: block and air have the thermometer's temperature.

    `at_c` returns this temperature, °C, at a time of the clock, s, or now for None.
    """

    def __init__(self, world: World, at_c: Callable[[float | None], float]) -> None:
        self._world = world
        self.block_c_at = at_c

    def __getattr__(self, name: str) -> Any:
        return getattr(self._world, name)

    @property
    def block_c(self) -> float:
        """The temperature now, °C."""
        return self.block_c_at(None)

    chamber_c = block_c


class SimulatedBench:
    """A context manager that serves the instruments of a world.

    `instruments` maps each name on the bench to a meter or to another dialect on the world; a dialect may
    state its `model`. Each instrument gets a TCP port on `host`: any free port, or consecutive ports from
    `first_port`. It also gets a pseudo-terminal if `with_terminals` is True or contains its name. `buses`
    puts instruments on the GPIB bus of an adapter, `{"adapter": {"voltmeter.x": 22, …}}`; they share the
    adapter's port. `adapter_options` are options of each `GpibAdapter`. The `faults` are armed as by `arm`.

    These map names: `dialects` to instruments, `faulty` to `FaultyInstrument`s, `resources` to addresses for
    a driver, `wired` to `ServedInstrument`s, `servers` to TCP servers and `terminals` to pseudo-terminals.
    The last three are the adapter's for an instrument on its bus. In the context, a virtual clock advances
    only after all commands on the wires are carried out.
    """

    def __init__(
        self,
        world: World,
        instruments: Mapping[str, Dialect | SimulatedMeter],
        *,
        host: str = "127.0.0.1",
        first_port: int = 0,
        with_terminals: bool | Collection[str] = False,
        buses: Mapping[str, Mapping[str, int]] | None = None,
        adapter_options: Mapping[str, Any] | None = None,
        faults: Sequence[Fault] = (),
    ) -> None:
        """Prepare the instruments and arm the faults.

        Raises the `ValueError` of `arm`, and `ValueError` for an instrument on a bus that does not use SCPI.
        """
        self.world = world
        self._of_adapter = dict(adapter_options or {})
        self.traffic = Traffic()
        self.dialects: dict[str, Dialect] = {}
        self.faulty: dict[str, FaultyInstrument] = {}
        self._on_bus: dict[str, tuple[str, int]] = {
            name: (adapter, address)
            for adapter, members in (buses or {}).items()
            for name, address in members.items()
        }
        for adapter, members in (buses or {}).items():
            self._attach(adapter, {name: instruments[name] for name in members})
        for name, given in instruments.items():
            if name not in self._on_bus:
                made = given.on(world) if isinstance(given, SimulatedMeter) else given
                self._add(name, made)
        ported = [name for name in self.dialects if name not in self._on_bus]
        wired = {
            name: ServedInstrument(self.faulty[name], self.traffic, self.faulty[name].wire_fault)
            for name in ported
        }
        servers = {
            name: TcpServer(wired[name], host=host, port=first_port + number if first_port else 0)
            for number, name in enumerate(ported)
        }
        with_one = ported if with_terminals is True else with_terminals or ()
        terminals = {name: TerminalServer(wired[name]) for name in ported if name in with_one}
        self.wired = wired | {name: wired[adapter] for name, (adapter, _) in self._on_bus.items()}
        self.servers = servers | {name: servers[adapter] for name, (adapter, _) in self._on_bus.items()}
        self.terminals = terminals | {
            name: terminals[adapter] for name, (adapter, _) in self._on_bus.items() if adapter in terminals
        }
        self._started: dict[str, tuple[TcpServer, TerminalServer | None]] = {
            name: (server, terminals.get(name)) for name, server in servers.items()
        }
        for fault in faults:
            self.arm(fault)
        self._stack = ExitStack()

    def _add(self, name: str, dialect: Dialect) -> FaultyInstrument:
        self.dialects[name] = dialect
        self.faulty[name] = FaultyInstrument(dialect, name, self.world.settings.seed)
        return self.faulty[name]

    def _attach(self, adapter: str, members: Mapping[str, Dialect | SimulatedMeter]) -> None:
        """Put instruments on the bus of an adapter; a meter uses the clock that the adapter provides."""
        bus = GpibAdapter(self.world.clock, **self._of_adapter)
        self._add(adapter, bus)
        for name, given in members.items():
            if isinstance(given, SimulatedMeter):
                make: Callable[[Clock], ScpiInstrument] = partial(given.on, self.world)
            elif isinstance(given, ScpiInstrument):
                make = partial(_as_it_is, given)
            else:
                raise ValueError(
                    f"{name} does not speak SCPI and cannot be on a GPIB bus; give it a resource without adapter"
                )
            address = self._on_bus[name][1]
            bus.let_through(address, self._add(name, bus.attach(address, make)))

    def __enter__(self) -> SimulatedBench:
        """Start all servers, or none: raise `BenchError` if a port or a pseudo-terminal is not available."""
        with ExitStack() as stack:
            for name, (server, _) in self._started.items():
                with taken_port(name, server):
                    stack.enter_context(server)
            for name, (_, terminal) in self._started.items():
                if terminal is None:
                    continue
                try:
                    stack.enter_context(terminal)
                except OSError as error:
                    cause = f"the system gives no pseudo-terminal ({error.strerror})"
                    remedy = (
                        "end programs that hold pseudo-terminals ('bench simulate' needs none with --no-pty)"
                    )
                    raise BenchError(name, cause, remedy) from error
            clock = self.world.clock
            if isinstance(clock, VirtualClock):
                clock.before_advance = self.traffic.settle
                stack.callback(setattr, clock, "before_advance", None)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Within this context, reading instruments leaves the world unchanged; see `World.aside`."""
        with self.world.aside():
            yield
            self.traffic.settle()
        for dialect in self.dialects.values():
            if isinstance(dialect, GpibAdapter):
                dialect.return_to_present()

    @property
    def resources(self) -> dict[str, str]:
        """The resource by name, "TCPIP0::127.0.0.1::40123::SOCKET"; on a bus "prologix://127.0.0.1:40123/22"."""
        return {name: self._resource(name) for name in self.dialects}

    def _resource(self, name: str) -> str:
        server = self.servers[name]
        if name in self._on_bus:
            return f"prologix://{server.address}/{self._on_bus[name][1]}"
        return server.resource

    def addresses(self) -> list[dict[str, str | None]]:
        """Return the name, model, TCP address ("tcp") and pseudo-terminal ("pty", or None) of each instrument.

        An instrument on a GPIB bus has the adapter's "tcp" and "pty", and its bus address as "gpib".
        """
        return [
            {
                "name": name,
                "model": str(getattr(dialect, "model", type(dialect).__name__)),
                "tcp": self.servers[name].address,
                "pty": self.terminals[name].path if name in self.terminals else None,
            }
            | ({"gpib": str(self._on_bus[name][1])} if name in self._on_bus else {})
            for name, dialect in self.dialects.items()
        ]

    def failure(self) -> BenchError | None:
        """Return the mistake of a simulation that ended a connection, if there was one."""
        return next((faulty.failure for faulty in self.faulty.values() if faulty.failure is not None), None)

    def arm(self, fault: Fault) -> None:
        """Arm a fault for the instrument that it names, or for every instrument that can have it.

        Raises `ValueError` if the instrument is unknown or cannot have the fault, or if no instrument can.
        """
        if not fault.instrument:
            able = [name for name, faulty in self.faulty.items() if faulty.can_have(fault.kind)]
            able = [name for name in able if not self._is_of_another_wire(name, fault)]
            if not able:
                raise ValueError(
                    f"no instrument of this bench can have the fault '{fault.kind}'; choose another fault"
                )
        elif fault.instrument not in self.faulty:
            raise ValueError(
                f"no instrument {fault.instrument} is served; choose from {', '.join(self.faulty)}"
            )
        elif self._is_of_another_wire(fault.instrument, fault):
            adapter = self._on_bus[fault.instrument][0]
            raise ValueError(
                f"{fault.instrument} has no wire of its own; give the fault '{fault.kind}' to its {adapter}"
            )
        else:
            able = [fault.instrument]
        for name in able:
            self.faulty[name].add(fault)

    def _is_of_another_wire(self, name: str, fault: Fault) -> bool:
        """Whether this is a wire fault, and the instrument is on a bus and so has no wire of its own."""
        return name in self._on_bus and fault.kind not in OF_INSTRUMENT


def _as_it_is(instrument: ScpiInstrument, clock: Clock) -> ScpiInstrument:
    """Return the instrument unchanged; `clock` is not used, because its commands take no time."""
    return instrument


@contextmanager
def taken_port(name: str, server: TcpServer) -> Iterator[None]:
    """Within this context, raise `BenchError` for the `OSError` or `OverflowError` of opening a port."""
    try:
        yield
    except OverflowError as error:
        cause = f"there is no port {server.port}"
        raise BenchError(name, cause, "choose ports between 1 and 65535") from error
    except OSError as error:
        reason = os.strerror(error.errno).lower() if error.errno and error.errno > 0 else str(error)
        cause = f"port {server.port} of {server.host} cannot be served ({reason})"
        remedy = "end the program that has it, or choose another"
        if isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
            remedy = "listen on an address of this computer, such as 127.0.0.1"
        elif error.errno == errno.EACCES:
            remedy = "choose a port of 1024 or above"
        raise BenchError(name, cause, remedy) from error
