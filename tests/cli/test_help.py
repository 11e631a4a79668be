"""The help: common commands on one screen, common options in 25 lines, everything with --all and --help-all."""

import pytest

from bench.cli.commands import COMMANDS, COMMON, HEADINGS, MORE
from docs.generators.commands import commands
from tests.support.commands import printed, refused

SCREEN = 25
EVERY = sorted(commands())


@pytest.fixture
def narrow(bench, monkeypatch):
    """The commands in a terminal of 80 columns."""
    monkeypatch.setenv("COLUMNS", "80")
    return bench


def test_the_common_commands_are_on_one_screen_one_line_each(narrow):
    out = printed(narrow("--help"), "more: bench help --all")
    lines = out.splitlines()
    assert len(lines) <= SCREEN
    assert max(map(len, lines)) <= 80
    names = [name for names in COMMON.values() for name in names]
    assert len(names) == len(set(names)) == 15
    for name in names:
        assert f"  {name:11}  {COMMANDS[name]}" in lines
    assert narrow("help") == narrow("--help") == narrow()


def test_all_commands_are_listed_under_a_heading_with_the_whole_summary(narrow):
    out = printed(narrow("help", "--all"))
    assert out == printed(narrow("--help-all"))
    assert max(map(len, out.splitlines())) <= 80
    words = " ".join(out.split())
    for name, line in COMMANDS.items():
        assert f"{name} {line}" in words, name
    assert [line for line in HEADINGS.values() if f"\n{line}:\n" in out] == list(HEADINGS.values())
    assert "--install-completion" in out


@pytest.mark.parametrize("name", COMMANDS)
def test_a_summary_has_at_most_20_words(name):
    assert len(COMMANDS[name].split()) <= 20


@pytest.mark.parametrize("name", EVERY)
def test_the_help_of_a_command_is_short_and_the_whole_help_has_every_option(narrow, name):
    short = printed(narrow(*name.split(), "--help"), "Example: bench ")
    whole = printed(narrow(*name.split(), "--help-all"), "Example: bench ")
    assert len(short.splitlines()) <= SCREEN
    assert (f"{MORE}:" in whole) == ("--help-all" in short) == (len(whole) > len(short))
    assert f"{MORE}:" not in short
    for option in commands()[name].params:
        for flag in option.opts if option.param_type_name == "option" else ():
            assert f"  {flag}" in whole, flag


@pytest.mark.parametrize("name", ["run", "fleet effects", "certificate issue"])
def test_the_help_command_shows_the_same(narrow, name):
    for asked, more in (("--help", ()), ("--help-all", ("--all",))):
        assert printed(narrow("help", *name.split(), *more)) == printed(
            narrow(*name.split(), asked), "Example: bench "
        )


@pytest.mark.parametrize("name", ["batch", "catalogue", "certificate", "fleet"])
def test_a_group_lists_its_commands_with_whole_summaries(narrow, name):
    out = printed(narrow(name, "--help"), "Example: bench ")
    assert len(out.splitlines()) <= SCREEN
    words = " ".join(out.split())
    for whole, command in commands().items():
        group, _, alone = whole.partition(" ")
        if group == name:
            assert f"{alone} {command.help.splitlines()[0]}" in words
    assert out == printed(narrow(name, "--help-all")) == printed(narrow("help", name))


@pytest.mark.parametrize("words", [["brew"], ["run", "brew"], ["fleet", "brew"]])
def test_the_help_of_an_unknown_command_is_refused(bench, words):
    refused(bench("help", *words), f"unknown command '{' '.join(words)}'; 'bench help --all' lists all")


# --- a procedure is an argument everywhere ----------------------------------------------------------


@pytest.fixture
def asked(monkeypatch):
    """Hold the requests of `budget` and `require`, which are not carried out."""
    held = []

    def hold(request):
        held.append(request.procedure)
        raise ValueError

    monkeypatch.setattr("bench.services.planning.budget_of", hold)
    monkeypatch.setattr("bench.services.planning.requirements", hold)
    return held


@pytest.mark.parametrize("command", [["budget"], ["require", "--accuracy", "1e-4"]])
def test_a_procedure_is_an_argument_and_the_older_option_is_accepted(bench, asked, command):
    for words in (["paper"], ["--procedure", "paper"], ["paper", "--procedure", "paper"], []):
        bench(*command, *words)
    assert asked == ["paper", "paper", "paper", "calibration"]
    refused(bench(*command, "quick", "--procedure", "paper"), "the procedure is quick already")
