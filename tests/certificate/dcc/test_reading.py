"""The way back: coefficients out of our certificates and others', instruments' certificates for bench files."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from bench.certificate.dcc.document import document_of
from bench.certificate.dcc.nodes import VOLT_PER_MS2, product, read_unit
from bench.config.bench_file.file import load_bench
from bench.config.devices.device import HeadCertificate, VoltmeterCertificate
from bench.config.shipped import find_bench
from bench.model.geometry import COEFFICIENTS
from bench.services.coefficients import coefficients_of
from tests.support.commands import refused
from tests.support.schemas import keeps_to

HEAD = """<dcc:digitalCalibrationCertificate xmlns:dcc="https://ptb.de/dcc" xmlns:si="https://ptb.de/si"
 schemaVersion="3.2.1"><dcc:administrativeData><dcc:dccSoftware><dcc:software><dcc:name><dcc:content>editor</dcc:content>
 </dcc:name><dcc:release>1</dcc:release></dcc:software></dcc:dccSoftware><dcc:coreData>
 <dcc:countryCodeISO3166_1>DE</dcc:countryCodeISO3166_1><dcc:usedLangCodeISO639_1>en</dcc:usedLangCodeISO639_1>
 <dcc:mandatoryLangCodeISO639_1>en</dcc:mandatoryLangCodeISO639_1><dcc:uniqueIdentifier>H-88</dcc:uniqueIdentifier>
 <dcc:beginPerformanceDate>2025-11-19</dcc:beginPerformanceDate><dcc:endPerformanceDate>2025-11-20</dcc:endPerformanceDate>
 <dcc:performanceLocation>laboratory</dcc:performanceLocation></dcc:coreData><dcc:items><dcc:item>
 <dcc:name><dcc:content>block</dcc:content></dcc:name><dcc:identifications><dcc:identification>
 <dcc:issuer>manufacturer</dcc:issuer><dcc:value>S-7</dcc:value></dcc:identification></dcc:identifications>
 </dcc:item></dcc:items><dcc:calibrationLaboratory><dcc:contact><dcc:name><dcc:content>Angle
 Laboratory</dcc:content></dcc:name><dcc:location><dcc:city>X</dcc:city></dcc:location></dcc:contact>
 </dcc:calibrationLaboratory><dcc:respPersons><dcc:respPerson><dcc:person><dcc:name><dcc:content>A</dcc:content></dcc:name>
 </dcc:person></dcc:respPerson></dcc:respPersons><dcc:customer><dcc:name><dcc:content>C</dcc:content></dcc:name>
 <dcc:location><dcc:city>Y</dcc:city></dcc:location></dcc:customer></dcc:administrativeData><dcc:measurementResults>
 <dcc:measurementResult><dcc:name><dcc:content>results</dcc:content></dcc:name><dcc:results><dcc:result>
 <dcc:name><dcc:content>errors</dcc:content></dcc:name><dcc:data>{}</dcc:data></dcc:result></dcc:results>
 </dcc:measurementResult></dcc:measurementResults></dcc:digitalCalibrationCertificate>"""
"""A certificate by another author. With the tables below, it is valid against PTB's dcc.xsd 3.2.1."""

NAMES = list(COEFFICIENTS)
VALUES = [-2.1, 0.01, 0.02, 0.03, -2.2, 0.04, 0.05, 0.06, -2.3, 0.07, -0.19, -0.41]


@pytest.fixture
def ours(empty_folder, issued_certificate):
    Path("ours.xml").write_bytes(document_of(issued_certificate))
    return "ours.xml"


def real_list(labels=NAMES, values=VALUES, k_unit=r"\volt", extra="", u="2e-4"):
    units = " ".join([k_unit] * 9 + [r"\volt"] * 3)
    uncertain = (
        "<si:measurementUncertaintyUnivariateXMLList><si:expandedMUXMLList><si:valueExpandedMUXMLList>"
        f"{' '.join([u] * 12)}</si:valueExpandedMUXMLList><si:coverageFactorXMLList>{' '.join(['2'] * 12)}"
        f"</si:coverageFactorXMLList><si:coverageProbabilityXMLList>{' '.join(['0.95'] * 12)}"
        "</si:coverageProbabilityXMLList></si:expandedMUXMLList></si:measurementUncertaintyUnivariateXMLList>"
    )
    return (
        f"<dcc:quantity><si:realListXMLList><si:labelXMLList>{' '.join(labels)}</si:labelXMLList><si:valueXMLList>"
        f"{' '.join(map(repr, values))}</si:valueXMLList><si:unitXMLList>{units}</si:unitXMLList>"
        f"{uncertain if u else ''}{extra}</si:realListXMLList></dcc:quantity>"
    )


