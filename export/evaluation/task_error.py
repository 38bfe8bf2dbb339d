"""The metric that decides: how far the robot's plan and command move when a graph is rounded, by age of the KV cache.

Every number is a difference to the fp32 model on the same samples, given also as a share of how much that model's own
plans vary: an untrained model plans nearly the same whatever it sees, and would make any rounding look exact.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from edge.core.geometry import SE2
from edge.motion.controller import TARGET_TIME_S, arc_to
from edge.reasoning.prompt import Segment
from edge.state.semantic import waypoints_now
from export.evaluation.task_samples import Sample, SampleSet

Floats = npt.NDArray[np.float32]
Picture = npt.NDArray[np.uint8]
Context: TypeAlias = tuple[Floats, Floats]


class TaskErrorError(ValueError):
    """Outputs that cannot be compared: not finite, or of another shape than the reference's."""


class Stages(Protocol):
    """The model in the calls that the runtime makes, whatever runs them."""

    def encode(self, frame: Picture) -> Floats:
        """Frame [1, px, px, 3] → visual tokens [1, N, D]."""

    def language(self, prompt: Sequence[Segment], new_tokens: int) -> tuple[Floats, tuple[int, ...]]:
        """K‖V of the last layer for every prompt token [1, T, kv_dim], and the first `new_tokens` greedy tokens."""

    def context(self, guidance: Floats) -> Context:
        """K‖V or waypoints → keys and values of every cross-attention layer, [layers, 1, heads, T, d] each."""

    def act(self, visual_tokens: Floats, state: Floats, latency: Floats, keys: Floats, values: Floats) -> Floats:
        """Visual tokens, state [1, 3], latency [1, 4] and context → trajectory [1, steps, 3]."""


@dataclass(frozen=True)
class StageOutputs:
    """Everything one implementation gave over a sample set."""

    visual: tuple[Floats, ...]
    """By frame."""
    kv: tuple[Floats, ...]
    """By sample."""
    token_ids: tuple[tuple[int, ...], ...]
    trajectories: tuple[Floats, ...]
    """By sample: [moments, steps, 3]."""
    swapped: tuple[Floats, ...]
    """The same moments under the semantic context of the next sample (negative control)."""


def run_stages(
    stages: Stages, samples: SampleSet, *, new_tokens: int = 0, progress: Callable[[str], None] = lambda _: None
) -> StageOutputs:
    """Run a whole sample set; for the reference once, for a candidate through `task_error`."""
    visual = []
    for number, frame in enumerate(samples.frames):
        progress(f"frame {number + 1} of {len(samples.frames)}")
        visual.append(stages.encode(frame))
    kv, token_ids = [], []
    for sample in samples.samples:
        progress(f"generation {sample.name}")
        last_layer_kv, ids = stages.language(prompt_parts(sample, visual), new_tokens)
        kv.append(last_layer_kv)
        token_ids.append(ids)
    contexts = [moment_contexts(stages.context, s, x) for s, x in zip(samples.samples, kv, strict=True)]
    others = [*samples.samples[1:], samples.samples[0]]
    swapped = [
        moment_contexts(stages.context, replace(s, waypoints=other.waypoints), x)
        for s, other, x in zip(samples.samples, others, kv[1:] + kv[:1], strict=True)
    ]
    return StageOutputs(
        tuple(visual),
        tuple(kv),
        tuple(token_ids),
        tuple(plan(stages, s, visual, c) for s, c in zip(samples.samples, contexts, strict=True)),
        tuple(plan(stages, s, visual, c) for s, c in zip(samples.samples, swapped, strict=True)),
    )


def prompt_parts(sample: Sample, visual: Sequence[Floats] | Mapping[int, Floats]) -> list[Segment]:
    """The sample's prompt with its frames' visual tokens."""
    return [Segment(part.ids, None if part.frame is None else visual[part.frame]) for part in sample.prompt]


def moment_contexts(context: Callable[[Floats], Context], sample: Sample, last_layer_kv: Floats) -> list[Context]:
    """The semantic context at every moment of a sample: K‖V's does not change, waypoints' moves with the robot."""
    if sample.waypoints is None:
        return [context(last_layer_kv)] * len(sample.moments)
    return [context(waypoints_now(sample.waypoints, moment.offset)) for moment in sample.moments]


def plan(
    stages: Stages,
    sample: Sample,
    visual: Sequence[Floats] | Mapping[int, Floats],
    contexts: Sequence[Context],
) -> Floats:
    """Trajectories [moments, steps, 3] of a sample under the semantic context of every moment."""
    planned = [
        stages.act(
            visual[moment.frame],
            np.array([moment.state], dtype=np.float32),
            np.array([moment.latency], dtype=np.float32),
            *context,
        )
        for moment, context in zip(sample.moments, contexts, strict=True)
    ]
    return np.concatenate(planned)


