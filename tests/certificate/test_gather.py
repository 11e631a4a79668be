"""What a certificate says is what the analyses say; what it lacks is told."""

import json
import re
import shutil
from dataclasses import replace
from datetime import date, datetime
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from bench.calibration.conformity import DecisionRule
from bench.certificate.content import Issue, rule_said
from bench.certificate.dcc.document import document_of
from bench.certificate.gather import certificate_of, missing
from bench.certificate.laboratory import Accreditation, Adjusted, Person, load_laboratory, load_order
from bench.certificate.verify import Findings, against_record
from bench.config.devices.device import Certificate as Held
from bench.model.geometry import COEFFICIENTS
from bench.services.errors import Refused
from tests.support.certificates import ORDER, RECORDED, copy_run, write_files


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("certificates")
    copy_run(folder / "runs")
    return folder


@pytest.fixture(scope="module")
def files(folder):
    laboratory, order = write_files(folder, {"k": 3}, ORDER)
    return load_laboratory(laboratory), load_order(order)


@pytest.fixture(scope="module")
def certificate(folder, files):
    return certificate_of("finished", folder / "runs", *files)


def test_it_says_what_calibrate_and_verify_say(certificate):
    found = certificate.found
    own = found.result.calibration
    assert [value.value for value in found.coefficients.values] == own.block.vector.tolist()
    assert np.array_equal(found.coefficients.covariance, own.covariance)
    assert [value.U for value in found.coefficients.values] == [3 * u for u in own.u.tolist()]
    assert certificate.coverage == pytest.approx(0.9973, abs=1e-4)
    assert found.inverse.covariance.shape == (12, 12)
    assert np.allclose(
        np.array([value.value for value in found.inverse.values[:9]]).reshape(3, 3) @ own.block.K, np.eye(3)
    )
    assert found.verification.passed == found.verdict.passed
    assert found.verification.p_outside == found.verdict.verification.p_outside


@pytest.mark.parametrize(
    ("of_house", "of_order", "rule"),
    [
        ({}, {}, DecisionRule.of("simple")),  # the record is older than the default
        ({"rule": "guarded"}, {}, DecisionRule.of("guarded")),
        ({"rule": "guarded"}, {"rule": "non-binary", "guard_band": 0.5}, DecisionRule.of("non-binary", 0.5)),
    ],
)
def test_the_rule_that_was_agreed_stands_before_the_default(folder, tmp_path, of_house, of_order, rule):
    laboratory, order = write_files(tmp_path, of_house, ORDER | of_order)
    made = certificate_of("finished", folder / "runs", load_laboratory(laboratory), load_order(order))
    assert made.found.verification.decision == rule
    told = json.loads(made.found.result_json)["verification"]
    assert DecisionRule.of_json(told) == rule
    # and so it is held against the record
    attached = {one.name: one.content for one in made.attachments}
    says = SimpleNamespace(coefficients={"Kxx": SimpleNamespace(k=made.k)})
    shown = SimpleNamespace(files=attached, says=says, release=version("triaxial-bench"))
    against_record(found := Findings(), shown, folder / "runs")
    assert "to the last digit" in found.agreed[0]
    words = rule_said(made.texts[0].say, rule)
    assert f"w = {rule.guard_band:g} U" in words or rule.name == "simple acceptance"


def test_a_rule_that_nobody_stated_is_written_out(certificate):
    assert "at most 5 % at every verification point" in rule_said(certificate.texts[0].say, DecisionRule())


def test_it_says_where_the_numbers_come_from(certificate):
    found = certificate.found
    assert certificate.simulated
    assert found.record.events == len(found.result.source.run.history.events)
    assert found.record.head == found.result.source.run.history.head
    assert found.operator == "A. Person"
    assert found.method.procedure == "quick.yaml"
    assert [one.name for one in found.instruments][:4] == [*(f"voltmeter.{c}" for c in "xyz"), "head"]
    (temperature,) = (one for one in found.conditions if one.key == "temperature")
    assert temperature.low <= temperature.high
    (gravity,) = (one for one in found.conditions if one.key == "gravity")
    assert gravity.u > 0
    assert found.begun < found.ended


def test_nothing_of_it_depends_on_the_folder(certificate, files, tmp_path):
    shutil.copytree(RECORDED, tmp_path / "elsewhere" / "finished")
    again = certificate_of("finished", tmp_path / "elsewhere", *files)
    assert again.found.result_json == certificate.found.result_json
    assert again.attachments == certificate.attachments
    assert again.found.notes == certificate.found.notes
    assert str(tmp_path) not in again.found.result_json


