"""The bill of materials of a release (CycloneDX 1.5), and the licences of what it depends on."""

from __future__ import annotations

import uuid
from datetime import UTC, datetime
from importlib import metadata
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from bench.services.validated import packages


def licence_of(one: metadata.Distribution) -> str:
    """Return the licence of a distribution: its SPDX expression, else its classifiers, else its own words."""
    told = one.metadata.json
    if expression := told.get("license_expression"):
        return str(expression)
    stated = [str(text) for text in told.get("classifier", ())]
    classifiers = [text.rpartition(" :: ")[2] for text in stated if text.startswith("License")]
    words = str(told.get("license", "")).strip().splitlines()
    return "; ".join(classifiers) or (words[0] if words else "not stated")


def bill(epoch_s: int) -> dict[str, Any]:
    """Return the bill of materials of the installed program, as of a time (s since 1970); its order is fixed."""
    program, *others = packages()
    others.sort(key=lambda one: one.name.lower())
    wanted = [_component(one, "library") for one in others]
    identity = " ".join(one["bom-ref"] for one in (_component(program, "application"), *wanted))
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "serialNumber": f"urn:uuid:{uuid.uuid5(uuid.NAMESPACE_OID, identity)}",
        "version": 1,
        "metadata": {
            "timestamp": datetime.fromtimestamp(epoch_s, UTC).isoformat().replace("+00:00", "Z"),
            "component": _component(program, "application"),
        },
        "components": wanted,
        "dependencies": _dependencies(program, others),
    }


def _dependencies(
    program: metadata.Distribution, others: list[metadata.Distribution]
) -> list[dict[str, Any]]:
    """Return which package needs which: with its extras for the program, as installed for the others."""
    known = {canonicalize_name(one.name): _reference(one) for one in (program, *others)}
    found = []
    for one in (program, *others):
        stated = map(Requirement, one.requires or ())
        needed = {
            known.get(canonicalize_name(each.name), "")
            for each in stated
            if one is program or each.marker is None or each.marker.evaluate({"extra": ""})
        }
        found.append({"ref": _reference(one), "dependsOn": sorted(needed - {""})})
    return found


def licences(found: dict[str, Any]) -> str:
    """Return the licences of a bill of materials as a table in text, a line for each package."""
    rows = [found["metadata"]["component"], *found["components"]]
    lines = [f"{one['name']}\t{one['version']}\t{one['licenses'][0]['license']['name']}" for one in rows]
    return "\n".join(["package\tversion\tlicence", *lines, ""])


def _reference(one: metadata.Distribution) -> str:
    return f"pkg:pypi/{one.name.lower().replace('_', '-')}@{one.version}"


def _component(one: metadata.Distribution, kind: str) -> dict[str, Any]:
    reference = _reference(one)
    return {
        "type": kind,
        "bom-ref": reference,
        "name": one.name,
        "version": one.version,
        "purl": reference,
        "licenses": [{"license": {"name": licence_of(one)}}],
    }
