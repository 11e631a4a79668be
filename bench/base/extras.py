"""Packages that come with extras: one that is missing is named with the command that installs it.

An import of one stands bare where it is needed; `bench.services.explained` tells of a failure.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import Final

EXTRAS: Final[Mapping[str, tuple[str, ...]]] = {
    "pandas": ("pandas",),
    "signing": ("cryptography", "rfc3161_client"),
    "panel": ("starlette", "uvicorn", "h11"),
    "certificate": ("typst", "lxml", "signxml", "pyhanko", "pyhanko_certvalidator", "asn1crypto", "pikepdf"),
    "catalogue": ("sqlalchemy", "alembic", "pyarrow", "duckdb"),
    "postgresql": ("psycopg",),
    "cluster": ("dask", "distributed"),
    "pkcs11": ("pkcs11",),
}
"""What is imported of each extra of pyproject.toml; the first that has a package, where several have."""


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
    """Whether the import that failed stands in the room of certificates, whose extra has all that it imports."""
    while trace is not None:
        if trace.tb_frame.f_globals.get("__name__", "").startswith("bench.certificate."):
            return True
        trace = trace.tb_next
    return False
