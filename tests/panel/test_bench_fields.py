"""The fields of a bench file: from its models, written with comments kept, mistakes at their fields."""

import re
from pathlib import Path

import numpy as np
import pytest

from bench.base.arrays import ARCSEC
from bench.base.yaml_files import read_yaml
from bench.config.bench_file.file import load_bench
from bench.config.shipped import CONFIG
from bench.panel.bench_fields import (
    GRAVITY_FORM,
    METERS,
    NEW_INSTALLATION,
    completed,
    groups_of,
    placed,
    values_of,
)
from bench.panel.own_files import shipped_files
from bench.panel.pages.bench import mistakes_in
from bench.panel.round_trip import changed_text, signed, with_comments
from drivers.clock import utc_now

SHIPPED = shipped_files(CONFIG)


def comments(text):
    return [line for line in text.splitlines() if line.lstrip().startswith("#")]


def changed(name, **typed):
    text = SHIPPED[name].read_text("utf-8")
    before = values_of(read_yaml(text).data)
    values = completed(before | typed, before)
    return text, changed_text(text, values, groups_of(values))


@pytest.mark.parametrize("name", sorted(SHIPPED))
def test_a_file_in_which_nothing_is_changed_is_written_as_it_was(name):
    before, after = changed(name)
    assert after == before
    bare = "".join(
        line for line in before.splitlines(True) if line.strip() and not line.lstrip().startswith("#")
    )
    assert with_comments(before, bare) == before


@pytest.mark.parametrize(
    ("name", "typed"),
    [
        ("bench-gpib", {"instruments.chamber.driver": "", "line_frequency": "60 Hz"}),
        ("bench-gpib", {METERS: "1"}),
        ("bench-multiplexer", {METERS: "3", "instruments.voltmeters[1].driver": "agilent-34401a"}),
        ("bench-lan", {"instruments.head.driver": "zaber", "instruments.chamber.driver": "espec"}),
        ("bench-motorised", {"instruments.head.driver": "manual-head", GRAVITY_FORM: "value of gravity"}),
        ("bench-stand", {"instruments.voltmeters[1].serial.parity": "", "unit_under_test.serial": "a: b #c"}),
    ],
)
def test_every_comment_line_is_kept_where_sections_come_and_go(name, typed):
    before, after = changed(name, **typed)
    assert sorted(comments(after)) == sorted(comments(before))
    assert after != before
    data = read_yaml(after).data
    for place, text in typed.items():
        if text and not place.startswith("form:") and "serial.parity" not in place:
            assert values_of(data)[place] == text


def test_a_scanner_takes_the_place_of_three_voltmeters():
    _, after = changed("bench-gpib", **{METERS: "1"})
    mistakes, file = mistakes_in(after, Path("mine.yaml"))
    assert mistakes == ()
    assert [meter.channels for meter in file.instruments.voltmeters] == [("x", "y", "z")]


def test_three_voltmeters_take_the_place_of_a_scanner():
    more = {
        f"instruments.voltmeters[{n}].resource": f"TCPIP0::192.0.2.{n}::5025::SOCKET" for n in (1, 2, 3)
    } | {f"instruments.voltmeters[{n}].interface": "lan" for n in (1, 2, 3)}
    _, after = changed(
        "bench-multiplexer", **{METERS: "3", "instruments.voltmeters[1].driver": "keysight-34461a"}, **more
    )
    mistakes, file = mistakes_in(after, Path("mine.yaml"))
    assert mistakes == ()
    assert [meter.channels for meter in file.instruments.voltmeters] == [("x",), ("y",), ("z",)]


def test_gravity_with_its_source_is_written_with_its_u():
    stated = {"value": "9.8105 m/s^2", "source": "survey", "date": "2026-03-02", "U": "2e-5 m/s^2", "k": "2"}
    _, after = changed(
        "bench-lan",
        **{GRAVITY_FORM: "gravity with its source"},
        **{f"gravity.{key}": text for key, text in stated.items()},
    )
    mistakes, file = mistakes_in(after, Path("mine.yaml"))
    assert mistakes == ()
    assert (file.gravity_m_s2, file.gravity.U, file.gravity.k) == (9.8105, 2e-5, 2.0)
    assert after.index("# Local gravity") < after.index("gravity: {") < after.index("line_frequency")


METER, SECOND = (f"instruments.voltmeters[{n}].certificate" for n in (1, 2))
CERTIFICATE = {"number": "K-17", "laboratory": "Acme", "date": "2026-03-02", "valid_until": "2027-03-01",
               "values[1].range": "10 V", "values[1].gain.U": "10 ppm", "values[1].gain.k": "2"}  # fmt: skip


