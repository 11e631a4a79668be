"""Instruments in date: with an expired certificate a real run is refused, asked about or begun."""

import sys
from dataclasses import dataclass
from datetime import UTC, datetime

import pytest

from bench.config.bench_file.file import load_bench
from bench.run.events import RunState
from bench.run.folder import Run
from bench.services import validated
from bench.services.errors import Refused
from bench.services.execution import new_run
from bench.services.requests.measuring import RunRequest
from bench.services.validated import agree_to_expired, refuse_unfit, reminders
from drivers.interfaces import BenchError
from drivers.person import Answer
from tests.support.certified_bench import meter_certificate, write_bench
from tests.support.commands import printed, refused


@pytest.fixture
def today(monkeypatch, empty_folder):
    monkeypatch.delenv("BENCH_LABORATORY", raising=False)
    monkeypatch.setattr(validated, "utc_now", lambda: datetime(2026, 11, 24, tzinfo=UTC))


def bench_of(folder, policy, until="2026-10-01"):
    return write_bench(folder, {"x": meter_certificate(valid_until=until)}, expired=policy)


@dataclass
class Says:
    """A person with one answer to everything."""

    answer: str
    asked: str = ""

    def ask(self, prompt):
        self.asked = prompt.text
        return Answer(prompt.id, self.answer)


@pytest.mark.parametrize(
    ("policy", "terminal", "away", "words"),
    [
        ("refuse", True, True, "refuses such runs"),
        ("ask", False, False, "there is no terminal"),
        ("ask", True, False, ""),
        ("ask", False, True, ""),
        ("say", False, False, ""),
    ],
)
def test_an_expired_certificate_is_treated_as_the_file_says(
    tmp_path, monkeypatch, today, policy, terminal, away, words
):
    file = bench_of(tmp_path, policy)
    monkeypatch.setattr(sys.stdin, "isatty", lambda: terminal, raising=False)
    if not words:
        refuse_unfit(load_bench(file), file, RunRequest("quick"), away=away)
        return
    with pytest.raises(Refused, match=words) as refusal:
        refuse_unfit(load_bench(file), file, RunRequest("quick"), away=away)
    assert "voltmeter.x" in str(refusal.value)
    assert ("expired: ask" in str(refusal.value)) == (policy == "refuse")
    assert ("--answers folder" in refusal.value.typed) == (policy == "ask")
    assert "expired on 2026-10-01" in str(refusal.value)


def test_certificates_in_date_refuse_nothing(tmp_path, today):
    file = bench_of(tmp_path, "refuse", "2026-11-24")
    refuse_unfit(load_bench(file), file, RunRequest("quick"), away=False)


def begun(tmp_path, monkeypatch):
    """A real run that has not begun, and its record."""
    file = bench_of(tmp_path, "ask")
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True, raising=False)
    new = new_run(RunRequest("quick", str(file), name="run", runs=tmp_path / "runs"))
    return Run(new.folder), new.record()


def test_a_yes_goes_on_and_a_no_ends_the_run_for_good(tmp_path, monkeypatch, today):
    run, record = begun(tmp_path, monkeypatch)
    person = Says("yes")
    agree_to_expired(run, record, person)
    assert "expired on 2026-10-01. Measure nevertheless?" in person.asked
    with pytest.raises(BenchError, match="answered no"):
        agree_to_expired(run, record, Says("no"))
    assert Run(run.folder).history.state is RunState.ABORTED


def test_reminders_begin_thirty_days_before(tmp_path, today):
    for until, count in {"2026-12-25": 0, "2026-12-24": 1, "2026-11-24": 1, "2026-11-23": 0}.items():
        found = list(reminders(load_bench(bench_of(tmp_path, "ask", until))))
        assert len(found) == count, until
    (words,) = reminders(load_bench(bench_of(tmp_path, "ask", "2026-11-25")))
    assert words.endswith("expires on 2026-11-25, in 1 day; have it calibrated")


def test_the_commands_say_it(bench, tmp_path, today):
    file = bench_of(tmp_path, "ask")
    refused(bench("run", "quick", "--bench", file), "voltmeter.x", "expired on 2026-10-01", "no terminal")
    soon = bench_of(tmp_path, "ask", "2026-12-01")
    assert "expires on 2026-12-01, in 7 days" in printed(bench("check", "quick", "--bench", soon))
    refused(bench("check", "quick", "--bench", bench_of(tmp_path, "sometimes")), "expired")
