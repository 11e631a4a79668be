"""Report how long and how plain the documentation pages are; with `--check`, refuse banned phrases.

For each page of docs/ and the README it counts: words (as `wc -w` does), sentences, their mean length, the share of
them over 25 words, pictures, and the phrases of docs/banned-phrases.txt. Sentences are those of paragraphs and
lists, not of code blocks, tables, headings, comments and front matter. Inline code counts as one word. Text that a
command writes between the marks `<!-- NAME: made by COMMAND -->` and `<!-- end of NAME -->` is left out.

    python -m benchmarks.prose            # all pages
    python -m benchmarks.prose --pages docs/panel.md README.md
    python -m benchmarks.prose --check    # `make lint`: banned phrases in pages, texts of the program and comments
"""

import re
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from benchmarks.campaign import ROOT, arguments

BANNED: Final = ROOT / "docs" / "banned-phrases.txt"
LONG: Final = 25
"""Number of words above which a sentence is long."""

CHECKED: Final = ("bench", "drivers", "sim", "config", "procedures", "docs/generators")
SUFFIXES: Final = {".py", ".j2", ".js", ".typ", ".yaml"}

_GAP: Final = r"[\s\"'#]+(?:[fr]{1,2}[\"'])?"
_LEFT_OUT: Final = re.compile(
    r"\A---\n.*?\n---\n|^(?P<fence>`{3,}|:{3,}).*?^(?P=fence)$|<!--.*?-->|^\|[^\n]*$|^#+ [^\n]*$|^\(\S+\)=$"
    r"|(?<=\n\n)(?: {4}\S[^\n]*\n)+",
    re.M | re.S,
)
_MADE: Final = re.compile(r"^<!-- [^>]*: made by [^>]* -->$.*?^<!-- end of [^>]* -->$", re.M | re.S)
"""Text that a command writes into a page, such as tables of results; like generated pages, it is not counted."""
_PICTURE: Final = re.compile(r"!\[[^\]]*\]\([^)]*\)|^```\{(?:figure|image|picture)\}.*$", re.M)
_ITEM: Final = re.compile(r"^\s*(?:[-*+]|\d+\.|:|>)\s+", re.M)
_END: Final = re.compile(r"(?<!\b[A-Z])(?<!e\.g)(?<!i\.e)[.!?][\"'”’)*_]*\s+(?=[\"'“‘(*_]*[^\sa-z])")


@dataclass(frozen=True)
class Prose:
    """The counts for a page."""

    name: str
    words: int
    lengths: tuple[int, ...]
    pictures: int
    banned: tuple[str, ...]

    @property
    def mean(self) -> float:
        """The mean length of a sentence in words."""
        return sum(self.lengths) / max(len(self.lengths), 1)

    @property
    def long_share(self) -> float:
        """The share of sentences over 25 words."""
        return sum(length > LONG for length in self.lengths) / max(len(self.lengths), 1)


def sentences(text: str) -> list[str]:
    """Return the sentences of a page; each item of a list has at least one sentence."""
    text = _ITEM.sub("\n\n", _PICTURE.sub("", _LEFT_OUT.sub("\n\n", text)))
    text = re.sub(r"``.*?``|`[^`]*`", "Code", text)
    text = re.sub(r"\[([^\]]*)\](?:\([^)]*\)|\[[^\]]*\])", r"\1", text)
    found = (one.strip() for part in re.split(r"\n\s*\n", text) for one in _END.split(part))
    return [one for one in found if re.search(r"\w", one) and one not in {"Code", "Code Code"}]


def prose_of(name: str, text: str, phrases: Iterable[str]) -> Prose:
    """Return the counts for a page, without text that a command writes into it."""
    text = _MADE.sub("", text)
    plain = " ".join(re.sub(r"```.*?```|`[^`]*`", "", text, flags=re.S).lower().split())
    banned = tuple(p for p in phrases for _ in re.findall(rf"(?<!\w){re.escape(p)}(?!\w)", plain))
    lengths = tuple(len(re.findall(r"\S*\w\S*", one)) for one in sentences(text))
    return Prose(name, len(text.split()), lengths, len(_PICTURE.findall(text)), banned)


def banned_in(text: str, phrases: Iterable[str]) -> Iterator[tuple[int, str]]:
    """Yield line and phrase of each banned phrase, even if it continues on the next line or in the next literal."""
    plain = text.lower()
    for phrase in phrases:
        words = phrase.split()
        if all(word in plain for word in words):
            first, *others = map(re.escape, words)
            for found in re.finditer(
                rf"{first}(?<!\w{first}){''.join(_GAP + word for word in others)}(?!\w)", plain
            ):
                yield plain.count("\n", 0, found.start()) + 1, phrase


def check(phrases: Iterable[str]) -> int:
    """Print each banned phrase of the project with its place; return how many there are."""
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")]
    files = (path for top in CHECKED for path in (ROOT / top).rglob("*") if path.suffix in SUFFIXES)
    number = 0
    for path in sorted([*pages, *files]):
        text = path.read_text(encoding="utf-8")
        if path.suffix == ".md":
            text = re.sub(r"`[^`\n]*`", "", text)  # CONTRIBUTING.md quotes what not to say
        for line, phrase in sorted(banned_in(text, phrases)):
            print(
                f"{path.relative_to(ROOT)}:{line}: '{phrase}' is banned: say it plainly (CONTRIBUTING.md, Words)"
            )
            number += 1
    return number


def main() -> None:
    asked = arguments(
        __doc__, pages=([""], "only these pages"), check=(False, "only look for banned phrases")
    )
    paths = [Path(one) for one in asked.pages if one] or [
        ROOT / "README.md",
        *sorted((ROOT / "docs").glob("*.md")),
    ]
    phrases = BANNED.read_text(encoding="utf-8").splitlines()
    if asked.check:
        sys.exit(min(check(phrases), 1))
    pages = [prose_of(p.name, p.read_text(encoding="utf-8"), phrases) for p in paths]
    all_lengths = tuple(length for page in pages for length in page.lengths)
    banned = tuple(one for page in pages for one in page.banned)
    totals = Prose("all", sum(p.words for p in pages), all_lengths, sum(p.pictures for p in pages), banned)
    print(f"{'page':<30}{'words':>7}{'sentences':>11}{'mean':>7}{f'over {LONG}':>9}{'pictures':>10}  banned")
    for page in [*pages, totals]:
        found = len(page.banned) if page is totals else ", ".join(dict.fromkeys(page.banned))
        print(
            f"{page.name:<30}{page.words:>7}{len(page.lengths):>11}{page.mean:>7.1f}{page.long_share:>9.1%}"
            f"{page.pictures:>10}  {found}".rstrip()
        )


if __name__ == "__main__":
    main()
