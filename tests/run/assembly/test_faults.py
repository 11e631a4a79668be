"""Faults that a bench file states: taken as the simulation takes them, and struck where they are to strike."""

import numpy as np
import pytest
from pydantic import ValidationError

from bench.config.bench_file.sections import FaultSection, FaultWord
from drivers.interfaces import BadReading, BenchError, InstrumentRefused
from sim.wires.faults import Fault, FaultKind
from tests.support.composed_bench import composing, read


@pytest.fixture
def composed(tmp_path):
    with composing(tmp_path) as compose:
        yield compose


def faults(*written):
    """Return the change of a bench file's text that adds faults; the file has no simulation yet."""
    return "verification:\n", f"simulation: {{faults: [{', '.join(written)}]}}\nverification:\n"


def test_the_kinds_of_faults_are_those_of_the_simulation():
    assert set(FaultWord.__args__) == {kind.value for kind in FaultKind}


@pytest.mark.parametrize(
    "data",
    [
        {"fault": "cut", "probability": "0.01"},
        {"fault": "drop", "at": "17", "instrument": "voltmeter.y"},
        {"fault": "late", "matching": "READ?", "seconds": "2"},
        {"fault": "error", "at": "3", "error": "-113"},
        {"fault": "hang", "at": "1"},
        {"fault": "cut"},
        {"fault": "cut", "at": "0"},
        {"fault": "cut", "at": "1.5"},
        {"fault": "cut", "at": "1", "probability": "0.1"},
        {"fault": "cut", "probability": "1.1"},
        {"fault": "cut", "probability": "nan"},
        {"fault": "cut", "at": "1", "seconds": "1"},
        {"fault": "late", "at": "1"},
        {"fault": "late", "at": "1", "seconds": "-1"},
        {"fault": "silence", "at": "1", "error": "-113"},
        {"fault": "sulk", "at": "1"},
        {"fault": "cut", "when": "1"},
    ],
)
def test_a_bench_file_takes_the_faults_that_the_simulation_takes(data):
    try:
        fault = Fault.parse(data)
    except ValueError:
        with pytest.raises(ValidationError):
            FaultSection.model_validate(data)
    else:
        assert Fault.parse(FaultSection.model_validate(data).model_dump(exclude_none=True)) == fault


@pytest.mark.parametrize(
    ("bench", "fault", "error", "told"),
    [
        ("bench-lan", 'fault: garble, matching: "FETC?"', BadReading, r": the reply to FETC\?"),
        ("bench-prologix", "fault: error, matching: INIT, error: -213", InstrumentRefused, ".*-213"),
    ],
)
def test_a_fault_strikes_the_meter_that_it_names_behind_an_adapter_too(composed, bench, fault, error, told):
    _, assembly = composed(bench, faults(f"{{{fault}, instrument: voltmeter.y, at: 2}}"))
    assembly.instruments.open()
    read(assembly.instruments)
    with pytest.raises(error, match=rf"voltmeter\.y{told}"):
        read(assembly.instruments)


@pytest.mark.parametrize(
    ("name", "fault", "says"),
    [
        (
            "bench-prologix",
            "{fault: cut, instrument: voltmeter.y, at: 1}",
            "voltmeter.y has no wire of its own; give the fault 'cut' to its adapter",
        ),
        (
            "bench-rate-table",
            "{fault: overload, instrument: chamber, at: 1}",
            "chamber has no input to overload; correct the faults in the bench file",
        ),
    ],
)
def test_a_fault_that_cannot_be_is_one_sentence(composed, name, fault, says):
    with pytest.raises(BenchError) as error:
        composed(name, faults(fault))
    assert str(error.value) == f"simulation: {says}"


def test_a_dropped_adapter_is_told_and_found_again(composed):
    _, assembly = composed(
        "bench-prologix", faults('{fault: drop, instrument: adapter, matching: "++read", at: 9}')
    )

    def open_often():
        for _ in range(9):
            assembly.instruments.open()

    with pytest.raises(BenchError, match="broke the connection"):
        open_often()
    assembly.instruments.open()
    assert np.abs(read(assembly.instruments)).max() > 2.0
