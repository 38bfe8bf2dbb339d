"""What this machine takes for a tick and for a generation, measured on the exported graphs."""

from __future__ import annotations

import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np

from edge.geometry import SE2
from edge.language import LanguageModel
from edge.manifest import load_artifacts
from edge.policy import Policy
from edge.ring import EncodedFrame
from edge.semantic import SemanticState

TICKS = 30


def measure_plan(directory: Path) -> dict[str, Any]:
    """Median tick (encoder + action expert, one thread) and one full-length generation on this machine, in ms."""
    artifacts = load_artifacts(directory)
    runtime = artifacts.runtime
    policy, language = Policy(artifacts), LanguageModel(artifacts)
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (1, runtime.image_px, runtime.image_px, 3)).astype(np.uint8)
    here = SE2(0.0, 0.0, 0.0)
    frames = [EncodedFrame(i, here, policy.encode(image)) for i in range(len(runtime.frame_offsets_s))]
    segments = language.prompt.build(frames, "walk down the corridor and stop at the vending machine")
    started_ns = time.monotonic_ns()
    generation = language.generate(segments, max_new_tokens=runtime.max_new_tokens, cancelled=lambda: False)
    context = policy.semantic_context(generation.last_layer_kv)
    generation_ms = (time.monotonic_ns() - started_ns) / 1e6
    semantic = SemanticState(0, 0, here, 0, generation.last_layer_kv, context, generation.text, None)
    ticks_ms: list[float] = []
    for _ in range(TICKS):
        started_ns = time.monotonic_ns()
        policy.act(policy.encode(image), (0.0, 0.0, 0.0), 1.0, here, semantic)
        ticks_ms.append((time.monotonic_ns() - started_ns) / 1e6)
    return {
        "tick_ms": statistics.median(ticks_ms),
        "tick_ms_samples": ticks_ms,
        "generation_ms": generation_ms,
        "generation_tokens": generation.new_tokens,
        "average_w": None,
        "tagged": "measured",
    }
