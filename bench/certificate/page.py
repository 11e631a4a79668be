"""From what a certificate says to the data of its pages and the unsigned PDF."""

from __future__ import annotations

import json
import re
from datetime import date, datetime
from hashlib import sha256
from importlib.resources import files
from typing import Any, Final

from bench.base.files import MEGABYTE, read_regular
from bench.base.numbers import rounded, uncertainty
from bench.certificate import proof
from bench.certificate.content import Attached, Certificate, day_of
from bench.certificate.laboratory import Contact
from bench.certificate.proof import NOBODY_SAYS, Block, Cell, Writer, plain
from bench.services.errors import Refused

DCC: Final = "dcc.xml"
"""The name under which the digital certificate is attached."""

RELATIONS: Final = {DCC: "data", "result.json": "data", "readings.csv": "source", "seal.json": "supplement"}
"""How what is attached is related to the pages (ISO 19005-3, AFRelationship)."""

_PICTURES: Final = ((b"\x89PNG", "png"), (b"\xff\xd8\xff", "jpg"), (b"<svg", "svg"), (b"<?xml", "svg"))
_LARGEST_LOGO: Final = 2 * MEGABYTE


def attachments_of(certificate: Certificate, dcc: bytes) -> tuple[Attached, ...]:
    """Return the files in a certificate's PDF, the digital certificate first; a draft has none (`dcc` is empty)."""
    digital = Attached(DCC, "text/xml", "the digital calibration certificate (DCC)", dcc)
    return (digital, *certificate.attachments) if dcc else certificate.attachments


def data_of(certificate: Certificate, dcc: bytes) -> dict[str, Any]:
    """Return what the template is given. Raises `Refused` for a logo that is no picture."""
    write = Writer(certificate)
    laboratory, issue = certificate.laboratory, certificate.issue
    title = write.say("title")
    name = NOBODY_SAYS if laboratory is None else laboratory.name
    # a draft is of the day on which the run ended: a PDF/A has a date, and not the clock's
    day = day_of(certificate.found.ended if issue is None else issue.issued) or date(1970, 1, 1)
    attached = attachments_of(certificate, dcc)
    told = {
        "languages": [text.language for text in certificate.texts],
        "title": f"{title[0]} {certificate.number}".strip(),
        "author": name,
        "keywords": [word for word in (certificate.number, certificate.found.item.serial) if word],
        "date": [day.year, day.month, day.day],
        "heading": title,
        "number-words": write.say("number"),
        "number": certificate.number or NOBODY_SAYS,
        "laboratory": _letter_head(certificate, write),
        "draft": write.say("draft") if certificate.draft else None,
        "simulated": write.say("simulated") if certificate.simulated else None,
        "unsigned": write.say("unsigned") if certificate.unsigned else None,
        "footer": certificate.number or write.say("draft")[0],
        "page": write.say("page", page="{page}", pages="{pages}"),
        "end": write.say("end"),
        "front": _front(certificate, write),
        "signed": _signed(certificate, write),
        "terms": [write.say(key) for key in certificate.terms],
        "proof": proof.pages(certificate, write, [_listed(one) for one in attached]),
        "attached": [
            {
                "name": one.name,
                "media-type": one.media_type,
                "description": one.description,
                "relation": RELATIONS[one.name],
            }
            for one in attached
        ],
    }
    return {**plain(told), "logo": _logo(certificate)}


def _listed(file: Attached) -> tuple[str, str, str]:
    return file.name, file.description, sha256(file.content).hexdigest()


def _letter_head(certificate: Certificate, write: Writer) -> list[str]:
    laboratory = certificate.laboratory
    if laboratory is None:
        return []
    lines = [", ".join(laboratory.address.lines), *reached(laboratory)]
    body = laboratory.accreditation
    if body is not None and not (certificate.simulated or certificate.draft):
        lines += write.say("accreditation", body=body.body, number=body.number, standard=body.standard)
    return lines


def reached(contact: Contact) -> list[str]:
    """Return how somebody is reached, in a line, where it is said."""
    ways = [way for way in (contact.email, contact.phone) if way]
    return [" · ".join(ways)] if ways else []


def _front(certificate: Certificate, write: Writer) -> list[Block]:
    found, order, unit, issue = certificate.found, certificate.order, certificate.unit, certificate.issue
    customer = None if order is None else order.customer
    item = found.item
    manufacturer, reference = (None, None) if unit is None else (unit.manufacturer, unit.reference)
    rows: list[tuple[str, list[Cell]]] = [
        ("item", [item.type, manufacturer or ""]),
        ("serial", [item.serial]),
        ("customer", [] if customer is None else [customer.name, ", ".join(customer.address.lines)]),
        (
            "order",
            [] if order is None else [" · ".join(filter(None, (order.number, reference)))],
        ),
        ("received", [] if unit is None else [f"{unit.received} · {unit.condition}"]),
        ("calibrated", [_days(certificate)]),
        ("place", [certificate.place]),
        ("state", [write.say(certificate.state.replace(" ", "_"))] if certificate.state else []),
        *write.stated(certificate, "front"),
    ]
    blocks = [write.pairs(rows)]
    if issue is not None and issue.before is not None:
        before = issue.before
        told = {
            "kind": write.say(before.kind),
            "number": before.number,
            "issued": before.issued,
            "reason": before.reason,
        }
        blocks.append(write.words("replaces", **told))
    return [*blocks, write.heading("results"), write.words("answer_text", k=f"{certificate.k:.3g}"),
            _matrix(certificate, write), *proof.verdict(certificate, write)]  # fmt: skip