def test_nothing_is_missing_where_all_is_said(certificate):
    assert missing(certificate) == ()


def test_a_draft_needs_neither_laboratory_nor_order(folder):
    draft = certificate_of("finished", folder / "runs")
    assert draft.draft
    assert len(missing(draft)) == 2


def test_what_17025_asks_for_and_is_not_there_is_listed(folder, files, tmp_path):
    laboratory, _ = files
    # a local day can be one ahead of that of UTC
    for received, said in (("2026-11-23", []), ("2026-11-24", ["2026-11-24 is after 2026-11-22"])):
        unit = {**ORDER["units"][0], "received": received}
        order = load_order(write_files(tmp_path, order={"units": [unit]})[1])
        of_day = missing(certificate_of("finished", folder / "runs", laboratory, order))
        assert len(of_day) == len(said)
        assert all(one in text for one, text in zip(said, of_day, strict=True))
    other = load_order(write_files(tmp_path, order={"units": [{**ORDER["units"][0], "serial": "9"}]})[1])
    assert (
        "unit '1' in the order file"
        in missing(certificate_of("finished", folder / "runs", laboratory, other))[0]
    )
    early = Issue("1", "2026-11-01T00:00:00+00:00", Person(name="A"))
    dated = certificate_of("finished", folder / "runs", *files, early)
    assert "2026-11-01 is before 2026-11-22" in missing(dated)[0]


def test_real_instruments_without_certificates_are_missing_unless_that_was_agreed(bench, tmp_path):
    readings = RECORDED.parent / "readings.csv"
    assert bench("import", readings, "--name", "mine", "--bench", RECORDED / "bench.yaml")[0] == 0
    laboratory, order = write_files(
        tmp_path, order={"units": [{**ORDER["units"][0], "received": "2020-01-01"}]}
    )
    read = load_laboratory(laboratory), load_order(order)
    lacking = missing(certificate_of("mine", Path("runs"), *read))
    assert "traceability of voltmeter.x, voltmeter.y, voltmeter.z, head" in lacking[0]
    assert "state 'calibrated' for the unit" in lacking[1]
    agreed = read[1].model_copy(update={"without_certificates": "a comparison in the house"})
    assert not any(
        "traceability" in text for text in missing(certificate_of("mine", Path("runs"), read[0], agreed))
    )


def test_scale_factors_of_another_block_in_the_bench_file_are_missing_once_with_the_way_out(bench, files):
    """All three channels contradict the bench file; the same readings with the corrected one do not."""
    right = (RECORDED / "bench.yaml").read_text("utf-8")
    Path("wrong.yaml").write_text(re.sub(r"-2\.1[48] V/g", "-5 V/g", right), "utf-8")
    assert bench("export", RECORDED, "--csv", "out.csv")[0] == 0
    lacking = {}
    for name, file in (("wrong", "wrong.yaml"), ("right", RECORDED / "bench.yaml")):
        assert bench("import", "out.csv", "--name", name, "--bench", file)[0] == 0
        found = missing(certificate_of(name, Path("runs"), *files))
        lacking[name] = [text for text in found if "data sheet" in text]
    (text,) = lacking["wrong"]
    assert text.count("announces -5 V/g") == 3
    assert "'bench import' them" in text
    assert lacking["right"] == []


def test_a_unit_that_was_adjusted_shows_both(folder, files):
    laboratory, order = files
    adjusted = Adjusted(what="trimmed", as_found="finished")
    unit = order.units[0].model_copy(update={"state": "as left", "adjusted": adjusted})
    order = order.model_copy(update={"units": (unit,)})
    both = certificate_of("finished", folder / "runs", laboratory, order)
    assert both.as_found.record.run == "finished"
    assert both.state == "as left"


def test_no_certificate_is_of_a_readings_file_or_a_run_that_goes_on(folder):
    with pytest.raises(Refused, match="'bench import"):
        certificate_of(str(RECORDED.parent / "readings.csv"), folder / "runs")
    shutil.copytree(RECORDED.parent / "interrupted", folder / "runs" / "interrupted")
    with pytest.raises(Refused, match="the run is interrupted"):
        certificate_of("interrupted", folder / "runs")


