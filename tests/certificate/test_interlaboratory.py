"""The interlaboratory kit from the plan to the report, with results as JSON and as a certificate of anybody."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import bench
from bench.certificate.interlaboratory import kit_evaluate, kit_seal, load_kit, plan_kit
from bench.history.comparison import Snapshot
from bench.history.equivalence import against_others
from bench.history.measured import STANDARD_GRAVITY
from bench.model.geometry import COEFFICIENTS
from bench.results.interlaboratory import render_kit
from bench.services.errors import Refused
from bench.validation.paper_bench import TRUTH
from benchmarks import interlaboratory_campaign
from tests.certificate.dcc.test_reading import HEAD, real_list
from tests.support.commands import refused
from tests.support.schemas import keeps_to

U = np.array([2e-5] * 9 + [1e-5] * 3)
NAMES = ["Kyiv", "Graz", "Brno", "Lviv", "Turin"]


def result(rng, file, change=0.0, **more):
    """A laboratory's result, as `calibrate --json` has it, with independent errors of u and the members `more`."""
    vector = TRUTH + rng.normal(0.0, U) + change
    stated = zip(COEFFICIENTS, vector.tolist(), U.tolist(), strict=True)
    data = {
        "unit": "V", "g_m_s2": 9.80665, "noise": {"reading_v": 1e-4}, "order": list(COEFFICIENTS),
        "covariance": np.diag(U**2).tolist(),
        "coefficients": {name: {"value": v, "u": u, "U": 2 * u, "k": 2.0} for name, v, u in stated},
    } | more  # fmt: skip
    Path(file).write_text(json.dumps(data), encoding="utf-8")
    return file


@pytest.fixture
def planned(bench, empty_folder):
    arguments = [word for name in NAMES for word in ("--laboratory", name)]
    status, out, err = bench("kit", "plan", "kit.yaml", *arguments, "--block", "17", "--seed", "3")
    assert (status, err) == (0, "")
    assert out.count("Kyiv (pilot)") == 3
    return load_kit(Path("kit.yaml"))


def measured(kit, wrong, change):
    rng = np.random.default_rng(5)
    return [
        f"{stop.code}={result(rng, f'{stop.code}.json', change if stop.laboratory == wrong else 0.0)}"
        for stop in kit.stops
    ]


@pytest.mark.parametrize("wrong", [None, "Brno"])
def test_from_the_plan_to_the_report(bench, planned, wrong):
    results = measured(planned, wrong, np.eye(12)[4] * 3e-4)
    foreign = next(k for k, stop in enumerate(planned.stops) if stop.laboratory == "Graz")
    code, file = results[foreign].split("=")
    stated = json.loads(Path(file).read_text(encoding="utf-8"))["coefficients"]
    Path("graz.xml").write_text(HEAD.format(real_list(values=[stated[n]["value"] for n in stated], u="4e-5")))
    results[foreign] = f"{code}=graz.xml"
    assert "all results are sealed" in bench("kit", "seal", "kit.yaml", *results)[1]
    status, out, _ = bench(
        "kit", "evaluate", "kit.yaml", *results, "--g", 9.80665, "--out", "report", "--json", "r.json"
    )
    found = json.loads(Path("r.json").read_text(encoding="utf-8"))
    keeps_to("kit", found)
    off = [stop.code for stop in planned.stops if stop.laboratory == wrong]
    assert found["off"] == off
    assert status == (1 if wrong else 0)
    assert out.count("OFF") == len(off)
    assert any(note.startswith(f"{code}: it states no covariance") for note in found["notes"])
    assert any(note.startswith(f"{code}: states no part of u from K2 and K3") for note in found["notes"])
    assert not any("signature" in note for note in found["notes"])
    assert found["transport_p"] > 0.01
    page = Path("report/kit.html").read_text(encoding="utf-8")
    assert "<svg" in page
    assert not any(name in page for name in NAMES)
    assert "e+0" not in page
    value, u = found["consensus"]["Sx"].values()
    assert f"<td>{value:.7f} V/g</td><td>{1e6 * u:.1f} µV/g</td>" in page


def test_a_result_opens_only_when_all_are_sealed_and_is_the_one_that_was_sealed(bench, planned):
    results = measured(planned, None, 0.0)
    bench("kit", "seal", "kit.yaml", *results[1:])
    refused(bench("kit", "evaluate", "kit.yaml", *results), f"{planned.stops[0].code}: has no seal")
    bench("kit", "seal", "kit.yaml", results[0])
    code, _, file = results[2].partition("=")
    Path(file).write_text(Path(file).read_text(encoding="utf-8") + " ", encoding="utf-8")
    refused(bench("kit", "evaluate", "kit.yaml", *results), f"{code}: {file} is not the file that was sealed")
    refused(bench("kit", "seal", "kit.yaml", results[2]), f"{code}: is sealed already")


