"""Parsers for the JSON parameter of a request, which is untrusted input. Pure."""

from __future__ import annotations

import json
import math
from typing import Any

_HUGE = 1e9


def parse_table(parameter: str) -> dict[str, Any] | None:
    """Parse a JSON object; None for anything else."""
    try:
        table = json.loads(parameter)
    except (ValueError, RecursionError):
        return None
    return table if isinstance(table, dict) else None


def parse_numbers(parameter: str, *keys: str) -> tuple[float, ...] | None:
    """Return the finite numbers under `keys`; None if one is missing or invalid."""
    table = parse_table(parameter)
    numbers = []
    for key in keys:
        value = None if table is None else table.get(key)
        if not isinstance(value, (int, float)) or isinstance(value, bool) or not abs(value) < _HUGE:
            return None
        numbers.append(float(value))
    return tuple(numbers) if all(map(math.isfinite, numbers)) else None


def parse_flag(parameter: str, key: str) -> bool | None:
    """Return the boolean under `key`, also given as 0 or 1; None for anything else."""
    value = (parse_table(parameter) or {}).get(key)
    if isinstance(value, bool):
        return value
    return bool(value) if isinstance(value, int) and value in (0, 1) else None


def parse_text(parameter: str, key: str) -> str | None:
    """Return the text under `key`; None for anything else."""
    value = (parse_table(parameter) or {}).get(key)
    return value if isinstance(value, str) else None
