"""The register of certificates, and the files of laboratory and order."""

import json
import os
import random
import re
import signal
import time
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Annotated

import pytest

from bench.base.yaml_files import FileMistakes
from bench.certificate import register as module
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
from bench.certificate.register import ISSUED, REVOKED, Register
from bench.config.shipped import CERTIFICATE, shipped_folder
from bench.services import chain
from bench.services.chain import LINES, Entry, opened
from bench.services.errors import Refused
from tests.support.certificates import ORDER, write_files


def entry(number, **data):
    return Entry(ISSUED, number, "2026-11-22T12:00:00+00:00", "A. Example", {"record": {"head": "x"}, **data})


def issue(folder, *numbers):
    with opened(Register(folder)) as register:
        for number in numbers:
            register.issue(entry(number), {f"{number}.xml": number.encode(), f"{number}.pdf": b"pdf"})


def names(folder):
    return {path.name for path in folder.iterdir()} - {".register.lock", "made-from"}


def test_what_was_issued_is_there_when_it_is_opened_again(tmp_path):
    issue(tmp_path, "1", "2")
    with opened(Register(tmp_path)) as register:
        assert list(register.standings) == ["1", "2"]
        assert register.file("2.xml") == b"2"
        assert register.number_after(iter("123")) == "3"
    assert names(tmp_path) == {LINES, "1.xml", "1.pdf", "2.xml", "2.pdf"}


def test_a_number_is_never_issued_twice(tmp_path):
    issue(tmp_path, "1")
    with opened(Register(tmp_path)) as register, pytest.raises(Refused, match="issued before"):
        register.issue(entry("1"), {"1.xml": b"other"})
    assert (tmp_path / "1.xml").read_bytes() == b"1"


def test_each_line_has_the_hash_of_the_one_before(tmp_path):
    issue(tmp_path, "1", "2", "3")
    lines = (tmp_path / LINES).read_bytes().splitlines(keepends=True)
    for wrong in (
        lines[:1] + lines[2:],
        [lines[0].replace(b"A. Example", b"A. Nother"), *lines[1:]],
        [*lines, lines[0]],
        [b"{}\n"],
    ):
        (tmp_path / LINES).write_bytes(b"".join(wrong))
        with pytest.raises(Refused, match=f"{LINES}, line"), opened(Register(tmp_path)):
            pass


def test_lines_that_are_taken_away_while_it_is_known_are_noticed(tmp_path):
    issue(tmp_path, "1", "2")
    with opened(Register(tmp_path)) as register:
        pass
    lines = (tmp_path / LINES).read_bytes().splitlines(keepends=True)
    (tmp_path / LINES).write_bytes(lines[0])
    with pytest.raises(Refused, match="the last lines are missing"), opened(register):
        pass


def test_a_half_written_line_is_no_line(tmp_path):
    issue(tmp_path, "1")
    with (tmp_path / LINES).open("ab") as file:
        file.write(b'{"n": 2, "type": "iss')
    issue(tmp_path, "2")
    with opened(Register(tmp_path)) as register:
        assert list(register.standings) == ["1", "2"]


def killed(tmp_path, monkeypatch, name, after):
    """Issue number 2, and stop as if killed at the `after`-th call of an operation."""
    calls = []

    class Killed(BaseException):
        pass

    real = getattr(module, name)

    def operation(*arguments):
        calls.append(arguments)
        if len(calls) == after:
            raise Killed
        return real(*arguments)

    with monkeypatch.context() as patch:
        for one in (module, chain):  # what both do is one operation
            patch.setattr(one, name, operation, raising=one is module)
        try:
            issue(tmp_path, "2")
        except Killed:
            return True
    return False


@pytest.mark.parametrize(
    ("operation", "after"), [("write_synced", 1), ("write_synced", 2), ("sync_folder", 1)]
)
def test_killed_before_its_line_a_certificate_is_not_there(tmp_path, monkeypatch, operation, after):
    issue(tmp_path, "1")
    assert killed(tmp_path, monkeypatch, operation, after)
    with opened(Register(tmp_path)) as register:
        assert list(register.standings) == ["1"]
        assert register.number_after(iter("123")) == "2"
    assert names(tmp_path) == {LINES, "1.xml", "1.pdf"}