def test_coefficients_of_ours_come_back_whole(bench, ours, issued_certificate):
    status, _, err = bench("certificate", "read", ours, "--out", "coefficients.json")
    assert status == 0
    assert "has no signature" in err
    data = json.loads(Path("coefficients.json").read_text())
    keeps_to("calibrate", data)
    taken = coefficients_of(data, "it")
    own = issued_certificate.found.result.calibration
    assert np.array_equal(taken.block.vector, own.block.vector)
    assert np.array_equal(taken.covariance, own.covariance)
    assert np.array_equal(taken.same_meters, own.covariance_same_meters)
    assert data["certificate"]["number"] == "SIM-2026-0001"
    assert taken.simulated


def test_beside_a_damaged_register_it_is_read_with_a_note(bench, ours):
    Path("register.jsonl").write_text("no line\n", encoding="utf-8")
    status, _, err = bench("certificate", "read", ours, "--out", "coefficients.json")
    assert status == 0
    assert "not known to be valid: " in err
    assert "not a line of a register" in err


def test_ours_with_another_value_in_its_list_is_refused(bench, ours, issued_certificate):
    text = Path(ours).read_text(encoding="utf-8")
    value = repr(issued_certificate.found.coefficients["Kxx"].value)
    Path(ours).write_text(text.replace(value, value.replace("2", "3", 1), 1), encoding="utf-8")
    refused(
        bench("certificate", "read", ours, "--out", "coefficients.json"),
        "state different coefficients",
    )
    assert not Path("coefficients.json").exists()


@pytest.mark.parametrize("unit", [r"\milli\foo", r"\milli", "mV"])
def test_an_unknown_unit_is_shown_as_the_document_has_it(unit):
    with pytest.raises(ValueError, match=f"^'{re.escape(unit)}'"):
        read_unit(unit)


@pytest.mark.parametrize(
    ("unit", "scale"), [(r"\volt", 1.0), (r"\milli\volt\per\metre\second\tothe{2}", 9.81e-3)]
)
def test_coefficients_of_anothers_list_are_taken_by_their_names(bench, empty_folder, unit, scale):
    order = np.random.default_rng(20261122).permutation(12)
    scattered = sorted(range(12), key=lambda i: (i >= 9, order[i]))
    named = [NAMES[i].replace("K", "K_") for i in scattered]
    Path("x.xml").write_text(HEAD.format(real_list(named, [VALUES[i] for i in scattered], unit)))
    refused(bench("certificate", "read", "x.xml", "--out", "c.json"), "give --g", "--noise")
    status, out, err = bench(
        "certificate", "read", "x.xml", "--out", "c.json", "--g", 9.81, "--noise", "50 uV"
    )
    assert (status, "assumed uncorrelated" in err) == (0, True)
    assert ("taken as per local g of its laboratory, 9.81 m/s²" in err) == (scale == 1.0)
    assert "local g (9.81 m/s², +1 g on an upward axis), U in V, block at an unknown temperature" in out
    assert any(
        "no K2 and K3" in note for note in json.loads(Path("c.json").read_text(encoding="utf-8"))["notes"]
    )
    taken = coefficients_of(json.loads(Path("c.json").read_text()), "it")
    scales = np.array([scale] * 9 + [1.0] * 3)
    assert np.allclose(taken.block.vector, np.array(VALUES) * scales, rtol=1e-14)
    assert np.allclose(taken.covariance, np.diag((1e-4 * scales) ** 2), rtol=1e-14)
    assert taken.noise == pytest.approx(5e-5)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (real_list([*NAMES[:11], "U0"]), "no list of the twelve"),
        (real_list() * 2, "more than one list"),
        (real_list(u=""), "states no uncertainty"),
        (real_list(k_unit=r"\ampere"), "ask the laboratory for K in"),
        (real_list(k_unit=r"\furlong"), "furlong is unknown"),
        (real_list(values=VALUES[:11]), "11 values, but 12 units"),
        (real_list().replace("0.07", "seven"), "'seven' is not a number"),
        (real_list().replace("-2.1 ", "NaN "), "not a number"),
    ],
)
def test_what_cannot_be_read_is_refused(bench, empty_folder, content, told):
    Path("x.xml").write_text(HEAD.format(content))
    refused(bench("certificate", "read", "x.xml", "--out", "c.json", "--g", 9.81, "--noise", "50 uV"), told)


