"""Check that every text that people read has its translation.

    python -m benchmarks.translations

Texts are the arguments of `message`, the words of refusals and faults, what a console prints, headings of tables
(see `MARKS`), the arguments of `_` in scripts and in expressions of templates, the words of page templates, and
titles, descriptions and reasons of the shipped procedures and bench files. A name that a page takes from a record
or a file is an entry of a catalogue with
the reference `names-shown`. `make lint` fails if one lacks a translation, if a translation has other blanks or
elements than its text, if a catalogue has an unused text, if a word of the certificate lacks a language, or if the
text of a `Prompt` is not marked.
"""

import ast
import re
import sys
from collections.abc import Iterator
from io import BytesIO
from itertools import product
from pathlib import Path
from typing import Any, Final

import yaml
from babel.messages.catalog import Catalog
from babel.messages.pofile import read_po, write_po

from bench.base.languages import ENGLISH, HEADING, LANGUAGES, Entry
from bench.base.template_texts import (
    ATTRIBUTE,
    ENGLISH_ONLY,
    LETTER,
    Segment,
    entry_of,
    parts_of,
    segment_of,
    trimmed,
)
from benchmarks.campaign import arguments

ROOT: Final = Path(__file__).parents[1]
CATALOGUES: Final = ROOT / "bench" / "base" / "catalogues"
EFFECTS: Final = ROOT / "bench" / "model" / "effects"
"""Folder of the effects, which state texts as attributes: the sentence, and the measurement that shows them."""
WORDS: Final = ROOT / "bench" / "certificate" / "words.yaml"
NAMES_SHOWN: Final = "names-shown"
"""Reference of a catalogue's entry for a name that no module states, because it comes from a record or a file."""
REFUSALS: Final = "Refused NoCheckBlock RecordError ReadingsError CalibrationError FaultyReadings"
FAULTS: Final = (
    "BenchError InstrumentLost InstrumentRefused BadReading LimitExceeded WentAstray NoAnswer SetOtherwise "
    "RailFault NotSettled"
)
MARKS: Final = {
    "message": slice(0, 1),
    **dict.fromkeys(REFUSALS.split(), slice(0, 1)),
    **dict.fromkeys(("SpoiledFit", "DeviatingReadings"), slice(0, 2)),
    "table": slice(None),
    **dict.fromkeys(("print", "aside"), slice(None)),
    "tracked": slice(1, 2),
    "ValueError": slice(0, 1),
    **dict.fromkeys(("Refusal", "BadCell"), slice(1, 2)),
    **dict.fromkeys(FAULTS.split(), slice(1, 3)),
    **dict.fromkeys(
        ("Key", "Figure", "confirm", "tell", "Skipped", "SessionEnded", "NotIntact"), slice(0, 1)
    ),
    "Part": slice(0, 2),
    "Finding": slice(4),
}
"""The calls that mark texts for translation, with the places of these texts among their arguments."""
IN_FILES: Final = (ROOT / "bench" / "config", ROOT / "bench" / "base" / "units.py")
"""The modules in which the text of a `ValueError` is on a file that people write."""
FINDINGS: Final = ROOT / "bench" / "run" / "commission"
NAMED: Final = ("said", "remedy", "expected", "of")
"""The keyword arguments of these calls, and in `FINDINGS` also the local names, that are texts."""
OF_FINDINGS: Final = ("Finding", "Figure", "Part")
"""The calls whose single words are headings, because elsewhere they may be keys or names."""
OF_HEADINGS: Final = ("table", "tracked")
"""The calls whose texts are headings of tables and of progress."""
SHIPPED: Final = (ROOT / "procedures", ROOT / "config")
_MARKED: Final = re.compile(r"(?<![\w.])_\(")
_LITERAL: Final = re.compile(r'"((?:[^"\\]|\\.)*)"')
_CONTEXT: Final = re.compile(r'context="(\w+)"')
_SHIPPED_TEXT: Final = re.compile(r"\b(?:title|description|reason): ([^}\n#]+)")
_IN_SCRIPT: Final = re.compile(r"(?<![\w.$])_\((?=[\"`])")
_VALUE: Final = re.compile(r"(\$\{(?:[^{}]|\{(?:[^{}]|\{[^{}]*\})*\})*\})")
_ENDING: Final = re.compile(r'\$\{(?:[^{}]+?) === 1 \? "([^"]*)" : "([^"]*)"\}')
_WORDS: Final = re.compile(r"[^\W\d_]{2,} ")
_BLANKS: Final = re.compile(r"\{\d+\}|</?\w+")


