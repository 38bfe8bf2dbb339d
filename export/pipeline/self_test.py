"""Known answers of an export: what its graphs answer on this machine, and how far a robot's may deviate."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

from edge.artifacts.known_answers import CHAIN, LATER, LIMITS_S, LOGITS, VOCABULARY, KnownAnswers
from edge.artifacts.manifest import LANGUAGE_PAIR, LANGUAGE_WHOLE, Artifacts
from edge.artifacts.target_facts import plan_facts
from edge.core.cli import EXIT_CHECK_FAILED
from edge.inference.graph import CPU_PROVIDER, GraphError, Interrupt
from edge.inference.language import LanguageModel
from edge.inference.policy import Policy
from edge.inference.self_test import SelfTestError, SelfTestResult, check_answers, compute_answers
from edge.inference.start_guard import OPEN_S, StartGuard
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


@dataclass(frozen=True)
class SelfTestLimits:
    """Limits of a robot's self-test, which follow from the plan and from the precisions of the graphs."""

    limit_s: float
    same_tokens: float
    tolerances: Mapping[str, float]
    """By graph, CHAIN and those of LATER."""


def self_test_limits(manifest: Mapping[str, Any], *, half: bool, replaced: bool) -> SelfTestLimits:
    """Return the limits that a manifest's `graphs` and `plan` give.

    `half`: whether activations and KV buffers are fp16. `replaced`: whether the answers were computed on another
    provider than the one that ships.
    """
    tolerances = {
        name: max(_tolerance(graph, half=half), ROUNDED if replaced else 0.0)
        for name, graph in manifest["graphs"].items()
    }
    worst = max(tolerances.values())
    language = [name for name in (*LANGUAGE_WHOLE, *LANGUAGE_PAIR) if name in tolerances]
    later = {VOCABULARY: tolerances[language[0]], LOGITS: tolerances[language[-1]]} if language else {}
    plan = plan_facts(manifest)
    planned_s = 0.0 if plan is None else (plan.tick_alone_ms + float(manifest["plan"]["generation_alone_ms"])) / 1e3
    return SelfTestLimits(
        limit_s=round(min(max(LEAST_LIMIT_S, SLOWER * planned_s), LIMITS_S[1]), 1),
        same_tokens=SAME_TOKENS[worst],
        tolerances={**tolerances, **later, CHAIN: CHAIN_FACTOR * worst},
    )


def known_answers(artifacts: Artifacts, manifest: Mapping[str, Any], *, half: bool) -> KnownAnswers:
    """Compute the answers of a directory's graphs; raises SelfTestError or GraphError.

    `half`: whether activations and KV buffers are fp16.
    """
    limits = self_test_limits(manifest, half=half, replaced=_replaced(artifacts))
    prompt, answers = compute_answers(*_opened(artifacts), SEED, limits.tolerances)
    return KnownAnswers(
        seed=SEED, limit_s=limits.limit_s, prompt=prompt, same_tokens=limits.same_tokens, answers=answers
    )


def recorded_and_expected_limits(
    recorded: Mapping[str, Any], manifest: Mapping[str, Any], *, half: bool
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the limits in `recorded`, a manifest's `self_test`, and those that an export of `manifest` writes."""
    answers = recorded["answers"]
    found = SelfTestLimits(
        recorded["limit_s"], recorded["same_tokens"], {name: answer["tolerance"] for name, answer in answers.items()}
    )
    accelerated = any(graph["session"]["provider"] != CPU_PROVIDER for graph in manifest["graphs"].values())
    # The exporting computer may have lacked the accelerator's provider, which this one has.
    both = [self_test_limits(manifest, half=half, replaced=replaced) for replaced in (False, True)]
    missing = LATER - answers.keys()
    both = [
        replace(limits, tolerances={name: each for name, each in limits.tolerances.items() if name not in missing})
        for limits in both
    ]
    expected = both[1] if accelerated and found == both[1] else both[0]
    return asdict(found), asdict(expected)


def repeat_self_test(artifacts: Artifacts) -> SelfTestResult:
    """Run the robot's self-test on this machine, with a start's limits of time and memory.

    Raises ArtifactError; ends the process where a graph hangs in native code.
    """
    guard, known = StartGuard(artifacts, end=end_process), artifacts.known_answers
    try:
        with guard.stage("opening the graphs", OPEN_S):
            opened = _opened(artifacts, guard.interrupt)
        with guard.stage("self-test", OPEN_S if known is None else known.limit_s):
            return check_answers(*opened, known)
    except GraphError as error:
        raise SelfTestError(f"{artifacts.directory}: the graphs do not run ({error}); export again") from error


def end_process(line: str) -> None:
    """Print one line and end the process with the exit code of a failed check: native code ends in no other way."""
    os.write(2, f"edge-export: {line}\n".encode(errors="replace"))
    os._exit(EXIT_CHECK_FAILED)


def _opened(artifacts: Artifacts, interrupt: Interrupt | None = None) -> tuple[Policy, LanguageModel]:
    """Open all graphs on the providers that ship, or on the processor where one does not load here."""
    provider = CPU_PROVIDER if _replaced(artifacts) else None
    policy = Policy(artifacts, provider=provider, interrupt=interrupt)
    return policy, LanguageModel(artifacts, provider=provider, interrupt=interrupt)


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
