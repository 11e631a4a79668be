"""The origin of readings, the bench file that an analysis uses for them, and the reason for this choice."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError

from bench.base.files import MEGABYTE, read_regular, to_text
from bench.base.languages import message
from bench.base.text import visible
from bench.config.bench_file.file import BenchFile, load_bench, load_recorded_bench
from bench.config.bench_file.learned import LearnedFile, load_learned
from bench.config.shipped import find_bench
from bench.results.parts import BenchPart
from bench.run.events import sha256
from bench.run.folder import BENCH, IMPORTED, LEARNED, Run
from drivers.interfaces import NO_SERIAL

FORMAT: Final = 1
SUFFIX: Final = ".json"


def _printable(text: str) -> str:
    if visible(text) != text:
        raise ValueError("text with control characters")
    return text


_Text = Annotated[str, AfterValidator(_printable)]


class _Part(BaseModel):
    """A part of the origin file of a readings file; unknown members are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore", strict=True)


class UnitOrigin(_Part):
    """The block that was measured: its type and serial number."""

    type: _Text
    serial: _Text


class BenchOrigin(_Part):
    """The bench file of a run: its name, its copy in the run's folder, and its SHA-256.

    `copied_to_from_here` is the path of the copy relative to the readings file; empty on another drive."""

    file: _Text
    copied_to: _Text
    copied_to_from_here: _Text = ""
    sha256: _Text


class Origin(_Part):
    """The origin of readings: their run, block, bench file and instruments.

    `unit_under_test` is None if the block was not stated, `procedure` is "" if there was none. `serials` are the
    serial numbers that the instruments reported; simulated runs record them only for a bench with certificates.
    If the readings are a corrected copy, `mended` lists the mistakes that were corrected.
    """

    simulated: bool
    run: _Text
    begun: _Text
    operator: _Text
    procedure: _Text
    plan_hash: _Text
    unit_under_test: UnitOrigin | None
    bench: BenchOrigin
    instruments: dict[_Text, _Text]
    measured_with: dict[_Text, _Text]
    serials: dict[_Text, _Text] = {}
    mended: tuple[_Text, ...] = ()

    def text_beside(self, readings: Path, content: bytes) -> str:
        """Return the text of the origin file for the readings file at path `readings` with this `content`."""
        empty = {name for name in ("serials", "mended") if not getattr(self, name)}
        own = self.model_dump(mode="json", exclude={"sha256", *empty})
        try:
            here = os.path.relpath(self.bench.copied_to, readings.absolute().parent)
        except ValueError:  # on another drive
            here = ""
        own["bench"]["copied_to_from_here"] = here
        about = {"format": FORMAT, "sha256": sha256(content), **own}
        return to_text(about)

    def bench_file(self, readings: Path) -> Path | None:
        """Return the path of an unchanged copy of the run's bench file; None if none is found.

        The search covers the copy in the run's folder and then the original file. The copy is looked for at its
        recorded path and, in case it was moved with the readings, at its path relative to `readings`.
        """
        places = [self.bench.copied_to, self.bench.copied_to_from_here, self.bench.file]
        for path in (readings.parent / place for place in places if place):
            if (content := _read(path)) is not None and sha256(content) == self.bench.sha256:
                return path
        return None


def instrument_name(identity: str, serial: str, resource: str | None, bench: str) -> str:
    """Return model and serial number of an instrument; without a serial number, identity, address and bench."""
    serial = serial.strip()
    if serial in NO_SERIAL:
        place = f" at {resource}" if resource else ""
        return f"{identity}{place} of {bench}"
    return f"{identity.split(serial, maxsplit=1)[0].strip()} {serial}".strip()


@dataclass(frozen=True)
class OriginBeside:
    """The origin of readings (None if its file is missing, unusable or of other readings), and notes."""

    origin: Origin | None = None
    notes: tuple[str, ...] = ()


