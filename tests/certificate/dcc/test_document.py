"""The document says what the certificate says: values, covariance, statements, files."""

import base64
import json
from dataclasses import replace

import numpy as np
import pytest
from lxml import etree
from scipy import stats

from bench.calibration.budget.whole import dof_through
from bench.calibration.intrinsic import joint_factor
from bench.certificate import proof
from bench.certificate.content import Before
from bench.certificate.dcc.document import document_of
from bench.certificate.dcc.nodes import NAMESPACES
from bench.certificate.dcc.rules import broken_rules
from bench.certificate.gather import missing
from bench.certificate.laboratory import Accreditation
from bench.certificate.proof import Writer
from bench.config.devices.device import Certificate as Held
from bench.services.calibration import verification_of
from bench.services.verification import VerdictOptions
from tests.support.certificates import ORDER
from tests.support.results import calibration_json


@pytest.fixture(scope="module")
def document(issued_certificate):
    return document_of(issued_certificate)


@pytest.fixture(scope="module")
def root(document):
    return etree.fromstring(document)


def of_result(root, ref, path):
    return root.findtext(f".//dcc:result[@refType='bench_{ref}']//{path}", namespaces=NAMESPACES)


def floats(text):
    return [float(word) for word in text.split()]


def covariance_of(root, ref):
    columns = root.findall(
        f".//dcc:result[@refType='bench_{ref}']//si:covarianceXMLList/si:valueXMLList", NAMESPACES
    )
    return np.array([floats(column.text) for column in columns]).T


def test_it_keeps_to_all_rules(document):
    assert broken_rules(document) == ()


def test_the_same_certificate_is_the_same_bytes(document, issued_certificate):
    assert document_of(issued_certificate) == document


def test_coefficients_and_their_covariance_come_back_to_the_bit(root, issued_certificate):
    found = issued_certificate.found
    for ref, values in (("coefficients", found.coefficients), ("inverse", found.inverse)):
        assert of_result(root, ref, "si:labelXMLList").split() == [one.name for one in values.values]
        assert floats(of_result(root, ref, "si:valueXMLList")) == [one.value for one in values.values]
        assert np.array_equal(covariance_of(root, ref), values.covariance)
        U = floats(of_result(root, ref, "si:valueExpandedMUXMLList"))
        assert [one.U for one in values.values] == U


@pytest.mark.parametrize(
    ("ref", "says"),
    [
        ("coefficients", "in local g, +1 on an axis that points up. K is per local g"),
        ("coefficients_si", "for a in m/s²"),
        ("inverse", "a = N (U − U₀) in local g"),
        ("misalignments", "K_ij = −K_ii α_ji for ij = xz, yx, zy"),
        ("intrinsic", "the bias of a is −b"),
    ],
)
def test_each_list_of_numbers_is_defined(root, issued_certificate, ref, says):
    """K in volts alone does not show that it is per local g; nor does the pdf show the sign of an angle."""
    assert says in of_result(root, ref, "dcc:description/dcc:content")
    blocks = proof.pages(Writer(issued_certificate), [])
    words = " ".join(" ".join(block["words"]) for block in blocks if block["kind"] == "words")
    assert says in words or ref.startswith("coefficients")


def test_every_entry_of_the_covariance_has_its_unit(root):
    columns = root.findall(
        ".//dcc:result[@refType='bench_coefficients_si']//si:covarianceXMLList/si:unitXMLList", NAMESPACES
    )
    units = [column.text.split() for column in columns]
    assert [len(column) for column in units] == [12] * 12
    assert units[0][0] == r"\volt\tothe{2}\metre\tothe{-2}\second\tothe{4}"
    assert units[11][11] == r"\volt\tothe{2}"
    assert units[0][11] == r"\volt\tothe{2}\metre\tothe{-1}\second\tothe{2}"


def test_per_metre_and_second_squared_holds_the_uncertainty_of_gravity(root, issued_certificate):
    own = issued_certificate.found.result.calibration
    values = floats(of_result(root, "coefficients_si", "si:valueXMLList"))
    assert np.allclose(values[:9], own.block.vector[:9] / own.g_m_s2, rtol=1e-15)
    stated = calibration_json(own)["coefficients_per_ms2"]
    u = np.sqrt(np.diag(covariance_of(root, "coefficients_si")))
    assert u[:9] == pytest.approx([stated[name]["u"] for name in list(stated)[1:]], rel=1e-12)


def test_the_ellipsoid_of_twelve_holds_what_it_says():
    draws = np.random.default_rng(20261122).normal(size=(200_000, 12))
    k = joint_factor(12, level=0.9545).k
    held = np.mean(np.sum(draws**2, axis=1) <= k * k)
    assert held == pytest.approx(0.9545, abs=4 * np.sqrt(0.9545 * 0.0455 / 200_000))


