"""Signed or not, by what the register says: what `bench certificate verify` makes of each combination."""

from dataclasses import replace
from pathlib import Path

import pytest

from bench.certificate import proof
from bench.certificate.dcc.document import document_of
from bench.certificate.page import body_of
from bench.certificate.register import ISSUED, REVOKED, Entry, opened
from bench.certificate.signatures import sign_pdf, sign_xml
from bench.certificate.verify import verify_certificate
from bench.services.errors import Refused
from tests.support.signed import NOW, a_signatory

NUMBER = "SIM-2026-0001"
NOWHERE = Path("nowhere")
SVG = '<svg viewBox="0 0 2 1"><path d="M0 0L2 1" stroke="black"/></svg>'
SIGNED, UNSIGNED = "intact, signer unknown", "not signed, unchanged since it was issued"


@pytest.fixture(scope="module")
def forms(issued_certificate):
    """PDF and XML of one certificate, signed and not."""
    bare = replace(issued_certificate, issue=replace(issued_certificate.issue, signed_by=""))
    xml = sign_xml(document_of(issued_certificate), a_signatory(), NOW)
    with pytest.MonkeyPatch.context() as patch:  # figures take most of the time
        for name in ("residuals_by_angle", "verification_points"):
            patch.setattr(proof, name, lambda _: SVG)
        pdf = sign_pdf(body_of(issued_certificate, xml), a_signatory(), NOW, "", "")
        unsigned = document_of(bare)
        return {
            True: {"pdf": pdf, "xml": xml},
            False: {"pdf": body_of(bare, unsigned), "xml": unsigned},
            "draft": body_of(replace(issued_certificate, issue=None), b""),
        }


def issued(folder, forms, number=NUMBER, **data):
    """Issue a certificate in a register of its own; return where its PDF stands."""
    entry = Entry(ISSUED, number, NOW.isoformat(), "A", {"record": {"head": ""}, "signed_by": None, **data})
    with opened(folder) as register:
        register.issue(entry, {f"{number}.{form}": content for form, content in forms.items()})
    return folder / f"{number}.pdf"


def intact(folder, forms):
    return issued(folder / "register", forms), folder / "register"


def beside(folder, forms):
    """The register was not named, but stands beside the file: anybody can write one."""
    return issued(folder / "register", forms), None


def changed(folder, forms):
    file = issued(folder / "register", forms)
    file.write_bytes(file.read_bytes() + b"\n")
    return file, folder / "register"


def revoked(folder, forms):
    file = issued(folder / "register", forms)
    with opened(folder / "register") as register:
        register.revoke(Entry(REVOKED, NUMBER, NOW.isoformat(), "A", {"reason": "wrong unit"}))
    return file, folder / "register"


def amended(folder, forms):
    file = issued(folder / "register", forms)
    issued(folder / "register", {}, "SIM-2026-0002", before={"kind": "amended", "number": NUMBER})
    return file, None


def unknown(folder, forms):
    file, _ = nowhere(folder, forms)
    issued(folder / "register", {}, "SIM-2026-0002")
    return file, folder / "register"


def nowhere(folder, forms):
    for form, content in forms.items():
        (folder / f"{NUMBER}.{form}").write_bytes(content)
    return folder / f"{NUMBER}.pdf", None


