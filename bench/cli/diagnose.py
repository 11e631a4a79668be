"""diagnose: where model and readings disagree, what is missing, the model with it, and how far the gap closes."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from bench.cli import CommandError
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
    from bench.analysis.diagnosis.full import FullDiagnosis
    from bench.cli.source import Request, Source

THREADS: Final = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
"""Where the libraries of linear algebra look for the number of their threads."""


@app.command(epilog="Example: bench diagnose unit-17 --json diagnosis.json")
def diagnose(
    sources: Sources,
    together: Annotated[
        bool, typer.Option("--together", help="Several sources are one body of data: one block, one bench.")
    ] = False,
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
    # many small matrices: the threads of a linear algebra library would wait for one another
    for name in THREADS:
        os.environ.setdefault(name, "1")
    from bench.cli.source import Request

    request = Request(sources, runs, bench, model, g, out, skip_bad_rows)
    results = diagnosed(request, json, together=together, accept_first=accept_first, report=report)
    return 1 if strict and any(one.diagnosis.verdict != "agrees" for one in results) else 0


def diagnosed(
    request: Request,
    target: str | None,
    *,
    together: bool = False,
    accept_first: bool = False,
    report: bool | None = None,
) -> list[FullDiagnosis]:
    """Diagnose the sources, each by itself or all `together`; print, write JSON to `target`, and return it."""
    from bench.cli import printing
    from bench.cli.source import check_places, check_target, load_sources, write_json
    from bench.report.diagnosis.terminal import print_one, print_several

    check_target(target)
    check_places(request)
    alone = together or len(request.sources) == 1
    if alone:
        body = _body(load_sources(request))
        results = [examined(body, accept_first=accept_first, report=report is not False)]
    else:
        results = list(_side_by_side(request, accept_first=accept_first, report=report is True))
    write_json([one.to_dict() for one in results], target)
    out = printing.console(json=target)
    if alone:
        print_one(results[0], out)
    else:
        print_several(results, out)
    return results


def _side_by_side(request: Request, *, accept_first: bool, report: bool) -> Iterator[FullDiagnosis]:
    """Diagnose each source in a process of its own kind, in the order given."""
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor

    work = partial(_one_of_several, request, accept_first=accept_first, report=report)
    workers = min(len(request.sources), os.cpu_count() or 1)
    # a fresh interpreter in every worker: a copy of this one would share its threads and locks
    fresh = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=fresh) as pool:
        try:
            yield from pool.map(work, request.sources)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _one_of_several(request: Request, name: str, *, accept_first: bool, report: bool) -> FullDiagnosis:
    from bench.cli.source import load_sources

    body = _body(load_sources(replace(request, sources=[name])))
    return examined(body, accept_first=accept_first, report=report)


# --- one body of readings ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Body:
    """A body of readings with the hashes of what it is made of, and the name of what is written for it."""

    source: Source
    sha256: tuple[str, ...]
    command: str = "diagnose"

    def output(self, suffix: str) -> Path:
        """Return the file that is written for it."""
        return self.source.output(self.command, suffix)

    def not_written(self, what: str, error: OSError) -> None:
        """Say that a file is not written; raise `error` where its place was asked for."""
        if self.source.request.out is not None:
            raise error
        print(f"note: {what} is not written ({error.strerror}); use --out DIR", file=sys.stderr)


def _body(sources: list[Source]) -> Body:
    """Return the sources as one body of data. Raises `CommandError` where they are not of one bench."""
    from bench.cli.source import data_sha256
    from bench.readings.joined import JoinedPart, together

    hashes = tuple(data_sha256(source.readings) for source in sources)
    first = sources[0]
    if len(sources) == 1:
        return Body(first, hashes)
    for source in sources[1:]:
        _require_same_bench(first, source)
    try:
        readings = together([JoinedPart(source.readings, _began_s(source)) for source in sources])
    except ValueError as problem:
        raise CommandError(f"--together: {problem}") from problem
    # a model that was found in any of the sources has seen a part of the whole
    model = next((s.model for s in sources if not any(a.u for a in s.model.effects)), first.model)
    name = " + ".join(source.name for source in sources)
    return Body(replace(first, readings=readings, model=model, name=name), hashes, "diagnose-together")


def _require_same_bench(first: Source, other: Source) -> None:
    import numpy as np

    one, two = first.model.installations, other.model.installations
    same = {
        "local gravity": first.g_m_s2 == other.g_m_s2,
        "limits of the stand": first.stand_u == other.stand_u,
        "installations": one.keys() == two.keys()
        and all(np.allclose(one[name].block_from_platform, two[name].block_from_platform) for name in one),
        "scale factors": first.bench.unit_under_test.scale_factors
        == other.bench.unit_under_test.scale_factors,
    }
    different = [what for what, agrees in same.items() if not agrees]
    if different:
        raise CommandError(
            f"--together: {other.name} has another bench than {first.name} ({', '.join(different)}); say with "
            "--bench FILE which one holds for both"
        )


def _began_s(source: Source) -> float | None:
    """Return when the clock of a run began, s; None for a readings file, which does not say."""
    if source.run is None or source.run.imported:
        return None
    try:
        return datetime.fromisoformat(source.run.created).timestamp()
    except ValueError:
        return None


def examined(body: Body, *, accept_first: bool = False, report: bool = True) -> FullDiagnosis:
    """Diagnose a body of readings and write what is asked for, the procedure to carry out next in any case."""
    import platformdirs

    from bench.analysis.diagnosis import ThresholdCache
    from bench.analysis.diagnosis.full import diagnose_fully

    source = body.source
    full = diagnose_fully(
        source.readings,
        source.model,
        source.bench,
        source.g_m_s2,
        ThresholdCache(Path(platformdirs.user_cache_dir("triaxial-bench")) / "thresholds"),
        source=source.name,
        simulated=source.simulated,
    )
    if full.diagnosis.verdict in ({"named", "confounded"} if accept_first else {"named"}):
        full = replace(full, model=_written_model(body, full))
    if full.next_measurement is not None:
        try:
            proposal = full.next_measurement.write(body.output("-next.yaml"))
            full = replace(full, next_measurement=proposal)
        except OSError as error:
            body.not_written("the next procedure", error)
    return replace(full, report=_written_report(body, full)) if report else full


def _written_model(body: Body, full: FullDiagnosis) -> Path | None:
    """Write the model with what was found; None where it cannot be written or nothing was added."""
    from bench.base.forms import FileMistakes
    from bench.files.model import load_model, write_model_file
    from bench.report.diagnosis.words import evidence_in_words

    source, after = body.source, full.shown.after
    if after is None:
        return None
    file = source.request.model
    given = None if file is None else load_model(file, source.model.installations).data_sha256
    for path in _free_files(body.output("-model.yaml")):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_model_file(
                path,
                after.model.name,
                (*after.effects[: len(source.model.effects)], *full.diagnosis.applied),
                parent=source.model.name,
                data_sha256=" ".join(dict.fromkeys((*(given or "").split(), *body.sha256))),
                evidence=evidence_in_words(full),
            )
        except FileMistakes:  # it was free a moment ago, and another program has it now
            continue
        except OSError as error:
            body.not_written(str(path), error)
            return None
        return path
    return None


def _free_files(path: Path) -> Iterator[Path]:
    """Yield names that no file has: the path, then with a number from 2 on."""
    names = (path if n == 1 else path.with_name(f"{path.stem}-{n}{path.suffix}") for n in count(1))
    return (name for name in names if not name.exists())


def _written_report(body: Body, full: FullDiagnosis) -> Path | None:
    """Write the page; None where it cannot be written beside the source and nobody said where else."""
    from bench.cli.provenance import provenance
    from bench.cli.source import write_beside
    from bench.report.diagnosis.page import render_diagnosis

    source, file = body.source, body.output(".html")
    title = f"Diagnosis of {source.block_name or source.name}"
    page = render_diagnosis(full, title, source.bench.verification_limit_g, provenance(source))
    return file if write_beside(file, page, asked=source.request.out is not None) else None
