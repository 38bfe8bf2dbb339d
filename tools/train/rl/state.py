"""What reinforcement learning remembers between iterations: the policies it has had, their scores, its checkpoint."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import torch

from export.model.weights import weights_sha256
from tools.train.config.rl import LOG_STD_RANGE, RlConfig
from tools.train.rl.learners import Learner
from tools.train.rl.ppo import PpoOptimiser
from tools.train.run import checkpoint
from tools.train.run.job import StageJob

STAGE: Final = "rl"
ROLLOUTS: Final = "rollouts"
_ROUNDING: Final = 1e-9


class RlError(ValueError):
    """Nothing to improve, or a checkpoint of another run; one line."""


@dataclass(frozen=True)
class Score:
    """Of one evaluation by the mean action."""

    success: float
    collided: float
    spl: float

    def ahead_of(self, other: Score, by: float = 0.0) -> bool:
        """Whether it has more success by more than that, or no less success and fewer collisions by more than that."""
        if self.success - other.success > by + _ROUNDING:
            return True
        return self.success >= other.success and other.collided - self.collided > by + _ROUNDING


class State:
    """The stage's checkpoint: policy, value network, exploration, moments, the policy it began with and the best."""

    def __init__(self, job: StageJob, learner: Learner, config: RlConfig) -> None:
        self._job, self._learner, self._config = job, learner, config
        self.optimiser = PpoOptimiser(learner, config.ppo)
        folder = job.run_dir.stage(STAGE)
        self._path, self._policy = folder / "checkpoint.safetensors", folder / "policy.safetensors"
        numbers = asdict(config)
        numbers.pop("jobs")
        content = {
            "rl": numbers,
            "seed": job.seed,
            "before": weights_sha256(learner.network),
        }
        self._key = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
        self.iteration = 0
        self.steps = 0
        self.first: Score | None = None
        self.best: Score | None = None
        self.improved = False
        """Whether the best is another one than the policy it began with."""
        self._kept: dict[str, dict[str, torch.Tensor]] = {}

    def write_policy(self) -> Path:
        """What workers drive with now."""
        log_std = [float(v) for v in self._learner.log_std.detach().clamp(*LOG_STD_RANGE)]
        checkpoint.save(self._policy, self._learner.policy_tensors(), {"log_std": log_std})
        return self._policy

    def begin(self) -> None:
        """The policy as it is now is the start, and the best so far."""
        self._kept = {name: self._learner.policy_tensors() for name in ("start", "best")}

    def take(self, name: str) -> None:
        """Go back to the policy it began with (`start`) or to the `best`."""
        self._learner.load_policy(self._kept[name])

    def judge(self, score: Score) -> bool:
        """Keep a better policy; take the best up again when it has fallen too far, which is what is returned."""
        assert self.best is not None
        if score.success - self.best.success > self._config.keep_margin + _ROUNDING:
            self.best, self.improved = score, True
            self._kept["best"] = self._learner.policy_tensors()
            return False
        if not self.best.ahead_of(score, self._config.fall_back):
            return False
        self.take("best")
        # Moments of the way that led astray would lead there again.
        self.optimiser = PpoOptimiser(self._learner, self._config.ppo)
        return True

    def save(self) -> None:
        """After every iteration."""
        learner, optimiser = self._learner, self.optimiser
        tensors = {
            **checkpoint.with_prefix("policy", learner.policy_tensors()),
            **checkpoint.with_prefix("start", self._kept["start"]),
            **checkpoint.with_prefix("best", self._kept["best"]),
            **checkpoint.with_prefix("value", learner.network.value.state_dict()),
            **checkpoint.with_prefix("actor", checkpoint.optimiser_tensors(optimiser.actor)),
            **checkpoint.with_prefix("critic", checkpoint.optimiser_tensors(optimiser.critic)),
            "log_std": learner.log_std.detach(),
        }
        scores = {name: asdict(score) for name in ("first", "best") if (score := getattr(self, name)) is not None}
        meta = {"key": self._key, "iteration": self.iteration, "steps": self.steps, "improved": self.improved, **scores}
        checkpoint.save(self._path, tensors, meta)

    def load(self) -> None:
        """Go on if asked to and able to. Raises RlError for another run's checkpoint."""
        if not (self._job.resume and self._path.exists()):
            self._job.run_dir.rewind(STAGE, -1)
            shutil.rmtree(self._path.parent / ROLLOUTS, ignore_errors=True)
            return
        tensors, meta = checkpoint.load(self._path)
        if meta["key"] != self._key:
            raise RlError(f"{self._path}: of another policy or another recipe; delete it to begin anew")
        learner, optimiser = self._learner, self.optimiser
        learner.load_policy(checkpoint.under("policy", tensors))
        self._kept = {name: checkpoint.under(name, tensors) for name in ("start", "best")}
        learner.network.value.load_state_dict(checkpoint.under("value", tensors))
        checkpoint.restore_optimiser(optimiser.actor, checkpoint.under("actor", tensors))
        checkpoint.restore_optimiser(optimiser.critic, checkpoint.under("critic", tensors))
        learner.log_std.data.copy_(tensors["log_std"])
        self.iteration, self.steps, self.improved = int(meta["iteration"]), int(meta["steps"]), bool(meta["improved"])
        self.first, self.best = _score(meta.get("first")), _score(meta.get("best"))
        self._job.run_dir.rewind(STAGE, self.iteration)


def _score(content: Mapping[str, float] | None) -> Score | None:
    return None if content is None else Score(**content)
