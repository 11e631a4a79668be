"""The results of `bench runs`, `show`, `instruments`, `commission` and `simulate`, as JSON and as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from pydantic import Field
from rich.console import Console
from rich.text import Text

from bench.base.languages import HEADING, message, translated
from bench.base.result_model import ResultModel
from bench.base.tables import table
from bench.base.text import civil_minute
from bench.results.parts import RecordPart, UnitPart
from bench.results.tables import page
from bench.run.commission.session import Finding
from bench.run.folder import Run
from bench.run.instruments import same_serials
from bench.run.record import resume_point
from bench.run.sentences import duration, said, sentence
from drivers.interfaces import Identity

_NAME: Final = 19
"""Width of the column of names; the whole line then has 80 characters."""
_SAID: Final = ("answered", "answer_refused")
_LABELS: Final = {
    "created": message("created", "heading"),
    "dry_run": message("dry run", "heading"),
    "seed": message("seed", "heading"),
    "format": message("format of the record"),
    "imported": message("imported from"),
    "imported_from": message("imported from"),
    "living": message("questions answered by a person"),
    "operator_person": message("operator in the register"),
    "bench": message("bench file"),
    "bench_why": message("choice of the bench file"),
    "plan_hash": message("SHA-256 of the plan"),
    "versions": message("versions of the programs"),
    "devices": message("sources of drivers"),
    "default_rule": message("decision rule if none is stated"),
    "verdict": message("limit and rule of the run"),
    "until": message("goals of the run"),
    "check_block": message("check block at the start"),
    "files": message("SHA-256 of the files"),
    "limit_g": message("limit in g", "heading"),
    "guard_band": message("guard band", "heading"),
    "false_acceptance": message("false acceptance"),
    "rule": message("rule", "heading"),
    "type": message("type", "heading"),
    "serial": message("serial", "heading"),
}
"""The label in `bench show` of each member of a manifest, or of a part of it, whose name does not explain it."""
_NAMES: Final = ("name", "operator", "procedure", "bench file", "imported from", "unit_under_test")
"""The labels of names, which are shown as they are, also where they are words."""


class RunPart(ResultModel):
    """A run in the list of runs."""

    name: str
    created: str = Field(description="civil time at which the run was created")
    instruments: str = Field(description="`simulated` or `real`; `-` if unknown")
    state: str
    """ready, running, paused, finished, failed, interrupted, aborted, imported or damaged; not begun or
    unfinished if no program carries the run out
    """
    readings: int
    verdict: str | None
    """verdict at the run's own verification points: passed, conditional pass, conditional fail, failed,
    inconclusive, not complete or does not fit; null if there is none or the record is damaged
    """
    to_go_on: str = Field(description="command that resumes the run; empty if nothing is left to do")


class RunsResult(ResultModel):
    """The runs of a folder."""

    runs: list[RunPart]

    def print_on(self, folder: Path, out: Console) -> None:
        """Print a line (80 characters) for each run; below it, any damage and the command that resumes the run."""
        if not self.runs:
            out.print(message(f"{folder}: no runs there; name their folder with --runs"))
            return
        heads = (
            translated(one, "column") for one in ("begun", "instruments", "state", "readings", "verdict")
        )
        out.print(Text(_line(translated("run", "column"), tuple(heads)), style="bold"))
        for run in self.runs:
            begun = run.created[:16].replace("T", " ")
            state, _, damage = run.state.partition(": ")
            instruments, state = translated(run.instruments, "column"), translated(state)
            verdict = translated(run.verdict or "-").upper()
            out.print(Text(_line(run.name, (begun, instruments, state, run.readings, verdict))))
            for further in filter(None, (damage, run.to_go_on)):
                out.print(f"    {further}")


def _line(name: str, facts: Sequence[object]) -> str:
    """Return `name` and `facts` in a line of 80 characters; a name that is too long gets its own line."""
    begun, instruments, state, readings, verdict = facts
    shown = f"{begun!s:16}  {instruments!s:11}  {state!s:10}  {readings!s:>8}  {verdict}"
    separate = "\n" if len(name) > _NAME else ""
    return f"{name}{separate}{'':{_NAME if separate else max(_NAME - len(name), 0)}} {shown}"


class ManifestPart(ResultModel):
    """`run.json`: the inputs of a run."""

    format: int = Field(description="format of the record")
    name: str
    created: str
    imported: str = Field("", description="readings file that was imported")
    imported_from: str = Field("", description="readings file that was imported, in older records")
    readings: int = Field(0, description="number of imported readings")
    dry_run: bool = False
    seed: int | None = None
    living: bool = Field(False, description="true for a dry run in which a person answers the questions")
    operator: str = ""
    procedure: str = ""
    bench: str = ""
    bench_why: str = Field("", description="why this bench file was used")
    plan_hash: str = ""
    unit_under_test: UnitPart | None = Field(None, description="the block")
    versions: dict[str, str] = Field(description="versions of the programs")
    devices: dict[str, str] = Field({}, description="sources of drivers that the bench file does not name")
    default_rule: dict[str, Any] = Field({}, description="decision rule if none is stated")
    verdict: dict[str, Any] = Field({}, description="limit and rule that replace those of the bench file")
    until: list[str] = Field([], description="goals at which the run ends")
    check_block: dict[str, Any] = Field({}, description="state of the check block at the start of the run")
    files: dict[str, str] = Field(description="SHA-256 of each file that was copied into the run folder")


class ProvenRecordPart(RecordPart):
    """What identifies a record, with the findings of `--verify`."""

    told: list[str] = Field(description="evidence for and against the record; only with --verify")


class ShowResult(RunPart):
    """A run: its manifest, its state and its record."""

    manifest: ManifestPart | dict[str, Any] = Field(description="content of `run.json`")
    record: ProvenRecordPart
    problems: list[str] = Field(description="faults of the record; only with --verify")

    def print_on(self, run: Run, supply: str, out: Console, *, verified: bool) -> None:
        """Print the manifest, and then the events or, with `verified`, what the record proves."""
        summary = {name: getattr(self, name) for name in RunPart.model_fields if name != "to_go_on"}
        summary[message("command to resume")] = self.to_go_on
        labelled = {**summary, **{_LABELS.get(name, name): value for name, value in run.manifest.items()}}
        labelled["created"] = civil_minute(self.created)
        labelled["operator"] = run.history.progress.operators(labelled.get("operator"))
        for label, value in labelled.items():
            if value not in ("", None):
                text = _text(value)
                shown = text if label in _NAMES else translated(text)
                context = HEADING if label in {*_LABELS, *_LABELS.values()} else ""
                out.print(Text(f"{translated(label.replace('_', ' '), context)}: {shown}"))
        if supply:
            out.print(f"supply of the block: {supply}")
        if verified:
            self._print_proof(run, out)
        else:
            _print_events(run, out)

    def _print_proof(self, run: Run, out: Console) -> None:
        wrong = run.history.problems
        found = "; ".join(wrong) if wrong else message("chain of hashes complete")
        out.print(f"record: {len(run.history.events)} events, {found}")
        if run.history.torn:
            out.print("record: the last line is incomplete; 'bench resume' drops it")
        for line in self.record.told:
            hashed = line.removeprefix("head: ")  # the record's last hash, not the dividing head
            lead = "" if hashed == line else translated(message("head", "record"), "record") + ": "
            out.print(Text(lead + translated(hashed)))
        for problem in self.problems if not wrong else ():
            out.print(problem, style="bold")


def _text(value: object) -> str:
    """Return a value of the manifest as text, and a mapping as "name value, name value"."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, dict):
        return ", ".join(
            f"{translated(_LABELS.get(str(name), str(name)), HEADING)} {part}" for name, part in value.items()
        )
    return str(value)


