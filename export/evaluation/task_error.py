"""Task error: the change of the robot's plan and command when a graph is rounded, by age of the KV cache.

Every number is a difference to the fp32 model on the same samples, also as a share of the spread of that model's plans:
the plans of an untrained model hardly depend on its inputs, so every rounding would seem exact.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from edge.core.geometry import SE2
from edge.motion.controller import TARGET_TIME_S, arc_to
from edge.reasoning.prompt import Segment
from edge.state.semantic import waypoints_now
from export.evaluation.task_samples import Sample, SampleSet
from export.graphs.build import linear_layers
from export.model.network import TicVla
from export.quantize.precision import Precision
from export.quantize.rounding import Rounder

Floats = npt.NDArray[np.float32]
Picture = npt.NDArray[np.uint8]
Context: TypeAlias = tuple[Floats, Floats]
Visual: TypeAlias = Sequence[Floats] | Mapping[int, Floats]
"""Visual tokens by frame."""
Act: TypeAlias = Callable[[Floats, Floats, Floats, Floats, Floats], Floats]
"""Signature of `TorchStages.act`, also for a graph in its place."""


class TaskErrorError(ValueError):
    """Outputs that cannot be compared: not finite, or of a different shape than the reference."""


def prompt_tensors(model: TicVla, prompt: Sequence[Segment]) -> tuple[Tensor, Tensor]:
    """Return ids [1, T] and visual tokens [F, N, D] of a whole prompt, for one call."""
    ids = torch.tensor([[token for segment in prompt for token in segment.ids]])
    frames = [torch.from_numpy(segment.tokens) for segment in prompt if segment.tokens is not None]
    vision = model.config.vision
    visual = torch.cat(frames) if frames else torch.zeros(1, vision.tokens, vision.token_dim)
    return ids, visual


def empty_past(model: TicVla) -> list[Tensor]:
    """Return empty KV caches."""
    c = model.config.language
    return [torch.zeros(1, c.kv_heads, 0, c.head_dim) for _ in range(2 * c.layers)]


class TorchStages:
    """PyTorch model with the runtime's calls; the graphs in `precisions` are rounded."""

    def __init__(
        self,
        model: TicVla,
        precisions: Mapping[str, Precision] | None = None,
        *,
        rounder: Rounder | None = None,
        activations: bool = True,
    ) -> None:
        self.model = model
        self._precisions = dict(precisions or {})
        self._rounder = rounder or Rounder()
        self._activations = activations

    def encode(self, frame: npt.NDArray[np.uint8]) -> Floats:
        """Encode a frame [1, px, px, 3] to visual tokens [1, N, D]."""
        with torch.no_grad(), self._graph("vision_encoder", self.model.vision):
            return _array(self.model.vision(torch.from_numpy(frame)))

    def language(self, prompt: Sequence[Segment], new_tokens: int) -> tuple[Floats, tuple[int, ...]]:
        """Return the last layer's K‖V of every prompt token [1, T, kv_dim] and the first `new_tokens` greedy tokens.

        The prompt is one call; chunks would give the same result.
        """
        ids, visual = prompt_tensors(self.model, prompt)
        language, end = self.model.language, self.model.config.language.im_end_id
        with torch.no_grad(), self._graph("language_model", language):
            if new_tokens == 0:
                return _array(language.hidden_states(ids, visual, empty_past(self.model))[2]), ()
            next_id, _, kv, *past = language(ids, visual, empty_past(self.model))
            found: list[int] = []
            while len(found) < new_tokens and int(next_id[0, -1]) != end:
                found.append(int(next_id[0, -1]))
                if len(found) < new_tokens:
                    next_id, _, _, *past = language(next_id[:, -1:], visual[:1], past)
        return _array(kv), tuple(found)

    def context(self, guidance: Floats) -> tuple[Floats, Floats]:
        """Project K‖V or waypoints to every cross-attention layer's keys and values, [layers, 1, heads, T, d] each."""
        with torch.no_grad(), self._graph("semantic_context", self.model.action):
            keys, values = self.model.action.context(torch.from_numpy(guidance))
        return _array(keys), _array(values)

    def act(self, visual_tokens: Floats, state: Floats, latency: Floats, keys: Floats, values: Floats) -> Floats:
        """Plan a trajectory [1, steps, 3] from visual tokens, state [1, 3], latency [1, 4] and context."""
        tensors = [torch.from_numpy(array) for array in (visual_tokens, state, latency, keys, values)]
        with torch.no_grad(), self._graph("action_expert", self.model.action):
            return _array(self.model.action(*tensors))

    def _graph(self, name: str, part: nn.Module) -> AbstractContextManager[None]:
        precision = self._precisions.get(name)
        if precision is None:
            return nullcontext()
        layers = linear_layers(self.model.config, name)
        return self._rounder.applied(part, precision, layers, activations=self._activations)


