"""Support for long computations: progress, threads, garbage collection; package versions and optional packages."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sized
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from types import TracebackType
from typing import Final, TypeVar

Listener = Callable[[str, int, int], None]
"""A progress callback: called with the computation's name, the number of parts done and the total number."""

quiet: ContextVar[bool] = ContextVar("quiet", default=False)
"""Whether progress and notes are suppressed (`--quiet`); results, questions and errors are always shown."""

_T = TypeVar("_T")
_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)


class CalibrationError(ValueError):
    """The readings do not allow the requested calibration; the message says why and what is needed."""


@contextmanager
def heard_by(listener: Listener | None) -> Iterator[None]:
    """Report the progress of all `tracked` computations to `listener` within this context.

    With None for `listener`, nobody receives reports.
    """
    before = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(before)


def tracked(parts: Iterable[_T], what: str, total: int | None = None) -> Iterator[_T]:
    """Yield each of `parts`, and report the progress of the computation `what` to the listener of `heard_by`.

    `total` is the number of parts if `len(parts)` is not defined. Fewer than two parts give no report.
    """
    count = len(parts) if isinstance(parts, Sized) else total or 0
    listener = _listener.get() if count > 1 else None
    for done, part in enumerate(parts):
        if listener is not None:
            listener(what, done, count)
        yield part
    if listener is not None:
        listener(what, count, count)


THREADS: Final = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
"""Environment variables that set the number of threads of linear-algebra libraries."""


def one_thread() -> None:
    """Limit linear algebra to one thread, because one thread is faster for small matrices.

    Environment variables that are already set are kept. Call this function before numpy is imported.
    """
    for name in THREADS:
        os.environ.setdefault(name, "1")


@contextmanager
def uncollected() -> Iterator[None]:
    """Pause the garbage collector while many small objects are created, because it would scan them repeatedly.

    Objects without reference cycles are freed as usual. Also usable as a function decorator.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


# --- packages ----------------------------------------------------------------------------------------

PACKAGES: Final = ("triaxial-bench", "numpy", "scipy", "pyvisa", "pyvisa-py", "pyserial")


@cache
def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages on which results depend, by name."""
    import platform
    from importlib import metadata

    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found


# --- packages that come with extras -----------------------------------------------------------------
# Modules import these packages where they need them; `bench.services.explained` reports a missing one.

EXTRAS: Final[Mapping[str, tuple[str, ...]]] = {
    "pandas": ("pandas",),
    "signing": ("cryptography", "rfc3161_client"),
    "panel": ("starlette", "uvicorn", "h11", "ruamel"),
    "certificate": ("typst", "lxml", "signxml", "pyhanko", "pyhanko_certvalidator", "asn1crypto", "pikepdf"),
    "catalogue": ("sqlalchemy", "pyarrow", "duckdb"),
    "postgresql": ("psycopg",),
    "cluster": ("dask", "distributed"),
    "pkcs11": ("pkcs11",),
}
"""The imported packages of each extra in pyproject.toml; a package of several extras is listed in the first."""


def missing(error: BaseException) -> str:
    """Return a sentence that names the missing package and the extra of this program that installs it.

    Return "" if `error` is not the failed import of a package in `EXTRAS`.
    """
    package = (error.name or "").partition(".")[0] if isinstance(error, ImportError) else ""
    for extra, packages in EXTRAS.items():
        if package in packages:
            shared = extra == "signing" and _in_certificates(error.__traceback__)
            wanted = "certificate" if shared else extra
            return f"the package {package} is not installed: pip install 'triaxial-bench[{wanted}]'"
    return ""


def _in_certificates(trace: TracebackType | None) -> bool:
    """Return whether an import failed in `bench.certificate`; its extra includes the signing packages."""
    while trace is not None:
        if trace.tb_frame.f_globals.get("__name__", "").startswith("bench.certificate."):
            return True
        trace = trace.tb_next
    return False
