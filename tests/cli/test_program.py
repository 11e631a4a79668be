"""What holds for every command: Ctrl-C, help, quiet, completion, what a mistake is called."""

import codecs
import io
import json
import os
import re
import runpy
import signal
import sys
from importlib import metadata
from pathlib import Path

import pytest
from rich.console import Console

from bench.base.computing import heard_by, quiet, tracked
from bench.cli import app, printing, program
from bench.cli.app import explain
from bench.cli.program import in_ascii
from bench.config.shipped import find_procedure
from bench.run.interrupts import Interrupts
from bench.services.errors import Refused
from tests.support.commands import printed, refused
from tests.support.pages import ROOT
from tests.support.scripted_session import Clock


@pytest.fixture
def handler(monkeypatch):
    """Give the handler back: the program never hears Ctrl-C again once it has ended."""
    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(program.os, "_exit", sys.exit)
    monkeypatch.setattr(Interrupts, "heard", 0)
    yield
    signal.signal(signal.SIGINT, before)


def interrupted():
    os.kill(os.getpid(), signal.SIGINT)


def test_ctrl_c_is_a_line_and_later_ones_are_not_heard(handler, monkeypatch, capsys):
    monkeypatch.setattr(app, "main", interrupted)
    with pytest.raises(SystemExit) as end:
        program.main()
    interrupted()
    assert end.value.code == 2
    assert capsys.readouterr().err == "bench: stopped by Ctrl-C\n"


def test_no_signal_takes_the_place_of_a_refusal_on_its_way(handler, monkeypatch, capsys):
    def refused(*arguments):
        raise Refused("interrupted; 3 readings are kept")

    def leave(interrupts, kind, error, trace):
        leave_now(interrupts, kind, error, trace)
        if kind is Refused:
            interrupted()

    leave_now = Interrupts.__exit__
    monkeypatch.setattr(Interrupts, "__exit__", leave)
    monkeypatch.setattr("bench.services.instruments.look_at", refused)
    monkeypatch.setattr(sys, "argv", ["bench", "instruments", "--bench", "paper-stand"])
    with Interrupts(), pytest.raises(SystemExit) as end:  # which gives all handlers back
        program.main()
    assert end.value.code == 2
    assert capsys.readouterr().err == "bench: interrupted; 3 readings are kept\n"


def test_ctrl_c_as_the_program_leaves_changes_neither_status_nor_what_was_said(handler, monkeypatch, capsys):
    def done():
        raise SystemExit(1)

    def set_late(number, what):
        if what is signal.SIG_IGN and late:
            late.pop()
            interrupted()  # just before it is heard no more
        return set_now(number, what)

    set_now, late = signal.signal, [True]
    monkeypatch.setattr(app, "main", done)
    monkeypatch.setattr(program.signal, "signal", set_late)
    with pytest.raises(SystemExit) as end:
        program.main()
    assert end.value.code == 1
    assert capsys.readouterr().err == ""


def test_a_terminal_that_knows_few_characters_is_shown_ascii(handler, monkeypatch, empty_folder):
    shown = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(shown, encoding="ascii", write_through=True))
    assert status_of(monkeypatch, "check", "quick") == 0
    assert b" uV/g" in shown.getvalue()
    assert b"\\" not in shown.getvalue()
    shown.seek(0)
    shown.truncate()
    procedure = find_procedure("quick").read_text(encoding="utf-8")
    Path("p.yaml").write_text(re.sub(r"(?m)^procedure: .*", "procedure: µ", procedure), encoding="utf-8")
    assert status_of(monkeypatch, "check", "p.yaml", "--json", "-") == 0
    assert json.loads(shown.getvalue())["procedure"] == "µ"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("−2.177071 ± 0.1 µV/g ≤ 3", "-2.177071 +- 0.1 uV/g <= 3"),
        ("45°00′10″, 20 °C", "45 deg 00 arcmin 10 arcsec, 20 deg C"),
        ("|Δg|, 3σ, χ²/dof, 10⁻⁵ s⁻¹", "|delta g|, 3 sigma, chi^2/dof, 10^-5 s^-1"),
        ("Київ", r"\u041a\u0438\u0457\u0432"),
    ],
)
def test_a_character_that_a_terminal_lacks_is_written_in_ascii(text, shown):
    codecs.register_error("in_ascii", in_ascii)
    assert text.encode("ascii", "in_ascii").decode() == shown


