"""What certificates need beside the program: packages of the extra `certificate`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from bench.api.errors import Refused
from bench.certificate.signature.signatory import MISSING


@contextmanager
def needing_packages() -> Iterator[None]:
    """Tell of a package that is not installed which one it is, and how to have it. Raises `Refused`."""
    try:
        yield
    except ImportError as error:
        raise Refused(MISSING.format(error.name)) from error
