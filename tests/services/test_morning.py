"""The check of each morning on simulated benches: a good one, what is wrong with its remedy, the check block."""

import json
from pathlib import Path

import pytest

from bench.config.shipped import find_bench
from tests.support.check_runs import measured, write_bench
from tests.support.commands import printed, refused
from tests.support.schemas import keeps_to


@pytest.fixture
def morning(bench):
    """Carry out a dry morning; return its findings by check and the last line."""

    def call(file, *more, status=0):
        arguments = ("--morning", "--bench", file, "--dry-run", "--out", "m", "--json", "m.json", *more)
        out = printed(bench("check", *arguments), status=status)
        result = json.loads(Path("m.json").read_text(encoding="utf-8"))
        keeps_to("commission", result)
        by_check = {one["check"]: one for one in result["findings"]}
        return result, by_check, out

    return call


@pytest.mark.slow
def test_a_good_morning_is_one_green_line_within_five_minutes(morning):
    result, by_check, out = morning("bench-motorised", "--reference", "2")
    assert out.splitlines()[-1].startswith("✓ bench-motorised is ready, ")
    assert {"identity", "self-test", "noise, inputs shorted", "reference", "home and back"} == by_check.keys()
    assert result["took_s"] < 300.0
    assert "<title>Morning check of" in Path("m/commissioning.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_what_is_wrong_is_said_with_its_remedy(morning):
    text = find_bench("bench-motorised").read_text(encoding="utf-8")
    effects = "effects:\n  - name: voltmeter_offset\n    parameters: {offset: 5 mV}\n"
    Path("bad.yaml").write_text(f"{text}\n{effects}", encoding="utf-8")
    _, by_check, out = morning("bad.yaml", status=1)
    assert by_check["noise, inputs shorted"]["state"] == "other"
    assert "✗ bench-motorised is not ready" in out
    assert "short the input at the meter's own terminals" in out.splitlines()[-1]


@pytest.mark.slow
def test_one_setting_of_the_check_block_is_held_against_its_chart(morning):
    write_bench()
    _, by_check, out = morning("my.yaml")
    assert by_check["check block"]["state"] == "skipped"
    assert "check block not checked" in out.splitlines()[-1]
    for day in range(3):
        measured(f"check-{day}", seed=10 + day)
    Path("m").rename("first")
    _, by_check, _ = morning("my.yaml", "--seed", "5")
    assert by_check["check block"]["state"] == "works"
    text = Path("my.yaml").read_text(encoding="utf-8")
    moved = "effects:\n  - name: scale_asymmetry\n    channels: [z]\n    parameters: {Kabs: 1000 ug/g}\n"
    Path("my.yaml").write_text(f"{text}\n{moved}", encoding="utf-8")
    Path("m").rename("second")
    _, by_check, out = morning("my.yaml", "--seed", "5", status=1)
    assert by_check["check block"]["state"] == "other"
    assert "differs from its control chart (p = " in out


def test_it_asks_a_person_or_is_dry(bench):
    assert "start it in a terminal, or add --dry-run" in refused(
        bench("check", "--morning", "--bench", "bench-lan")
    )
    assert "name a procedure to check" in refused(bench("check"))
