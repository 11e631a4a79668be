"""Procedures, `procedures/*.yaml`: read with their included files, checked, expanded to a flat plan."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from bench.base.computing import uncollected
from bench.base.files import MEGABYTE
from bench.base.languages import message
from bench.base.text import as_typed
from bench.base.yaml_files import (
    Document,
    FileMistake,
    FileMistakes,
    Place,
    document_of,
    load_document,
    part,
    validated,
)
from bench.config.procedure.check import check
from bench.config.procedure.file import (
    FailureSection,
    IncludedFile,
    InputVerb,
    InstallationVerb,
    LevelVerb,
    PowerVerb,
    ProcedureFile,
    ReadingSection,
    ReadVerb,
    RepeatVerb,
    SettleForm,
    StepEntry,
    TemperaturesVerb,
    TurnVerb,
    heating,
)
from bench.config.procedure.plan import (
    SETTLING,
    Level,
    Mount,
    OnFailure,
    Plan,
    Read,
    SelectInput,
    Step,
    Turn,
    Wait,
)
from bench.config.procedure.steps import ActionVerb, mount_in_words
from bench.readings.table import REFERENCE, SHORTED
from drivers.interfaces import Direction

__all__ = ["Procedure", "check", "load_procedure"]

_INCLUDE: Final = "include"

MOST_BYTES: Final = 10 * MEGABYTE
"""Largest size of the procedure file, which a program may have written; included files have a lower limit."""

MOST_FILES: Final = 1_000
"""The greatest number of included files; more files are a mistake."""

MOST_DEEP: Final = 100
"""The greatest depth to which files may include each other."""

_TOO_DEEP: Final = "steps and included files are nested too deeply; nest fewer"


@dataclass(frozen=True)
class Procedure:
    """A procedure with its plan; `files` lists its own file, then the included ones in reading order."""

    name: str
    title: str
    files: tuple[Path, ...]
    plan: Plan

    def expand(self) -> Plan:
        """Return the flat plan, which was expanded when the procedure was loaded."""
        return self.plan


@uncollected()
def load_procedure(path: Path, content: bytes | None = None) -> Procedure:
    """Read and check a procedure. Raises `FileMistakes` with every mistake in it and its included files.

    If `content` is given, the file itself is not read, because it may not exist yet.
    """
    try:
        return _loaded(path, content)
    except RecursionError:
        raise FileMistakes(path, [FileMistake(0, "steps", _TOO_DEEP)]) from None


def _loaded(path: Path, content: bytes | None) -> Procedure:
    tree = _Tree(path, content)
    if tree.mistakes:
        raise FileMistakes(path, sorted(set(tree.mistakes), key=_in_order))
    root = tree.files[path.resolve()]
    expansion = Expansion(tree.documents, tree.files)
    steps = expansion.run(path.resolve())
    if expansion.mistakes:
        found = [tree.located(document, mistake) for document, mistake in expansion.mistakes]
        raise FileMistakes(path, sorted(set(found), key=_in_order))
    name = root.procedure or path.stem
    plan = Plan(name, steps, tree.sha256, root.operator_time.to_plan())
    return Procedure(name, root.title, tuple(d.path for d in tree.documents.values()), plan)


def _in_order(mistake: FileMistake) -> tuple[str, int, str, str]:
    return mistake.file, mistake.line, mistake.place, mistake.text


class _Tree:
    """A procedure file and all included files, by resolved path, with the mistakes in all of them."""

    def __init__(self, path: Path, content: bytes | None) -> None:
        self.documents: dict[Path, Document] = {}
        self.files: dict[Path, IncludedFile] = {}
        self.mistakes: list[FileMistake] = []
        self._refused: dict[Path, str] = {}
        self._checked: set[tuple[Path, frozenset[str]]] = set()
        self._root = load_document(path, MOST_BYTES) if content is None else document_of(path, content)
        if not (isinstance(self._root.data, dict) and {"procedure", "steps"} & set(self._root.data)):
            text = message("this is not a procedure: 'procedure' and 'steps' are missing")
            raise FileMistakes(path, [FileMistake(0, "", text)])
        self._read(self._root, ProcedureFile, ())
        self._check_scopes(self._root, part(self._root.data, "steps"), ("steps",), frozenset())

    @property
    def sha256(self) -> str:
        """The SHA-256 of the file's bytes; of several files, the SHA-256 of their concatenated hex digests."""
        digests = [document.sha256 for document in self.documents.values()]
        return digests[0] if len(digests) == 1 else hashlib.sha256("".join(digests).encode()).hexdigest()

    def located(self, document: Document, mistake: FileMistake) -> FileMistake:
        """Return the mistake; if it is in an included file, with the name of that file."""
        return mistake if document is self._root else replace(mistake, file=str(document.path))

    def _read(self, document: Document, model: type[IncludedFile], chain: tuple[Path, ...]) -> None:
        here = document.path.resolve()
        self.documents[here] = document
        try:
            self.files[here] = validated(document, model)
        except FileMistakes as error:
            self.mistakes += [self.located(document, mistake) for mistake in error.mistakes]
        for place, verb, body in _walk(part(document.data, "steps"), ("steps",)):
            if verb == _INCLUDE and isinstance(body, str):
                problem = self._include(document, body, (*chain, here))
                if problem:
                    at = document.mistake((*place, _INCLUDE), problem)
                    self.mistakes.append(self.located(document, at))

    def _include(self, document: Document, name: str, chain: tuple[Path, ...]) -> str:
        """Read an included file if it is new; return the reason why it cannot be included, or an empty text."""
        path = document.path.parent / name
        key = _resolved(path)
        if key in chain:
            circle = [*chain[chain.index(key) :], path]
            return f"the file includes itself, remove that: {' → '.join(p.name for p in circle)}"
        if key in self.documents:
            return ""
        if key not in self._refused:
            self._refused[key] = self._included(path, key, chain)
        return self._refused[key]

    def _included(self, path: Path, key: Path, chain: tuple[Path, ...]) -> str:
        if path.suffix.lower() not in _SUFFIXES or key.suffix.lower() not in _SUFFIXES:
            return f"{path}: name a file that ends with .yaml or .yml"
        if len(self.documents) > MOST_FILES:
            return f"more than {MOST_FILES} files are included; merge some"
        if len(chain) >= MOST_DEEP:
            return f"{path.name}: files are nested more than {MOST_DEEP} levels deep; include it further up"
        try:
            included = load_document(path)
        except FileMistakes as error:
            return self._unreadable(path, error.mistakes[0])
        if not (isinstance(included.data, dict) and "steps" in included.data):
            return message(f"{path}: this is not a procedure: 'steps' is missing")
        self._read(included, IncludedFile, chain)
        return ""

    def _unreadable(self, path: Path, mistake: FileMistake) -> str:
        """Return why an included file cannot be read; for a file that is not YAML, record a mistake and return "".

        The file is not quoted, since it may not be a procedure at all.
        """
        if not mistake.line:
            return f"{path}: {mistake.text}"
        told = f"this is not YAML in UTF-8; 'bench check {as_typed(path.name)}' shows the line"
        self.mistakes.append(FileMistake(mistake.line, "", told, str(path)))
        return ""

    def _check_scopes(self, document: Document, steps: Any, place: Place, within: frozenset[str]) -> None:
        """Check that every verb is allowed inside the verbs `within`; `steps` are as written, valid or not.

        An included file is checked once for each set of enclosing verbs, so that no mistake is reported twice.
        """
        for entry, verb, body in _entries(steps, place):
            if problem := _misplaced(verb, within):
                self.mistakes.append(self.located(document, document.mistake((*entry, verb), problem)))
            inner = within | {verb}
            if verb == _INCLUDE and isinstance(body, str):
                key = _resolved(document.path.parent / body)
                if key in self.documents and (key, inner) not in self._checked:
                    self._checked.add((key, inner))
                    included = self.documents[key]
                    self._check_scopes(included, part(included.data, "steps"), ("steps",), inner)
            elif steps_inside := part(body, "steps"):
                self._check_scopes(document, steps_inside, (*entry, verb, "steps"), inner)


