"""The counts of the third trial, and the bounds with which they are compared."""

import re
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from scipy.stats import binom, binomtest

from benchmarks.campaign import Share, markdown, shares
from benchmarks.third_trial.forms import SCATTER

Record = dict[str, Any]
Marks = dict[str, bool | None]
LARGE: Final = 12.0
"""Least rho of effects for which closed gaps and silent verdicts are judged."""
APART: Final = 4.0
"""Least part, in units of noise, that a rival leaves unexplained if the data decide between two names.

A name that leaves at least this part is wrong.
"""
CLOSED: Final = 0.8
"""Least closed fraction of the gap, relative to the gap that the true form closes."""
UNNAMED: Final = "unnamed_form"
PATTERNS: Final = ("unnamed", "free_by", "single_", "slow_in_time")
"""Prefixes of the names of unnamed forms."""
_NOTHING: Final = re.compile(r"(NOTHING FOUND: )?readings and model agree within the noise")
_PLACE: Final = re.compile(r"\bV\b|verification|point|channel|outlier|tails|slow|nois|round|off\b|\b[xyz]\b")


def silent(one: Record) -> bool:
    """Whether the verdict is "agrees" and the headline names nothing."""
    said = one["names"] or _PLACE.search(_NOTHING.sub("", one["headline"]))
    return one["verdict"] == "agrees" and not said


def alone(one: Record) -> bool:
    """Whether the verdict names one effect without ties."""
    return one["verdict"] == "named" and not any(one["ties"])


def in_set(one: Record) -> set[str]:
    """Return the names found and all names tied with them."""
    return {*one["names"], *(name for tie in one["ties"] for name in tie)}


def true_name(one: Record) -> str:
    """Return the true name of a case's effect, `UNNAMED` for a form without a name, "" for a null case.

    For a form outside the catalogue, the first name found counts as true if it leaves less than a unit of
    noise unexplained or, if this trial does not know the name, closes the gap.
    """
    if one["group"] != "outside":
        return str(one["name"])
    first = one["names"][0]
    left = one["leaves"].get(first)
    named = not first.startswith(PATTERNS) and (_closes(one) if left is None else left < 1)
    return first if named else UNNAMED


def _closes(one: Record) -> bool:
    return (one.get("closed") or 0.0) >= CLOSED


def marks_of(one: Record) -> Marks:
    """Return the marks of a case of the main trial: right, wrong, or None if not applicable."""
    failed: Marks = {"failed": one["verdict"] == "error"}
    if one["group"] == "null":
        return failed | {"null agrees": one["verdict"] == "agrees"}
    lone, first, large = alone(one), [*one["names"], ""][0], one["rho"] >= LARGE
    closed, left = _closes(one), one.get("left")
    # a name that this trial does not know is judged by the gap that it closes
    wrong = lone and first != one["name"] and (not closed if left is None else left >= APART)
    marks = failed | {"lone names that leave 4": wrong if lone else None}
    if one["group"] == "outside":
        mean, told = one["name"] not in SCATTER, silent(one)
        return marks | {
            "outside silent, mean form": told if large and mean else None,
            "outside silent, scatter": told if large and not mean else None,
            "outside closed": closed if large and mean else None,
        }
    right, rival, gap = lone and set(one["names"]) == {one["name"]}, one["rival"][1], one.get("gap", {})
    measured = large and first == one["name"] and gap.get("before") is not None
    return marks | {
        "detected": one["verdict"] != "agrees",
        "true name in the set": one["name"] in in_set(one) if one["verdict"] != "agrees" else None,
        "alone and right": right,
        "alone and right, rival leaves 4": right if rival >= APART else None,
        "alone, rival leaves below 1": lone if rival < 1 else None,
        "lone names that are wrong": not right if lone else None,
        "gap measured": gap.get("before") is not None if large and first == one["name"] else None,
        "gap shrinks": gap["shrinks"] is not False and gap["after"] < gap["before"] if measured else None,
        "catalogue closed": closed if large else None,
    }


