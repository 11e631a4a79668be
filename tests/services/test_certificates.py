"""Certificates from the bench file to the result: readings corrected once, what is said, what is not counted."""

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

import bench as program
from bench.base.arrays import ARCSEC
from bench.calibration import calibrate as estimate
from bench.calibration.budget.coefficients import make_budget, make_setup
from bench.calibration.budget.sources import bench_sources
from bench.config.bench_file.file import corrections_of, load_bench
from bench.config.procedure.load import load_procedure
from bench.config.shipped import find_bench, find_procedure
from bench.readings.corrected import corrected
from bench.readings.csv import write_csv
from bench.run.events import sha256
from bench.run.sentences import sentence
from bench.services.execution import _on_certificates
from bench.services.source import Request, data_sha256, load_sources, provenance
from bench.validation.paper_bench import TRUTH, U0, K, simulate
from tests.support.certified_bench import meter_certificate, table_certificate, write_bench
from tests.support.diagnosis_bench import paper_run

NOW = datetime(2026, 6, 1, 12, tzinfo=UTC)
GAIN = np.array([100e-6, -40e-6, 0.0])
OFFSET_V = np.array([0.0, 80e-6, -50e-6])
METERS = {
    "x": meter_certificate("-100 ppm", "0 V"),
    "y": meter_certificate("40 ppm", "-80 uV"),
    "z": meter_certificate("0 ppm", "50 uV"),
}


@pytest.fixture(autouse=True)
def today(empty_folder, monkeypatch):
    """It is the first of June 2026."""
    monkeypatch.setattr("bench.services.traceability.utc_now", lambda: NOW)


@pytest.fixture
def shown():
    """What meters show that read 100 ppm too much (x), 40 ppm too little (y), and have zeros of 80 and −50 µV."""
    true = paper_run(None)
    return replace(true, signal=true.signal * (1.0 + GAIN) + OFFSET_V)


def write(table, name="r.csv", **told):
    """Write a readings file, with the file that tells where it comes from where anything is told."""
    write_csv(table, Path(name))
    if told:
        bench = Path("certified.yaml")
        origin = {
            "format": 1, "sha256": sha256(Path(name).read_bytes()), "simulated": False, "run": "one",
            "begun": "2026-05-01T10:00:00+00:00", "operator": "", "procedure": "paper", "plan_hash": "",
            "unit_under_test": None, "measured_with": {}, "instruments": {},
            "bench": {"file": str(bench.absolute()), "copied_to": str(bench.absolute()),
                      "sha256": sha256(bench.read_bytes())},
            **told,
        }  # fmt: skip
        Path(f"{name}.json").write_text(json.dumps(origin), encoding="utf-8")
    return Path(name)


def test_meters_with_certificates_give_the_true_coefficients_back(shown):
    file = write_bench(Path(), METERS)
    result = program.calibrate(write(shown), bench=file)
    found = np.array([c.value for c in result.coefficients.values()])
    wrong = np.array([c.value for c in program.calibrate("r.csv").coefficients.values()])
    truth = np.array(TRUTH)
    # by the meters alone K would be 100 ppm and U0 80 µV off; what is left is of second order
    assert np.max(np.abs(wrong - truth)) > 1e-4
    assert np.max(np.abs(found - truth)) < 1e-7
    (note,) = [n for n in result.notes if n.startswith("readings corrected")]
    assert note == (
        "readings corrected as the certificates say, being taken for what the instruments showed: voltmeter.x gain "
        "-100 ppm (certificate C-1); voltmeter.y gain +40 ppm, offset -80 µV (certificate C-1); voltmeter.z offset "
        "+50 µV (certificate C-1)"
    )
    said = result.to_dict()["corrections"]
    assert [(one["instrument"], one["applied"]) for one in said] == [
        ("voltmeter.x", True), ("voltmeter.y", True), ("voltmeter.z", True),
    ]  # fmt: skip
    assert program.verify("r.csv", bench=file).to_dict()["corrections"] == said
    assert np.max(np.abs([p.delta_g for p in program.verify("r.csv", bench=file).verification.points])) < 1e-7


def test_the_table_of_the_head_takes_its_eccentricity_away():
    true = paper_run(np.random.default_rng(5))
    too_much_rad = 20 * ARCSEC * np.sin(true.angle_rad)  # what the scale shows
    corrections = {angle: float(-20 * np.sin(np.radians(angle))) for angle in range(0, 360, 45)}
    file = write_bench(Path(), head=table_certificate(corrections))
    write(replace(true, angle_rad=true.angle_rad + too_much_rad))

    def found(given, **options):
        return np.array([c.value for c in program.calibrate(given, **options).coefficients.values()])

    (source,) = load_sources(Request(["r.csv"], Path("runs"), str(file)))
    assert np.max(np.abs(source.as_read.angle_rad - true.angle_rad)) > 19 * ARCSEC
    assert source.readings.angle_rad == pytest.approx(true.angle_rad, abs=0.01 * ARCSEC)
    assert found("r.csv", bench=file) == pytest.approx(found(true), abs=1e-6)


