"""The pages: what is on each of them, that names are never markup, that the same content gives the same bytes."""

import io
import re
import shutil
import subprocess
from dataclasses import replace
from types import SimpleNamespace

import pikepdf
import pytest
from matplotlib.image import imread

from bench.certificate.content import Before, Issue, Item
from bench.certificate.gather import certificate_of
from bench.certificate.laboratory import Person, load_laboratory, load_order, texts_of
from bench.certificate.page import body_of, data_of, faults_of, pictures_of
from bench.certificate.proof import Writer, value_cells, verdict_of
from bench.certificate.signatures import check_pdf, sign_pdf
from bench.services.errors import Refused
from tests.support.certificates import ORDER, copy_run, write_files
from tests.support.signed import NOW, a_signatory

pytestmark = pytest.mark.figures
DCC = b'<?xml version="1.0"?>\n<certificate \xc2\xb5="1"/>\n'
NUMBER = "SIM-2026-0007"
NASTY = '#read("/etc/passwd") $x$ [a] *b* _c_ \\ @d <e> `f` "g" ~ // ґ µ\x1b[31m\u202e'


@pytest.fixture(scope="module")
def certificate(tmp_path_factory):
    folder = tmp_path_factory.mktemp("paper")
    copy_run(folder / "runs")
    laboratory, order = write_files(folder, {"logo": "logo.svg"}, ORDER)
    (folder / "logo.svg").write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 9 9"><circle r="4" cx="4" cy="4"/></svg>'
    )
    issue = Issue(NUMBER, "2026-11-22T18:00:00+02:00", Person(name="A. Example", role="head"))
    return certificate_of("finished", folder / "runs", load_laboratory(laboratory), load_order(order), issue)


@pytest.fixture(scope="module")
def body(certificate):
    return body_of(certificate, DCC)


def pages_of(pdf):
    """Return the text of each page, by a reader that is not ours."""
    if shutil.which("pdftotext") is None:
        pytest.skip("pdftotext is not on this machine")
    told = subprocess.run(["pdftotext", "-", "-"], input=pdf, capture_output=True, check=True).stdout  # noqa: S607
    return [" ".join(page.split()) for page in told.decode().split("\f")[:-1]]


@pytest.mark.slow
def test_the_same_content_gives_the_same_bytes(certificate, body):
    assert body_of(certificate, DCC) == body


@pytest.mark.slow
def test_it_is_what_it_claims_to_be_before_and_after_it_is_signed(body):
    assert faults_of(body) == ()
    signed = sign_pdf(body, a_signatory(), NOW, "Calibration certificate", "Kyiv")
    assert faults_of(signed) == ()
    assert signed.startswith(body)
    check_pdf(signed)


def test_each_page_has_the_number_and_says_that_it_is_simulated(body):
    pages = pages_of(body)
    assert len(pages) >= 4
    for n, page in enumerate(pages, 1):
        assert NUMBER in page
        assert f"Page {n} of {len(pages)}" in page
        assert "SIMULATED" in page
        assert "DRAFT" not in page
    assert [page.count("End of the certificate") for page in pages] == [0] * (len(pages) - 1) + [1]


def test_each_page_says_that_nobody_signed_it_unless_somebody_does(certificate, body):
    pages = pages_of(body)
    assert all("not signed" in page for page in pages)
    assert not re.search(r"electronic|signed by", " ".join(pages))
    signed = replace(certificate, issue=replace(certificate.issue, signed_by="Laboratory of Tests"))
    text = " ".join(pages_of(body_of(signed, DCC)))
    assert "electronic, by Laboratory of Tests, over the whole of this file" in text
    assert "DCC, XML, signed by itself" in text
    assert "not signed" not in text


def test_values_end_at_the_place_of_their_uncertainty(certificate, body):
    """JCGM 100:2008, 7.2.6: whatever stands with U on a page is rounded to the place of U, which has two digits."""
    text = " ".join(pages_of(body)).replace("−", "-")
    together = re.findall(r"(-?[\d.]+) (?:°C |m/s² )?± ([\d.]+)", text)
    assert len(together) == 12 + 2
    worst = re.search(r"max \|Δg\| = ([\d.]+) µg, U = ([\d.]+) µg", text)
    for value, U in (*together, worst.groups()):
        assert len(value.partition(".")[2]) == len(U.partition(".")[2])
        assert len(U.replace(".", "").strip("0")) <= 2
        if float(U) >= 100:
            assert value.endswith("0")
    points = certificate.found.verification.points
    assert max(p.U for p in points) > 100e-6  # so that tens are rounded
    assert f"{points[0].delta_g * 1e6:.1f}" not in text