@pytest.fixture
def unread(monkeypatch, capsys):
    """Make standard output a pipe whose reader has ended."""
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w", encoding="utf-8") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        yield
        sys.stdout.flush()


def status_of(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["bench", *arguments])
    with pytest.raises(SystemExit) as end:
        program.main()
    return end.value.code


@pytest.mark.slow
def test_a_run_whose_output_nobody_reads_any_more_goes_on_to_its_verdict(
    handler, unread, monkeypatch, empty_folder, capsys
):
    assert status_of(monkeypatch, "run", "quick", "--dry-run", "--name", "a") == 0
    assert json.loads((Path("runs") / "a" / "results.json").read_text())["made"]
    assert status_of(monkeypatch, "verify", "a", "--limit", "1e-6", "--rule", "simple") == 1
    assert status_of(monkeypatch, "verify", "b") == 2
    assert [line[:6] for line in capsys.readouterr().err.splitlines()] == ["bench:"]


def test_without_a_standard_output_a_command_ends_with_its_status(handler, monkeypatch, empty_folder, capsys):
    monkeypatch.setattr(sys, "stdout", None)
    assert status_of(monkeypatch, "instruments", "--bench", "paper-stand", "--json", "-") == 2
    assert status_of(monkeypatch, "check", "quick", "--json", "-") == 0
    assert "error of the program" not in capsys.readouterr().err


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
@pytest.mark.parametrize("streams", [["stderr"], ["stdout", "stderr"]])
def test_on_a_full_disk_a_command_ends_with_its_status(handler, monkeypatch, empty_folder, streams):
    with Path("/dev/full").open("w", 1, "utf-8") as full:
        for name in streams:
            monkeypatch.setattr(sys, name, full)
        assert status_of(monkeypatch, "show", "no-such-run") == 2


RECORDS = ROOT / "tests" / "data" / "records"


# --- help -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("arguments", [["fleet"], ["runs"], ["run"]])
def test_h_is_help(bench, arguments):
    short, long = bench(*arguments, "-h"), bench(*arguments, "--help")
    assert short == long
    assert short[0] == 0
    assert "-h, --help" in short[1]


def test_the_version_is_that_of_the_distribution_and_no_command_is_carried_out_beside_it(bench):
    told = (0, f"bench {metadata.version('triaxial-bench')}\n", "")
    assert bench("--version") == bench("--version", "run", "paper", "--dry-run") == told


# --- completion -------------------------------------------------------------------------------------


@pytest.fixture
def completed(bench, monkeypatch):
    def complete(*words):
        monkeypatch.setenv("_BENCH_COMPLETE", "complete_bash")
        monkeypatch.setenv("COMP_WORDS", " ".join(["bench", *words]))
        monkeypatch.setenv("COMP_CWORD", str(len(words)))
        monkeypatch.setattr("sys.argv", ["bench"])
        return bench()[1].split()

    return complete


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (["re"], {"resume", "report", "require"}),
        (["run", "qu"], {"quick"}),
        (["run", "--dry"], {"--dry-run"}),
        (["show", "un"], {"unit-1", "unit-2"}),
        (["calibrate", ""], {"unit-1", "unit-2", "by-hand.csv", "runs/"}),
        (["check", "paper", "--bench", "paper"], {"paper-stand"}),
        (["--"], {"--debug", "--quiet", "--version", "--install-completion", "--show-completion", "--help"}),
    ],
)
def test_a_shell_completes(completed, words, offered):
    for name in ("unit-1", "unit-2"):
        (Path("runs") / name).mkdir(parents=True)
        (Path("runs") / name / "run.json").write_text("{}")
    Path("by-hand.csv").touch()
    assert offered == set(completed(*words))


def test_the_script_for_a_shell_is_shown_and_nothing_is_written(bench, monkeypatch):
    monkeypatch.setenv("HOME", str(Path.cwd()))
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "")
    monkeypatch.setattr("typer.completion._get_shell_name", lambda: "bash")
    monkeypatch.setattr("sys.argv", ["bench"])
    printed(bench("--show-completion"), "complete -o default -F")
    assert list(Path().iterdir()) == []


