"""Free positions alone, diagnosed: what was found, and the texts of the files that may be written of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from bench.base.files import write_whole
from bench.base.tables import as_text
from bench.diagnosis.free_positions import all_free, diagnose_free
from bench.diagnosis.free_result import FreeDiagnosis
from bench.diagnosis.show import label
from bench.model import AppliedEffect
from bench.readings.corrected import as_read
from bench.readings.table import Readings
from bench.services.diagnosis import TOGETHER, place_together
from bench.services.own_effects import knowing_effects_of
from bench.services.source import Source, data_sha256, provenance


@dataclass(frozen=True)
class FreeDiagnosisResult:
    """Where free positions and model disagree, what is missing, and how far the gap closes with it.

    `sources` are the tables, each of one sensor in one record, `found` holds all that was found. `models`, `copies`
    and `page` are files that were written: a model of each sensor, or one where all are alike; copies without the
    positions that stand apart.
    """

    sources: Sequence[Source]
    found: FreeDiagnosis
    models: Sequence[Path] = ()
    copies: Mapping[int, Path] = field(default_factory=dict)
    page: Path | None = None

    @property
    def source(self) -> Source:
        """The first of the sources."""
        return self.sources[0]

    @property
    def verdict(self) -> str:
        """One of agrees, mistake, named, confounded, unknown."""
        return self.found.verdict

    @property
    def bench(self) -> str:
        """Which bench file was taken; and why that one."""
        return self.source.taken.words

    def output(self, suffix: str, source: int | None = None) -> Path:
        """Return the file that is written for it, or for one of the sources."""
        if len(self.sources) == 1:
            return self.source.output("diagnose", suffix)
        place = place_together(self.sources) if source is None else self.sources[source]
        return place.output(TOGETHER, suffix)

    def corrected(self) -> dict[int, Readings]:
        """Return the readings without the positions that stand apart, as read, by number of the source."""
        kept = {}
        for number in np.unique(self.found.left_out[:, 0]).tolist():
            source = self.sources[number]
            left_out = self.found.left_out[self.found.left_out[:, 0] == number, 1]
            stay = ~np.isin(np.arange(len(source.readings)), left_out)
            kept[number] = as_read(source.readings.select(stay), source.traced.by)
        return kept

    @property
    def sha256(self) -> tuple[str, ...]:
        """The hashes of what was searched, and of the copies without what stands apart."""
        tables = [*(source.as_read for source in self.sources), *self.corrected().values()]
        return tuple(data_sha256(table) for table in tables)

    @property
    def name(self) -> str:
        """What the model with what was found is called."""
        found = dict.fromkeys(label(one) for each in self.found.found for one in each.applied)
        return " + ".join([self.source.model.name, *found])

    def models_of(self, *, accept_first: bool = False) -> list[tuple[AppliedEffect, ...]]:
        """Return the effects of the model file of each sensor, of one where all are alike; none where none is due.

        What makes the gap no smaller is no better model, whoever accepts it.
        """
        found = self.found
        named = found.of_rest == "named"
        if not named and not (
            accept_first and found.of_rest == "confounded" and found.gap.shrinks is not False
        ):
            return []
        sensors = 1 if found.alike else found.rows.sensors
        return [
            (
                *self.source.model.effects,
                *(replace(one, installations=()) for one in found.applied_to(sensor)),
            )
            for sensor in range(sensors)
        ]

    def evidence(self) -> dict[str, str]:
        """Return what speaks for it, for the reader of the model file."""
        from bench.results.diagnosis import free_words

        found, gap = self.found, self.found.gap
        told = {"found in": free_words.named(found)}
        if found.apart:
            told["rests on"] = "; ".join(found.apart)
        for one in found.found:
            told[free_words.title(one)] = f"p {one.p_all_looks:.2g} with all looks, rho {one.rho:.1f}"
        told["gap"] = gap.reason or (
            f"reduced chi-square of positions held out {gap.before:.3f} before, {gap.after:.3f} after, "
            f"1 expected; root mean square of |a| - 1 g {1e6 * gap.before_rms:.3g} ug before, "
            f"{1e6 * gap.after_rms:.3g} ug after"
        )
        return told | {"threshold": f"ln odds {found.threshold:.3f}"}

    def to_dict(self) -> dict[str, Any]:
        """Return the result as `bench diagnose --json` writes it."""
        return self.found.to_dict() | {
            "model": str(self.models[0]) if self.models else None,
            "models": [str(path) for path in self.models],
            "report": None if self.page is None else str(self.page),
            "corrected": self._corrected(),
            "bench": self.source.taken.to_dict(),
            "corrections": [dict(one) for source in self.sources for one in source.traced.to_json()],
            "simulated": any(source.simulated for source in self.sources),
            "skipped_rows": [row for source in self.sources for row in source.readings.skipped],
        }

    def _corrected(self) -> dict[str, Any] | None:
        """Return what the rest without the positions that stand apart came to; None where there is none."""
        files = [str(path) for path in self.copies.values()]
        if not self.found.apart:
            return None
        return {
            "readings": files[0] if files else None,
            "files": files,
            "used": len(self.found.rows),
            "verdict": self.found.of_rest,
            "rests_on": list(self.found.apart),
        }

    def html(self) -> str:
        """Return the page."""
        from bench.results.diagnosis import free_words
        from bench.results.diagnosis.free_page import render_free

        title = f"Diagnosis of {self.source.block_name or free_words.named(self.found)}"
        with knowing_effects_of(self.source):
            return render_free(
                self.found,
                title,
                provenance(self.source),
                simulated=any(source.simulated for source in self.sources),
                models=[str(path) for path in self.models],
                copies=[str(path) for path in self.copies.values()],
            )

    def report(self, path: str | Path) -> None:
        """Write the page (HTML, with everything in it). Raises `OSError`."""
        write_whole(Path(path), self.html())

    def print_on(self, out: Console) -> None:
        """Print the diagnosis in the order in which it was made."""
        from bench.results.diagnosis.free_terminal import print_free

        files = [
            *(("corrected copy of the readings", path) for path in self.copies.values()),
            *(("model", path) for path in self.models),
            *([] if self.page is None else [("report", self.page)]),
        ]
        with knowing_effects_of(self.source):
            print_free(self.found, files, out)

    def __repr__(self) -> str:
        """Return what `bench diagnose` prints, and which bench file was taken."""
        return f"{as_text(self.print_on)}\nbench: {self.bench}"


def free_sources(sources: Sequence[Source]) -> bool:
    """Whether there are free positions and nothing else in these."""
    return all_free([source.readings for source in sources])


def free_diagnosis_of(sources: Sequence[Source], *, one_block: bool | None = None) -> FreeDiagnosisResult:
    """Diagnose free positions, each source one sensor in one record; all of `one_block`, or of a sensor each.

    Raises `CalibrationError` where the positions of a sensor do not determine its coefficients.
    """
    tables = [replace(source.readings, source=source.name) for source in sources]
    with knowing_effects_of(*sources):
        return FreeDiagnosisResult(tuple(sources), diagnose_free(tables, one_block, sources[0].model))