@pytest.mark.parametrize(("rows", "named"), [(45, ""), (30, "row near 45° and 3 more angles:")])
def test_angles_between_the_rows_of_a_heads_table_are_named(rows, named):
    corrections = {angle: float(-20 * np.sin(np.radians(angle))) for angle in range(0, 360, rows)}
    write(paper_run(np.random.default_rng(5)))
    notes = program.calibrate("r.csv", bench=write_bench(Path(), head=table_certificate(corrections))).notes
    found = [note for note in notes if "error of interpolation" in note]
    assert len(found) == bool(named)
    assert all(named in note for note in found)


def test_readings_at_hand_are_corrected_once_and_exported_as_they_were_read(shown):
    file = write_bench(Path(), METERS)
    (source,) = load_sources(Request([str(write(shown))], Path("runs"), str(file)))
    again = program.calibrate(source.readings, bench=file)
    first = program.calibrate("r.csv", bench=file)
    assert np.array_equal(
        [c.value for c in again.coefficients.values()], [c.value for c in first.coefficients.values()]
    )
    assert "these readings are corrected already" in again.to_dict()["corrections"][0]["why_not"]
    assert np.array_equal(source.as_read.signal, program.read_readings("r.csv").signal)
    (plain,) = load_sources(Request(["r.csv"], Path("runs")))
    assert data_sha256(source.as_read) == data_sha256(plain.as_read)


def test_a_meter_with_another_serial_number_is_not_corrected_and_has_the_data_sheet_s_limits(shown):
    meters = {
        **METERS,
        "x": meter_certificate("-100 ppm", serial="MY1"),
        "y": {**METERS["y"], "serial": "MY5"},
    }
    write_bench(Path(), meters)
    write(shown, serials={"voltmeter.x": "MY2", "voltmeter.y": "MY5"})
    result = program.calibrate("r.csv")
    error = np.array([c.value for c in result.coefficients.values()]) - np.array(TRUTH)
    assert error[0] == pytest.approx(100e-6 * K[0, 0], rel=1e-3)
    assert np.max(np.abs(error[3:9])) < 1e-7
    (words,) = [note for note in result.notes if "serial number" in note]
    assert words.startswith(
        "voltmeter.x: its certificate C-1 of 2026-01-01, Met Lab, is for serial number MY1, but the "
    )
    x, y, _ = result.to_dict()["corrections"]
    assert (x["applied"], x["why_not"]) == (False, "another instrument answered")
    assert (y["applied"], y["serial_answered"]) == (True, "MY5")
    plan = load_procedure(find_procedure("paper")).expand()
    own = result.source.bench
    lines = {s.name: s for s in bench_sources(own, make_setup(plan, own), result.source.traced.day)}
    assert lines["voltmeter_gain[x]"].origin == "agilent-34401a, limits of 90 days on 10 V"
    assert lines["voltmeter_gain[y]"].origin.startswith("certificate C-1")


def test_a_record_of_identities_alone_is_believed_where_the_serial_number_stands_in_it(shown):
    write_bench(
        Path(), {"x": meter_certificate("-100 ppm", serial="MY1"), "y": meter_certificate(serial="MY5")}
    )
    write(shown, instruments={"voltmeter.x": "Agilent 34401A MY1 A.02", "voltmeter.y": "Agilent 34401A A.02"})
    x, y = program.calibrate("r.csv").to_dict()["corrections"]
    assert (x["serial_answered"], y["serial_answered"]) == ("MY1", None)


@pytest.mark.parametrize(
    ("begun", "expired"), [("2026-04-30T10:00:00+00:00", False), ("2026-05-03T10:00:00+00:00", True)]
)
def test_expired_is_what_had_expired_on_the_day_of_the_readings(shown, begun, expired):
    write_bench(Path(), {"x": meter_certificate("-100 ppm", valid_until="2026-05-02")})
    write(shown, begun=begun)
    result = program.calibrate("r.csv")
    assert any("expired on 2026-05-02" in note for note in result.notes) == expired
    (said,) = result.to_dict()["corrections"]
    assert (said["expired"], said["applied"]) == (expired, True)
    assert ("EXPIRED on 2026-05-02" in provenance(result.source)["certificate of voltmeter.x"]) == expired