_SUFFIXES: Final = frozenset({".yaml", ".yml"})


def _resolved(path: Path) -> Path:
    """Return a path with symbolic links resolved, or the path itself if that fails; reading it then reports why."""
    try:
        return path.resolve()
    except (OSError, RuntimeError, ValueError):
        return path


def _misplaced(verb: str, within: frozenset[str]) -> str:
    """Return the reason why a verb is not allowed inside the verbs `within`; empty if it is allowed."""
    text = ""
    match verb:
        case _ if "input" in within:
            if verb in _NOT_IN_AN_INPUT:
                text = f"{_a(verb)} is inside an input, where no signal is connected; move it out"
        case "installation" if verb in within:
            text = "an installation is inside another; end the first one before it"
        case "temperatures" if verb in within:
            text = "a list of temperatures is inside another; merge them"
        case "turn" | "read" if "installation" not in within:
            text = f"a {verb} is outside of an installation; move it into the steps of one"
        case "read" if "turn" not in within:
            text = "a read is outside of a turn; move it into the turn's steps"
        case "turn" | "repeat" | "temperatures" | "level" if "turn" in within:
            text = f"{_a(verb)} is inside the steps of a turn; put it around the turn"
    return text


_NOT_IN_AN_INPUT: Final = frozenset(
    {"turn", "installation", "input", "temperature", "temperatures", "level", "power"}
)


