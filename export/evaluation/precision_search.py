"""Chooses every graph's precision by what rounding does to the robot's plan, with the reason in one sentence.

From the smallest candidate up, the first whose task error stays within the limits is taken; its most sensitive groups
of layers are raised to the next more exact candidate where that is enough. Nothing here is timed: the same inputs give
the same decision.
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
"""Largest mean deviation as a share of the fp32 plans' spread. In effect untrained weights are judged by it alone."""


@dataclass(frozen=True)
class Limits:
    """How far rounding one graph may move the plan and the command (a target's `[gates.task]`)."""

    waypoint_cm: float
    heading_deg: float
    speed_mps: float
    turn_radps: float
    relative: float = RELATIVE_LIMIT
    top1: float | None = None
    """Smallest share of equal next tokens; only held against trained weights: untrained logits are nearly ties."""
    output_error: float | None = None
    """Largest change of the graph's own output, as a share of it: what the gate holds its tensors to."""

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if value is not None and not value > 0:
                raise ValueError(f"limit {name} must be positive, found {value}")

    def load(self, reading: Reading, *, trained: bool) -> float:
        """The largest of the reading's figures as a share of its limit; at most 1 is within the limits."""
        names = ("waypoint_cm", "heading_deg", "speed_mps", "turn_radps", "relative")
        shares: list[float] = [getattr(reading, name) / getattr(self, name) for name in names]
        if trained and self.top1 is not None and reading.top1 is not None:
            shares.append((1 - reading.top1) / max(1 - self.top1, 1e-9))
        if self.output_error is not None:
            shares.append(reading.output_error / self.output_error)
        return max(shares)


@dataclass(frozen=True)
class SensitivityRow:
    """Task error of a graph with one group of layers rounded (`*`: all of them, `raised` exempted)."""

    group: str
    precision: str
    raised: tuple[str, ...]
    waypoint_cm: float
    heading_deg: float
    speed_mps: float
    turn_radps: float
    relative: float | None
    """None: the fp32 plans do not vary at all."""
    output_error: float
    top1: float | None
    load: float | None
    """The largest figure as a share of its limit; at most 1 is within the limits."""


@dataclass(frozen=True)
class Dropped:
    """A candidate that was not tried, and why."""

    precision: str
    reason: str


@dataclass(frozen=True)
class Decision:
    """The precision that a graph ships in."""

    graph: str
    precision: Precision
    reason: str
    """One sentence with the numbers, for the manifest."""
    within_limits: bool
    weight_bytes: int
    dropped: tuple[Dropped, ...]
    table: tuple[SensitivityRow, ...]
    """Whole graphs in the order they were tried, then groups from the most to the least sensitive."""

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON form."""
        return {**asdict(self), "precision": self.precision.to_dict()}


def search_samples(
    calibration: CalibrationSet, config: TicVlaConfig, frame_offsets_s: Sequence[float], tokenizer: bytes
) -> SampleSet:
    """The samples of the search: one anchor a clip, or two in a single one, and three delays.

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
    """Decisions for the graphs of one model, sharing what the fp32 model makes of the samples.

    Set the number of torch threads before: another number sums in another order and may change a last digit.
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
        """Decide for one graph; `candidates` run from the most exact to the smallest. See `drop_dominated`.

        `int8` layers are tried with their inputs rounded too, in every form: the fused kernels do that, and so does the
        plain form of the encoder. Where a plain graph rounds weights alone, the decision errs on the exact side.
        """
        if not candidates:
            raise ValueError(f"{graph}: no candidates to choose a precision from")
        sizes = {c: self.bytes_of(graph, Precision(c)) for c in candidates}
        kept, dropped = drop_dominated(graph, candidates, sizes, measured, speed_first=speed_first)
        # The rounded weights of one graph at a time: kept for all, they would take as much memory as the model.
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
        """Bytes of the graph's linear layers in a precision."""
        part: nn.Module = self._model.vision if graph == "vision_encoder" else self._model.action
        if graph.split(".")[0] == "language_model":
            part = self._model.language
        total = 0
        for layer in linear_layers(self._model.config, graph):
            module, of = part.get_submodule(layer), precision.of(layer)
            assert isinstance(module.weight, nn.Parameter)
            if isinstance(module, nn.Embedding) and of not in ("fp32", "fp16"):
                of = "int8"  # a token table is stored in 8 bits at least
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
    """Candidates without those that are neither smaller nor faster than a more exact one, and why they went.

    Faster counts only when the target's measured points say so, never by timing here. With `speed_first` (graphs that
    compute rather than read weights) a candidate that was measured slower than a more exact one goes although smaller.
    """
    kept: list[str] = []
    dropped: list[Dropped] = []
    for candidate in candidates:
        reason = ""
        for exact in kept:
            a, b = _time(graph, exact, measured), _time(graph, candidate, measured)
            smaller = sizes_bytes[candidate] < sizes_bytes[exact]
            times = "no measured time says it is faster"
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
    """Best measured time in ms, of a call or of a token."""
    times: list[float] = []
    for point in measured:
        if point.graph == graph and point.precision == precision:
            times.append(point.ms if point.ms is not None else 1000 / (point.tokens_per_s or math.nan))
    return min(times, default=None)


