"""Diagnoses of bodies of readings, several of them in parallel, and the files written from them."""

from __future__ import annotations

import multiprocessing
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeAlias, TypeVar

import numpy as np
from rich.console import Console

from bench.base.computing import tracked
from bench.base.files import cache_folder, write_whole
from bench.base.languages import message
from bench.base.result_model import ResultModel
from bench.base.tables import as_text
from bench.base.text import visible
from bench.base.yaml_files import FileMistakes
from bench.calibration.result import CalibrationError
from bench.config.formulas import effects_in, files_of_environment
from bench.config.model_file import load_model, write_model_file
from bench.diagnosis.evidence import ThresholdCache
from bench.diagnosis.mistakes.search import Mistake, MistakesLeaveTooLittle
from bench.diagnosis.next_measurement import Proposal
from bench.diagnosis.pipeline import FullDiagnosis, MistakesAlone, diagnose_fully
from bench.diagnosis.result import Diagnosis, Findings
from bench.diagnosis.show import label
from bench.model import CATALOGUE, AppliedEffect
from bench.readings.corrected import as_read
from bench.readings.csv import format_csv
from bench.readings.table import Readings, all_free, is_record
from bench.results import diagnosis_words as words
from bench.results.diagnosis import print_several
from bench.results.diagnosis_words import NO_FILES, Files
from bench.run.events import writing
from bench.services.bench_selection import SUFFIX
from bench.services.bodies import Body, put_right, whole_body
from bench.services.errors import Refused
from bench.services.own_effects import knowing_effects_in, knowing_effects_of
from bench.services.requests.evaluation import Diagnose
from bench.services.source import Failed, Source, attempted, data_sha256, done, provenance

if TYPE_CHECKING:
    from bench.diagnosis.free_records import FreeDiagnosis
    from bench.diagnosis.record_diagnosis import RecordDiagnosis


T = TypeVar("T")


@dataclass(frozen=True)
class BodyResult(ABC):
    """The result of diagnosing a body: findings, files written, and notes on files that could not be written.

    The module `view` makes its JSON and its text.
    """

    view: ClassVar[str] = "bench.results.diagnosis"

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

    @property
    def _view(self) -> Any:
        return import_module(self.view)  # takes long to import

    @property
    def _simulated(self) -> bool:
        return any(source.simulated for source in self.body.sources)

    def to_dict(self) -> dict[str, Any]:
        """Return the result as `bench diagnose --json` writes it, with the files that were written."""
        sources = self.body.sources
        with knowing_effects_of(*sources):
            made: ResultModel = self._view.result_of(
                self.found,
                self.files,
                bench=self.source.taken.part(),
                corrections=[part for source in sources for part in source.traced.parts()],
                simulated=self._simulated,
                skipped_rows=[row for source in sources for row in source.readings.skipped],
            )
            return made.to_dict()

    def print_on(self, out: Console) -> None:
        """Print the diagnosis in the order in which it was made, the verdict last."""
        with knowing_effects_of(self.source):
            self._view.print_found(self.found, self.files, out)

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


# --- results ----------------------------------------------------------------------------------------


@dataclass(frozen=True, repr=False)
class MistakesResult(BodyResult):
    """A diagnosis that found mistakes and no more: the other readings do not determine the coefficients."""

    found: MistakesAlone

    def written(self, *, accept_first: bool = False, report: bool = True) -> Self:
        """Write the copy in which the mistakes are corrected; this result has neither model nor page."""
        return self.with_copy(self.found.mistakes, self.found.corrected)


