"""Formulas of GenICam descriptions, compiled to functions.

Source: GenICam Standard 2.1.1, section 2.8.11 (SwissKnife) and its table of operators.
"""

from __future__ import annotations

import functools
import math
import operator
import re
from collections.abc import Callable, Mapping
from typing import Final

from sim_hw import SimulatorError

Number = int | float
Evaluate = Callable[[Mapping[str, Number]], Number]

_TOKEN: Final = re.compile(
    r"\s*(?:(?P<number>0[xX][0-9a-fA-F]+|(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)"
    r"|(?P<name>[A-Za-z_][\w.]*)"
    r"|(?P<operator>\*\*|<<|>>|<=|>=|<>|&&|\|\||[-+*/%&|^~<>=?:(),]))"
)
_DEPTH_MAX: Final = 200
_INTEGER_MIN: Final = -(2**63)
_INTEGER_MAX: Final = 2**64 - 1


class FormulaError(SimulatorError, ValueError):
    """A formula that the standard does not allow, or that has no value."""


# A description repeats its formulas, and every emulated head of a camera compiles the same ones.
@functools.lru_cache(maxsize=8192)
def compile_formula(text: str, *, is_integer: bool) -> Evaluate:
    """Compile a formula.

    Args:
        text: the formula, with variables by name.
        is_integer: whether it belongs to an IntSwissKnife or IntConverter, whose division
            truncates towards zero.

    Returns:
        A function from the values of the variables to the value of the formula.

    Raises:
        FormulaError: the text is no formula. The function raises it for an unknown variable and
            for a value that does not exist, such as a division by zero.

    Example:
        >>> compile_formula("(A & 0x0F) = 3 ? 10 : A / 2", is_integer=True)({"A": 5})
        2
    """
    parser = _Parser(text, is_integer)
    try:
        evaluate = parser.conditional(0)
    except RecursionError:
        raise FormulaError("a formula is nested too deeply") from None
    parser.expect_end()

    def value(variables: Mapping[str, Number]) -> Number:
        try:
            found = evaluate(variables)
        except (ArithmeticError, ValueError, TypeError, RecursionError) as error:
            raise FormulaError(f"{text.strip()!r} has no value: {error}") from None
        return min(max(int(found), _INTEGER_MIN), _INTEGER_MAX) if is_integer else found

    return value


def _divide(left: Number, right: Number) -> float:
    return left / right


def _divide_integers(left: Number, right: Number) -> int:
    quotient = abs(int(left)) // abs(int(right))
    return quotient if (left < 0) == (right < 0) else -quotient


def _remainder(left: Number, right: Number) -> Number:
    return int(math.fmod(left, right))


def _bitwise(function: Callable[[int, int], int]) -> Callable[[Number, Number], int]:
    return lambda left, right: function(int(left), int(right))


_LEVELS: Final[tuple[dict[str, Callable[[Number, Number], Number]], ...]] = (
    {"||": lambda a, b: int(bool(a) or bool(b))},
    {"&&": lambda a, b: int(bool(a) and bool(b))},
    {"|": _bitwise(operator.or_)},
    {"^": _bitwise(operator.xor)},
    {"&": _bitwise(operator.and_)},
    {"=": lambda a, b: int(a == b), "<>": lambda a, b: int(a != b)},
    {
        "<": lambda a, b: int(a < b),
        ">": lambda a, b: int(a > b),
        "<=": lambda a, b: int(a <= b),
        ">=": lambda a, b: int(a >= b),
    },
    {"<<": _bitwise(operator.lshift), ">>": _bitwise(operator.rshift)},
    {"+": operator.add, "-": operator.sub},
    {"*": operator.mul, "/": _divide, "%": _remainder},
)
"""Binary operators from the weakest to the strongest; `**` binds to the right, stronger still."""


def _sign(value: Number) -> int:
    return (value > 0) - (value < 0)


def _round(value: Number, digits: Number = 0) -> float:
    scale = 10.0 ** int(digits)
    return math.copysign(math.floor(abs(value) * scale + 0.5), value) / scale


_FUNCTIONS: Final[dict[str, Callable[..., Number]]] = {
    "SGN": _sign,
    "NEG": operator.neg,
    "ABS": abs,
    "SQRT": math.sqrt,
    "LN": math.log,
    "LG": math.log10,
    "EXP": math.exp,
    "SIN": math.sin,
    "COS": math.cos,
    "TAN": math.tan,
    "ASIN": math.asin,
    "ACOS": math.acos,
    "ATAN": math.atan,
    "TRUNC": math.trunc,
    "FLOOR": math.floor,
    "CEIL": math.ceil,
    "ROUND": _round,
}
_CONSTANTS: Final = {"E": math.e, "PI": math.pi}


