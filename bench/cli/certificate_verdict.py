"""A verdict on a certificate, told at a terminal: what it says, who signed it, what that does not prove."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from bench.base.numbers import rounded, uncertainty
from bench.base.text import visible
from bench.cli import printing

if TYPE_CHECKING:
    from bench.certificate.dcc.shown import Shown
    from bench.certificate.verify import Verdict


def print_verdict(verdict: Verdict, on: Any) -> None:
    """Print a verdict; of a certificate that is not intact nothing is shown but why."""
    on.print(f"{verdict.file}: {verdict.headline}")
    for why in verdict.wrong:
        on.print(f"  {visible(why)}")
    if not verdict.intact:
        return
    if not verdict.unsigned:
        on.print(f"signer: {visible(verdict.signer)}, certificate SHA-256 {verdict.fingerprint}")
        on.print(f"signed at: {verdict.signed_at}")
    if verdict.why_not_trusted:
        on.print(f"not trusted: {visible(verdict.why_not_trusted)}")
    if verdict.shown is not None:
        _print_shown(verdict.shown, on)
    for heading, lines in (
        ("agrees", verdict.agreed), ("not signed", verdict.not_signed), ("not proved", verdict.not_proved),
    ):  # fmt: skip
        for line in lines:
            on.print(f"{heading}: {visible(line)}")


def _print_shown(shown: Shown, on: Any) -> None:
    """Print what it says."""
    if shown.simulated:
        on.print("SIMULATED: it certifies nothing of any real unit")
    told = {
        "certificate": shown.number,
        "laboratory": shown.laboratory,
        "customer": shown.customer,
        "unit": "; ".join(shown.items),
        "calibrated": " to ".join(dict.fromkeys(shown.calibrated)),
        "issued": shown.issued,
        "authorised by": shown.authorised_by,
        "conformity": shown.conformity or "no statement",
    }
    for name, text in told.items():
        on.print(f"{name}: {visible(text)}")
    table = printing.table("coefficient", ">value", ">U", ">k", "")
    for one in shown.coefficients:
        table.add_row(
            visible(one.name),
            rounded(one.value, one.U),
            uncertainty(one.U),
            f"{one.k:.3g}",
            visible(one.unit),
        )
    on.print(table)
