"""The SCPI engine, apart from any instrument that measures."""

import pytest

from sim.scpi import Command, ScpiInstrument
from sim.scpi_values import Boolean, Choice, Number, ScpiError, Text, notation_pattern
from tests.support.simulated_stand import tell


class Toy(ScpiInstrument):
    """Remembers one level, one mode, one label; enough to try every kind of parameter."""

    def __init__(self) -> None:
        super().__init__("MAKER,TOY,0,1")
        self.level = 0.0
        self.mode = "FAST"
        self.on = "0"
        self.label = ""
        self.add(
            [
                Command("[SENSe:]LEVel[:DC]:VALue", self._set_level, (Number("V", ("MIN", "MAX", "DEF")),)),
                Command("[SENSe:]LEVel[:DC]:VALue?", lambda: f"{self.level:+.6E}"),
                Command("[SENSe:]LEVel[:DC]:MODE", self._set_mode, (Choice(("FAST", "SLOWer")),)),
                Command("[SENSe:]LEVel[:DC]:MODE?", lambda: self.mode),
                Command("OUTPut:STATe", self._set_on, (Boolean(),)),
                Command("OUTPut:STATe?", lambda: self.on),
                Command("OUTPut:COUNt", lambda value: None, (Number(words=()),)),
                Command("OUTPut:LOAD", self._set_level, (Number("OHM"),)),
                Command("DISPlay:TEXT", self._set_label, (Text(),)),
                Command("DISPlay:TEXT?", lambda: self.label),
                Command("FAIL", self._fail),
            ]
        )

    def _set_level(self, value: float | str) -> None:
        self.level = {"MIN": -1.0, "MAX": 1.0, "DEF": 0.5}[value] if isinstance(value, str) else value

    def _set_mode(self, mode: str) -> None:
        self.mode = mode

    def _set_on(self, flag: str) -> None:
        self.on = flag

    def _set_label(self, text: str) -> None:
        self.label = text

    def _fail(self) -> None:
        raise ScpiError(-221)


@pytest.fixture
def toy() -> Toy:
    return Toy()


def error(toy: Toy) -> int:
    reply = tell(toy, "SYST:ERR?")
    assert reply is not None
    return int(reply.split(",")[0])


@pytest.mark.parametrize(
    "header",
    [
        "SENS:LEV:DC:VAL", "SENSE:LEVEL:DC:VALUE", "sens:level:dc:val", ":SENS:LEV:VAL", "LEV:VAL",
        "LEVEL:DC:VALUE", "lEv:VaL", ":level:value",
    ],
)  # fmt: skip
def test_every_legal_spelling_of_a_header_is_understood(toy: Toy, header: str) -> None:
    tell(toy, f"{header} 2.5")
    assert error(toy) == 0
    assert toy.level == 2.5


@pytest.mark.parametrize(
    ("message", "number"),
    [
        ("LEVE:VAL 1", -113),  # neither the short nor the long form
        ("LEV:DC 1", -113),
        ("SENS:VAL 1", -113),
        ("FAIL?", -113),
        ("*IDN", -113),
        ("LEV:VAL", -109),
        ("LEV:VAL 1,2", -108),
        ("FAIL 1", -108),
        ("LEV:VAL 1 A", -131),
        ("OUTP:COUN 3 V", -138),
        ("LEV:VAL 1x2", -121),
        ("LEV:VAL 1e99999", -123),
        ("LEV:VAL " + "1" * 300, -124),
        ("LEV:VAL 1E999", -123),
        ("LEV:VAL LOUD", -148),
        ('LEV:VAL "1"', -158),
        ("LEV:MODE MEDIUM", -224),
        ("LEV:MODE 3", -104),
        ('LEV:MODE "FAST"', -158),
        ("DISP:TEXT HELLO", -148),
        ("DISP:TEXT 12", -104),
        ('DISP:TEXT "open', -151),
        ("LEV:VALUEVALUEVALUE 1", -112),
        ("LEV$VAL 1", -101),
        ("LEV,VAL 1", -103),
        ("LEV::VAL 1", -102),
        ("LEV:VAL \u00b5", -101),
        ("FAIL", -221),
        ("*ESE 8", -113),
    ],
)
def test_each_mistake_has_its_number(toy: Toy, message: str, number: int) -> None:
    assert toy.handle(message.encode("latin-1")) is None
    assert error(toy) == number
    assert error(toy) == 0


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("2", 2.0), ("-2.5e-1", -0.25), (".5", 0.5), ("+3.", 3.0), ("1 V", 1.0), ("5mV", 5e-3),
        ("5 MV", 5e-3),
        ("7uV", 7e-6), ("2 kV", 2e3), ("2K", 2e3), ("2MAV", 2e6), ("3 U", 3e-6), ("3m", 3e-3), ("#H1F", 31.0),
        ("#b101", 5.0), ("#Q17", 15.0), ("MIN", -1.0), ("maximum", 1.0), ("Def", 0.5),
    ],
)  # fmt: skip
def test_numbers_suffixes_and_words(toy: Toy, text: str, value: float) -> None:
    tell(toy, f"LEV:VAL {text}")
    assert error(toy) == 0
    assert toy.level == pytest.approx(value, rel=1e-12)


