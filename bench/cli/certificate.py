"""certificate: certificates issued, amended, revoked, handed out again and read."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from typer.core import TyperGroup

from bench.cli import completing, printing
from bench.cli.options import RUNS, JsonOption, RunsOption
from bench.services.errors import Refused

if TYPE_CHECKING:
    from bench.certificate.life import Desk, Outcome


class IssueByDefault(TyperGroup):
    """The commands on certificates; what begins with none of them is to be issued."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put `issue` in front of a run."""
        first = next(iter(args), "--help")
        if first not in self.commands and first not in {"--help", "-h"}:
            args = ["issue", *args]
        return list(super().parse_args(ctx, args))


GROUP: Final = typer.Typer(
    name="certificate",
    cls=IssueByDefault,
    no_args_is_help=True,
    rich_markup_mode=None,
    epilog="Example: bench certificate unit-17 --laboratory laboratory.yaml --order order.yaml "
    "--authorised-by 'A. Example'",
    help="Certificates, on paper and for machines: issue, verify, amend, revoke, read.",
)

LaboratoryOption = Annotated[
    Path | None,
    typer.Option(
        "--laboratory",
        metavar="FILE",
        envvar="BENCH_LABORATORY",
        help="Laboratory file; 'bench init' has one.",
    ),
]
OrderOption = Annotated[
    Path | None, typer.Option("--order", metavar="FILE", help="Order file; 'bench init' has one.")
]
ByOption = Annotated[
    str | None,
    typer.Option("--authorised-by", metavar="NAME", help="Who authorises, as the laboratory file has it."),
]
SchemaOption = Annotated[
    Path | None,
    typer.Option(
        "--schema", metavar="DIR", help="The institute's schemas (DCC 3.3.0, D-SI 2.2.1): checked against."
    ),
]
KeyOption = Annotated[
    str | None,
    typer.Option(
        "--key", metavar="KEY", help="Key to sign with: a file (PEM), or pkcs11:… of one in a token."
    ),
]
ChainOption = Annotated[
    Path | None,
    typer.Option("--chain", metavar="FILE", help="Certificates of the key (PEM), where not beside it."),
]
ReasonOption = Annotated[str, typer.Option("--reason", metavar="TEXT", help="Why; it is written down.")]
NumberArgument = Annotated[str, typer.Argument(help="Number of a certificate.")]


@GROUP.command(
    epilog="Example: bench certificate issue unit-17 unit-18 --laboratory laboratory.yaml --order order.yaml "
    "--authorised-by 'A. Example'"
)
def issue(
    runs_: Annotated[
        list[str],
        typer.Argument(metavar="RUN…", help="Runs, by name or path.", autocompletion=completing.runs),
    ],
    laboratory: LaboratoryOption = None,
    order: OrderOption = None,
    authorised_by: ByOption = None,
    draft: Annotated[
        bool, typer.Option("--draft", help="A draft with a water mark; needs neither laboratory nor order.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Where drafts go (default: the run's folder).")
    ] = None,
    key: KeyOption = None,
    chain: ChainOption = None,
    schema: SchemaOption = None,
    json: JsonOption = None,
    runs: RunsOption = RUNS,
) -> int:
    """Issue the certificate of a run, once: NUMBER.pdf and NUMBER.xml in the folder of the register."""
    from bench.certificate.life import drafts, issue_all

    printing.check_target(json)
    if draft:
        outcomes = drafts(runs_, runs, laboratory, order, out)
    else:
        outcomes = issue_all(runs_, _desk(runs, laboratory, order, authorised_by, key, chain, schema))
    on = printing.console(json=json)
    done: list[dict[str, Any]] = []
    for outcome in outcomes:
        done.append(outcome.to_json())
        _print(outcome, on, several=len(runs_) > 1)
    printing.write_json([{"certificates": done}], json)
    issued = sum(one["why"] is None for one in done)
    if not draft and any(one["number"] and not one["issued_before"] for one in done):
        _say_unsigned(key)
    return 0 if issued == len(done) else 1 if issued else 2


def _say_unsigned(key: str | None) -> None:
    if key is None:
        printing.aside("bench: not signed; --key FILE signs what is issued")


def _print(outcome: Outcome, on: Any, *, several: bool) -> None:
    if outcome.why:
        printing.aside(f"bench: {outcome.why if not several else f'{outcome.run}: {outcome.why}'}")
        return
    said = "issued before as" if outcome.before_now else "issued as" if outcome.number else "draft"
    on.print(f"{outcome.run}: {said} {outcome.number}".rstrip())
    for file in outcome.files:
        on.print(f"  {file}")


