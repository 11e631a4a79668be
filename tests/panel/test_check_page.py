"""The page of the check block: its charts, for whoever may look; nothing is written."""

from pathlib import Path

import pytest

from bench.panel.access import Role
from tests.support.check_runs import measured, write_bench
from tests.support.panel_client import Browser, stranger


@pytest.mark.slow
def test_the_charts_of_the_check_block(empty_folder, monkeypatch):
    monkeypatch.delenv("BENCH_FILE", raising=False)
    write_bench()
    measured("check-0", seed=10)
    measured("check-1", seed=11)
    before = files_there()
    viewer = Browser(Path("runs"), "vera", Role.VIEWER)
    assert '<a href="/check">Check block</a>' in viewer.get("/").text
    page = viewer.get("/check")
    assert page.status_code == 200
    assert "Control chart of the check block" in page.text
    assert "CHECK-1" in page.text
    assert "SIMULATED" in page.text
    assert page.text.count("<svg") == 2
    assert "check-1, begun" in page.text
    assert "sandbox" in page.headers["content-security-policy"]
    none = viewer.get("/check?of=real")
    assert (none.status_code, "no run of a check block there" in none.text) == (409, True)
    assert files_there() == before


def files_there():
    """What stands in the runs, as it was written last."""
    return sorted(
        (str(file), file.stat().st_mtime_ns) for file in Path("runs").glob("check-*/**/*") if file.is_file()
    )


def test_a_stranger_sees_nothing_and_nobody_writes(tmp_path):
    assert stranger(tmp_path / "runs").get("/check").status_code in (303, 401)
    viewer = Browser(tmp_path / "runs", "vera", Role.VIEWER)
    assert viewer.post("/check").status_code == 405
    assert viewer.get("/check?of=all").status_code == 400
    none = viewer.get("/check")
    assert (none.status_code, "no run of a check block there" in none.text) == (409, True)
