"""Pages on bench files: their list, the form with the mistakes, the search for instruments, writing, the test."""

from __future__ import annotations

import re
from collections import Counter
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
from bench.panel.access import STATE, Refusal, Role
from bench.panel.bench_fields import (
    METERS,
    METERS_PLACE,
    ROLES,
    Group,
    completed,
    groups_of,
    number_of_meters,
    placed,
    still_of_example,
    values_of,
)
from bench.panel.own_files import (
    FileText,
    choices,
    own_file,
    own_files,
    read_file,
    shipped_file,
    shipped_files,
)
from bench.panel.pages.editing import LONGEST, EditedFile
from bench.panel.round_trip import changed_text
from bench.panel.searching import IDENTIFY, OFFERS, TEST, Findings, Search
from bench.panel.shared import Panel, acting, operator, page, panel_of

TARGETS: Final = ("x", "y", "z", "scanner", *ROLES)
"""Instruments to which a found resource may be assigned.

They are the voltmeter of a signal, the scanning voltmeter, and the other instruments that have a form.
"""


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


def listed() -> list[dict[str, Any]]:
    """Return name, path, description and number of mistakes of each bench file of the working folder."""
    rows = []
    for name, path in own_files(CONFIG).items():
        try:
            mistakes, file = mistakes_in(read_file(path).text, path)
            number = len(mistakes)
        except Refusal:  # it cannot be read
            number, file = 1, None
        rows.append(
            {"name": name, "path": path, "description": file.description if file else "", "mistakes": number}
        )
    return rows


def mistakes_in(text: str, path: Path) -> tuple[tuple[FileMistake, ...], BenchFile | None]:
    """Return the mistakes in the `text` of a bench file, and the bench file, which is None if there are any."""
    try:
        return (), validated(document_of(path, text.encode()), BenchFile)
    except FileMistakes as mistakes:
        return mistakes.mistakes, None


# --- the form ---------------------------------------------------------------------------------------


_OF_FORM: Final = re.compile(rf"form:|(?:{'|'.join(BenchFile.model_fields)})(?:[.\[]|$)")
"""Beginnings of the names of the form's fields; other names are of its buttons and of found instruments."""


@dataclass
class BenchForm(EditedFile):
    """The form of a bench file: typed values, groups of fields, resources typed for the search (`further`).

    `example` is the name of the shipped file from which the bench file was made in this form; empty if unknown.
    """

    KIND = CONFIG
    MOST_FIELDS = 1500
    CHANGED = message("Not written: the file changed since this form was opened. See the difference below.")

    values: dict[str, str] = field(default_factory=dict)
    groups: list[Group] = field(default_factory=list)
    file: BenchFile | None = None
    further: str = ""
    example: str = ""

    @classmethod
    def _begun(cls, name: str, start: str, new_name: str) -> BenchForm:
        if name:
            base = read_file(own_file(CONFIG, name))
            return cls(name, "", base, values=_values(base))
        shipped = read_file(shipped_file(CONFIG, start))
        values = _values(shipped)
        if new_name:
            values["name"] = new_name
        return cls(new_name, start, FileText(shipped.path, shipped.text), values=values, example=start)

    def _open(self, asked: Mapping[str, str]) -> None:
        if asked.get("written"):
            self.note = message(f"{self.base.path} was written.")
        self.example = self.start or asked.get("example", "")
        self._judge()

    def _take(self, panel: Panel, given: Mapping[str, str]) -> None:
        """Take over the typed values; begin a search if its button was pressed. Raises `Refusal` for odd texts."""
        for name, text in given.items():
            if len(text) > LONGEST and "\n" not in text:
                raise Refusal(400, f"{name}: the text has more than {LONGEST} characters; shorten it")
        for name, text in given.items():
            if _OF_FORM.match(name):
                if visible(text) != text or not (text.isprintable() or not text):
                    raise Refusal(400, f"{name}: the text has characters that cannot be printed; remove them")
                self.values[name] = text.strip()
        search = search_of(panel)
        self.refusal = _assign(self.values, given, search.found())
        self.values = completed(self.values, _values(self.base))
        self._judge()
        self.further, self.example = given.get("further", ""), self.start or given.get("example", "")
        do = given.get("do", "show")
        if do in {OFFERS, IDENTIFY}:
            try:
                search.begin(do, resources=_addressed(given) if do == IDENTIFY else ())
                self.further = "" if do == IDENTIFY else self.further
            except Refusal as refusal:
                self.refusal = refusal.text

    def _judge(self) -> None:
        """Make the file's new text from the typed values, and assign the mistakes in it to their fields."""
        self.groups = groups_of(self.values)
        try:
            self.text = changed_text(self.base.text, self.values, self.groups)
        except (yaml.YAMLError, TypeError, LookupError, AttributeError) as error:
            raise Refusal(
                409,
                "the form cannot show this file, because the file is not valid YAML or a "
                "section has the wrong structure; correct the file in an editor",
            ) from error
        mistakes, self.file = mistakes_in(self.text, self.base.path)
        self.placed = placed(mistakes, self.groups)

    def _may_be_written(self, path: Path) -> bool:
        if number := self.placed.number:
            self.refusal = message(f"Not written: {number} mistakes. See each at its field.")
        return not number

    @property
    def _address(self) -> str:
        example = f"&example={quote(self.example)}" if self.example else ""
        return f"/bench/form?file={quote(self.name)}&written=1{example}"

    def _shown(self, request: Request) -> Response:
        search = search_of(panel_of(request))
        found = search.found()
        tested = found.what == TEST and found.bench == str(self.base.path.absolute())
        results = {row["name"]: row for row in found.instruments} if tested else {}
        offers = [*dict.fromkeys(row["resource"] for row in found.resources)]
        if self.example:
            chosen = {**self.values, **{name: "" for name, text in self.values.items() if text in offers}}
            example = _values(read_file(shipped_file(CONFIG, self.example)))
            self.still = still_of_example(chosen, example, self.groups)
        return page(
            request,
            "bench_form.html.j2",
            state=self,
            found=found,
            searching=search.at_work(),
            certificates=_known_certificates(self.file),
            targets=TARGETS,
            chosen={resource: target for resource, (target, _) in _assigned(self.values).items()},
            tested=tested,
            results=_by_place(self.file, results),
            procedures=list(choices("procedures")),
            offers=offers,
        )