def entries_of(file: Path) -> Iterator[Entry]:
    """Yield the texts to translate in a module, a template or a script.

    Raises `ValueError` for a text that is no literal.
    """
    source = file.read_text(encoding="utf-8")
    if file.suffix == ".py":
        if any(f"{name}(" in source for name in MARKS) or file.parent == EFFECTS:
            yield from _in_module(ast.parse(source), file)
    elif file.name.endswith(".html.j2"):
        yield from texts_of_template(source)
    elif file.suffix == ".yaml" and file.parent in SHIPPED:
        yield from (Entry(told[1].strip()) for told in _SHIPPED_TEXT.finditer(source))
    elif file.suffix == ".js":
        for call in _IN_SCRIPT.finditer(source):
            yield _in_script(_literal_at(source, call.end()))


def texts_of_template(source: str) -> Iterator[Entry]:
    """Yield the texts of a template with their blanks; none if it begins with `{# English only #}`."""
    if source.startswith(ENGLISH_ONLY):
        return
    for part in parts_of(source):
        if isinstance(part, Segment):
            found = [entry_of(trimmed(part)[1])[0]]
        else:
            attributes = ATTRIBUTE.finditer(part) if part.startswith("<") else ()
            found = [entry_of(segment_of(one["text"]))[0] for one in attributes]
        yield from (entry for entry in found if entry is not None)
    for call in _calls_in_template(source):
        context = _CONTEXT.search(call)
        literals = _LITERAL.finditer(_CONTEXT.sub("", call))
        yield from (
            Entry(one[1], "", context[1] if context else "") for one in literals if LETTER.search(one[1])
        )


def _calls_in_template(source: str) -> Iterator[str]:
    """Yield the arguments of each call of `_` in a template."""
    for start in _MARKED.finditer(source):
        depth, at = 1, start.end()
        while depth and at < len(source):
            depth += {"(": 1, ")": -1}.get(source[at], 0)
            at += 1
        yield source[start.end() : at - 1]


def _in_module(tree: ast.AST, file: Path) -> Iterator[Entry]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign) and file.parent == EFFECTS:
            if {"sentence", "shown_by"} & {one.id for one in node.targets if isinstance(one, ast.Name)}:
                yield from _wordings(node.value)
        elif isinstance(node, ast.Assign) and file.parent == FINDINGS:
            if {*NAMED, "held"} & {one.id for one in node.targets if isinstance(one, ast.Name)}:
                yield from (one for one in _wordings(node.value, given=False) if one.english)
        elif isinstance(node, ast.Call) and (name := _called(node.func)) in MARKS:
            if name == "ValueError" and not any(file.is_relative_to(one) for one in IN_FILES):
                continue
            context = node.args[1:2] if name == "message" else []
            told = str(ast.literal_eval(context[0])) if context else ""
            try:
                named = (one.value for one in node.keywords if one.arg in NAMED)
                for text in (*node.args[MARKS[name]], *named):
                    for one in _wordings(text, given=name == "message"):
                        if name in OF_HEADINGS and LETTER.search(_BLANKS.sub("", one.english)):
                            yield Entry(
                                one.english.removeprefix(">"), "", HEADING
                            )  # ">": aligned to the right
                        elif name not in OF_HEADINGS and one.english:
                            alone = name in OF_FINDINGS and " " not in one.english
                            yield Entry(one.english, one.plural, HEADING if alone else told)
            except ValueError as error:
                raise ValueError(f"{file.relative_to(ROOT)}, line {node.lineno}: {error}") from error


def _called(function: ast.expr) -> str:
    """Return the name of a function, also that of a method of a console `out` or of the module `printing`."""
    match function:
        case ast.Name(name) if name != "print":
            return name
        case ast.Attribute(ast.Name("out" | "on" | "printing" | "evening"), name):
            return name
        case ast.Attribute(ast.Call(ast.Attribute(ast.Name("printing"), "console")), name):
            return name
    return ""


