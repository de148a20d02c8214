"""Mutants of a module: copies with one small mistake each, to see whether tests would notice."""

from __future__ import annotations

import ast
import copy
from collections.abc import Iterator
from types import ModuleType
from typing import Any

COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.Gt),
    ast.LtE: (ast.Lt, ast.GtE),
    ast.Gt: (ast.GtE, ast.Lt),
    ast.GtE: (ast.Gt, ast.LtE),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
}


def mutants(source: str, function: str) -> Iterator[tuple[str, str]]:
    """What was changed and the changed source, one mistake in `function` each."""
    tree = ast.parse(source)
    (body,) = [
        node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == function
    ]
    for index, node in enumerate(ast.walk(body)):
        for name, change in _changes(node):
            changed = copy.deepcopy(tree)
            (target,) = [
                n for n in changed.body if isinstance(n, ast.FunctionDef) and n.name == function
            ]
            victim = list(ast.walk(target))[index]
            change(victim)
            line = getattr(node, "lineno", 0)
            yield f"line {line}: {name}", ast.unparse(ast.fix_missing_locations(changed))


def load(source: str, like: ModuleType) -> dict[str, Any]:
    """Names of a mutant, run as if it were the module."""
    names: dict[str, Any] = {"__name__": like.__name__}
    exec(compile(source, "mutant", "exec"), names)
    return names


def _changes(node: ast.AST) -> Iterator[tuple[str, Any]]:
    if isinstance(node, ast.Compare):
        for place, operator in enumerate(node.ops):
            for other in COMPARISONS.get(type(operator), ()):

                def compare(
                    victim: ast.Compare, place: int = place, other: type[ast.cmpop] = other
                ) -> None:
                    victim.ops[place] = other()

                yield f"{type(operator).__name__} {place} becomes {other.__name__}", compare
    elif isinstance(node, ast.BoolOp):
        yield "and and or change places", _swap_bool
        for place in range(len(node.values)):

            def drop(victim: ast.BoolOp, place: int = place) -> None:
                victim.values[place] = ast.Constant(isinstance(victim.op, ast.And))

            yield f"operand {place} of {type(node.op).__name__} is dropped", drop
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield "not is dropped", lambda victim: setattr(victim, "op", ast.UAdd())
    elif isinstance(node, ast.If | ast.IfExp):
        yield "the condition is true", lambda victim: setattr(victim, "test", ast.Constant(True))
        yield "the condition is false", lambda victim: setattr(victim, "test", ast.Constant(False))
    elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub):
        yield "minus becomes plus", lambda victim: setattr(victim, "op", ast.Add())
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        yield "a number grows", lambda victim: setattr(victim, "value", victim.value + 1)
    elif isinstance(node, ast.Attribute) and node.attr in ("SLIP", "STABLE"):
        other_name = "STABLE" if node.attr == "SLIP" else "SLIP"
        yield f"{node.attr} becomes {other_name}", lambda v: setattr(v, "attr", other_name)
    elif isinstance(node, ast.Attribute) and node.attr == "UNKNOWN":
        yield "UNKNOWN becomes STABLE", lambda victim: setattr(victim, "attr", "STABLE")
    elif isinstance(node, ast.AugAssign) or (
        isinstance(node, ast.Expr) and not isinstance(node.value, ast.Constant)
    ):
        yield "a statement is dropped", _drop_statement


def _swap_bool(victim: ast.BoolOp) -> None:
    victim.op = ast.Or() if isinstance(victim.op, ast.And) else ast.And()


def _drop_statement(victim: ast.Expr | ast.AugAssign) -> None:
    if isinstance(victim, ast.Expr):
        victim.value = ast.Constant(None)
    else:
        victim.value = ast.Tuple([], ast.Load())
