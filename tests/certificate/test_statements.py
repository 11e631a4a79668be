"""Every statement of conformity has its words in each language, and its word in the DCC."""

import pytest

from bench.calibration.conformity import Statement
from bench.certificate import laboratory
from bench.certificate.dcc.document import _CONFORMITY
from bench.certificate.laboratory import texts_of
from bench.services.errors import Refused


@pytest.mark.parametrize("language", ["en", "de", "uk"])
def test_each_statement_can_be_said(language):
    assert all(texts_of(language).say(str(statement)) for statement in Statement)


def test_only_an_accepted_statement_is_a_pass():
    assert set(_CONFORMITY) == set(Statement)
    assert [one for one, word in _CONFORMITY.items() if word == "pass"] == [Statement.PASS]
    assert _CONFORMITY[Statement.MISFIT] == "noPass"


@pytest.mark.parametrize("words", [{}, {"operator": {"de": "Prüfer"}}])
def test_a_missing_text_is_refused_with_its_file_and_key(monkeypatch, words):
    monkeypatch.setattr(laboratory, "_WORDS", words)
    with pytest.raises(
        Refused, match=r"words\.yaml: there is no text 'operator'; add it, at least in English"
    ):
        texts_of.__wrapped__("uk").say("operator")
