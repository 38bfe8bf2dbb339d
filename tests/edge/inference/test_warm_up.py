"""Graphs that are far slower than they were planned for do not drive."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from edge.artifacts.files import ArtifactError
from edge.inference import warm_up

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
