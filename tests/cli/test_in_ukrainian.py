"""A run in Ukrainian, as its operator sees it: faults, a wrong answer, a stop, the resumption, the verdict."""

import io
from pathlib import Path

import pytest

from bench.base.languages import speaking, translated
from bench.base.tables import as_text, table
from bench.calibration.mistakes import in_another_unit
from bench.cli.app import main
from bench.results.interlaboratory import DriftPart, drift_words
from bench.results.parts import ValuePart
from bench.run.folder import Run
from bench.run.person import OpenPrompt
from tests.support.answering import answer_to
from tests.support.in_ukrainian import english_in
from tests.support.pages import ROOT

FAULTS = ("drop", "garble", "refuse, seconds: 4000", "overload", "error")
QUICK = ("run", "quick", "--dry-run", "--name", "one")


class Operator(io.TextIOBase):
    """Standard input from an operator who answers the open question of the run, until it is the question `stops`.

    The first answer to each of the first questions is not understood.
    """

    def __init__(self, stops=None):
        self.questions, self.stops, self.events = 0, stops, Path("runs/one/events.jsonl")
        self.confused = {"", "what", ":foo"}

    def readline(self, size=-1):
        self.questions += 1
        if self.questions == self.stops:
            return ""
        if self.confused and self.questions > 2:
            return f"{self.confused.pop()}\n"
        asked = OpenPrompt()
        for event in Run(self.events.parent).history.events:
            asked.take(event)
        return f"{answer_to(asked.prompt.prompt)}\n"


@pytest.fixture
def at_the_bench(capsys, empty_folder, monkeypatch):
    """Return what carries out a command in Ukrainian, asserts that it prints no English, and returns its output."""
    monkeypatch.setenv("BENCH_LANGUAGE", "uk")

    def call(*arguments, status, operator=None):
        monkeypatch.setattr("sys.stdin", operator or io.StringIO())
        with pytest.raises(SystemExit) as ended:
            main(list(arguments))
        said = "".join(capsys.readouterr())
        assert ended.value.code == status, said
        assert english_in(said) == [], said
        return said

    return call


def test_english_is_found_beside_what_stays():
    assert english_in("сеанс зупинено; the head stopped; «bench resume a run»") == ["the head"]
    assert english_in("межа 300 µg, U (k = 2), gls; далі: bench run calibration --bench my file") == []


@pytest.mark.slow(seconds=2)
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_told_in_ukrainian(at_the_bench, fault):
    bench = (ROOT / "config" / "paper-stand.yaml").read_text(encoding="utf-8")
    faults = f"  faults: [{{instrument: voltmeter.y, matching: FETC, probability: 1.0, fault: {fault}}}]\n"
    Path("faulty.yaml").write_text(bench + faults, encoding="utf-8")
    assert "вольтметр y: " in at_the_bench(*QUICK, "--bench", "faulty.yaml", status=2)


@pytest.mark.slow(seconds=10)
def test_a_run_with_a_stop_and_its_verdict_is_ukrainian_throughout(at_the_bench):
    at_the_bench("run", "quik", "--dry-run", status=2)
    at_the_bench(*QUICK, "--bench", "none.yaml", status=2)
    at_the_bench("run", "quick", status=2)
    assert "введення скінчилося" in at_the_bench(
        *QUICK, "--answers", "terminal", status=2, operator=Operator(9)
    )
    assert "ПРОЙДЕНО" in at_the_bench("resume", "one", status=0, operator=Operator())
    assert "ПРОЙДЕНО" in at_the_bench("runs", status=0)
    for command in (
        ("resume", "one"),
        ("abort", "one"),
        ("control", "one", "stop"),
        ("resume", "two"),
        QUICK,
    ):
        at_the_bench(*command, status=2)