@dataclass(frozen=True)
class Stat:
    """Mean, 95th percentile (nearest rank) and maximum."""

    mean: float
    p95: float
    max: float

    @classmethod
    def of(cls, values: Sequence[float] | Floats) -> Stat:
        """Of at least one value; four significant digits: more say nothing and differ between machines."""
        array = np.asarray(values, dtype=np.float64)
        p95 = np.percentile(array, 95, method="inverted_cdf")
        return cls(short(array.mean()), short(p95), short(array.max()))


@dataclass(frozen=True)
class Errors:
    """Differences to the reference over some moments."""

    moments: int
    waypoint_1s_cm: Stat
    waypoint_end_cm: Stat
    """At the end of the chunk (3 s)."""
    waypoint_mean_cm: Stat
    """Mean over the chunk's points."""
    heading_1s_deg: Stat
    heading_end_deg: Stat
    speed_mps: Stat
    turn_radps: Stat


@dataclass(frozen=True)
class TaskError:
    """Task error of a candidate, over all moments and by delay of the semantic state."""

    overall: Errors
    by_delay: tuple[tuple[float, Errors], ...]
    spread_cm: float
    """How far the reference's own plans lie from their mean, RMS over moments and points of the chunk."""
    spread_deg: float
    semantic_cm: float
    """How far the reference's plans move when they are given the semantic state of another sample."""
    visual_cosine: float
    """Lowest over the frames."""
    kv_cosine: float
    """Lowest over the samples."""
    kv_error: float
    """Largest ‖K‖V − reference‖ / ‖reference‖ over the samples."""
    token_agreement: float | None
    """Mean share of the first greedy tokens before the first that differs; None when no text was generated."""

    @property
    def waypoint_cm(self) -> float:
        """The gate's figure: the worst moment's mean deviation over the chunk."""
        return self.overall.waypoint_mean_cm.max

    @property
    def heading_deg(self) -> float:
        """The gate's figure: the worst moment's heading error at the end of the chunk."""
        return self.overall.heading_end_deg.max

    @property
    def speed_mps(self) -> float:
        """The gate's figure: the worst moment's forward-speed error."""
        return self.overall.speed_mps.max

    @property
    def turn_radps(self) -> float:
        """The gate's figure: the worst moment's yaw-rate error."""
        return self.overall.turn_radps.max

    @property
    def relative(self) -> float:
        """Mean deviation as a share of the reference's own spread: the larger of waypoints and heading."""
        shares = (
            _share(self.overall.waypoint_mean_cm.mean, self.spread_cm),
            _share(self.overall.heading_end_deg.mean, self.spread_deg),
        )
        return short(max(shares))

    @property
    def relative_semantic(self) -> float:
        """Mean deviation as a share of what another semantic state would do: judges the language model alone."""
        return short(_share(self.overall.waypoint_mean_cm.mean, self.semantic_cm))

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON form with the gate's figures."""
        return {
            "waypoint_cm": self.waypoint_cm,
            "heading_deg": self.heading_deg,
            "speed_mps": self.speed_mps,
            "turn_radps": self.turn_radps,
            "relative": _finite(self.relative),
            "relative_semantic": _finite(self.relative_semantic),
            "spread_cm": self.spread_cm,
            "spread_deg": self.spread_deg,
            "semantic_cm": self.semantic_cm,
            "visual_cosine": self.visual_cosine,
            "kv_cosine": self.kv_cosine,
            "kv_error": self.kv_error,
            "token_agreement": self.token_agreement,
            "overall": _plain(self.overall),
            "by_delay_s": {f"{delay_s:g}": _plain(errors) for delay_s, errors in self.by_delay},
        }


def task_error(
    reference: StageOutputs, candidate: Stages, samples: SampleSet, *, new_tokens: int = 0,
    progress: Callable[[str], None] = lambda _: None,
) -> TaskError:  # fmt: skip
    """Run the candidate over the samples and compare with the reference's outputs; raises TaskErrorError."""
    return compare(reference, run_stages(candidate, samples, new_tokens=new_tokens, progress=progress), samples)


def compare(reference: StageOutputs, found: StageOutputs, samples: SampleSet) -> TaskError:
    """Task error of outputs that are there already; raises TaskErrorError."""
    errors = compare_plans(reference.trajectories, found.trajectories, samples)
    agreement = [_agreement(a, b) for a, b in zip(reference.token_ids, found.token_ids, strict=True) if a]
    delays = [moment.delay_s for sample in samples.samples for moment in sample.moments]
    everything = np.concatenate(reference.trajectories)
    swapped = np.concatenate(reference.swapped)
    spread_cm, spread_deg = spread(everything)
    moved = np.linalg.norm((swapped - everything)[..., :2].astype(np.float64), axis=-1)
    return TaskError(
        overall=_errors(errors, [True] * len(delays)),
        by_delay=tuple((d, _errors(errors, [d == other for other in delays])) for d in sorted(set(delays))),
        spread_cm=spread_cm,
        spread_deg=spread_deg,
        semantic_cm=short(100 * moved.mean()),
        visual_cosine=short(min(map(cosine, reference.visual, found.visual)), digits=7),
        kv_cosine=short(min(map(cosine, reference.kv, found.kv)), digits=7),
        kv_error=short(max(map(relative_error, reference.kv, found.kv))),
        token_agreement=short(sum(agreement) / len(agreement)) if agreement else None,
    )


