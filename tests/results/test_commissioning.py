"""The page of a commissioning: what is wrong first, everything escaped."""

from bench.results.records import render_commissioning


def result(status, *findings, **more):
    return {
        "bench": "b<ench>", "bench_file": "bench.yaml", "simulated": False, "status": status, "ended": "",
        "began": "2026-11-22T20:00:00+00:00", "took_s": 780.0, "findings": list(findings), "to_do": {},
        "instruments": [{"name": "head", "address": "by hand", "identity": None}], "wire_log": "wire.log",
        "versions": {}, **more,
    }  # fmt: skip


def finding(state, said, remedy=""):
    figure = {"what": "took", "value": 1.23456, "unit": "s", "expected": "1 s"}
    told = {"state": state, "said": said, "figures": [figure], "remedy": remedy}
    return {"check": "stop", "instrument": "head", **told}


def test_what_is_wrong_stands_first_with_what_to_do_and_is_escaped():
    findings = finding("works", "fine"), finding("other", "<script>", "do <b>this</b>")
    page = render_commissioning(result(1, *findings, to_do={"head": "off"}))
    assert "<script>" not in page
    assert "b&lt;ench&gt;" in page
    assert page.index("&lt;script&gt;") < page.index("Every check") < page.index("fine")
    assert "Do &lt;b&gt;this" in page
    assert "1 do not work as expected" in page
    assert "head: off" in page
    assert "took 1.235 s (1 s)" in page
    assert "SIMULATED" not in page


def test_an_evening_that_ended_early_says_why():
    page = render_commissioning(result(2, ended="stopped by a signal"))
    assert "Ended early: stopped by a signal." in page
    assert "could not be tested" in page
