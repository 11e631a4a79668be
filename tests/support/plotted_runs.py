"""Runs with everything that the panel plots: two calibrations of one unit, the later one with a diagnosis."""

import contextlib
import io
from pathlib import Path

import pytest

MODEL = (
    'model_file: "1"\nname: with-k2\neffects:\n'
    "  - {name: quadratic_nonlinearity, channels: [y], parameters: {K2: 500 ug/g^2}}\n"
)


def make_plotted(folder: Path) -> Path:
    """Make the dry runs "earlier" and "later" in a folder; "later" has an effect, which its diagnosis names."""
    from bench.cli.app import main

    (folder / "k2.yaml").write_text(MODEL, encoding="utf-8")
    runs = folder / "runs"
    result = runs / "later" / "diagnose.json"
    for arguments in (
        ["run", "paper", "--dry-run", "--name", "earlier"],
        ["run", "paper", "--dry-run", "--name", "later", "--seed", "2", "--model", str(folder / "k2.yaml")],
        ["diagnose", str(runs / "later"), "--json", str(result)],
    ):
        with contextlib.redirect_stdout(io.StringIO()), pytest.raises(SystemExit):
            main([*arguments, "--runs", str(runs)])
    return runs