def test_a_certificate_typed_in_the_form_is_written_and_taken_out_again():
    typed = {f"{METER}.{key}": text for key, text in CERTIFICATE.items()}
    before, after = changed("bench-gpib", **typed)
    mistakes, file = mistakes_in(after, Path("mine.yaml"))
    assert mistakes == ()
    stated = file.instruments.voltmeters[0].certificate
    assert (stated.number, stated.laboratory, str(stated.date), str(stated.valid_until)) == tuple(
        list(CERTIFICATE.values())[:4]
    )
    assert (stated.of_range(10.0).gain.U, stated.of_range(10.0).gain.k) == (pytest.approx(1e-5), 2.0)
    assert [meter.certificate for meter in file.instruments.voltmeters[1:]] == [None, None]
    assert comments(after) == comments(before)
    values = values_of(read_yaml(after).data)
    emptied = values | dict.fromkeys(typed, "")
    assert read_yaml(changed_text(after, emptied, groups_of(emptied))).data == read_yaml(before).data
    less = values | {f"{METER}.valid_until": "", f"{METER}.number": "K-18"}
    assert f"number: {CERTIFICATE['number']}" in after
    assert "valid_until" not in (rest := changed_text(after, less, groups_of(less)))
    assert mistakes_in(rest, Path("mine.yaml"))[1].instruments.voltmeters[0].certificate.number == "K-18"


def test_of_two_ranges_of_a_certificate_the_last_may_be_emptied():
    typed = {f"{METER}.{key}": text for key, text in CERTIFICATE.items()}
    second = {f"{METER}.values[2].range": "100 V", f"{METER}.values[2].offset.U": "1 mV",
              f"{METER}.values[2].offset.k": "2"}  # fmt: skip
    _, one = changed("bench-gpib", **typed)
    _, two = changed("bench-gpib", **typed, **second)
    meter = mistakes_in(two, Path("mine.yaml"))[1].instruments.voltmeters[0]
    assert [value.range for value in meter.certificate.values] == [10.0, 100.0]
    emptied = values_of(read_yaml(two).data) | dict.fromkeys(second, "")
    assert read_yaml(changed_text(two, emptied, groups_of(emptied))).data == read_yaml(one).data


@pytest.mark.parametrize("name", sorted(SHIPPED))
def test_every_value_of_a_shipped_file_has_one_field(name):
    values = values_of(read_yaml(SHIPPED[name].read_text("utf-8")).data)
    fields = [one.name for group in groups_of(values) for one in group.fields]
    assert [place for place in values if place not in fields and "simulation" not in place] == []
    assert len(fields) == len(set(fields))


HEAD, CHAMBER = "instruments.head.certificate", "instruments.chamber.certificate"
PAPER = {"number": "H-1", "laboratory": "Acme", "date": "2026-03-02"}


def rows(place, number, *texts):
    keys = ("angle", "correction", "U", "k") if "head" in place else ("temperature", "correction", "U", "k")
    return {f"{place}.values[{number}].{key}": text for key, text in zip(keys, texts, strict=True)}


def test_the_table_of_a_head_is_typed_row_by_row_and_made_shorter():
    typed = {f"{HEAD}.{key}": text for key, text in PAPER.items()} | {f"form:{HEAD}.values": "9"}
    for number in range(9):
        typed |= rows(HEAD, number + 1, f"{40 * number} deg", f"{number} arcsec", "1 arcsec", "2")
    before, after = changed("bench-gpib", **typed)
    mistakes, file = mistakes_in(after, Path("mine.yaml"))
    assert mistakes == ()
    table = file.instruments.head.certificate.values
    assert [round(row.correction / ARCSEC) for row in table] == list(range(9))
    assert comments(after) == comments(before)
    values = values_of(read_yaml(after).data)
    assert values[f"form:{HEAD}.values"] == "9"
    shorter = values | {f"form:{HEAD}.values": "8"}
    mistakes, _ = mistakes_in(changed_text(after, shorter, groups_of(shorter)), Path("mine.yaml"))
    found = placed(mistakes, groups_of(shorter))
    assert "the table has no angle between 280° and 360°" in found.at[f"form:{HEAD}.values"][0]
    assert found.elsewhere == []


