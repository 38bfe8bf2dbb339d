"""Measures the task error when one graph, or one group of its layers, is rounded; all else stays in fp32.

The plans of the fp32 model and the inputs of every encoder block and language layer are computed once, so rounding
layer N costs only the layers from N on.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from edge.artifacts.manifest import MOST_ROWS
from edge.reasoning.prompt import Segment
from export.evaluation.parity import sample_inputs
from export.evaluation.task_error import (
    TorchStages,
    compare_plans,
    empty_past,
    moment_contexts,
    plan,
    prompt_parts,
    prompt_tensors,
    relative_error,
    short,
    spread,
)
from export.evaluation.task_samples import SampleSet, is_large
from export.graphs.build import linear_layers
from export.model.network import TicVla
from export.model.vision import fold_tokens
from export.quantize.precision import Precision
from export.quantize.rounding import Rounder

Floats = npt.NDArray[np.float32]

TOKENS_COMPARED = 16
"""Positions at the prompt's end whose most likely next token is compared: text, as in an answer."""

DECODE_INPUTS = 8
"""Number of calls as in the gate for a decoding graph: the gate judges its tensors without an exact prompt."""


@dataclass(frozen=True)
class Reading:
    """Task error of one rounding over the search's moments; `top1` is None for a graph without tokens."""

    waypoint_cm: float
    """Mean deviation over the chunk at the worst moment, cm."""
    heading_deg: float
    """Heading error at the end of the chunk at the worst moment, deg."""
    speed_mps: float
    turn_radps: float
    relative: float
    """Mean deviation as a share of the spread of the fp32 plans (waypoints or heading, the larger)."""
    output_error: float
    """‖output − fp32 output‖ / ‖fp32 output‖ of the graph itself."""
    top1: float | None


class Reference:
    """Outputs of the fp32 model for the samples, shared by all probes."""

    def __init__(self, model: TicVla, samples: SampleSet, progress: Callable[[str], None]) -> None:
        self.model = model
        self.samples = samples
        self.stages = TorchStages(model)
        progress(f"sensitivity: fp32 encoder, {len(samples.frames)} frames")
        self.visual = [self.stages.encode(frame) for frame in samples.frames]
        progress(f"sensitivity: fp32 language model, {len(samples.samples)} prompts")
        self.kv = [self.stages.language(self.prompt(i), 0)[0] for i in range(len(samples.samples))]
        self.contexts, self.plans = [], []
        for sample, kv in zip(samples.samples, self.kv, strict=True):
            self.contexts.append(moment_contexts(self.stages.context, sample, kv))
            self.plans.append(plan(self.stages.act, sample, self.visual, self.contexts[-1]))
        self.spread_cm, self.spread_deg = spread(np.concatenate(self.plans))

    def prompt(self, index: int) -> list[Segment]:
        """Return a sample's prompt with its visual tokens."""
        return prompt_parts(self.samples.samples[index], self.visual)

    def reading(self, plans: Sequence[Floats], output_error: float, top1: float | None = None) -> Reading:
        """Compare the plans of the first samples, or of all, with those of the fp32 model."""
        errors = compare_plans(self.plans[: len(plans)], plans, self.samples)
        waypoint, heading = errors["waypoint_cm"], errors["heading_deg"]
        shares = [
            float(values.mean()) / of if of > 0 else 0.0 if values.max() == 0 else float("inf")
            for values, of in ((waypoint, self.spread_cm), (heading, self.spread_deg))
        ]
        return Reading(
            waypoint_cm=short(float(waypoint.max())),
            heading_deg=short(float(heading.max())),
            speed_mps=short(float(errors["speed_mps"].max())),
            turn_radps=short(float(errors["turn_radps"].max())),
            relative=short(max(shares)),
            output_error=short(output_error),
            top1=None if top1 is None else short(top1),
        )


