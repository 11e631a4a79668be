"""A diagnosis in words, from the result as JSON has it: for the page and for the terminal alike."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from bench.base.numbers import fixed, quantity, rounded, two_digits
from bench.model import CATALOGUE

UNITS: Final = (("ug", "µg"), ("uV", "µV"), ("^2", "²"), ("^3", "³"), ("arcsec", "″"))
"""Units as files write them, and as a page does."""

MISTAKES: Final = frozenset(
    {
        "swapped_channels", "reversed_polarity", "reversed_rotation", "swapped_installations",
        "shifted_points", "wrong_setting", "outlier",
    }
)  # fmt: skip


MUCH_LESS_CERTAIN: Final = 2.0
"""A u that grows by no more than this is not worth a line."""

LEAST_P: Final = 1e-9
"""Smaller probabilities are not told: they would rest on the noise being normal far beyond what was ever seen."""

STILL_MISSING: Final = (
    "the readings still differ from the simulated bench by more than their repeats do, at 1 %: "
    "something small may be left"
)


def unit_in_print(unit: str) -> str:
    """Return a unit as it is printed: "µg/g²" for "ug/g^2"."""
    for written, printed in UNITS:
        unit = unit.replace(written, printed)
    return unit


def with_unit(number: str, unit: str) -> str:
    """Return a number with its unit as printed: "58 µg/g²", "8.1″", "0.3" where the unit is 1."""
    printed = unit_in_print(unit)
    if printed == "1":
        return number
    return f"{number}{printed}" if printed == "″" else f"{number} {printed}"


def mistakes_of(result: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return those entries of `effects` that are mistakes of procedure or wiring: they stand first."""
    return [effect for effect in result["effects"] if effect["name"] in MISTAKES]


