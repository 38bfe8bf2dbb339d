"""How far a graph's outputs are from PyTorch's: worst cosine, largest difference, agreement of the chosen token."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Arrays = Mapping[str, Array]
RunGraph = Callable[[Arrays], Arrays]

PRIMARY_OUTPUTS = ("visual_tokens", "logits", "last_layer_kv", "context.0.value", "trajectory")
"""What must differ between two inputs; caches echo their input and would always differ."""


class ParityError(Exception):
    """Outputs that cannot even be compared: another shape, or values that are not finite."""


@dataclass(frozen=True)
class Sample:
    """One test input of a graph and what PyTorch makes of it, both by tensor name."""

    feeds: dict[str, Array]
    expected: dict[str, Array]
    """Outputs to compare; a graph may have more, which are then not judged."""


@dataclass(frozen=True)
class ParityResult:
    """Worst case over all inputs and outputs of one graph."""

    inputs: int
    cosine: float
    max_abs: float
    min_difference: float
    """Smallest largest difference between the outputs of two different inputs (negative control)."""
    top1: float | None
    """Share of positions at which the same token is most likely, 0 to 1; None for a graph without tokens."""

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON form."""
        return asdict(self)


def compare(graph: str, samples: Sequence[Sample], run: RunGraph) -> ParityResult:
    """Run a graph over all samples and compare; raises ParityError, and ValueError for less than two samples."""
    if len(samples) < 2:
        raise ValueError(f"{graph}: {len(samples)} samples, expected two or more for the negative control")
    cosine, max_abs, min_difference = 1.0, 0.0, np.inf
    same, tokens = 0, 0
    primary: list[list[Array]] = []
    for sample in samples:
        found = run(sample.feeds)
        for name, expected in sample.expected.items():
            actual = _comparable(graph, name, expected, found)
            if not expected.size:
                continue
            if name == "next_token":
                # An index has no cosine. Where there are logits they tell more than the one that won.
                if "logits" not in sample.expected:
                    same, tokens = same + int(np.sum(expected == actual)), tokens + expected.size
                continue
            if name == "logits":
                agree = expected.argmax(axis=-1) == actual.argmax(axis=-1)
                same, tokens = same + int(agree.sum()), tokens + agree.size
            cosine = min(cosine, _cosine(expected, actual))
            max_abs = max(max_abs, float(np.max(np.abs(expected.astype(np.float64) - actual))))
        chosen = [found[name] for name in PRIMARY_OUTPUTS if name in sample.expected]
        min_difference = min([min_difference, *(_difference(chosen, other) for other in primary)])
        primary.append(chosen)
    return ParityResult(
        inputs=len(samples),
        cosine=round(cosine, 9),
        max_abs=_short(max_abs),
        min_difference=_short(float(min_difference)),
        top1=round(same / tokens, 6) if tokens else None,
    )


def _short(value: float) -> float:
    """Four significant digits: more say nothing, and would differ between machines."""
    return float(f"{value:.4g}")


def _comparable(graph: str, name: str, expected: Array, found: Arrays) -> Array:
    if name not in found:
        raise ParityError(f"{graph}: gives no {name!r}")
    actual = found[name]
    if actual.shape != expected.shape:
        raise ParityError(f"{graph}: {name} is {list(actual.shape)}, PyTorch gives {list(expected.shape)}")
    if not np.isfinite(actual).all():
        raise ParityError(f"{graph}: {name} has values that are not finite")
    return actual


def _cosine(a: Array, b: Array) -> float:
    x, y = a.ravel().astype(np.float64), b.ravel().astype(np.float64)
    # Plain sums: a threaded BLAS would add in an order that depends on the machine, and on a busy one takes longer.
    norm = math.sqrt(float((x * x).sum()) * float((y * y).sum()))
    return float((x * y).sum()) / norm if norm > 0 else float(np.array_equal(x, y))


def _difference(a: Sequence[Array], b: Sequence[Array]) -> float:
    """Largest difference where two runs overlap (their free axes may differ in length)."""
    largest = 0.0
    for x, y in zip(a, b, strict=True):
        cut = tuple(slice(0, min(m, n)) for m, n in zip(x.shape, y.shape, strict=True))
        if all(s.stop > 0 for s in cut):
            largest = max(largest, float(np.max(np.abs(x[cut].astype(np.float64) - y[cut].astype(np.float64)))))
    return largest