def test_the_results_as_found_are_of_another_run_of_that_kind_before_this_one(folder, files):
    laboratory, order = files
    adjusted = Adjusted(what="trimmed", as_found="finished")
    unit = order.units[0].model_copy(update={"state": "as left", "adjusted": adjusted})
    order = order.model_copy(update={"units": (unit,)})
    both = certificate_of("finished", folder / "runs", laboratory, order)
    earlier = {
        "record": replace(both.found.record, run="before", head="0" * 64),
        "begun": "2026-11-20T08:00:00+00:00", "ended": "2026-11-20T12:00:00+00:00",
    }  # fmt: skip
    for change, words in (
        ({"record": both.found.record}, "'as_found', finished, is the calibrated run itself"),
        ({"simulated": False}, "'as_found', before, is real, the calibrated one is not"),
        ({"ended": "2026-11-30T12:00:00+00:00"}, "ended on 2026-11-30, after the calibration began on 2026-11-22"),
        (
            {"ended": datetime.fromisoformat(both.found.begun).replace(hour=23, minute=59).isoformat()},
            "ended at 23:59:59 on 2026-11-22, after the calibration began at 02:10:59 (UTC)",
        ),
        ({"begun": "2026-11-01T08:00:00+00:00"}, "2026-11-16 is after 2026-11-01"),
        ({}, ""),
    ):  # fmt: skip
        lacking = missing(replace(both, as_found=replace(both.found, **earlier | change)))
        assert [words in text for text in lacking] == [True] * bool(words)


def test_instruments_of_the_run_as_found_need_certificates_too(certificate):
    assert certificate.uncertified
    valid = Held(number="C-1", laboratory="L", date=date(2026, 1, 1))
    of_valid = tuple(replace(one, certificate=valid) for one in certificate.found.instruments)
    held = replace(certificate, found=replace(certificate.found, instruments=of_valid))
    assert held.uncertified == ()
    assert replace(held, as_found=certificate.found).uncertified == certificate.uncertified


def test_no_certificate_is_declared_invalid_because_the_order_would_have_accepted_it(certificate):
    """The XML said so of instruments that all had valid certificates, whenever the order named a reason."""
    order = certificate.order.model_copy(update={"without_certificates": "a comparison in the house"})
    issue = Issue("SIM-2026-0001", "2026-11-22T12:00:00+00:00", Person(name="A"))
    lacking = replace(certificate, order=order, issue=issue)
    valid = Held(number="C-1", laboratory="L", date=date(2026, 1, 1))
    of_valid = tuple(replace(one, certificate=valid) for one in certificate.found.instruments)
    held = replace(lacking, found=replace(certificate.found, instruments=of_valid))
    for one, said in ((lacking, True), (replace(lacking, order=certificate.order), True), (held, False)):
        xml = document_of(one)
        assert (b"Not all instruments have valid certificates" in xml) is said
        assert (b"a comparison in the house" in xml) is (said and one is lacking)


def test_an_accreditation_that_ended_is_not_on_the_certificate(certificate):
    """It may have been valid on the day of the run, and no longer on that of the issue."""
    held = Accreditation(body="B", number="A-1", valid_until=date(2026, 11, 30))
    house = certificate.laboratory.model_copy(update={"accreditation": held})
    real = replace(certificate, laboratory=house, found=replace(certificate.found, simulated=False))
    for day, ended in (("2026-11-30", False), ("2026-12-01", True)):
        lacking = missing(replace(real, issue=Issue("2026-0001", f"{day}T12:00:00+00:00", Person(name="A"))))
        assert any("A-1 ended on 2026-11-30" in text for text in lacking) is ended
    assert missing(replace(real, found=certificate.found)) == missing(certificate) == ()


def test_no_coverage_probability_is_100_percent(certificate):
    for k, percent in ((1.0, "68.27"), (2.0, "95.45"), (3.0, "99.73"), (4.5, "99.9993"), (5.0, "99.9999")):
        values = tuple(replace(one, k=k) for one in certificate.found.coefficients.values)
        widened = replace(certificate.found.coefficients, values=values)
        assert (
            replace(certificate, found=replace(certificate.found, coefficients=widened)).coverage_percent
            == percent
        )


def test_the_parts_of_u_are_all_there_is_of_it(certificate):
    own = certificate.found.result.calibration
    told = certificate.found.contributions
    assert [one.name for one in told] == [
        "readings and stand",
        *(s.name for s in own.sources if s.covariance.any()),
    ]
    assert np.allclose(own.covariance_readings + sum(s.covariance for s in own.sources), own.covariance)
    readings = told[0]
    place = COEFFICIENTS.index(readings.most_in)
    assert readings.u == pytest.approx(np.sqrt(own.covariance_readings[place, place]))
