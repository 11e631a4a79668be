"""The pages on effects and on model files, from the catalogue."""

from __future__ import annotations

from typing import Final

from pydantic import BaseModel

from bench.config.model_file import ModelFile
from bench.model.effects import CATALOGUE, Effect, Parameter, Stage
from docs.generators.forms import sections
from docs.generators.markdown import code, prose, table

ENTRY_TITLES: Final = {
    "EffectEntry": "Entry of effects",
    "FormulaEntry": "Entry of formulas",
    "FormulaParameter": "Parameter of a formula",
    "OpenShape": "Free part of a shape",
}

PARTS: Final = (
    "foundation", "building", "head", "shaft", "chamber", "supply", "voltmeters", "platform", "bracket", "block",
)  # fmt: skip
"""The parts of the bench that an effect names in `shows_on`, in the order of the page `stand.md`."""

_INTRODUCTION: Final = """\
# Effects

An effect is an error of a block, a stand, a voltmeter or a site that the paper's model does not contain. The
simulated bench applies effects (`simulation: effects` of a [bench file](bench-files.md)), a calibration fits
them (a [model file](model-files.md)), and `bench diagnose` searches for them and names them.

*Plausible* is the usual size of an effect, one standard deviation, before any reading. A *shape* is a time
constant or a period: readings are not linear in it, so a diagnosis tries the values listed. [Writing an
effect](../writing-an-effect.md) shows how to add one.

The effects act one after another, stage by stage.
"""

_MODEL_FILES: Final = """\
# Model files

A model file lists effects with their values. `bench diagnose` writes one; `calibrate`, `budget`, `run
--dry-run`, `simulate` and the next diagnosis use it (`--model FILE`). `bench calibrate` **fits** the sizes: a
value with `u` is the prior of its size, a value without `u` only a start (its prior is ten times the plausible
size). So give a known effect a small `u`. `bench confirm` and the simulation **keep** the values. The section
`simulation` of a bench file has the same lists `formulas`, `effects`, `left_open`. Write a parameter in any
unit of its dimension, one value for all channels or one for each; a shape has one value and no `u`:

```yaml
model_file: 1
name: unit-17
effects:
  - name: quadratic_nonlinearity
    channels: [x, z]
    parameters: {K2: {x: 60 ug/g^2, z: {value: -20 ug/g^2, u: 4 ug/g^2}}}
  - name: warm_up
    installations: ["1"]
    parameters: {A: 150 ug, tau: 20 min}
```

`installations` says which mountings have the effect: `2/3` is installation 2 in series 3, `2 pass 1` the first
pass in installation 2 (not on the simulated bench). Take names and parameters from the [effects](effects.md), or
from the file's own `formulas` ([writing an effect](../writing-an-effect.md)).
"""


def page() -> str:
    """Return the page on effects."""
    parts = [_INTRODUCTION]
    for stage in Stage:
        held = [effect for effect in CATALOGUE.values() if effect.stage is stage]
        parts.append(f"## Stage: {stage.value}")
        parts += [_section(effect) for effect in held]
    return "\n\n".join(parts)


def parts() -> str:
    """Return the table of the effects that show on each part of the bench."""
    named: dict[str, list[str]] = {part: [] for part in PARTS}
    for effect in CATALOGUE.values():
        for part in effect.shows_on:
            named[part].append(code(effect.name))
    return table(("part", "effects"), [(part, ", ".join(names)) for part, names in named.items()])


def _section(effect: Effect) -> str:
    first = f"{effect.sentence[:1].upper()}{effect.sentence[1:]}."
    facts = [("part", effect.subsystem.value), ("shown by", effect.shown_by), *_more(effect)]
    listed = "\n".join(f"- {name}: {text}" for name, text in facts)
    rows = [_row(parameter) for parameter in effect.parameters]
    head = ("parameter", "unit", "plausible", "for", "tried by a diagnosis")
    return f"### {effect.name}\n\n{first}\n\n{prose(type(effect))}\n\n{listed}\n\n{table(head, rows)}"


def _more(effect: Effect) -> list[tuple[str, str]]:
    facts = []
    if effect.per_mount:
        facts.append(
            ("mountings", "may begin in one and remain" if effect.lasts else "may act in a single one")
        )
    if effect.needs_history:
        facts.append(("order", "a reading depends on earlier readings"))
    if effect.needs_path:
        facts.append(("way", "a reading depends on the path of the head"))
    return facts


def _row(parameter: Parameter) -> tuple[str, ...]:
    def written(si: float) -> str:
        return f"{si / parameter.si_per_unit:.4g}"

    grid = ", ".join(map(written, parameter.grid))
    return (
        code(parameter.name),
        parameter.unit if parameter.unit != "1" else "–",
        f"a shape; default {written(parameter.default)}"
        if parameter.is_shape
        else "the state at the start of a mounting"
        if parameter.start_of
        else written(parameter.plausible),
        "each channel" if parameter.per_channel else "one for all",
        grid or "–",
    )


def model_files_page() -> str:
    """Return the page on model files."""
    return f"{_MODEL_FILES}\n{sections(ModelFile, _title)}"


def _title(model: type[BaseModel]) -> str:
    return "The file" if model is ModelFile else ENTRY_TITLES[model.__name__]
