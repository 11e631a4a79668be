"""Test of a model file on new readings: are its effects confirmed, changed or gone?"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Console

from bench.base.files import cache_folder
from bench.base.tables import as_text
from bench.config.model_file import load_model
from bench.diagnosis import ThresholdCache
from bench.diagnosis.confirm import Confirmation, confirm, confirm_free, confirm_record
from bench.diagnosis.free_records import OUTLIER, FreeDiagnosis
from bench.diagnosis.mistakes.search import Mistake
from bench.diagnosis.record_diagnosis import RecordDiagnosis
from bench.readings.table import all_free, is_record
from bench.results.confirm import confirm_result, print_confirmation
from bench.services.bodies import put_right
from bench.services.errors import Refused
from bench.services.own_effects import knowing_effects_of
from bench.services.source import Source, data_sha256


@dataclass(frozen=True)
class ConfirmationResult:
    """The result of `bench confirm`; `known` are mistakes from early warnings, corrected before the test."""

    source: Source
    found: Confirmation
    known: tuple[Mistake, ...]

    @property
    def closed(self) -> float | None:
        """The fraction of reduced chi-square above 1 that the effects remove; None without such an excess."""
        return self.found.closed

    @property
    def verdict(self) -> str:
        """The verdict: confirmed, changed or gone."""
        return self.found.verdict

    @property
    def confirmed(self) -> bool:
        """Whether the verdict is "confirmed": all effects that the readings can show are unchanged.

        They must also remove half of the excess of reduced chi-square, unless chance explains the rest.
        """
        return self.found.verdict == "confirmed"

    @property
    def mistakes(self) -> tuple[Mistake, ...]:
        """The mistakes that were corrected in a copy of the readings before the model was tested."""
        diagnosis = self.found.diagnosis
        return (
            self.known
            if isinstance(diagnosis, FreeDiagnosis | RecordDiagnosis)
            else (*self.known, *diagnosis.mistakes.mistakes)
        )

    @property
    def notes(self) -> Iterator[str]:
        """Yield the notes on these readings, a sentence each."""
        yield from (f"{one.name}: {one.words}; corrected in a copy" for one in self.mistakes)
        diagnosis = self.found.diagnosis
        if isinstance(diagnosis, FreeDiagnosis):
            yield from (f"{OUTLIER}: {words}" for words in diagnosis.apart)
        yield from diagnosis.notes

    def to_dict(self) -> dict[str, Any]:
        """Return the result as `bench confirm --json` writes it."""
        source = self.source
        return confirm_result(
            self.found,
            model=str(source.request.model),
            source=source.name,
            bench=source.taken.part(),
            corrections=source.traced.parts(),
            simulated=source.simulated,
            notes=list(self.notes),
        ).to_dict()

    def print_on(self, out: Console) -> None:
        """Print each effect's values in the model and in the new readings, and how far the misfit falls."""
        print_confirmation(self.source.name, self.found, list(self.notes), out)

    def __repr__(self) -> str:
        """Return the output of `bench confirm`, with the bench file that was used."""
        return f"{as_text(self.print_on)}\nbench: {self.source.taken.words}"


def confirmation_of(source: Source) -> ConfirmationResult:
    """Test the model of a source on its readings; the user's cache folder keeps the thresholds of the tests.

    Raises `Refused` if the model is missing, has no effects, or was found in these same readings. Raises
    `CalibrationError` if the readings do not determine the coefficients or could not show the effects.
    """
    path = source.request.model
    if path is None:
        raise Refused(
            "no model named; give the model to confirm with --model FILE ('bench diagnose' writes it)"
        )
    if not source.model.effects:
        raise Refused(
            f"--model {path}: the model has no effects to confirm; give a model that 'bench diagnose' wrote"
        )
    file = load_model(path, source.model.installations)
    if data_sha256(source.as_read) in (file.data_sha256 or "").split():
        raise Refused(
            f"--model {path}: the model was found in these same readings ({source.name}), which cannot confirm "
            "it; measure new readings"
        )
    if all_free([source.readings]):
        with knowing_effects_of(source):
            return ConfirmationResult(source, confirm_free([source.readings], source.model), ())
    if is_record(source.readings):
        return ConfirmationResult(source, confirm_record(source.readings, source.model.effects), ())
    bench = source.bench
    readings, known = put_right(source)
    found = confirm(
        readings,
        source.model,
        {name: spread.u for name, spread in bench.stand_distributions().items()},
        np.array(bench.unit_under_test.scale_factors.values) if readings.unit == "V" else None,
        ThresholdCache(cache_folder("thresholds")),
    )
    return ConfirmationResult(source, found, known)
