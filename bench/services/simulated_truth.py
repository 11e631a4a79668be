"""What is true on the simulated bench: the effects that it has, or why it cannot have them."""

from __future__ import annotations

from pathlib import Path

from bench.config.bench_file.file import BenchFile
from bench.config.model_file import load_model
from bench.model import ForwardModel
from bench.model.effects.base import PASS
from bench.services.errors import Refused


def simulated_truth(bench: BenchFile, model: Path | None) -> ForwardModel:
    """Return the model that the simulated world obeys: effects of the bench file and of the model file.

    Raises `Refused` where one is of single passes: the world is read from outside, and knows of no pass.
    """
    installations = bench.installation_models()
    effects = bench.applied_effects()
    if model is not None:
        effects += load_model(model, installations).applied_effects()
    for applied in effects:
        passes = [label for label in applied.installations if PASS in label]
        if passes:
            raise Refused(
                f"effect {applied.effect.name} of {', '.join(passes)}: the simulated bench has effects of whole "
                "mountings and cannot have one of single passes; name the installations alone (such as "
                f"'{passes[0].split(PASS)[0]}'), or leave it out"
            )
    return ForwardModel(installations, effects)
