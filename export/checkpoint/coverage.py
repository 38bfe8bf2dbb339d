"""What became of every tensor: the account that a checkpoint is accepted or refused by."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from export.model.weights import WeightsError

SHOWN = 3


class CheckpointError(WeightsError):
    """A checkpoint that is not what was asked for; `coverage` has the full lists where tensors were compared."""

    def __init__(self, message: str, coverage: Coverage | None = None) -> None:
        super().__init__(message)
        self.coverage = coverage


@dataclass(frozen=True)
class SourceCoverage:
    """One `--checkpoint`: how its tensors were read."""

    label: str
    layouts: tuple[str, ...]
    """Names of the layouts found, each with the prefix its tensors carry ("internvl, prefix vlm.")."""
    tensors: int
    loaded: int
    ignored: tuple[str, ...] = ()
    """Tensors that hold nothing to load (buffers computed from the configuration)."""
    outside: tuple[str, ...] = ()
    """Entries beside the weights (optimizer state and the like) that were not read."""


@dataclass(frozen=True)
class Coverage:
    """Every tensor of the files and of the network accounted for."""

    sources: tuple[SourceCoverage, ...] = ()
    loaded: dict[str, str] = field(default_factory=dict)
    """Tensor of the network → "file: tensor[, tensor …]" it was read from."""
    seeded: dict[str, int] = field(default_factory=dict)
    """Part of the network that no file has → the seed of its random weights."""
    missing: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()
    misshaped: tuple[str, ...] = ()
    repeated: tuple[str, ...] = ()

    @property
    def complete(self) -> bool:
        """Whether nothing is missing, unknown, of another shape or given twice."""
        return not (self.missing or self.unknown or self.misshaped or self.repeated)

    def difference(self) -> str:
        """The difference in one line: a count and the first few names of each kind."""
        kinds = {
            "missing": self.missing,
            "unknown": self.unknown,
            "of another shape": self.misshaped,
            "given twice": self.repeated,
        }
        return "; ".join(
            f"{len(names)} tensor{'s'[: len(names) != 1]} {kind} ({', '.join(names[:SHOWN])}"
            f"{', …' if len(names) > SHOWN else ''})"
            for kind, names in kinds.items()
            if names
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON form, with nothing left out."""
        return {
            "sources": [
                {
                    "label": s.label,
                    "layouts": list(s.layouts),
                    "tensors": s.tensors,
                    "loaded": s.loaded,
                    "ignored": list(s.ignored),
                    "outside": list(s.outside),
                }
                for s in self.sources
            ],
            "loaded": dict(self.loaded),
            "seeded": dict(self.seeded),
            "missing": list(self.missing),
            "unknown": list(self.unknown),
            "misshaped": list(self.misshaped),
            "repeated": list(self.repeated),
        }