def test_mistakes_in_files_are_told_in_ukrainian_and_their_keys_stay(at_the_bench):
    bench = (ROOT / "config" / "paper-stand.yaml").read_text(encoding="utf-8")
    Path("wrong.yaml").write_text(
        bench.replace("gravity:", "gravty:").replace("3e-4 g", "quick"), encoding="utf-8"
    )
    said = at_the_bench("run", "quick", "--dry-run", "--bench", "wrong.yaml", status=2)
    assert "невідомий ключ «gravty»; може, «gravity»?" in said
    assert "очікувалося прискорення" in said
    Path("wrong.csv").write_text(
        "installation,pass,point,angle_deg,ux_v,uy_v\n1,1,1,0,1,2\n", encoding="utf-8"
    )
    assert "у заголовку немає uz_v; очікувалося щонайменше installation,pass" in at_the_bench(
        "calibrate", "wrong.csv", status=2
    )


@pytest.mark.slow(seconds=8)
def test_plans_and_evaluations_are_ukrainian_throughout(at_the_bench):
    bench = (ROOT / "config" / "paper-stand.yaml").read_text(encoding="utf-8")
    section = "\ncheck_block: {serial: CHECK-1, rule: warn, baseline: 1}\n"
    Path("my.yaml").write_text(
        bench.replace("triaxial block of the paper", "B-1") + section, encoding="utf-8"
    )
    for seed in ("1", "2", "3"):
        at_the_bench(*QUICK[:-1], seed, "--seed", seed, "--bench", "my.yaml", "--unit", "CHECK-1", status=0)
    assert "\nостанній хеш: " in at_the_bench("show", "1", "--verify", status=0)
    said = at_the_bench("chart", "runs", status=0)
    assert "у базі 1 сеанс: для такої кількості межі широкі" in said
    assert "під контролем" in said
    assert "того самого дня вимірювали ті самі вольтметри" in at_the_bench("compare", "1", "2", status=0)
    assert "спільний для всіх встановлень поворот блока" in at_the_bench("calibrate", "1", status=0)
    assert "точка перевірки" in at_the_bench("verify", "1", status=0)
    assert "один прохід у встановленні 1T90, як у методиці «remount-90»" in at_the_bench(
        "check", "quick", "--bench", "my.yaml", status=0
    )
    said = at_the_bench("budget", "quick", "--bench", "my.yaml", "--trials", "0", status=0)
    assert "прийнято за правдоподібними значеннями" in said
    assert "примітка: gravity: коефіцієнти на місцеве g" in said
    assert "контрольний блок: 3, " in at_the_bench(
        "run", "quick", "--dry-run", "--name", "unit", "--bench", "my.yaml", "--check-block", status=0
    )


def test_a_heading_is_translated_where_a_key_of_the_same_name_stays():
    with speaking("uk"):
        assert "крок" in as_text(lambda out: out.print(table("step")))
        assert translated("baseline: too long") == "baseline: too long"


@pytest.mark.parametrize(
    ("english", "ukrainian"),
    [
        (
            in_another_unit("xyz", "pass 2", "V", 3),
            "схоже, усі сигнали у проході 2 виражені в mV, а не в V: значення у 1000 разів завеликі; для "
            "порівняння взято решту",
        ),
        (
            in_another_unit("xy", "installation 1, pass 2", "V", -3),
            "схоже, сигнали каналу x, y у встановленні 1, прохід 2 виражені не в тій одиниці, що зазначена: "
            "значення у 1000 разів замалі; для порівняння взято решту",
        ),
        (
            "channel x: scale factor 2.18 V/g, but the bench file announces -2.18 V/g; perhaps the signals "
            "are in mV, not in V",
            "канал x: масштабний коефіцієнт 2,18 V/g, але у файлі стенда зазначено -2,18 V/g; можливо, "
            "сигнали в mV, а не в V",
        ),
    ],
)
def test_a_mistake_in_the_signals_is_told_in_ukrainian(english, ukrainian):
    with speaking("uk"):
        assert translated(english) == ukrainian


