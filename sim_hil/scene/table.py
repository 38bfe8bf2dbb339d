"""Strict reader of TOML tables in scene and suite files: known keys, right shapes, finite numbers."""

from __future__ import annotations

from collections.abc import Mapping
from math import radians
from typing import Any


class SceneError(ValueError):
    """An invalid scene; one line: what, expected, found."""


class Table:
    """Strict reader of a TOML table; all methods raise `error`, and `done` rejects unknown keys."""

    def __init__(self, what: str, table: object, error: type[ValueError] = SceneError) -> None:
        if not isinstance(table, Mapping):
            raise error(f"{what}: expected a table, found {type(table).__name__}")
        self.what, self._rest, self._error = what, dict(table), error

    def __contains__(self, key: str) -> bool:
        return key in self._rest

    def take(self, key: str, default: object = None) -> Any:
        """Return the raw value; a missing key without a default is an error."""
        if key not in self._rest and default is None:
            raise self._error(f"{self.what}: key {key!r} is missing")
        return self._rest.pop(key, default)

    def text(self, key: str, default: str | None = None) -> str:
        """Return a text."""
        value = self.take(key, default)
        if not isinstance(value, str):
            raise self._error(f"{self.what}: {key} must be text, found {value!r}")
        return value

    def texts(self, key: str) -> tuple[str, ...]:
        """Return an array of texts."""
        value = self.take(key)
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise self._error(f"{self.what}: {key} must be an array of texts, found {value!r}")
        return tuple(value)

    def number(self, key: str, default: float | None = None) -> float:
        """Return a finite number."""
        return number(f"{self.what}: {key}", self.take(key, default), self._error)

    def whole(self, key: str, default: int | None = None) -> int:
        """Return a whole number."""
        value = self.take(key, default)
        if isinstance(value, bool) or not isinstance(value, int):
            raise self._error(f"{self.what}: {key} must be a whole number, found {value!r}")
        return value

    def vector(self, key: str, length: int, default: tuple[float, ...] | None = None) -> tuple[Any, ...]:
        """Return `length` finite numbers."""
        return vector(f"{self.what}: {key}", self.take(key, default), length, self._error)

    def points(self, key: str) -> tuple[Any, ...]:
        """Return an array of (x, y) points."""
        value = self.take(key)
        if not isinstance(value, list):
            raise self._error(f"{self.what}: {key} must be an array of points")
        return tuple(vector(f"{self.what}: {key}: point", point, 2, self._error) for point in value)

    def heading(self, default_deg: float | None = None) -> float:
        """Return the heading, rad, from `heading_deg` or `heading_rad` (for exact values)."""
        if "heading_rad" in self:
            if "heading_deg" in self:
                raise self._error(f"{self.what}: expected heading_deg or heading_rad, found both")
            return self.number("heading_rad")
        return radians(self.number("heading_deg", default_deg))

    def tables(self, key: str) -> list[Table]:
        """Return an array of tables, each named by its index."""
        value = self.take(key, [])
        if not isinstance(value, list):
            raise self._error(f"{self.what}: {key} must be an array of tables")
        return [Table(f"{key}[{index}]", item, self._error) for index, item in enumerate(value)]

    def done(self) -> None:
        """Reject the table if it contains keys that were not read."""
        if self._rest:
            raise self._error(f"{self.what}: unknown key {sorted(self._rest)[0]!r}")


def number(what: str, value: object, error: type[ValueError] = SceneError) -> float:
    """Return a finite number of at most 1e6 in magnitude as a float. Raises `error`."""
    if isinstance(value, bool) or not isinstance(value, int | float) or value != value or abs(value) > 1e6:
        raise error(f"{what} must be a finite number, found {value!r}")
    return float(value)


def vector(what: str, value: object, length: int, error: type[ValueError] = SceneError) -> tuple[float, ...]:
    """Return `length` finite numbers. Raises `error`."""
    if not isinstance(value, list | tuple) or len(value) != length:
        raise error(f"{what} must be {length} numbers, found {value!r}")
    return tuple(number(what, item, error) for item in value)