def _print_events(run: Run, out: Console) -> None:
    if run.imported:
        return
    steps = run.plan.steps
    for event in run.history.events:
        if event.type == "step_started":
            continue
        text = event.type
        if "step" in event.data and event.type == "step_done":
            text = steps[int(event.data["step"])].describe()
        reading = event.data.get("reading")
        if reading:
            text += "  " + "  ".join(f"{value:+.6f} {reading['unit']}" for value in reading["mean"])
        if event.type in _SAID:
            text = said(event)
        elif event.type == "chosen":
            text = sentence(event)
        for told in ("error", "reason", *(("text",) if event.type == "asked" else ())):
            if event.data.get(told):
                text += f": {event.data[told]}"
        if event.data.get("by") and event.type not in _SAID:
            text += f" ({event.data['by']}, {event.data.get('role')}, {event.data.get('where')})"
        out.print(f"{event.number:5d}  {duration(event.bench_s):>11}  {text}")
    point = resume_point(run.plan, run.history)
    if point.step < len(steps):
        out.print(f"next: step {point.step + 1}, {steps[point.step].describe()}")


# --- instruments --------------------------------------------------------------------------------------


class FailurePart(ResultModel):
    """A fault of an instrument, with its remedy."""

    cause: str
    remedy: str


class InstrumentPart(ResultModel):
    """An instrument that was opened, tested and read."""

    name: str
    address: str
    identity: Identity | None
    settings: str
    self_test: str
    value: dict[str, float] | float | None = Field(description="value in V (by channel or output), rad or °C")
    shows: str
    failures: list[FailurePart]


