"""Effects stated as a formula in a file: their addition is an expression instead of a method."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Final, Generic, Protocol, TypeVar

import numpy as np

from bench.base.arrays import ARCSEC, CHANNELS, HOUR, MINUTE, Floats, Mask
from bench.model.effects.base import Effect, Parameter, Seen, Stage, Subsystem, Values, lagged
from bench.model.geometry import STAND_ANGLES

# --- expressions ------------------------------------------------------------------------------------
# The text is parsed, never executed: numbers, names, + - * / **, comparisons (1 if true, else 0) and calls of a few
# functions. All other Python syntax is refused with a sentence.

MOST_CHARACTERS: Final = 1000
"""The longest permitted expression; no formula for human readers is longer."""
MOST_NESTED: Final = 100
"""The deepest permitted nesting; a sum of n terms has n levels."""

FUNCTIONS: Final[Mapping[str, Callable[..., Any]]] = {
    "sin": np.sin, "cos": np.cos, "tan": np.tan, "exp": np.exp, "log": np.log, "sqrt": np.sqrt, "abs": np.abs,
    "sign": np.sign, "tanh": np.tanh, "min": np.minimum, "max": np.maximum,
}  # fmt: skip
"""The functions of one argument, and `min` and `max` with two. `lagged` (a signal and a lag) is separate."""

LAGGED: Final = "lagged"
OF_TWO: Final = ("min", "max", LAGGED)

_OPERATORS: Final[Mapping[type[ast.operator], str]] = {
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**",
}  # fmt: skip
_COMPARISONS: Final[Mapping[type[ast.cmpop], str]] = {
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=",
}  # fmt: skip


class ExpressionError(ValueError):
    """An invalid expression; the text gives the reason."""


Term = TypeVar("Term")


class ExpressionReading(Protocol, Generic[Term]):
    """An interpretation of an expression, for example as its value, its degree or its dimension."""

    def number(self, value: float, unit: str) -> Term:
        """Interpret a number that occurs in the expression.

        `value` is converted to SI, and `unit` is its SI unit, or "" for a plain number.
        """

    def name(self, name: str) -> Term:
        """Interpret a variable or a parameter."""

    def operation(self, symbol: str, left: Term, right: Term) -> Term:
        """Interpret one of + - * / ** or a comparison."""

    def call(self, name: str, arguments: list[Term]) -> Term:
        """Interpret a function call."""


QUANTITY: Final = re.compile(r"(?<![\w.])((?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?+)[ \t]*([A-Za-zµμ°′″]+)(?!\w)")
"""A number with its unit, "1.3 V"; the parser sees the unit as an attribute of the number, `(1.3).V`."""

UNITS: Final[Mapping[str, tuple[float, str]]] = {
    "V": (1.0, "V"), "mV": (1e-3, "V"), "uV": (1e-6, "V"), "s": (1.0, "s"), "ms": (1e-3, "s"),
    "min": (MINUTE, "s"), "h": (HOUR, "s"), "d": (24 * HOUR, "s"), "K": (1.0, "K"), "mK": (1e-3, "K"),
    "rad": (1.0, ""), "deg": (np.pi / 180, ""), "arcmin": (60 * ARCSEC, ""), "arcsec": (ARCSEC, ""),
    "rev": (2 * np.pi, ""), "g": (1.0, ""), "mg": (1e-3, ""), "ug": (1e-6, ""), "ppm": (1e-6, ""),
}  # fmt: skip
"""The units permitted after a number: the factor to SI, and the SI unit ("" for plain numbers)."""

_PLAIN: Final = str.maketrans({"µ": "u", "μ": "u", "°": "deg", "′": "arcmin", "″": "arcsec"})


@lru_cache(maxsize=2048)
def parse(text: str) -> ast.expr:
    """Return the syntax tree of an expression; a number with a unit is an attribute node, `(1.3).V`.

    Raises `ExpressionError` for any other Python syntax.
    """
    if len(text) > MOST_CHARACTERS:
        raise ExpressionError(
            f"the expression has {len(text)} characters; {MOST_CHARACTERS} are the limit; shorten it"
        )
    plain = QUANTITY.sub(lambda found: f"({found[1]}).{found[2].translate(_PLAIN)}", text.strip())
    try:
        tree = ast.parse(plain, mode="eval").body
    except (SyntaxError, ValueError, MemoryError, RecursionError) as error:
        reason = error.msg if isinstance(error, SyntaxError) else type(error).__name__
        raise ExpressionError(
            f"the expression is not a formula ({reason}); use numbers, names and operators"
        ) from None
    _refuse_others(tree, plain, MOST_NESTED)
    return tree


def _refuse_others(node: ast.AST, text: str, deeper: int) -> None:
    """Raise `ExpressionError` for the first forbidden node, or for more than `deeper` further levels of nesting."""
    if deeper == 0:
        raise ExpressionError(f"the expression is nested more than {MOST_NESTED} deep; simplify it")
    inside: Sequence[ast.expr] | None = None
    match node:
        case ast.Constant(value=bool() | str() | bytes() | complex() | None):
            pass
        case ast.Constant(value=int() | float()) | ast.Name():
            inside = ()
        case ast.Attribute(value=ast.Constant(value=int() | float()), attr=unit):
            if unit not in UNITS:
                raise ExpressionError(
                    f"'{unit}' after a number is not a unit of formulas; choose from {', '.join(UNITS)}"
                )
            inside = ()
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            inside = (left, right)
        case ast.UnaryOp(op=ast.UAdd() | ast.USub(), operand=operand):
            inside = (operand,)
        case ast.Compare(left=left, ops=[compare], comparators=[right]) if type(compare) in _COMPARISONS:
            inside = (left, right)
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
            _refuse_call(name, len(arguments))
            inside = arguments
    if inside is not None:
        for one in inside:
            _refuse_others(one, text, deeper - 1)
        return
    written = ast.get_source_segment(text, node) if isinstance(node, ast.expr) else None
    raise ExpressionError(
        f"'{written or text}' is not allowed in a formula; use numbers with units, names, + - * / **, "
        f"comparisons and the functions {', '.join(known_functions())}"
    )


def _refuse_call(name: str, given: int) -> None:
    if name not in known_functions():
        raise ExpressionError(f"unknown function '{name}'; choose from {', '.join(known_functions())}")
    wanted = 2 if name in OF_TWO else 1
    if given != wanted:
        raise ExpressionError(f"{name} takes {wanted} argument{'s' * (wanted > 1)}, not {given}")


def known_functions() -> tuple[str, ...]:
    """Return the names of all permitted functions."""
    return (*FUNCTIONS, LAGGED)


@lru_cache(maxsize=2048)
def names_in(text: str) -> tuple[str, ...]:
    """Return the names of the variables and parameters of an expression, in order of first appearance."""
    tree = parse(text)
    called = {id(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    found = [node for node in ast.walk(tree) if isinstance(node, ast.Name) and id(node) not in called]
    found.sort(key=lambda node: (node.lineno, node.col_offset))
    return tuple(dict.fromkeys(node.id for node in found))


@lru_cache(maxsize=2048)
def calls_in(text: str) -> frozenset[str]:
    """Return the names of the functions that an expression calls."""
    nodes = ast.walk(parse(text))
    return frozenset(n.func.id for n in nodes if isinstance(n, ast.Call) and isinstance(n.func, ast.Name))


@lru_cache(maxsize=2048)
def lags_in(text: str) -> tuple[ast.expr, ...]:
    """Return the lag times in an expression: the second arguments of all calls of `lagged`."""
    nodes = (n for n in ast.walk(parse(text)) if isinstance(n, ast.Call))
    return tuple(n.args[1] for n in nodes if isinstance(n.func, ast.Name) and n.func.id == LAGGED)


def interpret(text: str, reading: ExpressionReading[Term]) -> Term:
    """Return the result of interpreting an expression by `reading`. Raises the `ExpressionError` of `reading`."""
    return _read(parse(text), reading)


def _read(node: ast.expr, reading: ExpressionReading[Term]) -> Term:
    match node:
        case ast.Constant(value=int() | float() as value):
            return reading.number(_as_float(value), "")
        case ast.Attribute(value=ast.Constant(value=int() | float() as value), attr=unit):
            si, of_unit = UNITS[unit]
            return reading.number(_as_float(value) * si, of_unit)
        case ast.Name(id=name):
            return reading.name(name)
        case ast.UnaryOp(op=op, operand=operand):
            sign = -1.0 if isinstance(op, ast.USub) else 1.0
            return reading.operation("*", reading.number(sign, ""), _read(operand, reading))
        case ast.BinOp(left=left, op=op, right=right):
            return reading.operation(_OPERATORS[type(op)], _read(left, reading), _read(right, reading))
        case ast.Compare(left=left, ops=[op], comparators=[right]):
            return reading.operation(_COMPARISONS[type(op)], _read(left, reading), _read(right, reading))
        case ast.Call(func=ast.Name(id=name), args=arguments):
            return reading.call(name, [_read(argument, reading) for argument in arguments])
    raise ExpressionError(f"'{ast.unparse(node)}' is not allowed in a formula")  # not reached after `parse`


def _as_float(value: int | float) -> float:
    try:
        return float(value)
    except OverflowError:
        raise ExpressionError("a number in the formula is too large; use a smaller one") from None


class ValueReading:
    """An interpretation of an expression as its numeric value.

    `names` maps variables and parameters to values; `lagged` is the lag function. The caller suppresses numpy's
    warnings of results that are not finite.
    """

    def __init__(self, names: Mapping[str, Floats], lagged: Callable[[Floats, Floats], Floats]) -> None:
        self._names = names
        self._lagged = lagged

    def number(self, value: float, unit: str) -> Floats:
        """Return the number as an array."""
        return np.asarray(value)

    def name(self, name: str) -> Floats:
        """Return the value of a name. Raises `ExpressionError` for a name without a value."""
        if name not in self._names:
            raise ExpressionError(f"'{name}' has no value; give it one")
        return self._names[name]

    def operation(self, symbol: str, left: Floats, right: Floats) -> Floats:
        """Return the result of an operation, which may be infinite or NaN."""
        return np.asarray(_OPERATIONS[symbol](left, right), dtype=np.float64)

    def call(self, name: str, arguments: list[Floats]) -> Floats:
        """Return the result of a function call."""
        if name == LAGGED:
            return self._lagged(*arguments)
        return np.asarray(FUNCTIONS[name](*arguments), dtype=np.float64)


_OPERATIONS: Final[Mapping[str, Callable[[Floats, Floats], Any]]] = {
    "+": np.add, "-": np.subtract, "*": np.multiply, "/": np.divide, "**": np.float_power,
    "<": np.less, "<=": np.less_equal, ">": np.greater, ">=": np.greater_equal,
}  # fmt: skip


class DegreeReading:
    """An interpretation of an expression as its degree in the size parameters, 0 or 1.

    The addition of an effect must have degree 1 in each of its terms.
    """

    def __init__(self, sizes: frozenset[str]) -> None:
        self._sizes = sizes
        self._named = ", ".join(sorted(sizes)) or "none is stated"

    def number(self, value: float, unit: str) -> int:
        """Return 0."""
        return 0

    def name(self, name: str) -> int:
        """Return 1 for a size parameter, 0 for any other name."""
        return int(name in self._sizes)

    def operation(self, symbol: str, left: int, right: int) -> int:
        """Return the degree of the result. Raises `ExpressionError` if it is not linear in the sizes."""
        if symbol in {"+", "-"}:
            if left != right:
                raise ExpressionError(
                    f"a term has no size ({self._named}); multiply each term by a size, so that the effect "
                    "vanishes for zero sizes"
                )
            return left
        if symbol == "*" and left + right <= 1:
            return left + right
        if symbol == "/" and right == 0:
            return left
        if left == right == 0:
            return 0
        raise ExpressionError(
            f"the effect is not linear in its sizes ({self._named}): one is multiplied by another, or is in a "
            f"power, a divisor or a comparison; {GRID_HINT}"
        )

    def call(self, name: str, arguments: list[int]) -> int:
        """Return 0. Raises `ExpressionError` if an argument contains a size parameter."""
        if any(arguments):
            raise ExpressionError(
                f"{name} contains a size ({self._named}), in which an effect must be linear; {GRID_HINT}"
            )
        return 0


GRID_HINT: Final = "give that parameter a grid of values to be tried, then it is a shape"


# --- effects ----------------------------------------------------------------------------------------

SUBSYSTEM_OF: Final[Mapping[Stage, Subsystem]] = {
    Stage.STAND: Subsystem.STAND,
    Stage.HEAD_ANGLE: Subsystem.STAND,
    Stage.SPECIFIC_FORCE: Subsystem.SITE,
    Stage.BLOCK_OUTPUT: Subsystem.BLOCK,
    Stage.VOLTMETER_READING: Subsystem.VOLTMETER,
}
"""The default subsystem of a formula, by its stage."""

OF_THE_HEAD: Final = ("angle", "turned", "wound", "travelled")
"""Variables that have no value for a reading without a head angle."""


@dataclass(frozen=True)
class FormulaEffect(Effect):
    """An effect whose addition is an expression in the variables of its stage and its parameters, in SI.

    At the stage STAND the value is added to the angle `adds_to`. At BLOCK_OUTPUT it is in g, and the channel's
    scale factor converts it to volts. Raises `ExpressionError` for an invalid expression.
    """

    name: str
    stage: Stage
    subsystem: Subsystem
    parameters: tuple[Parameter, ...]
    sentence: str
    shown_by: str
    expression: str
    adds_to: str = ""
    per_mount: bool = False
    lasts: bool = False
    origin: str = field(default="", compare=False, repr=False)
    """File and line of the expression, for error messages; empty if it was not read from a file."""

    def __post_init__(self) -> None:
        """Raise `ExpressionError` unless every name is known and each term has degree 1 in the sizes."""
        names = names_in(self.expression)
        own = {parameter.name for parameter in self.parameters}
        variables = variables_of(self.stage)
        for name in names:
            if name not in own and name not in variables:
                known = ", ".join(variables)
                raise ExpressionError(f"'{name}' is unknown; at the stage '{self.stage}' there are {known}")
        for parameter in self.parameters:
            if parameter.name not in names:
                raise ExpressionError(
                    f"the parameter '{parameter.name}' is not in the expression; use or remove it"
                )
        shapes = {parameter.name for parameter in self.parameters if parameter.is_shape}
        for lag in lags_in(self.expression):
            if not isinstance(lag, ast.Constant | ast.Attribute) and not (
                isinstance(lag, ast.Name) and lag.id in shapes
            ):
                raise ExpressionError(
                    "state the lag of 'lagged' as a number of seconds or a parameter with a grid"
                )
        if (self.adds_to in STAND_ANGLES) != (self.stage is Stage.STAND):
            raise ExpressionError(
                f"an effect at the stage '{Stage.STAND}' needs 'adds_to', one of {', '.join(STAND_ANGLES)}; leave "
                "'adds_to' out at other stages"
            )
        sizes = frozenset(parameter.name for parameter in self.parameters if not parameter.is_shape)
        if interpret(self.expression, DegreeReading(sizes)) != 1:
            raise ExpressionError("the expression has no size; add a parameter without a grid")

    @property
    def needs_history(self) -> bool:  # type: ignore[override]
        """Whether a reading depends on earlier readings."""
        looks_back = {"turned", "wound", "travelled", "visit", "since_mounting"}
        return (
            self.lasts
            or LAGGED in calls_in(self.expression)
            or not looks_back.isdisjoint(names_in(self.expression))
        )

    def addition(self, values: Values, seen: Seen) -> Floats:
        """Return the addition at the stage (see `Effect.addition`).

        A non-finite result counts as 0 in a reading without a head angle if one of its variables is unknown.
        In any other reading it raises `ExpressionError`.
        """
        used = frozenset(names_in(self.expression))
        known = {name: of(seen) for name, of in variables_of(self.stage).items() if name in used}
        channels = self.stage in _WITH_CHANNELS
        if channels:
            known = {name: c if c.ndim == 2 else c[..., None] for name, c in known.items()}
        time_s = seen.conditions.elapsed_s
        reading = ValueReading({**known, **values}, lambda course, lag: _lagged(course, time_s, lag))
        with np.errstate(all="ignore"):
            added = interpret(self.expression, reading)
        shape = (len(seen.conditions), 3) if channels else (len(seen.conditions),)
        away = ~np.isfinite(seen.conditions.angle_rad)
        if used.isdisjoint(OF_THE_HEAD):
            away &= _unseen(known.values(), len(away))
        added = self._finite(np.broadcast_to(added, shape), away)
        if self.stage is Stage.STAND:
            placed = np.zeros_like(seen.signal)
            placed[:, STAND_ANGLES.index(self.adds_to)] = added
            return placed
        return added * seen.scale if self.stage is Stage.BLOCK_OUTPUT else added

    def _finite(self, added: Floats, away: Mask) -> Floats:
        """Return `added`, with 0 for each value that is not finite in the readings of the mask `away` (n,).

        These readings lack values of variables. Raises `ExpressionError` for such a value in any other reading.
        """
        bad = ~np.isfinite(added)
        if not bad.any():
            return added
        added = np.where(away.reshape(-1, *(1,) * (added.ndim - 1)), 0.0, added)
        bad = ~np.isfinite(added)
        if bad.any():
            row = int(np.flatnonzero(bad.reshape(len(added), -1).any(axis=1))[0])
            raise ExpressionError(
                f"{f'{self.origin}: ' if self.origin else ''}the formula of {self.name} gives no finite number for "
                f"reading {row + 1}, as a division by zero does; change the expression, "
                "such as by max(…, 1e-6) in a divisor or a logarithm"
            )
        return added


_WITH_CHANNELS: Final = (Stage.SPECIFIC_FORCE, Stage.BLOCK_OUTPUT, Stage.VOLTMETER_READING)

Variable = Callable[[Seen], Floats]

SINCE_POWER_ON: Final = "since_power_on"
"""The time since power-on; for readings without it, the time since the start of the run."""


def variables_of(stage: Stage) -> dict[str, Variable]:
    """Return the variables of a formula at a stage: name -> function from `Seen` to values (n,) or (n, 3)."""
    match stage:
        case Stage.SPECIFIC_FORCE | Stage.BLOCK_OUTPUT:
            return _COMMON | _own_and_each("a") | {"aj": _axis_after(1), "ak": _axis_after(2)}
        case Stage.VOLTMETER_READING:
            return _COMMON | _own_and_each("U")
        case _:
            return dict(_COMMON)


def _own_and_each(letter: str) -> dict[str, Variable]:
    """Return the variables of a signal: for "a" they are a (on each channel's own axis), ax, ay and az."""
    each = {letter + channel: _axis(i) for i, channel in enumerate(CHANNELS)}
    return {letter: lambda seen: seen.signal, **each}


def _axis(number: int) -> Variable:
    return lambda seen: seen.signal[:, number]


def _axis_after(steps: int) -> Variable:
    return lambda seen: np.roll(seen.signal, -steps, axis=1)


_COMMON: Final[dict[str, Variable]] = {
    "pi": lambda seen: np.full(len(seen.conditions), np.pi),
    "angle": lambda seen: seen.conditions.angle_rad,
    "turned": lambda seen: seen.conditions.head_turns.turned,
    "wound": lambda seen: seen.conditions.head_turns.wound,
    "travelled": lambda seen: seen.conditions.head_turns.travelled,
    "direction": lambda seen: seen.conditions.direction.astype(np.float64),
    "time": lambda seen: seen.conditions.elapsed_s,
    "since_start": lambda seen: seen.conditions.elapsed_s,
    "since_mounting": lambda seen: seen.conditions.since_mounting_s,
    SINCE_POWER_ON: lambda seen: seen.conditions.switched_on_s,
    "temperature": lambda seen: seen.conditions.warmth_k,
    "pass_number": lambda seen: seen.conditions.pass_number.astype(np.float64),
    "visit": lambda seen: seen.conditions.head_turns.visit,
}


def _lagged(course: Floats, time_s: Floats, lag: Floats) -> Floats:
    """Return a signal after a first-order lag (see `lagged`), column by column."""
    whole = np.broadcast_to(course, (len(time_s), *np.shape(course)[1:]))
    if whole.ndim == 1:
        return lagged(whole, time_s, float(lag))
    return np.stack([lagged(column, time_s, float(lag)) for column in whole.T], axis=1)


def _unseen(variables: Iterable[Floats], readings: int) -> Mask:
    """Return the mask (n,) of the readings for which a variable is not finite, such as `a` at a shorted input."""
    missing = np.zeros(readings, dtype=bool)
    for values in variables:
        if values.ndim and len(values) == readings:
            missing |= ~np.isfinite(values).reshape(readings, -1).all(axis=1)
    return missing