def _wordings(node: ast.expr, *, given: bool = True) -> Iterator[Entry]:
    """Yield the wordings of a text, one per branch of its conditions; a choice by number gives a plural.

    Raises `ValueError` for a text that is no literal. Unless it must be `given` here, it is marked elsewhere.
    """
    match node:
        case ast.Constant(value=str(text)):
            yield Entry(text)
        case ast.IfExp():
            yield from (*_wordings(node.body, given=given), *_wordings(node.orelse, given=given))
        case ast.JoinedStr():
            yield from (one for one in _filled(node) if LETTER.search(_BLANKS.sub("", one.english)))
        case _ if given:
            raise ValueError("a marked text is a literal or an f-string")


def _filled(node: ast.JoinedStr) -> Iterator[Entry]:
    parts: list[list[tuple[str, str]]] = []
    blanks = 0
    for part in node.values:
        if isinstance(part, ast.Constant):
            parts.append([(str(part.value), str(part.value))])
            continue
        value = part.value if isinstance(part, ast.FormattedValue) else None
        if isinstance(value, ast.IfExp) and all(
            isinstance(b, ast.Constant) for b in (value.body, value.orelse)
        ):
            yes, no = str(value.body.value), str(value.orelse.value)  # type: ignore[attr-defined]
            match value.test:
                case ast.Compare(ops=[ast.Eq()], comparators=[ast.Constant(value=1)]):
                    parts.append([(yes, no)])
                case ast.Compare(ops=[ast.NotEq()], comparators=[ast.Constant(value=1)]):
                    parts.append([(no, yes)])
                case _:
                    parts.append([(yes, yes), (no, no)])
        else:
            parts.append([(f"{{{blanks}}}",) * 2])
            blanks += 1
    for way in product(*parts):
        one, many = ("".join(part[form] for part in way) for form in (0, 1))
        yield Entry(one, many if many != one else "")


def _literal_at(source: str, at: int) -> str:
    """Return the literal that begins at a position of a script; a template literal may contain others."""
    quote, end, depth = source[at], at + 1, 0
    while source[end] != quote or depth:
        if source[end] == "\\":
            end += 1
        elif source.startswith("${", end):
            depth += 1
        elif source[end] == "}" and depth:
            depth -= 1
        end += 1
    return source[at : end + 1]


def _in_script(literal: str) -> Entry:
    text = literal[1:-1].replace('\\"', '"')
    if literal.startswith('"'):
        return Entry(text)
    forms = []
    for number in (1, 2):
        form, blanks = "", 0
        for part in _VALUE.split(_ENDING.sub(lambda choice, n=number: choice[n], text)):  # type: ignore[misc]
            if part.startswith("${"):
                form, blanks = f"{form}{{{blanks}}}", blanks + 1
            else:
                form += part
        forms.append(form)
    return Entry(forms[0], forms[1] if forms[1] != forms[0] else "")


def all_entries() -> dict[Entry, list[str]]:
    """Return every text of the program with the files that use it; a text with a plural replaces one without."""
    found: dict[Entry, list[str]] = {}
    for folder in ("bench", "drivers", "procedures", "config"):
        for file in sorted((ROOT / folder).rglob("*")):
            if file.suffix in {".py", ".j2", ".js", ".yaml"}:
                for entry in entries_of(file):
                    found.setdefault(entry, []).append(str(file.relative_to(ROOT)))
    for language in LANGUAGES.keys() - {ENGLISH}:
        for one in catalogue(language):
            if any(file == NAMES_SHOWN for file, _ in one.locations):
                found.setdefault(_entry(one), []).append(NAMES_SHOWN)
    with_plural = {(one.english, one.context) for one in found if one.plural}
    return {
        one: of for one, of in found.items() if one.plural or (one.english, one.context) not in with_plural
    }


def catalogue(language: str) -> Catalog:
    """Return the stored catalogue of a language."""
    with (CATALOGUES / f"{language}.po").open("rb") as stream:
        return read_po(stream, locale=language)


