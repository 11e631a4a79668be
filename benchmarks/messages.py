"""List all messages of the program, found in its code: errors, prompts, notes, texts, help, templates.

    python -m benchmarks.messages                          # all, one a line: kind, place, text
    python -m benchmarks.messages --kind error --sample 60 --seed 1

`…` stands for an inserted value. The page on troubleshooting lists the errors with remedies.
"""

import ast
import random
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Final

import yaml

from bench.certificate.signatures import ORIGINAL
from benchmarks.campaign import ROOT, arguments

ELLIPSIS: Final = "…"
PACKAGES: Final = ("bench", "drivers", "sim")
KINDS: Final = {
    "Prompt": "prompt", "Option": "help", "Argument": "help", "Field": "help", "Key": "help",
    "table": "heading", "print": "note", "note": "note", "warn": "note", "echo": "note",
}  # fmt: skip
"""The kind of a text by the function that takes it; exceptions and lists of problems take errors."""
_ERROR_TAKERS: Final = re.compile(
    "Error|Mistake|Problem|Failure|Refus|refuse|mistake|problem|"
    "InstrumentLost|LimitExceeded|WentAstray|NotConnected|NoAnswer|SetOtherwise|NotSettled|RailFault|"
    "BadReading|BadCell|NotIntact|NotRead|NoTimeStamp"
)
_NOT_INTACT: Final = ("NotIntact", "NoCertificate")
"""Errors of a certificate, to which `bench.certificate.verify` adds its remedy."""
_BENCH_ERROR: Final = ("instrument", "cause", "remedy")
_OF_PROBLEMS: Final = "problems"
"""Kind of a function whose docstring says that it returns or yields problems: its texts are parts of errors."""
_PROBLEMS: Final = re.compile(
    r"(?:\b|_)(problem|mistake|wrong|fault|bad|failure|refus|contradict|caveat|doubt)", re.I
)
_WORDLESS: Final = (ast.Name, ast.expr_context, ast.operator, ast.cmpop, ast.unaryop, ast.boolop, ast.alias)
_WORD: Final = re.compile(r"[^\W\d_]{2,}")
_TAG: Final = re.compile(
    r"\{#.*?#\}|<(script|style)\b.*?</\1>|<!--.*?-->|\{%.*?%\}|<[^<>]*>|\{\{.*?\}\}", re.S
)
_NO_MESSAGE: Final = re.compile(
    r"(SELECT|COPY|CREATE|FORMAT) |\{#|<\w|\w+ = (?:[\[\d…]|\w+ = )|\w+/\w+; charset=|"
    r"width=device-width|[A-Z]+( [A-Z]+)+$|'?sha256-"
)
"""Pattern of texts for programs: queries, elements, definitions of units, commands of instruments."""
_LITERAL: Final = re.compile(r"\"([^\"\n]*)\"|'([^'\n]*)'|`([^`]*)`")


@dataclass(frozen=True)
class Message:
    """A text of the program: its kind, its file and line, and its words, with `…` for inserted values."""

    kind: str
    path: str
    line: int
    text: str

    @property
    def remedy(self) -> str:
        """The remedy that the message states: the text after its last semicolon; "" if there is none."""
        before, _, after = self.text.rpartition("; ")
        return after if before else ""


@cache
def messages() -> list[Message]:
    """Return all messages, in the order of files and lines."""
    found: list[Message] = []
    for path in sorted(path for top in PACKAGES for path in (ROOT / top).rglob("*") if path.is_file()):
        name = str(path.relative_to(ROOT))
        if path.suffix == ".py":
            found += in_code(name, path.read_text(encoding="utf-8"))
        elif path.suffix == ".j2" and ".css" not in path.suffixes:
            found += in_template(name, path.read_text(encoding="utf-8"))
        elif path.suffix == ".js":
            found += in_script(name, path.read_text(encoding="utf-8"))
        elif path.name == "words.yaml":
            found += in_words(name, path.read_text(encoding="utf-8"))
    return found


def in_code(name: str, source: str) -> Iterator[Message]:
    """Yield the messages of a Python module: every literal of at least two words, but no docstring."""
    yield from _below(ast.parse(source), name, "text")


def _below(node: ast.AST, name: str, kind: str) -> Iterator[Message]:
    text = _text(node)
    if text is not None:
        words = " ".join(text.split())
        enough = " " in words and len(_WORD.findall(words)) > (kind != "error")
        if enough and "(?" not in words and not _NO_MESSAGE.match(words):
            said = (
                "error" if kind == "part" and "; " in words[2:] else "text" if kind == _OF_PROBLEMS else kind
            )
            yield Message(said, name, getattr(node, "lineno", 0), words)
        for hole in _holes(node):
            yield from _below(hole, name, "part" if kind == "error" else kind)
        return
    for field in node._fields:
        value = getattr(node, field, None)
        for child in value if isinstance(value, list) else (value,):
            if isinstance(child, _WORDLESS) or not isinstance(child, ast.AST):
                continue
            if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant):
                continue  # a docstring
            yield from _below(child, name, _kind(node, child, kind))


