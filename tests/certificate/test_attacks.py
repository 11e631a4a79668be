"""What is done to signed files: wrapped, appended, hidden, signed again; it is refused, or changes nothing."""

import io
import re
from datetime import timedelta

import pikepdf
import pytest
from lxml import etree
from pyhanko.pdf_utils.incremental_writer import IncrementalPdfFileWriter

from bench.certificate.signatures import SIGNATURE, NotIntact, check_pdf, check_xml, sign_pdf, sign_xml
from bench.services.errors import Refused
from tests.support.signed import NOW, a_signatory, blank_pdf

XML = b"""<c:cert xmlns:c="urn:c" version="3"><!-- made by hand -->
  <c:value unit="V">-2.177</c:value><c:id>2026-0001</c:id>
</c:cert>"""
DS = f"{{{SIGNATURE}}}"


@pytest.fixture(scope="module")
def signed_xml():
    return sign_xml(XML, a_signatory(), NOW)


@pytest.fixture(scope="module")
def signed_pdf():
    return sign_pdf(blank_pdf(), a_signatory(), NOW, "certificate", "Kyiv")


def test_the_content_of_a_signature_has_no_comment_and_no_signature(signed_xml):
    checked = check_xml(signed_xml)
    assert checked.content == XML.replace(b"<!-- made by hand -->", b"")
    assert (checked.signed_at, checked.comments) == (NOW, 1)
    assert check_xml(signed_xml.replace(b"by hand", b"by nobody")).content == checked.content


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"-2.177", b"-2.178"),
        (b"-2.177", b"-2.177 "),
        (b"-2.177", b"-2<!-- -->.178"),
        (b'"V"', b'"mV"'),
        (b"</c:value><c:id>", b"</c:value> <c:id>"),
        (b'version="3"', b'version="3" more="1"'),
        (b"c:cert", b"c:bert"),
        (b"+00:00</", b"+01:00</"),
    ],
)
def test_what_is_signed_in_xml_cannot_be_changed(signed_xml, old, new):
    with pytest.raises(NotIntact, match="is invalid"):
        check_xml(signed_xml.replace(old, new))


def test_a_comment_within_a_value_does_not_cut_it(signed_xml):
    """A reader that takes the text before a comment for the value would show 2 in place of -2.177."""
    whole = check_xml(signed_xml.replace(b"-2.177", b"-2<!-- -->.177")).content
    assert etree.fromstring(whole)[0].text == "-2.177"


def wrapped(root):
    """Put the signed document into one with other values, the signature where it is looked for."""
    new, signature = etree.fromstring(XML.replace(b"-2.177", b"-9.999")), root.find(f"{DS}Signature")
    root.remove(signature)
    new.extend([root, signature])
    return new


def within_object(root):
    """Hide the signed document in an object of its signature."""
    new, signature = etree.fromstring(XML.replace(b"-2.177", b"-9.999")), root.find(f"{DS}Signature")
    root.remove(signature)
    etree.SubElement(signature, f"{DS}Object").append(root)
    new.append(signature)
    return new


def signed_twice(root):
    root.append(etree.fromstring(etree.tostring(root.find(f"{DS}Signature"))))


def not_at_the_end(root):
    root.insert(0, root.find(f"{DS}Signature"))


def unsigned_properties(root):
    (properties,) = root.iter("{http://uri.etsi.org/01903/v1.3.2#}QualifyingProperties")
    etree.SubElement(properties, "{http://uri.etsi.org/01903/v1.3.2#}UnsignedProperties")


def no_signature(root):
    root.remove(root.find(f"{DS}Signature"))


def a_reference_less(root):
    info = root.find(f".//{DS}SignedInfo")
    info.remove(info.findall(f"{DS}Reference")[2])