def _values(file: FileText) -> dict[str, str]:
    try:
        return values_of(read_yaml(file.text).data)
    except yaml.YAMLError as error:
        where = mistakes_in(file.text, file.path)[0][0]
        raise Refusal(
            409, f"{file.path}, line {where.line}: {where.text}; correct it in an editor"
        ) from error


def _assign(values: dict[str, str], given: Mapping[str, str], found: Findings) -> str:
    """Assign found resources to the instruments that the person chose for them; return a refusal, "" for none.

    `was:N` is the choice that the form showed for resource N. Where the choice is unchanged, the typed values hold.
    A resource that changes its instrument leaves the one before without a resource.
    """
    changed = [
        (row, target)
        for number, row in enumerate(found.resources)
        if given.get(f"resource:{number}") == row["resource"]
        and (target := given.get(f"is:{number}", "")) != given.get(f"was:{number}", "")
    ]
    before = _assigned(values)
    for row, _ in changed:
        if row["resource"] in before:
            values[f"{before[row['resource']][1]}.resource"] = ""
    wanted = Counter(target for _, target in changed if target in TARGETS)
    for row, target in changed:
        if wanted[target] == 1:
            place = _place_of(target, values)
            values[f"{place}.resource"] = row["resource"]
            if row["driver"]:
                values[f"{place}.driver"] = row["driver"]
            if row.get("interface"):
                values[f"{place}.interface"] = row["interface"]
    twice = [target for target, number in wanted.items() if number > 1]
    if not twice:
        return ""
    return message(
        f"Two of the instruments found are chosen as {' and as '.join(twice)}. Choose one of them."
    )


def _places(values: Mapping[str, str]) -> dict[str, str]:
    """Return the role or channel of the instrument at each path of the form; the voltmeters come last."""
    number = number_of_meters(values)
    places = {f"instruments.{role}": str(role) for role in ROLES}
    for index, signal in enumerate("xyz"[:number]):
        place = dotted((*METERS_PLACE, index))
        places[place] = "scanner" if number == 1 else values.get(f"{place}.channels", signal)
    return places


def _assigned(values: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """Return the role or channel that each resource in the form's values serves, and its section's path."""
    return {
        resource: (target, place)
        for place, target in _places(values).items()
        if (resource := values.get(f"{place}.resource", ""))
    }


def _place_of(target: str, values: dict[str, str]) -> str:
    """Return the path of `target`, which gets a found resource; change the number of voltmeters if necessary."""
    if target == "scanner":
        values[METERS] = "1"
    elif target not in ROLES and number_of_meters(values) == 1:
        values[METERS] = "3"
    places = _places(values)
    return next((place for place, one in places.items() if one == target), list(places)[-1])


def _addressed(given: Mapping[str, str]) -> list[str]:
    """Return the resources to be addressed: ticked ones, and typed ones (one per line)."""
    ticked = [given.get(f"resource:{key[4:]}", "") for key in given if key.startswith("ask:")]
    return [one for one in (*ticked, *given.get("further", "").split()) if one]


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
    for role in ROLES:
        if (section := getattr(file.instruments, role)) is not None:
            places[f"instruments.{role}"] = section.name
    return {place: results[name] for place, name in places.items() if name in results}


# --- searching and testing --------------------------------------------------------------------------


def search_of(panel: Panel) -> Search:
    """Return the `Search` with the findings of the panel's latest search for instruments."""
    return Search(panel.settings.runs / STATE / "search")


def searched(request: Request) -> Response:
    """Tell the script of the form whether a search is in progress."""
    operator(request)
    return JSONResponse({"at_work": search_of(panel_of(request)).at_work()})


async def test(request: Request) -> Response:
    """Start a process that opens, tests and reads the instruments of a bench file that was saved before."""
    _, given = await acting(request, Role.OPERATOR)
    name = given.get("file", "")
    path = own_file(CONFIG, name)
    await run_in_threadpool(search_of(panel_of(request)).begin, TEST, bench=path)
    return RedirectResponse(f"/bench/form?file={quote(name)}#try", status_code=303)
