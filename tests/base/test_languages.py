"""Languages of pages and prompts: catalogue, plural forms, numbers, templates, answers."""

import re
from pathlib import Path

import pytest
from babel.messages.catalog import Catalog

from bench.base.languages import (
    Entry,
    catalogue,
    known_language,
    language,
    local_number,
    message,
    shown,
    speaking,
    texts_for_scripts,
    translated,
)
from bench.base.template_texts import environment_for
from bench.run.person import in_english, problem_with_answer
from benchmarks import translations
from drivers.person import Prompt, PromptKind


@pytest.fixture
def ukrainian():
    with speaking("uk"):
        yield


def test_a_sentence_that_begins_with_a_number_is_translated_beside_another(ukrainian):
    doubt = "44 °C: 21 °C from the 23 °C set. Is that right?"
    assert translated(f"Answer yes or no, not 'x'. {doubt}") == (
        f"Відповідайте так або ні, а не 'x'. {translated(doubt)}"
    )
    assert "задано" in translated(doubt)


REFUSED = (
    "voltmeter.y: ADDRESS refused the connection; check that the instrument is on and that address and port in "
    "the bench file are right"
)
STANDS = "check that it stands still, and if not, press its emergency stop"


@pytest.mark.parametrize(
    "text",
    [
        "Choose one of untouched, mounted again, not '1'. The block was mounted in installation 1. Has nobody "
        "touched it since? If somebody has, mount it again now and answer 'mounted again'",
        f"failed, tried again: {REFUSED}",
        f"{REFUSED}; 1 reading is kept in RUN; resume with 'bench resume RUN'",
        "head: no reading within 0°00′30″ of 45°00′00″ in 5 attempts (45°00′40″ is 0°00′40″ above the target, "
        "outside the 0°00′30″ allowed: turn the head until it agrees.); check the clamp, the scale and the "
        "procedure's angle, then redo this point",
        "operator: answered no several times to: Mount the block in installation 1, clamp it; do what the "
        "question asks, then resume the run",
        "answered no to: Mount the block in installation 1, clamp it; remove the reason, then start or resume "
        "again",
        "voltmeter.y: ADDRESS was not found, at the command FETC?; check that the instrument is on and its address "
        "in the bench file is right",
        "stopped by SIGTERM; 1 reading is kept in RUN; resume with 'bench resume RUN'",
        "chamber: it shows 90 °C, which is not plausible (-60 to 85 °C).",
        f"head: its stop is not confirmed; {STANDS}. Cause: its driver failed with OSError: 5",
        "still to do: chamber: is still conditioning at 25 °C: switch it off by hand. Cause: ADDRESS did not "
        f"answer MON? within 3 s\nstill to do: head: {STANDS}. Cause: its driver failed with OSError: 5",
        "voltmeter.x: the signal of channel x overloads the 10 V range; choose a higher range in the procedure, "
        "or check the wiring and power of the block",
        "head: it stalled at 5°00′00″, sent to 9°00′00″: no progress in 5 s; check the load and that nothing "
        "blocks the head, then repeat this step",
        "redo is not possible: no step is running yet",
        "voltmeter.y: ADDRESS closed the connection at the command FETC?, after '+1'; check that the "
        "instrument is on and nobody else uses it, then repeat this step",
    ],
)
def test_what_a_halted_run_says_is_translated_clause_by_clause(ukrainian, text):
    assert not re.findall(
        "[a-z]{3,}", translated(text).replace("«bench resume RUN»", "").replace("OSError", "")
    )


@pytest.mark.parametrize("name", ["2026.12", "head"])
def test_a_command_and_a_path_to_type_stay_as_they_are(ukrainian, name):
    told = translated(f"interrupted; 7 readings are kept in {name}; resume with 'bench resume {name}'")
    assert told == f"перервано; 7 показів збережено в {name}; продовжте командою «bench resume {name}»"
    assert translated(f"Use the model: bench calibrate {name} --model {name}").endswith(
        f"bench calibrate {name} --model {name}"
    )


def test_the_number_in_a_clause_chooses_the_plural(ukrainian):
    assert translated("interrupted; 1 reading is kept in RUN") == "перервано; 1 показ збережено в RUN"
    assert translated("interrupted; 7 readings are kept in RUN") == "перервано; 7 показів збережено в RUN"


def test_english_texts_come_back_byte_for_byte():
    text = message("✓ Verification passed, 0.12 V")
    assert translated(text) is text
    assert shown(text) is text


@pytest.mark.slow
def test_every_text_has_its_translation():
    assert translations.main([]) == 0


def test_a_new_text_without_translation_is_told_with_its_file(tmp_path):
    module = tmp_path / "new.py"
    module.write_text(
        "message(f\"{n} screw{'' if n == 1 else 's'} too loose\")\nmessage(f'{a} of {b!r:>9} screws')\n"
        "Refusal(404, f'{name} has no report')\nRefusal(400, str(error))\n"
    )
    found = {entry: ["bench/new.py"] for entry in translations.entries_of(module)}
    assert list(found) == [
        Entry("{0} screw too loose", "{0} screws too loose"), Entry("{0} of {1} screws"), Entry("{0} has no report")
    ]  # fmt: skip
    told = list(translations.problems(Catalog(locale="uk"), found, "uk"))
    assert told == [f"uk: {entry.english!r} (bench/new.py) has no translation" for entry in found]


