"""Tables of a scene file, read strictly: every key known, of the right shape, finite."""

from __future__ import annotations

from collections.abc import Mapping
from math import radians
from typing import Any


class SceneError(ValueError):
    """A scene that cannot be used; one line: what, expected, found."""


class Table:
    """A TOML table that insists on every key being known and of the right shape; `done` refuses what is left over."""

    def __init__(self, what: str, table: object) -> None:
        if not isinstance(table, Mapping):
            raise SceneError(f"{what}: expected a table, found {type(table).__name__}")
        self.what, self._rest = what, dict(table)

    def __contains__(self, key: str) -> bool:
        return key in self._rest

    def take(self, key: str, default: object = None) -> Any:
        """The raw value; raises SceneError when the key is missing and there is no default."""
        if key not in self._rest and default is None:
            raise SceneError(f"{self.what}: key {key!r} is missing")
        return self._rest.pop(key, default)

    def text(self, key: str, default: str | None = None) -> str:
        """A piece of text."""
        value = self.take(key, default)
        if not isinstance(value, str):
            raise SceneError(f"{self.what}: {key} must be text, found {value!r}")
        return value

    def number(self, key: str, default: float | None = None) -> float:
        """A finite number."""
        return number(f"{self.what}: {key}", self.take(key, default))

    def whole(self, key: str, default: int | None = None) -> int:
        """A whole number."""
        value = self.take(key, default)
        if isinstance(value, bool) or not isinstance(value, int):
            raise SceneError(f"{self.what}: {key} must be a whole number, found {value!r}")
        return value

    def vector(self, key: str, length: int, default: tuple[float, ...] | None = None) -> tuple[Any, ...]:
        """So many finite numbers."""
        return vector(f"{self.what}: {key}", self.take(key, default), length)

    def points(self, key: str) -> tuple[Any, ...]:
        """An array of (x, y) points."""
        value = self.take(key)
        if not isinstance(value, list):
            raise SceneError(f"{self.what}: {key} must be an array of points")
        return tuple(vector(f"{self.what}: {key}: point", point, 2) for point in value)

    def heading(self, default_deg: float | None = None) -> float:
        """`heading_deg`, or `heading_rad` where degrees cannot say it to the last bit; rad."""
        if "heading_rad" in self:
            if "heading_deg" in self:
                raise SceneError(f"{self.what}: expected heading_deg or heading_rad, found both")
            return self.number("heading_rad")
        return radians(self.number("heading_deg", default_deg))

    def tables(self, key: str) -> list[Table]:
        """An array of tables, each named by its place in it."""
        value = self.take(key, [])
        if not isinstance(value, list):
            raise SceneError(f"{self.what}: {key} must be an array of tables")
        return [Table(f"{key}[{index}]", item) for index, item in enumerate(value)]

    def done(self) -> None:
        """Raises SceneError when a key was not taken."""
        if self._rest:
            raise SceneError(f"{self.what}: unknown key {sorted(self._rest)[0]!r}")


def number(what: str, value: object) -> float:
    """A finite number of sensible size, as a float; raises SceneError."""
    if isinstance(value, bool) or not isinstance(value, int | float) or value != value or abs(value) > 1e6:
        raise SceneError(f"{what} must be a finite number, found {value!r}")
    return float(value)


def vector(what: str, value: object, length: int) -> tuple[float, ...]:
    """So many finite numbers; raises SceneError."""
    if not isinstance(value, list | tuple) or len(value) != length:
        raise SceneError(f"{what} must be {length} numbers, found {value!r}")
    return tuple(number(what, item) for item in value)