@dataclass(frozen=True, repr=False)
class DiagnosisResult(ResultWithPage):
    """Where readings and model disagree, which effect is missing, and its test on held-out readings.

    result = bench.diagnose("unit-17")
    result.write_model("found.yaml")
    bench.confirm("unit-18", model="found.yaml").verdict
    """

    found: FullDiagnosis

    @property
    def diagnosis(self) -> Diagnosis:
        """The verdict and its evidence: patterns of residuals, effects, mistakes, and held-out readings."""
        return self.found.diagnosis

    @property
    def verdict(self) -> str:
        """Verdict: "agrees", "mistake", "named", "confounded" (several fit or none confirmed), "unknown"."""
        return self.diagnosis.verdict

    @property
    def next_measurement(self) -> Proposal | None:
        """The measurement that is proposed next; None if none is proposed."""
        return self.found.next_measurement

    def html(self) -> str:
        """Return the HTML page."""
        from bench.results.diagnosis_page import render_diagnosis

        source = self.source
        title, limit_g = (
            message(f"Diagnosis of {source.block_name or source.name}"),
            source.bench.verification.limit,
        )
        with knowing_effects_of(source):
            return render_diagnosis(self.found, self.files, title, limit_g, provenance(source))

    def model_is_due(self, *, accept_first: bool = False) -> bool:
        """Return whether a model can be written; `accept_first` permits one for the verdict "confounded"."""
        form = self.diagnosis.form
        there = _named(self.diagnosis, accept_first=accept_first) or (form is not None and form.applied)
        return bool(there) and self.found.shown.after is not None

    def write_model(self, path: str | Path, *, accept_first: bool = False) -> Path:
        """Write the model file with the effects found; return its path. Raises `Refused`, `FileMistakes`."""
        if not self.model_is_due(accept_first=accept_first):
            tied = self.diagnosis.of_copy == "confounded"
            why = (
                words.why_no_model(self.diagnosis)
                if tied
                else "without a named effect; measure what write_next writes"
                if self.next_measurement is not None
                else "without a named effect, and no further measurement is proposed"
            )
            raise Refused(f"{path}: no model file was written {why}")
        with knowing_effects_of(self.source):
            self._write_model(Path(path))
        return Path(path)

    def write_next(self, path: str | Path) -> Path:
        """Write the proposed procedure; return its path. Raises `Refused` if nothing is proposed."""
        if self.next_measurement is None:
            raise Refused(f"{path}: no procedure would show more; repeat the same one with more passes")
        return self.next_measurement.write(Path(path)).procedure

    def written(self, *, accept_first: bool = False, report: bool = True) -> Self:
        """Write corrected readings, model, next procedure and page; return the result with their paths."""
        mistakes, body = self.diagnosis.mistakes, self.body
        result = self.with_copy(mistakes.mistakes, mistakes.corrected)
        if self.model_is_due(accept_first=accept_first):
            file = body.output("-model.yaml")
            model, result = result.tried(str(file), partial(by_unused_name, file, result._write_model))
            models = () if model is None else (model,)
            result = replace(result, files=replace(result.files, models=models))
        if self.next_measurement is not None:
            write = partial(self.next_measurement.write, body.output("-next.yaml"))
            proposal, result = result.tried("the next procedure", write)
            if proposal is not None:
                result = replace(result, found=replace(self.found, next_measurement=proposal))
        return result.with_report() if report else result

    def _write_model(self, path: Path) -> None:
        source, after, found = self.source, self.found.shown.after, self.diagnosis
        assert after is not None  # noqa: S101 - who writes asks before
        given = source.request.model
        known = "" if given is None else load_model(given, source.model.installations).data_sha256 or ""
        hashes = [*known.split(), *self.body.sha256]
        if found.mistakes.mistakes:
            hashes.append(data_sha256(as_read(found.mistakes.corrected, source.traced.by)))
        write_model_file(
            path,
            after.model.name,
            (*after.effects[: len(source.model.effects)], *found.applied, *found.left_open),
            parent=source.model.name,
            data_sha256=" ".join(dict.fromkeys(hashes)),
            evidence=words.evidence_in_words(self.found, self.files.copy),
            dark_uncertainty=None if found.form is None else words.dark_for_model(found.form),
        )


