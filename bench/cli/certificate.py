"""certificate: issue, amend, revoke, hand out again, verify and read certificates."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from bench.cli import printing
from bench.cli.commands import HELP_FLAGS, CommandGroup
from bench.cli.options import JsonOption, command, group
from bench.services.requests.documents import (
    AmendCertificate,
    CheckRegister,
    IssueCertificates,
    Issuing,
    ReadCertificate,
    RevokeCertificate,
    VerifyCertificate,
)  # fmt: skip
from bench.services.requests.shared import runs_folder

if TYPE_CHECKING:
    from bench.certificate.life import Desk


class IssueByDefault(CommandGroup):
    """The group of commands on certificates; `issue` is assumed if the first word is no command."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments, with `issue` inserted if the first word is not a command."""
        first = next(iter(args), "--help")
        if first not in self.commands and first not in HELP_FLAGS:
            args = ["issue", *args]
        return list(super().parse_args(ctx, args))


GROUP: Final = group(
    "certificate",
    "bench certificate unit-17 --laboratory laboratory.yaml --order order.yaml --authorised-by 'A. Example'",
    IssueByDefault,
)


@command(
    "bench certificate issue unit-17 unit-18 --laboratory laboratory.yaml --order order.yaml "
    "--authorised-by 'A. Example'",
    to=GROUP,
)
def issue(request: IssueCertificates, json: JsonOption = None) -> int:
    """Issue the certificate of a run: NUMBER.pdf and NUMBER.xml in the register's folder."""
    from bench.certificate.life import drafts, issue_all
    from bench.results.certificate import CertificateResult

    outcomes = drafts(request) if request.draft else issue_all(request.names, _desk(request))
    on = printing.console(json=json)
    done = []
    for one in outcomes:
        done.append(one)
        if one.why is None:
            one.print_on(on)
        else:
            of = f"{one.run}: " if len(request.names) > 1 else ""
            printing.aside(f"bench: {of}{one.why}")
    printing.write_json([CertificateResult(certificates=done).to_dict()], json)
    issued = sum(one.why is None for one in done)
    if any(one.number and not one.issued_before for one in done):
        _say_unsigned(request)
    return 0 if issued == len(done) else 1 if issued else 2


def _say_unsigned(request: Issuing) -> None:
    if request.key is None:
        printing.aside("bench: not signed; --key FILE signs it")


@command(
    "bench certificate amend 2026-0007 unit-17 --reason 'name of the customer' --laboratory "
    "laboratory.yaml --order order.yaml --authorised-by 'A. Example'",
    to=GROUP,
)
def amend(request: AmendCertificate, json: JsonOption = None) -> int:
    """Issue a certificate with a new number that replaces a valid one."""
    from bench.certificate import life
    from bench.results.certificate import CertificateResult

    desk = _desk(request)
    issued = life.amend(request.number, request.run, desk, request.reason, replaced=request.replace)
    printing.write_json([CertificateResult(certificates=[issued]).to_dict()], json)
    issued.print_on(printing.console(json=json))
    _say_unsigned(request)
    return 0


@command(
    "bench certificate revoke 2026-0007 --reason 'wrong unit' --laboratory laboratory.yaml "
    "--authorised-by 'A. Example'",
    to=GROUP,
)
def revoke(request: RevokeCertificate) -> int:
    """Revoke a certificate; its files remain."""
    from bench.certificate import life

    life.revoke(request)
    printing.console().print(f"{request.number}: revoked")
    return 0


@command("bench certificate register 2026-0007 --out to-the-customer", to=GROUP)
def register(request: CheckRegister, json: JsonOption = None) -> int:
    """List and check issued certificates; exit status 1 if a record or file was changed."""
    from bench.certificate.life import checked

    result, files = checked(request)
    on = printing.console(json=json)
    printing.write_json([result.to_dict()], json)
    result.print_on(on)
    for file in files:
        on.print(f"wrote {file}")
    printing.aside(*(f"bench: {problem}" for problem in result.problems))
    result.print_head(on)
    return 1 if result.problems else 0


@command("bench certificate verify 2026-0007.pdf --trust laboratory.pem.crt", to=GROUP)
def verify(request: VerifyCertificate, json: JsonOption = None) -> int:
    """Check integrity, signature and validity of a certificate; exit status 1 if any fails."""
    from bench.certificate.laboratory import load_laboratory
    from bench.certificate.verify import verify_certificate

    register = None if request.laboratory is None else load_laboratory(request.laboratory).register_folder
    result = verify_certificate(request.file, request.trust, runs_folder(request.runs), register)
    printing.write_json([result.to_dict()], json)
    result.print_on(printing.console(json=json))
    return 0 if result.accepted else 1


@command("bench certificate read 2026-0007.xml --out coefficients.json", to=GROUP)
def read(request: ReadCertificate, json: JsonOption = None) -> int:
    """Read coefficients with covariance, or an instrument's entry for the bench file, from a certificate."""
    from bench.base.files import to_text, write_whole
    from bench.certificate.dcc.reading import coefficients_in, document_in, has_coefficients, section_of
    from bench.results.certificate import print_coefficients
    from bench.services.coefficients import holds_at
    from bench.services.source import check_gravity

    check_gravity(request.g)
    on = printing.console(json=json)
    root, notes = document_in(request.file)
    if request.out is None and json is None and not has_coefficients(root):
        section, further = section_of(request.file, root)
        on.print(section.rstrip())
        printing.notes_aside((*notes, *further))
        if request.into is not None:
            from bench.panel.round_trip import accept_certificate

            on.print(accept_certificate(request, section))
        return 0
    result, notes = coefficients_in(request.file, request.g, request.noise)
    printing.write_json([result], json)
    print_coefficients(result, holds_at(result), on)
    printing.notes_aside(notes)
    if request.out is not None:
        write_whole(request.out, to_text(result))
        on.print(f"coefficients: {request.out}")
    return 0


def _desk(request: Issuing) -> Desk:
    from bench.certificate.life import desk_of
    from bench.cli.printing import passphrase

    return desk_of(request, lambda: passphrase("Passphrase of the key: "))