def origin_of_run(run: Run) -> OriginBeside:
    """Return the origin of a run's readings; for an imported run, from any origin file imported with it."""
    if run.imported:
        told = origin_beside(run.folder / IMPORTED)
        if told.origin is not None or told.notes:
            return told
    manifest = run.manifest
    unit = manifest.get("unit_under_test")
    copied_to = run.folder.absolute() / BENCH
    return OriginBeside(
        Origin(
            simulated=run.simulated,
            run=run.name,
            begun=run.created,
            operator=_as_text(run.history.progress.operators(manifest.get("operator"))),
            procedure=_as_text(manifest.get("procedure")),
            plan_hash=_as_text(manifest.get("plan_hash")),
            unit_under_test=unit and UnitOrigin(type=_as_text(unit["type"]), serial=_as_text(unit["serial"])),
            bench=BenchOrigin(
                file=_as_text(manifest.get("bench")),
                copied_to=_as_text(copied_to),
                sha256=sha256(read_regular(copied_to)),
            ),
            instruments={name: _as_text(identity) for name, identity in run.history.identities.items()},
            serials={name: _as_text(serial) for name, serial in run.history.serials.items()},
            measured_with={name: _as_text(v) for name, v in manifest.get("versions", {}).items()},
        )
    )


def origin_beside(readings: Path) -> OriginBeside:
    """Return the origin in a readings file's origin file, if it states the SHA-256 of these readings."""
    file = readings.with_name(readings.name + SUFFIX)
    content = _read(file)
    if content is None or not readings.is_file():
        return OriginBeside()
    try:
        about = _About.model_validate_json(content)
    except ValidationError:
        return (
            OriginBeside()
            if b'"sha256"' not in content
            else OriginBeside(notes=(f"{file.name} {_UNREADABLE}",))
        )
    if about.sha256 != sha256(read_regular(readings)):
        return OriginBeside(notes=(_mismatch(readings.name, file.name, about),))
    mended = "; ".join(about.mended)
    return OriginBeside(
        about, (f"a copy of {about.run} with corrected mistakes: {mended}",) if mended else ()
    )


def is_told(file: Path) -> bool:
    """Return whether `file` is an origin file (of any readings)."""
    try:
        _About.model_validate_json(_read(file) or b"")
    except ValidationError:
        return False
    return True


_UNREADABLE: Final = (
    "was not written by this program beside a readings file; its simulation, unit and bench are not used"
)


class _About(Origin):
    """The whole origin file: the origin of the readings, and the SHA-256 of the readings file."""

    sha256: _Text


def _mismatch(readings: str, file: str, about: Origin) -> str:
    kind = "SIMULATED instruments" if about.simulated else "real instruments"
    return (
        f"{readings} was changed after it was exported: {file} has other content (SHA-256), of run {about.run} "
        f"on {kind}; its simulation, unit and bench are not used"
    )


def _read(path: Path) -> bytes | None:
    """Return the content of `path`, a regular file of at most 1 MB; None for anything else."""
    try:
        return read_regular(path, MEGABYTE)
    except OSError:
        return None


def _as_text(value: object) -> str:
    return visible(str(value or ""))


DEFAULT_BENCH: Final = "paper-stand"
_ASKED_FOR: Final = message("as asked for")
_NONE_NAMED: Final = message("the shipped one, because no file was named")


@dataclass(frozen=True)
class BenchTaken:
    """The bench file of an analysis; `why` is the reason for this choice.

    `chosen` is the reason why the run was begun with this file.
    """

    file: BenchFile
    where: str
    sha256: str
    why: str
    chosen: str = ""

    @property
    def stated(self) -> bool:
        """Whether the user or the record named this bench file; otherwise it is the shipped default."""
        return self.why != _NONE_NAMED

    @property
    def learned_path(self) -> Path | None:
        """Path of the file of learned errors that the bench file names, or of the run's copy; or None."""
        if self.file.learned is None:
            return None
        own = Path(self.where)
        copy = own.with_name(LEARNED)
        return copy if own.name == BENCH and copy.is_file() else own.parent / self.file.learned

    def learned(self) -> LearnedFile | None:
        """Return the learned file that the bench file names, or None. Raises `FileMistakes`."""
        path = self.learned_path
        return None if path is None else load_learned(path, self.file)

    @property
    def words(self) -> str:
        """The name of the bench file, and the reason for the choice."""
        return f"{self.file.name}, {self.why}"

    @property
    def reason(self) -> str:
        """The reason for this bench file, and the reason why the run was begun with this file."""
        if not self.chosen:
            return self.why
        if self.chosen == _ASKED_FOR:
            return message(f"{self.why}; chosen at the start as asked for")
        return message(f"{self.why}; chosen at the start as {self.chosen.removeprefix('as ')}")

    def part(self) -> BenchPart:
        """Return name, path, reason and SHA-256 of the bench file as a part of a result."""
        return BenchPart(name=self.file.name, file=self.where, why=self.reason, sha256=self.sha256)