@GROUP.command(
    epilog="Example: bench certificate amend 2026-0007 unit-17 --reason 'name of the customer' --laboratory "
    "laboratory.yaml --order order.yaml --authorised-by 'A. Example'"
)
def amend(
    number: NumberArgument,
    run: Annotated[str, typer.Argument(help="Run, by name or path.", autocompletion=completing.runs)],
    reason: ReasonOption,
    laboratory: LaboratoryOption = None,
    order: OrderOption = None,
    authorised_by: ByOption = None,
    replace: Annotated[
        bool, typer.Option("--replace", help="It replaces the other as a whole: another run, other results.")
    ] = False,
    key: KeyOption = None,
    chain: ChainOption = None,
    schema: SchemaOption = None,
    json: JsonOption = None,
    runs: RunsOption = RUNS,
) -> int:
    """Issue a certificate in place of one that holds; it has a number of its own, and names the one before."""
    from bench.certificate import life

    printing.check_target(json)
    desk = _desk(runs, laboratory, order, authorised_by, key, chain, schema)
    outcome = life.amend(number, run, desk, reason, replaced=replace)
    printing.write_json([{"certificates": [outcome.to_json()]}], json)
    _print(outcome, printing.console(json=json), several=False)
    _say_unsigned(key)
    return 0


@GROUP.command(
    epilog="Example: bench certificate revoke 2026-0007 --reason 'wrong unit' --laboratory laboratory.yaml "
    "--authorised-by 'A. Example'"
)
def revoke(
    number: NumberArgument,
    reason: ReasonOption,
    laboratory: LaboratoryOption = None,
    authorised_by: ByOption = None,
) -> int:
    """Write down that a certificate holds no more. Its files stay."""
    from bench.certificate import life
    from bench.certificate.laboratory import load_laboratory
    from drivers.clock import utc_now

    stated = load_laboratory(_needed(laboratory, "--laboratory FILE"))
    by = _needed(authorised_by, "--authorised-by NAME")
    life.revoke(number, stated, by, reason, utc_now())
    printing.console().print(f"{number}: revoked")
    return 0


@GROUP.command(epilog="Example: bench certificate register 2026-0007 --out to-the-customer")
def register(
    number: Annotated[str | None, typer.Argument(help="One certificate; all if left out.")] = None,
    laboratory: LaboratoryOption = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Hand the files of NUMBER out again, into a folder."),
    ] = None,
    again: Annotated[
        bool,
        typer.Option("--again", help="Make the unsigned certificates from their records again, and compare."),
    ] = False,
    json: JsonOption = None,
    runs: RunsOption = RUNS,
) -> int:
    """What was issued: chain and files are checked; exit status 1 where one is not what it was."""
    from bench.certificate.laboratory import load_laboratory
    from bench.certificate.life import checked, handed_out
    from bench.certificate.register import opened

    printing.check_target(json)
    if out is not None and number is None:
        raise Refused("--out: say the number of the certificate that is handed out")
    folder = load_laboratory(_needed(laboratory, "--laboratory FILE")).register_folder
    with opened(folder) as book:
        found = checked(book, number, runs if again else None)
        files = [] if out is None or number is None else handed_out(book, number, out)
    on = printing.console(json=json)
    told = {
        "register": str(folder),
        "head": found.head,
        "certificates": found.rows,
        "problems": list(found.problems),
    }
    printing.write_json([told], json)
    for row in found.rows:
        state = row["state"] + (f" ({row['by']})" if row["by"] else "")
        state += "" if row["signed_by"] else ", not signed"
        on.print(f"{row['number']}  {row['issued'][:10]}  {row['unit']}  {row['run']}  {state}")
    for file in files:
        on.print(f"wrote {file}")
    for problem in found.problems:
        printing.aside(f"bench: {problem}")
    on.print(f"{len(found.rows)} certificates, chain of hashes whole, head {found.head}")
    return 1 if found.problems else 0


