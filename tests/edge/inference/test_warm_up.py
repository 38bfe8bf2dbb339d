"""Graphs that are far slower than they were planned for do not drive."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from edge.artifacts.files import ArtifactError
from edge.inference import warm_up


@dataclass
class Target:
    """A manifest's target."""

    enforce_plan: object

    def manifest(self, _directory: Path) -> dict[str, Any]:
        return {"provenance": {"target": {"runtime": {"enforce_plan": self.enforce_plan}}}}


ARTIFACTS: Any = SimpleNamespace(directory=Path("out/orin"), runtime=SimpleNamespace(tick_period_ms=100))


def test_a_tick_beyond_its_period_is_refused_with_what_was_expected_and_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warm_up, "read_manifest", Target(True).manifest)
    with pytest.raises(ArtifactError, match=r"takes 250 ms here, expected less than its period of 100 ms.*edge-doctor"):
        warm_up.check_tick(ARTIFACTS, 250.0)


def test_a_tick_within_its_period_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warm_up, "read_manifest", Target(True).manifest)
    warm_up.check_tick(ARTIFACTS, 99.0)


def test_a_target_that_promises_no_speed_may_be_slow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warm_up, "read_manifest", Target(False).manifest)
    warm_up.check_tick(ARTIFACTS, 250.0)
