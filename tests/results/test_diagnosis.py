"""The page of a diagnosis and its words: what is said, in which order, and that the page stands alone."""

import html
import re

import numpy as np
import pytest

import bench as program
from bench.base.languages import speaking
from bench.base.numbers import fixed
from bench.base.tables import as_text
from bench.diagnosis import NamedEffect
from bench.diagnosis.result import EffectValue
from bench.readings.csv import write_csv
from bench.results import plots
from bench.results.diagnosis_parts import repeats_told
from bench.results.diagnosis_words import (
    by_clause,
    closed_in_words,
    effect_title,
    micro_g,
    parameters_in_words,
    smallest_found,
    unit_in_print,
)  # fmt: skip
from bench.stats.repeats import compare_repeats
from tests.support.diagnosis_bench import paper_run
from tests.support.in_ukrainian import english_in, words_of

pytestmark = pytest.mark.slow


def page_of(folder, seed, **hidden):
    """Diagnose readings of the independent simulation; return the result and the page."""
    write_csv(paper_run(np.random.default_rng(seed), directions=(1, -1, 1), **hidden), folder / "r.csv")
    found = program.diagnose(folder / "r.csv", write=True)
    return found, (folder / "diagnose" / "r.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def cache():
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("BENCH_FILE", raising=False)
        yield


@pytest.fixture(scope="module")
def named(cache, tmp_path_factory):
    """With one figure drawn; the others have an identifier each."""
    draw = plots._written

    def written(name, *how):
        return (
            draw(name, *how) if name == "diagnosis-overlay-0" else '<svg viewBox="0 0 1 1"><g id="a"/></svg>'
        )

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plots, "_written", written)
        return page_of(tmp_path_factory.mktemp("named"), 4, K2=(0.0, 1e-4, 0.0))


@pytest.fixture(scope="module")
def agrees(cache, tmp_path_factory):
    return page_of(tmp_path_factory.mktemp("agrees"), 3)


def text_of(page):
    plain = re.sub(r"<svg.*?</svg>|<style.*?</style>|<[^>]+>", " ", page, flags=re.DOTALL)
    return " ".join(html.unescape(plain).split())


@pytest.mark.figures
def test_the_story_stands_in_order(named):
    _, page = named
    order = [
        "What to do", "Measured and simulated", "Basic model and noise", "Where readings and model disagree",
        "What was found",
        "How sure:", "What else it could be:", "How far the gap closes", "Readings against the simulated bench",
        "Consequence", "What to measure next", "Hidden effects: what these readings cannot show",
        "Registered before the search",
        "Provenance",
    ]  # fmt: skip
    places = [page.index(heading) for heading in order]
    assert places == sorted(places)


@pytest.mark.figures
def test_the_figures_are_those_of_the_result(named):
    full, page = named
    text = text_of(page)
    (k2,) = full.diagnosis.effects[0].parameters
    assert f"K2 of y = {fixed(k2.value, 1)} ± {fixed(k2.u, 1)} µg/g² (u)" in text
    gap = full.diagnosis.gap
    assert f"{gap.before:.2f} before, {gap.after:.2f} after; noise alone gives 1" in text
    assert full.diagnosis.registered.sha256 in text
    assert str(full.files.model) in text
    for fold in gap.folds:
        assert fold.label in text


@pytest.mark.figures
def test_the_first_screen_has_verdict_gap_and_what_to_do(named):
    full, page = named
    first = text_of(page[: page.index("Measured and simulated")])
    gap = full.diagnosis.gap
    assert f"Gap closed {min(100 * gap.closed, 100):.0f} %, from {micro_g(gap.before_rms_g)} to " in first
    assert f"bench calibrate {full.source.name} --model {full.files.model}" in first
    assert f"bench confirm NEW --model {full.files.model}" in first


@pytest.mark.figures
def test_measured_and_simulated_signals_stand_in_one_figure(named):
    _, page = named
    figure = page[page.index("diagnosis-overlay-0") :].partition("</svg>")[0]
    # the readings of three channels, in each of three passes, with the marks of the passes
    assert len(set(re.findall(r'id="(diagnosis-overlay-0-overlay-0-[xyz]-\d+)"', figure))) == 9


@pytest.mark.figures
def test_the_page_needs_nothing_but_itself(named):
    _, page = named
    assert re.findall(r'(?:src|href)="(?!#)[^"]*"', page) == []
    assert (
        page.count("<svg") == page.count("</svg>") == 8
    )  # two overlays, ranking, gap, two mountings, time, modulus
    identifiers = re.findall(r'\bid="([^"]+)"', page)
    assert len(identifiers) == len(set(identifiers))


def test_nothing_found_is_told_with_what_would_not_show(agrees):
    full, page = agrees
    text = text_of(page)
    assert full.diagnosis.verdict == "agrees"
    assert "Nothing found" in text
    assert "What was found" not in text
    assert "An effect smaller than its size at the end of this page would probably be missed" in text
    for name, size in smallest_found(full.diagnosis):
        assert f"{name} {size}" in text
    assert full.diagnosis.hidden
    for name in full.diagnosis.hidden:
        assert name in text


