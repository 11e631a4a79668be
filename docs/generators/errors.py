"""The errors of the program, for the page on troubles: what happened, what to do, where."""

from __future__ import annotations

import re
from typing import Final

from benchmarks.messages import messages
from docs.generators.markdown import code, table

AREAS: Final = {
    "drivers": ("Instruments", "–"),
    "bench/run": (
        "Runs and their records",
        "`bench show RUN` shows the record, `bench resume RUN` continues it.",
    ),
    "bench/config": (
        "Bench files and procedures",
        "Correct the file at the line named; `bench check` reads it again.",
    ),
    "bench/base": (
        "Values, files, units",
        "Correct the value at the file, line or option that the message names.",
    ),
    "bench/readings": ("Readings files", "Correct the row and column named, or give `--skip-bad-rows`."),
    "bench/model": ("Effects and model files", "Correct the model file at the place named."),
    "bench/stats": ("Calibration and verification", ""),
    "bench/calibration": (
        "Calibration and verification",
        "Check the readings: `bench show RUN`, `bench diagnose RUN`.",
    ),
    "bench/planning": ("Planning of test points", "Change the option or the goal named."),
    "bench/diagnosis": ("Diagnosis", "Give the readings that the message asks for, or another `--model`."),
    "bench/history": ("Several runs", "Choose other runs, or correct the bench file named."),
    "bench/exchange": ("Files for other programs", "Change the option named."),
    "bench/services": ("Commands", "Change the option or the source named; `bench COMMAND --help`."),
    "bench/results": ("Commands", ""),
    "bench/cli": ("Commands", ""),
    "bench/certificate": (
        "Certificates",
        "Do not rely on this certificate; ask the laboratory that issued it.",
    ),
    "bench/catalogue": (
        "Catalogue and batches",
        "`bench catalogue sync DIR` builds the catalogue again from the runs.",
    ),
    "bench/batch": ("Catalogue and batches", ""),
    "bench/panel": ("Panel", "Go back, correct the field named, and send it again."),
    "bench": ("Commands", ""),
    "sim": ("Simulated instruments", "The instrument refused a command; correct the program that sent it."),
}
"""By folder: the heading of its errors, and what to do where they do not say it; empty if stated before."""
_LEAST_OF_A_PART: Final = 4
"""A text that other messages contain is listed from so many words on: shorter ones say nothing by themselves."""


def fragment() -> str:
    """Return the errors as a part of the page on troubles, a table for each area of the program."""
    remedies = {title: remedy for title, remedy in reversed(AREAS.values()) if remedy}
    rows: dict[str, dict[str, tuple[str, str, str]]] = {title: {} for title, _ in AREAS.values()}
    for one in messages():
        part = one.kind == "part" or (one.path.startswith("drivers/") and not one.remedy)
        if one.kind in ("error", "part") and not (part and _short(one.text)):
            title = next(words for top, (words, _) in AREAS.items() if one.path.startswith(f"{top}/"))
            cause = one.text.removesuffix(f"; {one.remedy}")
            rows[title].setdefault(
                one.text,
                (
                    code(cause.replace("`", "'")),
                    one.remedy or ("–" if one.kind == "part" else remedies[title]),
                    one.path,
                ),
            )
    head = ("what happened", "what to do", "where")
    parts = [
        f"### {title}\n\n{table(head, sorted(found.values()))}" for title, found in rows.items() if found
    ]
    return "\n\n".join(parts)


def _short(text: str) -> bool:
    return len(re.findall(r"[^\W\d_]{2,}", text)) < _LEAST_OF_A_PART
