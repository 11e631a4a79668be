"""The terminal session of the first page: recorded from the program when the site is built, shown line by line.

The style sheet lets the lines appear one after another; a reader who wants no motion sees all of them at once.
"""

from __future__ import annotations

import re
from functools import cache
from html import escape
from typing import Final

from docs.generators.workbench import workbench

WAIT_S: Final = 0.12
"""Between two lines of an answer; a command waits for `TYPED_S` beforehand."""
TYPED_S: Final = 1.2
SESSION: Final = (
    ("run paper --dry-run --name first --seed 1", r"^first \(|^lack of fit|^report"),
    ("calibrate first", r"^coefficient|^K[xyz]{2}|^U0|^noise"),
    ("run paper --dry-run --name bent --seed 2 --model bent.yaml", r"^bent \(|^lack of fit|^next"),
    ("diagnose bent", r"^Found|^  sine|^Gap closed|^bent"),
)
"""Each command, and the lines of its answer that are shown."""
WIDTH: Final = 96


@cache
def recorded() -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Return each command of the session with the lines of its answer that are shown."""
    printed = workbench().printed
    return tuple(
        (command, tuple(_cut(line) for line in printed[command].splitlines() if re.search(wanted, line)))
        for command, wanted in SESSION
    )


def _cut(line: str) -> str:
    return line if len(line) <= WIDTH else f"{line[: WIDTH - 2].rstrip()} …"


def shown(words: str) -> str:
    """Return the session as HTML, each line with the time at which it appears."""
    at_s, lines = 0.0, []
    for command, answer in recorded():
        lines.append(
            f'<span class="typed" style="animation-delay:{at_s:.2f}s">$ bench {escape(command)}</span>'
        )
        at_s += TYPED_S
        for line in answer:
            lines.append(f'<span style="animation-delay:{at_s:.2f}s">{escape(line)}</span>')
            at_s += WAIT_S
        at_s += TYPED_S
    return (
        f'<pre class="session" role="group" tabindex="0" aria-label="{escape(words)}">'
        + "\n".join(lines)
        + "</pre>"
    )
