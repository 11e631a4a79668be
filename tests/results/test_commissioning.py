"""The page of a commissioning: what is wrong first, everything escaped."""

from bench.results.records import render_commissioning


def result(status, *findings, **more):
    return {
        "bench": "b<ench>",
        "bench_file": "bench.yaml",
        "simulated": False,
        "began": "2026-11-22T20:00:00+00:00",
        "took_s": 780.0,
        "status": status,
        "ended": "",
        "instruments": [{"name": "head", "address": "by hand", "identity": None}],
        "findings": list(findings),
        "to_do": {},
        "wire_log": "wire.log",
        "versions": {},
    } | more


def finding(state, said, remedy=""):
    figure = {"what": "took", "value": 1.23456, "unit": "s", "expected": "1 s"}
    return {
        "check": "stop",
        "instrument": "head",
        "state": state,
        "said": said,
        "figures": [figure],
        "remedy": remedy,
    }


def test_a_bench_that_is_well_has_nothing_to_do():
    page = render_commissioning(result(0, finding("works", "stopped")))
    assert "Everything tested works as expected" in page
    assert "What to do" not in page
    assert "SIMULATED" not in page
    assert "took 1.235 s (1 s)" in page


def test_what_is_wrong_stands_first_with_what_to_do_and_is_escaped():
    page = render_commissioning(
        result(
            1, finding("works", "fine"), finding("other", "<script>", "do <b>this</b>"), to_do={"head": "off"}
        )
    )
    assert "<script>" not in page
    assert "b&lt;ench&gt;" in page
    assert page.index("&lt;script&gt;") < page.index("Every check") < page.index("fine")
    assert "Do &lt;b&gt;this" in page
    assert "1 do not work as expected" in page
    assert "head: off" in page


def test_an_evening_that_ended_early_says_why():
    page = render_commissioning(result(2, ended="stopped by a signal"))
    assert "Ended early: stopped by a signal." in page
    assert "could not be tested" in page
