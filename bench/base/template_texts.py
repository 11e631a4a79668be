"""Texts of page templates, found in unmarked HTML, for the catalogue and for the translated pages.

A text is the content between block elements and Jinja statements, inline elements included. Its expressions become
numbered blanks: `<p>Page <b>{{ n }}</b> of {{ m }}</p>` has the text `Page <b>{0}</b> of {1}`. A text with an
expression such as `{{ "" if n == 1 else "s" }}` has a plural. Within expressions, `_("…")` marks a text. English
pages are rendered from the template as it is.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Final

from jinja2 import Environment, PackageLoader, StrictUndefined
from jinja2.ext import Extension
from markupsafe import Markup

from bench.base.languages import ENGLISH, Entry, catalogue, language, shown, translated
from bench.base.numbers import typeset

ENGLISH_ONLY: Final = "{# English only #}"

_INLINE: Final = frozenset(
    ["a", "abbr", "b", "br", "code", "em", "i", "kbd", "small", "span", "strong", "sub", "sup", "var"]
)
_RAW: Final = frozenset({"script", "style", "pre", "textarea"})
_AS_IS: Final = frozenset({"code", "kbd", "time"})
"""Elements with names or addresses: their numbers stay unchanged, as in an element of the class "name"."""

_JINJA: Final = r"\{\{.*?\}\}|\{%.*?%\}|\{#.*?#\}"
_QUOTED: Final = rf'"(?:{_JINJA}|[^"])*"'
_TOKEN: Final = re.compile(
    rf"(?P<comment>\{{#.*?#\}}|<!.*?>)|(?P<statement>\{{%.*?%\}})|(?P<value>\{{\{{.*?\}}\}})"
    rf"|(?P<tag></?[a-zA-Z](?:{_JINJA}|{_QUOTED}|[^<>\"])*>)|(?P<text>[^<{{]+|.)",
    re.DOTALL,
)
ATTRIBUTE: Final = re.compile(
    rf'(?P<name>\s(?:aria-label|title|alt|placeholder|data-label))="(?P<text>(?:{_JINJA}|[^"])*)"', re.DOTALL
)
_ENDING: Final = re.compile(r'\{\{\s*"(\w*)" if (.+?) == 1 else "(\w*)"\s*\}\}')
_ATTRIBUTE_ALONE: Final = re.compile(r'\s*[a-z-]+="')
"""The beginning of an attribute, such as `href="`, whose value a macro writes."""
LETTER: Final = re.compile(r"[^\W\d_]{2}")


@dataclass
class Segment:
    """One text of a template: its tokens, each as (kind, source).

    `raw` holds the indices of tokens whose values are shown unchanged: not translated, no local decimal sign.
    """

    tokens: list[tuple[str, str]] = field(default_factory=list)
    raw: set[int] = field(default_factory=set)


def segment_of(text: str) -> Segment:
    """Return a text of a template as one segment."""
    return Segment([(str(found.lastgroup), found[0]) for found in _TOKEN.finditer(text)])


def parts_of(source: str) -> Iterator[str | Segment]:
    """Yield the source in order: each text as a `Segment`, the source between texts as a string."""
    segment, raw, names = Segment(), "", 0
    for found in _TOKEN.finditer(source):
        kind, told = str(found.lastgroup), found[0]
        name = (re.match(r"</?(\w+)", told) or [""] * 2)[1].lower() if kind == "tag" else ""
        if raw:
            yield told
            raw = "" if name == raw and told.startswith("</") else raw
        elif kind in {"text", "value"} or (name in _INLINE and "{%" not in told):
            if name in _AS_IS or (name and re.search(r'class="[^"]*\bname\b', told)):
                names += 1
            elif told.startswith("</") and names:
                names -= 1
            if kind == "value" and names:
                segment.raw.add(len(segment.tokens))
            segment.tokens.append((kind, told))
        else:
            yield segment
            # a form sends the text of an <option> without a value, so this text is not translated
            sent = name == "option" and "value=" not in told and not told.startswith("</")
            segment, names = Segment(), 1 if sent or name in _AS_IS or 'class="name"' in told else 0
            yield told
            raw = name if name in _RAW and not told.startswith("</") else ""
    yield segment


def entry_of(segment: Segment) -> tuple[Entry | None, list[str], str]:
    """Return the catalogue entry of a segment, the expressions of its blanks, and the expression of its count.

    The entry is None for a segment without words; the count is "" for a text without plural.
    """
    english, plural, values, count = "", "", [], ""
    for at, (kind, told) in enumerate(segment.tokens):
        one, many = told, told
        if kind == "value" and (ending := _ENDING.fullmatch(told)):
            one, count, many = ending.groups()
        else:

            def blank(found: re.Match[str], as_is: bool = kind == "tag" or at in segment.raw) -> str:
                expression = _expression(found[0])
                values.append(expression if as_is else f"_shown({expression})")
                return f"{{{len(values) - 1}}}"

            one = many = re.sub(r"\{\{.*?\}\}", blank, told, flags=re.DOTALL)
        english, plural = english + one, plural + many
    words = re.sub(r"<[^>]*>|\{\d+\}|&\w+;", " ", english)
    if not LETTER.search(words) or _ATTRIBUTE_ALONE.match(english):
        return None, [], ""
    return Entry(" ".join(english.split()), " ".join(plural.split()) if count else ""), values, count


VOID: Final = ("<br", "<input", "<img", "<hr", "<wbr")
"""The beginnings of tags that have no end."""


def trimmed(segment: Segment) -> tuple[str, Segment, str]:
    """Trim white space and tags from both ends; return (cut off before, segment, cut off after)."""
    tokens = list(enumerate(segment.tokens))
    before, after = "", ""

    def outside(kind: str, told: str) -> bool:
        return kind == "tag" or not told.strip()

    while tokens and outside(*tokens[0][1]):
        before += tokens.pop(0)[1][1]
    while tokens and outside(*tokens[-1][1]):
        after = tokens.pop()[1][1] + after
    closed, opened = 0, 0
    for _, (kind, told) in tokens:
        if kind == "tag" and not told.startswith(VOID):
            closed += told.startswith("</") and not opened
            opened += 1 if not told.startswith("</") else -1 if opened else 0
    # a tag before or after the text belongs to the text if its counterpart is within the text
    for _ in range(closed):
        if around := re.fullmatch(r"(.*)(<[^/][^<]*)", before, re.DOTALL):
            before, start = around.groups()
            tokens.insert(0, (-1, ("tag", start)))
    for _ in range(opened):
        if around := re.fullmatch(r"(\s*</[^>]*>)(.*)", after, re.DOTALL):
            end, after = around.groups()
            tokens.append((-1, ("tag", end)))
    raw = {new for new, (old, _) in enumerate(tokens) if old in segment.raw}
    return before, Segment([token for _, token in tokens], raw), after


class TranslatedTemplates(Extension):
    """A Jinja extension that replaces each text of a template by a look-up in the current catalogue."""

    def __init__(self, environment: Environment) -> None:
        super().__init__(environment)
        environment.globals.update(_text=_text, _shown=shown)

    def preprocess(self, source: str, name: str | None, filename: str | None = None) -> str:
        """Return the source of a template with its texts replaced by look-ups.

        Sources that begin with `ENGLISH_ONLY`, and templates other than HTML, are unchanged.
        """
        if source.startswith(ENGLISH_ONLY) or (name is not None and ".html" not in name):
            return source
        source = source.replace('<html lang="en">', f'<html lang="{language()}">')
        return "".join(
            _translated(part) if isinstance(part, Segment) else _tag(part) for part in parts_of(source)
        )


def _translated(segment: Segment) -> str:
    before, middle, after = trimmed(segment)
    lead = re.match(r"\s*", middle.tokens[0][1])[0] if middle.tokens else ""  # type: ignore[index]
    tail = re.search(r"\s*$", middle.tokens[-1][1])[0] if middle.tokens else ""  # type: ignore[index]
    entry, values, count = entry_of(middle)
    if entry is None:
        return "".join(
            _shown_value(told) if kind == "value" and at not in segment.raw else told
            for at, (kind, told) in enumerate(segment.tokens)
        )
    return f"{before}{lead}{_call(entry, values, count)}{tail}{after}"


def _expression(value: str) -> str:
    """Return the expression in `{{ … }}` or `{{- … -}}`; the minus signs control white space."""
    return value[2:-2].strip("-").strip()


def _shown_value(value: str) -> str:
    """Return `{{ … }}` with its expression translated, and its control of white space as it is."""
    before, after = ("-" if sign == "-" else "" for sign in (value[2], value[-3]))
    return f"{{{{{before} _shown({_expression(value)}) {after}}}}}"


def _call(entry: Entry, values: list[str], count: str) -> str:
    return (
        f"{{{{ _text({', '.join([repr(entry.english), repr(entry.plural), count or 'none', *values])}) }}}}"
    )


def _tag(part: str) -> str:
    def of(found: re.Match[str]) -> str:
        entry, values, count = entry_of(segment_of(found["text"]))
        value = re.fullmatch(r"\{\{(?:(?!\}\}).)*\}\}", found["text"])
        text = found["text"] if entry is None else _call(entry, values, count)
        if entry is None and value is not None:
            text = _shown_value(value[0])
        return f'{found["name"]}="{text}"'

    return ATTRIBUTE.sub(of, part) if part.startswith("<") else part


def _text(english: str, plural: str, count: float | None, *values: object) -> Markup:
    """Return a text of a template in the current language; values without markup are escaped."""
    escaped = {str(at): str(Markup("{}").format(value)) for at, value in enumerate(values)}
    return Markup(catalogue(language()).fill(Entry(english, plural), escaped, count))  # noqa: S704 - our own text


def mark(text: Any, *values: object, context: str = "") -> Any:
    """Return a text, or a list of texts, translated; `values` fill its blanks. Templates call it `_`."""
    if isinstance(text, list):
        return [mark(one) for one in text]
    if hasattr(text, "__html__") or not isinstance(text, str):
        return text
    told = translated(text, context)
    return told.format(*(translated(str(one)) for one in values)) if values else told


def environment_for(name: str, package: str) -> Environment:
    """Return the Jinja environment of a package's pages in a language; `_("…")` marks texts in expressions."""
    environment = Environment(
        loader=PackageLoader(package, "templates"),
        extensions=[] if name == ENGLISH else [TranslatedTemplates],
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["_"] = mark
    environment.filters["typeset"] = typeset
    return environment