@pytest.mark.parametrize("content", ["", "<a/>", "<!DOCTYPE a [<!ENTITY b 'c'>]><a>&b;</a>", "\x00"])
def test_what_is_no_certificate_is_refused(bench, empty_folder, content):
    Path("x.xml").write_text(content)
    err = refused(bench("certificate", "read", "x.xml", "--out", "c.json"))
    assert err.startswith("bench: x.xml: not ")


def column(role, values, unit, u=None):
    uncertain = (
        ""
        if u is None
        else re.sub(r"^.*?(<si:measurement.*Univariate\w+>).*$", r"\1", real_list(u=u).replace("\n", ""))
    )
    count = len(values)
    uncertain = re.sub(r">([^<> ]+)( \1)+<", lambda m: f">{' '.join([m[1]] * count)}<", uncertain)
    return (
        f'<dcc:quantity refType="{role}"><dcc:name><dcc:content>c</dcc:content></dcc:name>'
        f"<si:realListXMLList><si:valueXMLList>{' '.join(map(str, values))}"
        f"</si:valueXMLList><si:unitXMLList>{unit}</si:unitXMLList>{uncertain}</si:realListXMLList></dcc:quantity>"
    )


def test_a_heads_certificate_is_printed_for_the_bench_file(bench, empty_folder):
    angles = [0, 45, 90, 135, 180, 225, 270, 315]
    errors = [0.0, 2.4, 3.1, 1.9, -0.2, -2.2, -3.0, -2.1]
    table = column("basic_nominalValue", angles, r"\degree") + column(
        "basic_measurementError", errors, r"\arcsecond", "1.0"
    )
    Path("x.xml").write_text(HEAD.format(f"<dcc:list>{table}</dcc:list>"))
    status, out, err = bench("certificate", "read", "x.xml")
    assert status == 0
    section = yaml.safe_load(out)["certificate"]
    section["date"] = str(section["date"])
    head = HeadCertificate.model_validate({**section})
    assert (head.number, head.laboratory, head.serial) == ("H-88", "Angle Laboratory", "S-7")
    corrections = np.degrees([value.correction for value in head.values]) * 3600
    assert np.allclose(corrections, -np.array(errors), atol=1e-8)
    assert [value.U for value in head.values] == pytest.approx([np.radians(1 / 3600)] * 8, rel=1e-5)
    assert "a bench file cannot use" not in err


def test_a_heads_certificate_is_accepted_into_a_bench_file_once(bench, empty_folder, monkeypatch):
    monkeypatch.delenv("BENCH_LABORATORY", raising=False)
    angles = [0, 45, 90, 135, 180, 225, 270, 315]
    table = column("basic_nominalValue", angles, r"\degree") + column(
        "basic_measurementError", [0.0, 2.4, 3.1, 1.9, -0.2, -2.2, -3.0, -2.1], r"\arcsecond", "1.0"
    )
    Path("x.xml").write_text(HEAD.format(f"<dcc:list>{table}</dcc:list>"))
    Path("my.yaml").write_bytes(find_bench("bench-lan").read_bytes())
    call = ("certificate", "read", "x.xml", "--into", "my.yaml")
    refused(bench(*call, "--instrument", "head"), "--by NAME")
    refused(bench(*call, "--instrument", "haed", "--by", "A. Example"), "lists no instrument haed")
    assert load_bench(Path("my.yaml")).instruments.head.certificate is None
    status, out, _ = bench(*call, "--instrument", "head", "--by", "A. Example")
    assert (status, "number: H-88" in out) == (0, True)
    held = load_bench(Path("my.yaml")).instruments.head.certificate
    assert (held.number, len(held.values)) == ("H-88", 8)
    text = Path("my.yaml").read_text()
    assert text.startswith("# certificate of head accepted by A. Example on ")
    assert text.count("#") == find_bench("bench-lan").read_text().count("#") + 1
    refused(bench(*call, "--instrument", "head", "--by", "A. Example"), "was accepted already")


