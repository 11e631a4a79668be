"""Where readings and model disagree, found in one body of readings; nothing is written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console

from bench.analysis.diagnosis import Diagnosis, ThresholdCache
from bench.analysis.diagnosis.full import FullDiagnosis, TooLittleLeft, diagnose_fully
from bench.analysis.mistakes.search import Mistake
from bench.api.early_mistakes import put_right
from bench.api.errors import Refused
from bench.api.origin import SUFFIX
from bench.api.own_effects import knowing_effects_of
from bench.api.provenance import provenance
from bench.api.source import Source, data_sha256
from bench.base.arrays import Floats
from bench.base.cache import cache_folder
from bench.base.tables import as_text
from bench.base.visible import visible
from bench.base.whole import write_whole
from bench.readings.corrected import as_read
from bench.readings.csv import format_csv
from bench.readings.joined import JoinedPart, together
from bench.readings.table import Readings

TOGETHER: Final = "diagnose-together"


@dataclass(frozen=True)
class Body:
    """A body of readings with the hashes of what it is made of, and the name of what is written for it.

    `nominal` (blocks, 3) are the scale factors of the data sheets where blocks of several kinds are in it. Of
    several sources `place` is the one beside which it is written.
    """

    source: Source
    sha256: tuple[str, ...]
    command: str = "diagnose"
    nominal: Floats | None = None
    place: Source | None = None

    def output(self, suffix: str) -> Path:
        """Return the file that is written for it."""
        return (self.place or self.source).output(self.command, suffix)

    def copy_files(self, mistakes: Sequence[Mistake], corrected: Readings) -> dict[Path, str]:
        """Return the readings file of the copy with mistakes put right, and the one that tells where it comes from.

        It reads, with the same bench file, to the very readings that were searched. Nothing where there was no
        mistake.
        """
        if not mistakes:
            return {}
        path = self.output("-corrected.csv")
        text = format_csv(as_read(corrected, self.source.traced.by))
        files = {path: text}
        if self.source.origin is not None and len(self.sha256) == 1:
            mended = tuple(visible(mistake.words) for mistake in mistakes)
            origin = self.source.origin.model_copy(update={"mended": (*self.source.origin.mended, *mended)})
            files[path.with_name(path.name + SUFFIX)] = origin.text_beside(path, text.encode())
        return files

    def sha256_with_copy(self, full: FullDiagnosis) -> tuple[str, ...]:
        """Return the hashes of what was searched: the body's, and that of the copy with mistakes put right."""
        copy = as_read(full.diagnosis.mistakes.corrected, self.source.traced.by)
        return self.sha256 if not full.diagnosis.mistakes.mistakes else (*self.sha256, data_sha256(copy))


@dataclass(frozen=True)
class DiagnosisResult:
    """Where readings and model disagree, what is missing, and how far the gap closes with it.

    `full` holds all that was found, `source` the readings, the bench and the model.
    """

    source: Source
    full: FullDiagnosis

    @property
    def diagnosis(self) -> Diagnosis:
        """The verdict with what speaks for it: places, effects, mistakes, the gap."""
        return self.full.diagnosis

    @property
    def verdict(self) -> str:
        """One of agrees, mistake, named, confounded, unknown."""
        return self.diagnosis.verdict

    @property
    def bench(self) -> str:
        """Which bench file gave the errors of the stand and gravity; and why that one."""
        return self.source.taken.words

    def to_dict(self) -> dict[str, Any]:
        """Return the result as `bench diagnose --json` writes it; no file was written, so it names none."""
        return self.full.to_dict()

    def report(self, path: str | Path) -> None:
        """Write the page (HTML, with everything in it). Raises `OSError`."""
        write_whole(Path(path), diagnosis_page(self.source, self.full))

    def print_on(self, out: Console) -> None:
        """Print the diagnosis in the order in which it was made."""
        from bench.report.diagnosis.terminal import print_one

        with knowing_effects_of(self.source):
            print_one(self.full, out)

    def __repr__(self) -> str:
        """Return what `bench diagnose` prints, and which bench file was taken."""
        return f"{as_text(self.print_on)}\nbench: {self.bench}"


