"""Chooses every graph's precision by the task error of its rounding, and gives the reason in one sentence.

The search takes the smallest candidate whose task error stays within the limits. If raising the most sensitive groups
of layers to the next more exact candidate is enough, it does that. It measures no time: the same inputs give the same
decision.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from torch import nn

from export.evaluation.calibration import CalibrationSet
from export.evaluation.precision_probe import Probe, Reading, Reference, probe
from export.evaluation.task_error import short
from export.evaluation.task_samples import SampleSet, is_large, samples_from
from export.graphs.build import linear_layers
from export.model.config import TicVlaConfig
from export.model.network import TicVla
from export.quantize.precision import Precision, bits, weight_bytes
from export.quantize.rounding import Rounder
from export.targets.sections import Measured

SEARCH_DELAYS_S = (0.0, 3.0, 10.0)
RELATIVE_LIMIT = 0.5
"""Largest mean deviation as a share of the fp32 plans' spread; the only limit that matters for untrained weights."""


@dataclass(frozen=True)
class Limits:
    """Largest change of plan and command by rounding one graph (a target's `[gates.task]`)."""

    waypoint_cm: float
    heading_deg: float
    speed_mps: float
    turn_radps: float
    relative: float = RELATIVE_LIMIT
    top1: float | None = None
    """Smallest share of equal next tokens, 0 for any; ignored for untrained weights, whose logits are nearly equal."""
    output_error: float | None = None
    """Largest relative change of the graph's output, as in the gate."""

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if value is not None and not (value > 0 or (name == "top1" and value == 0)):
                raise ValueError(f"limit {name} must be positive, found {value}")

    def load(self, reading: Reading, *, trained: bool) -> float:
        """Return the largest figure of the reading as a share of its limit; at most 1 is within the limits."""
        names = ("waypoint_cm", "heading_deg", "speed_mps", "turn_radps", "relative")
        shares: list[float] = [getattr(reading, name) / getattr(self, name) for name in names]
        if trained and self.top1 is not None and reading.top1 is not None:
            shares.append((1 - reading.top1) / max(1 - self.top1, 1e-9))
        if self.output_error is not None:
            shares.append(reading.output_error / self.output_error)
        return max(shares)


@dataclass(frozen=True)
class SensitivityRow:
    """Task error of a graph with one group of layers rounded (`*`: all of them except `raised`)."""

    group: str
    precision: str
    raised: tuple[str, ...]
    waypoint_cm: float
    heading_deg: float
    speed_mps: float
    turn_radps: float
    relative: float | None
    """None: the fp32 plans do not vary."""
    output_error: float
    top1: float | None
    load: float | None
    """The largest figure as a share of its limit; at most 1 is within the limits."""


@dataclass(frozen=True)
class Dropped:
    """Candidate that was not tried, with the reason."""

    precision: str
    reason: str


@dataclass(frozen=True)
class Decision:
    """Chosen precision of a graph."""

    graph: str
    precision: Precision
    reason: str
    """One sentence with the numbers, for the manifest."""
    within_limits: bool
    weight_bytes: int
    dropped: tuple[Dropped, ...]
    table: tuple[SensitivityRow, ...]
    """Whole graphs in the order of the search, then groups from the most to the least sensitive."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON form."""
        return {**asdict(self), "precision": self.precision.to_dict()}


def search_samples(
    calibration: CalibrationSet, config: TicVlaConfig, frame_offsets_s: Sequence[float], tokenizer: bytes
) -> SampleSet:
    """Return the samples of the search: one anchor per clip (two for a single clip) and three delays.

    A large model gets two clips and one frame a prompt.
    """
    per_clip = 1 if len(calibration.clips) > 1 else 2
    if is_large(config):
        calibration = CalibrationSet(calibration.name, calibration.sha256, calibration.clips[:2])
        frame_offsets_s = (0.0,)
    return samples_from(
        calibration, config, frame_offsets_s, tokenizer, delays_s=SEARCH_DELAYS_S, anchors_per_clip=per_clip
    )


