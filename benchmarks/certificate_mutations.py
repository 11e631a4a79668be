"""Test whether every change of a signed certificate is rejected, or leaves the signed content unchanged.

    python -m benchmarks.certificate_mutations --number 1000 --seed 16

A dry run is made and its certificate issued: the XML is signed and put into the PDF, and the PDF is signed.
Then the XML or the PDF is changed at random, by the seed: a byte of a value, a unit, the covariance, an
embedded file or any other place; the order of labels or elements; comments and blanks inside values;
exchanged parts of the PDF's attachments, appended data, or the file encoded again. The changed file is
verified with the trust file, as `bench certificate verify` does, once alone and once with the other,
unchanged form in the same folder.

A change passes if it is rejected, or if the values shown equal the signed ones byte by byte (comments and
blanks between attributes are not signed, and hexadecimal digits have two cases). A table by kind is printed.
The exit status is 1 if a changed file is accepted and shows anything else.
"""

import io
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from random import Random
from typing import Final

import pikepdf

from bench.certificate.content import Issue
from bench.certificate.dcc.document import document_of
from bench.certificate.gather import certificate_of
from bench.certificate.laboratory import load_laboratory, load_order
from bench.certificate.page import body_of
from bench.certificate.signatory import new_certificate_key, signatory_of
from bench.certificate.signatures import NotIntact, check_xml, sign_pdf, sign_xml
from bench.certificate.verify import verify_certificate
from bench.config.shipped import CERTIFICATE, shipped_folder
from benchmarks.campaign import arguments, done, markdown

REFUSED, UNCHANGED, CHANGED = "refused", "unchanged", "CHANGED"
_DIGITS: Final = b"0123456789"


@dataclass(frozen=True)
class Pair:
    """A certificate in both forms, and the trust file."""

    xml: bytes
    pdf: bytes
    trust: Path


Change = Callable[[bytes, Random], bytes]


def signed_pair(run: Path, folder: Path) -> Pair:
    """Issue and sign the certificate of a run, with a key that is made for it in `folder`."""
    laboratory = load_laboratory(shipped_folder(CERTIFICATE) / "laboratory.yaml")
    order = load_order(shipped_folder(CERTIFICATE) / "order.yaml")
    now = datetime.now(UTC).replace(microsecond=0)
    issue = Issue("SIM-2026-0001", now.isoformat(), laboratory.authorised[0], signed_by=laboratory.name)
    certificate = certificate_of(run.name, run.parent, laboratory, order, issue)
    trust, _ = new_certificate_key(folder / "keys" / "laboratory.pem", laboratory.name, None, now)
    signatory = signatory_of(str(folder / "keys" / "laboratory.pem"), None, lambda: b"", now)
    xml = sign_xml(document_of(certificate), signatory, now)
    pdf = sign_pdf(body_of(certificate, xml), signatory, now, "certificate", certificate.place)
    return Pair(xml, pdf, trust)


# --- changes of the XML -------------------------------------------------------------------------------


def _within(document: bytes, tag: bytes, rng: Random) -> tuple[int, int]:
    """Return the position of the text of one element with a tag, chosen at random."""
    return rng.choice(_texts(document, tag))


def _texts(document: bytes, tag: bytes) -> list[tuple[int, int]]:
    return [match.span(1) for match in re.finditer(rb"<" + tag + rb"[^>]*>([^<]+)</", document)]


def _other(byte: int, rng: Random) -> bytes:
    """Return another byte of the same kind: a digit for a digit, else any printable byte."""
    letters = _DIGITS if byte in _DIGITS else bytes(range(33, 127))
    return bytes([rng.choice([one for one in letters if one != byte])])


def _byte_in(tag: bytes) -> Change:
    def change(document: bytes, rng: Random) -> bytes:
        at = rng.randrange(*_within(document, tag, rng))
        return document[:at] + _other(document[at], rng) + document[at + 1 :]

    return change


def _put_in(tag: bytes, *what: bytes) -> Change:
    def change(document: bytes, rng: Random) -> bytes:
        first, last = _within(document, tag, rng)
        at = rng.randint(first, last)
        return document[:at] + rng.choice(what) + document[at:]

    return change


def _swapped(tag: bytes) -> Change:
    def change(document: bytes, rng: Random) -> bytes:
        whole = rb"<" + tag + rb"[ >].*?</" + tag + rb">"
        spans = [match.span() for match in re.finditer(whole, document, re.DOTALL)]
        (a, b), (c, d) = sorted(rng.sample(spans, 2))
        return document[:a] + document[c:d] + document[b:c] + document[a:b] + document[d:]

    return change


