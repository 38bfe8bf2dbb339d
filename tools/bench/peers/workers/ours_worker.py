"""Worker of this project's artifacts with the runner's code: `Policy`, `LanguageModel`, image embeddings."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from edge.artifacts.manifest import Artifacts, load_artifacts
from edge.core.geometry import SE2
from edge.inference.language import LanguageModel
from edge.inference.policy import Policy
from edge.reasoning.prompt import Segment
from edge.state.semantic import SemanticState
from tools.bench.peers.workers.serve import Load, Task, serve, timed_task
from tools.bench.peers.workload import DECODE_STEPS, FRAMES, Workload

HERE = SE2(0.0, 0.0, 0.0)


def prompt(workload: Workload, artifacts: Artifacts) -> list[Segment]:
    """Return the workload's prompt: one segment per frame, then the text."""
    runtime, vision = artifacts.runtime, workload.config.vision
    image = (runtime.img_start_id, *[runtime.img_context_id] * runtime.frame_tokens, runtime.img_end_id)
    frames = np.random.default_rng(3).standard_normal((FRAMES, 1, vision.tokens, vision.token_dim)).astype(np.float32)
    tail = workload.text_ids(workload.prompt_tokens - FRAMES * len(image))
    return [*(Segment(image, frame) for frame in frames), Segment(tuple(tail.tolist()), None)]


def language(workload: Workload, artifacts: Artifacts, threads: int) -> Task:
    """Create the task of one generation of exactly DECODE_STEPS tokens."""
    model = LanguageModel(artifacts, threads=threads)
    segments = prompt(workload, artifacts)

    def run() -> dict[str, float]:
        made = model.generate(segments, max_new_tokens=DECODE_STEPS, cancelled=lambda: False)
        if (made.prompt_tokens, made.new_tokens) != (workload.prompt_tokens, DECODE_STEPS):
            raise ValueError(
                f"generated {made.new_tokens} tokens after {made.prompt_tokens}, "
                f"the benchmark is {DECODE_STEPS} after {workload.prompt_tokens}"
            )
        return {"prefill_ms": made.prefill_ms, "decode_tokens_per_s": 1e3 * made.new_tokens / made.decode_ms}

    return run


def load(request: Load) -> Mapping[str, Task]:
    """Open the requested parts."""
    workload = Workload(request.model)
    artifacts = load_artifacts(Path(request.options["artifacts"]))
    tasks: dict[str, Task] = {}
    if {"encoder", "action"} & set(request.parts):
        policy = Policy(artifacts, threads=request.threads)
        frame, kv = workload.frame(), workload.last_layer_kv()
        semantic = SemanticState(0, 0, HERE, 0, kv, policy.semantic_context(kv), "", None)
        state = (0.4, 0.0, 0.0)
        tokens = policy.encode(frame)
        tasks["encoder"] = timed_task("encoder_ms", lambda: policy.encode(frame))
        tasks["action"] = timed_task("action_ms", lambda: policy.act(tokens, state, 2.0, HERE, semantic))
        tasks["tick"] = timed_task("tick_ms", lambda: policy.act(policy.encode(frame), state, 2.0, HERE, semantic))
    if "language" in request.parts:
        tasks["language"] = language(workload, artifacts, request.threads)
    return tasks


if __name__ == "__main__":
    sys.exit(serve(load, ("onnxruntime",)))