def test_a_mistake_in_a_row_stands_at_its_field_also_below_an_empty_row():
    typed = {f"{CHAMBER}.{key}": text for key, text in PAPER.items()} | {f"form:{CHAMBER}.values": "3"}
    typed |= rows(CHAMBER, 1, "-40 degC", "0.1", "0.05 K", "2")
    typed |= rows(CHAMBER, 3, "60 degC", "0.1 K", "0.05 K", "two")
    before, after = changed("bench-motorised", **typed)
    values = values_of(read_yaml(after).data)
    found = placed(mistakes_in(after, Path("mine.yaml"))[0], groups_of(values))
    assert found.elsewhere == []
    assert {name.removeprefix(f"{CHAMBER}.values") for name in found.at} == {
        "[1].correction", "[2].temperature", "[2].correction", "[2].U", "[2].k", "[3].k"
    }  # fmt: skip
    assert comments(after) == comments(before)
    mended = values | rows(CHAMBER, 2, "23 degC", "0 K", "0.05 K", "2")
    mended |= {f"{CHAMBER}.values[1].correction": "0.1 K", f"{CHAMBER}.values[3].k": "2"}
    mistakes, file = mistakes_in(changed_text(after, mended, groups_of(mended)), Path("mine.yaml"))
    assert mistakes == ()
    assert [row.temperature for row in file.instruments.chamber.certificate.values] == [-40.0, 23.0, 60.0]


def test_installations_are_added_changed_and_taken_out_with_mistakes_at_their_fields():
    label = {NEW_INSTALLATION: "U1"}
    assert "installations.U1" in [group.place for group in groups_of(label)]
    typed = {"installations.U1.axes": "-x, z,y", "installations.U1.turned": "30 deg",
             "installations.V.turned": "60 deg"}  # fmt: skip
    before, after = changed("bench-stand", **label, **typed)
    mistakes, file = mistakes_in(after, Path("mine.yaml"))
    assert mistakes == ()
    assert file.installations["U1"].axes == ("-x", "z", "y")
    assert file.installations["V"].turned == pytest.approx(np.radians(60.0))
    assert comments(after) == comments(before)
    values = values_of(read_yaml(after).data)
    emptied = values | dict.fromkeys([name for name in values if name.startswith("installations.U1.")], "")
    again = changed_text(after, emptied, groups_of(emptied))
    assert again == before.replace("turned: 45 deg", "turned: 60 deg")
    wrong = {
        "installations.U1.axes": "x, y, -z",
        "installations.V.turned": "45",
        "installations.U-2.axes": "x",
    }
    _, after = changed("bench-stand", **wrong)
    values = values_of(read_yaml(after).data)
    found = placed(mistakes_in(after, Path("mine.yaml"))[0], groups_of(values))
    assert found.elsewhere == []
    assert found.at.keys() == {*wrong, "installations.U-2"}
    assert completed(label | typed, {})[NEW_INSTALLATION] == ""  # it is one of the installations now


SUPPLY = "unit_under_test.supply"


def test_a_supply_is_stated_with_its_rails_and_goes_with_its_instrument():
    stand = values_of(read_yaml(SHIPPED["bench-stand"].read_text("utf-8")).data)
    typed = {
        name: text for name, text in stand.items()
        if name.removeprefix("form:").startswith(("instruments.power_supply.", "instruments.level.", SUPPLY))
    }  # fmt: skip
    before, after = changed("bench-lan", **typed)
    mistakes, file = mistakes_in(after, Path("mine.yaml"))
    assert mistakes == ()
    assert file.unit_under_test.supply == load_bench(SHIPPED["bench-stand"]).unit_under_test.supply
    assert file.instruments.level is not None
    values = values_of(read_yaml(after).data)
    without = values | {"instruments.power_supply.driver": "", "instruments.level.driver": ""}
    assert changed_text(after, without, groups_of(without)) == before
    wrong = {
        f"{SUPPLY}.rails[1].output": "7",
        f"{SUPPLY}.rails[2].limits.maximum": "18",
        f"{SUPPLY}.pause": "",
    }
    _, after = changed("bench-lan", **typed | wrong | {f"{SUPPLY}.when_unsafe": ""})
    values = values_of(read_yaml(after).data)
    found = placed(mistakes_in(after, Path("mine.yaml"))[0], groups_of(values))
    assert found.elsewhere == []
    assert found.at.keys() == {*list(wrong)[:2], f"{SUPPLY}.when_unsafe"}


def test_a_warm_up_that_is_a_criterion_has_its_fields():
    text = SHIPPED["bench-stand"].read_text("utf-8")
    text = text.replace("warm_up: 30 min", "warm_up: {drift: 1 mV, per: 10 min, timeout: 2 h}")
    values = values_of(read_yaml(text).data) | {f"{SUPPLY}.warm_up.drift": "2 mV"}
    _, file = mistakes_in(changed_text(text, values, groups_of(values)), Path("mine.yaml"))
    assert (file.unit_under_test.supply.warm_up.drift, file.unit_under_test.supply.warm_up.per) == (
        2e-3,
        600.0,
    )