@dataclass(frozen=True, repr=False)
class DiagnosisAlone(ResultWithPage):
    """A diagnosis of free positions alone, or of a record; module `view` makes its page, too."""

    found: FreeDiagnosis | RecordDiagnosis

    @property
    def verdict(self) -> str:
        """Verdict: "agrees", "mistake", "named", "confounded" (several fit or none confirmed), "unknown"."""
        return self.found.verdict

    def models_of(self, *, accept_first: bool = False) -> list[tuple[AppliedEffect, ...]]:
        """Return the effects of each model file to write: one, or one for each sensor; [] if none is due."""
        if not _named(self.found, accept_first=accept_first):
            return []
        return [(*self.source.model.effects, *added) for added in self.found.models]

    def html(self) -> str:
        """Return the HTML page."""
        title = message(f"Diagnosis of {self.source.block_name or words.readings_named(self.found.source)}")
        told = provenance(self.source)
        with knowing_effects_of(self.source):
            page: str = self._view.render(self.found, self.files, title, told, simulated=self._simulated)
            return page

    def write_models(self, path: str | Path, *, accept_first: bool = False) -> tuple[Path, ...]:
        """Write one model file or, if sensors differ, one for each sensor (`…-sensor-1`, …); return the paths.

        Raises `Refused` if there is no model to write, `FileMistakes` if a file exists.
        """
        models = self.models_of(accept_first=accept_first)
        if not models:
            raise Refused(f"{path}: no model file was written {words.why_no_model(self.found)}")
        place = Path(path)
        paths = [
            place.with_stem(f"{place.stem}-sensor-{n + 1}") if len(models) > 1 else place
            for n in range(len(models))
        ]
        for one, effects in zip(paths, models, strict=True):
            self._write_model(effects, one)
        return tuple(paths)

    def corrected(self) -> dict[int, Readings]:
        """Return the readings without outlying positions of each source that has any, by source number."""
        return {}

    def written(self, *, accept_first: bool = False, report: bool = True) -> Self:
        """Write copies, models and page; return the result with their paths."""
        result, copies, written = self, [], []
        for number, readings in self.corrected().items():
            place = self.body.output("-corrected.csv", number)
            path, result = result.tried(str(place), partial(write_content, place, format_csv(readings)))
            copies += [path] * (path is not None)
        models = self.models_of(accept_first=accept_first)
        for number, effects in enumerate(models, start=1):
            file = self.body.output(f"-model-sensor-{number}.yaml" if len(models) > 1 else "-model.yaml")
            write = partial(by_unused_name, file, partial(self._write_model, effects))
            path, result = result.tried(str(file), write)
            written += [path] * (path is not None)
        result = replace(result, files=Files(tuple(filter(None, copies)), tuple(filter(None, written))))
        return result.with_report() if report else result

    def _write_model(self, effects: tuple[AppliedEffect, ...], path: Path) -> None:
        given = self.source.model.name
        added = dict.fromkeys(label(one) for each in self.found.effects for one in each.applied)
        hashes = (*self.body.sha256, *(data_sha256(table) for table in self.corrected().values()))
        write_model_file(
            path, " + ".join([given, *added]), effects, parent=given, data_sha256=" ".join(hashes),
            evidence=self._view.evidence_in_words(self.found),
        )  # fmt: skip


class RecordDiagnosisResult(DiagnosisAlone):
    """The diagnosis of a record at a known input: effects on meters and reference, test on held-out parts."""

    found: RecordDiagnosis
    view = "bench.results.known_input"

    def write_model(self, path: str | Path, *, accept_first: bool = False) -> Path:
        """Write the model file with the effects found; return its path. Raises the errors of `write_models`."""
        return self.write_models(path, accept_first=accept_first)[0]


class FreeDiagnosisResult(DiagnosisAlone):
    """The diagnosis of free positions: misfit of the model, missing effect, test on held-out positions."""

    found: FreeDiagnosis
    view = "bench.results.free_diagnosis"
    write_model = DiagnosisAlone.write_models

    def corrected(self) -> dict[int, Readings]:
        """Return the readings without outlying positions of each source that has any, by source number."""
        kept = {}
        for number in np.unique(self.found.left_out[:, 0]).tolist():
            source = self.body.sources[number]
            left_out = self.found.left_out[self.found.left_out[:, 0] == number, 1]
            stay = ~np.isin(np.arange(len(source.readings)), left_out)
            kept[number] = as_read(source.readings.select(stay), source.traced.by)
        return kept


def _named(found: Findings, *, accept_first: bool) -> bool:
    """Return whether a model of the effect may be written.

    It may be for the verdict "named". With `accept_first`, it may be for "confounded", too, unless the gap is known
    not to shrink.
    """
    accepted = accept_first and found.of_copy == "confounded" and found.gap.shrinks is not False
    return found.of_copy == "named" or accepted


Diagnosed: TypeAlias = DiagnosisResult | DiagnosisAlone | MistakesResult


def print_diagnosed(results: Sequence[Diagnosed | Failed], out: Console) -> None:
    """Print each diagnosis in full; if there are several, print all of type `DiagnosisResult` in one table."""
    listed = [one for one in results if isinstance(one, DiagnosisResult)] if len(results) > 1 else []
    if listed:
        with knowing_effects_of(*(one.source for one in listed)):
            print_several([(one.found, one.files) for one in listed], out)
    for one in done(results):
        if one not in listed:
            one.print_on(out)


