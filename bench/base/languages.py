"""Languages of pages and prompts: texts are made in English, and a view translates them when it shows them.

Results, records and JSON therefore stay English, and the page of an old record can be in another language.
`message` marks a text in the code. The values of an f-string become numbered blanks: `message(f"{n} rows")` is the
entry "{0} rows" of the catalogue (`catalogues/uk.po`). A view calls `translated`, which finds the entry of a text
whose blanks are already filled. Values that are texts are translated as well, and numbers get the decimal sign of
the language. Templates are translated as a whole (`bench.base.template_texts`).
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import cache, lru_cache, partial
from gettext import GNUTranslations, NullTranslations
from importlib.resources import files
from io import BytesIO
from typing import Final

from drivers.interfaces import message as message  # noqa: PLC0414 - other modules take it from here

ENGLISH: Final = "en"
LANGUAGES: Final = {ENGLISH: "English", "uk": "Українська"}
"""The languages of pages and prompts, by ISO 639-1 code, with their own names."""

ENVIRONMENT: Final = "BENCH_LANGUAGE"

HEADING: Final = "heading"
"""Context of headings of tables and of progress: words that elsewhere may be keys or names, which stay."""

_chosen: ContextVar[str | None] = ContextVar("language", default=None)


def language() -> str:
    """Return the current language of pages and prompts.

    `speaking` or `speak` sets it. Otherwise it is the language in `BENCH_LANGUAGE`, by default English.
    """
    return _chosen.get() or known_language(os.environ.get(ENVIRONMENT, "")) or ENGLISH


@lru_cache(64)  # each text of a page asks
def known_language(name: str) -> str:
    """Return the code of the language in a name such as "uk_UA.UTF-8"; empty if it is not one of `LANGUAGES`."""
    code = re.split(r"[-_.]", name.strip().lower())[0]
    return code if code in LANGUAGES else ""


def speak(name: str | None) -> None:
    """Set the current language of pages and prompts; None leaves it unchanged.

    Raises `ValueError` for an unknown language.
    """
    if name is not None:
        if not known_language(name):
            raise ValueError(f"language {name!r}: choose one of {', '.join(LANGUAGES)}")
        _chosen.set(known_language(name))


@contextmanager
def speaking(name: str | None) -> Iterator[None]:
    """Set the current language within the context; None leaves it unchanged.

    Raises `ValueError` for an unknown language.
    """
    token = _chosen.set(_chosen.get())
    try:
        speak(name)
        yield
    finally:
        _chosen.reset(token)


def translated(text: str, context: str = "") -> str:
    """Return a text of the program in the current language; a text without a translation is returned unchanged.

    `context` distinguishes texts that are equal in English, such as "pass" (a verdict, a round).
    """
    name = language()
    return text if name == ENGLISH else catalogue(name).translate(text, context)


def shown(value: object) -> object:
    """Return a value as a page shows it: numbers with the local decimal sign, a text of several words translated.

    A single word is returned unchanged, because it may be a name; `translated` also translates single words.
    """
    name = language()
    if name == ENGLISH or hasattr(value, "__html__") or not isinstance(value, str | float):
        return value
    text = str(value)
    if " " in text.strip() and not is_numeric(text):
        return catalogue(name).translate(text)
    return catalogue(name).number(text) if is_numeric(text) else value


# --- numbers in texts --------------------------------------------------------------------------------

_DECIMAL: Final = re.compile(r"(?<![\w.])(\d+)\.(\d+)(?!\.?\d)(?![a-df-zA-DF-Z_])")
_WORDS: Final = re.compile(r"[^\W\d_²³]+")
_UNITS: Final = frozenset({
    *"VgmshdAKCWkpuUnerσχxyz", "Δg", "mV", "µV", "nV", "mg", "µg", "ng", "ms", "min", "°C", "mA", "kHz", "Hz",
    "ppm", "kB", "MB", "GB", "rad", "mrad", "µrad", "arcsec", "mm", "µm", "counts",
    "bx", "by", "bz",  # the intrinsic biases, beside their values
})  # fmt: skip


def is_numeric(text: str) -> bool:
    """Return whether a text consists of numbers, signs and units only, such as "−2.177(16) V/g"."""
    return bool(_DECIMAL.search(text)) and all(word in _UNITS for word in _WORDS.findall(text))


def local_number(text: str) -> str:
    """Return a text of numbers and units with the local decimal sign, and any other text unchanged."""
    name = language()
    return text if name == ENGLISH or not is_numeric(text) else catalogue(name).number(text)


# --- catalogues --------------------------------------------------------------------------------------

_AROUND: Final = re.compile(r"([\s:;,.([«»✓✗⚠▶○■●–·]*)(.*?)([\s:;,.)\]]*)", re.DOTALL)
"""Three groups: the signs before a text, the text, the signs after it."""
_SURE, _SHORT = 5, 60
"""In an entry of fewer than `_SURE` letters, the value of a blank may have at most `_SHORT` characters."""
_SENTENCE_END: Final = re.compile(r"(?<=[.?!]) (?=[A-Z(]|[-−]?\d)")
_CLAUSE_END: Final = re.compile(r"; |[.?!] (?=[A-Z(])|^\S+: |^[,;:] |  ")
_WORD: Final = re.compile(r"\b[a-z]{3,}\b")
_BLANK: Final = re.compile(r"\{(\d+)\}")
_TYPED: Final = re.compile(
    r"'bench [^']*'|: bench .*|'\{\d+\}'|(?:choose from|known:|known are|kept in|columns?) \{\d+\}"
    r"|(?:type one of|\(the log has) \{\d+\}|cannot share a chart \(.*"
    r"|^\{0\} \(SIMULATED\)|header lacks \{\d+\}(?:; expected at least \{\d+\})?"
    r"|(?:shipped|latest|latest runs) are: .*|^\{0\}: assumed from plausible"
    r"|^[✓✗] \{0\}(?= is )"
    r"|^\{0\}(?=: U = K a)|run 'as_found', \{0\}"
    r"|^\{0\}(?=: \{1\}: \{2\}; correct it)|(?:bench file|^Tumble|^Calibration) of \{0\}"
    r"|(?:^|\bof |\bas |\bthe )run \{\d+\}(?! \()"
)
"""The parts of an entry whose blanks hold what is typed or quoted (command, path, key, run): their values stay."""


@dataclass(frozen=True)
class Entry:
    """An entry of a catalogue: an English text with numbered blanks.

    `plural` is the form for any count but one; `context` distinguishes equal English texts.
    """

    english: str
    plural: str = ""
    context: str = ""
    files: str = field(default="", compare=False)
    """The files that use the text, separated by spaces."""

    @property
    def of_modules(self) -> bool:
        """Whether the text is from a module: modules fill the blanks before they look a text up.

        A template looks its texts up before it fills the blanks.
        """
        return not self.files or any(not file.endswith((".j2", ".js")) for file in self.files.split())

    def patterns(self) -> Iterator[tuple[str, re.Pattern[str]]]:
        """Yield each English form with a regular expression whose groups match the values of its blanks."""
        for text in filter(None, (self.english, self.plural)):
            seen: set[str] = set()
            parts = []
            for at, part in enumerate(_BLANK.split(text)):
                if at % 2 == 0:
                    parts.append(re.escape(part))
                else:
                    parts.append(f"(?P=v{part})" if part in seen else f"(?P<v{part}>.*?)")
                    seen.add(part)
            yield text, re.compile("".join(parts))


class Catalogue:
    """The catalogue of one language: its translations, and its decimal sign `decimal`."""

    def __init__(self, entries: Iterable[Entry], translations: NullTranslations, decimal: str) -> None:
        self.decimal = decimal
        self.entries = tuple(entries)
        self._translations = translations
        self._exact = {
            (one.context, text): one for one in self.entries for text in (one.english, one.plural) if text
        }
        copies = [one for one in self.entries if _BLANK.search(one.english) and one.of_modules]
        # entries that begin with a word, and those with many letters, are compared first
        copies.sort(
            key=lambda one: (one.english.startswith("{"), -_letters(one), -len(_BLANK.findall(one.english)))
        )
        self._patterns = {
            sure: [
                (max(_BLANK.split(text)[::2], key=len), one, pattern)
                for one in copies
                if (_letters(one) >= _SURE) is sure
                for text, pattern in one.patterns()
            ]
            for sure in (True, False)
        }
        self.translate: Callable[..., str] = lru_cache(maxsize=20000)(self._translate)

    def number(self, text: str) -> str:
        """Return a text with the decimal sign of the language in decimal numbers, not version numbers."""
        return _DECIMAL.sub(rf"\1{self.decimal}\2", text)

    def fill(self, entry: Entry, values: Mapping[str, str], count: float | None = None) -> str:
        """Return the translation of `entry` with `values` in its blanks.

        `count`, by default the first whole number in `values`, selects the plural form.
        """
        if count is None:
            count = next((int(value) for value in values.values() if value.isdecimal()), 2)
        form = self._form(entry, int(count) if float(count).is_integer() else 2)  # fraction: form of 2
        return _BLANK.sub(lambda blank: values.get(blank[1], blank[0]), form)

    def forms(self, entry: Entry) -> list[str]:
        """Return the translations of an entry: a single one or, for a plural, the forms for one, few and many."""
        return [self._form(entry, n) for n in ((1, 2, 5) if entry.plural else (1,))]

    def _form(self, entry: Entry, n: int) -> str:
        of, english = self._translations, entry.english
        match entry.context, entry.plural:
            case "", "":
                return of.gettext(english)
            case context, "":
                return of.pgettext(context, english)
            case "", plural:
                return of.ngettext(english, plural, n)
        return of.npgettext(entry.context, english, entry.plural, n)

    def _translate(self, text: str, context: str = "") -> str:
        if is_numeric(text):
            return self.number(text)
        lowered = text[:1].lower() + text[1:]
        looks: tuple[Callable[[str], str | None], ...] = (
            partial(self._exactly, context=context),
            self._filled,
        )
        for look in looks:
            if (told := look(text)) is not None:
                return told
            if lowered != text and (told := look(lowered)) is not None:
                return told[:1].upper() + told[1:]
        for separator in ("\n", "  "):
            if len(parts := text.split(separator)) > 1:
                return separator.join(map(self.translate, parts))
        if (told := self._fault(text) or self._last_clause(text)) is not None:
            return told
        if (end := _SENTENCE_END.search(text)) is not None:  # the rest may be an entry of several sentences
            return f"{self.translate(text[: end.start()])} {self.translate(text[end.end() :])}"
        before, inner, after = _around(text)
        if inner != text:
            return before + self.translate(inner, context) + after
        for joint in ("; ", ": ", ", "):
            parts = text.split(joint)
            if all(map(self._settled, parts)) and (joined := joint.join(map(self._part, parts))) != text:
                return joined
        return self._filled(text, single=1) or self._filled(text, single=0) or self._part(text)

    def _last_clause(self, text: str) -> str | None:
        """Return the translation of a text whose last clause, after a semicolon, has one; None for any other."""
        before, joint, last = text.rpartition("; ")
        told = self._part(last)
        return f"{self.translate(before)}; {told}" if joint and told != last else None

    def _fault(self, text: str) -> str | None:
        """Return the translation of `NAME: FAULT`, with one or more names before the fault; None for other texts.

        A name is that of an instrument or a file. The catalogue has an entry for the fault alone.
        """
        name, colon, rest = text.partition(": ")
        if not colon or " " in name:
            return None
        told = self._exactly(rest) or self._filled(rest) or self._fault(rest)
        return None if told is None else f"{self._instrument(name)}: {told}"

    def _part(self, text: str) -> str:
        if is_numeric(text):
            return self.number(text) if _WORDS.search(text) else text  # a clause of a standard has no unit
        if told := self._exactly(text) or self._filled(text) or self._filled(text, sure=False):
            return told
        name, colon, rest = text.partition(": ")  # an instrument and its fault
        told = self._part(rest) if colon and " " not in name else rest
        return text if told == rest else f"{self._instrument(name)}: {told}"

    def _instrument(self, name: str) -> str:
        """Return the translation of a name before a colon if the program gave it; the name of a run stays."""
        entry = self._exact.get(("", name))
        return name if entry is None or "names-shown" not in entry.files else self.fill(entry, {})

    def _settled(self, text: str) -> bool:
        """Return whether a part of a text has a translation or needs none (a single word, numbers)."""
        return " " not in text.strip() or not self._foreign(text)

    def _foreign(self, text: str) -> bool:
        return any(word not in _UNITS for word in _WORD.findall(text)) and self._part(text) == text

    def _exactly(self, text: str, context: str = "") -> str | None:
        entry = self._exact.get((context, text)) or self._exact.get(("", text))
        return None if entry is None else self.fill(entry, {})

    def _filled(self, text: str, *, sure: bool = True, single: int | None = None) -> str | None:
        """Return the translation of `text`, an entry with filled blanks; None if no entry matches.

        With `sure`, only the entries with at least `_SURE` letters are tried. Otherwise only the shorter entries
        are tried, such as "{0} in {1}", and their blanks match short values only. In an entry that begins with a
        blank, the first `single` blanks (by default all) match a single clause only.
        """
        for literal, entry, pattern in self._patterns[sure]:
            if literal in text and (found := pattern.fullmatch(text)) is not None:
                values = found.groupdict("")
                begins = entry.english.startswith("{")
                if begins and any(map(_CLAUSE_END.search, list(values.values())[:single])):
                    continue
                if sure or all(len(one) <= _SHORT and not self._foreign(one) for one in values.values()):
                    typed, blanks = _typed(entry.english), {name[1:]: one for name, one in values.items()}
                    told = {n: one if n in typed else self.translate(one) for n, one in blanks.items()}
                    if " " not in (name := blanks.get("0", " ")) and entry.english.startswith("{0}: "):
                        told["0"] = self._instrument(name)
                    return self.fill(entry, told)
        return None


def _around(text: str) -> tuple[str, str, str]:
    """Return the signs before a text, the text, and the signs after it.

    A bracket that opens in the text also closes in it.
    """
    found = _AROUND.fullmatch(text)
    if found is None:
        return "", text, ""
    before, inner, after = found.groups()
    if inner.count("(") > inner.count(")") and ")" in after:
        end = after.index(")") + 1
        inner, after = inner + after[:end], after[end:]
    return before, inner, after


def _typed(english: str) -> set[str]:
    """Return the numbers of an entry's blanks that are part of a command or path to type."""
    return {number for part in _TYPED.findall(english) for number in _BLANK.findall(part)}


