"""Search for English in texts that are shown in Ukrainian."""

import html
import re

TYPED = re.compile(
    r"«bench[^»]*»|'[^']*'|\"[^\"]*\"|\bbench [a-z]+ .*|(?<!\w)--?[a-z][\w-]*|[\w.-]*/[\w./-]*|\w+\.(?:yaml|json)"
    r"|(?:зразкові|відомі):? .*|очікувалося щонайменше .*|\[.*\]"
    r"|(?:\w+, ){3,}\w+:"
)
"""What stays as it is: commands, quoted texts, options, paths, files, units of a question, a list of names."""
TWO_WORDS = re.compile(r"\b[A-Za-z]{2,},? [a-z]{3,}\b")
"""Two words of English, one after the other; a name, a unit or an identifier stands alone."""


def english_in(text: str) -> list[str]:
    """Return the places in a text at which two words of English follow each other."""
    return [found[0] for line in text.splitlines() for found in TWO_WORDS.finditer(TYPED.sub("·", line))]


def words_of(page: str) -> str:
    """Return the text of a page, a line for each block, with the alternative texts of its figures."""
    spoken = re.findall(r'(?:aria-label|alt|title|data-label)="([^"]*)"', page)
    page = re.sub(
        r"<(style|script|code)\b.*?</\1>|</?(?:b|i|sub|sup|a|span)\b[^>]*>", "", page, flags=re.DOTALL
    )
    return html.unescape("\n".join([re.sub(r"<[^>]+>", "\n", page), *spoken]))