@pytest.mark.parametrize(
    ("attack", "words"),
    [
        (wrapped, "is invalid"),
        (within_object, "unsigned parts"),
        (signed_twice, "2 signatures"),
        (not_at_the_end, "is not the last element"),
        (unsigned_properties, "unsigned parts"),
        (no_signature, "no XML signature"),
        (a_reference_less, "is invalid"),
    ],
)
def test_a_wrapped_signature_is_refused(signed_xml, attack, words):
    root = etree.fromstring(signed_xml)
    changed = attack(root)
    with pytest.raises(NotIntact, match=words):
        check_xml(etree.tostring(root if changed is None else changed))


@pytest.mark.parametrize(
    ("put", "words"),
    [
        (b'<!DOCTYPE c:cert [<!ENTITY v "1">]>', "DOCTYPE"),
        (b'<!DOCTYPE c:cert SYSTEM "http://127.0.0.1:1/x.dtd">', "DOCTYPE"),
        (b'<?xml-stylesheet href="shown.xsl"?>', "processing instructions"),
        (b"<", "not XML"),
    ],
)
def test_what_stands_before_the_document_is_refused(signed_xml, put, words):
    with pytest.raises(NotIntact, match=words):
        check_xml(signed_xml.replace(b"<c:cert", put + b"<c:cert", 1))


def test_another_signer_shows_as_another(signed_xml):
    theirs = sign_xml(XML, a_signatory("Somebody else"), NOW)
    assert check_xml(theirs).chain != check_xml(signed_xml).chain
    foreign = re.search(rb"<ds:X509Certificate>.*?</ds:X509Certificate>", theirs, re.DOTALL)[0]
    with pytest.raises(NotIntact, match="is invalid"):
        check_xml(
            re.sub(rb"<ds:X509Certificate>.*?</ds:X509Certificate>", foreign, signed_xml, flags=re.DOTALL)
        )


def test_what_is_signed_is_not_signed_again(signed_xml, signed_pdf):
    with pytest.raises(Refused, match="already signed"):
        sign_xml(signed_xml, a_signatory(), NOW)
    with pytest.raises(Refused, match="already signed"):
        sign_pdf(signed_pdf, a_signatory(), NOW, "", "")


# --- PDF --------------------------------------------------------------------------------------------


def test_the_body_stands_before_its_signature_as_it_was(signed_pdf):
    assert signed_pdf.startswith(blank_pdf())
    assert check_pdf(signed_pdf).signed_at == NOW


def appended(pdf, change):
    writer = IncrementalPdfFileWriter(io.BytesIO(pdf))
    change(writer)
    out = io.BytesIO()
    writer.write(out)
    assert out.getvalue().startswith(pdf)
    return out.getvalue()


def content_shown_anew(writer):
    page = writer.root["/Pages"]["/Kids"][0]
    page["/MediaBox"][2] = type(page["/MediaBox"][2])(100)
    writer.update_container(page["/MediaBox"])
    writer.mark_update(page.container_ref)


def form_filled(writer):
    """What some readers let pass after a signature: a field."""
    from pyhanko.sign.fields import SigFieldSpec, append_signature_field

    append_signature_field(writer, SigFieldSpec("Second"))


def attached(writer):
    from pyhanko.pdf_utils.embed import EmbeddedFileObject, FileSpec, embed_file

    file = EmbeddedFileObject.from_file_data(writer, data=b"<other/>", mime_type="text/xml")
    embed_file(writer, FileSpec("other.xml", file_name="other.xml", embedded_data=file))


@pytest.mark.parametrize("change", [content_shown_anew, form_filled, attached])
def test_nothing_can_be_appended_to_a_signed_file(signed_pdf, change):
    """Shadow attacks hide something in a file before it is signed, and show it by an update after."""
    with pytest.raises(NotIntact, match="something was appended"):
        check_pdf(appended(signed_pdf, change))


def test_an_update_before_the_signature_is_no_body(signed_pdf):
    body = appended(blank_pdf(), attached)
    with pytest.raises(NotIntact, match="appended to it after the signature"):
        check_pdf(sign_pdf(body, a_signatory(), NOW, "", ""))