RANGES = column("dmm_range", [1, 1, 1, 10, 10, 10, 10, 10], r"\volt")
POINTS = [-1.0, 0.0, 1.0, -10.0, -5.0, 0.0, 5.0, 10.0]


def meter(errors_uv, U_uv="4", ranges=RANGES):
    """A voltmeter's table: errors at eight voltages on two ranges."""
    errors = column("basic_measurementError", errors_uv, r"\micro\volt", U_uv)
    at = column("basic_referenceValue", POINTS, r"\volt")
    return HEAD.format(f"<dcc:list>{ranges}{at}{errors}</dcc:list>")


def test_a_voltmeters_certificate_gives_gain_and_offset_of_each_range(bench, empty_folder):
    """Errors of 7 µV + 3 ppm and 20 µV - 12 ppm, the last one 6 µV off that line."""
    lines = [7 + 3 * x if i < 3 else 20 - 12 * x for i, x in enumerate(POINTS)]
    Path("x.xml").write_text(meter([*lines[:7], lines[7] + 6.0]))
    Path("my.yaml").write_bytes(find_bench("paper-stand").read_bytes())
    call = (
        "certificate",
        "read",
        "x.xml",
        "--into",
        "my.yaml",
        "--instrument",
        "voltmeter.y",
        "--by",
        "A. Example",
    )
    assert bench(*call)[0] == 0
    held = load_bench(Path("my.yaml")).instruments.voltmeters[1].certificate
    one, ten = held.values
    assert (one.range, one.gain.correction, one.offset.correction) == pytest.approx((1.0, -3e-6, -7e-6))
    assert pytest.approx((4e-6, 4e-6)) == (one.gain.U, one.offset.U)
    # by hand: slope and intercept of least squares gain 6 * 10/250 and 6/5; deviations 6 * (-0.2, 0, 0.2..., 0.4)
    assert ten.gain.correction == pytest.approx(12e-6 - 6e-6 * 10 / 250)
    assert ten.offset.correction == pytest.approx(-20e-6 - 6e-6 / 5)
    worst = 6e-6 * (1 - 1 / 5 - 100 / 250)
    assert pytest.approx(2 * np.hypot(2e-6, worst), rel=1e-5) == ten.offset.U
    assert pytest.approx(2 * np.hypot(2e-6 / 5, worst / 10), rel=1e-5) == ten.gain.U


def test_corrections_of_a_voltmeter_undo_its_errors(bench, empty_folder):
    """Random errors on a line (seed 5): a corrected reading is the reference, but for 10 V (5e-5)²."""
    rng = np.random.default_rng(5)
    gain, offset = rng.uniform(-50e-6, 50e-6, 2), rng.uniform(-50e-6, 50e-6, 2)
    which = np.array([0] * 3 + [1] * 5)
    errors = gain[which] * POINTS + offset[which]
    Path("x.xml").write_text(meter((1e6 * errors).tolist()))
    status, out, _ = bench("certificate", "read", "x.xml")
    assert status == 0
    section = yaml.safe_load(out)["certificate"]
    found = VoltmeterCertificate.model_validate({**section, "date": str(section["date"])}).values
    for at, error, one in zip(POINTS, errors, which, strict=True):
        reading = at + error
        corrected = reading * (1 + found[one].gain.correction) + found[one].offset.correction
        assert corrected == pytest.approx(at, abs=3e-8)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (meter([0.0] * 8, ranges=""), "no column states the range"),
        (meter([0.0] * 8, U_uv=None), "without an uncertainty"),
        (meter([0.0] * 8, ranges=RANGES + column("x", [50] * 8, r"\hertz")), "errors of another kind"),
        (meter([2e5] * 8), "zero correction within 1 %"),
    ],
)
def test_what_a_voltmeters_certificate_lacks_is_said(bench, empty_folder, content, told):
    Path("x.xml").write_text(content)
    status, _, err = bench("certificate", "read", "x.xml")
    assert (status, told in err) == (0, True)