def test_the_smallest_size_that_shows_is_about_that_of_the_noise(agrees):
    # readings of 15 uV on 2.1 V/g: a square of 1 g^2 in one channel is known to about 5 ug/g^2 (test of the
    # dry run), so that six times that is found in half of all runs
    full, _ = agrees
    sizes = dict(smallest_found(full.diagnosis))
    assert sizes["quadratic_nonlinearity"].endswith(" µg/g²")
    assert 5 < float(sizes["quadratic_nonlinearity"].split()[0]) < 60


def test_a_mistake_in_the_readings_is_shown_with_its_correction(cache, tmp_path):
    table = paper_run(np.random.default_rng(3), directions=(1, -1, 1))
    write_csv(table, tmp_path / "r.csv")
    text = (tmp_path / "r.csv").read_text(encoding="utf-8")
    (tmp_path / "r.csv").write_text(
        text.replace("ux_v", "t_v").replace("uz_v", "ux_v").replace("t_v", "uz_v")
    )
    full = program.diagnose(tmp_path / "r.csv", write=True)
    page = text_of((tmp_path / "diagnose" / "r.html").read_text(encoding="utf-8"))
    assert (full.diagnosis.verdict, full.files.model) == ("mistake", None)
    # what follows the mistake is of the corrected copy
    assert full.to_dict()["simulation"]["before"]["p"] > 0.01
    assert "swapped_channels , channel x, z" in page
    assert "the correction changes the misfit of all readings from" in page


def test_page_and_terminal_are_ukrainian_throughout(named, agrees, monkeypatch):
    monkeypatch.setattr(plots, "_written", lambda *_: '<svg viewBox="0 0 1 1"><g id="a"/></svg>')
    for full, _ in (named, agrees):
        english = full.to_dict()
        with speaking("uk"):
            page = words_of(full.html()).replace(english["bench"]["why"], "")
            assert english_in(page) == []
            assert english_in(as_text(full.print_on)) == []
            assert full.to_dict() == english


@pytest.mark.parametrize(
    "text",
    [
        "something without a name: a wave, 0.5 per turn, of one mounting, in the bias of y (mounting 2; mostly in "
        "channel y)",
        "installation 1, pass 2, point 9: channel x by +2.2 V, y by +0.006 V off the value that the other readings "
        "predict (22 standard deviations); the copy leaves the reading out",
        "channel z has the wrong sign in installation 1, pass 2, as with its wires reversed; the copy has it "
        "turned; these readings cannot separate it from other_mounting "
        "(the block sat otherwise), the same in pass 3",
        "the channels x, y are exchanged in the whole run; the copy has their signals put back",
        "installation 2, pass 1: channel x reads the same at all points, as if stuck; the copy leaves the pass out",
    ],
)
def test_each_clause_of_a_finding_is_translated(text):
    with speaking("uk"):
        told = by_clause(text)
    assert not re.findall("[a-z]{3,}", told.replace("other_mounting", "")), told
    assert by_clause(text) == text


def found(name, channels, installations, *parameters):
    return NamedEffect(name, channels, installations, (), (), parameters, 0.0, 0.0, 1.0, "")


def test_parameters_read_as_a_person_writes_them():
    amplitude = EffectValue("A", "x", "", -151.26, 12.3, "ug")
    warm_up = found("warm_up", ("x", "z"), (), amplitude, EffectValue("tau", "", "", 20.0, None, "min"))
    assert effect_title(warm_up) == "warm_up of x, z"
    assert list(parameters_in_words(warm_up)) == [
        "A of x = −151 ± 12 µg (u)",
        "tau = 20 min (the likeliest of the values tried)",
    ]
    angle = EffectValue("angle", "", "1", 93.2, 4.1, "arcsec")
    mounting = found("mounting_error", ("x", "y", "z"), ("1",), angle)
    assert effect_title(mounting) == "mounting_error in installation 1"
    assert list(parameters_in_words(mounting)) == ["angle in installation 1 = 93.2 ± 4.1″ (u)"]
    assert unit_in_print("ug/g^3") == "µg/g³"


def test_a_headline_does_not_claim_a_smaller_rms_than_the_details_show():
    assert closed_in_words(0.99, 412e-6, 9e-6, 8.8e-6) == (
        "gap closed 99 %, from 412 µg to 9.0 µg (noise alone: 8.8 µg)"
    )
    assert closed_in_words(0.97, 20e-6, 27e-6, 26e-6) == (
        "gap closed 97 % by chi-square; rms from 20 µg to 27 µg (noise and u of the prediction: 26 µg)"
    )


def test_repeats_that_scatter_as_stated_prove_no_u():
    """Seed 2: five repeats; the words give the interval, within which u may be too small by a factor of two."""
    repeats = compare_repeats(np.random.default_rng(2).normal(size=(1, 5, 1)), np.full((1, 5, 1), 1.0))
    assert repeats.term is None
    assert repeats.held_before.low < 1.0
    assert repeats.held_before.high > 2.0
    told = repeats_told(repeats, "within the record", [])
    assert told.endswith(
        f"(95 %: {repeats.held_before.low:.2g} to {repeats.held_before.high:.2g}): they do not show that u is too "
        "small"
    )
