"""Opens, proves and warms up every graph before the robot may move, and refuses ticks that are far too slow."""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass
from typing import Final

import numpy as np

from edge.artifacts.files import MANIFEST_NAME, ArtifactError, read_manifest
from edge.artifacts.manifest import Artifacts
from edge.artifacts.runtime import RuntimeConfig
from edge.core.geometry import SE2
from edge.inference.language import LanguageModel
from edge.inference.policy import Policy
from edge.inference.scheduling import Schedule, TickActivity
from edge.inference.self_test import SelfTestResult, check_answers
from edge.inference.start_guard import OPEN_S, StartGuard
from edge.state.ring import EncodedFrame
from edge.state.semantic import STRAIGHT_AHEAD, SemanticState
from edge.state.switches import Speculation

COLD_TICKS: Final = 5
"""Pay for first-time allocation."""
WARM_TICKS: Final = 20


@dataclass(frozen=True)
class WarmUp:
    """Outcome of a warm-up."""

    tick_ms: float
    """Median duration of warm ticks, ms (graphs only)."""
    notes: tuple[str, ...]
    """Lines for the operator."""


@dataclass(frozen=True)
class Opened:
    """The model's graphs, opened within limits and proven by the self-test."""

    policy: Policy
    language: LanguageModel
    tested: SelfTestResult
    guard: StartGuard
    """Limits of the rest of the start."""


def open_proven(
    artifacts: Artifacts,
    *,
    schedule: Schedule | None = None,
    activity: TickActivity | None = None,
    guard: StartGuard | None = None,
    threads: int | None = None,
) -> Opened:
    """Open every graph on the provider that ships and run the self-test; raises ArtifactError.

    `threads`: threads of each graph; None: the manifest's.
    """
    guard = guard or StartGuard(artifacts)
    with guard.stage("opening the graphs", OPEN_S):
        policy = Policy(artifacts, threads=threads, schedule=schedule, activity=activity, interrupt=guard.interrupt)
        language = LanguageModel(artifacts, threads=threads, schedule=schedule, interrupt=guard.interrupt)
    known = artifacts.known_answers
    with guard.stage("self-test", OPEN_S if known is None else known.limit_s):
        return Opened(policy, language, check_answers(policy, language, known), guard)


def warm_up(policy: Policy, language: LanguageModel, speculation: Speculation) -> WarmUp:
    """Run every graph to allocate its memory, and turn speculation on where it is exact. Raises GraphError."""
    here, runtime = SE2(0.0, 0.0, 0.0), language.runtime
    frame = np.zeros((1, runtime.image_px, runtime.image_px, 3), dtype=np.uint8)
    frames = [EncodedFrame(i, here, policy.encode(frame)) for i in range(len(runtime.frame_offsets_s))]
    generation = language.generate(language.prompt.build(frames, "stop"), max_new_tokens=4, cancelled=lambda: False)
    context = policy.semantic_context(generation.last_layer_kv)
    semantic = SemanticState(0, 0, here, 0, generation.last_layer_kv, context, "", STRAIGHT_AHEAD)
    _run_largest_context(policy, runtime, frames[-1])
    took_ms: list[float] = []
    for _ in range(COLD_TICKS + WARM_TICKS):
        started_ns = time.monotonic_ns()
        policy.act(policy.encode(frame), (0.0, 0.0, 0.0), 0.0, here, semantic)
        took_ms.append((time.monotonic_ns() - started_ns) / 1e6)
    note = language.speculate() if speculation is Speculation.ON else None
    return WarmUp(statistics.median(took_ms[COLD_TICKS:]), () if note is None else (note,))


def _run_largest_context(policy: Policy, runtime: RuntimeConfig, frame: EncodedFrame) -> None:
    """Run a tick on the longest semantic state, so that no later one makes ONNX Runtime extend its memory."""
    kv = np.zeros((1, runtime.max_context, runtime.kv_dim), dtype=np.float32)
    here = frame.T_odom_base
    semantic = SemanticState(0, 0, here, 0, kv, policy.semantic_context(kv), "", STRAIGHT_AHEAD)
    policy.act(frame.tokens, (0.0, 0.0, 0.0), 0.0, here, semantic)


def check_tick(artifacts: Artifacts, tick_ms: float) -> None:
    """Refuse graphs that are slower than planned; raises ArtifactError.

    Fault matrix row 25: nodes that an accelerator does not support run on the processor without a message. A target
    whose plan is not enforced (`runtime.enforce_plan`) promises no speed.
    """
    period_ms = artifacts.runtime.tick_period_ms
    if tick_ms <= period_ms:
        return
    try:
        enforced = bool(read_manifest(artifacts.directory)["provenance"]["target"]["runtime"]["enforce_plan"])
    except (KeyError, TypeError) as error:
        raise ArtifactError(f"{MANIFEST_NAME}: the target lacks runtime.enforce_plan; export again") from error
    if enforced:
        raise ArtifactError(
            f"{artifacts.directory}: a tick of its graphs takes {tick_ms:.0f} ms here, expected less than its period "
            f"of {period_ms} ms: part of a graph may run on the processor; edge-doctor lists which"
        )
