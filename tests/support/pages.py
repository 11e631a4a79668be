"""The documentation's pages as blocks of code, and as commands with their output.

A comment on the line before a block marks it. `<!-- file: NAME -->`: later commands read this file; `data:
PATH`: they read this file of the repository; `status: N`: exit status of the last command. Blocks with
`shell: WHY` are not carried out, nor those with `hardware: WHY`, `checked: WHY` or `not run: WHY`, whose
commands and options must exist.
"""

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
ELLIPSIS = "…"

_BLOCK = re.compile(
    r"(?:^<!-- (?P<mark>[^>]*) -->\n)?^```(?P<kind>\S*) ?(?P<argument>[^\n]*)\n(?P<text>.*?)^```$",
    re.M | re.S,
)


@dataclass(frozen=True)
class Block:
    """One block: its kind ("console", "python"), its text, its mark, and its line on the page."""

    page: str
    kind: str
    text: str
    mark: str
    line: int

    @property
    def why_not_run(self) -> str:
        """The mark, if it says that the block is not carried out; else empty."""
        return self.mark if self.mark.partition(":")[0] in {"shell", "hardware", "checked", "not run"} else ""

    def marked(self, word: str) -> str:
        """Return the text after `word` in the mark; empty if the mark is another."""
        name, _, rest = self.mark.partition(": ")
        return rest if name == word else ""


@dataclass
class Command:
    """A command of a console block, and the output shown below it."""

    words: list[str]
    shown: list[str] = field(default_factory=list)


def pages() -> list[Path]:
    """Return the pages that people write: those of docs/, and the README."""
    return [*sorted(DOCS.glob("*.md")), ROOT / "README.md"]


def blocks(page: Path) -> list[Block]:
    """Return the blocks of a page in order."""
    text = page.read_text(encoding="utf-8")
    return [
        Block(page.name, *_shown(m), m["mark"] or "", text.count("\n", 0, m.start()) + 1)
        for m in _BLOCK.finditer(text)
    ]


def _shown(block: re.Match[str]) -> tuple[str, str]:
    """Return kind and text of a block, or of the file that it includes."""
    if block["kind"] == "{literalinclude}":
        path = DOCS / block["argument"]
        return {".py": "python", ".yaml": "yaml"}[path.suffix], path.read_text(encoding="utf-8")
    return block["kind"], block["text"]


def commands(block: Block) -> Iterator[Command]:
    """Yield the commands of a console block."""
    command = None
    for line in block.text.splitlines():
        if line.startswith("$ "):
            if command is not None:
                yield command
            command = Command(shlex.split(line[2:], comments=True))
        elif command is not None:
            command.shown.append(line)
    if command is not None:
        yield command


def told_apart(shown: list[str], printed: str) -> str:
    """Return in words the first shown line that the printed output lacks; empty if they agree.

    The line "…" matches any lines, an ellipsis within a line any text.
    """
    if not shown:
        return ""
    pattern = ""
    best = ""
    for line in shown:
        if line.strip() == ELLIPSIS:
            pattern += r"(?:[^\n]*\n)*?"
            continue
        pieces = (re.escape(piece) for piece in line.rstrip().split(ELLIPSIS))
        pattern += r"[^\n]*?".join(pieces) + r"[ ]*\n"
        if not best and re.match(pattern, printed) is None:
            best = line
    if re.fullmatch(pattern, printed):
        return ""
    return f"{best or shown[-1]!r} does not stand in:\n{printed}"
