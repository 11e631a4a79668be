"""Which bench file an analysis takes, and why that one."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from bench.api.origin import SUFFIX, Told
from bench.base.regular import read_regular
from bench.files.bench.file import BenchFile, load_bench, load_recorded_bench
from bench.files.bench.learned import LearnedFile, load_learned
from bench.files.shipped import find_bench
from bench.run.folder import BENCH, LEARNED, Run
from bench.run.manifest import sha256 as sha256_of

DEFAULT_BENCH: Final = "paper-stand"
_NONE_NAMED: Final = "the shipped one, as none was named"


@dataclass(frozen=True)
class BenchTaken:
    """A bench file, where it is, its SHA-256, and why that one; `chosen` is why a run had it."""

    file: BenchFile
    where: str
    sha256: str
    why: str
    chosen: str = ""

    @property
    def stated(self) -> bool:
        """Whether anybody said that these readings are of this bench: else it stands in for theirs."""
        return self.why != _NONE_NAMED

    @property
    def learned_path(self) -> Path | None:
        """Where the learned file is that it names: beside it, or the run's copy of it; None where it names none."""
        if self.file.learned is None:
            return None
        own = Path(self.where)
        copy = own.with_name(LEARNED)
        return copy if own.name == BENCH and copy.is_file() else own.parent / self.file.learned

    def learned(self) -> LearnedFile | None:
        """Return what was learned of the bench, None where its file names none. Raises `FileMistakes`."""
        path = self.learned_path
        return None if path is None else load_learned(path, self.file)

    @property
    def words(self) -> str:
        """Which one it is, and why that one."""
        return f"{self.file.name}, {self.why}"

    @property
    def reason(self) -> str:
        """Why that one, with why the run had it."""
        return ": ".join(filter(None, (self.why, self.chosen)))

    def to_dict(self) -> dict[str, str]:
        """Return what a result says of it."""
        return {"name": self.file.name, "file": self.where, "why": self.reason, "sha256": self.sha256}


def bench_path(given: str | None) -> Path:
    """Return the bench file asked for (in BENCH_FILE, if not said), or the shipped one that stands in for it."""
    return find_bench(given or os.environ.get("BENCH_FILE") or DEFAULT_BENCH)


def why_taken(given: str | None) -> str:
    """Say why `bench_path` takes the bench file that it takes."""
    if given:
        return "as asked for"
    return "named by BENCH_FILE" if os.environ.get("BENCH_FILE") else _NONE_NAMED


def find_bench_file(given: str | BenchFile | BenchTaken | None) -> BenchTaken:
    """Return the bench file at hand or asked for, else that of BENCH_FILE, else the shipped one."""
    if isinstance(given, BenchTaken):
        return given
    if isinstance(given, BenchFile):
        return BenchTaken(given, given.name, sha256_of(given.model_dump_json().encode()), "as given")
    path = bench_path(given)
    return BenchTaken(load_bench(path), str(path), sha256_of(read_regular(path)), why_taken(given))


def bench_for_record(file: BenchFile, path: Path) -> dict[str, bytes]:
    """Return what a run keeps of a bench file: it, and what it names as learned. Raises `FileMistakes`."""
    taken = BenchTaken(file, str(path), "", "")
    kept = {BENCH: read_regular(path)}
    if taken.learned() is not None and taken.learned_path is not None:
        kept[LEARNED] = read_regular(taken.learned_path)
    return kept


def recorded_sha256(run: Run) -> str:
    """Return the SHA-256 of the bench file that a run recorded."""
    return sha256_of(read_regular(run.folder / BENCH))


def bench_of(
    name: str, run: Run | None, told: Told, given: str | BenchFile | None
) -> tuple[BenchTaken, tuple[str, ...]]:
    """Return the bench file for readings, with notes: the one asked for, else that which the run recorded.

    Readings that are no run have the one asked for, of BENCH_FILE, of which the file beside them tells (`told`), or
    the shipped one, in this order.
    """
    if run is not None:
        return _of_run(run, given)
    origin = told.origin
    if origin is None:
        return find_bench_file(given), told.notes
    meant = f"the bench file that {Path(name).name} was measured with ({origin.bench.file})"
    if given is not None or os.environ.get("BENCH_FILE"):
        taken = find_bench_file(given)
        other = taken.sha256 != origin.bench.sha256
        return taken, (f"evaluated with {taken.where} in place of {meant}",) if other else ()
    path = origin.bench_file(Path(name))
    if path is None:
        taken = find_bench_file(None)
        return taken, (
            f"{meant} is not here as it was (SHA-256 {origin.bench.sha256[:12]}…): taken is {taken.words}; name it "
            "with --bench",
        )
    why = f"as {Path(name).name}{SUFFIX} names it, of run {origin.run}"
    return BenchTaken(load_recorded_bench(path), str(path), origin.bench.sha256, why), ()


def _of_run(run: Run, given: str | BenchFile | None) -> tuple[BenchTaken, tuple[str, ...]]:
    if given is not None:
        taken = find_bench_file(given)
        return taken, (f"evaluated with {taken.where} in place of the bench file that the run recorded",)
    path = run.folder / BENCH
    recorded = load_recorded_bench(path)
    chosen = run.manifest.get("bench_why", "")
    return BenchTaken(recorded, str(path), recorded_sha256(run), "as the run recorded it", chosen), ()


def own_bench(run: Run) -> tuple[BenchFile, Path]:
    """Return the bench file that a run recorded, and where it was: a reference is named from there."""
    stated = Path(str(run.manifest.get("bench", "")))
    return load_recorded_bench(run.folder / BENCH), stated if stated.is_file() else run.folder / BENCH
