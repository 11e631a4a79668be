"""Passphrases: typed unseen at a terminal, else a line of standard input."""

from __future__ import annotations

import sys

from bench.services.errors import Refused


def passphrase(question: str, again: str = "") -> bytes:
    """Ask for a passphrase, twice where `again` asks for it once more. Raises `Refused` for none, or for two."""
    typed = _line(question)
    if not typed:
        raise Refused("a passphrase is wanted, and none was given")
    if again and _line(again) != typed:
        raise Refused("the two passphrases are not the same; begin again")
    return typed.encode()


def _line(question: str) -> str:
    if sys.stdin.isatty():
        from getpass import getpass

        return getpass(question)
    return sys.stdin.readline().rstrip("\r\n")
