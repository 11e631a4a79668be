"""What came of a batch, printed for a person."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from bench.cli import printing

if TYPE_CHECKING:
    from rich.console import Console

    from bench.batch.outcome import Outcome

_SHOWN: Final = 20


def print_outcome(outcome: Outcome, out: Console) -> None:
    """Print how many verdicts are other ones, which, how far coefficients went, and where the tables are."""
    told = outcome.summary
    _runs(told, out)
    _verdicts(told, out)
    if told["different"]:
        _different(told, out)
    if told["change_in_u"]:
        _coefficients(told, out)
    _failed(told, out)
    for name in (*told["files"], "summary.json"):
        out.print(f"  {outcome.folder / name}")
    differ = told["verdicts"]["different"]
    said = (
        "NO VERDICT WOULD BE DIFFERENT" if not differ else f"{_count(differ, 'VERDICT')} WOULD BE DIFFERENT"
    )
    failed = told["runs"]["failed"]
    out.print(said + (f"; {_count(failed, 'RUN')} FAILED" if failed else ""), style="bold")


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}" + ("" if number == 1 else "S" if what.isupper() else "s")


def _runs(told: Mapping[str, Any], out: Console) -> None:
    runs, program = told["runs"], told["program"]
    kinds = [f"{runs['simulated']:,} simulated"] if runs["simulated"] else []
    if left := runs["listed"] - runs["done"]:
        kinds.append(f"{left:,} not done yet")
    said = f" ({', '.join(kinds)})" if kinds else ""
    out.print(
        f"batch {told['command']} over {' '.join(told['over'])}: {_count(runs['listed'], 'run')}{said}, "
        f"program {program['version']} (code {program['code']})"
    )
    versions = {str(one["version"] or "not recorded"): one["runs"] for one in told["measured_with"]}
    if versions.keys() - {program["version"]}:
        listed = ", ".join(f"{version} ({count:,})" for version, count in versions.items())
        out.print(f"the runs were measured with program {listed}")
    words = [f"{name.replace('_', ' ')} {_asked(value)}" for name, value in told["asked"].items()]
    out.print(f"computed with: {', '.join(words) or 'what each run recorded'}")


def _asked(value: Any) -> str:
    if isinstance(value, Mapping):
        return str(value["file"])
    return {True: "on", False: "off"}[value] if isinstance(value, bool) else str(value)


def _verdicts(told: Mapping[str, Any], out: Console) -> None:
    found, runs = told["verdicts"], told["runs"]
    out.print(
        f"verdicts: {found['same']:,} the same, {found['different']:,} different, {found['unknown']:,} "
        f"with nothing to compare ({runs['without_stored_verdict']:,} without a stored one)"
    )
    for name, what in (("fit", "lack of fit"), ("names", "names of effects")):
        if told[name]:
            out.print(
                f"{what}: {told[name]['same']:,} judged the same, {told[name]['different']:,} otherwise"
            )
    if not found["changes"]:
        return
    shown = printing.table("stored", "now", ">runs", "")
    for one in found["changes"]:
        simulated = "simulated" if one["simulated"] else ""
        shown.add_row(one["stored"], one["now"], f"{one['runs']:,}", simulated)
    out.print(shown)


def _different(told: Mapping[str, Any], out: Console) -> None:
    diagnosis = told["names"] is not None
    headings = ("names stored", "names now") if diagnosis else (">worst Δg stored", ">now", ">most change")
    shown = printing.table("would be different", "unit", "stored", "now", *headings)
    for one in told["different"][:_SHOWN]:
        own = [one["names_stored"], one["names"]] if diagnosis else _sizes(one)
        shown.add_row(_short(one["run"]), one["serial"] or "", one["stored"], one["now"], *own)
    out.print(shown)
    _more(len(told["different"]), "verdicts.csv", out)


def _short(run: str) -> str:
    """Return the path of a run from the working folder, where it is in it."""
    path = Path(run)
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else run


def _sizes(one: Mapping[str, Any]) -> list[str]:
    stored, now, change = one["worst_delta_g_stored"], one["worst_delta_g"], one["largest_change_in_u"]
    sizes = ["" if size is None else f"{size * 1e6:+.1f} µg" for size in (stored, now)]
    return [*sizes, _change(change, one["largest_change_of"])]


def _change(change: float | None, name: str) -> str:
    if change is None:
        return ""
    return f"{change:.2g} u in {name}" if change else "none"


def _coefficients(told: Mapping[str, Any], out: Console) -> None:
    change, ratio = told["change_in_u"], told["u_ratio"]
    if change["most"] == 0.0:
        out.print("no coefficient has changed")
        return
    out.print(
        f"largest change of a coefficient in a run, in units of its stored u: median {change['median']:.2g}, "
        f"95 % up to {change['of_95_percent']:.2g}, most {change['most']:.2g} ({change['most_in']} of "
        f"{_short(change['most_of'])})"
    )
    if ratio:
        out.print(f"u of now over u stored: from {ratio['least']:.3g} to {ratio['most']:.3g}")


def _failed(told: Mapping[str, Any], out: Console) -> None:
    for one in told["failed"][:_SHOWN]:
        out.print(f"failed: {_short(one['run'])}: {one['why']}")
    _more(len(told["failed"]), "failed.csv", out)


def _more(count: int, file: str, out: Console) -> None:
    if count > _SHOWN:
        out.print(f"  … and more, all in {file}")
