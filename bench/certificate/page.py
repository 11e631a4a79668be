"""Page data and unsigned PDF of a certificate, and the check that a file is a certificate's PDF.

A certificate is a PDF/A-3b with files attached (ISO 19005-3:2012). `faults_of` checks the objects of a file,
signed or unsigned. Each fault names its clause. The check is not complete: veraPDF checks more.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterator
from datetime import date, datetime
from hashlib import sha256
from importlib.resources import files
from typing import Any, Final

from bench.base.files import MEGABYTE, read_regular, remedy_for
from bench.base.languages import ENGLISH, known_language, local_number, speaking
from bench.base.numbers import rounded, uncertainty
from bench.certificate import proof
from bench.certificate.content import Attached, Certificate, day_of
from bench.certificate.proof import NOBODY_SAYS, Block, Cell, Writer, days_in_words, plain
from bench.services.errors import Refused

DCC: Final = "dcc.xml"
"""Name of the attached digital certificate."""

RELATIONS: Final = {DCC: "data", "result.json": "data", "readings.csv": "source", "seal.json": "supplement"}
"""Relationship of each attachment to the pages (ISO 19005-3, AFRelationship)."""

_PICTURES: Final = ((b"\x89PNG", "png"), (b"\xff\xd8\xff", "jpg"), (b"<svg", "svg"), (b"<?xml", "svg"))
_LARGEST_LOGO: Final = 2 * MEGABYTE


def attachments_of(certificate: Certificate, dcc: bytes) -> tuple[Attached, ...]:
    """Return the attachments of the PDF; the digital certificate `dcc` comes first, unless it is empty (draft)."""
    digital = Attached(DCC, "text/xml", "the digital calibration certificate (DCC)", dcc)
    return (digital, *certificate.attachments) if dcc else certificate.attachments


def data_of(certificate: Certificate, dcc: bytes) -> dict[str, Any]:
    """Return the input data of the page template. Raises `Refused` for a logo that is not a picture.

    Only texts from `words.yaml` are in all languages; numbers, figures and other texts are in the main one.
    """
    with speaking(known_language(certificate.texts[0].language) or ENGLISH):
        return _data_of(certificate, dcc)


def _data_of(certificate: Certificate, dcc: bytes) -> dict[str, Any]:
    write = Writer(certificate)
    laboratory, issue = certificate.laboratory, certificate.issue
    title = write.say("title")
    name = NOBODY_SAYS if laboratory is None else laboratory.name
    # PDF/A needs a date; a draft bears that of the run's end, so that its bytes do not depend on the clock
    day = day_of(certificate.found.ended if issue is None else issue.issued) or date(1970, 1, 1)
    attached = attachments_of(certificate, dcc)
    listed = [(one.name, sha256(one.content).hexdigest()) for one in attached]
    told = {
        "languages": [text.language for text in certificate.texts],
        "title": f"{title[0]} {certificate.number}".strip(),
        "author": name,
        "keywords": [word for word in (certificate.number, certificate.found.item.serial) if word],
        "date": [day.year, day.month, day.day],
        "heading": title,
        "number-words": write.say("number"),
        "number": certificate.number or NOBODY_SAYS,
        "laboratory": _letter_head(write),
        "draft": write.say("draft") if certificate.draft else None,
        "simulated": write.say("simulated") if certificate.simulated else None,
        "unsigned": write.say("unsigned") if certificate.unsigned else None,
        "footer": certificate.number or write.say("draft")[0],
        "page": write.say("page", page="{page}", pages="{pages}"),
        "end": write.say("end"),
        "front": _front(write),
        "signed": _signed(write),
        "terms": [write.say(key) for key in certificate.terms],
        "proof": proof.pages(write, listed),
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


def _letter_head(write: Writer) -> list[str]:
    certificate = write.certificate
    laboratory = certificate.laboratory
    if laboratory is None:
        return []
    ways = " · ".join(filter(None, (laboratory.email, laboratory.phone)))
    lines = [", ".join(laboratory.address.lines), *([ways] if ways else [])]
    body = laboratory.accreditation
    if body is not None and not (certificate.simulated or certificate.draft):
        lines += write.say("accreditation", body=body.body, number=body.number, standard=body.standard)
    return lines


def _front(write: Writer) -> list[Block]:
    certificate = write.certificate
    found, order, unit, issue = certificate.found, certificate.order, certificate.unit, certificate.issue
    customer = None if order is None else order.customer
    item = found.item
    manufacturer, reference = (None, None) if unit is None else (unit.manufacturer, unit.reference)
    rows: list[tuple[str, list[Cell]]] = [
        ("item", [item.type, manufacturer or ""]),
        ("serial", [item.serial]),
        ("customer", [] if customer is None else [customer.name, ", ".join(customer.address.lines)]),
        ("order", [] if order is None else [" · ".join(filter(None, (order.number, reference)))]),
        ("received", [] if unit is None else [f"{unit.received} · {unit.condition}"]),
        ("calibrated", [days_in_words(certificate.calibrated)]),
        ("place", [certificate.place]),
        ("state", [write.say(certificate.state.replace(" ", "_"))] if certificate.state else []),
        *write.stated("front"),
    ]
    blocks = [write.pairs(rows)]
    if issue is not None and issue.before is not None:
        told = {**vars(issue.before), "kind": write.say(issue.before.kind)}
        blocks.append(write.words("replaces", **told))
    return [*blocks, write.heading("results"), write.words("answer_text", k=f"{certificate.k:.4g}"),
            _matrix(write), *proof.verdict_of(found, write)]  # fmt: skip


def _matrix(write: Writer) -> Block:
    values = write.certificate.found.coefficients
    rows: list[list[Cell]] = []
    for channel in "xyz":
        cells: list[Cell] = [{"symbol": "U", "index": channel}]
        for name in (*(f"K{channel}{axis}" for axis in "xyz"), f"U0{channel}"):
            value = values[name]
            exact = value.value == 0.0 and value.U == 0.0
            cells.append(
                "0" if exact else local_number(f"{rounded(value.value, value.U)} ± {uncertainty(value.U)}")
            )
        rows.append(cells)
    units = [values["Kxx"].unit] * 3 + [values["U0x"].unit]
    columns = [{"symbol": "K", "index": f"·{axis}"} for axis in "xyz"] + [{"symbol": "U", "index": "0"}]
    head: list[Cell] = [write.say("channel")]
    head += [{**column, "unit": unit} for column, unit in zip(columns, units, strict=True)]
    return write.table(head, rows, "lrrrr", ["auto", 1, 1, 1, 1], size=9.0)


def _signed(write: Writer) -> list[list[Any]]:
    issue = write.certificate.issue
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
            [
                write.say(
                    "unsigned_text" if write.certificate.unsigned else "signed_text", name=issue.signed_by
                )
            ],
        ],
    ]


def _logo(certificate: Certificate) -> dict[str, Any] | None:
    file = None if certificate.laboratory is None else certificate.laboratory.logo_file
    if file is None:
        return None
    try:
        content = read_regular(file, _LARGEST_LOGO)
    except OSError as error:
        remedy = remedy_for(error, "check name and permissions")
        raise Refused(f"{file}: the logo cannot be read ({error.strerror}); {remedy}") from error
    kinds = [kind for start, kind in _PICTURES if content.lstrip()[: len(start)] == start]
    if not kinds:
        raise Refused(f"{file}: the logo has an unknown format; give SVG, PNG or JPEG")
    return {"format": kinds[0], "bytes": list(content)}


_TEMPLATE: Final = "certificate.typ"
_NO_SIGN: Final = re.compile(r'the text `"(.+?)"` could not be displayed')


def body_of(certificate: Certificate, dcc: bytes) -> bytes:
    """Return the PDF/A-3b of a certificate with its attachments; `dcc` is the XML, empty for a draft.

    Raises `Refused` for a bad logo, or for a character that the fonts lack.
    """
    return typeset_pdf(_inputs(certificate, dcc), _moment(certificate))


def pictures_of(certificate: Certificate, dcc: bytes, dots_per_inch: float = 110.0) -> list[bytes]:
    """Return an image (PNG) of each page. Raises the errors of `body_of`."""
    import typst

    data = _inputs(certificate, dcc)
    made = typst.compile(
        _template(), format="png", ppi=dots_per_inch, ignore_system_fonts=True, sys_inputs=data
    )
    return made if isinstance(made, list) else [made]


def _inputs(certificate: Certificate, dcc: bytes) -> dict[str, str]:
    """Return the inputs of the template: its data, and the attachments by name."""
    given = {one.name: one.content.decode() for one in attachments_of(certificate, dcc)}
    return {"data": json.dumps(data_of(certificate, dcc)), **given}


def typeset_pdf(data: dict[str, str], moment: int, template: bytes | None = None) -> bytes:
    """Return the PDF/A-3b that a Typst template makes of `data`, dated `moment` (s since 1970).

    `template` is that of certificates by default. Raises `Refused` for a character that the fonts lack.
    """
    import typst

    try:
        made: Any = typst.compile(
            template or _template(),
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
            f"the fonts of a certificate lack a character for {found[1]}; write the name in Latin, Greek "
            "or Cyrillic letters"
        ) from error
    return bytes(made)


def _template() -> bytes:
    return files(__package__).joinpath(_TEMPLATE).read_bytes()


def _moment(certificate: Certificate) -> int:
    """Return the time of issue, or of the run's end for a draft, in s since 1970; 0 if unknown."""
    told = certificate.found.ended if certificate.issue is None else certificate.issue.issued
    try:
        return int(datetime.fromisoformat(told).timestamp())
    except ValueError:
        return 0


