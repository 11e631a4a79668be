"""The register of failures: collected from the records of runs; persons note state, cause and remedy."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Final

from bench.base.languages import message
from bench.base.text import visible
from bench.certificate.laboratory import load_laboratory
from bench.results.registers import Failure, FailuresResult, NotedRemedy, ValidationResult
from bench.run.events import EventType, RecordError
from bench.run.folder import Run, all_runs
from bench.run.sentences import sentence
from bench.services.chain import Chain, Entry, civil_now, opened
from bench.services.errors import Refused
from bench.services.persons import persons_of
from bench.services.requests.documents import Failures, FailureState, Right
from bench.services.requests.shared import runs_folder
from bench.services.validated import laboratory_needed
from drivers.clock import utc_now

SEEN, NOTED, DAMAGED, VALIDATION = "seen", "noted", "damaged", "validation"
KINDS: Final = frozenset(
    {
        EventType.RUN_FAILED, EventType.RUN_ABORTED, EventType.RUN_INTERRUPTED, EventType.STEP_FAILED,
        EventType.ANSWER_REFUSED, EventType.REDO, EventType.SKIPPED, EventType.EARLY_SIGN, EventType.WENT_ON,
        EventType.CERTIFICATE, EventType.SAME_SERIAL, EventType.CLOCK_JUMPED, EventType.CHAMBER_SLOW,
        EventType.LEFT_SAFE,
    }
)  # fmt: skip
"""Events that are failures, stops, refused answers, repeated readings or alarms.

A "fault" of the power supply also counts.
"""


@dataclass
class FailureRegister(Chain):
    """The register of failures: `seen` maps numbers to failures, `noted` maps numbers to notes on them."""

    KIND: ClassVar[str] = "failures"

    seen: dict[str, Entry] = field(default_factory=dict)
    noted: dict[str, list[Entry]] = field(default_factory=dict)

    def _note(self, entry: Entry, where: str) -> bool:
        if entry.kind == SEEN and entry.number not in self.seen:
            self.seen[entry.number] = entry
            self.noted[entry.number] = []
        elif entry.kind == NOTED and entry.number in self.seen:
            self.noted[entry.number].append(entry)
        else:
            return False
        return True

    def keys(self) -> set[tuple[str, str, int]]:
        """Return the keys of the known failures: creation time and name of the run, and number of the event."""
        return {(one.data["created"], one.data["run"], one.data["event"]) for one in self.seen.values()}


def failures(request: Failures) -> FailuresResult:
    """Add new failures from the records to the register, apply the request's changes, and return the register.

    Raises `Refused` without a laboratory file, for an unknown number, and for a remedy without text or without a
    person.
    """
    laboratory = laboratory_needed(
        request.laboratory, message("the register of failures is a folder beside it")
    )
    with opened(FailureRegister.beside(laboratory)) as register:
        new = 0
        known = register.keys()
        for data in _in_records(runs_folder(request.runs)):
            if (data["created"], data["run"], data["event"]) not in known:
                _append(register, data, "bench failures")
                new += 1
        if request.number is not None:
            _note(register, request, laboratory)
        return _result(register, request.year, new)


def note_validation(laboratory: Path, name: str, result: ValidationResult) -> str:
    """Add a failed validation, by the `name` of its folder, to the register; return the failure's number.

    Raises `Refused` if the register cannot be used.
    """
    data = {
        "run": name,
        "created": result.began,
        "event": 0,
        "when": result.began,
        "kind": VALIDATION,
        "said": visible(f"{result.headline}: {', '.join(one.name for one in result.failed)}"),
        "simulated": False,
    }
    with opened(FailureRegister.beside(laboratory)) as register:
        return _append(register, data, "bench validate")


def _append(register: FailureRegister, data: dict[str, Any], by: str) -> str:
    """Append a failure that a program found to the register; return its number."""
    number = f"F{data['when'][:4] or utc_now().year}-{len(register.seen) + 1:04d}"
    register.append(Entry(SEEN, number, civil_now(), by, data))
    return number


def _in_records(runs: Path) -> Iterator[dict[str, Any]]:
    """Yield the failures in the records of a folder, oldest run first."""
    for run in all_runs(runs):
        about = {"run": run.name, "created": run.created}
        try:
            about["simulated"] = run.simulated  # type: ignore[assignment]
            yield from ({**about, **one} for one in _in_record(run))
        except RecordError as error:
            yield {
                "simulated": False,
                **about,
                "event": 0,
                "when": run.created,
                "kind": DAMAGED,
                "said": str(error),
            }


def _in_record(run: Run) -> Iterator[dict[str, Any]]:
    history = run.history
    for event in history.events:
        fault = event.type == EventType.POWER and event.data.get("power") == "fault"
        if event.type in KINDS or fault:
            words = sentence(event).replace("\n", "; ")
            why = event.data.get("error") or event.data.get("reason") or event.data.get("why") or ""
            said = (
                words if words != event.type else f"{event.type.replace('_', ' ')}: {why}".removesuffix(": ")
            )
            yield {"event": event.number, "when": event.time, "kind": str(event.type), "said": visible(said)}
    if history.problems:
        yield {"event": 0, "when": run.created, "kind": DAMAGED, "said": visible("; ".join(history.problems))}


def _note(register: FailureRegister, request: Failures, laboratory: Path) -> None:
    """Append to the register what the request states about a failure."""
    number, by = str(request.number), request.by
    needed = {"--state": request.state, "--remedy TEXT": request.remedy, "--by NAME": by}
    lacking = [option for option, given in needed.items() if not given]
    if lacking or request.state is None or by is None:
        raise Refused(f"--number {number}: a remedy needs {', '.join(lacking)}")
    if number not in register.seen:
        latest = ", ".join(list(register.seen)[-3:]) or "none"
        raise Refused(f"--number {number}: no failure of that number; the latest are: {latest}")
    if request.state == FailureState.CLOSED:
        load_laboratory(laboratory).authorised_person(by, "--by")
    elif (persons := persons_of(laboratory)) is not None:
        persons.chosen(by, Right.OPERATE, "--by")
    told = {"state": str(request.state), "remedy": request.remedy}
    register.append(Entry(NOTED, number, civil_now(), by, told))


def _result(register: FailureRegister, year: int | None, new: int) -> FailuresResult:
    found = []
    for number, one in register.seen.items():
        noted = [
            NotedRemedy(time=entry.time, by=entry.by, state=entry.data["state"], remedy=entry.data["remedy"])
            for entry in register.noted[number]
        ]
        state = noted[-1].state if noted else str(FailureState.OPEN)
        told = {name: one.data[name] for name in ("run", "event", "kind", "said", "simulated")}
        when = str(one.data["when"])
        if year is None or when.startswith(f"{year}-"):
            found.append(Failure(number=number, time=when, state=state, noted=noted, **told))
    return FailuresResult(
        register_=str(register.folder), head=register.head, year=year, collected=new, failures=found
    )