class _Parser:
    """Recursive descent over the tokens of one formula."""

    def __init__(self, text: str, is_integer: bool) -> None:
        self._text = text
        self._is_integer = is_integer
        self._tokens: list[tuple[str, str]] = []
        position = 0
        while text[position:].strip():
            found = _TOKEN.match(text, position)
            if found is None or found.lastgroup is None:
                raise FormulaError(f"{text.strip()!r} is no formula at character {position}")
            self._tokens.append((found.lastgroup, found[found.lastgroup]))
            position = found.end()
        self._next = 0

    def expect_end(self) -> None:
        if self._next < len(self._tokens):
            raise FormulaError(f"{self._text.strip()!r}: unexpected {self._peek()!r}")

    def conditional(self, depth: int) -> Evaluate:
        if depth > _DEPTH_MAX:
            raise FormulaError(f"a formula is nested deeper than {_DEPTH_MAX}")
        condition = self._binary(0, depth)
        if self._peek() != "?":
            return condition
        self._take("?")
        if_true = self.conditional(depth + 1)
        self._take(":")
        if_false = self.conditional(depth + 1)
        return lambda of: if_true(of) if condition(of) else if_false(of)

    def _binary(self, level: int, depth: int) -> Evaluate:
        if level == len(_LEVELS):
            return self._unary(depth)
        left = self._binary(level + 1, depth)
        while (symbol := self._peek()) in _LEVELS[level]:
            self._take(symbol)
            function = _LEVELS[level][symbol]
            if symbol == "/" and self._is_integer:
                function = _divide_integers
            left = _apply(function, left, self._binary(level + 1, depth))
        return left

    def _unary(self, depth: int) -> Evaluate:
        symbol = self._peek()
        if symbol not in ("-", "+", "~"):
            return self._power(depth)
        self._take(symbol)
        if depth > _DEPTH_MAX:
            raise FormulaError(f"a formula is nested deeper than {_DEPTH_MAX}")
        inner = self._unary(depth + 1)
        if symbol == "-":
            return lambda of: -inner(of)
        if symbol == "~":
            return lambda of: ~int(inner(of))
        return inner

    def _power(self, depth: int) -> Evaluate:
        base = self._atom(depth)
        if self._peek() != "**":
            return base
        self._take("**")
        exponent = self._unary(depth + 1)

        def power(of: Mapping[str, Number]) -> Number:
            exponent_value = exponent(of)
            if abs(exponent_value) > 1024:
                raise FormulaError(f"the exponent {exponent_value} is out of range")
            found: Number = base(of) ** exponent_value
            return found

        return power

    def _atom(self, depth: int) -> Evaluate:
        if self._next >= len(self._tokens):
            raise FormulaError(f"{self._text.strip()!r} ends in the middle")
        kind, token = self._tokens[self._next]
        self._next += 1
        if kind == "number":
            value = _number(token)
            return lambda of: value
        if token == "(":
            inner = self.conditional(depth + 1)
            self._take(")")
            return inner
        if kind != "name":
            raise FormulaError(f"{self._text.strip()!r}: unexpected {token!r}")
        if self._peek() == "(" and token in _FUNCTIONS:
            return self._call(_FUNCTIONS[token], depth)
        return lambda of: _variable(of, token)

    def _call(self, function: Callable[..., Number], depth: int) -> Evaluate:
        self._take("(")
        arguments = [self.conditional(depth + 1)]
        while self._peek() == ",":
            self._take(",")
            arguments.append(self.conditional(depth + 1))
        self._take(")")
        return lambda of: function(*(argument(of) for argument in arguments))

    def _peek(self) -> str:
        return self._tokens[self._next][1] if self._next < len(self._tokens) else ""

    def _take(self, token: str) -> None:
        if self._peek() != token:
            raise FormulaError(
                f"{self._text.strip()!r}: {token!r} is missing before {self._peek()!r}"
            )
        self._next += 1


def _apply(
    function: Callable[[Number, Number], Number], left: Evaluate, right: Evaluate
) -> Evaluate:
    return lambda of: function(left(of), right(of))


def _variable(of: Mapping[str, Number], name: str) -> Number:
    if name in of:
        return of[name]
    if name in _CONSTANTS:
        return _CONSTANTS[name]
    raise FormulaError(f"the variable {name} is not defined")


def _number(token: str) -> Number:
    if token[:2].lower() == "0x":
        return int(token, 16)
    return float(token) if re.search(r"[.eE]", token) else int(token)
