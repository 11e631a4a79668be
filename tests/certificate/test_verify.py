"""What is told of a certificate: intact or not, by whom, what register and record say, what is not proved."""

import io
import json
import re
import shutil
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from cryptography.hazmat.primitives.serialization import Encoding
from rich.console import Console

from bench.certificate.dcc.document import document_of
from bench.certificate.dcc.reading import coefficients_in, shown_of
from bench.certificate.page import body_of
from bench.certificate.register import ISSUED, REVOKED, Register
from bench.certificate.signatures import sign_pdf, sign_xml
from bench.certificate.verify import verify_certificate
from bench.services.chain import Entry, opened
from bench.services.errors import Refused
from tests.support.certificates import RECORDED
from tests.support.signed import NOW, a_signatory, authority, certified, signatory

OTHER = "Somebody else"


@dataclass
class Made:
    """The signed forms of a certificate, and what makes others of it."""

    certificate: object
    xml: bytes
    pdf: bytes

    def paper(self, xml, signer=None, now=NOW):
        return sign_pdf(body_of(self.certificate, xml), signer or a_signatory(), now, "", "")


@pytest.fixture(scope="module")
def made(issued_certificate):
    xml = sign_xml(document_of(issued_certificate), a_signatory(), NOW)
    return Made(
        issued_certificate, xml, sign_pdf(body_of(issued_certificate, xml), a_signatory(), NOW, "", "")
    )


@pytest.fixture
def written(made, tmp_path):
    """The two forms beside each other."""
    (tmp_path / "c.xml").write_bytes(made.xml)
    (tmp_path / "c.pdf").write_bytes(made.pdf)
    return tmp_path


def trust_in(folder, *certificates):
    file = folder / "trust.pem"
    file.write_bytes(b"".join(one.public_bytes(Encoding.PEM) for one in certificates))
    return file


def looked_at(file, trust=None, runs=Path("nowhere")):
    return verify_certificate(file, trust, runs)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["c.pdf", "c.xml"])
def test_without_a_trust_file_it_is_intact_and_the_signer_unknown(written, name):
    verdict = looked_at(written / name)
    assert verdict.verdict == "intact, signer unknown"
    assert verdict.accepted
    assert any("who signed" in text for text in verdict.not_proved)
    assert any("no authority stamped it" in text for text in verdict.not_proved)
    assert any("record is missing here" in text for text in verdict.not_proved)
    assert any("beside it has the same content" in text for text in verdict.agreed)


@pytest.mark.slow
def test_with_one_it_is_of_the_signer_or_of_another(written):
    own = trust_in(written, a_signatory().chain[0])
    verdict = looked_at(written / "c.pdf", own)
    assert (verdict.verdict, verdict.accepted) == ("intact, signed by Laboratory of Tests", True)
    assert not any("who signed" in text for text in verdict.not_proved)
    other = trust_in(written, authority("Another").certificate)
    verdict = looked_at(written / "c.xml", other)
    assert (verdict.verdict, verdict.accepted) == ("intact, signer not trusted", False)


@pytest.mark.slow
@pytest.mark.parametrize("trusted", [True, False])
@pytest.mark.parametrize(
    ("change", "why"),
    [
        (
            {"until": NOW - timedelta(days=1)},
            "(valid from 2026-10-23 to 2026-11-21) was not valid at the time",
        ),
        ({"sign": False}, "its key usage excludes signatures"),
        ({"key": rsa.generate_private_key(65537, 1024)}, "its key has 1024 bits, fewer than 2048"),  # noqa: S505
    ],
)
def test_a_key_that_may_not_sign_is_not_trusted_and_changes_nothing(
    made, tmp_path, caplog, change, why, trusted
):
    """Of a certificate that an expired key signed, the program said that it was changed."""
    change = dict(change)
    key = change.pop("key", None) or ec.generate_private_key(ec.SECP256R1())
    root = authority("Root")
    signer = signatory(key, certified(key.public_key(), "Laboratory of Tests", root, **change))
    xml = sign_xml(document_of(made.certificate), signer, NOW)
    for form, content in (("pdf", made.paper(xml, signer)), ("xml", xml)):
        file = tmp_path / f"c.{form}"
        file.write_bytes(content)
        verdict = looked_at(file, trust_in(tmp_path, root.certificate) if trusted else None)
        assert (verdict.verdict, verdict.accepted) == ("intact, signer not trusted", False)
        assert why in verdict.why_not_trusted
    assert not caplog.records, "a package told of it with a traceback"
    with pytest.raises(Refused, match="not read, as its "):
        coefficients_in(tmp_path / "c.xml")


