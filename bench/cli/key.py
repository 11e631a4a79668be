"""key: the laboratory's key, with which seals are signed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bench.cli import printing
from bench.cli.options import app


@app.command(epilog="Example: bench key ~/.bench-keys/laboratory.pem")
def key(
    file: Annotated[
        Path, typer.Argument(help="Where the private key is written; the public one is FILE.pub.")
    ],
    passphrase: Annotated[
        bool, typer.Option("--passphrase", help="Ask for a passphrase that covers the private key.")
    ] = False,
) -> int:
    """Make the laboratory's key (Ed25519, PEM), with which 'bench seal' signs."""
    from bench.cli.passphrase import passphrase as typed
    from bench.run.signing import new_key

    cover = typed("Passphrase: ", again="Once more: ") if passphrase else None
    public, fingerprint = new_key(file, cover)
    out = printing.console()
    out.print(f"private key: {file} (keep it; who has it signs in the laboratory's name)")
    out.print(f"public key: {public} (give it to whoever is to check)")
    out.print(f"fingerprint: {fingerprint}")
    return 0
