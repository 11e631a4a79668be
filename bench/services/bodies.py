"""Bodies of readings: sources that are diagnosed as one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.diagnosis.free_positions import all_free
from bench.readings.table import JoinedPart, together
from bench.services.errors import Refused
from bench.services.own_effects import knowing_effects_in
from bench.services.requests.diagnosis import Diagnose
from bench.services.source import Failed, Source, data_sha256, load_each, load_sources, reading

TOGETHER: Final = "diagnose-together"


@dataclass(frozen=True)
class Body:
    """Readings that are diagnosed as one: the `sources`, and all of them as one `source`.

    `nominal` (blocks, 3) are the scale factors of the data sheets where blocks of several kinds are in it. Free
    positions alone stay a table for each source: `one_block` says whether they are of one sensor.
    """

    sources: tuple[Source, ...]
    source: Source
    nominal: Floats | None = None
    one_block: bool | None = None

    @property
    def sha256(self) -> tuple[str, ...]:
        """The hashes of what it is made of."""
        return tuple(data_sha256(source.as_read) for source in self.sources)

    def output(self, suffix: str, number: int | None = None) -> Path:
        """Return the file that is written for it; of several sources for the one of this number."""
        if len(self.sources) == 1:
            return self.source.output("diagnose", suffix)
        place = place_together(self.sources) if number is None else self.sources[number]
        return place.output(TOGETHER, suffix)


def whole_body(request: Diagnose) -> Body:
    """Read the sources as one body. Raises `Refused` where they are not of one bench."""
    with knowing_effects_in(request.effects):
        return body_of(load_sources(reading(request, *request.sources)), request.one_block)


def single_bodies(request: Diagnose) -> list[Body | Failed]:
    """Read the sources, each by itself; what is wrong with one alone is raised."""
    with knowing_effects_in(request.effects):
        loaded = load_each(reading(request, *request.sources))
        return [one if isinstance(one, Failed) else body_of([one], request.one_block) for one in loaded]


def body_of(sources: list[Source], one_block: bool | None = None) -> Body:
    """Return the sources as one body of data: of `one_block`, or of a block each.

    Where nobody says (None), the names of the blocks tell, and where those do not, the readings will. Raises
    `Refused` where they are not of one bench.
    """
    first = sources[0]
    if len(sources) == 1 or all_free([source.readings for source in sources]):
        return Body(tuple(sources), first, None, one_block)
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
    return Body(tuple(sources), whole, nominal, one_block)


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
