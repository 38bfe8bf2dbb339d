"""Small changes of a module's source, one at a time: each is a mutant that some test must fail for. Pure."""

from __future__ import annotations

import ast
import copy
import functools
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

_COMPARED: Final[dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
"""For an order: the boundary moved, and the order reversed."""
_COMPUTED: Final[dict[type[ast.operator], type[ast.operator]]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Add,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.BitAnd: ast.BitOr,
}
_LARGE: Final = 100
"""Integers from here on are doubled: no test should depend on a nanosecond."""
_CALLED: Final = {"min": "max", "max": "min", "any": "all", "all": "any"}


@dataclass(frozen=True)
class Mutant:
    """One change of a module. `key` names function, statement and change, and survives a move within the file.

    `place`: names of the classes and the function around the change, from outside inwards; a function inside a
    function counts as a part of it. `line`: its line in the file. `span`: first and last line of the function or class.
    `change` makes the change and returns the module's tree; it may be called once, and of all mutants of one
    `mutants_of` for one only.
    """

    key: str
    place: tuple[str, ...]
    line: int
    span: tuple[int, int]
    change: Callable[[], ast.Module]


def mutants_of(source: str) -> list[Mutant]:
    """Return the mutants of a module's source. Messages, docstrings and annotations stay as they are."""
    tree = ast.parse(source)
    seen: Counter[str] = Counter()
    mutants = []
    for site in _inside(tree, (), (0, 0), "", in_function=False):
        before, after = ast.unparse(site.child), _first_line(site.replacement)
        place = ".".join(site.place) or "<module>"
        statement = "" if site.statement == _short(before) else f"{site.statement} | "
        key = f"{place} | {statement}{_short(before)} -> {_short(after)}"
        seen[key] += 1
        key = key if seen[key] == 1 else f"{key} #{seen[key]}"
        mutants.append(Mutant(key, site.place, site.line, site.span, functools.partial(_changed, tree, site)))
    return mutants


@dataclass(frozen=True)
class _Site:
    place: tuple[str, ...]
    span: tuple[int, int]
    statement: str
    parent: ast.AST
    field: str
    position: int
    child: ast.AST
    replacement: ast.AST

    @property
    def line(self) -> int:
        line: int = getattr(self.child, "lineno", 0)
        return line


def _changed(tree: ast.Module, site: _Site) -> ast.Module:
    ast.copy_location(site.replacement, site.child)
    value = getattr(site.parent, site.field)
    if isinstance(value, list):
        value[site.position] = site.replacement
    else:
        setattr(site.parent, site.field, site.replacement)
    return ast.fix_missing_locations(tree)


def _first_line(node: ast.AST) -> str:
    return ast.unparse(ast.fix_missing_locations(copy.copy(node))).partition("\n")[0]


def _short(text: str) -> str:
    line = " ".join(text.partition("\n")[0].split())
    return line if len(line) <= 70 else f"{line[:45]} ... {line[-20:]}"


def _inside(
    node: ast.AST, place: tuple[str, ...], span: tuple[int, int], statement: str, *, in_function: bool
) -> Iterator[_Site]:
    """Every possible change below a node, always in the same order."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params", "bases"):
            continue
        for position, child in enumerate(value if isinstance(value, list) else [value]):
            if not isinstance(child, ast.AST) or isinstance(child, (ast.JoinedStr, ast.Import, ast.ImportFrom)):
                continue
            if _is_docstring(child):
                continue
            inner, within, function = place, span, in_function
            if isinstance(child, (ast.FunctionDef, ast.ClassDef)) and not in_function:
                inner, function = (*place, child.name), isinstance(child, ast.FunctionDef)
                within = (child.lineno, child.end_lineno or child.lineno)
            text = _short(ast.unparse(child)) if isinstance(child, ast.stmt) else statement
            for replacement in _replacements(child, node):
                yield _Site(inner, within, text, node, name, position, child, replacement)
            if not isinstance(child, ast.Raise):  # what it raises is a message
                yield from _inside(child, inner, within, text, in_function=function)


def _is_docstring(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _replacements(node: ast.AST, parent: ast.AST) -> Iterator[ast.AST]:
    if isinstance(node, ast.Compare):
        for position, operator in enumerate(node.ops):
            for other in _COMPARED[type(operator)]:
                ops = [*node.ops[:position], other(), *node.ops[position + 1 :]]
                yield ast.Compare(node.left, ops, node.comparators)
    elif isinstance(node, ast.BoolOp):
        yield ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values)
        if len(node.values) > 2:
            for position in range(len(node.values)):
                yield ast.BoolOp(node.op, node.values[:position] + node.values[position + 1 :])
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.Not, ast.USub)):
        yield node.operand
    elif isinstance(node, ast.BinOp) and type(node.op) in _COMPUTED:
        yield ast.BinOp(node.left, _COMPUTED[type(node.op)](), node.right)
    elif isinstance(node, ast.AugAssign) and type(node.op) in _COMPUTED:
        yield ast.AugAssign(node.target, _COMPUTED[type(node.op)](), node.value)
        yield ast.Pass()
    elif isinstance(node, ast.Constant):
        yield from _constants(node)
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in _CALLED:
        yield ast.Call(ast.Name(_CALLED[node.func.id], ast.Load()), node.args, node.keywords)
    elif isinstance(node, ast.IfExp):
        yield ast.IfExp(ast.UnaryOp(ast.Not(), node.test), node.body, node.orelse)
    elif isinstance(node, (ast.If, ast.While)) and not _has_own_mutants(node.test):
        changed = copy.copy(node)
        changed.test = ast.UnaryOp(ast.Not(), node.test)
        yield changed
    elif isinstance(node, ast.Return) and not isinstance(node.value, ast.Constant | None):
        yield ast.Return(ast.Constant(None))
    elif _is_removable(node, parent):
        yield ast.Pass()


def _constants(node: ast.Constant) -> Iterator[ast.AST]:
    value = node.value
    if isinstance(value, bool):
        yield ast.Constant(not value)
    elif isinstance(value, (int, float)):
        yield ast.Constant(value * 2 if abs(value) >= _LARGE or (isinstance(value, float) and value) else value + 1)
    elif isinstance(value, str) and value.isidentifier():
        yield ast.Constant(f"{value}_")


def _has_own_mutants(test: ast.AST) -> bool:
    """Whether the mutants of a condition include its negation."""
    return isinstance(test, (ast.Compare, ast.Constant)) or (
        isinstance(test, ast.UnaryOp) and isinstance(test.op, ast.Not)
    )


def _is_removable(node: ast.AST, parent: ast.AST) -> bool:
    """Whether a statement can go: a call, an assignment to an attribute or an item, a raise, an early end."""
    if isinstance(node, ast.Assign):
        targets = [each for target in node.targets for each in getattr(target, "elts", [target])]
        return all(isinstance(target, (ast.Attribute, ast.Subscript)) for target in targets)
    if isinstance(node, ast.Return):
        return not isinstance(parent, ast.FunctionDef)
    if isinstance(node, ast.Expr):
        return isinstance(node.value, ast.Call)
    return isinstance(node, (ast.Raise, ast.Delete, ast.Continue, ast.Break))
