"""Whether a file is what it claims to be: a PDF/A-3b with files attached (ISO 19005-3:2012), looked at as objects.

It is asked of the body and again of the signed file. It is no whole validator; what it asks is listed here, rule by
rule, with the clause: veraPDF asks for more.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from typing import Any, Final

_RELATIONS: Final = {"/Source", "/Data", "/Alternative", "/Supplement", "/EncryptedPayload", "/Unspecified"}
_ACTIONS: Final = {
    "/Launch", "/Sound", "/Movie", "/ResetForm", "/ImportData", "/Hide", "/SetOCGState", "/Rendition", "/Trans",
    "/GoTo3DView", "/JavaScript", "/URI", "/SubmitForm", "/GoToR", "/GoToE",
}  # fmt: skip
"""No action that runs or leads out of the file: 6.5.1 forbids most of them, a certificate needs none."""
_FORBIDDEN_ANNOTATIONS: Final = {"/3D", "/Sound", "/Screen", "/Movie", "/RichMedia", "/FileAttachment"}
_HIDING: Final = 1 | 2 | 32 | 256  # Invisible, Hidden, NoView, ToggleNoView
_PRINT: Final = 4
_PDFA: Final = "http://www.aiim.org/pdfa/ns/id/"


def faults_of(file: bytes) -> tuple[str, ...]:
    """Return in what a file is not the PDF/A-3b that a certificate is, a sentence each; nothing where it is."""
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
        yield f"6.1.2: it says to be of version {str(pdf.Root.Version)[1:]}, and part 3 stands on 1.7"
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
    with pdf.open_metadata(set_pikepdf_as_editor=False, update_docinfo=False) as told:
        part, level = told.get(f"{{{_PDFA}}}part"), told.get(f"{{{_PDFA}}}conformance")
        if (part, level) != ("3", "B"):
            yield f"6.6.4: it says to be part {part}, level {level}, and not part 3, level B"
        title = pdf.docinfo.get("/Title") if "/Info" in pdf.trailer else None
        if title is not None and str(title) != told.get("dc:title"):
            yield "6.6.3: its title in the document information is not that of its metadata"


def _colours(pdf: Any) -> Iterator[str]:
    intents = list(pdf.Root.get("/OutputIntents", []))
    profiles = [one.get("/DestOutputProfile") for one in intents if one.get("/S") == "/GTS_PDFA1"]
    if len(profiles) != 1 or profiles[0] is None or profiles[0].get("/N") not in (1, 3, 4):
        yield "6.2.3: it has no output intent with a colour profile"
    elif b"acsp" not in profiles[0].read_bytes()[:128]:
        yield "6.2.3: the profile of its output intent is no ICC profile"


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
        yield "it has fields to fill in, and a certificate has none but its signature"


def _attachments(pdf: Any) -> Iterator[str]:
    related = [one.objgen for one in pdf.Root.get("/AF", [])]
    for name, file in pdf.attachments.items():
        spec = file.obj
        if "/F" not in spec or "/UF" not in spec:
            yield f"6.8: the attached {name} has no name for every reader"
        if str(spec.get("/AFRelationship")) not in _RELATIONS:
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
    """Look at every object that the file has, whether a page shows it or not."""
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