def bench_path(given: str | Path | BenchFile | None) -> Path:
    """Return the path of the bench file to use: `given`, else $BENCH_FILE, else that of the shipped file."""
    return find_bench(str(given or "") or os.environ.get("BENCH_FILE") or DEFAULT_BENCH)


def why_taken(given: str | Path | BenchFile | None) -> str:
    """Return why `bench_path(given)` chooses its file."""
    if given:
        return _ASKED_FOR
    return message("named by BENCH_FILE") if os.environ.get("BENCH_FILE") else _NONE_NAMED


def find_bench_file(given: str | Path | BenchFile | BenchTaken | None) -> BenchTaken:
    """Return the bench file `given` (content, path or name), else $BENCH_FILE, else the shipped one."""
    if isinstance(given, BenchTaken):
        return given
    if isinstance(given, BenchFile):
        return BenchTaken(given, given.name, sha256(given.model_dump_json().encode()), message("as given"))
    path = bench_path(given)
    return BenchTaken(load_bench(path), str(path), sha256(read_regular(path)), why_taken(given))


def bench_for_record(file: BenchFile, path: Path) -> dict[str, bytes]:
    """Return the files to copy into a run, by name: bench file and any learned file. Raises `FileMistakes`."""
    taken = BenchTaken(file, str(path), "", "")
    kept = {BENCH: read_regular(path)}
    if taken.learned() is not None and taken.learned_path is not None:
        kept[LEARNED] = read_regular(taken.learned_path)
    return kept


def recorded_sha256(run: Run) -> str:
    """Return the SHA-256 of the bench file that a run recorded."""
    return sha256(read_regular(run.folder / BENCH))


def bench_of(
    name: str, run: Run | None, told: OriginBeside, given: str | Path | BenchFile | None
) -> tuple[BenchTaken, tuple[str, ...]]:
    """Return the bench file to use for readings, and notes.

    A run uses the requested file (`given`), else the one that it recorded. Other readings use the requested
    file, else the file in BENCH_FILE, else the file that their origin (`told`) names, else the shipped file. A
    file that the origin names is not used if it was moved or changed.
    """
    if run is not None:
        return _of_run(run, given)
    origin = told.origin
    if origin is None:
        return find_bench_file(given), told.notes
    meant = message(f"the bench file that {Path(name).name} was measured with ({origin.bench.file})")
    if given is not None or os.environ.get("BENCH_FILE"):
        taken = find_bench_file(given)
        other = taken.sha256 != origin.bench.sha256
        return taken, (message(f"evaluated with {taken.where} instead of {meant}"),) if other else ()
    path = origin.bench_file(Path(name))
    if path is None:
        taken = find_bench_file(None)
        return taken, (
            message(
                f"{meant} was moved or changed (SHA-256 {origin.bench.sha256[:12]}…): used is {taken.words}; "
                "name it with --bench"
            ),
        )
    why = message(f"as {Path(name).name}{SUFFIX} names it, of run {origin.run}")
    return BenchTaken(load_recorded_bench(path), str(path), origin.bench.sha256, why), ()


def _of_run(run: Run, given: str | Path | BenchFile | None) -> tuple[BenchTaken, tuple[str, ...]]:
    if given is not None:
        taken = find_bench_file(given)
        return taken, (
            message(f"evaluated with {taken.where} instead of the bench file that the run recorded"),
        )
    path = run.folder / BENCH
    recorded = load_recorded_bench(path)
    chosen = run.manifest.get("bench_why", "")
    return BenchTaken(
        recorded, str(path), recorded_sha256(run), message("as the run recorded it"), chosen
    ), ()


def own_bench(run: Run) -> tuple[BenchFile, Path]:
    """Return the bench file that a run recorded, and the path to which its relative paths refer.

    This is the path of the original file if it still exists, otherwise the path of the run's copy.
    """
    stated = Path(str(run.manifest.get("bench", "")))
    return load_recorded_bench(run.folder / BENCH), stated if stated.is_file() else run.folder / BENCH