class Probe(ABC):
    """Rounds one graph of the model and reads the task error."""

    def __init__(self, reference: Reference, graph: str, rounder: Rounder, *, activations: bool) -> None:
        self.reference = reference
        self.graph = graph
        self.layers = linear_layers(reference.model.config, graph)
        self._rounder = rounder
        self._activations = activations

    @property
    def groups(self) -> tuple[str, ...]:
        """Return patterns of layers that are rounded together: a block, a decoder layer, a projection."""
        return tuple(dict.fromkeys(group_of(layer) for layer in self.layers))

    @abstractmethod
    def whole(self, precision: Precision) -> Reading:
        """Read the task error of the whole graph in a precision."""

    def group(self, group: str, precision: str) -> Reading:
        """Read the task error with one group of layers in a precision."""
        return self.whole(Precision("fp32", ((group, precision),)))

    def _rounded(self, part: nn.Module, precision: Precision) -> AbstractContextManager[None]:
        return self._rounder.applied(part, precision, self.layers, activations=self._activations)


class VisionProbe(Probe):
    """Probe of the encoder: its tokens feed the action expert at once and the language model later."""

    def __init__(self, reference: Reference, graph: str, rounder: Rounder, *, activations: bool) -> None:
        super().__init__(reference, graph, rounder, activations=activations)
        newest = [sample.moments[0].frame for sample in reference.samples.samples]
        # A block of a large encoder takes 0.2 s per frame: one frame is enough to rank the blocks.
        self._scan_frames = sorted(set(newest))[: 1 if is_large(reference.model.config) else None]
        self._inputs: dict[int, list[Tensor]] = {}

    def whole(self, precision: Precision) -> Reading:
        """See `Probe`."""
        r = self.reference
        stages = TorchStages(
            r.model, {"vision_encoder": precision}, rounder=self._rounder, activations=self._activations
        )
        visual = [stages.encode(frame) for frame in r.samples.frames]
        plans = []
        for sample in r.samples.samples:
            kv = r.stages.language(prompt_parts(sample, visual), 0)[0]
            plans.append(plan(r.stages.act, sample, visual, moment_contexts(r.stages.context, sample, kv)))
        return r.reading(plans, max(map(relative_error, r.visual, visual)))

    def group(self, group: str, precision: str) -> Reading:
        """See `Probe`; only the action expert's frames at the anchors are rounded."""
        r, vision = self.reference, self.reference.model.vision
        visual = list(r.visual)
        index = group.split(".")[1] if group.startswith("blocks.") else None
        for frame in self._scan_frames:
            if frame not in self._inputs:  # before anything is rounded
                self._inputs[frame] = self._inputs_of(frame)
            with torch.no_grad(), self._rounded(vision, Precision("fp32", ((group, precision),))):
                if group.startswith("embed"):
                    tokens = vision(torch.from_numpy(r.samples.frames[frame]))
                else:
                    tokens = self._from_block(frame, len(vision.blocks) if index is None else int(index))
            visual[frame] = tokens.numpy()
        # Use the same picture for every age of the state: so each delay is tested with few frames.
        plans: list[Floats] = []
        exact: list[Floats] = []
        for i, (sample, context) in enumerate(zip(r.samples.samples, r.contexts, strict=True)):
            frame = self._scan_frames[i % len(self._scan_frames)]
            for tokens_of, into in ((visual, plans), (r.visual, exact)):
                into.append(plan(r.stages.act, sample, dict.fromkeys(range(len(visual)), tokens_of[frame]), context))
        errors = [relative_error(r.visual[frame], visual[frame]) for frame in self._scan_frames]
        # `reading` compares with the plans of the true frames; shifting by the difference keeps that reference.
        moved = [base + found - expected for base, found, expected in zip(r.plans, plans, exact, strict=True)]
        return r.reading(moved, max(errors))

    def _inputs_of(self, frame: int) -> list[Tensor]:
        """Return the input of every block, and the output of the last one."""
        vision, inputs = self.reference.model.vision, list[Tensor]()
        hooks = [b.register_forward_pre_hook(lambda _m, x: inputs.append(x[0])) for b in vision.blocks]
        hooks.append(vision.blocks[-1].register_forward_hook(lambda _m, _x, y: inputs.append(y)))
        try:
            with torch.no_grad():
                vision(torch.from_numpy(self.reference.samples.frames[frame]))
        finally:
            for hook in hooks:
                hook.remove()
        return inputs

    def _from_block(self, frame: int, start: int) -> Tensor:
        vision = self.reference.model.vision
        x = self._inputs[frame][start]
        for block in vision.blocks[start:]:
            x = block(x)
        tokens: Tensor = vision.projector(fold_tokens(x[:, 1:], vision.config.pixel_shuffle))
        return tokens