def test_a_table_in_percent_is_none_of_angles(bench, empty_folder):
    """PTB's example of a hygrometer states errors in percent: no dimension, but no angles."""
    table = column("basic_measuredValue", [20, 50], r"\percent") + column(
        "basic_measurementError", [1.0, 2.0], r"\percent", "1.0"
    )
    Path("x.xml").write_text(HEAD.format(f"<dcc:list>{table}</dcc:list>"))
    status, out, err = bench("certificate", "read", "x.xml")
    assert (status, "values" in out, "errors of another kind" in err) == (0, False, True)


def thermometer(at, unit, errors):
    errors = column("basic_measurementError", errors, r"\kelvin", "0.06")
    return f"<dcc:list>{column('basic_measuredValue', at, unit)}{errors}</dcc:list>"


def test_temperatures_in_kelvin_become_degrees_celsius(bench, empty_folder):
    """Values of PTB's good practice example GP_DCC_temperature_typical: 306.32 K is 33.17 °C."""
    for at, unit in (([306.32, 373.21], r"\kelvin"), ([33.17, 100.06], r"\degreecelsius")):
        Path("x.xml").write_text(HEAD.format(thermometer(at, unit, [0.072, 0.089])))
        _, out, _ = bench("certificate", "read", "x.xml")
        values = yaml.safe_load(out)["certificate"]["values"]
        assert [one["temperature"] for one in values] == ["33.17 degC", "100.06 degC"]
        assert [one["correction"] for one in values] == ["-0.072 K", "-0.089 K"]


def test_of_two_tables_of_one_kind_none_is_taken(bench, empty_folder):
    """A certificate with the errors before and after an adjustment: only a person knows which ones hold."""
    both = thermometer([20], r"\degreecelsius", [0.4]) + thermometer([21], r"\degreecelsius", [0.1])
    Path("x.xml").write_text(HEAD.format(both))
    status, out, err = bench("certificate", "read", "x.xml")
    assert (status, "values" in out, "more than one table" in err) == (0, False, True)


def test_what_a_bench_file_would_not_take_is_said(bench, empty_folder):
    table = column("basic_nominalValue", [0, 90], r"\degree") + column(
        "basic_measurementError", [0.0, 2.4], r"\arcsecond", "1.0"
    )
    Path("x.xml").write_text(HEAD.format(f"<dcc:list>{table}</dcc:list>"))
    status, _, err = bench("certificate", "read", "x.xml")
    assert (status, "the table has no angle between" in err) == (0, True)
    Path("x.xml").write_text(HEAD.format("<dcc:text/>"))
    status, out, err = bench("certificate", "read", "x.xml")
    assert (status, "number: H-88" in out, "by hand" in err) == (0, True, True)


@pytest.mark.parametrize(
    ("text", "factor", "dimension"),
    [
        (r"\volt", 1.0, {"V": 1}),
        (r"\milli\volt", 1e-3, {"V": 1}),
        (r"\volt\metre\tothe{-1}\second\tothe{2}", 1.0, {"V": 1, "m": -1, "s": 2}),
        (r"\volt\per\metre\second\tothe{2}", 1.0, {"V": 1, "m": -1, "s": 2}),
        (r"\micro\volt\tothe{2}", 1e-12, {"V": 2}),
        (r"\one", 1.0, {}),
        (r"\degree", 0.017453292519943295, {}),
        (r"\kilo\metre\per\hour", 1000 / 3600, {"m": 1, "s": -1}),
    ],
)
def test_units_are_read(text, factor, dimension):
    size, powers = read_unit(text)
    assert size == pytest.approx(factor, rel=1e-15)
    assert powers == dimension


@pytest.mark.parametrize(
    "text", ["V", "", r"\volt V", r"\vold", r"\milli", r"\tothe{2}", r"\volt\per", r"\volt\tothe"]
)
def test_what_is_no_unit_is_refused(text):
    with pytest.raises(ValueError, match="unit"):
        read_unit(text)


def test_products_have_the_dimension_of_both():
    assert read_unit(product(VOLT_PER_MS2, r"\volt")) == (1.0, {"V": 2, "m": -1, "s": 2})
    assert read_unit(product(VOLT_PER_MS2, VOLT_PER_MS2)) == (1.0, {"V": 2, "m": -2, "s": 4})
    assert product(r"\one", r"\one") == r"\one"
    assert product(r"\one", r"\volt") == r"\volt"