def effects_of(result: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the others: effects by name, and what has none."""
    return [effect for effect in result["effects"] if effect["name"] not in MISTAKES]


def effect_title(effect: Mapping[str, Any]) -> str:
    """Return name, channels and mountings: "quadratic_nonlinearity of y"."""
    title = str(effect["name"])
    entry = CATALOGUE.get(title)
    of_channels = entry is None or any(parameter.per_channel for parameter in entry.parameters)
    if effect["channels"] and of_channels:
        title += f" of {', '.join(effect['channels'])}"
    if effect.get("installations"):
        several = "s" if len(effect["installations"]) > 1 else ""
        title += f" in installation{several} {', '.join(effect['installations'])}"
    return title


def parameters_in_words(effect: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each parameter, such as "K2 of y = 58.1 ± 5.2 µg/g² (u)"."""
    for name, told in effect["parameters"].items():
        yield from _values(name, told, "")
    for one in effect.get("together", ()):
        both = f"{rounded(one['value'], one['u'])} ± {two_digits(one['u'])}"
        yield (
            f"{one['combination']} of {one['parameter']} of {' and '.join(one['of'])} = "
            f"{with_unit(both, one['unit'])} (u): the readings tell this, and hardly either by itself"
        )


def _values(name: str, told: Mapping[str, Any], of: str) -> Iterator[str]:
    if "value" in told:
        if "u" in told:
            both = f"{rounded(told['value'], told['u'])} ± {two_digits(told['u'])}"
            value = f"{with_unit(both, told['unit'])} (u)"
        else:
            value = with_unit(format(told["value"], "g"), told["unit"])
            value += " (its shape, the likeliest of those tried)"
        yield f"{name}{of} = {value}"
        return
    for key, inner in told.items():
        if key in {"x", "y", "z"}:
            yield from _values(name, inner, f" of {key}{of}")
        else:  # a mounting's own values stand one level deeper: name is the mounting, key the parameter
            yield from _values(key, inner, f" in installation {name}")


def p_in_words(p: float, digits: int = 1) -> str:
    """Return "p = 0.003"; far out nobody knows how chance is distributed, and it is "p < 1e-09"."""
    return f"p < {LEAST_P:.0e}" if p < LEAST_P else f"p = {p:.{digits}g}"


def p_in_column(p: float, digits: int = 1) -> str:
    """Return the same below a heading that is p: "0.003", "< 1e-09"."""
    return p_in_words(p, digits).removeprefix("p ").removeprefix("= ")


def place_in_words(place: Mapping[str, Any]) -> str:
    """Return one pattern of the disagreement as a phrase."""
    where = "verification points" if place["channel"] == "modulus" else f"channel {place['channel']}"
    if place["installation"] == "all":
        where += ", whole run"
    elif place["channel"] != "modulus":
        where += f", installation {place['installation']}"
    size = quantity(place["size"], place["unit"])
    return f"{where}: {place['pattern']}, {size} ({p_in_words(place['p'])} with all looks)"


def smallest_found(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return for each effect that can be seen the size that is found in half of all runs, in its unit.

    It is that of the first parameter that has a size, in the form that shows best.
    """
    sizes = []
    for name, factor in result["detectable"].items():
        if factor is None or name in result["hidden"]:
            continue
        parameter = next(p for p in CATALOGUE[name].parameters if not p.is_shape)
        size = factor * parameter.plausible / parameter.si_per_unit
        sizes.append((name, with_unit(two_digits(size), parameter.unit)))
    return sizes


LEAD: Final[Mapping[str, str]] = {
    "agrees": "Nothing found",
    "mistake": "A mistake in procedure or wiring",
    "named": "Found and named",
    "confounded": "Found, but not told apart",
    "unknown": "Something unknown",
}
"""The verdict in a word or two."""


def verdict_in_words(result: Mapping[str, Any]) -> str:
    """Return what the verdict rests on, in one sentence without its end."""
    names = [effect_title(effect) for effect in effects_of(result)]
    gap = result["gap"]
    closed = ""
    if gap["before"] is not None and gap["after"] is not None:
        sizes = f"from {gap['before']:.2f} to {gap['after']:.2f} (noise alone: 1)"
        closed = f"; the gap on readings not used goes {sizes}"
    match result["verdict"]:
        case "agrees":
            return "readings and model agree within the noise"
        case "mistake":
            found = ", ".join(
                " or ".join([mistake["name"], *mistake["cannot_tell_from"]])
                for mistake in mistakes_of(result)
            )
            return f"{found}; put it right and measure again, or mend the readings file"
        case "named":
            return f"{', '.join(names)}{closed}"
        case "confounded":
            return f"{alike_in_words(effects_of(result))}{closed}"
    return f"{'; '.join(str(effect['words']) for effect in effects_of(result))}{closed}"


def alike_in_words(effects: Sequence[Mapping[str, Any]]) -> str:
    """Return what was found, each with what it cannot be told from: "bias_drift of x or warm_up"."""
    told = []
    for effect in effects:
        others = effect["cannot_tell_from"]
        told.append(effect_title(effect) + (f" or {' or '.join(others)}" if others else ""))
    return "; ".join(told)


def shift_in_words(result: Mapping[str, Any], found: int, other: str) -> str:
    """Return what would change were it `other` that is there, in place of the effect number `found`; or nothing."""
    for rival in result["ranking"][found]:
        if rival["name"] == other:
            shift = rival["largest_shift"]
            return (
                f"were it that, {shift['coefficient']} would differ by {fixed(shift['in_u'], 1, sign=True)} u"
            )
    return ""


def joined_in_words(result: Mapping[str, Any]) -> Iterator[str]:
    """Yield what the verification points say where they alone show what was found; nothing where not."""
    before, after = (result["simulation"][when] for when in ("before", "after"))
    if after is None or not after["verification_joined"]:
        return
    worst = [
        max((abs(point["delta_g"]) for point in one["delta_g"] if point["delta_g"] is not None), default=None)
        for one in (before, after)
    ]
    if None not in worst:
        sizes = [quantity(size, "g") for size in worst if size is not None]
        yield (
            "that is a test of the settings; some of what was found shows in the verification points alone: worst "
            f"|Δg| {sizes[0]} without, {sizes[1]} with it, which is no check, as they took part"
        )


def less_certain(result: Mapping[str, Any]) -> list[str]:
    """Return the coefficients whose u grows with what was found, and how many times: "Kyz (u 249 times)"."""
    grown = [
        (name, one["u_after"] / one["u_before"])
        for name, one in result["coefficients"].items()
        if one["u_before"] > 0
    ]
    grown.sort(key=lambda pair: -pair[1])
    return [f"{name} (u {two_digits(times)} times)" for name, times in grown if times > MUCH_LESS_CERTAIN]