def _array(tensor: Tensor) -> Floats:
    return cast(Floats, np.ascontiguousarray(tensor.numpy()))


@dataclass(frozen=True)
class StageOutputs:
    """Outputs of one implementation for a sample set."""

    visual: tuple[Floats, ...]
    """By frame."""
    kv: tuple[Floats, ...]
    """By sample."""
    token_ids: tuple[tuple[int, ...], ...]
    trajectories: tuple[Floats, ...]
    """By sample: [moments, steps, 3]."""
    swapped: tuple[Floats, ...]
    """Trajectories of the same moments with the next sample's semantic context (negative control)."""


def run_stages(
    stages: TorchStages, samples: SampleSet, *, new_tokens: int = 0, progress: Callable[[str], None] = lambda _: None
) -> StageOutputs:
    """Run a whole sample set."""
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

    def plans(waypoints: Sequence[Sample], guidance: Sequence[Floats]) -> tuple[Floats, ...]:
        found = []
        for sample, other, x in zip(samples.samples, waypoints, guidance, strict=True):
            contexts = moment_contexts(stages.context, replace(sample, waypoints=other.waypoints), x)
            found.append(plan(stages.act, sample, visual, contexts))
        return tuple(found)

    own = plans(samples.samples, kv)
    swapped = plans([*samples.samples[1:], samples.samples[0]], kv[1:] + kv[:1])
    return StageOutputs(tuple(visual), tuple(kv), tuple(token_ids), own, swapped)


def prompt_parts(sample: Sample, visual: Visual) -> list[Segment]:
    """Return a sample's prompt with its frames' visual tokens."""
    return [Segment(part.ids, None if part.frame is None else visual[part.frame]) for part in sample.prompt]


def moment_contexts(context: Callable[[Floats], Context], sample: Sample, last_layer_kv: Floats) -> list[Context]:
    """Return the semantic context at every moment: that of K‖V is constant, that of waypoints moves with the robot."""
    if sample.waypoints is None:
        return [context(last_layer_kv)] * len(sample.moments)
    return [context(waypoints_now(sample.waypoints, moment.offset)) for moment in sample.moments]


def plan(act: Act, sample: Sample, visual: Visual, contexts: Sequence[Context]) -> Floats:
    """Plan trajectories [moments, steps, 3] of a sample with the semantic context of every moment."""
    planned = [
        act(
            visual[moment.frame],
            np.array([moment.state], dtype=np.float32),
            np.array([moment.latency], dtype=np.float32),
            *context,
        )
        for moment, context in zip(sample.moments, contexts, strict=True)
    ]
    return np.concatenate(planned)


@dataclass(frozen=True)
class TaskResult:
    """Effect of rounding on the robot at the worst moment over all delays of the semantic state."""

    waypoint_cm: float
    """Mean deviation over the chunk."""
    heading_deg: float
    """At the end of the chunk."""
    speed_mps: float
    turn_radps: float
    relative: float | None
    """Mean deviation as a share of the spread of the model's plans (waypoints or heading, the larger); None if they
    do not vary."""
    by_delay_cm: tuple[tuple[float, float], ...]
    """(Δt in s, worst moment's waypoint deviation in cm) in order of Δt."""
    token_agreement: float | None = None
    """Mean share of the greedy tokens before the first difference; None for a graph without text."""
    kv_cosine: float = 1.0
    """Cosine of the semantic state to the exact one, lowest over the samples."""
    semantic: float | None = None
    """Change of the exact plans by another semantic state, as a share of their spread; None if they do not vary."""

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> TaskResult:
        """Build the result from its `asdict` form, also after JSON."""
        pairs = tuple((float(delay_s), float(cm)) for delay_s, cm in content["by_delay_cm"])
        return cls(**{**content, "by_delay_cm": pairs})


