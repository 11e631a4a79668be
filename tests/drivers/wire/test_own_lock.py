"""An instrument's own lock, where its interface has one; no such instrument is simulated."""

from __future__ import annotations

from typing import Any
from unittest.mock import create_autospec

import pytest
from pyvisa.constants import StatusCode
from pyvisa.errors import VisaIOError
from pyvisa.resources import TCPIPInstrument, TCPIPSocket

from drivers.wire.pyvisa_connection import Connection, probable_cause


def connection(kind: type[Any], answer: BaseException | None = None) -> Connection:
    made = Connection.__new__(Connection)
    made._visa = create_autospec(kind, instance=True)
    made._visa.lock_excl.side_effect = answer
    return made


def test_a_lan_instrument_is_locked_within_the_timeout() -> None:
    made = connection(TCPIPInstrument)
    made.take_own_lock(1.5)
    made._visa.lock_excl.assert_called_once_with(timeout=1500.0)  # type: ignore[attr-defined]


def test_one_that_somebody_else_has_locked_is_refused_with_the_cause() -> None:
    with pytest.raises(VisaIOError) as locked:
        connection(TCPIPInstrument, VisaIOError(StatusCode.error_resource_locked)).take_own_lock(1.0)
    assert probable_cause(locked.value)[0] == "is locked by another program or computer"


@pytest.mark.parametrize("answer", [VisaIOError(StatusCode.error_nonsupported_operation), KeyError(8)])
def test_one_that_cannot_be_locked_is_opened_all_the_same(answer: Exception) -> None:
    connection(TCPIPInstrument, answer).take_own_lock(1.0)


def test_a_plain_socket_has_no_lock() -> None:
    made = connection(TCPIPSocket)
    made.take_own_lock(1.0)
    made._visa.lock_excl.assert_not_called()  # type: ignore[attr-defined]
