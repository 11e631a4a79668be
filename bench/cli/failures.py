"""failures: what failed in runs, in a register with state and remedy; a page for the management review."""

from __future__ import annotations

from bench.cli import printing
from bench.cli.options import JsonOption, command
from bench.services.requests.documents import Failures


@command("bench failures --laboratory laboratory.yaml --year 2026 --page review.html")
def failures(request: Failures, json: JsonOption = None) -> int:
    """Collect failures of runs in a register; note their remedies; a page for the review.

    Failed and stopped runs, refused answers, repeated readings and alarms are collected from the records.
    """
    from bench.results.failures import render_failures
    from bench.validation.failures import failures as collect

    result = collect(request)
    files = () if request.page is None else [("page", request.page, render_failures(result))]
    return printing.told(result, json, result.print_on, files)