def far_marks(one: Record) -> Marks:
    """Return the marks of a case in which something is far off."""
    where = any(word in one["headline"] for word in one["right"])
    anywhere = any(word in one.get("text", "") for word in one["right"])
    return {"silent": silent(one), "place in the headline": where, "place in the text": anywhere}


def mistake_marks(one: Record) -> Marks:
    """Return the marks of a case with a mistake; it counts as corrected within 4.5 u in all twelve coefficients."""
    after = one.get("off", {}).get("after")
    return {
        "detected": not silent(one),
        "named": bool(in_set(one) & set(one["right"])),
        "named alone": bool(one["names"]) and set(one["names"]) <= set(one["right"]) and not any(one["ties"]),
        "put right": after is not None and max(map(abs, after)) < 4.5,
    }


def form_marks(one: Record) -> Marks:
    """Return the marks of a model's effect on the coefficients of a new day.

    The time at which a drift counts as zero affects only the biases. A confounded name is in the model only because
    the trial accepts the first one; the cases without it are counted again as unforced, and those in which the
    program added a form as form added.
    """
    if "new_day" not in one:
        return {"model file": False}
    unforced, added = one["verdict"] != "confounded", one["verdict"] == "unknown"
    before, after = (np.abs(one["new_day"][when]) for when in ("before", "after"))
    worse = after > before + 1
    better = bool(np.sum(after**2) < np.sum(before**2))
    return {
        "model file": True,
        "better": better,
        "worse by more than u": bool(worse.any()),
        "K worse by more than u": bool(worse[:9].any()),
        "unforced, better": better if unforced else None,
        "unforced, worse by more than u": bool(worse.any()) if unforced else None,
        "form added, better": better if added else None,
        "form added, worse by more than u": bool(worse.any()) if added else None,
    }


JUDGED: Final[dict[str, Callable[[Record], Marks]]] = {
    "main": marks_of, "far": far_marks, "mistakes": mistake_marks, "forms": form_marks,
    "nulls": marks_of, "declared": lambda one: {"failed": one["verdict"] == "error"},
}  # fmt: skip
BOUNDS: Final = {
    "failed": ("<=", 0.0), "null agrees": (">=", 0.99), "outside silent, mean form": ("<=", 0.03),
    "outside silent, scatter": ("<=", 0.15), "outside closed": (">=", 0.85),
    "lone names that leave 4": ("<=", 0.02), "lone names that are wrong": ("<=", 0.015),
    "gap shrinks": (">=", 0.95), "alone and right, rival leaves 4": (">=", 0.92),
    "alone, rival leaves below 1": ("<=", 0.02), "silent": ("<=", 0.0), "place in the headline": (">=", 1.0),
    "named": (">=", 1.0), "better": (">=", 0.8), "worse by more than u": ("<=", 0.02),
}  # fmt: skip
"""Relation and bound for each column."""


def report(trial: str, found: Sequence[Record]) -> tuple[str, int]:
    """Return tables and bounds as text, and the number of missed bounds."""
    marks = [JUDGED[trial](one) for one in found]
    total = shares(marks)
    lines = [f"\n## {trial}: {len(found)} cases", "", *markdown(["", "share"], total.items())]
    kinds: dict[str, dict[str, list[Marks]]] = {}
    for one, its in zip(found, marks, strict=True):
        kinds.setdefault(one["group"], {}).setdefault(one["name"] or one["noise"], []).append(its)
    for group, by_name in kinds.items():
        heads = list(dict.fromkeys(head for its in by_name.values() for one in its for head in one))
        rows = [
            [name, *(f"{s.successes}/{s.of}" for s in shares(its).values())] for name, its in by_name.items()
        ]
        lines += ["", *markdown([group, *heads], rows)]
    said = []
    for name, (sign, limit) in BOUNDS.items():
        if share := total.get(name):
            met = share.of == 0 or (share.part <= limit if sign == "<=" else share.part >= limit)
            said.append(f"{name}: {share}; asked {sign} {limit:g}: {'met' if met else 'NOT MET'}")
    if trial == "main":
        said += _coefficients(found)
    if trial in {"main", "declared"}:
        said += _posteriors(found)
        for group in ("catalogue", "outside"):
            of_group = _posteriors([one for one in found if one["group"] == group])
            said += [f"{group} cases, {line.rpartition(': ')[0]}" for line in of_group]
    cpu = np.quantile([one["cpu"] for one in found if "cpu" in one], [0.5, 0.95])
    lines += ["", *said, f"CPU of a diagnosis: median {cpu[0]:.2f} s, 95 % {cpu[1]:.2f} s"]
    return "\n".join(lines), sum(line.endswith("NOT MET") for line in said)


