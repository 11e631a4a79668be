"""Bench files in a form: their list, the form with its mistakes, finding instruments, writing and testing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

import yaml
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response

from bench.base.languages import message
from bench.base.text import visible
from bench.base.yaml_files import FileMistake, FileMistakes, document_of, dotted, read_yaml, validated
from bench.config.bench_file.file import BenchFile
from bench.config.shipped import CONFIG
from bench.panel.access import STATE, Person, Refusal, Role
from bench.panel.bench_fields import (
    METERS_PLACE,
    OF_BENCH,
    Group,
    completed,
    groups_of,
    number_of_meters,
    placed,
    values_of,
)
from bench.panel.launching import choices
from bench.panel.own_files import (
    EditedFile,
    FileText,
    own_file,
    own_files,
    read_file,
    shipped_file,
    shipped_files,
)
from bench.panel.round_trip import changed_text, signed
from bench.panel.searching import IDENTIFY, OFFERS, TEST, Findings, Search
from bench.panel.shared import Panel, acting, operator, page, panel_of
from drivers.clock import utc_now

MOST_FIELDS: Final = 300
LONGEST: Final = 400
TARGETS: Final = ("x", "y", "z", "scanner", "head", "chamber")
"""Instruments to which a found resource may be assigned.

They are the voltmeter of a signal, the scanning voltmeter, the head and the chamber.
"""


@dataclass
class FormState(EditedFile):
    """The state of the form: its file, the typed values, the findings; `written` is the file's new text."""

    values: dict[str, str] = field(default_factory=dict)
    groups: list[Group] = field(default_factory=list)
    written: str = ""
    file: BenchFile | None = None
    further: str = ""


# --- the list ---------------------------------------------------------------------------------------


def benches(request: Request) -> Response:
    """Show the bench files of the working folder and the shipped ones to start from."""
    operator(request)
    return page(
        request,
        "benches.html.j2",
        own=listed(),
        shipped=list(shipped_files(CONFIG)),
        folder=str(Path().resolve()),
    )


@dataclass(frozen=True)
class Listed:
    """A bench file in the list: its name, its description, and the number of its mistakes."""

    name: str
    path: str
    description: str
    mistakes: int


def listed() -> list[Listed]:
    """Return the bench files of the working folder for the list."""
    rows = []
    for name, path in own_files(CONFIG).items():
        try:
            text = read_file(path)
            mistakes, file = mistakes_in(text.text, path)
        except Refusal:
            mistakes, file = (
                (FileMistake(0, "", message("the file cannot be read; check its permissions")),),
                None,
            )
        rows.append(Listed(name, str(path), file.description if file else "", len(mistakes)))
    return rows


def mistakes_in(text: str, path: Path) -> tuple[tuple[FileMistake, ...], BenchFile | None]:
    """Return the mistakes of a bench file with this text, and the bench file if there are none."""
    try:
        return (), validated(document_of(path, text.encode()), BenchFile)
    except FileMistakes as mistakes:
        return mistakes.mistakes, None


# --- the form ---------------------------------------------------------------------------------------


def form(request: Request) -> Response:
    """Show the form of a bench file (`file`), or of a new file that begins as a copy of a shipped one (`start`)."""
    operator(request)
    asked = request.query_params
    state = _begun(asked.get("file", ""), asked.get("start", ""), asked.get("name", ""))
    if asked.get("written"):
        state.note = message(f"{state.base.path} was written.")
    _judge(state)
    return _form_page(request, state)


def _begun(name: str, start: str, new_name: str = "") -> FormState:
    """Return the form of file `name`, else of a copy `new_name` of `start`. Raises `Refusal` if missing."""
    if name:
        base = read_file(own_file(CONFIG, name))
        return FormState(name, "", base, values=_values(base.text))
    shipped = read_file(shipped_file(CONFIG, start))
    values = _values(shipped.text)
    if new_name := new_name.strip():
        values["name"] = new_name
    return FormState(new_name, start, FileText(shipped.path, shipped.text), values=values)


def _values(text: str) -> dict[str, str]:
    try:
        return values_of(read_yaml(text).data)
    except yaml.YAMLError as error:
        raise Refusal(
            409, message("the file is not YAML; 'bench check' shows where: correct it in an editor")
        ) from error


def _judge(state: FormState) -> None:
    """Make the file's new text from the typed values, and assign the mistakes in it to their fields."""
    state.groups = groups_of(state.values)
    try:
        state.written = changed_text(state.base.text, state.values, state.groups)
    except (yaml.YAMLError, TypeError, KeyError, AttributeError) as error:
        raise Refusal(409, message("the form cannot show this file; correct it in an editor")) from error
    mistakes, state.file = mistakes_in(state.written, state.base.path)
    state.placed = placed(mistakes, state.groups)


async def sent(request: Request) -> Response:
    """Carry out the action of the pressed button: show, find, ask for identities, write, or test."""
    person, given = await acting(request, Role.OPERATOR, most=MOST_FIELDS)
    return await run_in_threadpool(_sent, request, person, given)


def _sent(request: Request, person: Person, given: dict[str, str]) -> Response:
    panel = panel_of(request)
    state = _typed(given)
    search = search_of(panel)
    _assign(state, given, search.found())
    state.values = completed(state.values, _values(state.base.text))
    _judge(state)
    do = given.get("do", "show")
    state.further = given.get("further", "")
    if do == "write":
        if _write(panel, person, state, given.get("sha256", "")):
            return RedirectResponse(f"/bench/form?file={quote(state.name)}&written=1", status_code=303)
    elif do in {OFFERS, IDENTIFY}:
        try:
            search.begin(do, resources=_addressed(given) if do == IDENTIFY else ())
            state.further = "" if do == IDENTIFY else state.further
        except Refusal as refusal:
            state.refusal = refusal.text
    return _form_page(request, state)