class Search:
    """Search for the precisions of one model's graphs, with shared outputs of the fp32 model.

    Set the number of torch threads before: it changes the order of sums and so the last digit.
    """

    def __init__(
        self, model: TicVla, samples: SampleSet, *, trained: bool, progress: Callable[[str], None] = lambda _: None
    ) -> None:
        self._model = model
        self.trained = trained
        self._progress = progress
        self._reference = Reference(model, samples, progress)

    def choose(
        self,
        graph: str,
        candidates: Sequence[str],
        limits: Limits,
        *,
        measured: Sequence[Measured] = (),
        speed_first: bool = False,
    ) -> Decision:
        """Choose one graph's precision; `candidates` are ordered from the most exact to the smallest.

        `int8` layers are tried with rounded inputs in every form, as the fused kernels and the encoder's plain form
        compute. For a plain graph that rounds only weights, the choice is too exact rather than too coarse.
        """
        if not candidates:
            raise ValueError(f"{graph}: no candidates to choose a precision from")
        sizes = {c: self.bytes_of(graph, Precision(c)) for c in candidates}
        kept, dropped = drop_dominated(graph, candidates, sizes, measured, speed_first=speed_first)
        # Keep the rounded weights of one graph at a time: those of all would take as much memory as the model.
        found = probe(self._reference, graph, Rounder(), activations=True)
        trial = _Trial(found, limits, self.trained, self._progress)
        precision, within = _smallest_within(trial, kept)
        reason = _reason(trial, self, graph, precision, kept, within)
        return Decision(
            graph=graph,
            precision=precision,
            reason="; ".join([reason, *(f"{item.precision} dropped: {item.reason}" for item in dropped)]),
            within_limits=within,
            weight_bytes=self.bytes_of(graph, precision),
            dropped=dropped,
            table=(*trial.wholes.values(), *trial.ranked),
        )

    def bytes_of(self, graph: str, precision: Precision) -> int:
        """Return the bytes of the graph's linear layers in a precision."""
        part: nn.Module = self._model.vision if graph == "vision_encoder" else self._model.action
        if graph.split(".")[0] == "language_model":
            part = self._model.language
        total = 0
        for layer in linear_layers(self._model.config, graph):
            module, of = part.get_submodule(layer), precision.of(layer)
            assert isinstance(module.weight, nn.Parameter)
            if isinstance(module, nn.Embedding) and of not in ("fp32", "fp16"):
                of = "int8"  # a token table has 8 bits or more
            rows = module.weight.shape[0]
            total += weight_bytes(of, rows, module.weight.numel() // rows)
        return total


def drop_dominated(
    graph: str,
    candidates: Sequence[str],
    sizes_bytes: dict[str, int],
    measured: Sequence[Measured],
    *,
    speed_first: bool = False,
) -> tuple[tuple[str, ...], tuple[Dropped, ...]]:
    """Drop candidates that are neither smaller nor faster than a more exact one; returns the rest and the reasons.

    Only the target's measured points decide which is faster; nothing is timed here. With `speed_first` (graphs limited
    by computing, not by reading weights) a candidate measured slower than a more exact one is dropped even if smaller.
    """
    kept: list[str] = []
    dropped: list[Dropped] = []
    for candidate in candidates:
        reason = ""
        for exact in kept:
            a, b = _time(graph, exact, measured), _time(graph, candidate, measured)
            smaller = sizes_bytes[candidate] < sizes_bytes[exact]
            times = "no measured time shows that it is faster"
            faster = slower = False
            if a is not None and b is not None:
                times, faster, slower = f"{b:.4g} against {a:.4g} ms", b < a, b > a
            if not smaller and not faster:
                size = f"{_mb(sizes_bytes[candidate])} against {_mb(sizes_bytes[exact])}"
                reason = f"not smaller than the more exact {exact} ({size}) and not faster ({times})"
            elif speed_first and slower:
                reason = f"slower than the more exact {exact} ({times})"
        if reason:
            dropped.append(Dropped(candidate, reason))
        else:
            kept.append(candidate)
    return tuple(kept), tuple(dropped)


def _time(graph: str, precision: str, measured: Sequence[Measured]) -> float | None:
    """Return the best measured time of a call or of a token, ms."""
    times: list[float] = []
    for point in measured:
        if point.graph == graph and point.precision == precision:
            times.append(point.ms if point.ms is not None else 1000 / (point.tokens_per_s or math.nan))
    return min(times, default=None)


UNRANKED_BITS = 16
"""Bits from which a graph within the limits is not searched for its most sensitive layers."""


class _Trial:
    """Readings of one graph, each computed once."""

    def __init__(self, found: Probe, limits: Limits, trained: bool, progress: Callable[[str], None]) -> None:
        self.probe = found
        self.limits = limits
        self._trained = trained
        self._progress = progress
        self.wholes: dict[Precision, SensitivityRow] = {}
        self.ranked: tuple[SensitivityRow, ...] = ()

    def whole(self, precision: Precision) -> SensitivityRow:
        """Read the task error of the graph in a precision with overrides."""
        if precision not in self.wholes:
            raised = tuple(pattern for pattern, _ in precision.overrides)
            self._progress(f"sensitivity: {self.probe.graph} in {precision.default}, {len(raised)} groups raised")
            self.wholes[precision] = self._row("*", precision.default, raised, self.probe.whole(precision))
        return self.wholes[precision]

    def rank(self, precision: str) -> tuple[SensitivityRow, ...]:
        """Read the task error of every group alone in a precision; the most sensitive first."""
        if not self.ranked:
            rows = []
            groups = self.probe.groups
            for number, group in enumerate(groups):
                self._progress(f"sensitivity: {self.probe.graph} {group} in {precision}, {number + 1}/{len(groups)}")
                rows.append(self._row(group, precision, (), self.probe.group(group, precision)))
            # Equal loads keep the graph's order; the output error decides between groups without effect on the limits.
            rows.sort(key=lambda row: (-_sortable(row.load), -_sortable(row.output_error)))
            self.ranked = tuple(rows)
        return self.ranked

    def _row(self, group: str, precision: str, raised: tuple[str, ...], reading: Reading) -> SensitivityRow:
        load = self.limits.load(reading, trained=self._trained)
        values: dict[str, Any] = {
            name: value if value is None or math.isfinite(value) else None for name, value in asdict(reading).items()
        }
        return SensitivityRow(group, precision, raised, load=short(load) if math.isfinite(load) else None, **values)


def _smallest_within(trial: _Trial, kept: Sequence[str]) -> tuple[Precision, bool]:
    """Find the smallest candidate within the limits, with as few raised groups as possible."""
    if len(kept) == 1:
        return Precision(kept[0]), _within(trial, Precision(kept[0]))
    if bits(kept[-1]) >= UNRANKED_BITS and _within(trial, Precision(kept[-1])):
        return Precision(kept[-1]), True
    # Rank the groups once, at the coarsest precision: their order hardly depends on it.
    ranked = trial.rank(kept[-1])
    for index in range(len(kept) - 1, 0, -1):
        default, exact = kept[index], kept[index - 1]
        if _within(trial, Precision(default)):
            return Precision(default), True
        # Double the number of raised groups; if half must be raised, the next candidate is the simpler choice.
        count = 1
        while count <= len(ranked) // 2:
            if _within(trial, _raised(default, exact, ranked, count)):
                return _raised(default, exact, ranked, _fewest(trial, default, exact, ranked, count)), True
            count *= 2
    return Precision(kept[0]), _within(trial, Precision(kept[0]))


def _fewest(trial: _Trial, default: str, exact: str, ranked: Sequence[SensitivityRow], enough: int) -> int:
    """Find the smallest sufficient number of raised groups between `enough`/2, which is too small, and `enough`."""
    low, high = enough // 2, enough
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if _within(trial, _raised(default, exact, ranked, middle)) else (middle, high)
    return high


def _raised(default: str, exact: str, ranked: Sequence[SensitivityRow], count: int) -> Precision:
    return Precision(default, tuple((row.group, exact) for row in ranked[:count]))


def _within(trial: _Trial, precision: Precision) -> bool:
    if precision == Precision("fp32"):
        return True
    return _sortable(trial.whole(precision).load) <= 1


def _sortable(value: float | None) -> float:
    return math.inf if value is None else value


def _reason(trial: _Trial, search: Search, graph: str, precision: Precision, kept: Sequence[str], within: bool) -> str:
    if precision == Precision("fp32") and len(kept) == 1:
        return "fp32: the only candidate"
    parts = []
    if precision in trial.wholes:
        row, limits = trial.wholes[precision], trial.limits
        share = "unknown" if row.relative is None else f"{100 * row.relative:.2g} %"
        parts.append(
            f"{precision.default}: plans move by at most {row.waypoint_cm:.2g} cm and {row.heading_deg:.2g} deg, on "
            f"average {share} of their own spread (limits {limits.waypoint_cm:g} cm, {limits.heading_deg:g} deg, "
            f"{100 * limits.relative:g} %)"
        )
        if limits.output_error is not None:
            parts.append(
                f"its outputs move by {100 * row.output_error:.2g} % (limit {100 * limits.output_error:.2g} %)"
            )
    else:
        parts.append(f"{precision.default}: the exact model")
    if not within:
        parts.append("outside the limits, but no candidate is more exact")
    if precision.overrides:
        names, to = [pattern for pattern, _ in precision.overrides], precision.overrides[0][1]
        parts.append(f"{', '.join(names)} raised to {to}, the most sensitive of {len(trial.ranked)} groups of layers")
    for candidate in kept[kept.index(precision.default) + 1 :]:
        row = trial.wholes[Precision(candidate)]
        load = "far" if row.load is None else f"{row.load:.2g} times"
        parts.append(f"{candidate} alone is {load} the limit")
    size, exact = search.bytes_of(graph, precision), search.bytes_of(graph, Precision(kept[0]))
    if size != exact:
        parts.append(f"{_mb(size)} instead of {_mb(exact)} in {kept[0]}")
    if not search.trained:
        parts.append("untrained weights: of these limits only the share of the spread is meaningful")
    return "; ".join(parts)


def _mb(size_bytes: int) -> str:
    return f"{size_bytes / 1e6:.3g} MB"
