"""The result of diagnosing a record at a known input, and the files written from it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Self

from rich.console import Console

from bench.config.model_file import write_model_file
from bench.diagnosis.record_diagnosis import RecordDiagnosis
from bench.diagnosis.show import label
from bench.results import record_diagnosis as of_record
from bench.results.diagnosis_words import Files
from bench.services.body_results import ResultWithPage, by_unused_name
from bench.services.errors import Refused
from bench.services.source import provenance


@dataclass(frozen=True, repr=False)
class RecordDiagnosisResult(ResultWithPage):
    """The effects to which meters and reference respond in a record at a known input, and how well they predict
    held-out readings.
    """

    found: RecordDiagnosis

    @property
    def verdict(self) -> str:
        """One of agrees, named, confounded, unknown."""
        return self.found.verdict

    def to_dict(self) -> dict[str, Any]:
        """Return the result as `bench diagnose --json` writes it."""
        source = self.source
        return of_record.record_result(
            self.found, self.files, source.taken.part(), source.traced.parts(),
            simulated=source.simulated, skipped_rows=source.readings.skipped,
        ).to_dict()  # fmt: skip

    def html(self) -> str:
        """Return the HTML page."""
        title, told = f"Diagnosis of {self.source.name}", provenance(self.source)
        return of_record.render_record(self.found, self.files, title, told, simulated=self.source.simulated)

    def print_on(self, out: Console) -> None:
        """Print the diagnosis, the verdict last."""
        of_record.print_record(self.found, self.files, out)

    def _model_is_due(self, *, accept_first: bool) -> bool:
        return self.verdict == "named" or (accept_first and self.verdict == "confounded")

    def write_model(self, path: str | Path, *, accept_first: bool = False) -> Path:
        """Write the model file with the effects found; return its path. Raises `Refused`, `FileMistakes`."""
        if not self._model_is_due(accept_first=accept_first):
            raise Refused(
                f"{path}: not written, as no effect was named; --accept-first takes the first of several"
            )
        effects = (*self.source.model.effects, *self.found.applied)
        name = " + ".join([self.source.model.name, *map(label, self.found.applied)])
        evidence = of_record.evidence_in_words(self.found)
        write_model_file(
            Path(path), name, effects, parent=self.source.model.name, evidence=evidence,
            data_sha256=" ".join(self.body.sha256),
        )  # fmt: skip
        return Path(path)

    def written(self, *, accept_first: bool = False, report: bool = True) -> Self:
        """Write model and page; return the result with their paths."""
        result, file = self, self.body.output("-model.yaml")
        if self._model_is_due(accept_first=accept_first):
            write = partial(self.write_model, accept_first=accept_first)
            model, result = self.tried(str(file), partial(by_unused_name, file, write))
            result = replace(result, files=Files(models=() if model is None else (model,)))
        return result.with_report() if report else result