def test_a_question_that_is_not_marked_is_told():
    source = """
Prompt(key, PromptKind.CONFIRM, "Tap the block")
Prompt(id=key, kind=PromptKind.CONFIRM, text=f"{trouble} {task}")
"""
    assert [told.partition(":")[0] for told in translations.unmarked(source, "a.py")] == ["a.py, line 2"]
    assert not list(translations.all_unmarked())


def test_a_translation_with_another_blank_and_one_that_nothing_uses_are_told():
    told = Catalog(locale="uk")
    told.add("{0} V", "{1} V")
    told.add("old", "старе")
    first, second = translations.problems(told, {Entry("{0} V"): ["a.py"]}, "uk")
    assert "other blanks" in first
    assert "used nowhere" in second


@pytest.mark.parametrize(
    ("count", "word"),
    [(1, "точка"), (2, "точки"), (5, "точок"), (11, "точок"), (21, "точка"), (22, "точки")],
)
def test_plural_forms(ukrainian, count, word):
    points = f"next: {count} point{'' if count == 1 else 's'} in installation 2, 5 min"
    assert translated(points) == f"далі: {count} {word} у встановленні 2, 5 min"


@pytest.mark.parametrize(
    ("english", "told"),
    [
        ("−2.177071(81) V/g", "−2,177071(81) V/g"),
        ("22.8 … 23.1 °C ± 0.2 °C (k = 2)", "22,8 … 23,1 °C ± 0,2 °C (k = 2)"),
        ("9.8105 m/s² ± 0.0010 m/s² (k = 2)", "9,8105 m/s² ± 0,0010 m/s² (k = 2)"),
        ("numpy 2.4.6", "numpy 2.4.6"),
        ("192.0.2.22", "192.0.2.22"),
        ("run-3.5", "run-3.5"),
        ("JCGM 106:2012, 8.3", "JCGM 106:2012, 8.3"),
    ],
)
def test_numbers_have_a_decimal_comma_and_names_stay(ukrainian, english, told):
    assert local_number(english) == told
    assert shown(english) == told


def test_filled_copies_are_found_in_one_another(ukrainian):
    trouble = (
        "45°00′40″ is 0°00′40″ above the target, outside the 0°00′30″ allowed: turn the head until it agrees."
    )
    task = (
        "Turn the head to 45°00′00″: approach with the angle rising, from below; clamp; read again and type"
    )
    task += " the angle read."
    told = translated(f"{trouble} {task}")
    assert not re.search("[a-z]", told)
    assert told.count("45°00′") == 2


@pytest.mark.parametrize(
    "text", ["triaxial block of the paper 1", "One pass in ten, then none", "Olena and Taras went"]
)
def test_what_people_wrote_stays(ukrainian, text):
    assert translated(text) == text


def test_the_language_is_that_of_the_environment(monkeypatch):
    monkeypatch.setenv("BENCH_LANGUAGE", "uk_UA.UTF-8")
    assert language() == "uk"
    with speaking("en"):
        assert language() == "en"
    monkeypatch.setenv("BENCH_LANGUAGE", "fr")
    assert language() == "en"
    assert known_language("xx") == ""
    with pytest.raises(ValueError, match="choose one of en, uk"), speaking("xx"):
        pass


TEMPLATE = (
    '<html lang="en"><p>Rule: {{ a }} – {{ b }}.</p>{# note #}<td data-label="unit">{{ c }}</td>'
    "<p><code>{{ c }}</code></p><option>{{ c }}</option><pre>Rule: {{ c }}</pre></html>"
)


def test_texts_of_templates_are_found_without_marks():
    assert [entry.english for entry in translations.texts_of_template(TEMPLATE)] == [
        "Rule: {0} – {1}.",
        "unit",
    ]


def test_translated_templates_escape_values_and_leave_names(ukrainian):
    template = environment_for("uk", "bench.panel").from_string(TEMPLATE)
    told = template.render(a="<i>", b="0.5 V", c="0.5")
    assert told.startswith('<html lang="uk"><p>Правило: &lt;i&gt; – 0,5 V.</p>')
    assert '<td data-label="виріб">0,5</td>' in told
    assert told.endswith("<p><code>0.5</code></p><option>0.5</option><pre>Rule: 0.5</pre></html>")


@pytest.mark.parametrize("mark", ["{{- m('12.5') }}", "{{ m('12.5') -}}", "{{- -2.5 }}"])
def test_white_space_control_stays_in_a_translated_template(ukrainian, mark):
    environment = environment_for("uk", "bench.panel")
    source = f"{{% macro m(x) %}}{{{{ x }}}}{{% endmacro %}}<nav>a<i>b</i> {mark} </nav>"
    told = environment.from_string(source).render()
    plain = environment_for("en", "bench.panel").from_string(source).render()
    assert told == plain.replace("2.5", "2,5")