def _a(verb: str) -> str:
    """Return the name of a verb's action with its article, such as "an installation"."""
    if verb == "power":
        return "a switching of the block"
    return "a list of temperatures" if verb == "temperatures" else f"a{'n' * (verb[0] in 'ai')} {verb}"


def _entries(steps: Any, place: Place) -> Iterator[tuple[Place, str, Any]]:
    """Yield place, verb and body of each step in a list as written."""
    for index, entry in enumerate(steps if isinstance(steps, list) else []):
        for verb, body in entry.items() if isinstance(entry, dict) else ():
            yield (*place, index), verb, body


def _walk(steps: Any, place: Place) -> Iterator[tuple[Place, str, Any]]:
    """Yield place, verb and body of each step in a list as written, nested steps included."""
    for entry, verb, body in _entries(steps, place):
        yield entry, verb, body
        if steps_inside := part(body, "steps"):
            yield from _walk(steps_inside, (*entry, verb, "steps"))


MOST_STEPS: Final = 200_000
"""The greatest number of steps in a plan; more steps are a mistake in the file."""

_DIRECTIONS: Final[Mapping[str, Direction]] = {"rising": 1, "falling": -1}
_INPUTS: Final[Mapping[str, str]] = {"short": SHORTED, "reference": REFERENCE}


@dataclass(frozen=True)
class _Context:
    """The position in the procedure at which a step is expanded: mounting, pass, point and the enclosing verbs.

    Fields of verbs that do not enclose the step have defaults.
    """

    document: Document
    reading: ReadingSection
    installation: str = ""
    series: int = 1
    pass_number: int = 1
    direction: Direction = 1
    point: int = 0
    target_rad: float = 0.0
    input: str = ""
    on_failure: FailureSection | None = None
    scan: str = ""

    @property
    def mount(self) -> str:
        """The mounting as part of a step key: "1", or "1s2" for series 2."""
        return self.installation if self.series == 1 else f"{self.installation}s{self.series}"

    @property
    def place(self) -> tuple[str, int, int, int]:
        return self.installation, self.series, self.pass_number, self.point

    @property
    def place_key(self) -> str:
        """The point as part of a step key: "1.2.5" for installation 1, pass 2, point 5."""
        return f"{self.mount}.{self.pass_number}.{self.point}"

    def inside(self, document: Document, file: IncludedFile) -> _Context:
        """Return the context for the steps of an included file; its sections override those of this one."""
        return replace(
            self,
            document=document,
            reading=file.reading or self.reading,
            on_failure=file.on_failure or self.on_failure,
        )

    def failure(self, *nearer: FailureSection | None) -> OnFailure:
        said = next((section for section in (*nearer, self.on_failure) if section is not None), None)
        return OnFailure() if said is None else said.to_plan()


class _TooLong(Exception):
    """The plan exceeds `MOST_STEPS` steps."""