def problems(told: Catalog, texts: dict[Entry, list[str]], language: str) -> Iterator[str]:
    """Yield a sentence for each text without a translation, with wrong blanks, or without use."""
    known = {_entry(one): one for one in told if one.id}
    for text, used in texts.items():
        forms = _forms(known.get(text))
        if not forms or not all(forms):
            yield f"{language}: {text.english!r} ({used[0]}) has no translation"
        for form in filter(None, forms):
            if sorted(_BLANKS.findall(form)) != sorted(_BLANKS.findall(text.english)):
                yield f"{language}: {text.english!r} has other blanks or elements than its translation {form!r}"
    yield from (
        f"{language}: {one.english!r} is used nowhere; leave it out" for one in known.keys() - texts.keys()
    )


def _entry(message: Any) -> Entry:
    english, plural = (message.id, "") if isinstance(message.id, str) else message.id
    return Entry(english, plural, message.context or "")


def _forms(message: Any) -> tuple[str, ...]:
    if message is None or message.fuzzy:
        return ()
    return (message.string,) if isinstance(message.string, str) else tuple(message.string)


def problems_of_words() -> Iterator[str]:
    """Yield a sentence for each word of the certificate that lacks a language that other words have."""
    words = yaml.safe_load(WORDS.read_text(encoding="utf-8"))
    languages = {language for told in words.values() for language in told}
    for key, told in words.items():
        yield from (f"{WORDS.name}: {key} has no word in {one}" for one in sorted(languages - told.keys()))


def unmarked(source: str, place: str) -> Iterator[str]:
    """Yield a sentence for each text of a `Prompt` that is not the argument of `message`."""
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name) or node.func.id != "Prompt":
            continue
        texts = [*node.args[2:3], *(one.value for one in node.keywords if one.arg == "text")]
        literals = (
            one for text in texts for one in (text.values if isinstance(text, ast.JoinedStr) else [text])
        )
        if any(isinstance(one, ast.Constant) and _WORDS.search(str(one.value)) for one in literals):
            yield f"{place}, line {node.lineno}: the text of this Prompt is not in message(); mark it"


def all_unmarked() -> Iterator[str]:
    """Yield the sentences of `unmarked` for all modules."""
    for folder in ("bench", "drivers"):
        for file in sorted((ROOT / folder).rglob("*.py")):
            source = file.read_text(encoding="utf-8")
            if "Prompt(" in source:
                yield from unmarked(source, str(file.relative_to(ROOT)))


def written(told: Catalog, texts: dict[Entry, list[str]], language: str) -> Catalog:
    """Return a catalogue of the texts in use, in order, with the translations known so far."""
    known = {_entry(one): one for one in told if one.id}
    new = Catalog(locale=language, project="triaxial-bench", charset="utf-8", header_comment="")
    for text, used in texts.items():
        old = known.get(text)
        new.add(
            (text.english, text.plural) if text.plural else text.english,
            old.string if old is not None else "",
            locations=[(file, None) for file in dict.fromkeys(used)],  # type: ignore[misc]
            context=text.context or None,
        )
    return new


def save(file: Path, told: Catalog) -> None:
    """Write a catalogue; the same texts always give the same file."""
    stream = BytesIO()
    write_po(stream, told, width=110, omit_header=True)
    header = (
        f'msgid ""\nmsgstr ""\n"Content-Type: text/plain; charset=utf-8\\n"\n"Language: {file.stem}\\n"\n'
    )
    plural = f'"Plural-Forms: {told.plural_forms}\\n"\n\n'
    file.write_bytes((header + plural).encode() + stream.getvalue().lstrip())


def main(given: list[str] | None = None) -> int:
    asked = arguments(__doc__, given, write=(False, "add new texts to the catalogues"))
    texts, told_off = all_entries(), [*problems_of_words(), *all_unmarked()]
    for language in LANGUAGES.keys() - {ENGLISH}:
        told = catalogue(language)
        if asked.write:
            told = written(told, texts, language)
            save(CATALOGUES / f"{language}.po", told)
        told_off += problems(told, texts, language)
    print(*told_off, f"{len(texts)} texts, {len(told_off)} problems", sep="\n")
    return 1 if told_off else 0


if __name__ == "__main__":
    sys.exit(main())
