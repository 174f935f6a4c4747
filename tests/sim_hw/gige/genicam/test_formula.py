"""Formulas of descriptions: precedence, integer arithmetic, functions, and what is refused."""

from __future__ import annotations

import math

import pytest

from sim_hw.gige.genicam.formula import FormulaError, compile_formula

INTEGER = [
    ("1 + 2 * 3", 7),
    ("(1 + 2) * 3", 9),
    ("7 / 2", 3),
    ("-7 / 2", -3),
    ("-7 % 2", -1),
    ("2 ** 3 ** 2", 512),
    ("-2 ** 2", -4),
    ("0x0F & 6 | 8", 14),
    ("6 ^ 3", 5),
    ("~0 & 0xFF", 255),
    ("1 << 4 >> 2", 4),
    ("3 = 3 && 2 <> 3", 1),
    ("0 || 0", 0),
    ("2 > 1 ? 10 : 20", 10),
    ("0 ? 1 : 0 ? 2 : 3", 3),
    ("A >= 5 ? A - 5 : B", 3),
    ("SGN(-4) + ABS(-4) + NEG(1)", 2),
    ("2 ** 200", 2**64 - 1),
]
REAL = [
    ("7 / 2", 3.5),
    ("ROUND(2.345, 2)", 2.35),
    ("ROUND(-2.5)", -3.0),
    ("TRUNC(-2.5)", -2.0),
    ("20 * LG(100)", 40.0),
    ("LN(EXP(2))", 2.0),
    ("SQRT(PI * PI)", math.pi),
    ("1.5e3 + .5", 1500.5),
]


@pytest.mark.parametrize(("text", "value"), INTEGER)
def test_integer_formula(text: str, value: int) -> None:
    assert compile_formula(text, is_integer=True)({"A": 8, "B": 1}) == value


@pytest.mark.parametrize(("text", "value"), REAL)
def test_real_formula(text: str, value: float) -> None:
    assert compile_formula(text, is_integer=False)({}) == pytest.approx(value)


@pytest.mark.parametrize("text", ["", "1 +", "(1", "1 2", "1 ? 2", "$", "SQRT(1", "(" * 500 + "1"])
def test_no_formula(text: str) -> None:
    with pytest.raises(FormulaError):
        compile_formula(text, is_integer=True)


@pytest.mark.parametrize("text", ["1 / 0", "1 % 0", "UNKNOWN", "SQRT(-1)", "2 ** 5000", "1 << -1"])
def test_no_value(text: str) -> None:
    with pytest.raises(FormulaError):
        compile_formula(text, is_integer=True)({})
