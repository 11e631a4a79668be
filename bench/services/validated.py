"""Checks before a run on real instruments: is the program validated, are the certificates valid?

A program is known by its fingerprint. The register is the folder `validations` beside the laboratory file. An entry
says that a named person accepted the result of `bench validate` for a program (its fingerprint) and a bench file
(its SHA-256).
"""

from __future__ import annotations

import datetime
import os
import platform
import re
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any, ClassVar, Final

from bench.base.files import to_text
from bench.base.languages import message
from bench.base.text import as_typed
from bench.base.yaml_files import load_document, part, sha256_of_file
from bench.config.bench_file.file import BenchFile, Standing, foreign_drivers, load_bench, standings
from bench.config.devices import FOLDERS
from bench.config.devices.registry import GROUP
from bench.config.formulas import files_of_environment
from bench.config.shipped import PROCEDURES, shipped_folder
from bench.results.registers import PackagePart, ProgramFingerprint
from bench.run.events import EventType, sha256
from bench.run.folder import BENCH, Run
from bench.run.listening import Asker
from bench.run.person import agree
from bench.run.record import Record
from bench.services.chain import Chain, Entry
from bench.services.errors import Refused
from bench.services.requests.measuring import RunRequest
from drivers.clock import utc_now
from drivers.interfaces import BenchError
from drivers.person import Prompt, PromptKind

DISTRIBUTION: Final = "triaxial-bench"
LABORATORY: Final = "BENCH_LABORATORY"
ACCEPTED, WITHDRAWN = "accepted", "withdrawn"
ROOT: Final = Path(__file__).parents[2]
OURS: Final = ("bench", "drivers", "sim")
_NO_CODE: Final = frozenset({".pyc", ".pyo", ".part"})
_REQUIREMENT: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


# --- the program ------------------------------------------------------------------------------------


def own_files() -> dict[str, str]:
    """Return the SHA-256 of each file of the program, by its path: its packages and the shipped procedures."""
    return {
        path: digest
        for name, folder in [
            *((name, ROOT / name) for name in OURS),
            (PROCEDURES, shipped_folder(PROCEDURES)),
        ]
        for path, digest in _files_of(folder, name)
    }


def _files_of(folder: Path, name: str) -> Iterator[tuple[str, str]]:
    """Yield path (which begins with `name`) and SHA-256 of each file in a folder, except compiled code."""
    for file in sorted(folder.rglob("*")):
        if file.is_file() and file.suffix not in _NO_CODE and "__pycache__" not in file.parts:
            yield f"{name}/{file.relative_to(folder).as_posix()}", sha256(file.read_bytes())


def plug_ins(bench: BenchFile) -> dict[str, str]:
    """Return the SHA-256 of each of the laboratory's own drivers and effects for a bench, by path or name.

    If the bench file names any driver of the laboratory, all its drivers are included: the files in the folders
    of BENCH_DEVICES, and the distributions that contain drivers.
    """
    found: dict[str, str] = {}
    if foreign_drivers(bench):
        for folder in filter(None, os.environ.get(FOLDERS, "").split(os.pathsep)):
            found |= dict(_files_of(Path(folder).expanduser(), Path(folder).name))
        for one in (entry.dist for entry in metadata.entry_points(group=GROUP)):
            if one is not None:
                found[one.name] = sha256((one.read_text("RECORD") or "").encode())
    effects = [Path(one).expanduser() for one in files_of_environment()]
    return found | {one.name: sha256(one.read_bytes()) for one in effects if one.is_file()}


def digest_of(found: dict[str, str]) -> str:
    """Return one SHA-256 for all `plug_ins`; "" if there are none."""
    return sha256(to_text(found).encode()) if found else ""


def packages() -> Iterator[metadata.Distribution]:
    """Yield the program's distribution, and the installed distributions that it needs or can use."""
    waiting, seen = [DISTRIBUTION], set()
    while waiting:
        name = re.sub(r"[-_.]+", "-", waiting.pop(0)).lower()
        if name in seen:
            continue
        seen.add(name)
        with suppress(metadata.PackageNotFoundError):
            one = metadata.distribution(name)
            yield one
            needed = _needed(one, of_program=name == DISTRIBUTION)
            waiting += [match[0] for match in map(_REQUIREMENT.match, needed) if match]


def _needed(one: metadata.Distribution, *, of_program: bool) -> list[str]:
    """Return the requirements of a distribution; of extras, only those that the program needs in use."""
    ours = re.compile(r"extra == ['\"](?:test|browser|docs|mutation|release|dev)['\"]")
    other = ours if of_program else re.compile(r"extra\s*==")
    return [text for text in one.requires or () if not other.search(text)]


