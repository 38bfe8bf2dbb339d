"""Puts one mutant into modules that are already imported, so that tests need not be collected again."""

from __future__ import annotations

import ast
import enum
import importlib.abc
import importlib.machinery
import importlib.util
import sys
import types
from typing import Any, Final

from tools.mutants.operators import Mutant

_SIMPLE: Final = (bool, int, float, str, bytes, type(None))
_BUILT_IN: Final = (bool, int, float, str, bytes, list, dict)
"""Types that are values of a constant, as in a table of expected kinds."""


class BrokenModuleError(Exception):
    """The changed module cannot be imported."""


def graft(module: types.ModuleType, mutant: Mutant) -> None:
    """Change `module` in place: a function's code, a class's values, or a module's constants and their copies."""
    scratch = vars(_loaded(module, mutant.change()))
    place = mutant.place
    if not place:
        _constants(module, scratch)
        return
    old, new = vars(module)[place[0]], scratch[place[0]]
    for name in place[1:]:
        if not isinstance(old, type):
            break
        owner, fresh = old, new
        old, new = vars(owner)[name], vars(fresh)[name]
    if isinstance(old, type):
        _values(old, new)
    else:
        _code(_function(old), _function(new))


class _Loader(importlib.abc.InspectLoader):
    """Loads a module from its changed tree."""

    def __init__(self, tree: ast.Module, file: str) -> None:
        self._tree = tree
        self._file = file

    def get_source(self, fullname: str) -> None:
        """There is no text of the changed tree."""

    def get_code(self, fullname: str) -> types.CodeType:
        """Return the compiled tree."""
        return compile(self._tree, self._file, "exec")


def _loaded(module: types.ModuleType, tree: ast.Module) -> types.ModuleType:
    """A second module of the same name, outside `sys.modules`."""
    loader = _Loader(tree, str(module.__file__))
    second = importlib.util.module_from_spec(importlib.machinery.ModuleSpec(module.__name__, loader))
    try:
        loader.exec_module(second)
    except (Exception, SystemExit) as error:
        raise BrokenModuleError(module.__name__) from error
    return second


def _function(member: Any) -> types.FunctionType:
    """The function behind a property, a class or static method, and decorators that name what they wrap."""
    while hasattr(member, "__wrapped__") or not isinstance(member, types.FunctionType):
        if isinstance(member, property):
            member = member.fget
        else:
            member = getattr(member, "__wrapped__", None) or getattr(member, "__func__")  # noqa: B009 - of any type
    return member


def _code(old: types.FunctionType, new: types.FunctionType) -> None:
    old.__code__ = new.__code__
    old.__defaults__, old.__kwdefaults__ = new.__defaults__, new.__kwdefaults__


def _values(old: type, new: type) -> None:
    """Take the changed class's plain values, an enumeration's too, and a dataclass's fields and `__init__`."""
    if issubclass(old, enum.Enum) and issubclass(new, enum.Enum):
        for member, changed in zip(old, new, strict=True):
            member._value_ = changed.value
        return
    generated = ("__dataclass_fields__", "__init__") if "__dataclass_fields__" in vars(new) else ()
    for name, value in vars(new).items():
        if name in generated or (_is_simple(value) and not name.startswith("__")):
            setattr(old, name, value)


def _constants(module: types.ModuleType, scratch: dict[str, Any]) -> None:
    """Replace the changed constants, also where other modules have imported them."""
    for name, old in list(vars(module).items()):
        new = scratch.get(name)
        if name.startswith("__") or not _is_simple(old) or repr(new) == repr(old):
            continue
        for other in list(sys.modules.values()):
            if getattr(other, "__dict__", {}).get(name) is old:
                setattr(other, name, new)


def _is_simple(value: object) -> bool:
    if isinstance(value, (tuple, frozenset, set, list)):
        return all(map(_is_simple, value))
    if isinstance(value, dict):
        return all(_is_simple(each) for pair in value.items() for each in pair)
    return isinstance(value, _SIMPLE) or value in _BUILT_IN