def _coefficients(found: Sequence[Record]) -> list[str]:
    """Judge the coefficients of null cases, which checks the trial, and of cases with only the right name."""
    right = [
        one
        for one in found
        if one["group"] == "catalogue" and alone(one) and set(one["names"]) == {one["name"]}
    ]
    lines = []
    for what, cases in (
        ("of nulls", [one for one in found if one["group"] == "null"]),
        ("after naming", right),
    ):
        share = Share.true(np.abs([one["off"]["after"] for one in cases if "off" in one]) <= 2)
        met = not share.of or 0.94 <= share.part <= 0.98
        lines.append(
            f"coefficients {what} within 2 u: {share}; asked 0.94 to 0.98: {'met' if met else 'NOT MET'}"
        )
    return lines


def _posteriors(found: Sequence[Record]) -> list[str]:
    """Compare stated probabilities with how often they are right, in five bins with 99 % binomial limits.

    All forms without a name count as one. The diagnosis expects 24 times as many effects of the catalogue as forms
    without a name (`KIND_PRIOR`); the trial draws equally many, which it declares as `--declared`. The bins of
    each group are printed, too, without a judgement.
    """
    stated: list[tuple[float, bool]] = []
    for one in (one for one in found if one.get("odds")):
        odds: dict[str, float] = {}
        for odd in one["odds"]:
            name = next(iter(odd["names"]), "")
            name = UNNAMED if name.startswith(PATTERNS) else name
            odds[name] = odds.get(name, 0.0) + odd["probability"]
        stated += [(probability, name == true_name(one)) for name, probability in odds.items()]
    if not stated:
        return ["posterior probabilities: not stated"]
    p, true = np.array(stated, dtype=float).T
    lines = []
    for low, high in ((0.01, 0.2), (0.2, 0.4), (0.4, 0.6), (0.6, 0.8), (0.8, 1.01)):
        mine = (p >= low) & (p < high)
        n, right, due = int(mine.sum()), int(true[mine].sum()), float(p[mine].sum())
        least, most = binom.interval(0.99, n, due / n) if n else (0, 0)
        met = "met" if least <= right <= most else "NOT MET"
        asked = f"{due:.1f} due; asked {least:.0f} to {most:.0f}: {met}"
        lines.append(f"stated {low:.2f} to {high:.2f}: {right} of {n} right, {asked}")
    return lines


def against(trial: str, new: Sequence[Record], old: Sequence[Record]) -> str:
    """Return a table of the cases that differ between two runs, with McNemar's exact p of each column."""
    before = {(one["seed"], one["number"]): JUDGED[trial](one) for one in old}
    after = {(one["seed"], one["number"]): JUDGED[trial](one) for one in new}
    pairs = [(before[key], after[key]) for key in after if key in before]
    rows = []
    for name in dict.fromkeys(name for pair in pairs for marks in pair for name in marks):
        both = [(was[name], now[name]) for was, now in pairs if None not in {was.get(name), now.get(name)}]
        gone, come = both.count((True, False)), both.count((False, True))
        p = binomtest(come, gone + come).pvalue if gone + come else 1.0
        held = [sum(bool(one[k]) for one in both) for k in (0, 1)]
        rows.append([name, len(both), *held, come, gone, f"{p:.2g}"])
    heads = ["column", "cases", "before", "now", "come", "gone", "McNemar's p"]
    return "\n".join(["", f"{len(pairs)} cases beside those of the other run", "", *markdown(heads, rows)])
