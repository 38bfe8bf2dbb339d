"""Precision of a graph's weights: a default and exceptions by layer name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase

PRECISIONS = ("fp32", "fp16", "int8-b32", "int8-b128", "int8", "int4-b32", "int4-b128")
"""From the most to the least exact; `int8` also rounds activations, `-bN` are weight-only in blocks of N."""


class PrecisionError(ValueError):
    """Unknown precision, or override without a matching layer."""


@dataclass(frozen=True)
class Precision:
    """Precision of every linear layer of a graph; the first override whose pattern matches a layer's name wins."""

    default: str
    overrides: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        for name in (self.default, *(precision for _, precision in self.overrides)):
            if name not in PRECISIONS:
                raise PrecisionError(f"precision {name!r} is not known; expected one of: {', '.join(PRECISIONS)}")

    def of(self, layer: str) -> str:
        """Return the precision of a layer, such as `layers.3.down` or `lm_head`."""
        return next((precision for pattern, precision in self.overrides if fnmatchcase(layer, pattern)), self.default)

    def to_dict(self) -> dict[str, object]:
        """Return the plain JSON form."""
        return {"default": self.default, "overrides": dict(self.overrides)}

    @classmethod
    def from_dict(cls, content: Mapping[str, object]) -> Precision:
        """Build the precision from its `to_dict` form. Raises PrecisionError."""
        overrides = content.get("overrides", {})
        if set(content) - {"default", "overrides"} or not isinstance(overrides, Mapping):
            raise PrecisionError(f"precision must be 'default' and 'overrides', found {sorted(content)}")
        return cls(str(content.get("default")), tuple((str(k), str(v)) for k, v in overrides.items()))


def block_size(precision: str) -> int | None:
    """Return the number of weights per scale of a weight-only precision; None for others."""
    return int(precision.partition("-b")[2]) if "-b" in precision else None


def bits(precision: str) -> int:
    """Return the bits of one weight, without scales."""
    return {"fp32": 32, "fp16": 16}.get(precision) or int(precision.removeprefix("int").partition("-")[0])


def weight_bytes(precision: str, rows: int, columns: int, *, scale_bytes: int = 4) -> int:
    """Return the bytes of a [rows, columns] weight in a precision, including scales."""
    block = block_size(precision)
    if block is not None:
        blocks = -(-columns // block)
        return rows * blocks * (block * bits(precision) // 8 + scale_bytes)
    scales = rows * scale_bytes if precision == "int8" else 0
    return rows * columns * bits(precision) // 8 + scales
