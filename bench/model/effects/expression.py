"""The expressions of effects that are stated as a formula: read through a short list of what may stand in one.

The text is parsed, never run: numbers, names, + - * / **, comparisons (1 where true, 0 else) and calls of a few
functions; whatever else can be written in Python is refused with a sentence.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, Final, Generic, Protocol, TypeVar

import numpy as np

from bench.base.arrays import Floats

MOST_CHARACTERS: Final = 1000
"""Longer is no formula that a person reads."""
MOST_NESTED: Final = 100
"""Deeper is none, either; a sum of so many terms is as deep."""

FUNCTIONS: Final[Mapping[str, Callable[..., Any]]] = {
    "sin": np.sin, "cos": np.cos, "tan": np.tan, "exp": np.exp, "log": np.log, "sqrt": np.sqrt, "abs": np.abs,
    "sign": np.sign, "tanh": np.tanh, "min": np.minimum, "max": np.maximum,
}  # fmt: skip
"""What may be called, with one number; `min` and `max` with two, `lagged` with a course and a lag."""

LAGGED: Final = "lagged"
OF_TWO: Final = ("min", "max", LAGGED)

_OPERATORS: Final[Mapping[type[ast.operator], str]] = {
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**",
}  # fmt: skip
_COMPARISONS: Final[Mapping[type[ast.cmpop], str]] = {
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=",
}  # fmt: skip


class ExpressionError(ValueError):
    """An expression that cannot be taken; the text says why."""


Term = TypeVar("Term")


class Reading(Protocol, Generic[Term]):
    """One way to read an expression: for its values, for its degree in the parameters, for its dimension."""

    def number(self, value: float) -> Term:
        """Read a number as written."""

    def name(self, name: str) -> Term:
        """Read a variable or a parameter."""

    def operation(self, symbol: str, left: Term, right: Term) -> Term:
        """Read one of + - * / ** or a comparison."""

    def call(self, name: str, arguments: list[Term]) -> Term:
        """Read the call of a function."""


@lru_cache(maxsize=2048)
def parse(text: str) -> ast.expr:
    """Return the tree of an expression. Raises `ExpressionError` where anything else stands in it."""
    if len(text) > MOST_CHARACTERS:
        raise ExpressionError(f"the expression has {len(text)} characters; {MOST_CHARACTERS} is the most")
    try:
        tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, MemoryError, RecursionError) as error:
        reason = error.msg if isinstance(error, SyntaxError) else type(error).__name__
        raise ExpressionError(f"this cannot be read as a formula ({reason})") from None
    _refuse_others(tree, text, MOST_NESTED)
    return tree


def _refuse_others(node: ast.AST, text: str, deeper: int) -> None:
    """Raise `ExpressionError` for the first thing that is not on the list, or not within so many others."""
    if deeper == 0:
        raise ExpressionError(f"the expression is nested more than {MOST_NESTED} deep")
    match node:
        case ast.Constant(value=bool() | str() | bytes() | complex() | None):
            pass
        case ast.Constant(value=int() | float()) | ast.Name():
            return
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            _refuse_others(left, text, deeper - 1)
            _refuse_others(right, text, deeper - 1)
            return
        case ast.UnaryOp(op=ast.UAdd() | ast.USub(), operand=operand):
            _refuse_others(operand, text, deeper - 1)
            return
        case ast.Compare(left=left, ops=[op], comparators=[right]) if type(op) in _COMPARISONS:
            _refuse_others(left, text, deeper - 1)
            _refuse_others(right, text, deeper - 1)
            return
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
            _refuse_call(name, len(arguments))
            for argument in arguments:
                _refuse_others(argument, text, deeper - 1)
            return
    written = ast.get_source_segment(text.strip(), node) if isinstance(node, ast.expr) else None
    raise ExpressionError(
        f"'{written or text}' may not stand in a formula; numbers, names, + - * / **, comparisons and "
        f"{', '.join(known_functions())} may"
    )


def _refuse_call(name: str, given: int) -> None:
    if name not in known_functions():
        raise ExpressionError(f"there is no function '{name}'; there are {', '.join(known_functions())}")
    wanted = 2 if name in OF_TWO else 1
    if given != wanted:
        raise ExpressionError(f"{name} takes {wanted} argument{'s' * (wanted > 1)}, not {given}")


def known_functions() -> tuple[str, ...]:
    """Return the names of all functions."""
    return (*FUNCTIONS, LAGGED)


@lru_cache(maxsize=2048)
def names_in(text: str) -> tuple[str, ...]:
    """Return the names of variables and parameters in the order in which they first stand."""
    tree = parse(text)
    called = {id(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    found = [node for node in ast.walk(tree) if isinstance(node, ast.Name) and id(node) not in called]
    found.sort(key=lambda node: (node.lineno, node.col_offset))
    return tuple(dict.fromkeys(node.id for node in found))


@lru_cache(maxsize=2048)
def calls_in(text: str) -> frozenset[str]:
    """Return the names of the functions that are called."""
    nodes = ast.walk(parse(text))
    return frozenset(n.func.id for n in nodes if isinstance(n, ast.Call) and isinstance(n.func, ast.Name))


@lru_cache(maxsize=2048)
def lags_in(text: str) -> tuple[ast.expr, ...]:
    """Return the second arguments of all calls of `lagged`."""
    nodes = (n for n in ast.walk(parse(text)) if isinstance(n, ast.Call))
    return tuple(n.args[1] for n in nodes if isinstance(n.func, ast.Name) and n.func.id == LAGGED)


def interpret(text: str, reading: Reading[Term]) -> Term:
    """Read an expression in one of the ways; the reading raises `ExpressionError` as it likes."""
    return _read(parse(text), reading)


def _read(node: ast.expr, reading: Reading[Term]) -> Term:
    match node:
        case ast.Constant(value=int() | float() as value):
            return reading.number(_as_float(value))
        case ast.Name(id=name):
            return reading.name(name)
        case ast.UnaryOp(op=op, operand=operand):
            sign = -1.0 if isinstance(op, ast.USub) else 1.0
            return reading.operation("*", reading.number(sign), _read(operand, reading))
        case ast.BinOp(left=left, op=op, right=right):
            return reading.operation(_OPERATORS[type(op)], _read(left, reading), _read(right, reading))
        case ast.Compare(left=left, ops=[op], comparators=[right]):
            return reading.operation(_COMPARISONS[type(op)], _read(left, reading), _read(right, reading))
        case ast.Call(func=ast.Name(id=name), args=arguments):
            return reading.call(name, [_read(argument, reading) for argument in arguments])
    raise ExpressionError(f"'{ast.unparse(node)}' may not stand in a formula")  # `parse` refused it before


def _as_float(value: int | float) -> float:
    try:
        return float(value)
    except OverflowError:
        raise ExpressionError("a number in the formula is too large to hold") from None


class ValueReading:
    """The values of an expression: `names` holds those of variables and parameters, `lagged` the function.

    What is not finite numpy would warn of: whoever reads an expression so keeps it quiet, once for all operations.
    """

    def __init__(self, names: Mapping[str, Floats], lagged: Callable[[Floats, Floats], Floats]) -> None:
        self._names = names
        self._lagged = lagged

    def number(self, value: float) -> Floats:
        """Return the number."""
        return np.asarray(value)

    def name(self, name: str) -> Floats:
        """Return the value of a name. Raises `ExpressionError` where nobody gave one."""
        if name not in self._names:
            raise ExpressionError(f"'{name}' has no value")
        return self._names[name]

    def operation(self, symbol: str, left: Floats, right: Floats) -> Floats:
        """Return what an operation gives; what is not finite is found out by whoever asked."""
        return np.asarray(_OPERATIONS[symbol](left, right), dtype=np.float64)

    def call(self, name: str, arguments: list[Floats]) -> Floats:
        """Return what a function gives."""
        if name == LAGGED:
            return self._lagged(*arguments)
        return np.asarray(FUNCTIONS[name](*arguments), dtype=np.float64)


_OPERATIONS: Final[Mapping[str, Callable[[Floats, Floats], Any]]] = {
    "+": np.add, "-": np.subtract, "*": np.multiply, "/": np.divide, "**": np.float_power,
    "<": np.less, "<=": np.less_equal, ">": np.greater, ">=": np.greater_equal,
}  # fmt: skip


class DegreeReading:
    """The degree in parameters that are sizes: 0 or 1. An effect has degree 1 in every term."""

    def __init__(self, sizes: frozenset[str]) -> None:
        self._sizes = sizes

    def number(self, value: float) -> int:
        """Return 0."""
        return 0

    def name(self, name: str) -> int:
        """Return 1 for a size, 0 for all else."""
        return int(name in self._sizes)

    def operation(self, symbol: str, left: int, right: int) -> int:
        """Return the degree of an operation. Raises `ExpressionError` where it is not linear."""
        if symbol in {"+", "-"}:
            if left != right:
                raise ExpressionError(
                    "a term has no size in it: each must be multiplied by one of the sizes, so that the effect is "
                    "nothing where they are zero"
                )
            return left
        if symbol == "*" and left + right <= 1:
            return left + right
        if symbol == "/" and right == 0:
            return left
        if left == right == 0:
            return 0
        raise ExpressionError(
            "a size is multiplied by another or stands in a power, a divisor or a comparison: the effect is not "
            f"linear in it; {GRID_HINT}"
        )

    def call(self, name: str, arguments: list[int]) -> int:
        """Return 0. Raises `ExpressionError` where a size stands in a function."""
        if any(arguments):
            raise ExpressionError(f"a size stands in {name}: the effect is not linear in it; {GRID_HINT}")
        return 0


GRID_HINT: Final = "give it a grid of values to be tried, then it is a shape"