def compare_plans(reference: Sequence[Floats], found: Sequence[Floats], samples: SampleSet) -> dict[str, Floats]:
    """Deviation of every moment by the names of `Errors`' figures; raises TaskErrorError."""
    a, b = np.concatenate(list(reference)).astype(np.float64), np.concatenate(list(found)).astype(np.float64)
    if a.shape != b.shape:
        raise TaskErrorError(f"trajectories are {list(b.shape)}, the reference's {list(a.shape)}")
    if not np.isfinite(b).all():
        raise TaskErrorError("a planned trajectory is not finite")
    one_second = min(a.shape[1], max(1, round(TARGET_TIME_S / samples.step_s))) - 1
    distance_cm = 100 * np.linalg.norm(a[..., :2] - b[..., :2], axis=-1)
    turn_deg = np.degrees(np.abs((a[..., 2] - b[..., 2] + math.pi) % (2 * math.pi) - math.pi))
    commands = np.abs(np.array([_command(row[one_second]) for row in a]) - [_command(row[one_second]) for row in b])
    return {
        "waypoint_1s_cm": distance_cm[:, one_second],
        "waypoint_end_cm": distance_cm[:, -1],
        "waypoint_mean_cm": distance_cm.mean(axis=1),
        "heading_1s_deg": turn_deg[:, one_second],
        "heading_end_deg": turn_deg[:, -1],
        "speed_mps": commands[:, 0],
        "turn_radps": commands[:, 1],
    }


def _command(point: npt.NDArray[np.float64]) -> tuple[float, float]:
    return arc_to(SE2(*(float(value) for value in point)), TARGET_TIME_S)


def _errors(values: Mapping[str, Floats], chosen: Sequence[bool]) -> Errors:
    mask = np.array(chosen)
    return Errors(int(mask.sum()), **{name: Stat.of(array[mask]) for name, array in values.items()})


def spread(trajectories: Floats) -> tuple[float, float]:
    """RMS distance (cm) and RMS end heading (deg) of trajectories [n, steps, 3] to their mean."""
    centred = trajectories.astype(np.float64) - trajectories.astype(np.float64).mean(axis=0)
    distance_cm = 100 * math.sqrt(float((centred[..., :2] ** 2).sum(axis=-1).mean()))
    return short(distance_cm), short(math.degrees(math.sqrt(float((centred[:, -1, 2] ** 2).mean()))))


def cosine(a: Floats, b: Floats) -> float:
    """Cosine of two arrays as vectors; 1 only for equal ones when a norm is zero."""
    x, y = a.ravel().astype(np.float64), b.ravel().astype(np.float64)
    # Plain sums: a threaded BLAS would add in an order that depends on the machine, and on a busy one takes longer.
    norm = math.sqrt(float((x * x).sum()) * float((y * y).sum()))
    return float((x * y).sum()) / norm if norm > 0 else float(np.array_equal(x, y))


def relative_error(reference: Floats, found: Floats) -> float:
    """‖found − reference‖ / ‖reference‖; raises TaskErrorError for another shape or values that are not finite."""
    if reference.shape != found.shape or not np.isfinite(found).all():
        raise TaskErrorError(f"semantic state is not finite or {list(found.shape)}, expected {list(reference.shape)}")
    squares = [float((x.astype(np.float64) ** 2).sum()) for x in (found - reference, reference)]
    return math.sqrt(squares[0] / max(squares[1], 1e-60))


def _agreement(a: Sequence[int], b: Sequence[int]) -> float:
    same = 0
    for x, y in zip(a, b, strict=False):
        if x != y:
            break
        same += 1
    return same / len(a) if len(a) == len(b) or same < min(len(a), len(b)) else same / max(len(a), len(b))


def _share(value: float, of: float) -> float:
    if value == 0:
        return 0.0
    return value / of if of > 0 else math.inf


def short(value: float, digits: int = 4) -> float:
    """The value with that many significant digits: more say nothing, and would differ between machines."""
    return float(f"{float(value):.{digits}g}")


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _plain(errors: Errors) -> dict[str, object]:
    stats = {name: vars(value) for name, value in vars(errors).items() if isinstance(value, Stat)}
    return {"moments": errors.moments, **{name: dict(stat) for name, stat in stats.items()}}
