"""diagnose: where model and readings disagree, what is missing, the model with it, and how far the gap closes."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import count
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bench.base.computing import one_thread, tracked
from bench.cli import printing, progress
from bench.cli.options import (
    RUNS,
    BenchOption,
    GravityOption,
    JsonOption,
    ModelOption,
    OutOption,
    RunsOption,
    SkipOption,
    Sources,
    app,
)

if TYPE_CHECKING:
    from rich.console import Console

    from bench.diagnosis.full import FullDiagnosis, TooLittleLeft
    from bench.diagnosis.mistakes.search import Mistake
    from bench.readings.table import Readings
    from bench.services.diagnosis import Body
    from bench.services.source import Failed, Request, Source


@app.command(epilog="Example: bench diagnose unit-17 --json diagnosis.json")
def diagnose(
    sources: Sources,
    together: Annotated[
        bool, typer.Option("--together", help="Several sources are one body of data, of one bench.")
    ] = False,
    one_block: Annotated[
        bool | None,
        typer.Option(
            "--one-block/--a-block-each",
            help="With --together: whose runs they are (default: as names and readings say).",
        ),
    ] = None,
    accept_first: Annotated[
        bool,
        typer.Option(
            "--accept-first",
            help="Write the model also where the data cannot tell: with the likeliest effect.",
        ),
    ] = False,
    report: Annotated[
        bool | None,
        typer.Option(
            "--report/--no-report", help="Write the page (default: for one source, not for several)."
        ),
    ] = None,
    bench: BenchOption = None,
    model: ModelOption = None,
    g: GravityOption = None,
    json: JsonOption = None,
    out: OutOption = None,
    skip_bad_rows: SkipOption = False,
    strict: Annotated[bool, typer.Option("--strict", help="A discrepancy found is not accepted.")] = False,
    runs: RunsOption = RUNS,
) -> int:
    """Where readings and model disagree: name the missing effect, add it, show the gap shrink."""
    one_thread()
    from bench.cli.free import diagnosed_free
    from bench.diagnosis.full import TooLittleLeft
    from bench.services.free_diagnosis import free_sources
    from bench.services.source import Request, done, load_each, load_sources

    printing.check_target(json)
    request = Request(sources, runs, bench, model, g, out, skip_bad_rows)
    loaded: list[Source | Failed] = [*load_sources(request)] if together else load_each(request)
    if done(loaded) and free_sources(done(loaded)):
        free = diagnosed_free(
            loaded, json, together=together, one_block=one_block, accept_first=accept_first, report=report
        )
        if printing.failed(free):
            return 2
        return 1 if strict and any(one.verdict != "agrees" for one in done(free)) else 0
    try:
        results = diagnosed(
            request,
            json,
            loaded,
            together=together,
            one_block=one_block,
            accept_first=accept_first,
            report=report,
        )
    except TooLittleLeft as found:
        if len(sources) > 1:
            raise
        told(found, done(loaded)[0], json)
        return 1 if strict else 0
    if printing.failed(results):
        return 2
    return 1 if strict and any(one.diagnosis.verdict != "agrees" for one in done(results)) else 0


def told(found: TooLittleLeft, source: Source, target: str | None) -> None:
    """Print and write mistakes that leave too little to fit anything, and what they leave."""
    from bench.results.diagnosis.terminal import print_mistakes
    from bench.services.diagnosis import body_of

    found.copy = _written_copy(body_of([source]), found.mistakes, found.corrected)
    printing.write_json([found.to_dict(source.name)], target)
    print_mistakes(found, source.name, printing.console(json=target))


def diagnosed(
    request: Request,
    target: str | None,
    loaded: list[Source | Failed] | None = None,
    *,
    together: bool = False,
    one_block: bool | None = None,
    accept_first: bool = False,
    report: bool | None = None,
) -> list[FullDiagnosis | Failed]:
    """Diagnose the sources, each by itself or all `together`; print, write JSON to `target`, and return it.

    `loaded` are the sources where they have been read already.
    """
    from bench.services.diagnosis import body_of
    from bench.services.own_effects import knowing_effects_of
    from bench.services.source import Failed, check_places, done, load_sources

    printing.check_target(target)
    check_places(request)
    alone = together or len(request.sources) == 1
    out = printing.console(json=target)
    loaded = [*load_sources(request)] if loaded is None else loaded
    good = done(loaded)
    printing.bench_files(good, target)
    results: list[FullDiagnosis | Failed]
    with knowing_effects_of(*good):
        if alone:
            body = body_of(good, one_block=one_block)
            with progress.shown():
                results = [examined(body, accept_first=accept_first, report=report is not False)]
        else:
            with progress.shown():
                names = replace(request, sources=[source.name for source in good])
                found = list(_side_by_side(names, accept_first=accept_first, report=report is True))
            rest = iter(found)
            results = [one if isinstance(one, Failed) else next(rest) for one in loaded]
        printing.write_json([one.to_dict() for one in results], target)
        _print(done(results), out, alone=alone)
    return results


def _print(results: list[FullDiagnosis], out: Console, *, alone: bool) -> None:
    from bench.results.diagnosis.terminal import print_one, print_several

    if alone:
        print_one(results[0], out)
    elif results:
        print_several(results, out)


def _side_by_side(request: Request, *, accept_first: bool, report: bool) -> Iterator[FullDiagnosis | Failed]:
    """Diagnose each source in a process of its own kind, in the order given."""
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor

    work = partial(_one_of_several, request, accept_first=accept_first, report=report)
    workers = max(1, min(len(request.sources), os.cpu_count() or 1))
    # a fresh interpreter in every worker: a copy of this one would share its threads and locks
    fresh = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=fresh) as pool:
        try:
            yield from tracked(pool.map(work, request.sources), "sources", len(request.sources))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _one_of_several(
    request: Request, name: str, *, accept_first: bool, report: bool
) -> FullDiagnosis | Failed:
    from bench.config.formulas import effects_in, files_of_environment
    from bench.model import CATALOGUE
    from bench.services.diagnosis import body_of
    from bench.services.source import attempted, load_sources

    def work() -> FullDiagnosis:
        body = body_of(load_sources(replace(request, sources=[name])))
        return examined(body, accept_first=accept_first, report=report)

    with CATALOGUE.also(effects_in(files_of_environment())):
        return attempted(name, work)


# --- one body of readings ---------------------------------------------------------------------------


def examined(body: Body, *, accept_first: bool = False, report: bool = True) -> FullDiagnosis:
    """Diagnose a body of readings and write what is asked for, the procedure to carry out next in any case."""
    from bench.services.diagnosis import diagnosis_of

    full = diagnosis_of(body.source, body.nominal)
    mistakes = full.diagnosis.mistakes
    full = replace(full, copy=_written_copy(body, mistakes.mistakes, mistakes.corrected))
    verdict, shrinks = full.diagnosis.of_copy, full.diagnosis.gap.shrinks
    # what makes the gap no smaller is no better model, whoever accepts it
    form = full.diagnosis.form
    told = verdict == "named" or (accept_first and verdict == "confounded" and shrinks is not False)
    if told or (form is not None and form.applied):
        full = replace(full, model=_written_model(body, full))
    if full.next_measurement is not None:
        try:
            proposal = full.next_measurement.write(body.output("-next.yaml"))
            full = replace(full, next_measurement=proposal)
        except OSError as error:
            _not_written(body, "the next procedure", error)
    return replace(full, report=_written_report(body, full)) if report else full


def _written_copy(body: Body, mistakes: Sequence[Mistake], corrected: Readings) -> Path | None:
    """Write the readings with mistakes put right; None where there was none or it cannot be written."""
    from bench.base.files import write_whole

    files = body.copy_files(mistakes, corrected)
    try:
        for path, text in files.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, text)
    except OSError as error:
        _not_written(body, "the corrected copy of the readings", error)
        return None
    return next(iter(files), None)


def _written_model(body: Body, full: FullDiagnosis) -> Path | None:
    """Write the model with what was found; None where it cannot be written or nothing was added."""
    from bench.base.yaml_files import FileMistakes
    from bench.config.model_file import load_model, write_model_file
    from bench.results.diagnosis.words import evidence_in_words

    source, after = body.source, full.shown.after
    if after is None:
        return None
    file = source.request.model
    given = None if file is None else load_model(file, source.model.installations).data_sha256
    for path in unused(body.output("-model.yaml")):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_model_file(
                path,
                after.model.name,
                (
                    *after.effects[: len(source.model.effects)],
                    *full.diagnosis.applied,
                    *full.diagnosis.left_open,
                ),
                parent=source.model.name,
                data_sha256=" ".join(dict.fromkeys((*(given or "").split(), *body.sha256_with_copy(full)))),
                evidence=evidence_in_words(full),
                dark_uncertainty=_dark(full),
            )
        except FileMistakes:  # it was free a moment ago, and another program has it now
            continue
        except OSError as error:
            _not_written(body, str(path), error)
            return None
        return path
    return None


def _dark(full: FullDiagnosis) -> str | None:
    """Return what stays unexplained beside the terms of what has no name, as a model file says it."""
    form = full.diagnosis.form
    if form is None or not form.applied or not isfinite(form.dark.upper):
        return None
    if form.dark.there:
        return f"{form.dark.value:.3g} {form.unit} with u {form.dark.u:.2g} {form.unit}"
    return f"less than {form.dark.upper:.2g} {form.unit} (95 %)"


def unused(path: Path) -> Iterator[Path]:
    """Yield names that no file has: the path, then with a number from 2 on."""
    names = (path if n == 1 else path.with_name(f"{path.stem}-{n}{path.suffix}") for n in count(1))
    return (name for name in names if not name.exists())


def _written_report(body: Body, full: FullDiagnosis) -> Path | None:
    """Write the page; None where it cannot be written beside the source and nobody said where else."""
    from bench.services.diagnosis import diagnosis_page

    source, file = body.source, body.output(".html")
    asked = source.request.out is not None
    return file if printing.write_beside(file, diagnosis_page(source, full), asked=asked) else None


def _not_written(body: Body, what: str, error: OSError) -> None:
    not_written(what, error, asked=body.source.request.out is not None)


def not_written(what: str, error: OSError, *, asked: bool) -> None:
    """Say that a file is not written; raise `error` where its place was asked for."""
    if asked:
        raise error
    printing.notes_aside([f"{what} is not written ({error.strerror}); use --out DIR"])
