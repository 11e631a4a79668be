"""Long computations: progress, threads, the garbage collector; packages that come with extras."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sized
from contextlib import contextmanager
from contextvars import ContextVar
from types import TracebackType
from typing import Final, TypeVar

Listener = Callable[[str, int, int], None]
"""A listener of progress: called with the computation's name, the parts done and their total number."""

quiet: ContextVar[bool] = ContextVar("quiet", default=False)
"""Whether progress and notes are to be silent, as `--quiet` asks; results, questions and errors never are."""

_T = TypeVar("_T")
_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)


class CalibrationError(ValueError):
    """The readings cannot give what was asked of them; the text says why and what would."""


@contextmanager
def heard_by(listener: Listener | None) -> Iterator[None]:
    """Report the progress of all `tracked` computations to a listener within the context; None: to nobody."""
    before = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(before)


def tracked(parts: Iterable[_T], what: str, total: int | None = None) -> Iterator[_T]:
    """Yield the parts of a computation and tell how many are done; of a single part there is nothing to tell.

    `total` says how many there are, where `parts` have no length.
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
"""Environment variables from which libraries of linear algebra read the number of threads."""


def one_thread() -> None:
    """Limit linear algebra to one thread, unless the number is set: threads slow small matrices down.

    Call it before numpy is imported.
    """
    for name in THREADS:
        os.environ.setdefault(name, "1")


@contextmanager
def uncollected() -> Iterator[None]:
    """Pause the garbage collector while many small objects are made and kept, to save its repeated passes.

    Objects without cycles are freed as usual. It also works as a decorator of a function.
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


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that a result depends on."""
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
# An import of one stands bare where it is needed; `bench.services.explained` tells of a failure.

EXTRAS: Final[Mapping[str, tuple[str, ...]]] = {
    "pandas": ("pandas",),
    "signing": ("cryptography", "rfc3161_client"),
    "panel": ("starlette", "uvicorn", "h11"),
    "certificate": ("typst", "lxml", "signxml", "pyhanko", "pyhanko_certvalidator", "asn1crypto", "pikepdf"),
    "catalogue": ("sqlalchemy", "pyarrow", "duckdb"),
    "postgresql": ("psycopg",),
    "cluster": ("dask", "distributed"),
    "pkcs11": ("pkcs11",),
}
"""The imported packages of each extra of pyproject.toml; a package of several extras is under the first."""


def missing(error: BaseException) -> str:
    """Return the sentence for a package that is not installed, empty for any other error."""
    package = (error.name or "").partition(".")[0] if isinstance(error, ImportError) else ""
    for extra, packages in EXTRAS.items():
        if package in packages:
            shared = extra == "signing" and _in_certificates(error.__traceback__)
            wanted = "certificate" if shared else extra
            return f"the package {package} is not installed: pip install 'triaxial-bench[{wanted}]'"
    return ""


def _in_certificates(trace: TracebackType | None) -> bool:
    """Return whether a module of certificates made the failed import; their extra has all its packages."""
    while trace is not None:
        if trace.tb_frame.f_globals.get("__name__", "").startswith("bench.certificate."):
            return True
        trace = trace.tb_next
    return False