@pytest.mark.slow
def test_what_is_shown_is_what_was_signed(made, written):
    result = looked_at(written / "c.pdf")
    found = made.certificate.found
    says = result.signed
    assert says.number == made.certificate.number
    assert says.laboratory == "Inertial Calibration Laboratory"
    assert says.customer == "Navigation Works"
    assert says.items == [f"{found.item.type}, {found.item.serial}"]
    assert says.simulated
    assert says.authorised_by == "A. Example"
    assert [one.value for one in says.coefficients.values()] == [
        one.value for one in found.coefficients.values
    ]
    assert shown_of(made.xml).covariance.tolist() == found.coefficients.covariance.tolist()
    assert {one["unit"] for one in result.to_dict()["signed"]["coefficients"].values()} == {r"\volt"}
    printed = io.StringIO()
    result.print_on(Console(file=printed, width=200))
    units = [line.split()[-1] for line in printed.getvalue().splitlines() if re.match("K[xyz]{2} |U0", line)]
    assert units == ["V/g"] * 9 + ["V"] * 3
    json.dumps(result.to_dict())


def test_comments_are_told_and_not_shown(made, tmp_path):
    (tmp_path / "c.xml").write_bytes(made.xml.replace(b"Navigation Works", b"Nav<!-- -->igation Works"))
    verdict = looked_at(tmp_path / "c.xml")
    assert verdict.intact
    assert verdict.signed.customer == "Navigation Works"
    assert "1 comments" in verdict.not_signed[0]


@pytest.mark.slow
def test_the_record_is_held_against_it(written, tmp_path):
    shutil.copytree(RECORDED, tmp_path / "runs" / "finished")
    verdict = looked_at(written / "c.pdf", runs=tmp_path / "runs")
    assert verdict.intact
    assert any("the same result to the last digit" in text for text in verdict.agreed)
    assert not any("record is missing here" in text for text in verdict.not_proved)
    events = tmp_path / "runs" / "finished" / "events.jsonl"
    events.write_bytes(b"".join(events.read_bytes().splitlines(keepends=True)[:-1]))
    verdict = looked_at(written / "c.pdf", runs=tmp_path / "runs")
    assert verdict.verdict == "CHANGED"
    assert "the seal covers" in verdict.wrong[0]


@pytest.mark.parametrize(("by_u", "intact"), [(1e-9, True), (1e-3, False)])
def test_what_another_computer_rounds_otherwise_is_no_change(made, tmp_path, by_u, intact):
    """A certificate whose result is off by so much of u from what its record gives here."""
    shutil.copytree(RECORDED, tmp_path / "runs" / "finished")
    found = made.certificate.found
    first, *others = found.coefficients.values
    moved = replace(first, value=first.value + by_u * first.u)
    text = found.result_json.replace(f'"value": {first.value!r}', f'"value": {moved.value!r}', 1)
    assert text != found.result_json
    values = replace(found.coefficients, values=(moved, *others))
    other = replace(made.certificate, found=replace(found, coefficients=values, result_json=text))
    (tmp_path / "c.xml").write_bytes(sign_xml(document_of(other), a_signatory(), NOW))
    verdict = looked_at(tmp_path / "c.xml", runs=tmp_path / "runs")
    assert verdict.intact is intact
    assert any("within 1e-06 u" in text for text in verdict.agreed) is intact
    assert any("gives another result" in text for text in verdict.wrong) is not intact


@pytest.mark.slow
def test_a_run_of_the_same_name_is_no_record_of_it(written, tmp_path):
    folder = shutil.copytree(RECORDED, tmp_path / "runs" / "finished")
    (folder / "run.json").write_text((folder / "run.json").read_text().replace("A. Person", "B. Person"))
    verdict = looked_at(written / "c.pdf", runs=tmp_path / "runs")
    assert verdict.intact
    assert any("record is missing here" in text for text in verdict.not_proved)


def other_number(made):
    changed = document_of(made.certificate).replace(b"SIM-2026-0001<", b"SIM-2026-0002<")
    return made.paper(sign_xml(changed, a_signatory(), NOW))


def other_values(made):
    value = repr(made.certificate.found.coefficients["Kxx"].value).encode()
    document = document_of(made.certificate)
    changed = document.replace(value + b" ", b"-2.0 ", 1)
    assert changed != document
    return made.paper(sign_xml(changed, a_signatory(), NOW))