# --- check that a file is a PDF/A-3b with attachments -----------------------------------------------

_KNOWN_RELATIONS: Final = {
    "/Source",
    "/Data",
    "/Alternative",
    "/Supplement",
    "/EncryptedPayload",
    "/Unspecified",
}
_ACTIONS: Final = {
    "/Launch", "/Sound", "/Movie", "/ResetForm", "/ImportData", "/Hide", "/SetOCGState", "/Rendition", "/Trans",
    "/GoTo3DView", "/JavaScript", "/URI", "/SubmitForm", "/GoToR", "/GoToE",
}  # fmt: skip
"""Actions that run code or leave the file. Clause 6.5.1 forbids most; a certificate needs none."""
_FORBIDDEN_ANNOTATIONS: Final = {"/3D", "/Sound", "/Screen", "/Movie", "/RichMedia", "/FileAttachment"}
_HIDING: Final = 1 | 2 | 32 | 256  # Invisible, Hidden, NoView, ToggleNoView
_PRINT: Final = 4
_PDFA: Final = "http://www.aiim.org/pdfa/ns/id/"


def faults_of(file: bytes) -> tuple[str, ...]:
    """Return a sentence for each deviation of a file from the PDF/A-3b of a certificate."""
    import pikepdf

    if re.match(rb"%PDF-1\.[0-7]\r?\n%[\x80-\xff]{4}", file) is None:
        return ("6.1.2: it does not begin as a PDF 1.7 with a line of four bytes above 127",)
    try:
        with pikepdf.open(io.BytesIO(file)) as pdf:
            return tuple(_faults(pdf))
    except (pikepdf.PdfError, ValueError, KeyError, AttributeError, TypeError) as error:
        return (f"it cannot be read as a PDF ({' '.join(str(error).split())[:200]})",)