class InstrumentsResult(ResultModel):
    """Every instrument of a bench: its identity, settings, self-test and faults."""

    bench: str
    passed: bool
    instruments: list[InstrumentPart]

    def print_on(self, out: Console) -> None:
        """Print a line for each instrument, and how many of them have no fault."""
        shown = table()
        for heading in (
            message("instrument", "heading"),
            message("address", "heading"),
            message("identity", "heading"),
            message("settings", "heading"),
            message("self-test", "heading"),
            message("shows", "heading"),
        ):
            # an address is copied from the table, so it must not be broken
            whole = heading in {"instrument", "address", "self-test"}
            shown.add_column(translated(heading, HEADING), overflow="fold", no_wrap=whole)
        for one in self.instruments:
            tested = one.self_test in ("", "none", "manual", "passed")
            unread = one.identity is not None and bool(one.failures) and not one.shows
            identity = message("NOT OPENED") if one.identity is None else str(one.identity)
            test, shows = one.self_test if tested else "FAILED", "FAILED" if unread else one.shows
            shown.add_row(one.name, one.address, identity, one.settings, test, shows)
        out.print(shown)
        identities = {one.name: one.identity for one in self.instruments if one.identity is not None}
        for words in same_serials(identities):
            out.print(f"note: {words}")
        well = sum(not one.failures for one in self.instruments)
        out.print(f"{well} of {len(self.instruments)} instruments respond without a fault")


# --- commissioning ------------------------------------------------------------------------------------

VERDICTS: Final = {
    0: ("passed", message("✓ Everything tested works as expected")),
    1: ("none", message("Something is slower or different than expected")),
    2: ("failed", message("✗ Something could not be tested")),
}
"""The style of the page and its headline, by exit status."""


class CommissionedPart(ResultModel):
    """An instrument of the commissioned bench."""

    name: str
    address: str
    identity: str | None


class CommissionResult(ResultModel):
    """The result of commissioning the instruments of a bench, check by check."""

    what: str = Field("commissioning", description="`commissioning` or `morning check`")
    bench: str
    bench_file: str
    simulated: bool = Field(description="whether the bench was simulated")
    began: str = Field(description="start (UTC, ISO 8601)")
    took_s: float = Field(description="duration by the clock of the bench, s")
    status: int = Field(ge=0, le=2)
    """0: every check succeeded; 1: something is slower or differs; 2: a check failed"""
    ended: str = Field(description="reason for early termination; empty if every check was made")
    instruments: list[CommissionedPart]
    findings: list[Finding]
    to_do: dict[str, str] = Field(description="remaining work for a person, by instrument")
    wire_log: str = Field(description="name of the log of all messages, a file beside the result")
    versions: dict[str, str] = Field(description="versions of the program and its libraries")


def render_commissioning(result: Mapping[str, Any]) -> str:
    """Return the HTML page of a commissioning from its JSON result; the same result always gives the same text."""
    look, word = VERDICTS[result["status"]]
    return page("commissioning.html.j2", result=result, look=look, word=word)


# --- simulation ---------------------------------------------------------------------------------------


class ServedPart(ResultModel):
    """A simulated instrument, with the addresses at which it is served."""

    name: str
    model: str
    tcp: str = Field(description="host and port of the instrument")
    pty: str | None = Field(None, description="path of the pseudo-terminal, if there is one")


class ReadyResult(ResultModel):
    """The address of each simulated instrument: the file of `bench simulate --ready-file`."""

    instruments: list[ServedPart]
    control: str = Field("", description="host and port for commands such as 'turn 45 deg'")
