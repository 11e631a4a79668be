"""A shipped bench whose block is fed by a supply, with sections as mappings that tests can change."""

import json
from pathlib import Path
from typing import Any, Final

import yaml

from bench.config.bench_file.file import BenchFile, load_bench
from bench.config.shipped import find_bench

P15: Final = {
    "name": "p15",
    "output": "P25V",
    "voltage": "15 V",
    "tolerance": "0.2 V",
    "current": {"minimum": "20 mA", "maximum": "120 mA"},
    "limits": {"minimum": "-0.5 V", "maximum": "18 V", "current": "200 mA"},
    "current_limit": "150 mA",
}
N15: Final = {
    **P15,
    "name": "n15",
    "output": "N25V",
    "voltage": "-15 V",
    "limits": {"minimum": "-18 V", "maximum": "0.5 V", "current": "200 mA"},
}
FEED: Final[dict[str, Any]] = {
    "rails": [P15, N15],
    "least_off": "10 s",
    "warm_up": "20 min",
    "when_unsafe": "off",
}


MANUAL: Final = {
    "driver": "manual-supply",
    "outputs": {
        "P25V": {"maximum": "25 V", "current": "1 A", "over_voltage": "27 V"},
        "N25V": {"minimum": "-25 V", "maximum": "0 V", "current": "1 A"},
    },
}


def write_fed(
    folder: Path,
    feed: dict[str, Any] | None = None,
    name: str = "bench-gpib",
    supply: dict[str, Any] | None = None,
) -> Path:
    """Write a shipped bench file with these sections (default: `FEED`, a manual supply); return its path."""
    data = yaml.safe_load(find_bench(name).read_text(encoding="utf-8"))
    data["unit_under_test"]["supply"] = json.loads(json.dumps(FEED if feed is None else feed))
    data["instruments"]["power_supply"] = json.loads(json.dumps(MANUAL if supply is None else supply))
    path = folder / "bench.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
    return path


def fed_bench(folder: Path, **changes: Any) -> BenchFile:
    """Return a bench whose block is fed as `FEED` states, with changes of its members."""
    return load_bench(write_fed(folder, {**FEED, **changes}))