def test_killed_after_its_line_a_certificate_is_there_whole(tmp_path, monkeypatch):
    issue(tmp_path, "1")
    assert killed(tmp_path, monkeypatch, "sync_folder", 2)
    assert "2.xml.part" in names(tmp_path)
    with opened(Register(tmp_path)) as register:
        assert register.file("2.xml") == b"2"
        assert register.damaged_files() == []
    assert names(tmp_path) == {LINES, "1.xml", "1.pdf", "2.xml", "2.pdf"}


def test_a_file_that_was_changed_is_not_handed_out(tmp_path):
    issue(tmp_path, "1")
    (tmp_path / "1.pdf").write_bytes(b"other")
    (tmp_path / "1.xml").unlink()
    with opened(Register(tmp_path)) as register:
        with pytest.raises(Refused, match="the file differs from the issued one"):
            register.file("1.pdf")
        assert len(register.damaged_files()) == 2
        with pytest.raises(Refused, match=r"no file \.\./1\.pdf was issued"):
            register.file("../1.pdf")


def test_what_is_kept_is_kept_once_and_checked(tmp_path):
    with opened(Register(tmp_path)) as register:
        digest = register.keep(b"order")
        assert register.keep(b"order") == digest
        assert register.kept(digest) == b"order"
        (tmp_path / "made-from" / digest).write_bytes(b"another order")
        with pytest.raises(Refused, match="was changed"):
            register.kept(digest)


def test_what_replaces_and_what_revokes_is_known(tmp_path):
    issue(tmp_path, "1", "2")
    with opened(Register(tmp_path)) as register:
        before = {"number": "1", "kind": "amended"}
        register.issue(entry("3", before=before), {"3.xml": b"3"})
        register.append(Entry(REVOKED, "2", "2026-11-23", "A. Example", {"reason": "wrong unit"}))
    with opened(Register(tmp_path)) as register:
        told = {number: (one.state, one.by) for number, one in register.standings.items()}
    assert told == {"1": ("amended", "3"), "2": ("revoked", "wrong unit"), "3": ("issued", "")}


def test_the_same_register_stays_open_for_the_next_certificate(tmp_path):
    known = Register(tmp_path)
    for number in "12":
        with opened(known) as register:
            register.issue(entry(number), {f"{number}.xml": b""})
        issue(tmp_path, f"by-another-{number}")
    with opened(known) as register:
        assert list(register.standings) == ["1", "by-another-1", "2", "by-another-2"]


