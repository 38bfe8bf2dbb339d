"""Tables as TOML text that a person can read: figures and short tables on one line, the rest with headers."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

_BARE = re.compile(r"[A-Za-z0-9_-]+")
_SHORT = 4


def toml_text(tables: Mapping[str, Any]) -> str:
    """The TOML of nested tables, lists of tables, lists and scalars; raises TypeError for anything else."""
    blocks = _blocks((), tables)
    return "\n\n".join(blocks) + "\n"


def _blocks(path: tuple[str, ...], table: Mapping[str, Any]) -> list[str]:
    lines = [f"{_key(key)} = {_value(value)}" for key, value in table.items() if _is_inline(value)]
    header = [f"[{'.'.join(map(_key, path))}]"] if path else []
    blocks = ["\n".join([*header, *lines])] if lines or (path and not table) else []
    for key, value in table.items():
        if _is_inline(value):
            continue
        below = (*path, key)
        if isinstance(value, Mapping):
            blocks += _blocks(below, value)
            continue
        for item in value:
            rows = [f"{_key(name)} = {_value(entry)}" for name, entry in item.items()]
            blocks.append("\n".join([f"[[{'.'.join(map(_key, below))}]]", *rows]))
    return blocks


def _is_inline(value: object) -> bool:
    if isinstance(value, Mapping):
        short = len(value) <= _SHORT and not any(isinstance(item, Mapping | list | tuple) for item in value.values())
        return short and bool(value)
    tables = isinstance(value, list | tuple) and bool(value) and all(isinstance(item, Mapping) for item in value)
    return not tables


def _key(key: str) -> str:
    return key if _BARE.fullmatch(key) else json.dumps(key, ensure_ascii=False)


def _value(value: object) -> str:
    if isinstance(value, Mapping):
        inside = ", ".join(f"{_key(str(key))} = {_value(item)}" for key, item in value.items())
        return f"{{ {inside} }}" if inside else "{}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, bool | int | str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, float):
        return repr(value)
    raise TypeError(f"{value!r} has no form in TOML")