def body_of(sources: list[Source], *, one_block: bool | None = None) -> Body:
    """Return the sources as one body of data: of `one_block`, or of a block each.

    Where nobody says (None), the names of the blocks tell, and where those do not, the readings will. Raises
    `Refused` where they are not of one bench.
    """
    hashes = tuple(data_sha256(source.as_read) for source in sources)
    first = sources[0]
    if len(sources) == 1:
        return Body(first, hashes)
    for source in sources[1:]:
        _require_same_bench(first, source)
    try:
        blocks = _blocks(sources, one_block)
        readings = together(
            [JoinedPart(s.readings, _began_s(s), block) for s, block in zip(sources, blocks, strict=True)]
        )
    except ValueError as problem:
        raise Refused(f"--together: {problem}") from problem
    # a model that was found in any of the sources has seen a part of the whole
    model = next((s.model for s in sources if not any(a.u for a in s.model.effects)), first.model)
    name = " + ".join(source.name for source in sources)
    entries = tuple(entry for source in sources for entry in source.traced.entries)
    own = tuple(dict.fromkeys(effect for source in sources for effect in source.effects))
    traced = replace(first.traced, entries=entries)
    whole = replace(first, readings=readings, model=model, name=name, traced=traced, effects=own)
    nominal = None
    if blocks[0] is not None:
        kinds = {n: s for n, s in zip(blocks, sources, strict=True) if n is not None}
        nominal = np.array([kinds[n].bench.unit_under_test.scale_factors.values for n in sorted(kinds)])
    return Body(whole, hashes, TOGETHER, nominal, place_together(sources))


def place_together(sources: Sequence[Source]) -> Source:
    """Return the first of several sources, by a name under which what is written of all of them stands."""
    first = sources[0]
    if len(sources) == 1:
        return first
    stem = Path(first.name).stem
    others = Path(sources[1].name).stem if len(sources) == 2 else f"{len(sources) - 1}-more"
    return replace(first, name=str(Path(first.name).parent / f"{stem}+{others}.csv"))


def _blocks(sources: list[Source], one_block: bool | None) -> list[int | None]:
    """Return the number of the block of each source; None for all where only the readings can tell."""
    if one_block is not None:
        return [0 if one_block else number for number in range(len(sources))]
    sheets = [tuple(source.bench.unit_under_test.scale_factors.values) for source in sources]
    names = [source.block_name for source in sources]
    told = list(zip(names, sheets, strict=True)) if all(names) else [("", sheet) for sheet in sheets]
    kinds = list(dict.fromkeys(told))
    return [kinds.index(one) for one in told] if len(kinds) > 1 else [None] * len(sources)


def _of_the_stand(source: Source) -> dict[str, float]:
    """Return the limits of the stand, in rad, without the noise in the unit of the signals."""
    return {name: u for name, u in source.stand_u.items() if name != "voltmeter_error"}


def _require_same_bench(first: Source, other: Source) -> None:
    one, two = first.model.installations, other.model.installations
    same = {
        "local gravity": first.g_m_s2 == other.g_m_s2,
        "limits of the stand": _of_the_stand(first) == _of_the_stand(other),
        "installations": one.keys() == two.keys()
        and all(np.allclose(one[name].block_from_platform, two[name].block_from_platform) for name in one),
    }
    different = [what for what, agrees in same.items() if not agrees]
    if different:
        raise Refused(
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


def diagnosis_of(source: Source, nominal: Floats | None = None) -> FullDiagnosis:
    """Diagnose a source with its own bench and model; thresholds are kept in the user's cache folder.

    `nominal` (blocks, 3) are the scale factors of several blocks, by default those of the bench file.

    What the early warning named while a run was taken is put right first. Raises `CalibrationError` where the
    readings do not determine the coefficients, `TooLittleLeft` where they would not without their mistakes.
    """
    readings, known = put_right(source)
    taken = source.taken.to_dict()
    try:
        with knowing_effects_of(source):
            full = diagnose_fully(
                readings,
                source.model,
                source.bench,
                source.g_m_s2,
                ThresholdCache(cache_folder("thresholds")),
                source=source.name,
                simulated=source.simulated,
                known=known,
                stated=source.taken.stated,
                nominal=nominal,
            )
    except TooLittleLeft as found:
        found.bench, found.corrections = taken, source.traced.to_json()
        raise
    return replace(full, bench=taken, corrections=source.traced.to_json())


def diagnosis_page(source: Source, full: FullDiagnosis) -> str:
    """Return the page of a diagnosis (HTML)."""
    from bench.report.diagnosis.page import render_diagnosis

    title = f"Diagnosis of {source.block_name or source.name}"
    with knowing_effects_of(source):
        return render_diagnosis(full, title, source.bench.verification_limit_g, provenance(source))
