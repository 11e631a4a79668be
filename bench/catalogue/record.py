"""The record of a run as the catalogue reads it: its chain of hashes, the run's state, what it read.

What is proved (column `record`): "chain" where every line carries the hash of the one before and the inputs are
those of `run.json`, without a look at what the lines say; "read" where each was also read as an event that may
stand there, as `bench show --verify` does; "broken" with the reason in `problem`; "none" where there is no line
yet. None of them shows that lines are missing at the end, or that a whole chain was computed anew: for that, keep
the head elsewhere.
"""

from __future__ import annotations

import hashlib
import math
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from bench.base.json_text import read_json
from bench.base.regular import read_regular
from bench.run.folder import Run
from bench.run.manifest import EVENTS, MANIFEST, Manifest, sha256
from bench.run.states import RunState, state_after_one

_END: Final = b', "prev": "%s"}'
"""How each line ends: with the hash of the one before."""
_CHANGING: Final = re.compile(rb'"type": "(run_[a-z]+)"')
_OPENED: Final = frozenset({"run_started", "run_resumed"})
_STEP_OF_READING: Final = re.compile(rb'"type": "step_done", "step": (\d+), [^{}\n]*"reading": \{')
_TEMPERATURE: Final = re.compile(rb'"reading": \{[^{}\n]*"temperature_c": (-?[0-9.eE+-]+)')
_TIME: Final = re.compile(rb'"time": "([^"]{1,40})"')


class RecordSeen:
    """The lines of a record gone through as bytes: their chain, the run's state, which steps were read."""

    def __init__(self, folder: Path, manifest: Manifest, manifest_sha256: str) -> None:
        self.folder = folder
        self.head, self.count, self.state = manifest_sha256, 0, RunState.READY
        self.problem = ""
        self.steps: set[bytes] = set()
        self.started: dict[str, Any] = {}
        self.whole = False
        self._temperatures: list[float] = []
        self._last = b""
        self._check_inputs(manifest)
        try:
            content = read_regular(folder / EVENTS)
        except FileNotFoundError:
            content = b""
        self._go_through(content)

    def _check_inputs(self, manifest: Manifest) -> None:
        for name, digest in manifest["files"].items():
            if Path(name).name != name:
                self.problem = f"{MANIFEST} names an input outside of the folder"
                return
            file = self.folder / name
            if not file.is_file() or sha256(read_regular(file)) != digest:
                self.problem = f"{name} was changed since the run began"

    def _go_through(self, content: bytes) -> None:
        lines = content.split(b"\n")[:-1]
        heads = [self.head.encode(), *(hashlib.sha256(line).hexdigest().encode() for line in lines)]
        count = next((k for k, line in enumerate(lines) if not line.endswith(_END % heads[k])), len(lines))
        if count < len(lines):
            self.problem = f"{EVENTS}, line {count + 1}: the chain is broken here"
        self.head, self.count = heads[count].decode(), count
        self._note(content[: sum(len(line) + 1 for line in lines[:count])])

    def _note(self, content: bytes) -> None:
        """Note what the lines say that the catalogue keeps; a text of an operator cannot look like one of them."""
        for found in _CHANGING.finditer(content):
            name = found.group(1).decode()
            self.state = state_after_one(self.state, name)
            if name in _OPENED and not self.started:
                begin, end = content.rfind(b"\n", 0, found.start()) + 1, content.index(b"\n", found.start())
                self.started = read_json(content[begin:end])
        self.steps = set(_STEP_OF_READING.findall(content))
        # of a step that was read again both count in the mean
        told = _TEMPERATURE.findall(content) if self.steps else []
        self._temperatures = [float(value) for value in told]
        self._last = content[content.rfind(b"\n", 0, -1) + 1 :]

    def read_whole(self) -> None:
        """Read every event, as `bench show --verify` does."""
        if problems := Run(self.folder).history.problems:
            self.problem = "; ".join(problems)
        self.whole = True

    @property
    def proved(self) -> str:
        """What is proved of the record."""
        if self.problem:
            return "broken"
        return ("read" if self.whole else "chain") if self.count else "none"

    @property
    def ended(self) -> datetime | None:
        """Civil time of the last event of a run that is not going on."""
        if self.state in (RunState.READY, RunState.RUNNING, RunState.PAUSED):
            return None
        told = _TIME.search(self._last)
        return utc_of(told.group(1).decode()) if told else None

    @property
    def temperature_c(self) -> float | None:
        """Mean of the temperatures of the readings, °C."""
        finite = [value for value in self._temperatures if math.isfinite(value)]
        return sum(finite) / len(finite) if finite else None


def utc_of(text: Any) -> datetime | None:
    """Return a civil time of a record as UTC without zone; None for what is none."""
    try:
        when = datetime.fromisoformat(str(text))
    except ValueError:
        return None
    return when.astimezone(UTC).replace(tzinfo=None) if when.tzinfo else None
