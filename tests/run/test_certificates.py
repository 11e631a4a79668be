"""Certificates as a run begins: the serial numbers that answered are asked about, and what is said is recorded."""

from drivers.interfaces import Identity
from tests.support.runner_bench import Bench, make_runner, new_record, recorded


def test_what_is_to_be_said_of_certificates_is_recorded_before_the_first_step(tmp_path):
    asked = []

    def said(serials):
        asked.append(dict(serials))
        return ["the certificate of x is of MY1, but MY2 answered"]

    runner = make_runner(Bench(), new_record(tmp_path), certificates=said)
    meter = runner.bench.instruments.voltmeters[0]
    meter.open = lambda: Identity("K", "34461A", "MY2")
    runner.run()
    serials = {"voltmeter.x": "MY2", "voltmeter.y": "", "voltmeter.z": "", "head": ""}
    assert asked == [serials]
    history, _, _ = recorded(tmp_path / "run")
    first, second, third = list(history.events)[:3]
    assert (first.type, second.type, third.type) == ("run_started", "certificate", "step_started")
    assert second.data["words"] == "the certificate of x is of MY1, but MY2 answered"
    assert history.serials == serials
    assert history.state == "finished"


def test_without_certificates_a_record_is_as_it_was(tmp_path):
    make_runner(Bench(), new_record(tmp_path)).run()
    history, _, _ = recorded(tmp_path / "run")
    assert set(next(iter(history.events)).data) == {"step", "instruments"}
    assert history.serials == {}
