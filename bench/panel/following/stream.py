"""One follower a run, shared by all who look at it, and what each of them is sent: server-sent events.

Events: `state` (a snapshot, whenever something changed), `points` (the residuals: from which place on they replace
what was sent before), `beat` (nothing changed, the panel lives), `trouble` (the record cannot be read; a sentence).
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from bench.base.forms import FileMistakes
from bench.base.numbers import without_infinity
from bench.panel.following.follower import Follower
from bench.panel.following.residuals import Points
from bench.run.answers import AskedPrompt
from bench.run.manifest import RecordError

LOOK_S: Final = 0.05
BEAT_S: Final = 2.0
LINGER_S: Final = 30.0
"""A follower whom nobody looks at any more is kept for so long: a page loaded again finds it as it was."""

JUDGED_AT_ONCE: Final = 20
"""So many readings are judged before what was found is sent: opening a long run shows the rest meanwhile."""

Add = Callable[[Path], dict[str, Any]]
"""What is told of a run beside its record, by its folder: who is in control."""


def as_event(name: str, data: Any) -> bytes:
    """Return a server-sent event; JSON holds no end of line."""
    text = json.dumps(without_infinity(data), ensure_ascii=True, separators=(",", ":"))
    return f"event: {name}\ndata: {text}\n\n".encode()


class Shared:
    """A follower in the background of an event loop: it reads in a thread, and wakes those who look.

    `state` is the snapshot as it was last, `trouble` why there is none.
    """

    def __init__(self, folder: Path, add: Add) -> None:
        self._folder, self._add = folder, add
        self._follower: Follower | None = None
        self._news = asyncio.Event()
        self._added: dict[str, Any] = {}
        self.version = 0
        self.points = Points()
        self.state: dict[str, Any] = {}
        self.sent_state = b""
        self.trouble = ""
        self.watchers = 0
        self._ready = asyncio.Event()
        self._task = asyncio.create_task(self._follow())

    @property
    def prompt(self) -> AskedPrompt | None:
        """The question that stands, None where none does or nobody would hear an answer."""
        return None if self._follower is None else self._follower.prompt

    async def ready(self) -> None:
        """Wait until there is a first snapshot, or trouble."""
        await self._ready.wait()

    def stop(self) -> None:
        """Follow no more."""
        self._task.cancel()

    async def wait(self, version: int) -> bool:
        """Wait until something is new to who saw this version, a heartbeat at most; say whether something is."""
        if self.version == version:
            with suppress(TimeoutError):
                await asyncio.wait_for(self._news.wait(), BEAT_S)
        return self.version != version

    async def _follow(self) -> None:
        while True:
            try:
                news = await asyncio.to_thread(self._look)
            except (RecordError, FileMistakes, OSError) as error:
                news, self.trouble = str(error) != self.trouble, str(error)
            except Exception as error:  # a defect of ours must not leave a page that looks alive
                news, self.trouble = not self.trouble, f"the panel cannot follow this run any more: {error!r}"
            if news:
                self.version += 1
                told, self._news = self._news, asyncio.Event()
                told.set()
            self._ready.set()
            if self.trouble:
                return
            judging = self._follower is not None and self._follower.waiting
            await asyncio.sleep(0.0 if judging else LOOK_S)

    def _look(self) -> bool:
        """Read what is new; say whether there is something to be sent."""
        if self._follower is None:
            self._follower = Follower(self._folder)
        follower = self._follower
        before = follower.points_version
        read = follower.look()
        if not read:
            for _ in range(JUDGED_AT_ONCE):
                if not follower.judge():
                    break
        if follower.points_version != before:
            self.points = follower.points()
        added = self._add(self._folder)
        if read or added != self._added or not self.state:
            self._added = added
            self.state = {**follower.state(), **added}
            self.sent_state = as_event("state", self.state)
            return True
        return follower.points_version != before


class Followers:
    """The followers of the runs that somebody looks at. Lives in one event loop."""

    def __init__(self, add: Add = lambda folder: {}) -> None:
        self._add = add
        self._shared: dict[Path, Shared] = {}

    async def state(self, folder: Path) -> dict[str, Any]:
        """Return the snapshot of a run. Raises `RecordError` where it cannot be read."""
        shared = await self._of(folder)
        try:
            return shared.state
        finally:
            self._leave(folder, shared)

    async def prompt(self, folder: Path) -> AskedPrompt | None:
        """Return the question of a run that stands. Raises `RecordError` where its record cannot be read."""
        shared = await self._of(folder)
        try:
            return shared.prompt
        finally:
            self._leave(folder, shared)

    async def stream(self, folder: Path) -> AsyncIterator[bytes]:
        """Yield server-sent events of a run as long as they are taken. Raises `RecordError` before the first."""
        shared = await self._of(folder)
        try:
            told, sent = Points(), b""
            while True:
                if shared.trouble:
                    yield as_event("trouble", {"words": shared.trouble})
                    return
                version = shared.version
                if shared.sent_state is not sent:
                    sent = shared.sent_state
                    yield sent
                if (points := shared.points) is not told:
                    yield as_event("points", points.since(told))
                    told = points
                if not await shared.wait(version):
                    yield as_event("beat", {})
        finally:
            self._leave(folder, shared)

    def close(self) -> None:
        """Follow no run any more."""
        for shared in self._shared.values():
            shared.stop()
        self._shared.clear()

    async def _of(self, folder: Path) -> Shared:
        shared = self._shared.get(folder)
        if shared is None or shared.trouble:
            shared = self._shared[folder] = Shared(folder, self._add)
        shared.watchers += 1
        try:
            await shared.ready()
            if shared.trouble:
                raise RecordError(shared.trouble)
        except BaseException:
            self._leave(folder, shared)
            raise
        return shared

    def _leave(self, folder: Path, shared: Shared) -> None:
        shared.watchers -= 1
        if shared.watchers == 0:
            with suppress(RuntimeError):  # the loop has ended
                asyncio.get_running_loop().call_later(LINGER_S, self._forget, folder, shared)

    def _forget(self, folder: Path, shared: Shared) -> None:
        if shared.watchers == 0:
            shared.stop()
            if self._shared.get(folder) is shared:
                del self._shared[folder]