def test_the_table_of_a_head_stays_where_its_certificate_is_renewed():
    table = ", ".join(
        f"{{angle: {a} deg, correction: 1 arcsec, U: 1 arcsec, k: 2}}" for a in range(0, 360, 45)
    )
    text = SHIPPED["bench-gpib"].read_text("utf-8").replace(
        "enter_accepts_target: no}", "enter_accepts_target: no,\n    certificate: {number: H-1, laboratory: Acme, "
        f"date: 2025-03-02, values: [{table}]}}}}")  # fmt: skip
    values = values_of(read_yaml(text).data)
    assert "instruments.head.certificate.number" in {f.name for g in groups_of(values) for f in g.fields}
    values |= {
        "instruments.head.certificate.number": "H-2",
        "instruments.head.certificate.date": "2026-03-02",
    }
    mistakes, file = mistakes_in(changed_text(text, values, groups_of(values)), Path("mine.yaml"))
    assert mistakes == ()
    assert file.instruments.head.certificate.number == "H-2"
    assert len(file.instruments.head.certificate.values) == 8


def test_stand_errors_are_changed_with_their_comments_and_optional_ones_come_and_go():
    before, after = changed("bench-gpib", **{
        "stand.axis_tilt.limit": "6 arcsec", "stand.setting_error.distribution": "normal",
        "stand.setting_error.k": "3", "stand.mounting_roll.limit": "", "stand.mounting_roll.distribution": "",
        "stand.foundation.limit": "2 arcsec", "stand.foundation.distribution": "rectangular"})  # fmt: skip
    mistakes, file = mistakes_in(after, Path("mine.yaml"))
    assert mistakes == ()
    assert file.stand.axis_tilt.limit == pytest.approx(6 * ARCSEC)
    assert (file.stand.setting_error.distribution, file.stand.setting_error.k) == ("normal", 3.0)
    assert file.stand.mounting_roll is None
    assert file.stand.foundation.limit == pytest.approx(2 * ARCSEC)
    assert sorted(comments(after)) == sorted(comments(before))
    assert "# shaft against the level" in after


def test_mistakes_in_certificates_and_stand_errors_stand_at_their_fields():
    wrong = {f"{METER}.number": "K-17", f"{METER}.date": "2026-02-30", "stand.zero_offset.limit": "5",
             "stand.axis_tilt.distribution": "normal", f"{SECOND}.values[1].range": "10 V",
             "instruments.voltmeters[3].certificate.number": "K-19"}  # fmt: skip
    _, after = changed("bench-gpib", **wrong)
    values = values_of(read_yaml(after).data)
    found = placed(mistakes_in(after, Path("mine.yaml"))[0], groups_of(values))
    assert found.elsewhere == []
    assert "'laboratory' is missing" in found.at[f"{METER}.laboratory"]
    assert "there is no day 2026-02-30" in found.at[f"{METER}.date"][0]
    assert "'values' is missing" in found.at["instruments.voltmeters[3].certificate.values[1].range"]
    assert "'number' is missing" in found.at[f"{SECOND}.number"]
    assert "without a unit" in found.at["stand.zero_offset.limit"][0]
    assert "add 'k'" in found.at["stand.axis_tilt.k"][0]
    fields = {one.name for group in groups_of(values) for one in group.fields}
    assert set(found.at) <= fields


def test_the_comment_of_who_changed_it_stands_once():
    once = signed("name: a\n", "anna", utc_now())
    assert re.fullmatch(r"# changed in the panel by anna on \d{4}-\d\d-\d\d\nname: a\n", once)
    assert signed(once, "bert", utc_now()).count("# changed in the panel") == 1


def test_mistakes_stand_at_their_fields():
    _, after = changed("bench-lan", **{"instruments.voltmeters[2].resource": "", "unit_under_test.range": "10",
                                       "instruments.voltmeters[3].channels": "y"})  # fmt: skip
    mistakes, _ = mistakes_in(after, Path("mine.yaml"))
    values = values_of(read_yaml(after).data)
    found = placed(mistakes, groups_of(values))
    assert "'resource' is missing" in found.at["instruments.voltmeters[2].resource"]
    assert "without a unit" in found.at["unit_under_test.range"][0]
    assert "carried by voltmeter 2 already" in found.at["instruments.voltmeters[3].channels"][0]
    assert "no voltmeter reads channel z" in found.at["instruments.voltmeters"][0]
    assert found.elsewhere == []
