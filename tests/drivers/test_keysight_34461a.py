"""The Truevolt driver against the manual's text, as pairs of (sent, answered)."""

import pytest

from drivers.instruments.keysight_34461a import Keysight34461A
from drivers.interfaces import Identity, LimitExceeded, Voltmeter, VoltmeterSettings
from tests.support.scripted_session import Pairs, ScriptedSession

IDENTITY = "Keysight Technologies,34461A,MY53200001,A.02.17-02.40-02.17-00.52-04-01"


def exchange(autozero: str, impedance: str, samples: int = 2) -> Pairs:
    return [
        ("CONF:VOLT:DC 10", None),
        ("FUNC?", '"VOLT"'),
        ("VOLT:DC:RANG?", "+1.00000000E+01"),
        ("VOLT:DC:RANG:AUTO?", "0"),
        ("VOLT:DC:NPLC 100", None),
        ("VOLT:DC:NPLC?", "+1.00000000E+02"),
        (f"{autozero} ON", None),
        (f"{autozero}?", "1"),
        (f"{impedance} ON", None),
        (f"{impedance}?", "1"),
        ("TRIG:SOUR IMM", None),
        ("TRIG:SOUR?", "IMM"),
        ("TRIG:COUN 1", None),
        ("TRIG:COUN?", "+1"),
        (f"SAMP:COUN {samples}", None),
        ("SAMP:COUN?", f"+{samples}"),
        ("SYST:ERR?", '+0,"No error"'),
        ("INIT", None),
        ("FETC?", ",".join(["+6.27530000E-01"] * samples)),
        ("*ESR?", "+0"),
        ("FUNC?", '"VOLT"'),
        ("VOLT:DC:RANG?", "+1.00000000E+01"),
        ("VOLT:DC:NPLC?", "+1.00000000E+02"),
    ]


def meter(script: ScriptedSession) -> Keysight34461A:
    return Keysight34461A("voltmeter.x", "x", script, script.clock)  # type: ignore[arg-type]


def whole_reading(identity: str, *pairs: tuple[str, str | None], samples: int = 2) -> Identity:
    script = ScriptedSession([("*IDN?", identity), ("*CLS", None)], pairs)
    m = meter(script)
    assert isinstance(m, Voltmeter)
    known = m.open()
    m.configure(VoltmeterSettings(10.0, 100.0, samples))
    m.start()
    assert m.fetch() == {"x": (0.62753,) * samples}
    assert script.left == []
    return known


def test_in_its_own_identity_autozero_and_impedance_stand_under_the_function() -> None:
    known = whole_reading(IDENTITY, *exchange("VOLT:DC:ZERO:AUTO", "VOLT:DC:IMP:AUTO"))
    assert known == Identity(
        "Keysight Technologies", "34461A", "MY53200001", "A.02.17-02.40-02.17-00.52-04-01"
    )


def test_emulating_a_34401a_it_is_spoken_to_as_one() -> None:
    known = whole_reading(
        "HEWLETT-PACKARD,34401A,MY53000001,01.05-11-5-2", *exchange("ZERO:AUTO", "INP:IMP:AUTO")
    )
    assert (known.model, known.serial) == ("34401A", "MY53000001")


@pytest.mark.parametrize("model", ["34460A", "34465A", "34470A"])
def test_its_relatives_are_taken(model: str) -> None:
    known = whole_reading(
        IDENTITY.replace("34461A", model), *exchange("VOLT:DC:ZERO:AUTO", "VOLT:DC:IMP:AUTO")
    )
    assert known.model == model


def test_more_samples_than_a_34401a_holds() -> None:
    whole_reading(IDENTITY, *exchange("VOLT:DC:ZERO:AUTO", "VOLT:DC:IMP:AUTO", 10_000), samples=10_000)


@pytest.mark.parametrize(
    ("identity", "most"),
    [
        (IDENTITY, 10_000),
        (IDENTITY.replace("34461A", "34460A"), 1_000),
        ("HEWLETT-PACKARD,34401A,0,11-5-2", 512),
    ],
)
def test_the_memory_is_that_of_the_model_that_answered(identity: str, most: int) -> None:
    m = meter(ScriptedSession([("*IDN?", identity), ("*CLS", None)]))
    m.open()
    with pytest.raises(LimitExceeded, match=f"memory holds 1 to {most}"):
        m.configure(VoltmeterSettings(10.0, 10.0, most + 1))
