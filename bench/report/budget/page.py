"""The page of a budget: one HTML file that needs nothing but itself, from the result as JSON has it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from markupsafe import Markup

from bench.analysis.calibration.conformity import DecisionRule
from bench.analysis.calibration.verdict_words import rule_in_words
from bench.base.numbers import fixed
from bench.report.budget.plots import contributions, modulus
from bench.report.tables import Row, symbol
from bench.report.template import page


def render_budget(result: Mapping[str, Any]) -> str:
    """Return the page; the same result gives the same text."""
    check = result["verification"]
    return page(
        "budget.html.j2",
        result=result,
        headings=["source", *(symbol(name) for name in result["order"])],
        coefficients=_coefficients(result),
        sources=_sources(result),
        accelerations=_accelerations(result),
        points=_points(result),
        verdict={True: "passed", False: "failed", None: "none"}[check["capable"]],
        limit=f"{1e6 * check['limit_g']:g}",
        rule_in_words=rule_in_words(DecisionRule.of_json(check)),
        monte_carlo=_monte_carlo(result),
        contributions=Markup(contributions(result).svg()),  # noqa: S704 - our own drawing
        modulus=Markup(modulus(result).svg()),  # noqa: S704
    )


def _coefficients(result: Mapping[str, Any]) -> list[Row]:
    rows = [
        Row(f"{name.replace('_', ' ')}{' *' if source['prior'] else ''}", _micro(source["contribution_u"]))
        for name, source in result["sources"].items()
    ]
    coefficients = [result["coefficients"][name] for name in result["order"]]
    rows.append(Row("stand, as calibrate states", _micro(result["groups"]["stand"]["u"])))
    rows.append(Row("combined u, per local g", _micro(result["per_local_g"]["u"])))
    rows.append(Row("combined u", _micro([one["u"] for one in coefficients])))
    rows.append(
        Row(
            "effective dof", tuple("∞" if one["dof"] is None else f"{one['dof']:.0f}" for one in coefficients)
        )
    )
    rows.append(Row("k", tuple(f"{one['k']:.2f}" for one in coefficients)))
    rows.append(Row("U", _micro([one["U"] for one in coefficients])))
    return rows


def _sources(result: Mapping[str, Any]) -> list[Row]:
    return [
        Row(
            f"{name.replace('_', ' ')} ({source['symbol']})",
            (
                source["shown"], source["distribution"], source["common_to"],
                "∞" if source["dof"] is None else f"{source['dof']:g}", source["origin"],
            ),
        )
        for name, source in result["sources"].items()
    ]  # fmt: skip


def _accelerations(result: Mapping[str, Any]) -> list[Row]:
    rows = []
    for at in result["acceleration"]["magnitudes"]:
        name, share = max(at["share"].items(), key=lambda item: item[1])
        sizes = [at[key] for key in ("u_modulus_mean", "u_modulus_max", "U_modulus_max", "u_vector_mean")]
        rows.append(Row(f"{at['magnitude_g']:g} g", (*_micro(sizes), f"{name} ({100 * share:.0f} %)")))
    return rows


def _points(result: Mapping[str, Any]) -> list[Row]:
    return [
        Row(
            f"point {point['point']} at {point['angle_deg']:g}°",
            (
                *_micro([point["u"], point["U"]]),
                fixed(1e6 * point["accepted_up_to"], 1) if point["accepted_up_to"] > 0 else "nothing",
                f"{100 * point['passes']:.4g} %",
            ),
            bad=not point["capable"],
        )
        for point in result["verification"]["points"]
    ]


def _monte_carlo(result: Mapping[str, Any]) -> list[Row]:
    if result["monte_carlo"] is None:
        return []
    return [
        Row(
            name,
            (
                *_micro([output["u_linear"], output["u"]]),
                f"{output['ratio']:.3f}",
                *_micro([*output["differences"], output["tolerance"]]),
                "yes" if output["validated"] else "no",
            ),
            bad=not output["validated"],
        )
        for name, output in result["monte_carlo"]["outputs"].items()
    ]


def _micro(values: Sequence[float]) -> tuple[str, ...]:
    return tuple(fixed(1e6 * value, 1) if abs(value) >= 5e-8 else "0" for value in values)
