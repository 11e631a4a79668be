"""The names of `import bench`: there, lazy, and not hidden by a room of the same name."""

import ast
import json
import pkgutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import bench
from bench.cli.commands import COMMANDS, load_command

HEAVY = {"numpy", "scipy", "pydantic", "matplotlib", "pandas", "rich", "typer"}


def modules_after(statement: str) -> set[str]:
    """Return what a fresh interpreter has imported after a statement."""
    program = f"import json, sys\n{statement}\nprint(json.dumps(sorted(sys.modules)), file=sys.stderr)"
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, check=True)  # noqa: S603 - our own words
    return set(json.loads(done.stderr.splitlines()[-1]))


def test_importing_bench_imports_nothing_heavy():
    assert not HEAVY & modules_after("import bench")
    assert "numpy" in modules_after("import bench; bench.calibrate")


def test_the_help_imports_nothing_heavy():
    call = "from bench.cli.app import main\ntry:\n    main(['--help'])\nexcept SystemExit:\n    pass"
    loaded = modules_after(call)
    assert "bench.cli.commands" in loaded
    assert not HEAVY - {"typer"} & loaded


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_no_command_imports_anything_heavy_before_it_runs(name):
    loaded = modules_after(f"from bench.cli.commands import load_command; load_command({name!r})")
    assert not HEAVY - {"typer"} & loaded


def test_the_list_of_commands_says_what_each_says_itself():
    for name, line in COMMANDS.items():
        command = load_command(name)
        assert (command.name, command.help.splitlines()[0]) == (name, line)


def test_every_public_name_is_what_it_was_when_every_module_is_imported():
    before = {name: getattr(bench, name) for name in bench.__all__}
    for module in pkgutil.walk_packages(bench.__path__, "bench."):
        import_module(module.name)
    assert {name: getattr(bench, name) for name in bench.__all__} == before
    assert dir(bench) == sorted(bench.__all__)
    assert all(value.__doc__ for value in before.values())


def test_a_type_checker_is_told_the_same_names_from_the_same_modules():
    tree = ast.parse(Path(bench.__file__).read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    told = [(one.module, name) for one in block.body if one.module != "typing" for name in one.names]
    assert all(name.asname == name.name for _, name in told)
    assert sorted((home, name.name) for home, name in told) == sorted(
        (home, name) for home, names in bench._HOMES.items() for name in names
    )


def test_an_unknown_name_is_no_attribute():
    with pytest.raises(AttributeError, match="no attribute 'calibration_of'"):
        bench.calibration_of  # noqa: B018 - the look-up is what is tested
