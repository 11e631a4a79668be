"""The user's own effects around an evaluation or a run: which are known, and what the record keeps of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import yaml

from bench.api.errors import Refused
from bench.files.formulas import effects_in, effects_text, load_effects
from bench.model import CATALOGUE
from bench.run.folder import EFFECTS, Run

if TYPE_CHECKING:
    from bench.api.source import Source


@contextmanager
def knowing_effects_of(*sources: Source) -> Iterator[None]:
    """Know the user's own effects of sources, while this lasts. Raises `Refused` where two of a name differ."""
    with ExitStack() as known:
        try:
            known.enter_context(CATALOGUE.also(effect for source in sources for effect in source.effects))
        except ValueError as problem:
            raise Refused(f"{', '.join(source.name for source in sources)}: {problem}") from None
        yield


def knowing_effects_in(files: str | Path | Sequence[str | Path] | None) -> AbstractContextManager[None]:
    """Know the effects in a file, or in several. Raises `FileMistakes` with every mistake in it."""
    return CATALOGUE.also(effects_in([files] if isinstance(files, str | Path) else files or ()))


def effects_for_record() -> dict[str, bytes]:
    """Return the file that a record keeps of the user's own effects; nothing where none is known."""
    if not CATALOGUE.own:
        return {}
    return {
        EFFECTS: yaml.safe_dump(effects_text(CATALOGUE.own), sort_keys=False, allow_unicode=True).encode()
    }


def knowing_effects_on_record(run: Run) -> AbstractContextManager[None]:
    """Know the user's own effects that a run was begun with. Raises `FileMistakes` where one differs by now."""
    file = run.folder / EFFECTS
    return CATALOGUE.also(load_effects(file) if file.is_file() else ())
