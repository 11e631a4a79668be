"""accept: give terms without a name, which a diagnosis found, a name and a sentence."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bench.cli.options import app
from bench.cli.printing import console


@app.command(
    epilog="Example: bench accept diagnose/unit-17-model.yaml --name cable_pull --sentence 'the cable pulls'"
)
def accept(
    model: Annotated[
        Path, typer.Argument(metavar="MODEL", help="Model file with terms that have no name (unnamed_1, …).")
    ],
    name: Annotated[str, typer.Option("--name", help="Name of the effect: small letters, digits, _.")],
    sentence: Annotated[str, typer.Option("--sentence", help="What it is, for reports.")],
    term: Annotated[
        list[str] | None,
        typer.Option(
            "--term", help="A term that it is made of; several times (default: all that have no name)."
        ),
    ] = None,
    shown_by: Annotated[
        str | None, typer.Option("--shown-by", metavar="TEXT", help="Which measurement would show it.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="FILE", help="Where the effect is written (default: NAME.yaml beside MODEL)."
        ),
    ] = None,
) -> int:
    """Give terms without a name, which a diagnosis found, a name and a sentence."""
    from bench.services.own_effects import accept_terms

    written = accept_terms(model, name, sentence, terms=term or (), shown_by=shown_by, out=out)
    told = console()
    told.print(f"effect: {written.effects}")
    told.print(f"model: {written.model}")
    told.print(f"from now on: --effects {written.effects}, or BENCH_EFFECTS={written.effects}")
    return 0