def test_a_block_that_changes_on_its_way_is_told_and_widens_u(planned):
    """From Python: bx steps by 30 u after the third stop, which the pilot's return shows, and u of everybody."""
    rng, step = np.random.default_rng(7), np.eye(12)[9] * 3e-4
    results = [
        f"{stop.code}={result(rng, f'{stop.code}.json', step * (number > 2))}"
        for number, stop in enumerate(planned.stops)
    ]
    left = kit_seal("kit.yaml", results)
    assert all(stop.seal for stop in left.stops)
    found = kit_evaluate("kit.yaml", results)
    pilots = [stop.code for stop in planned.stops if stop.pilot]
    assert [(one.first, one.last, one.changed) for one in found.drifts] == [
        (*pilots[:2], True),
        (*pilots[1:], False),
    ]
    assert found.drifts[0].changes["bx"].value == pytest.approx(step[9] / abs(TRUTH[0]), rel=0.3)
    assert found.transport["bx"] > 5e-5
    assert found.transport["by"] < 2e-5
    assert (found.off, found.accepted) == ([], False)
    assert "CHANGED from" in render_kit(found)


def test_errors_of_the_block_that_all_laboratories_share_stay_in_u_of_the_consensus(planned):
    """K2 shifts U0x by 40 µV in every laboratory: no mean reduces this error, and differences are free of it."""
    rng, shared, own = np.random.default_rng(10), 4e-5, U[9]
    covariance = np.diag(U**2 + shared**2 * (np.arange(12) == 9)).tolist()
    more = {"covariance": covariance, "block_terms": (shared * np.eye(12)[[9]]).tolist()}
    results = [f"{s.code}={result(rng, f'{s.code}.json', **more)}" for s in planned.stops]
    kit_seal("kit.yaml", results)
    found = kit_evaluate("kit.yaml", results)
    scale = abs(TRUTH[0])
    assert found.consensus["bx"].u == pytest.approx(np.hypot(shared, own / np.sqrt(5.0)) / scale, rel=0.01)
    for one in found.laboratories:
        assert one.differences["bx"].u == pytest.approx(own * np.sqrt(1.25) / scale, rel=0.2)


def test_monitors_at_a_stop_show_what_the_block_did_there(planned, tmp_path):
    """A monitor repeats to 5 µV; between arrival and departure at Brno bx moves by 2 mV, at Lviv by nothing."""
    rng = np.random.default_rng(8)
    results = measured(planned, None, 0.0)
    kit_seal("kit.yaml", results)
    codes = {stop.laboratory: stop.code for stop in planned.stops}
    checks = []
    for name, step in (("Brno", 2e-3), ("Lviv", 0.0)):
        for day, off in enumerate((0.0, step)):
            checks.append(f"{codes[name]}={monitor_file(rng, tmp_path / f'{name}{day}.csv', off)}")
    found = kit_evaluate("kit.yaml", results, check=checks)
    by_monitor = {one.first: one for one in found.drifts if one.by == "monitor"}
    assert {code: one.changed for code, one in by_monitor.items()} == {
        codes["Brno"]: True,
        codes["Lviv"]: False,
    }
    assert by_monitor[codes["Brno"]].changes["bx"].value == pytest.approx(2e-3 / 2.0, rel=0.02)
    assert found.transport["bx"] > 3e-4
    with pytest.raises(Refused, match="give each file as CODE=FILE"):
        kit_evaluate("kit.yaml", results, check=["brno.csv"])


def monitor_file(rng, path, off):
    """Four positions about the shaft, twice: 2 V/g along x and y, a bias of x, and noise of 5 µV."""
    rows = ["installation,pass,point,angle_deg,ux_v,uy_v,uz_v"]
    for number, angle in enumerate([0, 90, 180, 270] * 2):
        force = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0])
        signal = 2.0 * force + [off, 0.0, 0.0] + rng.normal(0.0, 5e-6, 3)
        rows.append(f"1,{number // 4 + 1},{number % 4 + 1},{angle},{','.join(map(str, signal))}")
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return path


def test_the_plan_visits_everybody_once_and_the_pilot_between():
    kit = plan_kit("17", NAMES, 3)
    assert sorted(s.laboratory for s in kit.stops if not s.pilot) == sorted(NAMES[1:])
    assert [s.pilot for s in kit.stops] == [True, False, False, True, False, False, True]
    assert len({s.code for s in kit.stops}) == 7
    assert [s.code for s in plan_kit("17", NAMES, 3).stops] == [s.code for s in kit.stops]
    with pytest.raises(Refused, match="three or more"):
        plan_kit("17", NAMES[:2], 3)