@pytest.mark.parametrize("ref", ["coefficients", "coefficients_si", "inverse", "misalignments", "intrinsic"])
def test_the_factor_of_an_ellipsoid_allows_for_few_degrees_of_freedom(root, issued_certificate, ref):
    coverage, nu = issued_certificate.coverage, floats(of_result(root, ref, "dcc:metaData//si:valueXMLList"))
    count = len(of_result(root, ref, "si:labelXMLList").split())
    k = np.sqrt(count * stats.f.ppf(coverage, count, min(nu)))
    stated = float(of_result(root, ref, "si:ellipsoidalRegionMUXMLList/si:coverageFactorXMLList"))
    assert stated == pytest.approx(k, rel=1e-9)
    assert stated > joint_factor(count, level=coverage).k


def test_each_verification_point_has_its_statement(root, issued_certificate):
    verification = issued_certificate.found.verification
    delta = ".//dcc:result[@refType='bench_delta_g']//dcc:quantity[@refType='bench_delta_g']"
    values = floats(root.findtext(f"{delta}//si:valueXMLList", namespaces=NAMESPACES))
    assert values == [point.delta_g for point in verification.points]
    said = root.findtext(f"{delta}//dcc:conformityXMLList", namespaces=NAMESPACES).split()
    assert len(said) == len(values)
    whole = root.findtext(
        ".//dcc:metaData[@refType='bench_conformity']/dcc:conformity", namespaces=NAMESPACES
    )
    assert whole == ("pass" if verification.statement == "pass" else whole)


def test_readings_are_there_as_data(root, issued_certificate):
    readings = issued_certificate.found.result.source.as_read
    path = "dcc:quantity[@refType='bench_{}']//si:valueXMLList"
    for i, axis in enumerate("xyz"):
        assert floats(of_result(root, "readings", path.format(f"u{axis}"))) == readings.signal[:, i].tolist()
    assert of_result(root, "readings", "dcc:charsXMLList").split() == readings.installation.tolist()


def test_the_files_of_the_certificate_are_in_it(root, issued_certificate):
    files = {
        one.findtext("dcc:fileName", namespaces=NAMESPACES): base64.b64decode(
            one.findtext("dcc:dataBase64", namespaces=NAMESPACES)
        )
        for one in root.iter(f"{{{NAMESPACES['dcc']}}}byteData")
    }
    given = {one.name: one.content for one in issued_certificate.attachments}
    assert files == {name: given[name] for name in ("seal.json", "result.json")}


def test_it_says_whether_it_is_signed_and_what_is_not_the_laboratorys_own(root, issued_certificate):
    bare = replace(issued_certificate, issue=replace(issued_certificate.issue, signed_by=""))
    unsigned = document_of(bare)
    assert broken_rules(unsigned) == ()
    for document, states in ((root, "signed"), (etree.fromstring(unsigned), "unsigned")):
        said = {one.get("refType") for one in document.iter(f"{{{NAMESPACES['dcc']}}}statement")}
        assert said & {"bench_signed", "bench_unsigned"} == {f"bench_{states}"}
        assert {"bench_statement_item", "bench_sampling", "bench_external", "bench_supplied"} <= said


def test_all_results_have_the_degrees_of_freedom_of_one_source(root, issued_certificate):
    own = issued_certificate.found.result.calibration
    assert np.array_equal(dof_through(own, np.eye(12)), own.dof)
    for ref in ("coefficients", "coefficients_si", "inverse", "misalignments"):
        path = f".//dcc:result[@refType='bench_{ref}']//dcc:metaData[@refType='bench_dof']//si:valueXMLList"
        dof = floats(root.findtext(path, namespaces=NAMESPACES))
        assert np.all((np.array(dof) >= own.noise.reading_dof) & np.isfinite(dof))
        if ref != "misalignments":
            assert dof[-3:] == own.dof[-3:].tolist()  # of U0, in each of them


def test_the_temperature_of_the_block_has_its_uncertainty(root):
    condition = root.find(".//dcc:influenceCondition[@refType='bench_temperature']", NAMESPACES)
    values = condition.findall(".//si:value", NAMESPACES)
    u = [float(one.text) for one in condition.iter(f"{{{NAMESPACES['si']}}}valueStandardMU")]
    assert len(u) == len(values) > 0
    assert u[0] == pytest.approx(0.5 / np.sqrt(3))


@pytest.mark.parametrize(
    ("rule", "word", "conformity"),
    [
        ("simple", "pass", "pass"),
        ("guarded", "fail", "fail"),
        ("non-binary", "conditional", "conditionalPass"),
    ],
)
def test_nothing_is_conditional_under_a_binary_rule(issued_certificate, rule, word, conformity):
    """|Δg| within the limit by less than the guard band: passed, failed or conditional, as the rule has it."""
    found = issued_certificate.found
    judged = verification_of(found.result.source, found.result, VerdictOptions(rule=rule))
    assert judged.verification.statement == "conditional pass"
    certificate = replace(issued_certificate, found=replace(found, verdict=judged))
    root = etree.fromstring(document_of(certificate))
    said = root.findtext(".//dcc:metaData[@refType='bench_conformity']/dcc:conformity", namespaces=NAMESPACES)
    points = root.findtext(".//dcc:conformityXMLList", namespaces=NAMESPACES)
    assert said == conformity
    assert ("conditional" in points) == (rule == "non-binary")
    write = Writer(certificate)
    shown = json.dumps([*proof.verdict_of(certificate.found, write), *proof.pages(write, [])])
    assert f"g: {word}" in shown
    assert ("conditional pass" in shown) == (rule == "non-binary")