def test_another_program_is_waited_for_and_then_told_of(tmp_path, monkeypatch):
    monkeypatch.setattr(chain, "WAIT_S", 0.05)
    with (
        opened(Register(tmp_path)),
        pytest.raises(Refused, match="another program has"),
        opened(Register(tmp_path)),
    ):
        pass


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written_is_told(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(Refused, match="cannot be written"), opened(Register(tmp_path / "register")):
        pass


def test_a_line_is_readable_by_people(tmp_path):
    issue(tmp_path, "1")
    told = json.loads((tmp_path / LINES).read_text(encoding="utf-8"))
    assert (told["n"], told["type"], told["number"], told["by"]) == (1, "issued", "1", "A. Example")


forked = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
SEED = 20261122


def program(folder, name, certificates):
    """Let another program issue certificates; return its process."""
    process = os.fork()
    if process:
        return process
    try:
        for n in range(certificates):
            with opened(Register(folder)) as register:
                number = register.number_after(str(k) for k in range(1, 10_000))
                data = {"record": {"head": f"{name}-{n}"}}
                entry = Entry(ISSUED, number, "2026-11-22T12:00:00+00:00", name, data)
                content = f"{name} {n} ".encode() * 2_000
                register.issue(entry, {f"{number}.xml": content, f"{number}.pdf": content[::-1]})
    finally:
        os._exit(0)


def check(folder):
    """Check what stands in a folder of a register; return how many certificates there are."""
    with opened(Register(folder)) as register:
        assert register.damaged_files() == []
        numbers = [int(number) for number in register.standings]
        known = {name for standing in register.standings.values() for name in standing.entry.files}
    assert numbers == list(range(1, len(numbers) + 1))
    assert {path.name for path in folder.iterdir()} == known | {LINES, ".register.lock"}
    return len(numbers)


@pytest.mark.slow
@forked
def test_two_programs_at_once_give_each_number_once(tmp_path):
    for process in [program(tmp_path, name, 8) for name in "ab"]:
        assert os.waitpid(process, 0)[1] == 0
    assert check(tmp_path) == 16
    with opened(Register(tmp_path)) as register:
        assert {standing.entry.by for standing in register.standings.values()} == {"a", "b"}


@pytest.mark.slow
@forked
def test_killed_at_random_moments_a_register_stays_whole(tmp_path):
    moments = random.Random(SEED)  # noqa: S311 - moments, no secrets
    before, killed = 0, 0
    for _ in range(8):
        processes = [program(tmp_path, name, 50) for name in "ab"]
        time.sleep(moments.uniform(0.0, 0.06))
        for process in processes:
            os.kill(process, signal.SIGKILL)
            killed += os.WIFSIGNALED(os.waitpid(process, 0)[1])
        after = check(tmp_path)
        assert after >= before
        before = after
    assert killed > 0


def test_the_shipped_files_are_read():
    laboratory = load_laboratory(shipped_folder(CERTIFICATE) / "laboratory.yaml")
    order = load_order(shipped_folder(CERTIFICATE) / "order.yaml")
    assert laboratory.language == ("en",)
    assert laboratory.register_folder == shipped_folder(CERTIFICATE).absolute() / "register"
    assert laboratory.authorised_person("A. Example").role == "head of the laboratory"
    with pytest.raises(Refused, match="the laboratory file names A"):
        laboratory.authorised_person("Somebody else")
    nobody = laboratory.model_copy(update={"authorised": ()})
    with pytest.raises(Refused, match="names nobody; add persons under 'authorised'"):
        nobody.authorised_person("A. Example")
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
    assert "unit 17 appears twice" in str(error.value)


def test_languages_say_the_same_things():
    assert LANGUAGES == ("de", "en", "uk")
    for key in texts_of("en").entries:
        texts = [texts_of(language).entries[key] for language in LANGUAGES]
        assert len({frozenset(re.findall(r"\{\w+\}", text)) for text in texts}) == 1, key


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


def test_the_day_of_the_order_is_on_the_certificate(issued_certificate):
    """It was read from the order file, and shown nowhere."""
    dated = replace(
        issued_certificate, order=issued_certificate.order.model_copy(update={"date": date(2026, 11, 9)})
    )
    document = document_of(dated)
    rows = [
        row
        for block in data_of(dated, document)["front"]
        if block["kind"] == "pairs"
        for row in block["rows"]
    ]
    assert [["Date of the order", "Datum des Auftrags"], ["2026-11-09"]] in rows
    assert b">2026-11-09</dcc:content>" in document


def test_a_laboratory_may_have_words_of_its_own(tmp_path):
    own = {"language": ["en", "de"], "texts": {"de": {"title": "Prüfschein"}}}
    laboratory = load_laboratory(write_files(tmp_path, own)[0])
    from bench.certificate.gather import texts_for

    english, german = texts_for(laboratory)
    assert (english.say("title"), german.say("title")) == ("Calibration certificate", "Prüfschein")
    assert Path(laboratory.register_).name == "register"


def test_a_laboratory_replaces_no_text_that_limits_a_certificate_and_keeps_the_blanks(tmp_path):
    own = {
        "fail": "pass", "simulated": "real", "unsigned": "signed", "conformity_text": "pass", "title": "{nme}",
        "not_accepted": "accepted", "statement_affected": "-", "page": "{page}/{pages}",
    }  # fmt: skip
    laboratory, _ = write_files(tmp_path, {"texts": {"en": own}})
    with pytest.raises(FileMistakes) as error:
        load_laboratory(laboratory)
    told = str(error.value)
    assert [told.count(f"texts.en.{key}: ") for key in own] == [1, 1, 1, 1, 1, 1, 1, 0]
    assert told.count("no laboratory may replace this text; remove it") == 5
    assert "expected the blanks {limit}, {points}, {statement}; keep the names in braces" in told


def test_spaces_alone_are_no_text_of_an_order(tmp_path):
    unit = {**ORDER["units"][0], "condition": " "}
    with pytest.raises(FileMistakes) as error:
        load_order(write_files(tmp_path, order={"units": [unit], "number": "  "})[1])
    assert str(error.value).count("expected a text that is not empty") == 2