# --- diagnosing -------------------------------------------------------------------------------------


def diagnosed(request: Diagnose, bodies: Sequence[Body | Failed]) -> list[Diagnosed | Failed]:
    """Diagnose bodies, several in parallel, and write the requested files.

    Each of several bodies that cannot be diagnosed gives a `Failed`; a single body raises its error.
    """
    if len(bodies) == 1:
        return [diagnosed_alone(request, body) for body in done(bodies)]
    pairs = zip(request.sources, bodies, strict=True)
    rest = _side_by_side([replace(request, source=one) for one, body in pairs if isinstance(body, Body)])
    return [body if isinstance(body, Failed) else _rebuilt(body, next(rest)) for body in bodies]


def diagnosed_alone(request: Diagnose, body: Body, *, report: bool = True) -> Diagnosed:
    """Diagnose a body and write the requested files; `report` decides on a page if the request leaves it open.

    Raises `CalibrationError` if the readings do not determine the coefficients.
    """
    with knowing_effects_in(request.effects), knowing_effects_of(*body.sources):
        result = diagnosis_of(body)
        if not request.write:
            return result
        page = report if request.report is None else request.report
        return result.written(accept_first=request.accept_first, report=page)


def diagnosis_of(body: Body) -> Diagnosed:
    """Correct a body for mistakes named by the early warning, and diagnose it. Raises `CalibrationError`."""
    with knowing_effects_of(*body.sources):
        return _result(body, _found(body))


def _found(body: Body) -> FullDiagnosis | MistakesAlone | FreeDiagnosis | RecordDiagnosis:
    source = body.source
    if all_free([one.readings for one in body.sources]):
        from bench.diagnosis.free_positions import diagnose_free

        tables = [replace(one.readings, source=one.name) for one in body.sources]
        return diagnose_free(tables, body.one_block, source.model)
    if is_record(source.readings):
        from bench.diagnosis.record_diagnosis import diagnose_record

        return diagnose_record(source.readings)
    readings, known = put_right(source)
    try:
        return diagnose_fully(
            readings,
            source.model,
            source.bench,
            source.g_m_s2,
            ThresholdCache(cache_folder("thresholds")),
            source=source.name,
            simulated=source.simulated,
            known=known,
            stated=source.taken.stated,
            nominal=body.nominal,
        )
    except MistakesLeaveTooLittle as error:
        mistakes, readings, reason = (*known, *error.search.mistakes), error.search.corrected, error.reason
    except CalibrationError as error:
        if not known:
            raise
        mistakes, reason = known, str(error)
    return MistakesAlone(source.name, source.simulated, mistakes, readings, reason)


def _result(
    body: Body,
    found: FullDiagnosis | MistakesAlone | FreeDiagnosis | RecordDiagnosis,
    files: Files = NO_FILES,
    not_written: tuple[str, ...] = (),
) -> Diagnosed:
    if isinstance(found, FullDiagnosis):
        return DiagnosisResult(body, found, files, not_written)
    if isinstance(found, MistakesAlone):
        return MistakesResult(body, found, files, not_written)
    from bench.diagnosis.free_records import FreeDiagnosis

    kind = FreeDiagnosisResult if isinstance(found, FreeDiagnosis) else RecordDiagnosisResult
    return kind(body, found, files, not_written)


_Done = tuple[Any, Files, tuple[str, ...]]
"""The data passed between processes: the findings, the files, and the files that could not be written."""


def _rebuilt(body: Body, one: _Done | Failed) -> Diagnosed | Failed:
    return one if isinstance(one, Failed) else _result(body, *one)


def _side_by_side(requests: Sequence[Diagnose]) -> Iterator[_Done | Failed]:
    """Yield the outcome of each request in the order given; each is computed in a worker process."""
    workers = max(1, min(len(requests), os.cpu_count() or 1))
    # a fresh interpreter in every worker: a copy of this one would share its threads and locks
    fresh = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=fresh) as pool:
        try:
            yield from tracked(pool.map(_one_of_several, requests), "sources", len(requests))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _one_of_several(request: Diagnose) -> _Done | Failed:
    def work() -> _Done:
        result = diagnosed_alone(request, whole_body(request), report=False)
        return result.found, result.files, result.not_written

    with CATALOGUE.also(effects_in(files_of_environment())):
        return attempted(str(request.source), work)
