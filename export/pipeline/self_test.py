"""Known answers of an export: what its graphs answer on this machine, and how far a robot's may deviate."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from edge.artifacts.known_answers import CHAIN, LIMITS_S, KnownAnswers
from edge.artifacts.manifest import Artifacts
from edge.artifacts.target_facts import plan_facts
from edge.inference.graph import CPU_PROVIDER
from edge.inference.language import LanguageModel
from edge.inference.policy import Policy
from edge.inference.self_test import SelfTestResult, check_answers, compute_answers
from export.evaluation.gates import gate_provider
from export.quantize.precision import bits

SELF_TEST_STAGE: Final = "self-test"
SEED: Final = 1
EXACT: Final = 2e-4
"""Tolerance of fp32 on the processor: other kernels and thread counts deviated by 1e-6 at most (results page)."""
HALF: Final = 2e-2
"""Of fp16, and of any accelerator: TF32 and fused kernels round to 10 bits."""
ROUNDED: Final = 5e-2
"""Of int8 and int4: an activation at the edge of a step is rounded to the other side. Also where the answers were
computed on another provider than the one that ships."""
CHAIN_FACTOR: Final = 2.0
"""The chain's deviation as a multiple of the graphs'."""
SAME_TOKENS: Final = {EXACT: 0.75, HALF: 0.5, ROUNDED: 0.5}
"""Smallest share of the same next tokens, by the largest tolerance."""
SLOWER: Final = 20.0
"""Time limit as a multiple of the plan's tick and generation: first runs allocate, and the machine may be busy."""
LEAST_LIMIT_S: Final = 30.0


def known_answers(artifacts: Artifacts, manifest: Mapping[str, Any], *, half: bool) -> KnownAnswers:
    """Compute the answers of a directory's graphs; raises SelfTestError or GraphError.

    `half`: whether activations and KV buffers are fp16.
    """
    tolerances = {
        name: max(_tolerance(graph, half=half), ROUNDED if _replaced(artifacts) else 0.0)
        for name, graph in manifest["graphs"].items()
    }
    worst = max(tolerances.values())
    tolerances[CHAIN] = CHAIN_FACTOR * worst
    prompt, answers = compute_answers(*_opened(artifacts), SEED, tolerances)
    plan = plan_facts(manifest)
    planned_s = 0.0 if plan is None else (plan.tick_alone_ms + float(manifest["plan"]["generation_alone_ms"])) / 1e3
    return KnownAnswers(
        seed=SEED,
        limit_s=round(min(max(LEAST_LIMIT_S, SLOWER * planned_s), LIMITS_S[1]), 1),
        prompt=prompt,
        same_tokens=SAME_TOKENS[worst],
        answers=answers,
    )


def repeat_self_test(artifacts: Artifacts) -> SelfTestResult:
    """Run the robot's self-test on this machine; raises SelfTestError."""
    return check_answers(*_opened(artifacts), artifacts.known_answers)


def _opened(artifacts: Artifacts) -> tuple[Policy, LanguageModel]:
    """Open all graphs on the providers that ship, or on the processor where one does not load here."""
    provider = CPU_PROVIDER if _replaced(artifacts) else None
    return Policy(artifacts, provider=provider), LanguageModel(artifacts, provider=provider)


def _replaced(artifacts: Artifacts) -> bool:
    shipping = {graph.session.provider for graph in artifacts.graphs.values()}
    return any(gate_provider(provider) != provider for provider in shipping)


def _tolerance(graph: Mapping[str, Any], *, half: bool) -> float:
    """Tolerance of a graph by the least exact of its precisions."""
    precision = graph["precision"]
    least = min(bits(kind) for kind in (precision["default"], *precision["overrides"].values()))
    if least < 16:
        return ROUNDED
    rounds = least < 32 or half or graph["session"]["provider"] != CPU_PROVIDER
    return HALF if rounds else EXACT