def _letters(entry: Entry) -> int:
    """Return the number of letters and digits in the English text of an entry, without its blanks."""
    return len(re.findall(r"[^\W_]", _BLANK.sub("", entry.english)))


_OF_SCRIPTS: Final = tuple(f"bench/{room}/" for room in ("panel", "run", "config", "results", "base"))
_OF_PROMPTS: Final = ("drivers/", "procedures/", "names-shown")


def texts_for_scripts(name: str) -> str:
    """Return JavaScript source that defines the translations into a language for the panel's scripts."""
    found = catalogue(name)
    texts = [
        (one.english, one.plural, found.forms(one))
        for one in found.entries
        if one.context != HEADING
        and any(
            file.startswith(_OF_SCRIPTS + _OF_PROMPTS) and not file.endswith(".j2")
            for file in one.files.split()
        )
    ]
    patterns = {
        "around": _AROUND,
        "sentence": _SENTENCE_END,
        "clause": _CLAUSE_END,
        "typed": _TYPED,
        "word": _WORD,
    }
    told = {
        "language": name,
        "decimal": found.decimal,
        "units": sorted(_UNITS),
        "instruments": [one.english for one in found.entries if "names-shown" in one.files],
        "sure": _SURE,
        "short": _SHORT,
        "patterns": {name: pattern.pattern for name, pattern in patterns.items()},
        "texts": texts,
    }
    return f"window.BENCH_TEXTS = {json.dumps(told, ensure_ascii=False)};\n"


@cache
def catalogue(name: str) -> Catalogue:
    """Return the catalogue of a language. Raises `FileNotFoundError` for English."""
    from babel import Locale
    from babel.messages.mofile import write_mo
    from babel.messages.pofile import read_po

    compiled = BytesIO()
    with (files(__package__) / "catalogues" / f"{name}.po").open("rb") as file:
        told = read_po(file, locale=name)
    write_mo(compiled, told)
    entries = []
    for one in told:
        complete = one.string and not one.fuzzy and (isinstance(one.string, str) or all(one.string))
        if one.id and complete:
            english, plural = (one.id, "") if isinstance(one.id, str) else one.id
            used = " ".join(file for file, _ in one.locations)
            entries.append(Entry(english, plural, one.context or "", used))
    decimal = str(Locale(name).number_symbols["latn"]["decimal"])
    return Catalogue(entries, GNUTranslations(BytesIO(compiled.getvalue())), decimal)
