"""check: what a procedure will do on a bench, before it does it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Final

import typer

from bench.cli import printing
from bench.cli.options import (
    RUNS,
    BenchOption,
    JsonOption,
    ProcedureArgument,
    RunsOption,
    UntilOption,
    app,
    devices_given,
)

if TYPE_CHECKING:
    from rich.console import Console

    from bench.planning.settings import Outlook
    from bench.services.until import Findings

_WAYS_LISTED: Final = 2


@app.command(epilog="Example: bench check calibration --bench my-bench.yaml")
def check(
    procedure: ProcedureArgument,
    bench: BenchOption = None,
    json: JsonOption = None,
    every_step: Annotated[
        bool, typer.Option("--all", help="List each step, not runs of equal ones.")
    ] = False,
    instruments: Annotated[
        bool, typer.Option("--instruments", help="Then open the bench's instruments, too.")
    ] = False,
    until: UntilOption = None,
    runs: RunsOption = RUNS,
) -> int:
    """Validate a procedure against a bench and print steps, time and operator actions; touch no instrument."""
    from bench.services.until import look_ahead

    found = look_ahead(procedure, bench, runs, until or ())
    printing.write_json([found.to_json()], json)
    if json != "-":
        _print(found, every_step=every_step)
        _offer_dry_run(found, procedure, bench)
    status = 1 if found.problems else 0
    if not instruments:
        return status
    from bench.cli.instruments import look

    return max(status, look(bench))


def _print(found: Findings, *, every_step: bool) -> None:
    from bench.config.procedure.check import switched_before
    from bench.config.procedure.listing import listing
    from bench.run.sentences import duration
    from bench.services.until import disk_space, outlook_in_words

    out = printing.console()
    plan, bench = found.plan, found.bench
    if (before := switched_before(plan, bench)) is not None:
        out.print(f"{'before':>13}  {before}")
    for line in listing(plan, every_step=every_step):
        steps = f"{line.first}" if line.first == line.last else f"{line.first}–{line.last}"
        out.print(f"{steps:>13}  {line.text}")
    counts = {kind: str(count) for kind, count in plan.counts().items()}
    _print_times(out, "step", found.by_kind_s, counts)
    _print_times(out, "installation", {name or "before": s for name, s in found.by_mount_s.items()}, {})
    at_most = f" (at most {duration(found.longest_s)})" if found.longest_s > found.expected_s else ""
    out.print(
        f"{plan.name} on {bench.name}: {len(plan.steps)} steps, {found.operator_actions} operator actions, "
        f"about {duration(found.expected_s)}{at_most}; plan {plan.hash[:12]}"
    )
    out.print(
        f"signals up to {found.largest_signal_v:.3g} V at nominal scale factors, on the "
        f"{bench.voltmeter_range_v:g} V range; about {disk_space(found.needed_bytes)} in {found.runs}, where "
        f"{disk_space(found.free_bytes)} are free"
    )
    for sentence in _coefficients_in_words(found.undetermined):
        out.print(sentence)
    for sentence in _outlook_in_words(found.outlook):
        out.print(sentence)
    if found.until is not None:
        out.print(f"--until: {outlook_in_words(found.until)}")
    for hint in found.hints:
        out.print(f"look: {hint}")
    for problem in found.problems:
        out.print(f"cannot be done: {problem}")
    for sentence in found.unanswered:
        out.print(f"a dry run refuses it: {sentence}")


def _print_times(out: Console, heading: str, times_s: Mapping[str, float], counts: Mapping[str, str]) -> None:
    from bench.run.sentences import duration

    table = printing.table(heading, *([">count"] if counts else []), ">expected time")
    for name, seconds in times_s.items():
        table.add_row(name, *([counts.get(name, "")] if counts else []), duration(seconds))
    out.print(table)


def _coefficients_in_words(undetermined: Mapping[float | None, tuple[str, ...]]) -> Iterator[str]:
    """Say which coefficients a calibration from the plan determines; by temperature where there are several."""
    from bench.model.geometry import COEFFICIENTS

    if not undetermined:
        yield "no calibration: it has no reading in an installation of known orientation"
    for names in dict.fromkeys(undetermined.values()):
        temperatures = [at_c for at_c, these in undetermined.items() if these == names]
        listed = ", ".join(
            "the first temperature" if at_c is None else f"{at_c:g} °C" for at_c in temperatures
        )
        where = f"at {listed}: " if len(undetermined) > 1 else ""
        if not names:
            yield f"{where}determines all twelve coefficients"
        elif len(names) == len(COEFFICIENTS):
            yield f"{where}no calibration: the orientations determine none of the twelve coefficients"
        else:
            determined = [name for name in COEFFICIENTS if name not in names]
            yield (
                f"{where}no calibration by itself: the orientations determine {', '.join(determined)} and "
                f"leave {', '.join(names)} open"
            )


def _outlook_in_words(found: Outlook | None) -> Iterator[str]:
    """Say what the readings leave open between coefficients and stand, and the cheapest ways to show it."""
    if found is None:
        return
    for sentence in found.open:
        yield f"leaves open: {sentence}"
    if found.open:
        ways = "; ".join(f"{r.text} ({_cost_in_words(r.cost_s)})" for r in found.remedies[:_WAYS_LISTED])
        yield f"would be shown by: {ways or 'nothing that this bench can do'}"
    if found.turns:
        yield (
            f"leaves open, as every procedure on one head does: a common turn of the block's axes (about "
            f"{', '.join(found.turns)}); the limits of the stand's angles alone hold it"
        )


def _cost_in_words(seconds: float) -> str:
    from bench.run.sentences import duration

    return f"about {duration(seconds)} more" if seconds else "no further readings"


def _offer_dry_run(found: Findings, procedure: str, bench_name: str | None) -> None:
    if found.problems or found.unanswered:
        return
    on = f" --bench {bench_name}" if bench_name else ""
    on += "".join(f" --devices {folder}" for folder in devices_given.get())
    printing.console().print(
        f"no mistakes found; try it in seconds with: bench run {procedure}{on} --dry-run"
    )