def test_the_name_of_a_run_stays_where_it_is_a_word_of_the_catalogue(at_the_bench, capsys):
    assert translated_in_ukrainian("none") == "немає"
    at_the_bench("run", "quick", "--dry-run", "--name", "none", status=0)
    assert at_the_bench("verify", "none", status=0).splitlines()[-1].startswith("none: ПРОЙДЕНО: ")
    assert (
        at_the_bench("diagnose", "none", status=0).splitlines()[-1].startswith("none: НІЧОГО НЕ ЗНАЙДЕНО: ")
    )
    assert "файл стенда для none: " in at_the_bench("compare", "none", "none", status=0)
    assert "Калібрування none: gls" in at_the_bench("calibrate", "none", status=0)
    with pytest.raises(SystemExit):
        main(["show", "none"])  # it shows the English name of the block
    shown = capsys.readouterr().out
    assert shown.startswith("назва: none\nстворено: ")
    assert "пробний сеанс: так" in shown
    assert "методика: " in shown
    assert "закріпити блок у встановленні 1" in shown


@pytest.mark.parametrize(
    "english",
    [
        "none: not issued; missing: results before the adjustment (7.8.4.1 d): the run 'as_found', after, ended on "
        "2026-12-01, after the calibration began on 2026-12-01; a day of issue (7.8.2.1 j) after the calibration: "
        "2026-11-30 is before 2026-12-01",
        "after: not issued; missing: results before the adjustment (7.8.4.1 d): the run 'as_found', none, is real, "
        "the calibrated one is not; the day of issue (7.8.2.1 j): this computer's clock shows 2026-11-30, but "
        "SIM-2026-0001 was issued on 2026-12-01 (set the clock or, if that day is wrong, revoke SIM-2026-0001)",
        "note: Q7FA: of simulated instruments",
        "note: Q7FA: not accepted by its laboratory: the readings contradict the model",
        "none: U = K a + U0, a the specific force in local g (9.81 m/s², +1 g on an upward axis), U in V, block "
        "at 23.0 °C",
    ],
)
def test_certificates_and_kits_speak_ukrainian_and_names_of_runs_stay(english):
    """A kit's note read "приладів: of simulated"; a run "after" was called "після"."""
    said = translated_in_ukrainian(english)
    names = [name for name in ("none", "after") if f"{name}:" in english or f"{name}," in english]
    assert all(name in said for name in names)
    for word in (*names, "as_found", "note"):
        said = said.replace(word, "")
    assert english_in(said) == []
    assert "приладів:" not in said


@pytest.mark.parametrize("off", [True, False])
def test_what_changed_in_a_kit_is_told_in_ukrainian(off):
    drift = DriftPart(
        first="Q7FA", last="9HLM", by="calibration", p=0.5, p_all_looks=0.5, changed=off,
        changes={"bz": ValuePart(value=5e-5, u=2e-5)},
    )  # fmt: skip
    with speaking("uk"):
        said = translated(drift_words(drift, "V"))
    assert said.startswith(
        "ЗМІНА від Q7FA до 9HLM (калібрування): bz на " if off else "без змін від Q7FA до 9HLM"
    )
    assert english_in(said) == []


def translated_in_ukrainian(text):
    with speaking("uk"):
        return translated(text)


@pytest.mark.parametrize(
    ("english", "ukrainian"),
    [
        ("wait 2 h: soak at 23 °C", "чекати 2 h: витримка за 23 °C"),
        ("installation 2 (series 8), pass 1, point 3", "встановлення 2 (серія 8), прохід 1, точка 3"),
        (
            "    5  40 min  mount the block in installation 1",
            "    5  40 min  закріпити блок у встановленні 1",
        ),
    ],
)
def test_each_line_of_steps_and_events_is_wholly_ukrainian(english, ukrainian):
    assert translated_in_ukrainian(english) == ukrainian
