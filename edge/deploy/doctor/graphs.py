"""Checks of the graphs on this machine: the provider that runs each node, and the measured duration of a tick."""

from __future__ import annotations

import functools
import json
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import onnxruntime as ort

from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import Artifacts, GraphContract
from edge.artifacts.target_facts import PlanFacts
from edge.core.cli import EXIT_CHECK_FAILED
from edge.core.geometry import SE2
from edge.deploy.doctor.check import Check, Level, skipped
from edge.inference.graph import CPU_PROVIDER, Array, CancelledError, Interrupt, session_settings, zeros
from edge.inference.policy import Policy
from edge.inference.start_guard import WARM_UP_S, StartGuard, end_process
from edge.inference.warm_up import Opened, open_proven
from edge.state.semantic import STRAIGHT_AHEAD, SemanticState

SHAPE_OPERATORS: Final = frozenset(
    {
        "Cast", "Concat", "ConstantOfShape", "Div", "Expand", "Gather", "Identity", "Mul", "Range", "ReduceSum",
        "Reshape", "Shape", "Size", "Slice", "Squeeze", "Sub", "Unsqueeze",
    }
)  # fmt: skip
"""Operators that ONNX Runtime itself runs on the processor when they only compute shapes."""
SHAPE_BYTES: Final = 1024
"""Largest output of such a node, bytes: shapes are a few numbers."""
COPIES: Final = ("MemcpyFromHost", "MemcpyToHost")
SLOWER: Final = 1.25
"""Multiple of the plan's upper bound from which a measured median tick contradicts the plan."""
LEAST_TICKS: Final = 5


@dataclass(frozen=True)
class Placement:
    """Nodes of one operator that ran on one provider."""

    provider: str
    operator: str
    nodes: int
    largest_output_bytes: int
    duration_us: int


def placements(events: Iterable[Any]) -> list[Placement]:
    """Read each node's provider from an ONNX Runtime profile; raises ValueError for another kind of file."""
    found: dict[tuple[str, str], list[tuple[str, int, int]]] = {}
    for event in events:
        if not isinstance(event, dict) or event.get("cat") != "Node":
            continue
        args, name = event.get("args"), str(event.get("name", ""))
        if not isinstance(args, dict) or not name.endswith("_kernel_time"):
            continue
        if "provider" not in args:
            raise ValueError(f"node {name} names no provider")
        key = (str(args["provider"]), str(args.get("op_name")))
        found.setdefault(key, []).append((name, int(args.get("output_size") or 0), int(event.get("dur") or 0)))
    if not found:
        raise ValueError("the profile names no node")
    return [
        Placement(
            provider, operator, len({n for n, _, _ in runs}), max(size for _, size, _ in runs), sum(d for *_, d in runs)
        )
        for (provider, operator), runs in sorted(found.items())
    ]


def judge_placement(graph: str, wanted: str, placed: Sequence[Placement]) -> Check:
    """Check that no node fell back to the processor, except nodes that only compute shapes."""
    name = f"provider of {graph}"
    by_provider: dict[str, int] = {}
    for place in placed:
        by_provider[place.provider] = by_provider.get(place.provider, 0) + place.nodes
    found = ", ".join(f"{nodes} nodes on {provider}" for provider, nodes in sorted(by_provider.items()))
    wrong = [place for place in placed if place.provider != wanted and not _harmless(place)]
    if not wrong:
        return Check(name, Level.OK, found, f"all on {wanted}")
    worst = max(wrong, key=lambda place: place.duration_us)
    found += f"; {worst.nodes} {worst.operator} on {worst.provider} take {worst.duration_us / 1e3:.2f} ms"
    advice = f"export again with a form that {wanted} takes, or build its engine (edge-install engines)"
    return Check(name, Level.FAIL, found, f"all on {wanted}", advice)


def _harmless(place: Placement) -> bool:
    small = place.operator in SHAPE_OPERATORS and place.largest_output_bytes <= SHAPE_BYTES
    return place.provider == CPU_PROVIDER and (small or place.operator in COPIES)


def guarded(artifacts: Artifacts) -> StartGuard:
    """Return limits whose last resort ends the command as a failed check does."""
    return StartGuard(artifacts, end=functools.partial(end_process, code=EXIT_CHECK_FAILED))


