"""diagnose: where model and readings disagree, what is missing, the model with it, and how far the gap closes."""

from __future__ import annotations

import math
import multiprocessing
import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs

from bench.analysis.diagnosis import Diagnosis, ThresholdCache
from bench.analysis.diagnosis import diagnose as examine
from bench.analysis.diagnosis.alternatives import Rival, rivals
from bench.analysis.diagnosis.next_measurement import propose
from bench.analysis.diagnosis.show import Shown, contradicted, label, show
from bench.base.forms import FileMistakes
from bench.cli import CommandError, diagnose_printing, printing
from bench.cli.source import (
    Request,
    Source,
    check_places,
    check_target,
    data_sha256,
    load_sources,
    write_beside,
    write_json,
)
from bench.files.model import ModelFile, load_model, write_model_file
from bench.model.block import COEFFICIENTS
from bench.readings.joined import JoinedPart, together


@dataclass(frozen=True)
class Options:
    """How to diagnose: several sources as one, the first of tied effects taken, a report written (None: of one)."""

    together: bool = False
    accept_first: bool = False
    report: bool | None = None
    strict: bool = False


@dataclass(frozen=True)
class Job:
    """A body of readings with the hashes of what it is made of, and the name of what is written for it."""

    source: Source
    sha256: tuple[str, ...]
    command: str = "diagnose"

    def output(self, suffix: str) -> Path:
        """Return the file that is written for it."""
        return self.source.output(self.command, suffix)


def diagnose(request: Request, options: Options, target: str | None) -> int:
    """Carry out `bench diagnose`; 1 with `strict` when something was found."""
    check_target(target)
    check_places(request)
    alone = options.together or len(request.sources) == 1
    if alone:
        job = _joined(load_sources(request))
        results = [examined(job, replace(options, report=options.report is not False))]
    else:
        results = list(_side_by_side(request, replace(options, report=options.report is True)))
    write_json(results, target)
    out = printing.console(json=target)
    if alone:
        diagnose_printing.one(results[0], out)
    else:
        diagnose_printing.several(results, out)
    found = any(result["verdict"] != "agrees" for result in results)
    return 1 if found and options.strict else 0


# --- several sources --------------------------------------------------------------------------------


def _side_by_side(request: Request, options: Options) -> Iterator[dict[str, Any]]:
    """Diagnose each source in a process of its own kind, in the order given."""
    work = partial(_one_of_several, request, options)
    workers = min(len(request.sources), os.cpu_count() or 1)
    # a fresh interpreter in every worker: a copy of this one would share its threads and locks
    fresh = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=fresh) as pool:
        try:
            yield from pool.map(work, request.sources)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _one_of_several(request: Request, options: Options, name: str) -> dict[str, Any]:
    (source,) = load_sources(replace(request, sources=[name]))
    return examined(_joined([source]), options)


def _joined(sources: list[Source]) -> Job:
    """Return the sources as one body of data. Raises `CommandError` where they are not of one bench."""
    hashes = tuple(data_sha256(source.readings) for source in sources)
    first = sources[0]
    if len(sources) == 1:
        return Job(first, hashes)
    for source in sources[1:]:
        _require_same_bench(first, source)
    try:
        readings = together([JoinedPart(source.readings, _began_s(source)) for source in sources])
    except ValueError as problem:
        raise CommandError(f"--together: {problem}") from problem
    # a model that was found in any of the sources has seen a part of the whole
    model = next((s.model for s in sources if not any(a.u for a in s.model.effects)), first.model)
    name = " + ".join(source.name for source in sources)
    return Job(replace(first, readings=readings, model=model, name=name), hashes, "diagnose-together")