UNRANKED_BITS = 16
"""A graph that keeps the limits in this many bits is not searched for its most sensitive layers."""


class _Trial:
    """Readings of one graph, each taken once."""

    def __init__(self, found: Probe, limits: Limits, trained: bool, progress: Callable[[str], None]) -> None:
        self.probe = found
        self.limits = limits
        self._trained = trained
        self._progress = progress
        self.wholes: dict[Precision, SensitivityRow] = {}
        self.ranked: tuple[SensitivityRow, ...] = ()

    def whole(self, precision: Precision) -> SensitivityRow:
        """The graph in a precision with overrides."""
        if precision not in self.wholes:
            raised = tuple(pattern for pattern, _ in precision.overrides)
            self._progress(f"sensitivity: {self.probe.graph} in {precision.default}, {len(raised)} groups raised")
            self.wholes[precision] = self._row("*", precision.default, raised, self.probe.whole(precision))
        return self.wholes[precision]

    def rank(self, precision: str) -> tuple[SensitivityRow, ...]:
        """Every group alone in a precision, the most sensitive first."""
        if not self.ranked:
            rows = []
            groups = self.probe.groups
            for number, group in enumerate(groups):
                self._progress(f"sensitivity: {self.probe.graph} {group} in {precision}, {number + 1}/{len(groups)}")
                rows.append(self._row(group, precision, (), self.probe.group(group, precision)))
            # Equal loads keep the graph's order; the output's own error decides between groups that no limit feels.
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
    """The smallest candidate within the limits, with as few groups raised as that takes."""
    if len(kept) == 1:
        return Precision(kept[0]), _within(trial, Precision(kept[0]))
    if bits(kept[-1]) >= UNRANKED_BITS and _within(trial, Precision(kept[-1])):
        return Precision(kept[-1]), True
    # The groups are ranked once, where rounding hurts most: their order hardly depends on the precision.
    ranked = trial.rank(kept[-1])
    for index in range(len(kept) - 1, 0, -1):
        default, exact = kept[index], kept[index - 1]
        if _within(trial, Precision(default)):
            return Precision(default), True
        # Raised in doubling numbers: if half of the groups must be raised, the next candidate is the plainer answer.
        count = 1
        while count <= len(ranked) // 2:
            if _within(trial, _raised(default, exact, ranked, count)):
                return _raised(default, exact, ranked, _fewest(trial, default, exact, ranked, count)), True
            count *= 2
    return Precision(kept[0]), _within(trial, Precision(kept[0]))


def _fewest(trial: _Trial, default: str, exact: str, ranked: Sequence[SensitivityRow], enough: int) -> int:
    """The smallest number of raised groups between `enough`/2, which is too few, and `enough`."""
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
        parts.append("untrained weights: of these only the share of the spread means anything")
    return "; ".join(parts)


def _mb(size_bytes: int) -> str:
    return f"{size_bytes / 1e6:.3g} MB"
