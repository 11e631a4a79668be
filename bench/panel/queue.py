"""The queue of the day: units to be measured, in order; who is on duty; when a bench was switched on.

The queue starts nothing. A person begins each item; its state is read from its run.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, ValidationError

from bench.base.languages import message
from bench.panel.access import KeptList, Person, Refusal
from bench.panel.launching import LONGEST_START_S
from bench.run.events import RecordError
from drivers.clock import utc_now

ITEMS: Final = "queue.json"
NOTES: Final = "day.json"
MOST_ITEMS: Final = 200
MOST_NOTES: Final = 100
REMEDY: Final = message("put the file aside on the page of the queue, and begin a new queue")
DUTY: Final = message("on duty")
OFF_DUTY: Final = message("off duty")
SWITCHED_ON: Final = message("switched on")


class _Row(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class QueueItem(_Row):
    """A unit to be measured: serial number (empty: as in the bench file), names of procedure and bench file.

    `wish` is the latest check's id, `run` the run's name, `begun` when a person began it; empty until then.
    """

    id: Annotated[str, Field(pattern=r"^[0-9a-f]{12}$")]
    unit: str
    procedure: str
    bench: str
    dry_run: bool
    added_by: str
    wish: str = ""
    run: str = ""
    begun: AwareDatetime | None = None

    @property
    def words(self) -> str:
        """The item in a few words, such as "17-042: calibration on bench-lan"."""
        return f"{self.unit or message('unit of the bench file')}: {self.procedure} on {self.bench}"


class DayNote(_Row):
    """A note of the day: `what` (`DUTY`, `OFF_DUTY` or `SWITCHED_ON`), its author and time, and the bench."""

    what: str
    who: str
    at: AwareDatetime
    bench: str = ""


class DayQueue:
    """The queue of a panel, in files of its private folder that survive a restart."""

    def __init__(self, folder: Path) -> None:
        self._items = KeptList(folder, ITEMS, REMEDY)
        self._notes = KeptList(folder, NOTES, REMEDY)

    def items(self) -> list[QueueItem]:
        """Return the items in order. Raises `RecordError` for a damaged file."""
        return _read(self._items.path, self._items.rows(), QueueItem)

    def item(self, item_id: str) -> QueueItem:
        """Return the item with this id. Raises `Refusal` (409) if it is not in the queue."""
        items = self.items()
        return items[_index(items, item_id)]

    def add(self, items: Sequence[QueueItem]) -> None:
        """Append items. Raises `Refusal` (409) if the queue would have more than `MOST_ITEMS`."""
        with self._changed() as queue:
            queue.extend(items)
            if len(queue) > MOST_ITEMS:
                raise Refusal(409, f"the queue holds at most {MOST_ITEMS} units; remove those that are done")

    def move(self, item_id: str, by: int) -> None:
        """Move an item up (`by` −1) or down (1), not beyond the ends. Raises `Refusal` (409) without the item."""
        with self._changed() as items:
            at = _index(items, item_id)
            items.insert(max(at + by, 0), items.pop(at))

    def remove(self, ids: Sequence[str]) -> None:
        """Remove items; ids that are no longer in the queue are ignored."""
        with self._changed() as items:
            items[:] = [one for one in items if one.id not in ids]

    def change(self, item_id: str, **values: object) -> None:
        """Set members of an item. Raises `Refusal` (409) if it is not in the queue."""
        with self._changed() as items:
            at = _index(items, item_id)
            items[at] = items[at].model_copy(update=values)

    def claim(self, item_id: str, run: str, exists: Callable[[str], bool]) -> None:
        """Store `run` as the name of an item's run before its start; `exists(name)` says if a run exists.

        Raises `Refusal` (409) if the item was begun already or is not in the queue.
        """
        with self._changed() as items:
            at = _index(items, item_id)
            item = items[at]
            if item.run and (exists(item.run) or self.is_starting(item)):
                raise Refusal(409, f"{item.words} was begun already; see the run {item.run}")
            items[at] = item.model_copy(update={"run": run, "begun": utc_now()})

    def is_starting(self, item: QueueItem) -> bool:
        """Whether the run of an item was requested so recently that its folder may not exist yet."""
        return item.begun is not None and utc_now() - item.begun < timedelta(seconds=2 * LONGEST_START_S)

    # --- notes of the day ---------------------------------------------------------------------------

    def note(self, what: str, person: Person, bench: str = "") -> None:
        """Store a note of the day; `what` is as in `DayNote`."""
        with self._notes.changed() as rows:
            rows.append(
                DayNote(what=what, who=person.name, at=utc_now(), bench=bench).model_dump(mode="json")
            )
            del rows[:-MOST_NOTES]

    def on_duty(self) -> DayNote | None:
        """Return who is on duty and since when; None for nobody. Raises `RecordError` for a damaged file."""
        notes = [one for one in self._notes_read() if one.what in {DUTY, OFF_DUTY}]
        return notes[-1] if notes and notes[-1].what == DUTY else None

    def switched_on(self) -> Mapping[str, DayNote]:
        """Return the latest note of switching on, for each bench. Raises `RecordError` for a damaged file."""
        return {one.bench: one for one in self._notes_read() if one.what == SWITCHED_ON}

    def put_aside(self) -> None:
        """Rename damaged files, so that an empty queue replaces them. Raises `OSError`."""
        self._items.put_aside(utc_now(), lambda rows: _read(self._items.path, rows, QueueItem))
        self._notes.put_aside(utc_now(), lambda rows: _read(self._notes.path, rows, DayNote))

    def _notes_read(self) -> list[DayNote]:
        return _read(self._notes.path, self._notes.rows(), DayNote)

    @contextmanager
    def _changed(self) -> Iterator[list[QueueItem]]:
        with self._items.changed() as rows:
            items = _read(self._items.path, rows, QueueItem)
            yield items
            rows[:] = [one.model_dump(mode="json") for one in items]


def new_item(unit: str, procedure: str, bench: str, by: str, *, dry_run: bool) -> QueueItem:
    """Return an item with an id of its own, added by the person named `by`."""
    return QueueItem(
        id=secrets.token_hex(6), unit=unit, procedure=procedure, bench=bench, dry_run=dry_run, added_by=by
    )


def _index(items: Sequence[QueueItem], item_id: str) -> int:
    for index, item in enumerate(items):
        if item.id == item_id:
            return index
    raise Refusal(409, "somebody removed this unit from the queue; load the page again")


Row = TypeVar("Row", QueueItem, DayNote)


def _read(file: Path, rows: Sequence[Mapping[str, Any]], kind: type[Row]) -> list[Row]:
    """Return the rows of a file as objects. Raises `RecordError` for a row that cannot be understood."""
    found: list[Row] = []
    for number, row in enumerate(rows, start=1):
        try:
            found.append(kind.model_validate(row))
        except ValidationError as error:
            names = ", ".join(dict.fromkeys(str(one["loc"][0]) for one in error.errors() if one["loc"]))
            raise RecordError(
                f"{file}, row {number}: cannot be understood (wrong or missing: {names}); {REMEDY}"
            ) from error
    return found
