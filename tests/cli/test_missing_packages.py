"""A package of an extra that is not installed: one line with the command that installs it, from every command."""

import re
import sys
import tomllib
from pathlib import Path

import pytest

from bench.base.computing import EXTRAS, missing
from tests.support.certificates import ORDER, copy_run, write_files
from tests.support.commands import refused
from tests.support.pages import ROOT

DESK = ("--laboratory", "laboratory.yaml", "--order", "order.yaml", "--authorised-by", "A. Example")
PDF, XML = "certificate.pdf", "certificate.xml"
BATCH = ("batch", "calibrate", "--over", "runs/*", "--out", "out")
IMPORTED = re.compile(r"^ *(?:from|import) (\w+)(?:[.\w]* import .*|[.\w]*(?: as \w+)?(?: +#.*)?)$", re.M)
HIDDEN = [
    ("cryptography", "signing", ("key", "lab.pem")),
    ("cryptography", "certificate", ("key", "lab.pem", "--certificate", "Laboratory")),
    ("starlette", "panel", ("panel",)),
    ("uvicorn", "panel", ("panel", "token", "anna")),
    pytest.param("lxml", "certificate", ("certificate", "finished", *DESK), marks=pytest.mark.slow),
    ("typst", "certificate", ("certificate", "finished", "--draft")),
    ("pikepdf", "certificate", ("certificate", "read", PDF)),
    ("lxml", "certificate", ("certificate", "read", XML)),
    ("signxml", "certificate", ("certificate", "verify", XML)),
    ("pyhanko", "certificate", ("certificate", "verify", PDF)),
    ("pkcs11", "pkcs11", ("certificate", "finished", *DESK, "--key", "pkcs11:token=lab?module-path=/no.so")),
    ("sqlalchemy", "catalogue", ("catalogue", "sync", "runs")),
    ("sqlalchemy", "catalogue", ("catalogue", "ask", "meter=MY1")),
    ("sqlalchemy", "catalogue", ("catalogue", "unit", "7")),
    ("sqlalchemy", "catalogue", ("catalogue", "due")),
    ("sqlalchemy", "catalogue", ("catalogue", "keys")),
    ("sqlalchemy", "catalogue", ("catalogue", "sync", "runs", "--catalogue", "new.sqlite")),
    ("psycopg", "postgresql", ("catalogue", "sync", "runs", "--catalogue", "postgresql://127.0.0.1/lab")),
    ("pyarrow", "catalogue", BATCH),
    ("duckdb", "catalogue", BATCH),
    pytest.param(
        "distributed", "cluster", (*BATCH, "--scheduler", "tcp://127.0.0.1:1"), marks=pytest.mark.slow
    ),
]


@pytest.fixture
def hide():
    """Make a package one that is not installed, for modules of ours that have imported it before, too."""
    before, packages = {}, []

    def hidden(package):
        packages.append(package)
        before.update({name: sys.modules.pop(name) for name in beneath(package)})
        before[package] = sys.modules.get(package)
        sys.modules[package] = None

    yield hidden
    for name in [name for package in packages for name in beneath(package)]:
        sys.modules.pop(name, None)  # what was imported without the package
    for name, module in before.items():
        sys.modules.pop(name, None)
        if module is not None:
            sys.modules[name] = module
    for name in [name for name in before if name.startswith("bench.")]:
        parent, _, child = name.rpartition(".")
        setattr(sys.modules[parent], child, before[name])


def beneath(package):
    tops = ("bench.certificate", "bench.catalogue", "bench.batch", "bench.panel", package)
    return [name for name in sys.modules if name.startswith(tuple(f"{top}." for top in tops))]


@pytest.mark.parametrize(("package", "extra", "words"), HIDDEN, ids=str)
def test_a_command_names_the_package_and_what_installs_it(bench, hide, package, extra, words):
    Path("runs").mkdir()
    copy_run(Path("runs"))
    write_files(Path(), order=ORDER)
    Path(XML).write_text("<a/>", encoding="utf-8")
    Path(PDF).write_bytes(b"%PDF-1.7\n")
    hide(package)
    err = refused(bench(*words))
    assert err == f"bench: the package {package} is not installed: pip install 'triaxial-bench[{extra}]'\n"


def test_a_seal_stands_without_the_package_of_its_time_stamp(bench, hide):
    Path("runs").mkdir()
    copy_run(Path("runs"))
    hide("rfc3161_client")
    status, _, err = bench("seal", "finished", "--timestamp", "http://127.0.0.1:1")
    assert status == 1
    assert "the package rfc3161_client is not installed: pip install 'triaxial-bench[signing]'" in err


def test_every_package_that_is_imported_comes_with_the_program_or_is_known_with_its_extra():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert set(EXTRAS) <= set(project["optional-dependencies"])
    brought = (
        "numpy babel scipy yaml pydantic pint typer rich matplotlib jinja2 openpyxl packaging pyvisa serial "
    )
    brought += "platformdirs filelock markupsafe pydantic_core bench drivers sim"
    known = {*brought.split()} | {package for packages in EXTRAS.values() for package in packages}
    for path in (p for top in ("bench", "drivers", "sim") for p in (ROOT / top).rglob("*.py")):
        unknown = set(IMPORTED.findall(path.read_text(encoding="utf-8"))) - known - sys.stdlib_module_names
        assert not unknown, (path, unknown)


def test_a_package_that_no_extra_has_is_no_matter_of_installing():
    assert missing(ModuleNotFoundError(name="h2")) == ""
    assert missing(ValueError("pandas")) == ""