def _words_swapped(tag: bytes) -> Change:
    def change(document: bytes, rng: Random) -> bytes:
        several = [span for span in _texts(document, tag) if document[slice(*span)].count(b" ") > 1]
        first, last = rng.choice(several)
        words = document[first:last].split(b" ")
        i, j = rng.sample(range(len(words)), 2)
        words[i], words[j] = words[j], words[i]
        return document[:first] + b" ".join(words) + document[last:]

    return change


def _byte_of_covariance(document: bytes, rng: Random) -> bytes:
    spans = [match.span() for match in re.finditer(rb"<si:covarianceXMLList>.*?</", document, re.DOTALL)]
    first, last = rng.choice(spans)
    at = first + document[first:last].index(b"si:valueXMLList>") + len(b"si:valueXMLList>")
    at = rng.randrange(at, last - len(b"</"))
    return document[:at] + _other(document[at], rng) + document[at + 1 :]


def _between_attributes(document: bytes, rng: Random) -> bytes:
    at = rng.choice([match.start() for match in re.finditer(rb' \w+="', document)])
    return document[:at] + rng.choice([b" ", b"\n"]) + document[at:]


def _any_byte(document: bytes, rng: Random) -> bytes:
    at = rng.randrange(len(document))
    return document[:at] + bytes([document[at] ^ 1 << rng.randrange(8)]) + document[at + 1 :]


def _byte_out(document: bytes, rng: Random) -> bytes:
    at = rng.randrange(len(document))
    return document[:at] + document[at + 1 :]


def _in_signature(document: bytes, rng: Random) -> bytes:
    at = rng.randrange(document.index(b"<ds:Signature"), len(document))
    return document[:at] + _other(document[at], rng) + document[at + 1 :]


BLANKS: Final = (b" ", b"\n", b"\t", b"\xc2\xa0", b"&#32;")
COMMENTS: Final = (b"<!---->", b"<!-- 9 -->", b"<?x?>", b"<![CDATA[9]]>")
XML: Final[dict[str, Change]] = {
    "a byte of a value": _byte_in(b"si:value(?:XMLList)?"),
    "a byte of a U": _byte_in(b"si:valueExpandedMUXMLList"),
    "a byte of a unit": _byte_in(b"si:unit(?:XMLList)?"), "a byte of a covariance": _byte_of_covariance,
    "a byte of a file in it": _byte_in(b"dcc:dataBase64"), "a byte of a text": _byte_in(b"dcc:content"),
    "a blank in a value": _put_in(b"si:valueXMLList", *BLANKS),
    "a blank in a unit": _put_in(b"si:unitXMLList", *BLANKS),
    "a blank in a file in it": _put_in(b"dcc:dataBase64", *BLANKS),
    "a comment in a value": _put_in(b"si:valueXMLList", *COMMENTS),
    "a comment in a text": _put_in(b"dcc:content", *COMMENTS),
    "values in another order": _words_swapped(b"si:valueXMLList"),
    "labels in another order": _words_swapped(b"si:labelXMLList"),
    "elements in another order": _swapped(b"dcc:result"),
    "columns in another order": _swapped(b"si:columnXMLList"),
    "a blank between attributes": _between_attributes, "a byte of the signature": _in_signature,
    "any bit": _any_byte, "a byte left out": _byte_out,
}  # fmt: skip


# --- changes of the PDF -------------------------------------------------------------------------------


def _stream_bit(file: bytes, rng: Random) -> bytes:
    spans = [match.span(1) for match in re.finditer(rb"stream\r?\n(.*?)\r?\nendstream", file, re.DOTALL)]
    at = rng.randrange(*rng.choice([span for span in spans if span[1] > span[0]]))
    return file[:at] + bytes([file[at] ^ 1 << rng.randrange(8)]) + file[at + 1 :]


def _appended(file: bytes, rng: Random) -> bytes:
    return file + rng.choice([b"\n", b"%%EOF\n", b" " * 40, b"1 0 obj\n<<>>\nendobj\n", file[-200:]])


def _saved(change: Callable[[pikepdf.Pdf, Random], None]) -> Change:
    def changed(file: bytes, rng: Random) -> bytes:
        out = io.BytesIO()
        with pikepdf.open(io.BytesIO(file)) as pdf:
            change(pdf, rng)
            pdf.save(out)
        return out.getvalue()

    return changed


