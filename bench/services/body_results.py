"""The common part of all results of diagnosing a body of readings, and the files that they write."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar

from rich.console import Console

from bench.base.files import write_whole
from bench.base.tables import as_text
from bench.base.text import visible
from bench.base.yaml_files import FileMistakes
from bench.diagnosis.mistakes.search import Mistake
from bench.diagnosis.next_measurement import Proposal
from bench.diagnosis.pipeline import FullDiagnosis, MistakesAlone
from bench.readings.corrected import as_read
from bench.readings.csv import format_csv
from bench.readings.table import Readings
from bench.results.diagnosis_words import NO_FILES, Files
from bench.run.events import writing
from bench.services.bench_selection import SUFFIX
from bench.services.bodies import Body
from bench.services.source import Source

if TYPE_CHECKING:
    from bench.diagnosis.free_records import FreeDiagnosis
    from bench.diagnosis.record_diagnosis import RecordDiagnosis

T = TypeVar("T")


@dataclass(frozen=True)
class BodyResult(ABC):
    """The result of diagnosing a body: findings, files written, and notes on files that could not be written."""

    body: Body
    found: FullDiagnosis | MistakesAlone | FreeDiagnosis | RecordDiagnosis
    files: Files = NO_FILES
    not_written: tuple[str, ...] = ()

    @property
    def source(self) -> Source:
        """The readings, the bench and the model."""
        return self.body.source

    @property
    def verdict(self) -> str:
        """The verdict: "mistake"; subclasses may return "agrees", "named", "confounded" or "unknown"."""
        return "mistake"

    @property
    def bench(self) -> str:
        """The name of the bench file that states gravity and the errors of the stand, and why it was chosen."""
        return self.source.taken.words

    @property
    def next_measurement(self) -> Proposal | None:
        """The measurement that is proposed next; None if none is proposed."""
        return None

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """Return the result as `bench diagnose --json` writes it, with the files that were written."""

    @abstractmethod
    def print_on(self, out: Console) -> None:
        """Print the diagnosis in the order in which it was made."""

    @abstractmethod
    def written(self, *, accept_first: bool = False, report: bool = True) -> Self:
        """Write all files of `bench diagnose`; return the result with their paths.

        With `accept_first`, the verdict "confounded" may give a model file, too, with the likeliest effect.
        `not_written` notes files that cannot be written; if `out` was requested, `OSError` is raised instead.
        """

    def __repr__(self) -> str:
        """Return the output of `bench diagnose`, with the bench file that was used."""
        return f"{as_text(self.print_on)}\nbench: {self.bench}"

    def tried(self, what: str, write: Callable[[], T]) -> tuple[T | None, Self]:
        """Call `write`; return its value and this result or, after an `OSError`, None and a result that notes it.

        `what` is the name of the file in the note. If an output folder was requested, `OSError` is raised.
        """
        try:
            return write(), self
        except OSError as error:
            if self.source.request.out is not None:
                raise
            note = f"{what} was not written ({error.strerror}); use --out DIR"
            return None, replace(self, not_written=(*self.not_written, note))

    def with_copy(self, mistakes: Sequence[Mistake], corrected: Readings) -> Self:
        """Write the `corrected` readings if there are `mistakes`; return the result with the path of that file."""
        if not mistakes:
            return self
        place = self.body.output("-corrected.csv")
        path, result = self.tried(
            "the corrected copy of the readings", lambda: write_copy(self.body, mistakes, corrected, place)
        )
        return result if path is None else replace(result, files=Files(copies=(path,)))


class ResultWithPage(BodyResult):
    """A result of a diagnosis that has an HTML page."""

    @abstractmethod
    def html(self) -> str:
        """Return the HTML page."""

    def report(self, path: str | Path) -> Path:
        """Write the self-contained HTML page; return its path. Raises `RecordError`."""
        with writing(path) as file:
            write_whole(file, self.html())
            return file

    def with_report(self) -> Self:
        """Write the page beside the other files; return the result with its path."""
        # the page does not contain its own path, so it can be rendered before it is written
        page, file = self.html(), self.body.output(".html")
        path, result = self.tried(str(file), lambda: write_content(file, page))
        return replace(result, files=replace(result.files, report=path))


# --- files ------------------------------------------------------------------------------------------


def write_content(path: Path, content: str) -> Path:
    """Write a text file, with its folder; return its path. Raises `OSError`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, content)
    return path


def write_copy(body: Body, mistakes: Sequence[Mistake], corrected: Readings, path: Path) -> Path:
    """Write readings free of mistakes and of instrument corrections, and any origin file; return the path."""
    source = body.source
    content = format_csv(as_read(corrected, source.traced.by))
    write_content(path, content)
    if source.origin is not None and len(body.sources) == 1:
        mended = tuple(visible(mistake.words) for mistake in mistakes)
        origin = source.origin.model_copy(update={"mended": (*source.origin.mended, *mended)})
        write_content(path.with_name(path.name + SUFFIX), origin.text_beside(path, content.encode()))
    return path


def by_unused_name(path: Path, write: Callable[[Path], object]) -> Path:
    """Write a file under an unused name: `path`, or `path` with a number from 2 on."""
    path.parent.mkdir(parents=True, exist_ok=True)
    for number in count(1):
        free_path = path if number == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}")
        if not free_path.exists():
            with suppress(FileMistakes):  # another program may have created it since
                write(free_path)
                return free_path
    raise AssertionError