def _require_same_bench(first: Source, other: Source) -> None:
    same = {
        "local gravity": first.g_m_s2 == other.g_m_s2,
        "limits of the stand": first.stand_u == other.stand_u,
        "installations": all(
            np.allclose(one.block_from_platform, other.model.installations[name].block_from_platform)
            for name, one in first.model.installations.items()
            if name in other.model.installations
        )
        and first.model.installations.keys() == other.model.installations.keys(),
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


# --- one body of data -------------------------------------------------------------------------------


def examined(job: Job, options: Options) -> dict[str, Any]:
    """Diagnose, write what is asked for, and return the result."""
    source = job.source
    nominal = np.array(source.bench.unit_under_test.scale_factors.values)
    diagnosis = examine(
        source.readings,
        source.model,
        source.stand_u,
        nominal if source.readings.unit == "V" else None,
        ThresholdCache(Path(platformdirs.user_cache_dir("triaxial-bench")) / "thresholds"),
    )
    corrected = diagnosis.mistakes.corrected
    shown = show(corrected, source.model, diagnosis.applied, source.stand_u, source.g_m_s2)
    ranked = rivals(diagnosis, source.stand_u["setting_error"])
    stated = contradicted(source.model.effects, shown.before.effects)
    diagnosis = replace(diagnosis, notes=(*diagnosis.notes, *stated))
    model = _written_model(job, diagnosis, shown, accept_first=options.accept_first)
    result = {
        **_without_infinity(diagnosis.to_json()),
        "next_measurement": _proposed(job, diagnosis),
        "model": None if model is None else str(model),
        "simulation": {
            "before": shown.before.to_json(),
            "after": None if shown.after is None else shown.after.to_json(),
        },
        "coefficients": _coefficients(shown),
        "ranking": [[rival.to_json() for rival in one] for one in ranked],
        "source": source.name,
        "simulated": source.simulated,
        "skipped_rows": list(source.readings.skipped),
        "report": None,
    }
    if options.report:
        result["report"] = _written_report(job, diagnosis, shown, ranked, result)
    return result


def _proposed(job: Job, diagnosis: Diagnosis) -> dict[str, Any] | None:
    """Return what to measure next with the procedure that was written for it; None where nothing would help."""
    proposal = propose(diagnosis, job.source.bench)
    if proposal is None:
        return None
    try:
        path = proposal.write(job.output("-next.yaml"))
    except OSError as error:
        if job.source.request.out is not None:
            raise
        print(f"note: the next procedure is not written ({error.strerror}); use --out DIR", file=sys.stderr)
        path = proposal.source
    return proposal.to_json(path)


def _coefficients(shown: Shown) -> dict[str, Any]:
    """Return the twelve coefficients as calibrate states them, by the model before and after."""
    before = shown.before.calibration
    after = before if shown.after is None else shown.after.calibration
    return {
        name: {"before": float(b), "u_before": float(ub), "after": float(a), "u_after": float(ua)}
        for name, b, ub, a, ua in zip(
            COEFFICIENTS, before.block.vector, before.u, after.block.vector, after.u, strict=True
        )
    }


def _without_infinity(told: Any) -> Any:
    """Return the same with null for what is no finite number: JSON has none."""
    if isinstance(told, Mapping):
        return {key: _without_infinity(value) for key, value in told.items()}
    if isinstance(told, list | tuple):
        return [_without_infinity(value) for value in told]
    return None if isinstance(told, float) and not math.isfinite(told) else told


# --- the model with what was found ------------------------------------------------------------------


def _written_model(job: Job, diagnosis: Diagnosis, shown: Shown, *, accept_first: bool) -> Path | None:
    """Write the model file where the verdict allows one; None where not."""
    allowed = {"named", "confounded"} if accept_first else {"named"}
    if diagnosis.verdict not in allowed or shown.after is None:
        return None
    source = job.source
    given = _given_model(source)
    known = () if given is None or given.data_sha256 is None else given.data_sha256.split()
    estimated = shown.after.effects[: len(source.model.effects)]
    for path in _free_files(job.output("-model.yaml")):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_model_file(
                path,
                shown.after.model.name,
                (*estimated, *diagnosis.applied),
                parent=source.model.name,
                data_sha256=" ".join(dict.fromkeys((*known, *job.sha256))),
                evidence=_evidence(source, diagnosis, shown),
            )
        except FileMistakes:  # it was free a moment ago, and another program has it now
            continue
        except OSError as error:
            if source.request.out is not None:
                raise
            print(f"note: {path} is not written ({error.strerror}); use --out DIR", file=sys.stderr)
            return None
        return path
    return None


def _given_model(source: Source) -> ModelFile | None:
    path = source.request.model
    return None if path is None else load_model(path, source.model.installations)


def _free_files(path: Path) -> Iterable[Path]:
    """Yield names that no file has: the path, then with a number from 2 on."""
    names = (path if n == 1 else path.with_name(f"{path.stem}-{n}{path.suffix}") for n in count(1))
    return (name for name in names if not name.exists())


def _evidence(source: Source, diagnosis: Diagnosis, shown: Shown) -> dict[str, str]:
    """Return what speaks for each effect and for the whole, for the reader of the model file."""
    told = {"found in": source.name}
    for effect, found in zip(diagnosis.effects, diagnosis.naming.found, strict=False):
        text = (
            f"ln odds {found.evidence:.2f}, p {effect.p_all_looks:.2g} with all looks, rho {effect.rho:.1f}"
        )
        if effect.cannot_tell_from:
            text += f"; the data cannot tell it from {', '.join(effect.cannot_tell_from)}"
        if effect.plainer_than:
            text += f"; plainer than {', '.join(effect.plainer_than)}"
        told[label(effect.applied[0])] = text
    gap = diagnosis.gap
    told["gap"] = "no readings could be held out that would confirm it"
    if gap.opened:
        told["gap"] = (
            f"reduced chi-square of readings held out {gap.before:.3f} before, {gap.after:.3f} after, "
            f"1 expected; p after {gap.p_after:.2g}"
        )
    if shown.after is not None:
        told["simulation"] = f"p of the readings beside the model {shown.after.test.p:.2g}"
    told["threshold"] = f"ln odds {diagnosis.registered['threshold']:.3f}"
    told["registered"] = str(diagnosis.registered["sha256"])
    return told


# --- the report -------------------------------------------------------------------------------------


def _written_report(
    job: Job,
    diagnosis: Diagnosis,
    shown: Shown,
    ranked: tuple[tuple[Rival, ...], ...],
    result: Mapping[str, Any],
) -> str | None:
    """Write the page; None where it cannot be written beside the source and nobody said where else."""
    from bench.cli.provenance import provenance
    from bench.report.diagnosis.page import DiagnosisContent, render_diagnosis

    source = job.source
    content = DiagnosisContent(
        title=f"Diagnosis of {source.block_name or source.name}",
        result=result,
        diagnosis=diagnosis,
        shown=shown,
        ranked=ranked,
        limit_g=source.bench.verification_limit_g,
        provenance=provenance(source),
    )
    file = job.output(".html")
    written = write_beside(file, render_diagnosis(content), asked=source.request.out is not None)
    return str(file) if written else None