def test_english_templates_are_rendered_as_they_stand():
    plain = environment_for("en", "bench.panel").from_string(TEMPLATE).render(a="<i>", b="0.5 V", c="0.5")
    assert plain.startswith('<html lang="en"><p>Rule: &lt;i&gt; – 0.5 V.</p>')


@pytest.mark.parametrize(
    ("kind", "choices", "typed", "told"),
    [
        (PromptKind.CONFIRM, (), "Так", "yes"),
        (PromptKind.CONFIRM, (), "ні", "no"),
        (PromptKind.CONFIRM, (), "yes", "yes"),
        (PromptKind.CHOOSE, ("redo point", "go on REASON"), "повторити точку", "redo point"),
        (PromptKind.CHOOSE, ("redo point", "go on REASON"), "продовжити кабель Ослаб", "go on кабель Ослаб"),
        (PromptKind.CHOOSE, ("redo point",), "щось інше", "щось інше"),
        (PromptKind.NUMBER, (), "23,5", "23,5"),
    ],
)
def test_answers_are_understood_in_the_language_of_the_prompt(ukrainian, kind, choices, typed, told):
    prompt = Prompt(id="1", kind=kind, text="?", choices=choices)
    assert in_english(prompt, typed) == told


@pytest.mark.parametrize(
    ("action", "unit"),
    [
        ({"do": "read_temperature"}, "°C"),
        ({"do": "read_level", "division_rad": 1e-5}, ""),
        ({"do": "read_supply"}, "A"),
        ({"do": "read_supply"}, "V"),
    ],
)
def test_what_is_no_number_is_refused_in_the_language_of_the_page(ukrainian, action, unit):
    prompt = Prompt("1", PromptKind.NUMBER, "", unit=unit, action=action)
    problem = problem_with_answer(prompt, "abc")
    assert not problem.endswith(".")
    assert translated(problem).startswith("Це не ")


def test_scripts_get_texts_that_a_browser_reads():
    told = texts_for_scripts("uk")
    assert told.startswith("window.BENCH_TEXTS = {")
    assert "</script" not in told
    assert '["Take control", "", ["Узяти керування"]]' in told


def test_catalogue_is_sorted_by_what_tells_a_text_apart(ukrainian):
    begun = "begun: read installation V, pass 1, point 4 at 315°: 10 samples of 10 power-line cycles"
    assert (
        translated(begun)
        == "розпочато: зняти показ (встановлення V, прохід 1, точка 4 за 315°): відліків 10 по 10 періодів мережі"
    )
    assert catalogue("uk").decimal == ","
    assert Path(translations.CATALOGUES / "uk.po").is_file()


def test_a_name_before_a_colon_stays_unless_it_is_an_instrument():
    with speaking("uk"):
        assert translated("none: the run has no seal").startswith("none: ")
        assert translated("none: no run of that name in runs").startswith("none: ")
        assert translated("voltmeter.x: the run has no seal").startswith("вольтметр x: ")


def test_the_bias_by_is_no_word():
    with speaking("uk"):
        assert translated("bx +19.1 u, by +17.3 u") == "bx +19,1 u, by +17,3 u"


@pytest.mark.parametrize(
    "english",
    [
        "repeats (SIMULATED): MEASURED; no calibration from it: 8 readings do not determine Kxy: the acceleration "
        "along y hardly changes; add the other installation or further angles to the procedure",
        "first (SIMULATED): NOT ACCEPTED: worst |Δg| = 96.3 µg ± 183.6 µg (U, k = 2), limit 300 µg",
        "verification points: NOT ACCEPTED: worst |Δg| = 96.3 µg ± 183.6 µg (U, k = 2), limit 300 µg",
        "run repeats starts on simulated instruments: repeatability, 131 steps, recorded in runs/repeats",
        "rule: guarded (w = 0.5 U), TUR 0.0051",
        "up to 14.2 µV for 10 µV",
        "x standard deviation",
        "at most 0.41 s, a tenth of a reading",
        "enough: combined u of Kxy is 37.7 µV/g, goal 100 µV/g",
        "No such option: --oops; did you mean --out? See 'bench run --help-all'",
        "assumed zero in channel x: 1 µg of K0p changes K0 +0.07, K1 +2.08",
        "step 4: the procedure levels the platform, but the bench file has no level; add one under instruments, or "
        "remove 'level' in a copy of the procedure",
    ],
)
def test_results_and_refusals_hold_no_english_beside_names(english):
    told = catalogue("uk").translate(english)
    assert told != english
    kept = {"first", "repeats", "repeatability", "runs", "bench", "run", "help", "all"}
    kept |= {"out", "oops", "level", "instruments"}
    assert set(re.findall(r"[a-z]{3,}", told)) <= kept | {"alpha"}


def test_the_name_of_a_run_stays_in_a_sentence_on_the_run():
    told = catalogue("uk").translate(
        "run repeats starts on simulated instruments: quick, 4 steps, recorded in r"
    )
    assert told.startswith("сеанс repeats ")


def test_the_verdict_of_a_catalogued_run_is_no_round_through_the_points():
    from bench.results.catalogue import _shown

    with speaking("uk"):
        assert _shown("verdict", "pass") == "відповідає"
