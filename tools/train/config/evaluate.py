"""The numbers of stage `evaluate`: the episodes, and how slow reasoning is in them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class EvaluateConfig:
    """Which episodes are driven, and how slow reasoning is in them."""

    episodes: int = 60
    scenario_seed: int = 9001
    """Of `tools.train.scenes.scenarios`: layouts that no other stage draws."""
    kinds: Mapping[str, float] = field(default_factory=dict)
    """Shares of the kinds of scenes; empty: those of `tools.train.scenes.scenarios`."""
    latency_s: float = 2.0
    drift: str = "none"
    jobs: int = 0
    """Processes at a time; 0: as many as there are cores. Changes nothing in what comes out."""

    def __post_init__(self) -> None:
        if not (1 <= self.episodes <= 10_000 and 0 <= self.scenario_seed <= 9_999 and 0 <= self.jobs <= 1024):
            raise ValueError("expected 1 to 10000 episodes, a scenario_seed of 0 to 9999 and 0 to 1024 jobs")
        if not 0 <= self.latency_s <= 60 or self.drift not in ("none", "typical", "severe"):
            raise ValueError("expected latency_s from 0 to 60 and drift none, typical or severe")