def _faults(pdf: Any) -> Iterator[str]:
    if pdf.is_encrypted:
        yield "6.1.3: it is encrypted"
    if str(pdf.Root.get("/Version", "/1.7")) > "/1.7":
        yield f"6.1.2: it states version {str(pdf.Root.Version)[1:]}, but part 3 needs 1.7"
    if "/ID" not in pdf.trailer:
        yield "6.1.3: it has no identifier"
    yield from _metadata(pdf)
    yield from _colours(pdf)
    yield from _catalogue(pdf)
    yield from _attachments(pdf)
    for number, page in enumerate(pdf.pages, 1):
        yield from (f"page {number}: {fault}" for fault in _annotations(page))
    yield from _objects(pdf)


def _metadata(pdf: Any) -> Iterator[str]:
    told = pdf.open_metadata()  # read only: as a context manager it would be written back
    part, level = told.get(f"{{{_PDFA}}}part"), told.get(f"{{{_PDFA}}}conformance")
    if (part, level) != ("3", "B"):
        yield f"6.6.4: it states part {part}, level {level}, and not part 3, level B"
    title = pdf.docinfo.get("/Title") if "/Info" in pdf.trailer else None
    if title is not None and str(title) != told.get("dc:title"):
        yield "6.6.3: its title in the document information differs from its metadata"