def other_result(made):
    """An XML that holds another result than the PDF has attached."""
    import base64

    (result,) = (one for one in made.certificate.attachments if one.name == "result.json")
    old, new = base64.b64encode(result.content), base64.b64encode(result.content + b" ")
    document = document_of(made.certificate)
    assert old in document
    return made.paper(sign_xml(document.replace(old, new), a_signatory(), NOW))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "words"),
    [
        (
            lambda made: made.paper(made.xml, a_signatory(OTHER)),
            "was signed by Somebody else, its XML by Laboratory of Tests",
        ),
        (other_number, "its XML of certificate SIM-2026-0002"),
        (
            lambda made: made.paper(document_of(made.certificate)),
            "the attached dcc.xml: it claims a signature but has none",
        ),
        (
            lambda made: made.paper(made.xml.replace(b"Navigation Works", b"Navigation Work")),
            "the attached dcc.xml: the signature is invalid",
        ),
        (other_values, "differ from its result"),
        (other_result, "result.json in the XML differs"),
        (
            lambda made: made.paper(sign_xml(b"<nothing/>", a_signatory(), NOW)),
            "the attached dcc.xml: it is not a digital calibration certificate",
        ),
    ],
)
def test_forms_that_do_not_agree_are_refused_whoever_signed_them(made, tmp_path, make, words):
    (tmp_path / "c.pdf").write_bytes(make(made))
    verdict = looked_at(tmp_path / "c.pdf")
    assert (verdict.verdict, verdict.accepted) == ("CHANGED", False)
    assert words in " ".join(verdict.wrong)
    assert verdict.signed is None


@pytest.mark.slow
def test_another_certificate_beside_it_is_told(made, written):
    theirs = sign_xml(document_of(made.certificate), a_signatory(OTHER), NOW)
    (written / "c.xml").write_bytes(theirs)
    assert "c.xml beside it differs" in looked_at(written / "c.pdf").wrong[0]
    assert "c.pdf beside it differs" in looked_at(written / "c.xml").wrong[0]
    (written / "c.xml").write_bytes(made.xml)
    (written / "c.pdf").write_bytes(made.pdf + b"\n")
    assert (
        "c.pdf beside it: its signature does not cover the end of the file"
        in looked_at(written / "c.xml").wrong[0]
    )


def test_files_that_cannot_be_read_are_told(tmp_path):
    with pytest.raises(Refused, match="cannot be read"):
        looked_at(tmp_path / "none.pdf")
    (tmp_path / "c.pdf").write_bytes(b"nothing")
    with pytest.raises(Refused, match="no X\\.509"):
        looked_at(tmp_path / "c.pdf", tmp_path / "c.pdf")
    verdict = looked_at(tmp_path / "c.pdf")
    assert (verdict.verdict, verdict.accepted) == ("NO CERTIFICATE", False)
    assert "not a PDF" in verdict.wrong[0]


NUMBER = "SIM-2026-0001"
NOWHERE = Path("nowhere")
SIGNED, UNSIGNED = "intact, signer unknown", "not signed, unchanged since it was issued"


@pytest.fixture(scope="module")
def forms(made):
    """PDF and XML of one certificate, signed and not."""
    bare = replace(made.certificate, issue=replace(made.certificate.issue, signed_by=""))
    unsigned = document_of(bare)
    return {
        True: {"pdf": made.pdf, "xml": made.xml},
        False: {"pdf": body_of(bare, unsigned), "xml": unsigned},
        "draft": body_of(replace(made.certificate, issue=None), b""),
    }


def issued(folder, forms, number=NUMBER, **data):
    """Issue a certificate in a register of its own; return where its PDF stands."""
    entry = Entry(ISSUED, number, NOW.isoformat(), "A", {"record": {"head": ""}, "signed_by": None, **data})
    with opened(Register(folder)) as register:
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
    with opened(Register(folder / "register")) as register:
        register.append(Entry(REVOKED, NUMBER, NOW.isoformat(), "A", {"reason": "wrong unit"}))
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


@pytest.mark.slow
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
    assert (verdict.verdict, verdict.accepted) == (headline, accepted)
    told = verdict.to_dict()
    there = [name for name in ("signed", "unsigned") if told[name] is not None]
    assert there == ([] if headline == "CHANGED" else ["signed" if signed else "unsigned"])
    open_to_doubt = any("register" in text for text in verdict.not_proved)
    not_named = happened is nowhere or (not signed and happened in {beside, amended})
    assert open_to_doubt == not_named