def test_m_is_mega_before_ohm_and_milli_elsewhere(toy: Toy) -> None:
    tell(toy, "OUTP:LOAD 2 MOHM")
    assert toy.level == 2e6
    tell(toy, "LEV:VAL 2 MV")
    assert toy.level == 2e-3


@pytest.mark.parametrize(
    ("text", "flag"), [("ON", "1"), ("off", "0"), ("1", "1"), ("0", "0"), ("0.4", "0"), ("-7", "1")]
)
def test_booleans(toy: Toy, text: str, flag: str) -> None:
    toy.on = "?"
    tell(toy, f"OUTP:STAT {text}")
    assert tell(toy, "OUTP:STAT?") == flag


@pytest.mark.parametrize(
    ("sent", "text"),
    [('"it"', "it"), ("'it'", "it"), ('"a""b"', 'a"b'), ("'a''b'", "a'b"), ("'a;b,c'", "a;b,c"), ('""', "")],
)
def test_strings_in_both_quotes(toy: Toy, sent: str, text: str) -> None:
    tell(toy, f"DISP:TEXT {sent};TEXT?")
    assert toy.label == text
    assert error(toy) == 0


def test_compound_stays_in_the_subsystem_and_joins_replies(toy: Toy) -> None:
    assert tell(toy, "SENS:LEV:VAL 2;MODE SLOW;VAL?;*IDN?;MODE?") == "+2.000000E+00;MAKER,TOY,0,1;SLOW"
    assert tell(toy, "LEV:VAL?;:OUTP:STAT?;:LEV:MODE?") == "+2.000000E+00;0;SLOW"
    assert error(toy) == 0


def test_compound_without_a_colon_does_not_leave_the_subsystem(toy: Toy) -> None:
    assert tell(toy, "LEV:VAL?;OUTP:STAT?") == "+0.000000E+00"
    assert error(toy) == -113


def test_the_path_starts_anew_with_each_message(toy: Toy) -> None:
    tell(toy, "LEV:VAL 1")
    tell(toy, "MODE SLOW")
    assert error(toy) == -113


def test_a_form_mistake_drops_the_rest_of_the_line_an_execution_error_does_not(toy: Toy) -> None:
    assert tell(toy, "NONSENSE;*IDN?") is None
    assert tell(toy, "FAIL;*IDN?") == "MAKER,TOY,0,1"
    assert [error(toy), error(toy), error(toy)] == [-113, -221, 0]


def test_empty_messages_and_stray_separators_are_nothing(toy: Toy) -> None:
    assert tell(toy, "") is None
    assert tell(toy, " ; ;") is None
    assert tell(toy, "*CLS;") is None
    assert error(toy) == 0


def test_error_queue_is_first_in_first_out_and_twenty_deep(toy: Toy) -> None:
    for _ in range(10):
        tell(toy, "NONSENSE")
        tell(toy, "FAIL")
    for _ in range(5):
        tell(toy, "LEV:VAL 1,2")
    numbers = [error(toy) for _ in range(21)]
    assert numbers[:4] == [-113, -221, -113, -221]
    assert numbers[18:] == [-113, -350, 0]


def test_cls_empties_queue_and_events(toy: Toy) -> None:
    tell(toy, "NONSENSE")
    tell(toy, "*CLS")
    assert tell(toy, "*ESR?;SYST:ERR?") == '+0;+0,"No error"'


def test_event_register_has_a_bit_for_each_class_and_is_cleared_by_reading(toy: Toy) -> None:
    assert tell(toy, "*ESR?") == "+128"  # power on
    tell(toy, "NONSENSE")
    tell(toy, "FAIL")
    assert tell(toy, "*ESR?") == "+48"
    assert tell(toy, "*ESR?") == "+0"
    toy.power_cycle()
    assert tell(toy, "*ESR?") == "+128"


def test_notation_with_unpaired_brackets_is_refused() -> None:
    with pytest.raises(ValueError, match="brackets"):
        notation_pattern("[SENSe:VOLTage")
