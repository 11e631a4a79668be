"""Who is heard while a run goes on: its person, at a terminal or away from one, and wishes left in its folder."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

from rich.console import Console

from bench.run.events import Event, EventType
from bench.run.folder import Run
from bench.run.listening import Asker, WishListener
from bench.run.person import at_the_shell
from bench.run.record import History, Record
from bench.run.sentences import TERMINAL, sentence
from bench.run.terminal import TerminalPerson


@dataclass(frozen=True)
class Heard:
    """`wishes` are those left in the run's folder; `asker` is its living person, None where none is asked."""

    wishes: WishListener
    asker: Asker | None = None


def heard_in(
    run: Run, record: Record, history: History | None, wishes: WishListener, out: Console, *, away: bool
) -> Heard:
    """Return who is heard in a run, new or (with its `history`) resumed; nobody is at a terminal if `away`.

    Whoever takes up a dry run that stopped is there to be asked how to go on.
    """
    if not run.asks_somebody and history is None:
        return Heard(wishes)
    last_s = history.events[-1].bench_s if history is not None and history.events else 0.0

    def tell(kind: EventType, data: dict[str, Any]) -> Event:
        event = record.append(kind, last_s, **data)
        if (text := sentence(event)) != event.type:
            out.print(text, style="bold yellow", highlight=False)
        return event

    terminal = None if away else TerminalPerson(sys.stdin, out, wishes=(), who=at_the_shell(TERMINAL))
    heard_before = history.progress.answers_heard if history is not None else 0
    return Heard(wishes, Asker(run.folder, record, tell, terminal=terminal, heard=heard_before))