def _typed(given: Mapping[str, str]) -> FormState:
    """Return the form with the typed values. Raises `Refusal` for texts that no form of the panel sends."""
    for text in given.values():
        if len(text) > LONGEST and "\n" not in text:
            raise Refusal(400, message(f"shorten the field to at most {LONGEST} characters"))
    file, start, name = given.get("file", ""), given.get("start", ""), given.get("new_name", "").strip()
    state = _begun(file, start, name)
    for name, text in given.items():
        if name in OF_BENCH or name.startswith(_OF_FORM):
            if visible(text) != text or not (text.isprintable() or not text):
                raise Refusal(400, message(f"{name}: use printable characters only"))
            state.values[name] = text.strip()
    return state


_OF_FORM: Final = ("form:", "gravity", "instruments.", "unit_under_test.")


def _assign(state: FormState, given: Mapping[str, str], found: Findings) -> None:
    """Assign found resources to the instruments that the person chose for them."""
    for number, row in enumerate(found.resources):
        target = given.get(f"is:{number}", "")
        if target in TARGETS and given.get(f"resource:{number}") == row["resource"]:
            place = _place_of(target, state.values)
            state.values[f"{place}.resource"] = row["resource"]
            if row["driver"]:
                state.values[f"{place}.driver"] = row["driver"]
            if row.get("interface"):
                state.values[f"{place}.interface"] = row["interface"]


def _place_of(target: str, values: dict[str, str]) -> str:
    """Return the path of `target`, which gets a found resource; change the number of voltmeters if it must."""
    if target in {"head", "chamber"}:
        return f"instruments.{target}"
    if target == "scanner":
        values["form:voltmeters"] = "1"
        return dotted((*METERS_PLACE, 0))
    if number_of_meters(values) == 1:
        values["form:voltmeters"] = "3"
    places = [dotted((*METERS_PLACE, index)) for index in range(number_of_meters(values))]
    for index, place in enumerate(places):
        if values.get(f"{place}.channels", "xyz"[index]) == target:
            return place
    return places[-1]


def _addressed(given: Mapping[str, str]) -> list[str]:
    """Return the resources to be addressed: ticked ones, and typed ones (one per line)."""
    ticked = [given.get(f"resource:{key[4:]}", "") for key in given if key.startswith("ask:")]
    return [one for one in (*ticked, *given.get("further", "").split()) if one]


def _write(panel: Panel, person: Person, state: FormState, expected: str) -> bool:
    """Write the file if it has no mistakes and was not changed meanwhile; return whether it was written."""
    if (path := state.target(CONFIG)) is None:
        return False
    if state.placed.number:
        state.refusal = message(f"Not written: {state.placed.number} mistakes. See each at its field.")
        return False
    state.written = signed(state.written, person.name, utc_now())
    changed = message("Not written: the file changed since this form was opened. See the difference below.")
    return state.write(path, state.written, expected, panel.settings.runs / STATE, changed)


def _form_page(request: Request, state: FormState) -> Response:
    search = search_of(panel_of(request))
    found = search.found()
    known = _known_certificates(state.file)
    tested = found.what == TEST and found.bench == str(state.base.path.absolute())
    results = {row["name"]: row for row in found.instruments} if tested else {}
    return page(
        request,
        "bench_form.html.j2",
        state=state,
        found=found,
        searching=search.at_work(),
        certificates=known,
        targets=TARGETS,
        tested=tested,
        results=_by_place(state.file, results),
        procedures=list(choices("procedures")),
        offers=[*dict.fromkeys(row["resource"] for row in found.resources)],
    )


def _known_certificates(file: BenchFile | None) -> dict[str, str]:
    """Return, by resource, the date of the certificate that the bench file states for the instrument."""
    found = {}
    for section in file.instruments.all() if file else ():
        resource, certificate = getattr(section, "resource", None), section.certificate
        if resource and certificate is not None:
            found[resource] = str(certificate.date)
    return found


def _by_place(file: BenchFile | None, results: Mapping[str, Any]) -> dict[str, Any]:
    """Return the results of a test, by the path of the instrument in the form."""
    if file is None:
        return {}
    meters = enumerate(file.instruments.voltmeters)
    places = {dotted((*METERS_PLACE, index)): meter.name for index, meter in meters}
    places["instruments.head"] = file.instruments.head.name
    if file.instruments.chamber is not None:
        places["instruments.chamber"] = file.instruments.chamber.name
    return {place: results[name] for place, name in places.items() if name in results}


# --- searching and testing --------------------------------------------------------------------------


def search_of(panel: Panel) -> Search:
    """Return the panel's latest search for instruments."""
    return Search(panel.settings.runs / STATE / "search")


def searched(request: Request) -> Response:
    """Tell the script of the form whether a search is in progress."""
    operator(request)
    return JSONResponse({"at_work": search_of(panel_of(request)).at_work()})


async def test(request: Request) -> Response:
    """Start a process that opens, tests and reads the instruments of a bench file that was written."""
    _, given = await acting(request, Role.OPERATOR)
    name = given.get("file", "")
    path = own_file(CONFIG, name)
    await run_in_threadpool(search_of(panel_of(request)).begin, TEST, bench=path)
    return RedirectResponse(f"/bench/form?file={quote(name)}#try", status_code=303)