@GROUP.command(epilog="Example: bench certificate verify 2026-0007.pdf --trust laboratory.pem.crt")
def verify(
    file: Annotated[Path, typer.Argument(help="Certificate, PDF or XML; the other form is found beside it.")],
    trust: Annotated[
        Path | None,
        typer.Option(
            "--trust", metavar="FILE", help="Certificates (PEM) of signers or authorities that are believed."
        ),
    ] = None,
    laboratory: Annotated[
        Path | None,
        typer.Option(
            "--laboratory",
            metavar="FILE",
            help="Laboratory file: its register is asked (default: the one where FILE stands).",
        ),
    ] = None,
    json: JsonOption = None,
    runs: RunsOption = RUNS,
) -> int:
    """Whether a certificate is intact, who signed it and whether it still holds; exit status 1 where not."""
    from bench.certificate.laboratory import load_laboratory
    from bench.certificate.verify import verify_certificate
    from bench.cli.certificate_verdict import print_verdict

    printing.check_target(json)
    register = None if laboratory is None else load_laboratory(laboratory).register_folder
    verdict = verify_certificate(file, trust, runs, register)
    printing.write_json([verdict.to_json()], json)
    print_verdict(verdict, printing.console(json=json))
    return 0 if verdict.accepted else 1


@GROUP.command(epilog="Example: bench certificate read 2026-0007.xml --out coefficients.json")
def read(
    file: Annotated[
        Path, typer.Argument(help="Digital calibration certificate, anybody's: XML, or the PDF that has it.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="FILE", help="Where the coefficients go, for verify --coefficients and compare."
        ),
    ] = None,
    g: Annotated[
        float | None,
        typer.Option("--g", metavar="M/S2", help="Local gravity for which K of another's is stated."),
    ] = None,
    noise: Annotated[
        str | None,
        typer.Option(
            "--noise", metavar="VOLTAGE", help="Noise of a reading, '50 uV', where the maker is another."
        ),
    ] = None,
    json: JsonOption = None,
) -> int:
    """Take coefficients with covariance out of a certificate; of an instrument's, print it for the bench file."""
    from bench.base.files import to_text, write_whole
    from bench.base.units import VOLTAGE, parse_quantity
    from bench.certificate.dcc.reading import coefficients_in, document_in, has_coefficients, section_of
    from bench.services.source import check_gravity

    printing.check_target(json)
    check_gravity(g)
    on = printing.console(json=json)
    root, notes = document_in(file)
    if out is None and json is None and not has_coefficients(root):
        section = section_of(file, root)
        on.print(section.text.rstrip())
        printing.notes_aside((*notes, *section.notes))
        return 0
    try:
        noise_v = None if noise is None else parse_quantity(noise, VOLTAGE)
    except ValueError as error:
        raise Refused(f"--noise: {error}") from None
    found = coefficients_in(file, g, noise_v)
    printing.write_json([found.result], json)
    _print_coefficients(found.result, on)
    printing.notes_aside(found.notes)
    if out is not None:
        write_whole(out, to_text(found.result))
        on.print(f"coefficients: {out}")
    return 0


def _print_coefficients(result: dict[str, Any], on: Any) -> None:
    from bench.base.numbers import fixed, places

    shown = printing.table("coefficient", ">value", ">u", "")
    for name, one in result["coefficients"].items():
        digits = places(one["u"])
        unit = result["unit"] + ("" if name.startswith("U0") else "/g")
        shown.add_row(name, fixed(one["value"], digits), fixed(one["u"], digits), unit)
    on.print(shown)


def _desk(
    runs: Path,
    laboratory: Path | None,
    order: Path | None,
    by: str | None,
    key: str | None,
    chain: Path | None,
    schema: Path | None,
) -> Desk:
    """Return what certificates are issued with, all of it read and checked. Raises `Refused`, `FileMistakes`."""
    from bench.base.yaml_files import load_document
    from bench.certificate.life import Desk
    from drivers.clock import utc_now

    lacking = [
        option
        for option, given in (
            ("--laboratory FILE", laboratory), ("--order FILE", order), ("--authorised-by NAME", by),
        )
        if given is None
    ]  # fmt: skip
    if laboratory is None or order is None or by is None:
        raise Refused(f"a certificate needs {', '.join(lacking)}; a draft (--draft) needs none of them")
    schemas = None
    if schema is not None:
        from bench.certificate.dcc.rules import read_schemas

        schemas = read_schemas(schema)
    signatory = None
    if key is not None:
        from bench.certificate.signatory import signatory_of
        from bench.cli.passphrase import passphrase as typed

        signatory = signatory_of(key, chain, lambda: typed("Passphrase of the key: "), utc_now())
    desk = Desk(runs, load_document(laboratory), load_document(order), by, utc_now, signatory, schemas)
    desk.person(desk.laboratory)
    return desk


def _needed(given: Any, option: str) -> Any:
    if given is None:
        raise Refused(f"say {option}")
    return given