class LanguageProbe(Probe):
    """Probe of the language model; for `language_model.decode` only the text at the prompt's end is rounded.

    That text replaces an answer's tokens, which decoding would feed one by one onto an exact cache. The output error
    also covers the gate's calls, in which all tokens are rounded.
    """

    def __init__(self, reference: Reference, graph: str, rounder: Rounder, *, activations: bool) -> None:
        super().__init__(reference, graph, rounder, activations=activations)
        self._tokens = "lm_head" in self.layers
        self._calls = self._gate_calls() if graph == "language_model.decode" else []
        self._runs = [self._prepare(index) for index in range(len(reference.samples.samples))]

    def _prepare(self, index: int) -> dict[str, Any]:
        """Run a prompt exactly; returns layer inputs, the layers' shared tensors, exact K‖V and chosen tokens."""
        r, language = self.reference, self.reference.model.language
        prompt = r.prompt(index)
        past, head = empty_past(r.model), None
        with torch.no_grad():
            if self.graph == "language_model.decode":
                *first, last = prompt
                _, past, kv = language.hidden_states(*prompt_tensors(r.model, first), past)
                head, prompt = kv.numpy(), [last]
            ids, visual = prompt_tensors(r.model, prompt)
            inputs: list[tuple[Any, ...]] = []
            hooks = [layer.register_forward_pre_hook(lambda _m, x: inputs.append(x)) for layer in language.layers]
            try:
                hidden, _, _ = language.hidden_states(ids, visual, past)
            finally:
                for hook in hooks:
                    hook.remove()
        run = {"ids": ids, "visual": visual, "past": past, "head": head, "inputs": inputs, "hidden": hidden}
        if self._tokens:
            run["tokens"] = self._choices(hidden, "fp32")
        return run

    def _choices(self, hidden: Tensor, precision: str) -> Tensor:
        weight = self.reference.model.language.lm_head.weight
        assert isinstance(weight, nn.Parameter)
        return self._rounder.choices(weight, hidden[0, -TOKENS_COMPARED:], precision)

    def whole(self, precision: Precision) -> Reading:
        """See `Probe`."""
        language = self.reference.model.language
        found: list[tuple[Tensor | None, Tensor]] = []
        for run in self._runs:
            with torch.no_grad(), self._rounded(language, precision):
                hidden, _, kv = language.hidden_states(run["ids"], run["visual"], run["past"])
            found.append((kv, hidden))
        return self._reading(found, precision.of("lm_head"), self._calls_error(precision))

    def group(self, group: str, precision: str) -> Reading:
        """See `Probe`."""
        if group != "lm_head" and not group.startswith("layers."):
            return super().group(group, precision)
        calls_error = self._calls_error(Precision("fp32", ((group, precision),)))
        if group == "lm_head":
            return self._reading([(None, run["hidden"]) for run in self._runs], precision, calls_error)
        language, start = self.reference.model.language, int(group.split(".")[1])
        found: list[tuple[Tensor | None, Tensor]] = []
        # One prompt is enough to rank the layers of a large model; the final choice is read on all prompts.
        for run in self._runs[: 1 if is_large(self.reference.model.config) else None]:
            x, cos, sin, mask, *_ = run["inputs"][start]
            with torch.no_grad(), self._rounded(language, Precision("fp32", ((group, precision),))):
                for i in range(start, len(language.layers)):
                    x, keys, values = language.layers[i](x, cos, sin, mask, *run["past"][2 * i : 2 * i + 2])
                new = run["ids"].shape[1]
                parts = [t[:, :, -new:].transpose(1, 2).reshape(1, new, -1) for t in (keys, values)]
                found.append((torch.cat(parts, dim=-1), language.norm(x)))
        return self._reading(found, "fp32", calls_error)

    def _gate_calls(self) -> list[tuple[Tensor, list[Tensor], Floats, Floats]]:
        """Return ids, caches, and the exact model's logits and K‖V for them."""
        calls = []
        for index in range(DECODE_INPUTS):
            feeds = sample_inputs(self.reference.model.config, self.graph, index)
            ids = torch.from_numpy(feeds["input_ids"])
            past = int(feeds["total_sequence_length"]) - ids.shape[1]
            caches = [torch.from_numpy(feeds[name][:, :, :past]) for name in feeds if name.startswith("past_")]
            calls.append((ids, caches, *self._call(ids, caches, Precision("fp32"))))
        return calls

    def _call(self, ids: Tensor, caches: list[Tensor], precision: Precision) -> tuple[Floats, Floats]:
        language, vision = self.reference.model.language, self.reference.model.config.vision
        weight = language.lm_head.weight
        assert isinstance(weight, nn.Parameter)
        with torch.no_grad(), self._rounded(language, precision):
            hidden, _, kv = language.hidden_states(ids, torch.zeros(1, vision.tokens, vision.token_dim), caches)
            logits = self._rounder.logits(weight, hidden[0, -MOST_ROWS:], precision.of("lm_head"))
        return logits.numpy(), kv.numpy()

    def _calls_error(self, precision: Precision) -> float:
        """Return the largest relative error of those calls' logits and K‖V."""
        errors = [0.0]
        for ids, caches, *exact in self._calls:
            found = self._call(ids, caches, precision)
            errors += [relative_error(a, b) for a, b in zip(exact, found, strict=True)]
        return max(errors)

    def _reading(
        self, found: list[tuple[Tensor | None, Tensor]], head_precision: str, calls_error: float = 0.0
    ) -> Reading:
        r = self.reference
        plans, errors, same = [], [], []
        for index, (run, (kv, hidden)) in enumerate(zip(self._runs, found, strict=False)):
            whole = r.kv[index] if kv is None else kv.numpy()
            if kv is not None and run["head"] is not None:
                whole = np.concatenate([run["head"], whole], axis=1)
            errors.append(relative_error(r.kv[index], whole))
            sample = r.samples.samples[index]
            plans.append(plan(r.stages.act, sample, r.visual, moment_contexts(r.stages.context, sample, whole)))
            if self._tokens:
                same.append(float((self._choices(hidden, head_precision) == run["tokens"]).float().mean()))
        return r.reading(plans, max(calls_error, *errors), sum(same) / len(same) if same else None)


