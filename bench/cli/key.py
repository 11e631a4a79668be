"""key: the laboratory's keys, with which seals and certificates are signed."""

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
    certificate: Annotated[
        str | None,
        typer.Option(
            "--certificate",
            metavar="NAME",
            help="Make one that signs certificates (P-256) in place of seals, and beside it FILE.crt: an X.509 "
            "certificate in the laboratory's name, signed by itself.",
        ),
    ] = None,
) -> int:
    """Make the laboratory's key (Ed25519, PEM), with which 'bench seal' signs; or one that signs certificates."""
    from bench.cli.passphrase import passphrase as typed
    from bench.run.seal import new_key
    from drivers.clock import utc_now

    cover = typed("Passphrase: ", again="Once more: ") if passphrase else None
    out = printing.console()
    if certificate is None:
        public, fingerprint = new_key(file, cover)
    else:
        from bench.certificate.signatory import new_certificate_key

        public, fingerprint = new_certificate_key(file, certificate, cover, utc_now())
    out.print(f"private key: {file} (keep it; who has it signs in the laboratory's name)")
    kind = "public key" if certificate is None else "certificate"
    out.print(f"{kind}: {public} (give it to whoever is to check)")
    out.print(f"fingerprint: {fingerprint}")
    return 0
