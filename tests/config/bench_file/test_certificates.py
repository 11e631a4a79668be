"""Certificates in a bench file: what they give, and all mistakes at once with their lines."""

import datetime

import numpy as np
import pytest
import yaml

from bench.base.yaml_files import FileMistakes
from bench.config.bench_file.file import corrections_of, load_bench, standings, without
from bench.config.shipped import find_bench
from tests.support.certified_bench import certified, meter_certificate, table_certificate, write_bench
from tests.support.pages import DOCS, blocks

DAY = datetime.date(2026, 6, 1)


def told(folder, **parts):
    with pytest.raises(FileMistakes) as error:
        load_bench(write_bench(folder, **parts))
    return [f"{mistake.place}: {mistake.text}" for mistake in error.value.mistakes]


def test_the_corrections_are_those_of_each_meters_channel_on_its_range(tmp_path):
    other_range = {"range": "1 V", "gain": {"correction": "70 ppm", "U": "6 ppm", "k": 2}}
    x = meter_certificate("-12 ppm", "15 uV")
    x["values"].append(other_range)
    z = {
        **meter_certificate(),
        "values": [{"range": "10 V", "offset": {"correction": "-0.02 mV", "U": "5 uV", "k": 2}}],
    }
    by = corrections_of(certified(tmp_path, meters={"x": x, "z": z}))
    assert by.gain == pytest.approx((-12e-6, 0.0, 0.0))
    assert by.offset_v == pytest.approx((15e-6, 0.0, -20e-6))


def test_a_multiplexer_s_certificate_is_of_all_its_channels(tmp_path):
    text = find_bench("bench-multiplexer").read_text(encoding="utf-8")
    values = "[{range: 10 V, gain: {correction: 5 ppm, U: 1 ppm, k: 2}}]"
    held = f"certificate: {{number: C, laboratory: L, date: 2026-01-01, values: {values}}}"
    changed = text.replace(
        "    - driver: keysight-34970a\n", f"    - driver: keysight-34970a\n      {held}\n"
    )
    assert changed != text
    (tmp_path / "bench.yaml").write_text(changed, encoding="utf-8")
    assert corrections_of(load_bench(tmp_path / "bench.yaml")).gain == pytest.approx((5e-6,) * 3)


def test_all_mistakes_are_told_at_once(tmp_path):
    def of(value):
        return {**meter_certificate(), "values": value}

    found = told(
        tmp_path,
        meters={
            "x": {"number": "1", "laboratory": "L", "date": "2026-02-30", "valid_untl": "2027-01-01",
                  "values": [{"range": "10 V", "gain": {"correction": "5 ppm", "U": "1 ppm"}}, {"range": "1 V"}]},
            "y": {**meter_certificate(), "valid_until": "2025-12-31",
                  "values": [{"range": "10 V", "gain": {"correction": "5", "U": "1 ppm", "k": 0,
                                                   "drift": "3 ppm"}}]},
            "z": of([{"range": "11 V", "offset": {"U": "1 uV", "k": 2}}]),
        },
        head=table_certificate({0: 1.0, 45: 1.0, 90: 1.0, 180: 1.0}),
        gravity={"value": "9.81 m/s^2", "source": "survey", "date": "1.2.2024", "U": "2e-5 m/s^2"},
        chamber={**meter_certificate(), "date": "2026-13-01", "values": [
            {"temperature": "23 degC", "correction": "0.1 degC", "U": "0.1 K", "k": 2}]},
    )  # fmt: skip
    expected = [
        "gravity: 'k' is missing",
        "gravity.date: expected a date such as 2026-03-02, got '1.2.2024'",
        "instruments.chamber.certificate.date: there is no day 2026-13-01",
        "instruments.chamber.certificate.values[1].correction: expected a difference of temperatures",
        "head.certificate.values: the table has no angle between 180° and 360°: state angles at most 45°",
        "voltmeters[1].certificate.date: there is no day 2026-02-30: expected a date such as 2026-03-02",
        "voltmeters[1].certificate.valid_untl: unknown key 'valid_untl'; did you mean 'valid_until'?",
        "voltmeters[1].certificate.values[1].gain: 'k' is missing",
        "voltmeters[1].certificate.values[2]: the range has neither 'gain' nor 'offset'",
        "voltmeters[2].certificate.valid_until: the certificate expired on ",
        "voltmeters[2].certificate.values[1].gain.correction: state a gain correction within ±1 %",
        "voltmeters[2].certificate.values[1].gain.drift: expected a drift of the gain such as '8 ppm/year'",
        "voltmeters[2].certificate.values[1].gain.k: expected more than 0.0, got '0'",
        "voltmeters[3].certificate: the certificate states the range 11 V, which the meter lacks; choose from "
        "0.1 V, 1 V, 10 V",
    ]
    for sentence in expected:
        assert [line for line in found if sentence in line], (sentence, found)
    assert len(found) == len(expected)


@pytest.mark.parametrize(
    ("parts", "sentence"),
    [
        ({"head": table_certificate(dict.fromkeys((0, 40, 80, 440, 120, 160, 200, 240, 280, 320), 0.0))},
         "80° appears twice, perhaps a turn apart; keep one"),
        ({"head": table_certificate(dict.fromkeys(range(0, 360, 30), 4000.0))}, "within ±1°, not 1.11111°"),
        ({"meters": {"x": meter_certificate(offset="0.2 V")}}, "within 1 % of the range, not 0.2 V"),
        ({"meters": {"x": {**meter_certificate(),
                           "values": [*meter_certificate()["values"], *meter_certificate()["values"]]}}},
         "the range 10 V appears twice; keep one"),
        ({"meters": {"x": {**meter_certificate(), "values": []}}}, "expected a list of at least 1"),
        ({"simulation": {"voltmeter": {"accuracy": "certificate"}}},
         "voltmeter 1, 2, 3 has no certificate from which to draw errors"),
    ],
)  # fmt: skip
def test_what_is_no_certificate_is_told(tmp_path, parts, sentence):
    assert any(sentence in line for line in told(tmp_path, **parts))


