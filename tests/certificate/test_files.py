"""Laboratory and order files: read whole, every mistake told at once with its line."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import pytest

from bench.base.yaml_files import FileMistakes
from bench.certificate.dcc.document import document_of
from bench.certificate.laboratory import (
    LANGUAGES,
    OnCertificate,
    UnitOrder,
    load_laboratory,
    load_order,
    stated_fields,
    texts_of,
)
from bench.certificate.page import data_of
from bench.config.shipped import CERTIFICATE, shipped_folder
from tests.support.certificates import write_files


def test_the_shipped_files_are_read():
    laboratory = load_laboratory(shipped_folder(CERTIFICATE) / "laboratory.yaml")
    order = load_order(shipped_folder(CERTIFICATE) / "order.yaml")
    assert laboratory.language == ("en",)
    assert laboratory.register_folder == shipped_folder(CERTIFICATE).absolute() / "register"
    assert laboratory.person("A. Example").role == "head of the laboratory"
    assert laboratory.person("Somebody else") is None
    assert order.unit("any").state == "as found"


def test_every_mistake_of_a_laboratory_is_told_at_once(tmp_path):
    file = tmp_path / "laboratory.yaml"
    file.write_text(
        "name: L\n"
        "address: {street: S, post_code: 1, city: C, country: Ukraine}\n"
        "place: here\n"
        "numbers: 'SIM-{count}'\n"
        "regster: r\n"
        "authorised: []\n"
        "k: 0\n"
        "language: [en, xx]\n"
        "texts: {en: {titel: T}}\n"
    )
    with pytest.raises(FileMistakes) as error:
        load_laboratory(file)
    lines = str(error.value).splitlines()
    assert [line.split(": ", 1)[0].rsplit(":", 1)[1] for line in lines] == ["2", "4", "5", "6", "7", "8", "9"]
    assert "did you mean 'register'?" in lines[2]
    assert "did you mean 'title'?" in lines[6]


@pytest.mark.parametrize(
    "scheme", ["{year}", "{count}{count}", "a/{count}", "{count.x}", "{count:04d}", "../{count}"]
)
def test_a_scheme_that_would_not_number_files_is_refused(tmp_path, scheme):
    laboratory, _ = write_files(tmp_path, {"numbers": scheme})
    with pytest.raises(FileMistakes, match="numbers: expected a scheme"):
        load_laboratory(laboratory)


def test_numbers_of_simulated_runs_are_a_series_of_their_own(tmp_path):
    laboratory = load_laboratory(write_files(tmp_path, {"numbers": "L{year}/{count:3}".replace("/", "-")})[0])
    assert laboratory.number(7, 2026, simulated=False) == "L2026-007"
    assert laboratory.number(7, 2026, simulated=True) == "SIM-L2026-007"


def test_units_of_an_order_are_found_by_serial_number(tmp_path):
    units = [
        {"serial": "17", "received": "2026-11-01", "condition": "scratched", "state": "as left"},
        {"received": "2026-11-02", "condition": "undamaged", "state": "as found"},
    ]
    order = load_order(write_files(tmp_path, order={"units": units})[1])
    assert order.unit("17").condition == "scratched"
    assert order.unit("18").condition == "undamaged"


def test_mistakes_between_the_units_of_an_order_are_told(tmp_path):
    unit = {"serial": "17", "received": "2026-11-31", "condition": "x", "state": "as found"}
    with pytest.raises(FileMistakes) as error:
        load_order(write_files(tmp_path, order={"units": [unit, {**unit, "received": "2026-11-01"}]})[1])
    assert "there is no day 2026-11-31" in str(error.value)
    assert "unit 17 stands twice" in str(error.value)


def test_languages_say_the_same_things():
    english, german = (texts_of(language).entries for language in ("en", "de"))
    assert LANGUAGES == ("de", "en")
    for key in english:
        blanks = {frozenset(re.findall(r"\{\w+\}", text)) for text in (english[key], german[key])}
        assert len(blanks) == 1, key


def test_every_field_that_stands_on_the_certificate_has_words():
    for one in stated_fields(None, None, None):
        assert {one.key, one.place.otherwise} <= {"", *texts_of("en").entries}


class UnitWithColour(UnitOrder):
    colour: Annotated[str | None, OnCertificate("front")] = None
    seals: Annotated[tuple[str, ...], OnCertificate("method", "none_stated")] = ()


@pytest.mark.parametrize("stated", [{"colour": "red", "seals": ("S 1", "S 2")}, {}])
def test_a_new_field_is_a_line_of_its_file_and_its_words(issued_certificate, stated):
    """It is on its page and in the DCC: nothing but the model of the file and `words.yaml` changes."""
    unit = UnitWithColour(**{**issued_certificate.unit.model_dump(), **stated})
    words = [
        replace(one, entries={**one.entries, "colour": "Colour", "seals": "Seals"})
        for one in issued_certificate.texts
    ]
    certificate = replace(issued_certificate, unit=unit, texts=tuple(words))
    document = document_of(certificate)
    pages = data_of(certificate, document)
    front, method = ([row for block in pages[part] if block["kind"] == "pairs" for row in block["rows"]]
                     for part in ("front", "proof"))  # fmt: skip
    assert ([["Colour", "Colour"], ["red"]] in front) is bool(stated)
    (seals,) = (lines for heading, lines in method if heading == ["Seals", "Seals"])
    assert seals == ["S 1", "S 2"] if stated else seals == [[one.say("none_stated") for one in words]]
    for text in ("red", "S 1", "S 2"):
        assert (f">{text}</dcc:content>".encode() in document) is bool(stated)


def test_a_laboratory_may_have_words_of_its_own(tmp_path):
    own = {"language": ["en", "de"], "texts": {"de": {"title": "Prüfschein"}}}
    laboratory = load_laboratory(write_files(tmp_path, own)[0])
    from bench.certificate.gather import texts_for

    english, german = texts_for(laboratory)
    assert (english.say("title"), german.say("title")) == ("Calibration certificate", "Prüfschein")
    assert Path(laboratory.register_).name == "register"