def fingerprint() -> ProgramFingerprint:
    """Return the fingerprint of an installation: files of the program, packages, Python and platform."""
    named = {}
    for one in packages():
        record, about = one.read_text("RECORD") or "", one.metadata  # read and parsed at each access
        named[about["Name"]] = PackagePart(version=about["Version"], sha256=sha256(record.encode()))
    stated: dict[str, Any] = {
        "version": named[DISTRIBUTION].version if DISTRIBUTION in named else "not installed",
        "python": f"{platform.python_implementation()} {platform.python_version()}",
        "platform": f"{platform.system()} {platform.machine()}",
        "files": own_files(),
        "packages": {name: named[name] for name in sorted(named) if name != DISTRIBUTION},
    }
    told = {**stated, "packages": {name: part_.to_dict() for name, part_ in stated["packages"].items()}}
    return ProgramFingerprint(fingerprint=sha256(to_text(told).encode()), **stated)


# --- the register -----------------------------------------------------------------------------------


@dataclass
class Validations(Chain):
    """The register of validations: `entries` in order, and the numbers of those `withdrawn`."""

    KIND: ClassVar[str] = "validations"

    entries: list[Entry] = field(default_factory=list)
    withdrawn: set[str] = field(default_factory=set)

    def _note(self, entry: Entry, where: str) -> bool:
        known = {one.number for one in self.entries if one.kind == ACCEPTED}
        if entry.kind == WITHDRAWN and entry.number in known - self.withdrawn:
            self.withdrawn.add(entry.number)
        elif entry.kind != ACCEPTED or entry.number in known:
            return False
        self.entries.append(entry)
        return True

    def standing(self) -> list[Entry]:
        """Return the accepted validations that were not withdrawn, the latest last."""
        return [one for one in self.entries if one.kind == ACCEPTED and one.number not in self.withdrawn]

    def latest(self, bench_file: Path | str) -> Entry | None:
        """Return the latest valid validation for a bench file with the file name of `bench_file`, or None."""
        name = Path(bench_file).name
        return next((one for one in reversed(self.standing()) if one.data["bench"] == name), None)

    def accepts(self, program: str, bench_sha256: str | None, own: str | None = None) -> bool:
        """Return whether a valid validation is for these hashes of program, bench file and plug-ins (None: any)."""
        return any(
            one.data["fingerprint"] == program
            and bench_sha256 in (None, one.data["bench_sha256"])
            and own in (None, one.data.get("plug_ins", ""))
            for one in self.standing()
        )


# --- the refusal ------------------------------------------------------------------------------------


def laboratory_known(given: Path | None) -> Path | None:
    """Return the laboratory file: `given`, else that in BENCH_LABORATORY; None if neither is set."""
    named = os.environ.get(LABORATORY)
    return given or (Path(named) if named else None)


def laboratory_needed(given: Path | None, why: str) -> Path:
    """Return the laboratory file as `laboratory_known` does; if there is none, raise `Refused` with `why`."""
    laboratory = laboratory_known(given)
    if laboratory is None:
        raise Refused(f"no laboratory file is named ({why}); give --laboratory FILE")
    return laboratory


def demanded_by(laboratory: Path | None) -> bool:
    """Return whether a laboratory file demands validated programs. Raises `FileMistakes` if it cannot be read."""
    if laboratory is None:
        return False
    written = part(load_document(laboratory).data, "require_validation")
    return written is True or str(written).lower() in {"true", "yes", "on"}


def refuse_unvalidated_run(bench: BenchFile, path: Path, laboratory: Path | None = None) -> None:
    """Raise `Refused` for a real run by a program that is not validated, if bench or laboratory file require it."""
    laboratory = laboratory_known(laboratory)
    if bench.require_validation or demanded_by(laboratory):
        by = path if bench.require_validation else laboratory
        _refuse(laboratory, str(by), path, digest_of(plug_ins(bench)))


def refuse_unvalidated_resumption(run: Run) -> None:
    """Raise the errors of `refuse_unvalidated_run` for a real run that is to be resumed."""
    if not run.simulated:
        copy = run.folder / BENCH
        refuse_unvalidated_run(load_bench(copy), copy)


def refuse_unvalidated_certificate(laboratory: Path) -> None:
    """Raise `Refused` for a certificate by a program that is not validated, if the laboratory file requires it."""
    if demanded_by(laboratory):
        _refuse(laboratory, str(laboratory), None)


def _refuse(laboratory: Path | None, by: str, bench: Path | None, own: str | None = None) -> None:
    of_bench = "" if bench is None else f" --bench {as_typed(bench)}"
    of_laboratory = f" --laboratory {as_typed(laboratory or 'FILE')}"
    way = (
        f"'bench validate{of_bench}{of_laboratory} --out DIR', then "
        f"'bench validate --accept DIR{of_laboratory} --by NAME --reason TEXT'"
    )
    if laboratory is None:
        raise Refused(
            f"{by} demands a validated program (require_validation), but no laboratory file is named; set "
            f"{LABORATORY} to the file, and if no validation was accepted yet: {way}"
        )
    register = Validations.beside(laboratory).read_lines()
    digest = None if bench is None else sha256_of_file(bench)
    program = fingerprint().fingerprint
    if register.accepts(program, digest, own):
        return
    if not register.standing():
        why = "no validation was accepted yet"
    elif register.accepts(program, digest):
        why = f"a driver or effect of your own, loaded with {bench}, was changed since, or never validated"
    elif register.accepts(program, None):
        why = f"the bench file {bench} was changed since, or never validated"
    else:
        why = f"the program was changed since {register.standing()[-1].number} was accepted"
    raise Refused(f"{by} demands a validated program (require_validation), and {why}; {way}")


