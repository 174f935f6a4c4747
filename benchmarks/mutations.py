"""Mutations of one Python file: each changes one operator, comparison, condition or constant.

What lives here is where a file can be changed and the text after the change; which tests run on it
is decided in `benchmarks.mutation_sample`.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass

COMPARISONS = {
    ast.Lt: ("<", "<="),
    ast.LtE: ("<=", "<"),
    ast.Gt: (">", ">="),
    ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
    ast.Is: ("is", "is not"),
    ast.IsNot: ("is not", "is"),
    ast.In: ("in", "not in"),
    ast.NotIn: ("not in", "in"),
}
OPERATORS = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
    ast.FloorDiv: ("//", "*"),
    ast.Mod: ("%", "*"),
    ast.Pow: ("**", "*"),
    ast.BitAnd: ("&", "|"),
    ast.BitOr: ("|", "&"),
}
LARGE = 10
"""From here on a constant is doubled instead of raised by one: a limit of 20 ms, not 20.000001."""
CONNECTIVES = {ast.And: ("and", "or"), ast.Or: ("or", "and")}


@dataclass(frozen=True)
class Mutation:
    """One change: the bytes `start:stop` of the file become `after`."""

    line: int
    start: int
    stop: int
    before: str
    after: str

    def apply(self, source: str) -> str:
        """The file's text with this change."""
        encoded = source.encode()
        return (encoded[: self.start] + self.after.encode() + encoded[self.stop :]).decode()

    def parses(self, source: str) -> bool:
        """Whether the changed file is Python at all."""
        try:
            ast.parse(self.apply(source))
        except SyntaxError:
            return False
        return True


def mutations(source: str) -> list[Mutation]:
    """List every mutation of a file, in the order of its text.

    Type annotations, decorators, docstrings, imports, `__all__` and text are left alone: changing
    them changes no decision. So is `|` between types.

    Args:
        source: the file's text; it parses.

    Returns:
        Mutations; a few of them may not parse.
    """
    encoded = source.encode()
    starts = [0]
    for line in encoded.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found = []
    for node in _deciding_nodes(ast.parse(source)):
        for first, last, before, after in _changes(node):
            start = starts[first[0] - 1] + first[1]
            stop = starts[last[0] - 1] + last[1]
            if before is not None:
                position = _token_position(encoded[start:stop].decode(), before)
                if position is None:
                    continue
                start += len(encoded[start:stop].decode()[:position].encode())
                stop = start + len(before.encode())
            text = encoded[start:stop].decode()
            found.append(Mutation(first[0], start, stop, text, after.replace("\0", text)))
    return sorted(found, key=lambda m: (m.start, m.after))


_Place = tuple[int, int]
_Change = tuple[_Place, _Place, str | None, str]


def _changes(node: ast.AST) -> Iterator[_Change]:
    """Where a node's text changes: between two places, which token (None: all of it), to what."""
    if isinstance(node, ast.Compare):
        operands = [node.left, *node.comparators]
        for left, operator, right in zip(operands, node.ops, operands[1:], strict=False):
            before, after = COMPARISONS[type(operator)]
            yield _end(left), _start(right), before, after
    elif isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
        before, after = OPERATORS[type(node.op)]
        yield _end(node.left), _start(node.right), before, after
    elif isinstance(node, ast.AugAssign) and type(node.op) in OPERATORS:
        before, after = OPERATORS[type(node.op)]
        yield _end(node.target), _start(node.value), f"{before}=", f"{after}="
    elif isinstance(node, ast.BoolOp):
        before, after = CONNECTIVES[type(node.op)]
        for left, right in zip(node.values, node.values[1:], strict=False):
            yield _end(left), _start(right), before, after
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield _start(node), _start(node.operand), "not", ""
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        yield _start(node), _start(node.operand), "-", "+"
    elif isinstance(node, ast.If | ast.While | ast.IfExp):
        yield _start(node.test), _end(node.test), None, "(not (\0))"
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float, bool):
        yield _start(node), _end(node), None, _other_constant(node.value)


def _other_constant(value: object) -> str:
    if isinstance(value, bool):
        return repr(not value)
    if isinstance(value, int):
        return repr(value + 1 if abs(value) < LARGE else value * 2)
    assert isinstance(value, float)
    return repr(value * 1.5) if value else "1.0"


def _deciding_nodes(tree: ast.AST) -> Iterator[ast.AST]:
    for node in ast.iter_child_nodes(tree):
        yield node
        yield from _deciding_nodes(_without_annotations(node))


def _without_annotations(node: ast.AST) -> ast.AST:
    if isinstance(node, ast.AnnAssign):
        return ast.Module([ast.Expr(node.value)] if node.value else [], [])
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        defaults = [d for d in [*node.args.defaults, *node.args.kw_defaults] if d is not None]
        return ast.Module([*map(ast.Expr, defaults), *node.body], [])
    if isinstance(node, ast.ClassDef):
        return ast.Module(node.body, [])
    if type(node).__name__ == "TypeAlias":
        return ast.Module([], [])
    return node


def _token_position(between: str, token: str) -> int | None:
    """Offset of a token in the text between two operands, without comments."""
    plain = "\n".join(
        line.split("#")[0].ljust(len(line)) if "#" in line else line for line in between.split("\n")
    )
    position = plain.find(token)
    return None if position < 0 else position


def _start(node: ast.expr | ast.UnaryOp) -> _Place:
    return node.lineno, node.col_offset


def _end(node: ast.expr) -> _Place:
    assert node.end_lineno is not None and node.end_col_offset is not None
    return node.end_lineno, node.end_col_offset