def test_points_of_a_second_mounting_have_other_numbers_than_those_of_the_first(issued_certificate):
    certified = issued_certificate.found
    once = certified.verdict.verification
    again = tuple(replace(point, series=2) for point in once.points)
    verdict = replace(certified.verdict, verification=replace(once, points=again))
    certificate = replace(issued_certificate, found=replace(certified, verdict=verdict))
    assert '"V/2: 1 / 1"' in json.dumps(proof.pages(Writer(certificate), []))


def test_a_simulated_run_says_so_and_is_not_called_traceable(root):
    assert "SIMULATED" in root.findtext(
        ".//dcc:statement[@refType='bench_simulated']/dcc:declaration/dcc:content", namespaces=NAMESPACES
    )
    path = ".//dcc:statement[@refType='bench_traceability']/dcc:traceable"
    assert root.findtext(path, namespaces=NAMESPACES) == "false"


@pytest.mark.parametrize(
    ("wrong", "traceable"), [({}, "true"), ({"expired": True}, "false"), ({"later": True}, "false")]
)
def test_a_real_run_on_an_expired_or_a_later_certificate_is_not_called_traceable(
    issued_certificate, wrong, traceable
):
    held = Held(number="7", laboratory="Acme", date="2025-01-01", valid_until="2026-01-01")
    found = issued_certificate.found
    instruments = [replace(one, certificate=held) for one in found.instruments]
    instruments[0] = replace(instruments[0], **wrong)
    real = replace(issued_certificate, found=replace(found, simulated=False, instruments=tuple(instruments)))
    root = etree.fromstring(document_of(real))
    path = ".//dcc:statement[@refType='bench_traceability']/dcc:traceable"
    assert root.findtext(path, namespaces=NAMESPACES) == traceable
    lacking = [text for text in missing(real) if "traceability" in text]
    assert [instruments[0].name in text for text in lacking] == [True] * len(wrong)
    in_range = root.findtext(".//dcc:certificate/dcc:inValidityRange", namespaces=NAMESPACES)
    assert in_range == traceable


def test_an_instrument_without_a_certificate_has_none(root, issued_certificate):
    assert len(issued_certificate.uncertified) == 4
    assert root.find(".//dcc:measuringEquipment/dcc:certificate", NAMESPACES) is None


def test_a_simulated_certificate_names_no_accreditation(issued_certificate):
    body = Accreditation(body="A body", number="0000-01")
    laboratory = issued_certificate.laboratory.model_copy(update={"accreditation": body})
    for simulated in (True, False):
        found = replace(issued_certificate.found, simulated=simulated)
        document = document_of(replace(issued_certificate, laboratory=laboratory, found=found))
        assert (b"0000-01" in document) is not simulated


def test_an_amendment_names_the_one_before(issued_certificate):
    before = Before("replaced", "SIM-2026-0000", "2026-11-20", "a wrong customer", "ab" * 32)
    whole = replace(issued_certificate, issue=replace(issued_certificate.issue, before=before))
    document = document_of(whole)
    assert broken_rules(document) == ()
    core = etree.fromstring(document).find(".//dcc:coreData", NAMESPACES)
    assert (
        core.findtext("dcc:reportAmendedSubstituted/dcc:typeOfChange", namespaces=NAMESPACES) == "substituted"
    )
    assert core.findtext("dcc:previousReport/dcc:value", namespaces=NAMESPACES) == "ab" * 32


def test_what_an_adjustment_changed_stands_beside_it(issued_certificate):
    from bench.certificate.laboratory import Adjusted

    unit = issued_certificate.unit.model_copy(
        update={"state": "as left", "adjusted": Adjusted(what="trimmed")}
    )
    both = replace(issued_certificate, unit=unit, as_found=issued_certificate.found)
    both = replace(both, as_found=replace(both.found))
    document = document_of(both)
    assert broken_rules(document) == ()
    root = etree.fromstring(document)
    found = {one.text for one in root.iter(f"{{{NAMESPACES['dcc']}}}status")}
    assert found == {"beforeAdjustment", "afterAdjustment"}
    assert len(root.findall(".//dcc:measurementResult", NAMESPACES)) == 2


def test_what_people_write_cannot_become_markup(issued_certificate):
    evil = "</dcc:content><x>&amp; \x1b[31m \u202e ]]>"
    unit = issued_certificate.unit.model_copy(update={"condition": evil})
    document = document_of(replace(issued_certificate, unit=unit))
    assert broken_rules(document) == ()
    (said,) = etree.fromstring(document).xpath(
        "//dcc:item/dcc:description/dcc:content", namespaces=NAMESPACES
    )
    assert said.text == r"</dcc:content><x>&amp; \x1b[31m \u202e ]]>"


def test_a_draft_has_no_document(issued_certificate):
    with pytest.raises(ValueError, match="dates and number"):
        document_of(replace(issued_certificate, issue=None))
    assert ORDER["units"][0]["state"] == issued_certificate.state
