"""Builds frozen dataclasses from TOML tables; an unknown key or a wrong type gives a one-line error."""

from __future__ import annotations

import dataclasses
import difflib
import functools
import math
import sys
import types
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

__all__ = ["FieldError", "SettingText", "build", "convert", "field_types", "from_text", "near", "plain", "tomllib"]

T = TypeVar("T")


class FieldError(ValueError):
    """Unknown key, missing key or value of a wrong type; its text is the one line to show."""


class SettingText(str):
    """Value from the command line as text; `convert` reads it as its field's type."""


def near(name: str, known: typing.Iterable[str]) -> str:
    """Return `did you mean …` with similar names, else `expected one of …`."""
    names = sorted(known)
    close = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
    if close:
        return f"did you mean {' or '.join(close)}?"
    return f"expected one of: {', '.join(names)}" if names else "nothing is expected there"


@functools.cache
def field_types(cls: type) -> Mapping[str, Any]:
    """Return the type of every field of a dataclass; resolving them takes most of the time of reading a file."""
    hints = typing.get_type_hints(cls)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}


def build(cls: type[T], content: object, where: str) -> T:
    """Build the dataclass `cls` from a table. Raises FieldError that names `where`."""
    if not isinstance(content, Mapping):
        raise FieldError(f"{where}: expected a table, found {content!r}")
    known = field_types(cls)  # type: ignore[arg-type]  # mypy takes a dataclass for unhashable; it is the class
    for key in content:
        if key not in known:
            raise FieldError(f"{where}: unknown key {key!r}; {near(str(key), known)}")
    for field in dataclasses.fields(cls):  # type: ignore[arg-type]  # T is any class; `field_types` has refused others
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if required and field.name not in content:
            raise FieldError(f"{where}: key {field.name!r} is missing")
    values = {key: convert(known[key], value, f"{where}: {key}") for key, value in content.items()}
    try:
        return cls(**values)
    except FieldError:
        raise
    except ValueError as error:
        raise FieldError(f"{where}: {error}") from error


def convert(kind: object, value: object, where: str) -> Any:
    """Convert `value` to the type `kind`. Raises FieldError. A dataclass may define `from_setting` for settings."""
    if isinstance(value, SettingText):
        own = [option for option in (kind, *typing.get_args(kind)) if hasattr(option, "from_setting")]
        value = own[0].from_setting(str(value), where) if own else from_text(kind, str(value), where)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        options = [option for option in arguments if option is not type(None)]
        if value is None and len(options) < len(arguments):
            return None
        if len(options) == 1:
            return convert(options[0], value, where)
        # bool before int: in Python True is an int.
        matching = [option for option in options if type(value) is option]
        if matching:
            return value
        raise FieldError(f"{where}: expected {_kind_name(kind)}, found {value!r}")
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        return value if isinstance(value, kind) else build(kind, value, where)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise FieldError(f"{where}: expected a list, found {value!r}")
        if arguments[-1] is not Ellipsis and len(value) != len(arguments):
            raise FieldError(f"{where}: expected a list of {len(arguments)} values, found {value!r}")
        return tuple(convert(arguments[0], item, f"{where}[{i}]") for i, item in enumerate(value))
    if origin is not None and issubclass(origin, Mapping):
        if not isinstance(value, Mapping):
            raise FieldError(f"{where}: expected a table, found {value!r}")
        return {str(key): convert(arguments[1], item, f"{where}.{key}") for key, item in value.items()}
    if kind is Any:
        return value
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value) if abs(value) < 2**53 else math.inf
    if type(value) is not kind or (kind is float and not math.isfinite(typing.cast(float, value))):
        raise FieldError(f"{where}: expected {_kind_name(kind)}, found {value!r}")
    return value


def from_text(kind: object, text: str, where: str) -> Any:
    """Convert text of the command line to the type `kind`. Raises FieldError."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        if type(None) in arguments and text == "none":
            return None
        options = [option for option in arguments if option is not type(None)]
        for option in sorted(options, key=lambda o: (bool, int, float, str).index(o) if len(options) > 1 else 0):
            try:
                return from_text(option, text, where)
            except FieldError:
                if option is options[-1] and len(options) == 1:
                    raise
        raise FieldError(f"{where}: expected {_kind_name(kind)}, found {text!r}")
    if origin is tuple:
        # "24,48" and "[24, 48]" are the same list.
        parts = text.strip().removeprefix("[").removesuffix("]").split(",")
        return [from_text(arguments[0], part.strip(), where) for part in parts if part.strip()]
    if kind is bool:
        if text not in ("true", "false"):
            raise FieldError(f"{where}: expected true or false, found {text!r}")
        return text == "true"
    if kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            raise FieldError(f"{where}: expected {_kind_name(kind)}, found {text!r}") from None
    if kind is str:
        return text
    raise FieldError(f"{where}: is a table; name one of its keys")


def _kind_name(kind: object) -> str:
    """Return a type's name for error messages."""
    names = {str: "a text", int: "a whole number", float: "a finite number", bool: "true or false"}
    if kind in names:
        return names[kind]
    return " or ".join(_kind_name(option) for option in typing.get_args(kind) if option is not type(None)) or str(kind)


def plain(value: object) -> Any:
    """Convert a dataclass to tables, lists and scalars that `build` reads back; omits options that are None."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        pairs = ((field.name, getattr(value, field.name)) for field in dataclasses.fields(value))
        return {name: plain(item) for name, item in pairs if item is not None}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    return [plain(item) for item in value] if isinstance(value, tuple | list) else value