def profile_graph(artifacts: Artifacts, name: str, guard: StartGuard) -> Check:
    """Open a graph as the runner does, run it once under ONNX Runtime's profiler and check its nodes' providers.

    `guard` limits time and memory: a graph that passes the self-test may loop on other inputs.
    """
    contract = artifacts.graphs[name]
    wanted = contract.session.provider
    with tempfile.TemporaryDirectory(prefix="edge-doctor-") as folder:
        options, providers = session_settings(artifacts, name)
        options.enable_profiling = True
        options.profile_file_prefix = str(Path(folder) / "profile")
        try:
            with guard.stage(f"profile of {name}", WARM_UP_S):
                session = ort.InferenceSession(artifacts.contents[contract.file], options, providers=providers)
                _run_once(session, example_feeds(artifacts, contract), guard.interrupt)
            events = json.loads(Path(session.end_profiling()).read_text(encoding="utf-8"))
            return judge_placement(name, wanted, placements(events))
        except Exception as error:  # noqa: BLE001 - ONNX Runtime raises any error of its providers; that is the finding
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            advice = "verify the artifacts (edge-export verify), then the provider's packages"
            return Check(f"provider of {name}", Level.FAIL, f"does not run: {reason}", wanted, advice)


def _run_once(session: ort.InferenceSession, feeds: dict[str, Array], interrupt: Interrupt) -> None:
    try:
        session.run(None, feeds, interrupt.options)
    except Exception as error:  # ONNX Runtime raises any error of its providers
        if interrupt.is_set:
            raise CancelledError("ended by its limit") from error
        raise


def example_feeds(artifacts: Artifacts, contract: GraphContract) -> dict[str, Array]:
    """Return zeros for every input of a graph, in the shapes of a short prompt's first call."""
    axes = {"S": 1, "F": 1, "T": artifacts.runtime.frame_tokens, "C": artifacts.runtime.max_context}
    feeds = {tensor.name: zeros(tensor, **axes) for tensor in contract.inputs}
    if "total_sequence_length" in feeds:
        feeds["total_sequence_length"] = np.array(1, dtype=np.int32)
    return feeds


def self_test(artifacts: Artifacts) -> tuple[Check, Opened | None]:
    """Run the runner's self-test; return its check and the opened graphs, None after a failure."""
    name, known = "self-test", artifacts.known_answers
    expected = "the exporter's answers" if known is None else f"the exporter's answers within {known.limit_s:g} s"
    try:
        opened = open_proven(artifacts, guard=guarded(artifacts))
    except ArtifactError as error:
        problem, _, advice = str(error).rpartition("; ")
        return Check(name, Level.FAIL, problem or advice, expected, advice), None
    return Check(name, Level.OK, str(opened.tested), expected), opened


def measure_ticks(policy: Policy, count: int, budget_s: float, prompt_tokens: int) -> list[float]:
    """Measure ticks on a black frame (encode and act), ms; fewer than `count` when the time budget is used up.

    Raises GraphError.
    """
    runtime = policy.artifacts.runtime
    here = SE2(0.0, 0.0, 0.0)
    frame = np.zeros((1, runtime.image_px, runtime.image_px, 3), dtype=np.uint8)
    kv = np.zeros((1, prompt_tokens, runtime.kv_dim), dtype=np.float32)
    semantic = SemanticState(0, 0, here, 0, kv, policy.semantic_context(kv), "", STRAIGHT_AHEAD)
    times: list[float] = []
    deadline_ns = time.monotonic_ns() + round(budget_s * 1e9)
    for number in range(count + 2):
        started_ns = time.monotonic_ns()
        policy.act(policy.encode(frame), (0.0, 0.0, 0.0), 0.0, here, semantic)
        if number >= 2:  # the first calls allocate
            times.append((time.monotonic_ns() - started_ns) / 1e6)
        if len(times) >= LEAST_TICKS and time.monotonic_ns() > deadline_ns:
            break
    return times


def judge_ticks(times_ms: Sequence[float], plan: PlanFacts | None, period_ms: int) -> Check:
    """Check measured ticks against the period and the plan."""
    name = "tick"
    if not times_ms:
        return skipped(name, "no tick was run")
    p50, p99, most = (float(np.percentile(times_ms, q)) for q in (50, 99, 100))
    found = f"p50 {p50:.1f}, p99 {p99:.1f}, max {most:.1f} ms of {len(times_ms)} ticks, alone, measured"
    expected = f"period {period_ms} ms"
    if plan is not None:
        expected += f", plan {plan.tick_alone_ms:.1f} ms alone, {plan.tick_ms:.1f} beside reasoning, {plan.tagged}"
    if p99 > period_ms:
        advice = "this machine cannot keep the rate: check power mode and clocks, or export with a faster precision"
        return Check(name, Level.FAIL, found, expected, advice)
    if plan is not None and p50 > SLOWER * plan.tick_alone_ms * (1 + plan.tick_error):
        advice = "slower than planned: check power mode, clocks and busy programs; edge-calib latency measures again"
        return Check(name, Level.WARN, found, expected, advice)
    return Check(name, Level.OK, found, expected)