def _days(certificate: Certificate) -> str:
    """Return the days of the calibration, once where they are one."""
    if certificate.calibrated is None:
        return ""
    first, last = certificate.calibrated
    return str(first) if first == last else f"{first} … {last}"


def _matrix(certificate: Certificate, write: Writer) -> Block:
    """Return K and U0 as the table that answers: a row for each channel."""
    values = certificate.found.coefficients
    rows: list[list[Cell]] = []
    for channel in "xyz":
        cells: list[Cell] = [{"symbol": "U", "index": channel}]
        for name in (*(f"K{channel}{axis}" for axis in "xyz"), f"U0{channel}"):
            value = values[name]
            exact = value.value == 0.0 and value.U == 0.0
            cells.append("0" if exact else f"{rounded(value.value, value.U)} ± {uncertainty(value.U)}")
        rows.append(cells)
    units = [values["Kxx"].unit] * 3 + [values["U0x"].unit]
    columns = [{"symbol": "K", "index": f"·{axis}"} for axis in "xyz"] + [{"symbol": "U", "index": "0"}]
    head: list[Cell] = [write.say("channel")]
    head += [{**column, "unit": unit} for column, unit in zip(columns, units, strict=True)]
    return write.table(head, rows, "lrrrr", ["auto", 1, 1, 1, 1], size=9.0)


def _signed(certificate: Certificate, write: Writer) -> list[list[Any]]:
    issue = certificate.issue
    if issue is None:
        return [
            [write.say("authorised"), [NOBODY_SAYS]],
            [write.say("signed"), [write.say("draft_unsigned_text")]],
        ]
    person = issue.authorised_by
    lines = [person.name, *([person.role] if person.role else [])]
    return [
        [write.say("authorised"), lines],
        [write.say("issued"), [issue.day]],
        [
            write.say("signed"),
            [write.say("unsigned_text" if certificate.unsigned else "signed_text", name=issue.signed_by)],
        ],
    ]


def _logo(certificate: Certificate) -> dict[str, Any] | None:
    file = None if certificate.laboratory is None else certificate.laboratory.logo_file
    if file is None:
        return None
    try:
        content = read_regular(file, _LARGEST_LOGO)
    except OSError as error:
        raise Refused(f"{file}: the logo cannot be read ({error.strerror})") from error
    kinds = [kind for start, kind in _PICTURES if content.lstrip()[: len(start)] == start]
    if not kinds:
        raise Refused(f"{file}: the logo is no picture that a page takes; give it as SVG, PNG or JPEG")
    return {"format": kinds[0], "bytes": list(content)}


_TEMPLATE: Final = "certificate.typ"
_NO_SIGN: Final = re.compile(r'the text `"(.+?)"` could not be displayed')


def body_of(certificate: Certificate, dcc: bytes) -> bytes:
    """Return the PDF/A-3b of a certificate with its files attached, `dcc` its digital certificate (XML).

    Raises `Refused` for a logo that is no picture, and for a letter that the fonts have no sign for.
    """
    given = {one.name: one.content.decode() for one in attachments_of(certificate, dcc)}
    data = {"data": json.dumps(data_of(certificate, dcc)), **given}
    return typeset_pdf(data, _moment(certificate))


def pictures_of(certificate: Certificate, dcc: bytes, dots_per_inch: float = 110.0) -> list[bytes]:
    """Return the pages as pictures (PNG). Raises as `body_of`."""
    given = {one.name: one.content.decode() for one in attachments_of(certificate, dcc)}
    data = {"data": json.dumps(data_of(certificate, dcc)), **given}
    import typst

    made = typst.compile(
        _template(), format="png", ppi=dots_per_inch, ignore_system_fonts=True, sys_inputs=data
    )
    return made if isinstance(made, list) else [made]


def typeset_pdf(data: dict[str, str], moment: int) -> bytes:
    """Set the template with its inputs; `moment` (s since 1970) is when the file says that it was made."""
    import typst

    try:
        made: Any = typst.compile(
            _template(),
            format="pdf",
            pdf_standards=["a-3b"],
            ignore_system_fonts=True,
            timestamp=moment,
            sys_inputs=data,
        )
    except typst.TypstError as error:
        found = _NO_SIGN.search(str(error))
        if found is None:
            raise
        raise Refused(
            f"the fonts of a certificate have no sign for {found[1]}; write the name that has it in Latin, Greek "
            "or Cyrillic letters"
        ) from error
    return bytes(made)


def _template() -> bytes:
    return files(__package__).joinpath(_TEMPLATE).read_bytes()


def _moment(certificate: Certificate) -> int:
    """Return when it was issued, of a draft when the run ended, s since 1970; 0 where nobody knows."""
    told = certificate.found.ended if certificate.issue is None else certificate.issue.issued
    try:
        return int(datetime.fromisoformat(told).timestamp())
    except ValueError:
        return 0