class Expansion:
    """The expansion of a procedure into steps; its files are valid, and every verb is allowed where it occurs.

    `mistakes` holds the mistakes that only the expansion reveals (such as a point read twice), each with its
    document.
    """

    def __init__(self, documents: Mapping[Path, Document], files: Mapping[Path, IncludedFile]) -> None:
        self.mistakes: list[tuple[Document, FileMistake]] = []
        self._documents = documents
        self._files = files
        self._steps: list[Step] = []
        self._mounted: set[tuple[str, int]] = set()
        self._read: set[tuple[str, int, int, int]] = set()
        self._measured: set[tuple[str, int]] = set()
        self._input_points: Counter[tuple[str, int, int]] = Counter()
        self._noted: set[tuple[Path, Place]] = set()
        self._paths: dict[tuple[int, str], Path] = {}
        self._since_power: dict[tuple[str, int], int | None] = {}
        self._levelled: tuple[str, int] | None = None

    def run(self, root: Path) -> tuple[Step, ...]:
        """Return the steps of the procedure in the file `root`."""
        document, file = self._documents[root], self._files[root]
        context = _Context(document, ReadingSection()).inside(document, file)
        try:
            self._all(file.steps, ("steps",), context)
        except _TooLong:
            text = f"the procedure has more than {MOST_STEPS} steps; check its repeats, counts and includes"
            self.mistakes.append((document, document.mistake(("steps",), text)))
        return tuple(self._steps)

    def _key(self, kind: str, where: str = "") -> str:
        if len(self._steps) >= MOST_STEPS:
            raise _TooLong
        return f"{len(self._steps) + 1:04d}/{kind}" + (f"/{where}" if where else "")

    def _once(self, context: _Context, place: Place, text: str) -> None:
        """Record a mistake at a place of a file once, even if that place is expanded repeatedly."""
        if (context.document.path, place) not in self._noted:
            self._noted.add((context.document.path, place))
            self.mistakes.append((context.document, context.document.mistake(place, text)))

    def _all(self, entries: Sequence[StepEntry], place: Place, context: _Context) -> None:
        for index, entry in enumerate(entries):
            self._one(entry, (*place, index), self._since_switched(context))

    def _one(self, entry: StepEntry, place: Place, context: _Context) -> None:
        verb, body = entry.given
        here = (*place, verb)
        match body:
            case InstallationVerb():
                self._installation(body, here, context)
            case RepeatVerb():
                self._repeat(body, here, context)
            case TurnVerb():
                self._turn(body, here, context)
            case ReadVerb():
                self._reading(body, here, context)
            case InputVerb():
                self._input(body, here, context)
            case TemperaturesVerb():
                self._temperatures(body, here, context)
            case LevelVerb():
                self._level(body, place, context)
            case str():
                path = self._path_of(context.document, body)
                inside = context.inside(self._documents[path], self._files[path])
                self._all(self._files[path].steps, ("steps",), inside)
            case ActionVerb():
                self._take(body.plan_steps(self._key))
                if isinstance(body, PowerVerb):
                    self._note_power(body, context)

    def _take(self, steps: Iterator[Step]) -> None:
        for step in steps:  # one by one: the key of a step contains the number of steps before it
            self._steps.append(step)

    def _path_of(self, document: Document, name: str) -> Path:
        """Return the resolved path of an included file, from a cache to save system calls."""
        if (id(document), name) not in self._paths:
            self._paths[id(document), name] = (document.path.parent / name).resolve()
        return self._paths[id(document), name]

    def _installation(self, verb: InstallationVerb, place: Place, context: _Context) -> None:
        series = verb.series or self._next_series(verb.label)
        if (verb.label, series) in self._mounted:
            where = mount_in_words(verb.label, series)
            text = f"installation {where} was visited before; give this visit another series"
            self._once(context, (*place, "series"), text)
        self._mounted.add((verb.label, series))
        inside = replace(context, installation=verb.label, series=series)
        if verb.level is not None:
            key = self._key("level", inside.mount)
            self._levelled = (verb.label, series)
            self._steps.append(Level(key, *self._levelled, verb.level.settings, verb.level.within))
        self._steps.append(Mount(self._key("mount", inside.mount), verb.label, series))
        self._all(verb.steps, (*place, "steps"), inside)

    def _level(self, verb: LevelVerb, place: Place, context: _Context) -> None:
        """Append a reading of the level; it belongs to the mounting for which the platform was last levelled."""
        if self._levelled is None:
            text = (
                "the platform was not levelled before: give an installation before it 'level: {}', so that this "
                "shows how it has moved since"
            )
            self._once(context, (*place, "level"), text)
            return
        label, series = self._levelled
        mount = label if series == 1 else f"{label}s{series}"
        self._steps.append(Level(self._key("level", mount), label, series, verb.settings))

    def _next_series(self, label: str) -> int:
        return max((series for known, series in self._mounted if known == label), default=0) + 1

    def _repeat(self, verb: RepeatVerb, place: Place, context: _Context) -> None:
        directions = [_DIRECTIONS[word] for word in verb.directions or ()]
        before = (context.pass_number - 1) * verb.passes
        for index in range(verb.passes):
            number = before + index + 1
            direction = directions[index] if directions else context.direction
            scan = verb.scans[index] if verb.scans else context.scan
            inside = replace(context, pass_number=number, direction=direction, scan=scan)
            self._all(verb.steps, (*place, "steps"), inside)

    def _turn(self, verb: TurnVerb, place: Place, context: _Context) -> None:
        direction = _DIRECTIONS[verb.direction] if verb.direction else context.direction
        points = list(enumerate(verb.angles_rad, start=verb.first_point))
        for point, target_rad in points if direction > 0 else reversed(points):
            here = replace(
                self._since_switched(context), direction=direction, point=point, target_rad=target_rad
            )
            key = self._key("turn", here.place_key)
            self._steps.append(Turn(key, *here.place, target_rad, direction, here.failure()))
            self._all_or_reading(verb.steps, place, here)

    def _all_or_reading(self, steps: Sequence[StepEntry] | None, place: Place, context: _Context) -> None:
        """Expand the steps; without steps, settle as in the section `reading` and take one reading."""
        if steps is not None:
            self._all(steps, (*place, "steps"), context)
            return
        settle = context.reading.settle
        if isinstance(settle, SettleForm):
            self._take(settle.plan_steps(self._key))
        elif settle:
            self._wait(settle, SETTLING)
        self._reading(ReadVerb(), place, context)

    def _input(self, verb: InputVerb, place: Place, context: _Context) -> None:
        if self._steps and isinstance(self._steps[-1], SelectInput):
            self._steps.pop()  # switch directly from one input to the next, not back to the signals in between
        self._steps.append(SelectInput(self._key("input"), verb.source, verb.voltage))
        self._all_or_reading(verb.steps, place, replace(context, input=_INPUTS[verb.source]))
        self._steps.append(SelectInput(self._key("input"), "signal"))

    def _reading(self, verb: ReadVerb, place: Place, context: _Context) -> None:
        for index in range(verb.times):
            if index and verb.pause:
                self._wait(verb.pause, message("until the next reading"))
            if context.input:
                self._read_input(verb, context)
            else:
                self._read_point(verb, place, replace(context, point=context.point + index))

    def _read_input(self, verb: ReadVerb, context: _Context) -> None:
        """Append a reading of the shorted or reference input; its points are numbered within each pass."""
        where = (context.input, context.series, context.pass_number)
        self._input_points[where] += 1
        here = replace(context, installation=context.input, point=self._input_points[where])
        self._append_read(verb, here, None, None)

    def _read_point(self, verb: ReadVerb, place: Place, context: _Context) -> None:
        if context.place in self._read:
            where = mount_in_words(context.installation, context.series)
            text = (
                f"point {context.point} of pass {context.pass_number} in installation {where} is read "
                "twice; give each turn another 'first_point', and a turn that reads several 'times' one angle"
            )
            self._once(context, place, text)
        self._read.add(context.place)
        self._measured.add((context.installation, context.series))
        self._append_read(verb, context, context.target_rad, context.direction)

    def _append_read(
        self, verb: ReadVerb, context: _Context, target_rad: float | None, direction: Direction | None
    ) -> None:
        key = self._key("read", context.place_key)
        samples, nplc = verb.samples or context.reading.samples, verb.nplc or context.reading.nplc
        failure = context.failure(verb.on_failure, context.reading.on_failure)
        self._steps.append(
            Read(key, *context.place, target_rad, direction, samples, nplc, failure, context.scan)
        )

    def _wait(self, duration_s: float, reason: str) -> None:
        self._steps.append(Wait(self._key("wait"), duration_s, reason))

    def _note_power(self, verb: PowerVerb, context: _Context) -> None:
        """Note that the block was switched on again: later readings on this mounting start a new series."""
        mounted = (context.installation, context.series)
        if verb.switch != "off" and mounted in self._measured:
            self._since_power[mounted] = None

    def _since_switched(self, context: _Context) -> _Context:
        """Return the context with a new series number if the block was switched on again during its mounting."""
        series = context.series
        while (mounted := (context.installation, series)) in self._since_power:
            following = self._since_power[mounted]
            if following is None:  # first step since the switch-on
                following = self._since_power[mounted] = self._next_series(context.installation)
                self._mounted.add((context.installation, following))
            series = following
        return context if series == context.series else replace(context, series=series)

    def _temperatures(self, verb: TemperaturesVerb, place: Place, context: _Context) -> None:
        """Expand the steps at each temperature; while the block stays mounted, each is a new series."""
        inside = context
        for at_c in verb.at:
            self._take(heating(verb, at_c, self._key))
            inside = self._since_switched(inside)
            if (inside.installation, inside.series) in self._measured:
                inside = replace(inside, series=self._next_series(inside.installation))
                self._mounted.add((inside.installation, inside.series))
            self._all(verb.steps, (*place, "steps"), inside)