def test_simulated_readings_are_corrected_where_the_simulation_had_the_error(shown):
    for accuracy in (None, "certificate"):
        write_bench(Path(), METERS, simulation={"voltmeter": {"noise": "no", "accuracy": accuracy}})
        write(shown, simulated=True)
        result = program.calibrate("r.csv")
        assert [c["applied"] for c in result.to_dict()["corrections"]] == [accuracy == "certificate"] * 3
        told = [
            note for note in result.notes if "were simulated without the errors in the certificates" in note
        ]
        assert bool(told) == (accuracy is None)


@pytest.mark.slow
def test_what_is_left_of_the_meters_errors_is_as_large_as_the_budget_says():
    """150 files: true gains and zeros drawn about the certificates' values, by U and a drift since (seed 17)."""
    rng = np.random.default_rng(17)
    bench = program.load_bench(write_bench(Path(), METERS))
    setup = make_setup(load_procedure(find_procedure("paper")).expand(), bench)
    day = (datetime(2026, 1, 1, tzinfo=UTC) + timedelta(days=365.25)).date()
    names = ("voltmeter_gain", "voltmeter_offset")
    sources = [s for s in bench_sources(bench, setup, day) if s.group == "stand" or s.name in names]
    budget = make_budget(setup, [s for s in sources if s.u > 0])
    u = np.sqrt(sum(budget.contribution(name).u ** 2 for name in names))
    true = simulate(None, 0.0)
    by = corrections_of(bench)
    of_diagonal = np.array([0, 4, 8, 9, 10, 11])
    z = []
    for _ in range(150):
        gain, offset_v = -np.array(by.gain), -np.array(by.offset_v)
        gain = gain + rng.normal(0.0, 3e-6, 3) + rng.uniform(-8e-6, 8e-6, 3)
        offset_v = offset_v + rng.normal(0.0, 5e-6, 3) + rng.uniform(-12e-6, 12e-6, 3)
        shown = replace(true, signal=true.signal * (1.0 + gain) + offset_v)
        found = estimate(corrected(shown, by), setup.model, {}, 9.81, "closed-form")
        z.append((found.block.vector - TRUTH)[of_diagonal] / u[of_diagonal])
    assert np.sqrt(np.mean(np.square(z), axis=0)) == pytest.approx(1.0, abs=0.173)  # 3 sigma of 150


@pytest.mark.slow
def test_a_dry_run_with_the_errors_of_the_certificates_gives_the_block_back():
    stand = {
        name: {"limit": "0 arcsec", "distribution": "normal", "k": 3}
        for name in ("axis_tilt", "zero_offset", "mounting_error", "setting_error")
    }
    stand["voltmeter_error"] = {"limit": "1e-3 uV", "distribution": "normal", "k": 3}
    operator = {"setting_deviation": "0 arcsec", "slip_probability": 0}
    simulation = {"operator": operator, "voltmeter": {"noise": "no", "accuracy": "certificate"}}
    file = write_bench(Path(), METERS, stand=stand, simulation=simulation)
    done = program.dry_run("quick", file)
    found = done.calibration.coefficients
    # the scale is read to 1″, of which half goes with 2.18 V/g: 5 µV
    assert found["U0y"].value == pytest.approx(U0[1], abs=8e-6)
    assert found["Kxx"].value == pytest.approx(K[0, 0], abs=8e-6)
    shown = done.source.as_read.signal - done.readings.signal
    assert np.allclose(shown, done.source.as_read.signal * np.array([1e-4, -4e-5, 0]) + OFFSET_V, atol=2e-8)


@pytest.mark.slow
def test_an_expired_certificate_is_said_by_check_and_recorded_as_the_run_begins(bench):
    file = write_bench(Path(), {"x": meter_certificate(valid_until="2026-02-01")})
    words = "voltmeter.x: its certificate C-1 of 2026-01-01, Met Lab, expired on 2026-02-01"
    _, out, _ = bench("check", "quick", "--bench", file)
    assert f"note: {words}" in " ".join(out.split())
    done, plain = program.dry_run("quick", file), program.dry_run("quick")
    events = list(done.run.history.events)
    kinds = [event.type for event in events]
    assert kinds[:3] == ["run_started", "certificate", "step_started"]
    assert kinds.count("certificate") == 1
    assert sentence(events[1]).startswith(f"note: {words}")
    assert set(events[0].data["serials"]) >= {"voltmeter.x", "head"}
    assert "serials" not in next(iter(plain.run.history.events)).data
    assert "certificate" not in {event.type for event in plain.run.history.events}


def test_a_real_run_keeps_the_serial_numbers_without_certificates_too():
    plain = load_bench(find_bench("paper-stand"))
    assert _on_certificates(plain, simulated=True) is None
    told = _on_certificates(plain, simulated=False)
    assert told is not None
    assert told({"voltmeter.x": "MY1", "head": ""}) == []
