"""A learned file of the shipped bench, with sizes far below the stated limits, and a bench file that names it."""

from pathlib import Path
from typing import Any

import numpy as np

from bench.base.arrays import ARCSEC
from bench.config.bench_file.file import load_bench
from bench.config.bench_file.learned import arcsec, learned_for, write_learned

SHIPPED = Path(__file__).parents[2] / "config" / "paper-stand.yaml"
KINDS = ("axis_tilt", "zero_offset", "mounting_error", "mounting_roll")
MEANS = np.array([0.4, -0.3, 12.0, -8.0]) * ARCSEC
U = np.array([0.3, 0.4, 1.5, 2.0]) * ARCSEC
REMOUNT = np.array([0.5, 0.6, 3.0, 4.0]) * ARCSEC
CORRELATION = np.array([[1, 0.2, 0, 0], [0.2, 1, -0.6, 0.1], [0, -0.6, 1, 0.3], [0, 0.1, 0.3, 1.0]])


def content(**parts: Any) -> dict[str, Any]:
    """Return the content of the shipped bench's learned file; `parts` replace members of it."""
    bench = load_bench(SHIPPED)
    return {
        "bench": bench.name,
        "learned_for": learned_for(bench),
        "made": "2026-01-01",
        "expires": "2126-01-01",
        "simulated": True,
        "runs": [{"name": "day-1", "readings": "111"}],
        "stand": {
            "means": [
                {"angle": kind, "value": arcsec(mean), "u": arcsec(u)}
                for kind, mean, u in zip(KINDS, MEANS.tolist(), U.tolist(), strict=True)
            ],
            "covariance_rad2": (CORRELATION * np.outer(U, U)).tolist(),
            "remount": {kind: arcsec(size) for kind, size in zip(KINDS, REMOUNT.tolist(), strict=True)},
        },
        "noise": {
            "unit": "V",
            **{c: {"size": size, "dof": 80.0} for c, size in zip("xyz", (3e-5, 4e-5, 5e-5), strict=True)},
            "setting": {"size": arcsec(1.5 * ARCSEC), "dof": 40.0},
        },
    } | parts


def leave(name: str = "mine.yaml", **parts: Any) -> None:
    """Write learned.yaml, the bench file `name` that uses it, and plain.yaml, which does not."""
    Path("learned.yaml").unlink(missing_ok=True)
    write_learned(Path("learned.yaml"), content(**parts), ())
    text = SHIPPED.read_text(encoding="utf-8")
    Path(name).write_text(f"learned: learned.yaml\n{text}", encoding="utf-8")
    Path("plain.yaml").write_text(text, encoding="utf-8")
