"""Mutants: modules with one small mistake each, made from their source text."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import CodeType
from typing import Final

BY_ONE_MAX, BY_ONE_MAX_FLOAT = 1_000_000, 100.0
"""Largest int that a mistake changes, and float that it increases, by one; others: by `SHARE`."""
SHARE = 0.2

COMPARISONS: Final[dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]]] = {
    ast.Lt: (ast.LtE, ast.Gt),
    ast.LtE: (ast.Lt, ast.GtE),
    ast.Gt: (ast.GtE, ast.Lt),
    ast.GtE: (ast.Gt, ast.LtE),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
OPERATORS: Final[dict[type[ast.operator], type[ast.operator]]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.FloorDiv,
    ast.Pow: ast.Mult,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.BitXor: ast.BitAnd,
}

Change = Callable[[ast.AST], None]
"""Makes the mistake in a node of the syntax tree, in place."""


@dataclass(frozen=True)
class Mutant:
    """One mistake in one module."""

    source: str
    place: int
    """Number of the changed node in the order of `_nodes`."""
    line: int
    begin: int
    """First line of the statement around `line`; a test that runs a line from it to `line` runs the
    mutant."""
    what: str
    change: Change
    file: str
    """Path of the module from the root of the tree."""

    def code(self) -> CodeType:
        """Return the module with the mistake, compiled."""
        tree = ast.parse(self.source)
        for place, (node, _) in enumerate(_nodes(tree, None)):
            if place == self.place:
                self.change(node)
                break
        return compile(ast.fix_missing_locations(tree), self.file, "exec")

    def __str__(self) -> str:
        text = self.source.splitlines()[self.line - 1].strip()
        return f"{self.file}:{self.line}: {self.what} in `{text}`"


def mutants(source: str, file: str) -> Iterator[Mutant]:
    """Yield all mutants of a module; `file`: its path from the root."""
    for place, (node, statement) in enumerate(_nodes(ast.parse(source), None)):
        line = getattr(node, "lineno", 0)
        for what, change in _changes(node):
            yield Mutant(source, place, line, statement.lineno, what, change, file)


def _nodes(
    parent: ast.AST, statement: ast.stmt | None
) -> Iterator[tuple[ast.expr | ast.stmt, ast.stmt]]:
    """Yield each node below `parent` that may be changed, and the statement around it.

    Leaves out annotations, decorators, formatted strings and calls of the log.
    """
    for name, value in ast.iter_fields(parent):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for node in value if isinstance(value, list) else [value]:
            if not isinstance(node, ast.AST) or _is_message(node):
                continue
            around = node if isinstance(node, ast.stmt) else statement
            if isinstance(node, ast.expr | ast.stmt) and around is not None:
                yield node, around
            yield from _nodes(node, around)


def _is_message(node: ast.AST) -> bool:
    """Return True for text for people: formatted strings and calls of the log."""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
        node = node.func.value
        return isinstance(node, ast.Name) and node.id == "_log"
    return isinstance(node, ast.JoinedStr)


def _changes(node: ast.AST) -> Iterator[tuple[str, Change]]:
    """Yield description and function of each mistake that a node may have."""
    match node:
        case ast.Compare():
            for place, operator in enumerate(node.ops):
                for wrong in COMPARISONS[type(operator)]:
                    what = f"{type(operator).__name__} becomes {wrong.__name__}"
                    yield what, _setter("ops", wrong(), place)
        case ast.BoolOp():
            other = ast.Or() if isinstance(node.op, ast.And) else ast.And()
            yield "and and or change places", _setter("op", other)
        case ast.UnaryOp(op=ast.Not() | ast.Invert() | ast.USub() as sign, operand=operand):
            twice = ast.UnaryOp(sign, operand)
            yield f"{type(sign).__name__} is dropped", _setter("operand", twice)
        case ast.BinOp(op=sign) | ast.AugAssign(op=sign) if type(sign) in OPERATORS:
            instead = OPERATORS[type(sign)]
            what = f"{type(sign).__name__} becomes {instead.__name__}"
            yield what, _setter("op", instead())
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            for changed in _numbers(number):
                yield f"{number} becomes {changed}", _setter("value", changed)


def _setter(field: str, value: object, place: int | None = None) -> Change:
    def change(node: ast.AST) -> None:
        if place is None:
            setattr(node, field, value)
        else:
            getattr(node, field)[place] = value

    return change


def _numbers(number: float) -> tuple[float, ...]:
    """Return a larger and a smaller wrong value of a number: off by one if it is small, else by
    `SHARE`; a float's smaller one always by `SHARE`, and 0.0 has none."""
    if isinstance(number, int):
        if abs(number) <= BY_ONE_MAX:
            return number + 1, number - 1
        return round(number * (1.0 + SHARE)), round(number * (1.0 - SHARE))
    larger = number + 1.0 if abs(number) <= BY_ONE_MAX_FLOAT else number * (1.0 + SHARE)
    return (larger, number * (1.0 - SHARE)) if number else (larger,)
