"""Terms without a name get one: the effect is written as a formula of the user's own, the model with it beside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import yaml

from bench.api.errors import Refused
from bench.base.forms import FileMistakes
from bench.files.accepting import accept
from bench.files.formulas import effects_as_written, effects_text, written_formulas
from bench.files.model import load_model, write_model_file
from bench.model import CATALOGUE


@dataclass(frozen=True)
class Written:
    """The files that were written."""

    effects: Path
    model: Path


def accept_terms(
    model: Path,
    name: str,
    sentence: str,
    *,
    terms: Sequence[str] = (),
    shown_by: str | None = None,
    out: Path | None = None,
) -> Written:
    """Write the effect of this name, and the model with it in place of the terms. Raises `Refused`, `FileMistakes`.

    Nothing is overwritten.
    """
    file = load_model(model)
    try:
        accepted = accept(file.applied_effects(), terms, name, sentence)
        effect = replace(accepted.effect, shown_by=shown_by or accepted.effect.shown_by)
        if effects_as_written(written_formulas([effect])) != (effect,):
            raise ValueError(f"--name {name}: expected small letters, digits and _, a letter first")
        with CATALOGUE.also([effect]):
            pass
    except ValueError as problem:
        raise Refused(f"{model}: {problem}") from None
    place = out or model.with_name(f"{name}.yaml")
    beside = model.with_name(f"{model.stem}-{name}{model.suffix}")
    for path in (place, beside):
        if path.exists():
            raise Refused(
                f"{path}: a file of that name is there and is not overwritten; say --out FILE or move it"
            )
    effects = [replace(a, effect=effect) if a.effect is accepted.effect else a for a in accepted.effects]
    try:
        place.write_text(yaml.safe_dump(effects_text([effect]), sort_keys=False, allow_unicode=True), "utf-8")
        write_model_file(
            beside,
            f"{file.parent} + {name}",
            effects,
            parent=file.parent,
            data_sha256=file.data_sha256,
            evidence=file.evidence,
            dark_uncertainty=file.dark_uncertainty,
        )
    except OSError as error:
        raise Refused(f"{error.filename}: it cannot be written ({error.strerror}); say --out FILE") from None
    except FileMistakes as mistakes:
        raise Refused(str(mistakes)) from None
    return Written(place, beside)