def _colours(pdf: Any) -> Iterator[str]:
    intents = list(pdf.Root.get("/OutputIntents", []))
    profiles = [one.get("/DestOutputProfile") for one in intents if one.get("/S") == "/GTS_PDFA1"]
    if len(profiles) != 1 or profiles[0] is None or profiles[0].get("/N") not in (1, 3, 4):
        yield "6.2.3: it has no output intent with a colour profile"
    elif b"acsp" not in profiles[0].read_bytes()[:128]:
        yield "6.2.3: the profile of its output intent is not an ICC profile"


def _catalogue(pdf: Any) -> Iterator[str]:
    root = pdf.Root
    names = root.get("/Names", {})
    for key, place in (("/OpenAction", root), ("/AA", root), ("/JavaScript", names), ("/OCProperties", root)):
        if key in place:
            yield f"6.5, 6.9: its catalogue has {key}"
    form = root.get("/AcroForm", {})
    if "/XFA" in form or bool(form.get("/NeedAppearances", False)):
        yield "6.4.1: its form is drawn by the reader"
    fields = list(form.get("/Fields", []))
    if any(field.get("/FT") != "/Sig" for field in fields):
        yield "it has form fields other than its signature"


def _attachments(pdf: Any) -> Iterator[str]:
    related = [one.objgen for one in pdf.Root.get("/AF", [])]
    for name, file in pdf.attachments.items():
        spec = file.obj
        if "/F" not in spec or "/UF" not in spec:
            yield f"6.8: the attached {name} has no name for every reader"
        if str(spec.get("/AFRelationship")) not in _KNOWN_RELATIONS:
            yield f"6.8: the attached {name} does not say how it is related"
        if spec.objgen not in related:
            yield f"6.8: the attached {name} is not associated with the document"
        if "/Subtype" not in spec.EF.F:
            yield f"6.8: the attached {name} does not say of which type it is"
    if len(related) != len(pdf.attachments):
        yield f"{len(related)} files are associated and {len(pdf.attachments)} attached"


def _annotations(page: Any) -> Iterator[str]:
    for one in page.obj.get("/Annots", []):
        kind, flags = str(one.get("/Subtype")), int(one.get("/F", 0))
        if kind in _FORBIDDEN_ANNOTATIONS:
            yield f"6.3.1: it has an annotation {kind}"
        if not flags & _PRINT or flags & _HIDING:
            yield f"6.3.2: its annotation {kind} is not printed"
        x0, y0, x1, y1 = (float(side) for side in one.Rect)
        if (x0, y0) != (x1, y1) and kind not in {"/Popup", "/Link"} and "/AP" not in one:
            yield f"6.3.3: its annotation {kind} has no appearance"


def _objects(pdf: Any) -> Iterator[str]:
    """Yield the faults of all objects in the file, whether or not a page shows them."""
    import pikepdf

    for one in pdf.objects:
        if isinstance(one, pikepdf.Stream):
            yield from _stream(one)
        elif isinstance(one, pikepdf.Dictionary):
            if str(one.get("/Type")) == "/Font":
                yield from _font(one)
            if str(one.get("/S")) in _ACTIONS and str(one.get("/Type", "/Action")) == "/Action":
                yield f"6.5.1: it has an action {one.S}"
            if "/JS" in one or "/AA" in one:
                yield "6.5.1: it has JavaScript or an action of its own"


def _stream(one: Any) -> Iterator[str]:
    import pikepdf

    filters = one.get("/Filter", pikepdf.Array())
    named = {str(each) for each in filters} if isinstance(filters, pikepdf.Array) else {str(filters)}
    if named & {"/LZWDecode", "/Crypt"} or "/F" in one:
        yield "6.1.7: a stream is outside the file, encrypted, or packed by LZW"
    if str(one.get("/Subtype")) == "/PS":
        yield "6.2.9: it has PostScript"


def _font(font: Any) -> Iterator[str]:
    kind, name = str(font.get("/Subtype")), str(font.get("/BaseFont", "without a name"))
    if kind in {"/Type0", "/Type3"}:
        if "/ToUnicode" not in font:
            yield f"the text in font {name} cannot be read out"
        return
    described = font.get("/FontDescriptor", {})
    if not any(key in described for key in ("/FontFile", "/FontFile2", "/FontFile3")):
        yield f"6.2.11.4: the font {name} is not embedded"