def test_consensus_and_difference_are_those_of_the_textbook():
    """Without scatter beyond u the consensus is the weighted mean, and nobody's u holds a term between them."""
    u = np.array([1.0, 2.0, 1.0, 2.0])
    values = np.array([0.0, 0.1, -0.1, 9.0])[:, None] * np.ones((4, 9))
    covariances = u[:, None, None] ** 2 * np.eye(9)
    last = against_others(values, covariances)[3]
    weights = 1 / u[:3] ** 2
    assert last.difference == pytest.approx(9.0 - weights @ [0.0, 0.1, -0.1] / weights.sum())
    assert last.u == pytest.approx(np.sqrt(4.0 + 1 / weights.sum()))
    assert last.dark == pytest.approx(0.0)
    assert last.chi2 == pytest.approx(np.sum((last.difference / last.u) ** 2))


@pytest.mark.slow
def test_laboratories_whose_gravity_is_off_within_its_u_are_not_accused():
    """Seed 9, 25 rounds of five right laboratories, each at a place of its own, with u of g above that of S.

    Holm at 5 %: any is accused in at most 5 % of the rounds, with a binomial margin of 99.9 %.
    """
    rng, gravity_u, accused = np.random.default_rng(9), 5e-5, np.zeros((25, 2), dtype=bool)
    for at in range(25):
        stated = 9.78 + 0.01 * np.arange(5)
        true = stated * (1.0 + gravity_u * rng.normal(size=5))
        errors = rng.normal(0.0, U, (5, 12))
        per_g = np.where(np.arange(12) < 9, true[:, None] / STANDARD_GRAVITY, 1.0)
        there = [
            Snapshot("", None, "17", "V", g, v, np.diag(U**2), gravity_u=gravity_u)
            for g, v in zip(stated.tolist(), TRUTH * per_g + errors, strict=True)
        ]
        for column, known in enumerate((gravity_u, 0.0)):
            nine = [replace(one, gravity_u=known).per(STANDARD_GRAVITY).in_nine() for one in there]
            judged = against_others(
                *(np.array([getattr(n, of) for n in nine]) for of in ("vector", "covariance"))
            )
            accused[at, column] = any(one.off for one in judged)
    most = stats.binom.ppf(0.999, len(accused), 0.05) / len(accused)
    assert accused[:, 0].mean() <= most < accused[:, 1].mean()


def test_the_campaign_in_short_keeps_its_promises(capsys):
    """Seed 1, 3 rounds of `python -m benchmarks.interlaboratory_campaign`."""
    assert interlaboratory_campaign.main(["--runs", "3", "--workers", "1"]) == 0
    assert "the wrong one found: 1.000" in capsys.readouterr().out


def test_a_result_that_was_given_twice_or_is_of_several_is_refused(planned):
    """A pilot that repeats its first result would prove that the block did not change."""
    results = measured(planned, None, 0.0)
    first, last = (results[at].partition("=")[2] for at in (0, -1))
    data = json.loads(Path(first).read_text(encoding="utf-8"))
    Path(last).write_text(json.dumps(data, indent=1), encoding="utf-8")
    kit_seal("kit.yaml", results)
    codes = [planned.stops[at].code for at in (0, -1)]
    with pytest.raises(Refused, match=f"{codes[0]}, {codes[1]}: the results are the same to the last digit"):
        kit_evaluate("kit.yaml", results)
    with pytest.raises(Refused, match=f"{codes[1]}: no result is given; add {codes[1]}=FILE"):
        kit_evaluate("kit.yaml", results[:-1])
    Path("kit.yaml").unlink()
    bench.kit_plan("kit.yaml", laboratory=NAMES, seed=3)
    Path(last).write_text(json.dumps([data, data]), encoding="utf-8")
    kit_seal("kit.yaml", results)
    with pytest.raises(Refused, match="has 2 results; give a file with one"):
        kit_evaluate("kit.yaml", results)


def test_notes_name_results_of_another_block_and_those_not_accepted(planned):
    rng = np.random.default_rng(12)
    more = {"unit_under_test": {"type": "block", "serial": "17"}}
    of = [
        more, more | {"fits": False},
        *[{"unit_under_test": {"type": "block", "serial": "18"}}] * (len(planned.stops) - 2),
    ]  # fmt: skip
    results = [
        f"{s.code}={result(rng, f'{s.code}.json', **one)}" for s, one in zip(planned.stops, of, strict=True)
    ]
    kit_seal("kit.yaml", results)
    first, *own = kit_evaluate("kit.yaml", results).notes
    codes = [stop.code for stop in planned.stops]
    assert first.startswith(f"the results name several blocks (block 17: {codes[0]}, {codes[1]}; block 18: ")
    assert f"{codes[1]}: not accepted by its laboratory: the readings contradict the model" in own


def test_codes_cannot_be_drawn_again_without_a_seed(empty_folder):
    plans = [bench.kit_plan(f"{n}.yaml", laboratory=NAMES) for n in range(2)]
    assert plans[0].stops != plans[1].stops
