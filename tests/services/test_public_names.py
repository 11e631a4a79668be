"""The names of `import bench`: there, lazy, and not hidden by a room of the same name."""

import ast
import pkgutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import bench
from bench.cli.commands import COMMANDS, load_command

HEAVY = ("numpy", "scipy", "pydantic", "matplotlib", "pandas", "rich", "importlib.metadata")
IMPORTS = f"""
import sys

def light(what):
    found = [name for name in {HEAVY} if name in sys.modules]
    assert not found, (what, found)

import bench
light("import bench")
assert "typer" not in sys.modules
from bench.cli.app import main
try:
    main(["--help"])
except SystemExit:
    light("the help")
from bench.cli.commands import COMMANDS, load_command
for name in COMMANDS:
    load_command(name)
    light(name)
"""


@pytest.mark.slow
def test_neither_the_package_nor_the_help_nor_a_command_that_has_not_begun_imports_anything_heavy():
    """What is imported is told by a fresh interpreter, one step after the other."""
    command = [sys.executable, "-c", IMPORTS]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)  # noqa: S603 - our own words


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
