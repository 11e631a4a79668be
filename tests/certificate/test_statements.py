"""Every statement of conformity has its words in each language, and its word in the DCC."""

import pytest

from bench.calibration.conformity import Statement
from bench.certificate.dcc.document import _CONFORMITY
from bench.certificate.laboratory import texts_of


@pytest.mark.parametrize("language", ["en", "de", "uk"])
def test_each_statement_can_be_said(language):
    assert all(texts_of(language).say(str(statement)) for statement in Statement)


def test_only_an_accepted_statement_is_a_pass():
    assert set(_CONFORMITY) == set(Statement)
    assert [one for one, word in _CONFORMITY.items() if word == "pass"] == [Statement.PASS]
    assert _CONFORMITY[Statement.MISFIT] == "noPass"