def compare(reference: StageOutputs, found: StageOutputs, samples: SampleSet) -> TaskResult:
    """Compute the task error of a candidate's outputs. Raises TaskErrorError."""
    errors = compare_plans(reference.trajectories, found.trajectories, samples)
    agreement = [_agreement(a, b) for a, b in zip(reference.token_ids, found.token_ids, strict=True) if a]
    delays = np.array([moment.delay_s for sample in samples.samples for moment in sample.moments])
    everything = np.concatenate(reference.trajectories)
    swapped = np.concatenate(reference.swapped)
    spread_cm, spread_deg = spread(everything)
    moved = np.linalg.norm((swapped - everything)[..., :2].astype(np.float64), axis=-1)
    means = {name: short(values.mean()) for name, values in errors.items()}
    relative = short(max(_share(means["waypoint_cm"], spread_cm), _share(means["heading_deg"], spread_deg)))
    return TaskResult(
        **{name: short(values.max()) for name, values in errors.items()},
        relative=relative if math.isfinite(relative) else None,
        by_delay_cm=tuple((float(d), short(errors["waypoint_cm"][delays == d].max())) for d in sorted(set(delays))),
        token_agreement=short(sum(agreement) / len(agreement)) if agreement else None,
        kv_cosine=short(min(map(cosine, reference.kv, found.kv)), digits=7),
        semantic=short(short(100 * moved.mean()) / spread_cm) if spread_cm > 0 else None,
    )


def compare_plans(reference: Sequence[Floats], found: Sequence[Floats], samples: SampleSet) -> dict[str, Floats]:
    """Compute every moment's deviations, named as in `TaskResult`. Raises TaskErrorError."""
    a, b = np.concatenate(list(reference)).astype(np.float64), np.concatenate(list(found)).astype(np.float64)
    if a.shape != b.shape:
        raise TaskErrorError(f"trajectories are {list(b.shape)}, the reference's {list(a.shape)}")
    if not np.isfinite(b).all():
        raise TaskErrorError("a planned trajectory is not finite")
    one_second = min(a.shape[1], max(1, round(TARGET_TIME_S / samples.step_s))) - 1
    distance_cm = 100 * np.linalg.norm(a[..., :2] - b[..., :2], axis=-1)
    turn_deg = np.degrees(np.abs((a[:, -1, 2] - b[:, -1, 2] + math.pi) % (2 * math.pi) - math.pi))
    commands = np.abs(np.array([_command(row[one_second]) for row in a]) - [_command(row[one_second]) for row in b])
    return {
        "waypoint_cm": distance_cm.mean(axis=1),
        "heading_deg": turn_deg,
        "speed_mps": commands[:, 0],
        "turn_radps": commands[:, 1],
    }


def _command(point: npt.NDArray[np.float64]) -> tuple[float, float]:
    return arc_to(SE2(*(float(value) for value in point)), TARGET_TIME_S)


def spread(trajectories: Floats) -> tuple[float, float]:
    """Return RMS distance (cm) and RMS end heading (deg) of trajectories [n, steps, 3] to their mean."""
    centred = trajectories.astype(np.float64) - trajectories.astype(np.float64).mean(axis=0)
    distance_cm = 100 * math.sqrt(float((centred[..., :2] ** 2).sum(axis=-1).mean()))
    return short(distance_cm), short(math.degrees(math.sqrt(float((centred[:, -1, 2] ** 2).mean()))))


def cosine(a: Floats, b: Floats) -> float:
    """Return the cosine of two arrays as vectors; if a norm is zero, 1 for equal arrays, else 0."""
    x, y = a.ravel().astype(np.float64), b.ravel().astype(np.float64)
    # Plain sums: a threaded BLAS adds in an order that depends on the machine.
    norm = math.sqrt(float((x * x).sum()) * float((y * y).sum()))
    return float((x * y).sum()) / norm if norm > 0 else float(np.array_equal(x, y))


def relative_error(reference: Floats, found: Floats) -> float:
    """Return ‖found − reference‖ / ‖reference‖. Raises TaskErrorError if shapes differ or a value is not finite."""
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
    """Round to significant digits: further digits are noise and differ between machines."""
    return float(f"{float(value):.{digits}g}")
