"""The words of a certificate by language: each language is a file here, with the same keys."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Final

import yaml

_FOLDER: Final = Path(__file__).parent
LANGUAGES: Final = tuple(sorted(file.stem for file in _FOLDER.glob("*.yaml")))
"""The languages there are, by the code of ISO 639-1."""

_BLANK: Final = re.compile(r"\{([a-z_]+)\}")


@dataclass(frozen=True)
class Texts:
    """The words of one language by their keys; `{name}` in one is a blank."""

    language: str
    entries: Mapping[str, str]

    def say(self, key: str, **values: object) -> str:
        """Return a text with its blanks filled. Raises `KeyError` for an unknown key or a blank without value."""
        return _BLANK.sub(lambda blank: str(values[blank[1]]), self.entries[key])

    def with_own(self, own: Mapping[str, str]) -> Texts:
        """Return the texts with a laboratory's own in place of some."""
        return replace(self, entries={**self.entries, **own})


@cache
def texts_of(language: str) -> Texts:
    """Return the texts of a language of `LANGUAGES`."""
    written = yaml.safe_load((_FOLDER / f"{language}.yaml").read_text(encoding="utf-8"))
    return Texts(language, {str(key): str(text).strip() for key, text in written.items()})