def test_what_is_not_the_laboratorys_own_is_marked(certificate):
    """ISO/IEC 17025:2017, 7.8.2.1 k, l and p, 7.8.2.2, in both languages."""
    plain = " ".join(pages_of(body_of(certificate, DCC)))
    for words in (
        "relate only to the unit calibrated",
        "the results apply to it as received",
        "Results from external providers none stated",
        "but not for what the customer supplied",
    ):
        assert words in plain
    assert "validity" not in plain
    data = {
        "sampling": "5 of 200 by plan S-2",
        "external": ({"what": "linearity", "by": "Institute"},),
        "supplied": ({"what": "supply voltage"}, {"what": "colour", "affects_validity": False}),
    }
    order = type(certificate.order).model_validate({**certificate.order.model_dump(), **data})
    told = replace(certificate, order=order, texts=(texts_of("en"), texts_of("de")))
    pages = pages_of(body_of(told, DCC))
    text = " ".join(pages)
    for words in (
        "5 of 200 by plan S-2",
        "linearity: from Institute",
        "linearity: von Institute",
        "supply voltage (can affect the validity of the results)",
        "supply voltage (kann die Gültigkeit",
    ):
        assert words in text
    assert "as received" not in text
    assert "colour (can" not in text
    assert "the laboratory has not verified them" in pages[0]
    assert "das Laboratorium hat sie nicht geprüft" in pages[0]


def test_the_first_page_answers(certificate, body):
    first = pages_of(body)[0]
    found = certificate.found
    for words in (
        "Calibration certificate",
        "Navigation Works",
        found.item.serial,
        "2026-11-22",
        "A. Example",
        "as found",
    ):
        assert words in first
    assert "Accredited" not in first
    value = found.coefficients["Kxx"]
    assert f"{value.value:.9f}"[:6].replace("-", "−") in first
    assert "0.0003 g" in first
    assert "conditional" not in first  # a binary rule knows no such thing
    assert "limit 0.0003 g: pass" in first


def test_the_pages_prove(certificate, body):
    text = " ".join(pages_of(body)[1:])
    record = certificate.found.record
    assert record.head.replace(" ", "") in text.replace(" ", "")
    for name in ("result.json", "readings.csv", "seal.json", "dcc.xml"):
        assert name in text
    for instrument in certificate.found.instruments:
        assert instrument.name in text
    assert "limit of Δg and decision rule as the record states them" in text


def test_what_is_attached_is_there_byte_for_byte(certificate, body):
    with pikepdf.open(io.BytesIO(body)) as pdf:
        found = {name: file.get_file().read_bytes() for name, file in pdf.attachments.items()}
        related = {name: str(file.obj.AFRelationship) for name, file in pdf.attachments.items()}
    assert found == {"dcc.xml": DCC, **{one.name: one.content for one in certificate.attachments}}
    assert related["dcc.xml"] == "/Data"
    assert related["readings.csv"] == "/Source"


def test_a_draft_says_so_on_every_page_and_needs_nobody(certificate):
    bare = replace(certificate, issue=None, laboratory=None, order=None, unit=None)
    draft = body_of(bare, DCC)
    assert faults_of(draft) == ()
    assert all("DRAFT" in page for page in pages_of(draft))
    assert body_of(bare, DCC) == draft


def test_names_are_never_markup(certificate):
    """What stands in a name is set as it is; what acts in a terminal or turns the writing round is seen."""
    found = replace(certificate.found, item=Item(NASTY, 'S/N "17" #1'), notes=(NASTY,))
    (customer,) = (certificate.order.customer,)
    order = certificate.order.model_copy(update={"customer": customer.model_copy(update={"name": NASTY})})
    pdf = body_of(replace(certificate, found=found, order=order), DCC)
    assert faults_of(pdf) == ()
    text = " ".join(pages_of(pdf)).replace(" ", "")
    shown = NASTY.replace("\x1b", "\\x1b").replace("\u202e", "\\u202e").replace(" ", "")
    assert text.count(shown) == 3
    assert "root:" not in text


def test_a_letter_that_no_font_has_is_told(certificate):
    with pytest.raises(Refused, match="lack a character for 漢"):
        body_of(replace(certificate, found=replace(certificate.found, item=Item("漢字", "1"))), DCC)


def test_two_languages_stand_side_by_side(certificate):
    two = (texts_of("en"), texts_of("de"))
    before = Before("replaced", "SIM-2026-0003", "2026-10-01", "a wrong serial number", "0" * 64)
    both = replace(certificate, texts=two, issue=replace(certificate.issue, before=before))
    pdf = body_of(both, DCC)
    assert faults_of(pdf) == ()
    pages = pages_of(pdf)
    for n, page in enumerate(pages, 1):
        for words in (f"Page {n} of {len(pages)}", f"Seite {n} von {len(pages)}", "SIMULATED", "SIMULIERT"):
            assert words in page
    first = pages[0]
    for words in (
        "Calibration certificate",
        "Kalibrierschein",
        "SIM-2026-0003",
        "Authorised by",
        "Freigegeben von",
    ):
        assert words in first  # the answer and who stands for it have one page in two languages, too
    assert (texts_of("en").entries.keys()) == (texts_of("de").entries.keys())