# --- before a run on real instruments --------------------------------------------------------------------


REMINDED_DAYS: Final = 30
"""How long before a certificate expires a reminder appears, days."""


def expired(bench: BenchFile) -> list[Standing]:
    """Return the certificates of a bench that are expired as of today."""
    return [one for one in standings(bench, utc_now().date()) if one.expired]


def reminders(bench: BenchFile) -> Iterator[str]:
    """Yield a sentence for each certificate that expires within the next 30 days."""
    today = utc_now().date()
    for one in standings(bench, today):
        until = one.certificate.valid_until
        if until is not None and today <= until <= today + datetime.timedelta(days=REMINDED_DAYS):
            left = (until - today).days
            yield (
                message(
                    f"{one.instrument}: its {one.certificate.words}, expires on {until}, in {left} "
                    f"day{'' if left == 1 else 's'}; have it calibrated"
                )
            )


def without_gravity(bench: BenchFile) -> Iterator[str]:
    """Yield a sentence if the bench file states no local gravity, because every result of a run needs it."""
    if bench.gravity_m_s2 is None:
        yield (
            message(
                "the bench file states no local gravity, so that a run ends without coefficients and verdict; "
                "add 'gravity' to it, or give --g to 'bench calibrate' and 'bench verify' after the run"
            )
        )


def is_away(answers: str | None, *, panel: bool) -> bool:
    """Return whether a person answers through the run's folder, and not at a terminal.

    This is the case if `answers` is "folder", or if it is None and a `panel` runs the program without a terminal.
    Raises `Refused` for any text but "folder" and "terminal".
    """
    if answers not in (None, "terminal", "folder"):
        raise Refused(f"--answers {answers}: give 'terminal' or 'folder'")
    return answers == "folder" or (panel and answers is None and not sys.stdin.isatty())


def refuse_contradictions(request: RunRequest) -> None:
    """Raise `Refused` for options that contradict each other, and for a real run without a bench file."""
    if not (request.bench or os.environ.get("BENCH_FILE") or request.dry_run):
        raise Refused(
            "a run on real instruments needs a bench file; give --bench FILE or set BENCH_FILE, or try it "
            "with --dry-run"
        )
    if request.model is not None and not request.dry_run:
        raise Refused("--model describes the simulated bench; add --dry-run or remove it")
    if request.follow and is_away(request.answers, panel=request.panel):
        raise Refused("--follow asks at the terminal before it continues; add --answers terminal")


def refuse_unfit(bench: BenchFile, path: Path, request: RunRequest, *, away: bool) -> None:
    """Raise `Refused` for a real run by a program that is not validated, or with expired certificates.

    With `expired: ask` in the bench file, expired certificates are refused only without a terminal, unless a
    person is `away` and can be asked through the run's folder.
    """
    refuse_unvalidated_run(bench, path, request.laboratory)
    late = expired(bench)
    if late and (
        bench.expired == "refuse" or (bench.expired == "ask" and not away and not sys.stdin.isatty())
    ):
        why, way = (
            (message("refuses such runs (expired: refuse)"), message("let a person decide (expired: ask)"))
            if bench.expired == "refuse"
            else (
                message("asks, and there is no terminal"),
                message("begin the run at a terminal, or with --answers folder"),
            )
        )
        raise Refused(
            f"{in_words(late)}; {path} {why}; have it calibrated and state the new certificate, or {way}"
        )


def in_words(late: list[Standing]) -> str:
    """Return a sentence on expired certificates."""
    return "; ".join(
        message(f"{one.instrument}: its {one.certificate.words}, expired on {one.certificate.valid_until}")
        for one in late
    )


def agree_to_expired(run: Run, record: Record, asker: Asker | None) -> None:
    """Before a real run with expired certificates and `expired: ask`, ask whether to continue.

    A no raises `BenchError`.
    """
    if run.simulated or asker is None:
        return
    bench = load_bench(run.folder / BENCH)
    late = expired(bench)
    if not late or bench.expired != "ask":
        return
    text = f"{in_words(late)}. Measure nevertheless?"
    try:
        agree(asker, Prompt(id="expired", kind=PromptKind.CONFIRM, text=text, action={"do": "answer"}))
    except BenchError:
        record.append(EventType.RUN_ABORTED, 0.0, reason="certificates have expired")
        raise