def _other_attachment(pdf: pikepdf.Pdf, rng: Random) -> None:
    name = rng.choice(sorted(pdf.attachments))
    content = bytearray(pdf.attachments[name].get_file().read_bytes())
    content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    pdf.attachments[name] = bytes(content)


def _exchanged(pdf: pikepdf.Pdf, rng: Random) -> None:
    one, other = rng.sample(sorted(pdf.attachments), 2)
    contents = {name: pdf.attachments[name].get_file().read_bytes() for name in (one, other)}
    pdf.attachments[one], pdf.attachments[other] = contents[other], contents[one]


def _signature_digits(file: bytes) -> tuple[int, int]:
    """Return the position of the signature's hexadecimal digits in a PDF."""
    start = file.rindex(b"/Contents <") + len(b"/Contents <")
    return start, file.index(b">", start)


def _in_place_of_the_signature(file: bytes, rng: Random) -> bytes:
    at = rng.randrange(*_signature_digits(file))
    return file[:at] + rng.choice([b"0", b"a", b"F", b" ", file[at : at + 1].swapcase()]) + file[at + 1 :]


PDF: Final[dict[str, Change]] = {
    "any bit of the PDF": _any_byte, "a bit of a stream": _stream_bit,
    "a byte of the PDF left out": _byte_out, "something appended": _appended,
    "a digit of the PDF's signature": _in_place_of_the_signature,
    "another byte in an attachment": _saved(_other_attachment),
    "attachments exchanged": _saved(_exchanged),
    "a page less": _saved(lambda pdf, rng: pdf.pages.__delitem__(rng.randrange(len(pdf.pages)))),
    "pages in another order": _saved(lambda pdf, rng: pdf.pages.reverse()),
    "the file written anew": _saved(lambda pdf, rng: None),
}  # fmt: skip
KINDS: Final = {**XML, **PDF}


# --- outcomes --------------------------------------------------------------------------------------------


def outcome(pair: Pair, changed: bytes, kind: str, folder: Path, *, beside: bool) -> str:
    """Return the outcome of verifying one changed form, with the unchanged other form in the same folder or not."""
    is_xml = kind in XML
    original, ending, other = (pair.xml, ".xml", ".pdf") if is_xml else (pair.pdf, ".pdf", ".xml")
    file = folder / f"certificate{ending}"
    file.write_bytes(changed)
    if beside:
        file.with_suffix(other).write_bytes(pair.pdf if is_xml else pair.xml)
    else:
        file.with_suffix(other).unlink(missing_ok=True)
    verdict = verify_certificate(file, pair.trust, folder / "no runs")
    if not verdict.accepted:
        return REFUSED
    return UNCHANGED if _same(original, changed, is_xml) else CHANGED


def _same(original: bytes, changed: bytes, is_xml: bool) -> bool:
    """Whether an accepted file states what was signed: the same content, or bytes outside the signature."""
    if is_xml:
        try:
            return check_xml(changed).content == check_xml(original).content
        except NotIntact:
            return False
    first, last = _signature_digits(original)
    outside = original[:first] == changed[:first] and original[last:] == changed[last:]
    return outside and original[first:last].lower() == changed[first:last].lower()


def trials(pair: Pair, number: int, seed: int, folder: Path) -> Iterator[tuple[str, str]]:
    """Change the pair `number` times, the kinds in turn; yield kind and outcome."""
    names = list(KINDS)
    for n in range(number):
        kind, rng = names[n % len(names)], Random(f"{seed}/{n}")  # noqa: S311 - it draws changes, not keys
        original = pair.xml if kind in XML else pair.pdf
        changed = original
        while changed == original:  # the drawn change may equal the original
            changed = KINDS[kind](original, rng)
        yield kind, outcome(pair, changed, kind, folder, beside=n // len(names) % 2 == 1)


def main() -> int:
    asked = arguments(__doc__, number=1000, seed=16)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        done("run", "quick", "--dry-run", "--name", "unit-17", "--runs", folder / "runs")
        pair = signed_pair(folder / "runs" / "unit-17", folder)
        found = list(trials(pair, asked.number, asked.seed, folder))
    columns, counts = (REFUSED, UNCHANGED, CHANGED), Counter(found)
    print(
        "\n".join(
            markdown(("", *columns), ((kind, *(counts[kind, one] for one in columns)) for kind in KINDS))
        )
    )
    return 1 if any(came == CHANGED for _, came in found) else 0


if __name__ == "__main__":
    sys.exit(main())