def test_a_second_signature_is_refused(signed_pdf):
    from asn1crypto.x509 import Certificate
    from cryptography.hazmat.primitives.serialization import Encoding
    from pyhanko.sign import signers
    from pyhanko.sign.general import SigningError
    from pyhanko_certvalidator.registry import SimpleCertificateStore

    other = a_signatory("Somebody else")

    class ByKey(signers.Signer):
        async def async_sign_raw(self, data, digest_algorithm, dry_run=False):
            return other.sign(data)

    own = Certificate.load(other.chain[0].public_bytes(Encoding.DER))
    signer = ByKey(signing_cert=own, cert_registry=SimpleCertificateStore())
    writer = IncrementalPdfFileWriter(io.BytesIO(signed_pdf))
    told = signers.PdfSignatureMetadata(field_name="Second", md_algorithm="sha256")
    with pytest.raises(SigningError):  # the library, too, will not add to what allows no change
        signers.sign_pdf(writer, told, signer)
    certifies_nothing = signers.sign_pdf(
        IncrementalPdfFileWriter(io.BytesIO(blank_pdf())), told, signer
    ).getvalue()
    with pytest.raises(NotIntact, match="not PAdES"):
        check_pdf(certifies_nothing)
    approved = signers.PdfSignatureMetadata(field_name="Third", md_algorithm="sha256")
    twice = signers.sign_pdf(
        IncrementalPdfFileWriter(io.BytesIO(certifies_nothing)), approved, signer
    ).getvalue()
    with pytest.raises(NotIntact, match="2 signatures"):
        check_pdf(twice)


def gap_of(pdf):
    _, before, after, _ = map(int, re.search(rb"/ByteRange\s*\[\s*(\d+) (\d+) (\d+) (\d+)", pdf).groups())
    return before, after


def test_the_place_of_the_signature_hides_nothing(signed_pdf):
    before, after = gap_of(signed_pdf)
    assert signed_pdf[after - 5 : after] == b"0000>"
    for at, put in ((after - 9, b"41414141"), (after - 9, b"00    00"), (before, b"(")):
        changed = signed_pdf[:at] + put + signed_pdf[at + len(put) :]
        with pytest.raises(NotIntact):
            check_pdf(changed)


@pytest.mark.parametrize("byte", [3, 25, 26, 28, 31, 40, 42])
def test_what_wraps_the_signature_is_as_it_was_made(signed_pdf, byte):
    """Versions and the list of algorithms of the CMS are not signed; a campaign of changes found them open."""
    at = gap_of(signed_pdf)[0] + 1 + 2 * byte + 1
    digit = b"%x" % (int(signed_pdf[at : at + 1], 16) ^ 1)
    with pytest.raises(NotIntact):
        check_pdf(signed_pdf[:at] + digit + signed_pdf[at + 1 :])


@pytest.mark.parametrize("at", [20, 400, -30, -600])
def test_a_byte_of_a_signed_file_cannot_be_changed(signed_pdf, at):
    changed = bytearray(signed_pdf)
    changed[at] ^= 1
    with pytest.raises(NotIntact):
        check_pdf(bytes(changed))


def test_what_is_no_certificate_is_told(signed_pdf):
    for file, words in (
        (b"GIF89a" + signed_pdf, "first byte"),
        (blank_pdf(), "no PDF signature"),
        (b"%PDF-1.7\n", "read"),
    ):
        with pytest.raises(NotIntact, match=words):
            check_pdf(file)
    locked = io.BytesIO()
    with pikepdf.open(io.BytesIO(blank_pdf())) as pdf:
        pdf.save(locked, encryption=pikepdf.Encryption(user="", owner="o"))
    with pytest.raises(NotIntact, match="encrypted"):
        check_pdf(locked.getvalue())


def test_the_time_of_a_signature_is_its_signers(signed_xml):
    later = NOW + timedelta(days=3)
    assert check_xml(sign_xml(XML, a_signatory(), later)).signed_at == later
