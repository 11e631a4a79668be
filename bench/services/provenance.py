"""What was run with which versions: for the record and the report."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from importlib import metadata

from bench.readings.columns import ranges_in_words
from bench.run.folder import Run
from bench.services.bench_selection import Origin
from bench.services.source import Source

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
    run, origin = source.run, source.origin
    stated = {
        "source": source.name,
        "unit under test": source.block_name or "not stated",
        "bench": f"{source.taken.words} (SHA-256 {source.taken.sha256})",
        "model": source.model.name,
        **source.traced.stated(),
    }
    if run is not None:
        stated["run"] = run.name
        if run.imported:
            stated["imported from"] = str(run.manifest["imported"])
        if checked := run.manifest.get("check_block"):
            stated["check block"] = checked.get("said", "")
    if origin is not None and origin.run != stated.get("run"):
        stated["exported from run"] = origin.run
    if origin is not None:
        stated.update(_measured(origin))
    if supply := ranges_in_words({name: cells.tolist() for name, cells in source.readings.extra.items()}):
        stated["supply of the block"] = supply
    if run is not None:
        head = record_head(run)
        stated["record"] = f"{head['events']} events, chain of hashes whole, head {head['head']}"
    if origin is not None:
        stated["measured with"] = _listed(origin.measured_with)
    stated["evaluated with"] = _listed(versions())
    return stated


def record_head(run: Run) -> dict[str, str | int]:
    """Return by what a record can be known again: how many events it has, and the head of their chain.

    The head is the SHA-256 of the last line, and through it of all before: kept elsewhere, as in a result, it shows
    whether any was changed, removed or added since.
    """
    return {"events": len(run.history.events), "head": run.history.head}


def _measured(origin: Origin) -> dict[str, str]:
    """What is known of the run that measured the readings: when, who, what, with which instruments."""
    stated = {"begun": origin.begun, "operator": origin.operator or "not stated"}
    if origin.procedure:
        stated["procedure"] = f"{origin.procedure} (plan SHA-256 {origin.plan_hash})"
        stated["instruments"] = "simulated" if origin.simulated else "real"
    return stated | origin.instruments


def _listed(versions_by_name: Mapping[str, str]) -> str:
    return ", ".join(f"{name} {version}" for name, version in versions_by_name.items())