def _kind(node: ast.AST, child: ast.AST, kind: str) -> str:
    """Return the kind of the texts in `child`, a part of `node` whose own kind is `kind`."""
    if isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Lambda)):
        told = "" if isinstance(child, ast.Lambda) else f"{child.name} {ast.get_docstring(child)}"
        return _OF_PROBLEMS if _PROBLEMS.search(told) else "text"
    if isinstance(node, ast.Raise):
        return "error"
    if isinstance(node, (ast.Return, ast.Yield)) and kind == _OF_PROBLEMS:
        return "part"
    if not isinstance(node, ast.Call) or child is node.func or kind not in ("text", _OF_PROBLEMS):
        return kind
    function, taker = node.func, _taker(node)
    if taker in ("append", "add", "extend") and isinstance(function, ast.Attribute):
        return "error" if _PROBLEMS.search(ast.unparse(function.value)) else kind
    return KINDS.get(taker, "error" if _ERROR_TAKERS.search(taker) else kind)


def _text(node: ast.AST) -> str | None:
    """Return the text of a literal, an f-string, joined literals, or a bench error; None for any other node."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else None
    if isinstance(node, ast.JoinedStr):
        return "".join(_text(value) or ELLIPSIS for value in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        sides = _text(node.left), _text(node.right)
        return None if sides == (None, None) else "".join(side or ELLIPSIS for side in sides)
    if (
        isinstance(node, ast.Call)
        and len(node.args) == len(_BENCH_ERROR)
        and _ERROR_TAKERS.search(_taker(node))
    ):
        who, cause, remedy = map(_text, node.args)  # `drivers.interfaces.BenchError` joins them so
        return f"{who or ELLIPSIS}: {cause or ELLIPSIS}; {remedy or ELLIPSIS}" if cause or remedy else None
    if isinstance(node, ast.Call) and len(node.args) == 1 and _taker(node) in _NOT_INTACT:
        cause = _text(node.args[0])
        return f"{cause}; {ORIGINAL}" if cause else None
    if isinstance(node, ast.Call) and len(node.args) == 2 and _ERROR_TAKERS.search(_taker(node)):
        cause, remedy = map(_text, node.args)  # `drivers.wire.pyvisa_connection.WireError`
        return f"{cause}; {remedy}" if cause and remedy else None
    return None


def _holes(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the expressions inserted into a text; they may contain literals."""
    if isinstance(node, ast.JoinedStr):
        yield from (value.value for value in node.values if isinstance(value, ast.FormattedValue))
    sides = (node.left, node.right) if isinstance(node, ast.BinOp) else getattr(node, "args", ())
    for side in sides:
        yield from (side,) if _text(side) is None else _holes(side)


def _taker(call: ast.Call) -> str:
    return str(getattr(call.func, "attr", getattr(call.func, "id", "")))


def in_template(name: str, source: str) -> Iterator[Message]:
    """Yield the texts of a page template: those between tags, and literals in expressions."""
    at = 0
    for tag in [*_TAG.finditer(source), None]:
        end = tag.start() if tag else len(source)
        yield from _of_page(name, source, at, source[at:end])
        if tag:
            at = tag.end()
            if not tag[0].startswith(("{#", "<script", "<style", "<!--")):
                for literal in _LITERAL.finditer(tag[0]):
                    yield from _of_page(name, source, tag.start(), next(filter(None, literal.groups()), ""))


def _of_page(name: str, source: str, at: int, text: str) -> Iterator[Message]:
    words = " ".join(text.split())
    if " " in words and len(_WORD.findall(words)) > 1 and not _NO_MESSAGE.match(words):
        yield Message("page", name, source.count("\n", 0, at) + 1, words)


def in_script(name: str, source: str) -> Iterator[Message]:
    """Yield the texts of a script of the panel: its literals of several words."""
    source = re.sub(r"^[ \t]*//.*$", "", source, flags=re.M)
    for literal in _LITERAL.finditer(source):
        text = re.sub(r"\$\{[^}]*\}", ELLIPSIS, next(filter(None, literal.groups()), ""))
        if not re.search(r"[<>{}=#]", text):
            yield from _of_page(name, source, literal.start(), text)


def in_words(name: str, source: str) -> Iterator[Message]:
    """Yield the English words of the certificate."""
    for number, line in enumerate(source.splitlines(), 1):
        found = re.match(r"\s*en: (.+)", line)
        if found:
            yield Message("certificate", name, number, str(yaml.safe_load(found[1])))


def main() -> None:
    asked = arguments(
        __doc__,
        kind=(str, "only this kind"),
        sample=(int, "so many, drawn at random"),
        seed=(1, "of the draw"),
    )
    shown = [one for one in messages() if asked.kind in (None, one.kind)]
    if asked.sample:
        shown = random.Random(asked.seed).sample(shown, asked.sample)  # noqa: S311
    for one in shown:
        print(f"{one.kind:<8}{one.path}:{one.line}: {one.text}")


if __name__ == "__main__":
    main()
