"""A bench file with calibration certificates, for tests."""

from copy import deepcopy
from pathlib import Path
from typing import Any

import yaml

from bench.config.bench_file.file import BenchFile, load_bench
from bench.config.shipped import find_bench

HELD: dict[str, Any] = {"number": "C-1", "laboratory": "Met Lab", "date": "2026-01-01"}


def meter_certificate(
    gain: str = "0 ppm", offset: str = "0 V", *, drift: bool = True, **others: Any
) -> dict[str, Any]:
    """Return a meter's certificate, 10 V: U 6 ppm and 10 µV, k = 2, dof 20; drift 8 ppm and 12 µV a year."""
    drifts: tuple[dict[str, str], ...] = (
        ({"drift": "8 ppm/year"}, {"drift": "12 uV/year"}) if drift else ({}, {})
    )
    values = {
        "range": "10 V",
        "gain": {"correction": gain, "U": "6 ppm", "k": 2, "dof": 20, **drifts[0]},
        "offset": {"correction": offset, "U": "10 uV", "k": 2, "dof": 20, **drifts[1]},
    }
    return {**HELD, "values": [values], **others}


def table_certificate(corrections_arcsec: dict[float, float], **others: Any) -> dict[str, Any]:
    """Return a head's certificate: corrections by angle in degrees, each with U of 2″, k = 2."""
    rows = [
        {"angle": f"{angle} deg", "correction": f"{size!r} arcsec", "U": "2 arcsec", "k": 2}
        for angle, size in corrections_arcsec.items()
    ]
    return {**HELD, "values": rows, **others}


def write_bench(
    folder: Path,
    meters: dict[str, dict[str, Any]] | None = None,
    head: dict[str, Any] | None = None,
    chamber: dict[str, Any] | None = None,
    **sections: Any,
) -> Path:
    """Write the paper's bench file with certificates of head, chamber, meters by channel; return its path."""
    data = yaml.safe_load(find_bench("paper-stand").read_text(encoding="utf-8"))
    instruments = data["instruments"]
    for meter in instruments["voltmeters"]:
        certificate = (meters or {}).get(meter["channels"][0])
        meter.update({} if certificate is None else {"certificate": deepcopy(certificate)})
    instruments["head"].update({} if head is None else {"certificate": head})
    instruments["chamber"].update({} if chamber is None else {"certificate": chamber})
    for name, content in sections.items():
        both = isinstance(data.get(name), dict) and isinstance(content, dict) and name != "gravity"
        data[name] = {**data[name], **content} if both else content
    file = folder / "certified.yaml"
    file.write_text(yaml.safe_dump(data, allow_unicode=True, sort_keys=False), encoding="utf-8")
    return file


def certified(folder: Path, **parts: Any) -> BenchFile:
    """Write a bench file with certificates, as `write_bench` does, and load it."""
    return load_bench(write_bench(folder, **parts))