@pytest.mark.parametrize(
    ("happened", "words"),
    [
        (intact, None),
        (nowhere, None),
        (revoked, f"has {NUMBER} as revoked (wrong unit): do not use it"),
        (amended, f"has {NUMBER} as amended by SIM-2026-0002: use that certificate"),
    ],
)
def test_a_certificate_that_is_read_is_told_as_invalid_by_the_register_beside_it(
    forms, tmp_path, happened, words
):
    file, _ = happened(tmp_path, forms[True])
    for form in ("pdf", "xml"):
        _, (signature, *told) = coefficients_in(file.with_suffix(f".{form}"))
        assert "intact" in signature
        assert told == ([] if words is None else [f"the register in {file.parent} {words}"])


def test_nothing_is_said_of_a_signer_who_is_not_there(forms, tmp_path):
    file, register = intact(tmp_path, forms[False])
    verdict = verify_certificate(file, None, NOWHERE, register)
    assert (verdict.signer.name, verdict.why_not_trusted) == ("", None)
    assert not any("signer" in text for text in (*verdict.agreed, *verdict.not_proved))
    verdict = verify_certificate(file, trust_in(tmp_path, a_signatory().chain[0]), NOWHERE, register)
    assert (verdict.accepted, verdict.why_not_trusted) == (False, "nobody signed it")


def test_a_signature_that_was_taken_off_is_missed(forms, tmp_path):
    """What says that it is signed, and is not, was changed; so was one that somebody else signed."""
    file, _ = nowhere(tmp_path, forms[True])
    body = file.read_bytes()
    file.write_bytes(body[: body.index(b"%%EOF") + 6])
    assert "the XML in it is signed, but not the PDF" in verify_certificate(file, None, NOWHERE).wrong[0]
    xml = file.with_suffix(".xml")
    start, end = xml.read_bytes().index(b"<ds:Signature "), xml.read_bytes().index(b"</ds:Signature>")
    xml.write_bytes(xml.read_bytes()[:start] + xml.read_bytes()[end + 15 :])
    wrong = verify_certificate(xml, None, NOWHERE).wrong
    assert wrong == ["it claims a signature but has none; ask the laboratory for the original"]
    xml.write_bytes(sign_xml(forms[False]["xml"], a_signatory(), NOW))
    wrong = verify_certificate(xml, None, NOWHERE).wrong
    assert wrong == ["it claims to be unsigned but has a signature; ask the laboratory for the original"]


def test_parts_of_an_unsigned_certificate_that_do_not_agree_are_a_change(forms, tmp_path, issued_certificate):
    file, _ = nowhere(tmp_path, forms[False])
    xml = file.with_suffix(".xml")
    value = repr(issued_certificate.found.coefficients["Kxx"].value).encode()
    xml.write_bytes(forms[False]["xml"].replace(value + b" ", b"-2.0 ", 1))
    verdict = verify_certificate(xml, None, NOWHERE)
    assert verdict.verdict == "CHANGED"
    assert "differ from its result" in verdict.wrong[0]
    column = forms[False]["xml"].index(b"<si:covarianceXMLList>")
    first = forms[False]["xml"].index(b"<si:valueXMLList>", column) + len(b"<si:valueXMLList>")
    ragged = forms[False]["xml"][:first] + forms[False]["xml"][first:].split(b" ", 1)[1]
    xml.write_bytes(ragged)
    verdict = verify_certificate(xml, None, NOWHERE)
    assert verdict.verdict == "CHANGED"
    assert "a covariance of another size" in verdict.wrong[0]
    xml.write_bytes(forms[False]["xml"].replace(b"Navigation Works", b"Navigation Work"))
    assert "c.xml beside it differs" in verify_certificate(file, None, NOWHERE).wrong[0].replace(NUMBER, "c")


def test_a_draft_and_a_register_that_is_not_there_are_told(forms, tmp_path):
    (tmp_path / "draft.pdf").write_bytes(forms["draft"])
    verdict = verify_certificate(tmp_path / "draft.pdf", None, NOWHERE)
    assert (verdict.verdict, verdict.wrong) == (
        "NO CERTIFICATE", ["it is a draft and was never issued; ask the laboratory for the original"]
    )  # fmt: skip
    file, _ = nowhere(tmp_path, forms[False])
    with pytest.raises(Refused, match="no register there"):
        verify_certificate(file, None, NOWHERE, tmp_path / "none")
