"""Configuration of stage `evaluate`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class EvaluateConfig:
    """Episodes of the evaluation and the latency of reasoning in them."""

    episodes: int = 60
    scenario_seed: int = 9001
    """Seed of the layouts (`tools.train.scenes.scenarios`); no other stage uses this one."""
    kinds: Mapping[str, float] = field(default_factory=dict)
    """Shares of the kinds of scenes; empty: the default shares (`tools.train.config.scenes`)."""
    latency_s: float = 2.0
    drift: str = "none"
    jobs: int = 0
    """Parallel processes; 0: one per core. Does not change the results."""

    def __post_init__(self) -> None:
        if not (1 <= self.episodes <= 10_000 and 0 <= self.scenario_seed <= 9_999 and 0 <= self.jobs <= 1024):
            raise ValueError("expected 1 to 10000 episodes, a scenario_seed of 0 to 9999 and 0 to 1024 jobs")
        if not 0 <= self.latency_s <= 60 or self.drift not in ("none", "typical", "severe"):
            raise ValueError("expected latency_s from 0 to 60 and drift none, typical or severe")
