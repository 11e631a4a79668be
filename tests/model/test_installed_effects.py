"""Effects of installed distributions, by entry points."""

import sys
from types import SimpleNamespace

import pytest

from bench.model.effects import CATALOGUE, GROUP, Catalogue

MODULE = '''
from bench.model.effects.base import BlockEffect, Parameter

class Fourth(BlockEffect):
    """K4 a^4."""
    name = "fourth"
    parameters = (Parameter("K4", "ug/g^4", 1e-6, 20e-6, per_channel=True),)
    sentence = "the output has a part with the fourth power"
    shown_by = "more angles"

    def addition(self, values, seen):
        return seen.scale * values["K4"] * seen.signal**4
'''


@pytest.fixture
def site(tmp_path, monkeypatch):
    (tmp_path / "my_bench_effects.py").write_text(MODULE)
    about = tmp_path / "my_bench_effects-1.2.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: my-bench-effects\nVersion: 1.2\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield about / "entry_points.txt"
    sys.modules.pop("my_bench_effects", None)


@pytest.mark.parametrize("entry", ["my_bench_effects", "my_bench_effects:Fourth"])
def test_a_distribution_brings_an_effect(site, entry):
    site.write_text(f"[{GROUP}]\nfourth = {entry}\n")
    catalogue = Catalogue(CATALOGUE.values())
    assert list(catalogue)[-1] == "fourth"
    assert catalogue["fourth"].parameters[0].name == "K4"
    assert catalogue.troubles == []


@pytest.mark.parametrize(
    ("entry", "told"),
    [
        ("my_bench_effects.nothing", "the distribution my-bench-effects 1.2 cannot be loaded"),
        ("my_bench_effects:MODULE", "cannot be loaded"),
        ("math", "is no effect and has none in it"),
    ],
)
def test_what_cannot_be_had_is_said_and_all_else_is_there(site, entry, told):
    site.write_text(f"[{GROUP}]\nwrong = {entry}\n")
    catalogue = Catalogue(CATALOGUE.values())
    assert list(catalogue) == list(CATALOGUE)
    assert [told in trouble for trouble in catalogue.troubles] == [True]


def test_a_name_that_is_taken_stays_with_the_bench(site):
    site.write_text(f"[{GROUP}]\nfourth = my_bench_effects\n")
    shipped = SimpleNamespace(name="fourth")
    catalogue = Catalogue([shipped])
    assert catalogue["fourth"] is shipped
    assert "there is one already" in " ".join(catalogue.troubles)
