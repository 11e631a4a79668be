"""tumble: each accelerometer of a multi-point tumble by the terms of IEEE Std 1293."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

import typer

from bench.cli import printing
from bench.cli.options import (
    RUNS,
    BenchOption,
    GravityOption,
    JsonOption,
    OutOption,
    RunsOption,
    SkipOption,
    Sources,
    StrictFitOption,
    app,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rich.console import Console
    from rich.table import Table

    from bench.calibration.tumble import TumbleView

CLOSE = 0.95
"""A correlation beyond which two terms are told to hang together."""


@app.command(epilog="Example: bench tumble unit-17-turn-12 --terms K2,K3")
def tumble(
    sources: Sources,
    terms: Annotated[
        str,
        typer.Option(metavar="TERM,…", help="Nonlinear terms: of K2, K3, Koq, Kip, Kio, Kpo, Kpp, Koo."),
    ] = "K2,K3,Koq",
    bench: BenchOption = None,
    g: GravityOption = None,
    json: JsonOption = None,
    out: OutOption = None,
    skip_bad_rows: SkipOption = False,
    strict: StrictFitOption = False,
    runs: RunsOption = RUNS,
) -> int:
    """Each axis of a multi-point tumble by IEEE 1293: bias, scale factor, misalignments, K2, K3, Koq."""
    from bench.services.compensation import tumble_of
    from bench.services.source import Request, load_sources

    printing.check_target(json)
    loaded = load_sources(Request(sources, runs, bench, None, g, out, skip_bad_rows))
    printing.bench_files(loaded, json)
    asked = [term.strip() for term in terms.split(",") if term.strip()]
    results, fits = [], True
    for source in loaded:
        view = tumble_of(source, asked)
        unit = source.bench.unit_under_test
        result = {
            **view.to_json(),
            "source": source.name,
            "bench": source.taken.to_dict(),
            "made_at": source.made_at,
            "unit_under_test": {"type": unit.type, "serial": unit.serial} if source.block_name else None,
            "simulated": source.simulated,
            "corrections": source.traced.to_json(),
            "notes": [
                *view.lack_of_fit.diagnose(source.name),
                *view.notes,
                *source.readings.notes,
                *source.readings.skipped,
            ],
        }
        results.append(result)
        fits = fits and view.lack_of_fit.accepted(strict=strict)
        file = printing.write_result(source, "tumble", result, what_if=source.what_if)
        on = printing.console(json=json)
        _print(view, source.name, on)
        printing.notes_on(on, result["notes"])
        if file is not None:
            printing.written("result", file, on)
    printing.write_json(results, json)
    return 0 if fits else 1


def _print(view: TumbleView, name: str, on: Console) -> None:
    on.print(f"Tumble of {name}: {len(view.fitted)} readings, local g = {view.g_m_s2:.6g} m/s²")
    on.print(
        "E/K1 = K0 + a_i + cross-axis terms + K2 a_i² + K3 a_i³ + Koq a_i |a_i| + …, a in g, E in "
        + view.unit
    )
    on.print(_table(view))
    for own in view.judged:
        on.print(own.sentence())
    for first, second, r in _close(view):
        on.print(
            f"{first} and {second} hang together (r = {r:.3f}): a sum of them is known far better than each"
        )
    fit = view.lack_of_fit
    if math.isfinite(fit.p):
        verdict = "none shown at 1 %" if not fit.shown else "THESE TERMS DO NOT FIT the readings"
        on.print(
            f"lack of fit against the repeats: chi2 {fit.chi2:.1f} for {fit.dof}, p = {fit.p:.2g}: {verdict}"
        )
    else:
        on.print("lack of fit: too few repeats to tell")
    notes = [
        f"{_left_out(term, combined=view.combined)} in channel {channel}: 1 µg/g² of {term} moves {_moved(moved)}"
        for channel, by_term in view.left_out.items()
        for term, moved in by_term.items()
        if moved
    ]
    printing.notes_on(on, notes)


def _table(view: TumbleView) -> Table:
    """Return the quantities, rounded to two digits of u; angles in arcsec, all else of a channel in µg."""
    from bench.base.numbers import fixed, places

    shown = printing.table("", "", ">value", ">u", ">U (k=2)", ">u, readings", "")
    for channel, quantities in view.axes.items():
        for q in quantities:
            times, unit = 1.0, q.unit
            if q.unit == "rad":
                times, unit = math.degrees(1.0) * 3600, "arcsec"
            elif q.unit == "g" or q.unit.startswith("g/g^"):
                times, unit = 1e6, q.unit.replace("g", "µg", 1).replace("^2", "²").replace("^3", "³")
            digits = places(times * q.u)
            cells = (fixed(times * size, digits) for size in (q.value, q.u, 2 * q.u, q.u_readings))
            shown.add_row(channel, q.words, *cells, unit)
    return shown


def _close(view: TumbleView) -> list[tuple[str, str, float]]:
    """Return pairs of nonlinear terms of one channel that are hardly told apart, with their correlation."""
    pairs = [
        (f"{channel}.{a.name}", f"{channel}.{b.name}")
        for channel, own in view.axes.items()
        for n, a in enumerate(own)
        for b in own[n + 1 :]
        if "g/g^" in a.unit and "g/g^" in b.unit
    ]
    told = [(a, b, view.correlation(a, b)) for a, b in pairs]
    return [pair for pair in told if abs(pair[2]) > CLOSE]


def _left_out(term: str, *, combined: bool) -> str:
    from bench.calibration.budget.whole import OF_BLOCK

    return "not fitted, but in u," if combined and term in OF_BLOCK else "taken as zero"


def _moved(moved: Mapping[str, float]) -> str:
    """Return what a term that was left out moves, in words: "K0 by +0.50"."""
    from bench.base.numbers import fixed

    return ", ".join(f"{name} by {fixed(by, 2, sign=True)}" for name, by in moved.items())