# --- a mistake of the program -----------------------------------------------------------------------


def test_a_mistake_of_the_program_says_in_which_command_and_what_to_do(bench, monkeypatch):
    def lost(folder):
        raise KeyError("x")

    monkeypatch.setattr("bench.services.records.run_summaries", lost)
    err = refused(bench("runs"))
    assert err == (
        "bench: 'bench runs' was stopped by an error of the program (KeyError: 'x'); run it again with --debug "
        "and report what it shows\n"
    )
    assert "Traceback" in bench("runs", "--debug")[2]


def test_no_message_begins_with_unexpected():
    beginning = re.compile(r"""["'](bench: )?unexpected""", re.IGNORECASE)
    for top in ("bench", "drivers", "sim"):
        for path in (ROOT / top).rglob("*.py"):
            assert not beginning.search(path.read_text(encoding="utf-8")), path
    assert not explain(RuntimeError()).lower().startswith("unexpected")


# --- quiet, and progress ----------------------------------------------------------------------------


@pytest.mark.parametrize("where", ["before", "after"])
def test_quiet_leaves_results_and_takes_notes_away(bench, where):
    results = [str(RECORDS / "calibrate.json")] * 2
    said = bench("compare", *results)[1]
    assert "note:" in said
    arguments = ["compare", *results]
    _, out, err = bench(*(["--quiet", *arguments] if where == "before" else [*arguments, "--quiet"]))
    assert err == ""
    assert "note:" not in out
    assert out.splitlines() == [line for line in said.splitlines() if not line.startswith("note:")]
    assert quiet.get() is False


def test_progress_says_how_much_time_is_left():
    clock, console = Clock(), Console(file=io.StringIO(), force_terminal=True, width=100)
    with printing.progress(console, clock):
        for _ in tracked(range(10), "ten parts"):
            clock.sleep(60.0)
            console.print("part")
    out = console.file.getvalue()
    assert "ten parts" in out
    assert "0:05:00" in out  # five of ten, a minute each


def test_progress_is_silent_without_a_terminal_and_when_quiet_is_asked_for():
    for terminal, hushed in ((False, False), (True, True)):
        console = Console(file=io.StringIO(), force_terminal=terminal)
        before = quiet.set(hushed)
        try:
            with printing.progress(console, Clock()):
                assert list(tracked("abc", "letters")) == ["a", "b", "c"]
        finally:
            quiet.reset(before)
        assert console.file.getvalue() == ""


def test_what_is_tracked_is_told_with_its_end():
    told = []
    with heard_by(lambda *one: told.append(one)):
        assert list(tracked(iter("ab"), "two", 2)) == ["a", "b"]
        assert list(tracked(["alone"], "one")) == ["alone"]
    assert list(tracked("ab", "nobody hears")) == ["a", "b"]
    assert told == [("two", 0, 2), ("two", 1, 2), ("two", 2, 2)]


# --- the list of runs -------------------------------------------------------------------------------


def test_the_list_of_runs_shows_verdict_and_a_command_to_copy_at_80_columns(bench):
    import shutil

    long = "calibration-20261101-101500"
    for name, passed in (("one", True), (long, False), ("open", None)):
        shutil.copytree(RECORDS / ("interrupted" if passed is None else "finished"), Path("runs") / name)
        if passed is not None:
            (Path("runs") / name / "verify.json").write_text(json.dumps({"passed": passed}))
    out = bench("runs")[1]
    assert max(map(len, out.splitlines())) <= 80
    assert re.search(r"^one .*simulated .*finished +\d+  PASSED$", out, re.MULTILINE)
    assert re.search(rf"^{long}\n .*finished +\d+  FAILED$", out, re.MULTILINE)
    assert "\n    bench resume open\n" in out
    found = {run["name"]: run["verdict"] for run in json.loads(bench("runs", "--json", "-")[1])["runs"]}
    assert found == {"one": "passed", long: "failed", "open": None}


def test_the_package_runs_as_the_program(handler, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["bench", "check", "--help"])
    with pytest.raises(SystemExit) as end:
        runpy.run_module("bench", run_name="__main__", alter_sys=False)
    assert not end.value.code
    assert "bench check" in capsys.readouterr().out
