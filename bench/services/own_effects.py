"""Effects that the user defined, for evaluations and runs; naming the unnamed terms of a model file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import yaml

from bench.base.yaml_files import FileMistakes
from bench.config.bench_file.file import BenchFile
from bench.config.formulas import effects_as_written, effects_in, effects_text, load_effects, written_formulas
from bench.config.model_file import accept, load_model, write_model_file
from bench.model import ForwardModel
from bench.model.effects import CATALOGUE
from bench.model.effects.base import PASS
from bench.run.folder import EFFECTS, Run
from bench.services.errors import Refused, refusing
from bench.services.requests.evaluation import Accept

if TYPE_CHECKING:
    from bench.services.source import Source


@contextmanager
def knowing_effects_of(*sources: Source) -> Iterator[None]:
    """Register the user's own effects of `sources` within a context."""
    with ExitStack() as known:
        try:
            known.enter_context(CATALOGUE.also(effect for source in sources for effect in source.effects))
        except ValueError as problem:
            raise Refused(f"{', '.join(source.name for source in sources)}: {problem}") from None
        yield


def knowing_effects_in(files: str | Path | Sequence[str | Path] | None) -> AbstractContextManager[None]:
    """Return a context in which the effects of files are registered. Raises `FileMistakes` with all mistakes."""
    return CATALOGUE.also(effects_in([files] if isinstance(files, str | Path) else files or ()))


def effects_for_record() -> dict[str, bytes]:
    """Return the file in which a run records the user's own effects, as {name: content}; {} without effects."""
    if not CATALOGUE.own:
        return {}
    return {
        EFFECTS: yaml.safe_dump(effects_text(CATALOGUE.own), sort_keys=False, allow_unicode=True).encode()
    }


def knowing_effects_on_record(run: Run) -> AbstractContextManager[None]:
    """Return a context with the effects recorded with a run. Raises `FileMistakes` for a file with mistakes."""
    file = run.folder / EFFECTS
    return CATALOGUE.also(load_effects(file) if file.is_file() else ())


def accept_terms(request: Accept) -> tuple[Path, Path]:
    """Write an effect file with the named terms, and a model file using it; return both. Raises `Refused`."""
    model, name = request.model, request.name
    file = load_model(model)
    if not request.sentence:
        raise Refused("--sentence: describe the effect in words, for reports")
    try:
        named, in_model = accept(file.applied_effects(), request.term or (), name, request.sentence)
        effect = replace(named, shown_by=request.shown_by or named.shown_by)
        if effects_as_written(written_formulas([effect])) != (effect,):
            raise Refused(f"--name {name}: expected up to 64 small letters, digits and _, a letter first")
        with CATALOGUE.also([effect]):
            pass
    except ValueError as problem:
        raise Refused(f"{model}: {problem}") from None
    place = request.out or model.with_name(f"{name}.yaml")
    beside = model.with_name(f"{model.stem}-{name}{model.suffix}")
    for path, other in ((place, "--out FILE"), (beside, "another --name")):
        if path.exists():
            raise Refused(f"{path}: this file exists and was not overwritten; give {other} or move it")
    effects = [replace(a, effect=effect) if a.effect is named else a for a in in_model]
    text = yaml.safe_dump(effects_text([effect]), sort_keys=False, allow_unicode=True)
    try:
        with refusing("give --out FILE"):
            place.write_text(text, "utf-8")
            write_model_file(
                beside, f"{file.parent} + {name}", effects, parent=file.parent, data_sha256=file.data_sha256,
                evidence=file.evidence, dark_uncertainty=file.dark_uncertainty,
            )  # fmt: skip
    except FileMistakes as mistakes:
        raise Refused(str(mistakes)) from None
    return place, beside


def simulated_truth(bench: BenchFile, model: Path | None) -> ForwardModel:
    """Return the true model of a simulated bench. Raises `Refused` for an effect that acts in single passes."""
    installations = bench.installation_models()
    effects = bench.applied_effects()
    if model is not None:
        effects += load_model(model, installations).applied_effects()
    for applied in effects:
        passes = [label for label in applied.installations if PASS in label]
        if passes:
            raise Refused(
                f"effect {applied.effect.name} of {', '.join(passes)}: the simulated bench cannot have an effect "
                f"in single passes; name installations without passes (such as '{passes[0].split(PASS)[0]}'), or "
                "remove the effect"
            )
    return ForwardModel(installations, effects)
