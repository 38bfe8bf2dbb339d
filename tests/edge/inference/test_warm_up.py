"""Graphs that are far slower than planned do not drive, and after the warm-up they need no more memory."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import load_artifacts
from edge.core.geometry import SE2
from edge.inference import warm_up
from edge.state.semantic import STRAIGHT_AHEAD, SemanticState
from edge.state.switches import Speculation
from tools.memory.gauge import heap_bytes

ARTIFACTS: Any = SimpleNamespace(directory=Path("out/orin"), runtime=SimpleNamespace(tick_period_ms=100))


@pytest.mark.parametrize(
    ("enforced", "tick_ms", "refused"), [(True, 250.0, True), (True, 99.0, False), (False, 250.0, False)]
)
def test_a_tick_beyond_its_period_is_refused_where_the_target_promises_a_speed(
    monkeypatch: pytest.MonkeyPatch, enforced: bool, tick_ms: float, refused: bool
) -> None:
    manifest = {"provenance": {"target": {"runtime": {"enforce_plan": enforced}}}}
    monkeypatch.setattr(warm_up, "read_manifest", lambda _directory: manifest)
    message = r"takes 250 ms here, expected less than its period of 100 ms.*edge-doctor"
    with pytest.raises(ArtifactError, match=message) if refused else nullcontext():
        warm_up.check_tick(ARTIFACTS, tick_ms)


def run_contexts(opened: warm_up.Opened, lengths: Sequence[int]) -> None:
    """Run a tick on semantic states of these lengths, tokens."""
    runtime, here = opened.language.runtime, SE2(0.0, 0.0, 0.0)
    tokens = np.zeros(opened.policy.tokens_shape, dtype=np.float32)
    for length in lengths:
        kv = np.zeros((1, length, runtime.kv_dim), dtype=np.float32)
        semantic = SemanticState(0, 0, here, 0, kv, opened.policy.semantic_context(kv), "", STRAIGHT_AHEAD)
        opened.policy.act(tokens, (0.0, 0.0, 0.0), 0.0, here, semantic)


@pytest.mark.slow
def test_after_the_warm_up_no_length_of_the_semantic_state_takes_more_memory(artifacts_dir: Path) -> None:
    opened = warm_up.open_proven(load_artifacts(artifacts_dir))
    warm_up.warm_up(opened.policy, opened.language, Speculation.OFF)
    most = opened.language.runtime.max_context
    run_contexts(opened, [100])
    before, _ = heap_bytes()
    run_contexts(opened, [*range(101, most, 16), most])
    run_contexts(opened, [100])
    # A plan of memory for each length took 1.4 KiB, and one extension of an arena 8 MiB.
    assert heap_bytes()[0] - before < 24 * 1024