class ActionProbe(Probe):
    """Probe of `semantic_context` or `action_expert`, which are cheap enough to run whole every time."""

    def whole(self, precision: Precision) -> Reading:
        """See `Probe`."""
        r = self.reference
        stages = TorchStages(r.model, {self.graph: precision}, rounder=self._rounder, activations=self._activations)
        plans, errors = [], []
        for sample, kv, exact in zip(r.samples.samples, r.kv, r.contexts, strict=True):
            context = exact
            if self.graph == "semantic_context":
                context = moment_contexts(stages.context, sample, kv)
                errors += [max(map(relative_error, e, c)) for e, c in zip(exact, context, strict=True)]
            plans.append(plan(stages.act, sample, r.visual, context))
        return r.reading(plans, max(errors or map(relative_error, r.plans, plans)))


def probe(reference: Reference, graph: str, rounder: Rounder, *, activations: bool) -> Probe:
    """Create the probe of a graph by name. Raises ValueError for an unknown graph."""
    if graph == "vision_encoder":
        return VisionProbe(reference, graph, rounder, activations=activations)
    if graph.split(".")[0] == "language_model":
        return LanguageProbe(reference, graph, rounder, activations=activations)
    return ActionProbe(reference, graph, rounder, activations=activations)


def group_of(layer: str) -> str:
    """Return a layer's group: `layers.3.down` → `layers.3.*`, `projector.1` → `projector.*`, `lm_head` → `lm_head`."""
    parts = layer.split(".")
    if parts[0] == "flow":
        return ".".join([*parts[:3], "*"])  # a coupling is one group
    return layer if len(parts) == 1 else ".".join([*parts[:-1], "*"])
