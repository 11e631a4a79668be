"""Whatever a client sends, the simulated instruments live on; the text is of what they understand."""

import random
import re
from collections.abc import Callable

import pytest

from sim.acutrol import AcutrolTable
from sim.agilent_34401a import Agilent34401A
from sim.chambers import EspecP300, Thermotron8800, WatlowF4T
from sim.counters import EncoderLine, HeidenhainNd28x, LineThermometer, MitutoyoMux10
from sim.keithley_2000 import Keithley2000
from sim.keysight_34461a import Keysight34461A
from sim.keysight_34970a import Keysight34970A
from sim.newport_esp301 import Esp301
from sim.scpi import never
from sim.wires.session import Dialect
from sim.world.world import World
from sim.zaber import ZaberStage
from tests.support.simulated_stand import a_world, tell

HEADS_AND_CHAMBERS = """\
/1 1 07 get set move abs rel home stop warnings clear pos maxspeed comm.checksum 384000 -1 :4F :
:mode:position :mode:rate :demand:rate :demand:position :read:position 1, 045.000 nan inf 1e999
TEMP? TEMP, S25.0 H L-45 MODE, CONSTANT RUN3 MON? *IDN? SETP1, RUNM PVAR1? STOP
:SOURCE:CLOOP1:SPOINT :UNIT:TEMPERATURE? F ? ; , \x00 \xe9 \xb2"""
COUNTERS = (
    "\x1bA0000 \x1bA0100 \x1bA0200 \x1bA0400 \x1bA0800 \x1bA0900 \x02 \x05 \x1bS0000 1 2 POS? ? \x00 \xe9"
)
NEWPORT = "1 2 PA PR TP MD MO MF ST VA SN OR TB? TE? *IDN? ? ; , -5 45.0 nan inf 1e9 \x00 \xe9"
SCPI = """\
CONF VOLT : ; ? , DC RANG NPLC AUTO SAMP:COUN TRIG:SOUR BUS IMM INIT :INIT :ABOR READ? FETC? *TRG *WAI *RST 2 10
1024 -1 -1E 0.02 1e999 MIN MAX INF ' " #H :TRAC:DATA? :TRAC:POIN :TRAC:FEED:CONT NEXT NEV ON OFF 'VOLT \x00 \xe9"""
KINDS: dict[str, tuple[Callable[[World], Dialect], str]] = {
    "zaber": (lambda world: ZaberStage(world, steps_per_degree=1000.0), HEADS_AND_CHAMBERS),
    "acutrol": (AcutrolTable, HEADS_AND_CHAMBERS),
    "esp301": (Esp301, NEWPORT),
    "nd 28x": (HeidenhainNd28x, COUNTERS),
    "mux-10": (MitutoyoMux10, COUNTERS),
    "line": (
        lambda world: EncoderLine(
            world,
            request="POS?",
            pattern=r"(?P<angle>[+-]\d+)",
            example="+1",
            per_turn=4096.0,
            ends=("\r", "\n"),
        ),
        COUNTERS,
    ),
    "line thermometer": (
        lambda world: LineThermometer(
            world, request="2", pattern=r"(?P<temperature>\d+)", example="1", ends=("\r", "\n")
        ),
        COUNTERS,
    ),
    "espec": (EspecP300, HEADS_AND_CHAMBERS),
    "f4t": (WatlowF4T, HEADS_AND_CHAMBERS),
    "thermotron": (Thermotron8800, HEADS_AND_CHAMBERS),
    "34401a": (lambda world: Agilent34401A(world.terminals("x"), world.clock), SCPI),
    "2000": (lambda world: Keithley2000(world.terminals("x"), world.clock), SCPI),
    "34461a": (lambda world: Keysight34461A(world.terminals("x"), world.clock), SCPI),
    "34970a": (
        lambda world: Keysight34970A({k: world.terminals("x") for k in (101, 102, 103)}, world.clock),
        SCPI + " ROUT:SCAN ROUT:CHAN:DEL (@101,102) (@101:1e9) (@ R? #H1F",
    ),
}
METERS = (Agilent34401A, Keithley2000, Keysight34461A, Keysight34970A)
NEVER = (
    "VOLT:DC:RANG kaputt", "NONSENSE:HEADER 1", "VOLT:DC:NPLC ,", "*IDN", "SAMP:COUN -1", "*SRE 999",
    "READ? (((", "VOLT:DC:RANG 1e999",
)  # fmt: skip
"""Messages that each voltmeter must refuse."""


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_that_is_sent_breaks_it(kind: str) -> None:
    """Seed 20261121: 2000 messages of up to six words, with and without blanks, now and then endless."""
    world = a_world()
    make, text = KINDS[kind]
    dialect, words = make(world), text.split()
    generator = random.Random(20261121)  # noqa: S311
    for _ in range(2000):
        parts = [generator.choice(words) for _ in range(generator.randint(0, 6))]
        message = generator.choice(("", " ")).join(parts).encode("latin-1")
        reply = dialect.handle(message + b"9" * generator.choice((0, 0, 5000)), never)
        assert reply is None or reply.isascii()
        assert reply is None or not isinstance(dialect, METERS) or reply.strip().decode().isprintable()
        world.clock.sleep(generator.choice((0.0, 0.3, 2.0)))
    assert abs(world.scale_angle_rad) < 1e6
    assert -80.0 < world.chamber_c < 200.0
    if isinstance(dialect, METERS):
        dialect.device_clear()
        assert tell(dialect, "*RST;*CLS;*IDN?") == dialect.identity
        for message in NEVER:
            tell(dialect, "*RST;*CLS")
            tell(dialect, message)
            assert not re.match(r"[+]?0,", str(tell(dialect, "SYST:ERR?"))), message