def test_a_logo_that_is_none_is_told(certificate, tmp_path):
    laboratory, _ = write_files(tmp_path, {"logo": "logo.txt"}, ORDER)
    (tmp_path / "logo.txt").write_text("unknown format")
    with pytest.raises(Refused, match="unknown format"):
        body_of(replace(certificate, laboratory=load_laboratory(laboratory)), DCC)
    (tmp_path / "logo.txt").unlink()
    with pytest.raises(Refused, match="cannot be read"):
        body_of(replace(certificate, laboratory=load_laboratory(laboratory)), DCC)


# --- the rules of the check: each catches what breaks it -----------------------------------------------


def broken(body, change):
    out = io.BytesIO()
    with pikepdf.open(io.BytesIO(body)) as pdf:
        change(pdf)
        pdf.save(out, static_id=True)
    return out.getvalue()


def to_level_u(pdf):
    with pdf.open_metadata(set_pikepdf_as_editor=False) as told:
        told["pdfaid:conformance"] = "U"


def with_script(pdf):
    pdf.Root.OpenAction = pdf.make_indirect(pikepdf.Dictionary(S=pikepdf.Name.JavaScript, JS="app.alert(1)"))


def without_font(pdf):
    for one in pdf.objects:
        if isinstance(one, pikepdf.Dictionary) and "/FontFile3" in one:
            del one["/FontFile3"]


def hidden_annotation(pdf):
    note = pikepdf.Dictionary(Type=pikepdf.Name.Annot, Subtype=pikepdf.Name.Text, Rect=[0, 0, 9, 9], F=2)
    pdf.pages[0].obj.Annots = pikepdf.Array([pdf.make_indirect(note)])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (to_level_u, "level U"),
        (lambda pdf: pdf.Root.__delitem__("/OutputIntents"), "output intent"),
        (with_script, "JavaScript"),
        (without_font, "not embedded"),
        (lambda pdf: setattr(pdf.Root, "AF", pikepdf.Array(list(pdf.Root.AF)[1:])), "not associated"),
        (lambda pdf: pdf.attachments["seal.json"].obj.__delitem__("/AFRelationship"), "how it is related"),
        (lambda pdf: pdf.attachments.__setitem__("more.txt", b"more"), "attached more.txt"),
        (hidden_annotation, "not printed"),
        (lambda pdf: setattr(pdf.Root, "Version", pikepdf.Name("/2.0")), "version 2.0"),
    ],
)
def test_what_breaks_a_rule_is_found(body, change, words):
    assert any(words in fault for fault in faults_of(broken(body, change)))


def test_what_is_no_such_file_is_told(body):
    locked = io.BytesIO()
    with pikepdf.open(io.BytesIO(body)) as pdf:
        pdf.save(locked, encryption=pikepdf.Encryption(user="", owner="o"))
    assert any("encrypted" in fault for fault in faults_of(locked.getvalue()))
    assert re.search("does not begin", faults_of(b"")[0])
    assert "cannot be read" in faults_of(body[:1000])[0]


def test_a_long_word_stays_on_its_page(certificate):
    word = "W" * 150
    laboratory = certificate.laboratory.model_copy(update={"place": word, "environment": word})
    meter = replace(certificate.found.instruments[0], identity=word)
    found = replace(certificate.found, instruments=(meter, *certificate.found.instruments[1:]))
    for page in pictures_of(replace(certificate, laboratory=laboratory, found=found), DCC, 40.0)[:3]:
        picture = imread(io.BytesIO(page))
        assert picture[:, -int(picture.shape[1] * 16 / 210) :, :3].min() == 1.0  # the margin is 18 mm


def test_the_first_page_says_that_the_readings_contradict_the_model(certificate):
    unjudged = replace(certificate.found, verdict=None)
    own = SimpleNamespace(**{**vars(unjudged.result), "accepted": False})
    for found, key in ((unjudged, "no_conformity"), (replace(unjudged, result=own), "does not fit")):
        (block,) = verdict_of(found, Writer(certificate))
        assert block["words"] == [certificate.texts[0].say(key)]


def test_attached_files_are_described_in_each_language(certificate):
    both = replace(certificate, texts=(texts_of("uk"), texts_of("en")))
    (rows,) = (
        block["rows"]
        for block in data_of(both, DCC)["proof"]
        if str(block).count("seal.json") and "rows" in block
    )
    assert rows[1][1] == ["результат", "the result"]


def test_each_expanded_uncertainty_has_its_own_factor(certificate):
    """The laboratory chose k of the coefficients; Δg has k = 2."""
    own = certificate.found.coefficients
    values = replace(own, values=tuple(replace(value, k=1.645) for value in own.values))
    assert value_cells(values["Kxx"])[3] == "1.645"
    told = data_of(replace(certificate, found=replace(certificate.found, coefficients=values)), DCC)
    assert "k = 1.645" in str(told["front"])
    (stated,) = (lines for block in told["front"] if block["kind"] == "pairs" for _, lines in block["rows"]
                 if "max |Δg|" in str(lines))  # fmt: skip
    assert stated[0].endswith("µg (k = 2)")