@pytest.mark.parametrize(
    ("signed", "happened", "headline", "accepted"),
    [
        (True, intact, SIGNED, True),
        (True, changed, "CHANGED", False),
        (True, revoked, f"{SIGNED}, REVOKED (wrong unit)", False),
        (True, beside, SIGNED, True),
        (True, unknown, f"{SIGNED}, UNKNOWN TO THE REGISTER", False),
        (True, nowhere, SIGNED, True),
        (False, intact, UNSIGNED, True),
        (False, changed, "CHANGED", False),
        (False, revoked, f"{UNSIGNED}, REVOKED (wrong unit)", False),
        (False, amended, "not signed, AMENDED (SIM-2026-0002)", False),
        (False, beside, "not signed", False),
        (False, unknown, "not signed, UNKNOWN TO THE REGISTER", False),
        (False, nowhere, "not signed", False),
    ],
)
def test_what_is_said_of_a_certificate_by_signature_and_register(
    forms, tmp_path, signed, happened, headline, accepted
):
    file, register = happened(tmp_path, forms[signed])
    verdict = verify_certificate(file, None, NOWHERE, register)
    assert (verdict.headline, verdict.accepted) == (headline, accepted)
    told = verdict.result().to_dict()
    there = [name for name in ("signed", "unsigned") if told[name] is not None]
    assert there == ([] if headline == "CHANGED" else ["signed" if signed else "unsigned"])
    open_to_doubt = any("register" in text for text in verdict.not_proved)
    not_named = happened is nowhere or (not signed and happened in {beside, amended})
    assert open_to_doubt == not_named


def test_nothing_is_said_of_a_signer_who_is_not_there(forms, tmp_path):
    file, register = intact(tmp_path, forms[False])
    verdict = verify_certificate(file, None, NOWHERE, register)
    assert (verdict.signer, verdict.why_not_trusted) == ("", None)
    assert not any("signer" in text for text in (*verdict.agreed, *verdict.not_proved))
    trust = tmp_path / "trust.pem"
    from cryptography.hazmat.primitives.serialization import Encoding

    trust.write_bytes(a_signatory().chain[0].public_bytes(Encoding.PEM))
    verdict = verify_certificate(file, trust, NOWHERE, register)
    assert (verdict.accepted, verdict.why_not_trusted) == (False, "nobody signed it")


def test_a_signature_that_was_taken_off_is_missed(forms, tmp_path):
    """What says that it is signed, and is not, was changed; so was one that somebody else signed."""
    file, _ = nowhere(tmp_path, forms[True])
    body = file.read_bytes()
    file.write_bytes(body[: body.index(b"%%EOF") + 6])
    assert (
        "the XML in it is signed, and nobody signed the PDF" in verify_certificate(file, None, NOWHERE).wrong
    )
    xml = file.with_suffix(".xml")
    start, end = xml.read_bytes().index(b"<ds:Signature "), xml.read_bytes().index(b"</ds:Signature>")
    xml.write_bytes(xml.read_bytes()[:start] + xml.read_bytes()[end + 15 :])
    wrong = verify_certificate(xml, None, NOWHERE).wrong
    assert wrong == ["it says that it is signed, and nobody signed it"]
    xml.write_bytes(sign_xml(forms[False]["xml"], a_signatory(), NOW))
    wrong = verify_certificate(xml, None, NOWHERE).wrong
    assert wrong == ["it says that nobody signed it, and it is signed"]


def test_parts_of_an_unsigned_certificate_that_do_not_agree_are_a_change(forms, tmp_path, issued_certificate):
    file, _ = nowhere(tmp_path, forms[False])
    xml = file.with_suffix(".xml")
    value = repr(issued_certificate.found.coefficients["Kxx"].value).encode()
    xml.write_bytes(forms[False]["xml"].replace(value + b" ", b"-2.0 ", 1))
    verdict = verify_certificate(xml, None, NOWHERE)
    assert verdict.headline == "CHANGED"
    assert "are not those of the result that it holds" in verdict.wrong[0]
    xml.write_bytes(forms[False]["xml"].replace(b"Navigation Works", b"Navigation Work"))
    assert "c.xml beside it is another" in verify_certificate(file, None, NOWHERE).wrong[0].replace(
        NUMBER, "c"
    )


def test_a_draft_and_a_register_that_is_not_there_are_told(forms, tmp_path):
    (tmp_path / "draft.pdf").write_bytes(forms["draft"])
    verdict = verify_certificate(tmp_path / "draft.pdf", None, NOWHERE)
    assert (verdict.headline, verdict.wrong) == ("NO CERTIFICATE", ["it is a draft, and was never issued"])
    file, _ = nowhere(tmp_path, forms[False])
    with pytest.raises(Refused, match="there is no register"):
        verify_certificate(file, None, NOWHERE, tmp_path / "none")
