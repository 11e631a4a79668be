"""diagnose of free positions alone: what is printed and written of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from bench.cli import printing
from bench.cli.diagnose import not_written, unused

if TYPE_CHECKING:
    from bench.model import AppliedEffect
    from bench.services.free_diagnosis import FreeDiagnosisResult
    from bench.services.source import Failed, Source


def diagnosed_free(
    loaded: Sequence[Source | Failed],
    target: str | None,
    *,
    together: bool,
    one_block: bool | None,
    accept_first: bool,
    report: bool | None,
) -> list[FreeDiagnosisResult | Failed]:
    """Diagnose sources of free positions, each by itself or all `together`; print, write JSON to `target`."""
    from bench.services.free_diagnosis import free_diagnosis_of
    from bench.services.source import done, each

    printing.bench_files(done(loaded), target)
    page = (together or len(loaded) == 1) if report is None else report

    def diagnosed(body: list[Source]) -> FreeDiagnosisResult:
        result = free_diagnosis_of(body, one_block=one_block)
        result = replace(result, copies=dict(_copies(result)))
        result = replace(result, models=list(_models(result, accept_first=accept_first)))
        if page:
            file = result.output(".html")
            # the page names itself nowhere, so that it may be made before it is written
            written = printing.write_beside(file, result.html(), asked=_asked(result))
            result = replace(result, page=file if written else None)
        return result

    results: list[FreeDiagnosisResult | Failed]
    results = [diagnosed(done(loaded))] if together else each(loaded, lambda source: diagnosed([source]))
    printing.write_json([one.to_dict() for one in results], target)
    out = printing.console(json=target)
    for one in done(results):
        one.print_on(out)
    return results


def _asked(result: FreeDiagnosisResult) -> bool:
    return result.source.request.out is not None


def _copies(result: FreeDiagnosisResult) -> Iterator[tuple[int, Path]]:
    """Write the readings without what stands apart; yield which source, and the file."""
    from bench.readings.csv import format_csv

    for number, readings in result.corrected().items():
        path = result.output("-corrected.csv", number)
        if printing.write_beside(path, format_csv(readings), asked=_asked(result)):
            yield number, path


def _models(result: FreeDiagnosisResult, *, accept_first: bool) -> Iterator[Path]:
    """Write the model of each sensor, or one where all are alike."""
    models = result.models_of(accept_first=accept_first)
    for number, effects in enumerate(models, start=1):
        suffix = f"-model-sensor-{number}.yaml" if len(models) > 1 else "-model.yaml"
        path = _written(result, result.output(suffix), effects)
        if path is not None:
            yield path


def _written(result: FreeDiagnosisResult, first: Path, effects: tuple[AppliedEffect, ...]) -> Path | None:
    from bench.base.yaml_files import FileMistakes
    from bench.config.model_file import write_model_file

    for path in unused(first):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_model_file(
                path,
                result.name,
                effects,
                parent=result.source.model.name,
                data_sha256=" ".join(result.sha256),
                evidence=result.evidence(),
            )
        except FileMistakes:  # it was free a moment ago, and another program has it now
            continue
        except OSError as error:
            not_written(str(path), error, asked=_asked(result))
            return None
        return path
    return None