def test_the_full_turn_need_not_be_written_twice(tmp_path):
    table = table_certificate({angle: float(angle == 180) for angle in range(0, 360, 45)})
    assert corrections_of(certified(tmp_path, head=table)).head[4] == pytest.approx((np.pi, np.pi / 648000))


def test_gravity_with_its_source_is_a_value(tmp_path):
    gravity = {"value": "9.81054 m/s^2", "source": "survey", "date": "2024-02-01", "U": "2e-6 m/s^2", "k": 2}
    assert certified(tmp_path, gravity=gravity).gravity_m_s2 == 9.81054


# --- on a day, with what answered -------------------------------------------------------------------


def test_an_expired_certificate_is_said_from_the_day_after(tmp_path):
    bench = certified(tmp_path, meters={"y": meter_certificate(valid_until="2026-06-01")})
    (on_the_day,) = standings(bench, DAY)
    (after,) = standings(bench, DAY + datetime.timedelta(days=1))
    assert list(on_the_day.remarks()) == []
    assert list(after.remarks()) == [
        "voltmeter.y: its certificate C-1 of 2026-01-01, Met Lab, expired on 2026-06-01: its values are "
        "used with an allowance for drift since then; have the instrument calibrated"
    ]


def test_no_allowance_is_claimed_for_the_drift_of_a_head(tmp_path):
    """u of a head is that of its table, however old it is."""
    table = table_certificate({float(angle): 0.0 for angle in range(0, 360, 45)}, valid_until="2026-06-01")
    (found,) = standings(certified(tmp_path, head=table), DAY + datetime.timedelta(days=1))
    (remark,) = found.remarks()
    assert "used without an allowance for drift since then" in remark


def test_a_certificate_dated_after_the_readings_is_said(tmp_path):
    bench = certified(tmp_path, meters={"y": meter_certificate()})
    (before,) = standings(bench, datetime.date(2025, 12, 31))
    (on_the_day,) = standings(bench, datetime.date(2026, 1, 1))
    assert (before.later, on_the_day.later) == (True, False)
    assert "is dated after the readings (2025-12-31)" in next(before.remarks())


@pytest.mark.parametrize(
    ("answered", "foreign"),
    [
        ({"voltmeter.x": "MY2"}, True),
        ({"voltmeter.x": "my1 "}, False),
        ({"voltmeter.x": ""}, False),
        ({}, False),
    ],
)
def test_a_certificate_of_another_serial_number_counts_nothing(tmp_path, answered, foreign):
    bench = certified(tmp_path, meters={"x": meter_certificate("-5 ppm", serial="MY1")})
    (found,) = standings(bench, DAY, answered)
    assert found.foreign == foreign
    own = without(bench, {found.instrument} if found.foreign else set())
    assert bool(corrections_of(own)) != foreign
    if foreign:
        assert "is for serial number MY1, but the connected instrument has MY2" in next(found.remarks())


def test_a_head_that_a_person_turns_states_no_serial_number(tmp_path):
    table = table_certificate(dict.fromkeys(range(0, 360, 45), 1.0), serial="H-9")
    (found,) = standings(certified(tmp_path, head=table), DAY, {"head": "X"})
    assert (found.answered, found.foreign) == (None, False)


def test_a_certificate_that_leaves_out_the_range_is_told(tmp_path):
    held = {**meter_certificate(), "values": [{"range": "1 V", "gain": {"U": "6 ppm", "k": 2}}]}
    (found,) = standings(certified(tmp_path, meters={"x": held}), DAY)
    assert "does not cover the 10 V range: the data sheet's limits apply there" in next(found.remarks())


# --- what is shown to be copied ---------------------------------------------------------------------


def test_the_certificates_on_the_page_are_read(tmp_path):
    shown = [yaml.safe_load(b.text) for b in blocks(DOCS / "traceability.md") if b.kind == "yaml"]
    meter, head, chamber = (table | {"date": str(table["date"])} for table in shown)
    meter["valid_until"] = str(meter["valid_until"])
    bench = certified(tmp_path, meters={"x": meter}, head=head, chamber=chamber)
    assert [found.correction for found in standings(bench, DAY)] == [
        "gain -12 ppm, offset +15 µV", "table of 8 angles, up to 3.1 arcsec", "2 temperatures, up to 0.3 K",
    ]  # fmt: skip


def test_the_example_in_a_shipped_file_is_one(tmp_path):
    lines = find_bench("bench-lan").read_text(encoding="utf-8").splitlines()
    first = lines.index("  # - driver: keysight-34461a")
    example = [line.replace("  # ", "    ", 1) for line in lines[first : first + 13]]
    plain = next(i for i, line in enumerate(lines) if "channels: [x], resource" in line)
    file = tmp_path / "bench.yaml"
    file.write_text("\n".join([*lines[:plain], *example, *lines[plain + 1 :]]), encoding="utf-8")
    assert corrections_of(load_bench(file)).gain == pytest.approx((-12e-6, 0, 0))
