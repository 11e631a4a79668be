"""What was run with which versions: for the record and the report."""

from __future__ import annotations

import platform
from importlib import metadata

from bench.api.source import Source
from bench.run.folder import Run

PACKAGES = ("triaxial-bench", "numpy", "scipy", "pyvisa", "pyvisa-py", "pyserial")


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that a result depends on."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found


def provenance(source: Source) -> dict[str, str]:
    """Return what the report says of where its numbers come from, in the order in which it says it."""
    stated = {
        "source": source.name,
        "unit under test": source.block_name or "not stated",
        "bench": f"{source.bench.name} (SHA-256 {source.bench_sha256})",
        "model": source.model.name,
    }
    if source.run is not None:
        manifest = source.run.manifest
        stated["run"] = source.run.name
        stated["begun"] = str(manifest.get("created", ""))
        stated["operator"] = str(manifest.get("operator") or "not stated")
        if "imported" in manifest:
            stated["imported from"] = str(manifest["imported"])
        else:
            stated["procedure"] = f"{manifest.get('procedure')} (plan SHA-256 {manifest.get('plan_hash')})"
            stated["instruments"] = "simulated" if source.run.simulated else "real"
        stated.update(_identities(source))
        head = record_head(source.run)
        stated["record"] = f"{head['events']} events, chain of hashes whole, head {head['head']}"
        recorded = manifest.get("versions", {})
        stated["measured with"] = ", ".join(f"{name} {version}" for name, version in recorded.items())
    stated["evaluated with"] = ", ".join(f"{name} {version}" for name, version in versions().items())
    return stated


def record_head(run: Run) -> dict[str, str | int]:
    """Return by what a record can be known again: how many events it has, and the head of their chain.

    The head is the SHA-256 of the last line, and through it of all before: kept elsewhere, as in a result, it shows
    whether any was changed, removed or added since.
    """
    return {"events": len(run.history.events), "head": run.history.head}


def _identities(source: Source) -> dict[str, str]:
    """Identities of the instruments as they answered when the run was begun."""
    if source.run is None:
        return {}
    return {name: str(identity) for name, identity in source.run.history.identities.items()}
