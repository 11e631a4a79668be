"""init: copies of the shipped files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bench.cli import printing
from bench.cli.options import app
from bench.services.errors import Refused


@app.command(epilog="Example: bench init my-lab")
def init(folder: Annotated[Path, typer.Argument(help="Folder to write into.")] = Path()) -> int:
    """Write copies of the shipped procedures and bench files, to edit."""
    from bench.config.shipped import copy_shipped

    try:
        copied = copy_shipped(folder)
    except OSError as error:
        raise Refused(f"{folder}: cannot be written ({error.strerror}); choose another folder") from error
    out = printing.console()
    for path in copied:
        out.print(f"wrote {path}")
    if not copied:
        out.print(f"{folder}: every shipped file is there already; nothing was written")
    return 0
