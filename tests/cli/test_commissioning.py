"""`bench instruments --commission`: who may start it, what it prints, its status."""

import json
from pathlib import Path

import pytest

from bench.cli.app import main


@pytest.fixture
def call(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("BENCH_FILE", raising=False)

    def instruments(*arguments):
        with pytest.raises(SystemExit) as ended:
            main(["instruments", *map(str, arguments)])
        out, err = capsys.readouterr()
        assert "Traceback" not in err
        return ended.value.code, out, err

    return instruments


def test_without_a_terminal_it_is_refused_before_anything_is_opened(call):
    status, _, err = call("--commission", "--bench", "bench-lan")
    assert status == 2
    assert "start it in a terminal" in err
    assert list(Path.cwd().iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--commission"], "say which bench"),
        (["--commission", "--discover", "--bench", "bench-lan"], "goes without --discover"),
        (
            ["--commission", "--wire-log", "w", "--bench", "bench-lan"],
            "goes without --discover and --wire-log",
        ),
        (["--dry-run", "--bench", "bench-lan"], "--dry-run and --out go with --commission"),
        (["--out", "here", "--bench", "bench-lan"], "--dry-run and --out go with --commission"),
    ],
)
def test_options_that_do_not_go_together_are_refused(call, arguments, said):
    status, _, err = call(*arguments)
    assert (status, said in err) == (2, True)


def test_a_dry_run_prints_what_it_finds_and_where_the_page_is(call):
    status, out, err = call("--commission", "--dry-run", "--bench", "bench-lan")
    assert (status, err) == (0, "")
    assert "voltmeter.x: time of a reading" in out
    (folder,) = Path.cwd().glob("commissioning-*")
    assert f"page: {folder.name}/commissioning.html" in out.replace("\\", "/")


def test_json_alone_goes_to_standard_output_and_a_fault_decides_the_status(call):
    from bench.config.shipped import find_bench

    text = find_bench("bench-lan").read_text(encoding="utf-8")
    faults = "simulation:\n  faults: [{fault: overload, instrument: voltmeter.y, probability: 1}]\n"
    Path("bench.yaml").write_text(f"{text}\n{faults}", encoding="utf-8")
    status, out, _ = call(
        "--commission", "--dry-run", "--bench", "bench.yaml", "--out", "here", "--json", "-"
    )
    result = json.loads(out)
    assert status == result["status"] == 1
    wrong = {one["instrument"] for one in result["findings"] if one["state"] != "works"}
    assert wrong == {"voltmeter.y"}
    assert (Path("here") / "commissioning.html").is_file()
