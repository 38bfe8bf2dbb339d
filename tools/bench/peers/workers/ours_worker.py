"""Worker of this project's artifacts with the runner's code: `Policy`, `LanguageModel`, image embeddings."""

from __future__ import annotations

import itertools
import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np

from edge.artifacts.manifest import Artifacts, load_artifacts
from edge.core.geometry import SE2
from edge.inference.language import LanguageModel
from edge.inference.policy import Policy
from edge.reasoning.prompt import Segment
from edge.state.semantic import SemanticState
from tools.bench.peers.forced_text import ForcedText, context_of
from tools.bench.peers.workers.serve import Load, Task, generation, serve, timed_task
from tools.bench.peers.workload import DECODE_STEPS, FRAMES, Workload

HERE = SE2(0.0, 0.0, 0.0)
ANSWERS: Final = Path(__file__).parents[1] / "answers.json"
"""Texts of one drive, one in 3 s, with the rules that they were decoded with."""


def prompt(workload: Workload, artifacts: Artifacts) -> list[Segment]:
    """Return the workload's prompt: one segment per frame, then the text."""
    runtime, vision = artifacts.runtime, workload.config.vision
    image = (runtime.img_start_id, *[runtime.img_context_id] * runtime.frame_tokens, runtime.img_end_id)
    frames = np.random.default_rng(3).standard_normal((FRAMES, 1, vision.tokens, vision.token_dim)).astype(np.float32)
    tail = workload.text_ids(workload.prompt_tokens - FRAMES * len(image))
    return [*(Segment(image, frame) for frame in frames), Segment(tuple(tail.tolist()), None)]


def language(workload: Workload, artifacts: Artifacts, threads: int) -> Task:
    """Create the task of two generations: DECODE_STEPS tokens one by one, and as the runner does, with guesses.

    The second writes the next of the recorded texts, each to its end. Raises ValueError where the device excludes
    guesses.
    """
    model = LanguageModel(artifacts, threads=threads)
    segments = prompt(workload, artifacts)
    if (line := model.speculate()) is not None:
        raise ValueError(line)
    speculator = model.speculator
    answers = itertools.cycle(json.loads(ANSWERS.read_text(encoding="utf-8"))["answers"])

    def guessed() -> dict[str, float]:
        model.speculator = speculator
        answer = next(answers)
        tokens = model.encode(answer["text"])
        rules = ForcedText(tokens, artifacts.runtime.im_end_id, model.encode, context_of(answer["rules"]))
        started_ns = time.monotonic_ns()
        made = model.generate(segments, max_new_tokens=len(tokens) + 1, cancelled=lambda: False, constraint=rules)
        generation_ms = (time.monotonic_ns() - started_ns) / 1e6
        if made.token_ids != tuple(tokens):
            raise ValueError(f"generated {made.text!r}, expected {answer['text']!r}")
        return {"generation_ms": generation_ms, "tokens": len(tokens), "calls": len(made.call_tokens)}

    def run() -> dict[str, float]:
        model.speculator = None
        made = model.generate(segments, max_new_tokens=DECODE_STEPS, cancelled=lambda: False)
        if (made.prompt_tokens, made.new_tokens) != (workload.prompt_tokens, DECODE_STEPS):
            raise ValueError(
                f"generated {made.new_tokens} tokens after {made.prompt_tokens}, "
                f"the benchmark is {DECODE_STEPS} after {workload.prompt_tokens}"
            )
        plain = generation(made.prefill_ms, made.decode_ms, made.new_tokens)
        return {**plain, "plain_generation_ms": plain["generation_ms"], **guessed()}

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
