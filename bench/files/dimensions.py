"""Whether a formula adds like to like: time, voltage, temperature, length; angles and g count as plain numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from bench.base.units import Dimension, unit_of
from bench.model import Stage
from bench.model.effects import ExpressionError, FormulaEffect
from bench.model.effects.expression import LAGGED, interpret
from bench.model.effects.formula import variables_of

_OF_VARIABLE: Final[Mapping[str, str]] = {
    "time": "s", "temperature": "K", "U": "V", "Ux": "V", "Uy": "V", "Uz": "V",
}  # fmt: skip
"""Units of the variables that are no plain numbers."""

Known = dict[str, Dimension]


def dimension_mistake(effect: FormulaEffect) -> str | None:
    """Return a sentence where the formula does not give what its stage is added to, None where it does."""
    known: Known = {name: unit_of(_OF_VARIABLE.get(name, ""))[1] for name in variables_of(effect.stage)}
    known |= {p.name: unit_of("" if p.unit == "1" else p.unit)[1] for p in effect.parameters}
    wanted = unit_of("V" if effect.stage is Stage.VOLTMETER_READING else "")[1]
    try:
        got = interpret(effect.expression, _DimensionReading(known))
    except ExpressionError as error:
        return str(error)
    if got[1] == wanted:
        return None
    return f"the expression gives {_told(got[1])}, and {_told(wanted)} is added at the stage '{effect.stage}'"


class _DimensionReading:
    """The dimension of a part of an expression, with its value where it is a number as written."""

    def __init__(self, known: Known) -> None:
        self._known = known

    def number(self, value: float) -> tuple[float | None, Dimension]:
        """Return a plain number."""
        return value, ()

    def name(self, name: str) -> tuple[float | None, Dimension]:
        """Return the dimension of a name."""
        return None, self._known[name]

    def operation(
        self, symbol: str, left: tuple[float | None, Dimension], right: tuple[float | None, Dimension]
    ) -> tuple[float | None, Dimension]:
        """Return the dimension of an operation. Raises `ExpressionError` where unlike things meet."""
        of_left, of_right = left[1], right[1]
        if symbol == "*":
            both = None if left[0] is None or right[0] is None else left[0] * right[0]
            return both, _product(of_left, of_right, 1.0)
        if symbol == "/":
            return None, _product(of_left, of_right, -1.0)
        if symbol == "**":
            return None, self._power(of_left, right)
        if of_left != of_right and not (left[0] == 0.0 or right[0] == 0.0):
            raise ExpressionError(f"{_told(of_left)} and {_told(of_right)} stand on two sides of '{symbol}'")
        if symbol in {"+", "-"}:
            return None, of_left or of_right
        return None, ()

    def _power(self, base: Dimension, exponent: tuple[float | None, Dimension]) -> Dimension:
        if exponent[1]:
            raise ExpressionError(f"an exponent is a plain number, and this one is in {_told(exponent[1])}")
        if not base:
            return ()
        if exponent[0] is None:
            raise ExpressionError(f"{_told(base)} is raised to a power that is no number as written")
        return _product((), base, exponent[0])

    def call(
        self, name: str, arguments: list[tuple[float | None, Dimension]]
    ) -> tuple[float | None, Dimension]:
        """Return the dimension of what a function gives. Raises `ExpressionError` where it takes no such thing."""
        of_first = arguments[0][1]
        match name:
            case "abs":
                return None, of_first
            case "sqrt":
                return None, _product((), of_first, 0.5)
            case "sign":
                return None, ()
            case "min" | "max":
                return self.operation("+", arguments[0], arguments[1])
            case _ if name == LAGGED:
                if arguments[1][1] != unit_of("s")[1] and arguments[1][0] is None:
                    raise ExpressionError("the second argument of 'lagged' is a time")
                return None, of_first
        if of_first:
            raise ExpressionError(f"{name} takes a plain number or an angle, and is given {_told(of_first)}")
        return None, ()


def _product(left: Dimension, right: Dimension, power: float) -> Dimension:
    total = dict(left)
    for name, exponent in right:
        total[name] = total.get(name, 0.0) + power * exponent
    return tuple(sorted((name, exponent) for name, exponent in total.items() if exponent))


def _told(dimension: Dimension) -> str:
    parts = [name if exponent == 1 else f"{name}^{exponent:g}" for name, exponent in dimension]
    return "*".join(parts) or "a plain number or an angle"
