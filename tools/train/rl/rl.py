"""Stage 3: reinforcement learning with asynchronous guidance (paper Algorithm 2, equation 5, Table 9, appendix D).

Differences from the paper:
- Rollouts are whole episodes, each in a new simulator, instead of 1,024 steps across episodes. A run therefore resumes
  exactly and has the same result with any number of processes.
- Rewards are scaled for the value network.
- A policy that becomes worse on fixed evaluation scenarios is reset to the best one.
- The best policy was selected on noisy scores, so it replaces the first policy only if it is ahead on other scenarios.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from edge.core.cli import write_whole
from export.model.network import initialise
from export.model.weights import weights_sha256
from firmware_bridge.system.input_file import read_json
from sim_hil.benchmark.policies.select import robot_config
from sim_hil.benchmark.results.bootstrap import paired_ci95
from tools.train.config.checks import TrainError
from tools.train.config.collect import TASKS_PER_SCENE
from tools.train.config.rl import LOG_STD_RANGE, RlConfig
from tools.train.drives.scenarios import KEPT_SEEDS
from tools.train.imitate.trainable_policies import build_point_goal, save_point_goal
from tools.train.rl.policies import CommandLimits, check_tail
from tools.train.rl.ppo import Learner, PointGoalLearner, PpoOptimiser, TailLearner
from tools.train.rl.rollout import Rollout
from tools.train.rl.worker import RolloutOrder, drive
from tools.train.run.job import StageFailedError, StageJob
from tools.train.run.loop import (
    load_checkpoint,
    optimiser_tensors,
    restore_optimiser,
    save_checkpoint,
    under,
    with_prefix,
)
from tools.train.run.network_file import (
    START,
    export_artifacts,
    finish_network,
    is_trained,
    read_network,
    weights_before,
)

POINT_GOAL_FILE: Final = "point_goal.safetensors"
# Seeds of scenarios that no other stage uses, for evaluation (selects the best), training and the final comparison.
_EVALUATION_SCENES, _SCENES, _FINAL_SCENES = KEPT_SEEDS[1:]
_EVALUATION_TASKS: Final = 2  # per layout: more layouts are more informative than more tasks in one
STAGE: Final = "rl"
ROLLOUTS: Final = "rollouts"
_ROUNDING: Final = 1e-9


Drive = Callable[..., Rollout]


@dataclass(frozen=True)
class Score:
    """Shares of an evaluation that drives the mean action: success, episodes with a collision, SPL."""

    success: float
    collided: float
    spl: float

    def ahead_of(self, other: Score, by: float = 0.0) -> bool:
        """Return whether success is higher by more than `by`, or equal or higher with collisions lower by more."""
        if self.success - other.success > by + _ROUNDING:
            return True
        return self.success >= other.success and other.collided - self.collided > by + _ROUNDING


class State:
    """State between iterations and its checkpoint: policy, value network, optimisers, first and best policy."""

    def __init__(self, job: StageJob, learner: Learner, config: RlConfig) -> None:
        self._job, self._learner, self._config = job, learner, config
        self.optimiser = PpoOptimiser(learner, config.ppo)
        folder = job.run_dir.stage(STAGE)
        self._path, self._policy = folder / "checkpoint.safetensors", folder / "policy.safetensors"
        numbers = asdict(config)
        numbers.pop("jobs")
        content = {"rl": numbers, "seed": job.seed, "before": weights_sha256(learner.network)}
        self._key = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
        self.iteration = 0
        self.steps = 0
        self.first = self.best = Score(0.0, 0.0, 0.0)  # until the first evaluation
        self.improved = False
        """Whether the best policy differs from the first one."""
        self._kept: dict[str, dict[str, torch.Tensor]] = {}

    def write_policy(self) -> Path:
        """Write the current policy for the workers and return its path."""
        log_std = [float(v) for v in self._learner.log_std.detach().clamp(*LOG_STD_RANGE)]
        save_checkpoint(self._policy, self._learner.policy_tensors(), {"log_std": log_std})
        return self._policy

    def begin(self) -> None:
        """Keep the current policy as the start and as the best so far."""
        self._kept = {name: self._learner.policy_tensors() for name in ("start", "best")}

    def take(self, name: str) -> None:
        """Load the policy `start` (the first one) or `best`."""
        self._learner.load_policy(self._kept[name])

    def judge(self, score: Score) -> bool:
        """Keep a better policy as the best, or reset a much worse one to the best; return whether it was reset."""
        if score.success - self.best.success > self._config.keep_margin + _ROUNDING:
            self.best, self.improved = score, True
            self._kept["best"] = self._learner.policy_tensors()
            return False
        if not self.best.ahead_of(score, self._config.fall_back):
            return False
        self.take("best")
        # The optimiser's moments point towards the policy that became worse.
        self.optimiser = PpoOptimiser(self._learner, self._config.ppo)
        return True

    def save(self) -> None:
        """Write the checkpoint of the finished iteration."""
        learner, optimiser = self._learner, self.optimiser
        tensors = {
            **with_prefix("policy", learner.policy_tensors()),
            **with_prefix("start", self._kept["start"]),
            **with_prefix("best", self._kept["best"]),
            **with_prefix("value", learner.network.value.state_dict()),
            **with_prefix("actor", optimiser_tensors(optimiser.actor)),
            **with_prefix("critic", optimiser_tensors(optimiser.critic)),
            "log_std": learner.log_std.detach(),
        }
        meta = {"key": self._key, "iteration": self.iteration, "steps": self.steps, "improved": self.improved}
        meta |= {"first": asdict(self.first), "best": asdict(self.best)}
        save_checkpoint(self._path, tensors, meta)

    def load(self) -> None:
        """Resume from the checkpoint if requested and present. Raises TrainError for another run's checkpoint."""
        if not (self._job.resume and self._path.exists()):
            self._job.run_dir.rewind(STAGE, -1)
            shutil.rmtree(self._path.parent / ROLLOUTS, ignore_errors=True)
            return
        tensors, meta = load_checkpoint(self._path)
        if meta["key"] != self._key:
            raise TrainError(f"{self._path}: checkpoint of another policy or another recipe; delete it to start again")
        learner, optimiser = self._learner, self.optimiser
        learner.load_policy(under("policy", tensors))
        self._kept = {name: under(name, tensors) for name in ("start", "best")}
        learner.network.value.load_state_dict(under("value", tensors))
        restore_optimiser(optimiser.actor, under("actor", tensors))
        restore_optimiser(optimiser.critic, under("critic", tensors))
        learner.log_std.data.copy_(tensors["log_std"])
        self.iteration, self.steps, self.improved = int(meta["iteration"]), int(meta["steps"]), bool(meta["improved"])
        self.first, self.best = Score(**meta["first"]), Score(**meta["best"])
        self._job.run_dir.rewind(STAGE, self.iteration)


def run(job: StageJob) -> dict[str, Any]:
    """Improve the newest weights of the run. Raises TrainError, StageFailedError, KeyboardInterrupt."""
    if job.ranks.world > 1:
        raise TrainError(
            "torchrun: reinforcement learning starts its own processes (rl.jobs); run edge-train rl without torchrun"
        )
    config = job.recipe.rl
    before = weights_before(job.run_dir.out, STAGE)
    if before is None:
        raise TrainError(f"{job.run_dir.out}: no policy to improve; run imitate first")
    imitated = before.parent.name == "imitate" or (before.parent.name == START and is_trained(before))
    if config.policy == "action" and not imitated:
        raise TrainError(f"{before}: the action expert is untrained; run imitate first")
    network = read_network(before, job.recipe.model, job.recipe.seed)
    initialise(network, job.seed, ("value",))
    network.to(job.device)
    bounds = robot_config().limits
    limits = CommandLimits(bounds.vx_max_mps, bounds.wz_max_radps)
    folder = job.run_dir.stage(STAGE)
    if config.policy == "point-goal":
        net = build_point_goal(job.recipe.model, job.generator("point-goal")).to(job.device)
        result = improve(job, PointGoalLearner(network, net, limits, config.log_std), before, None)
        if result["kept"] == "start":
            raise StageFailedError(
                f"rl: no policy is better than the untrained one after {config.iterations} iterations; try more "
                "(rl.iterations), another rate (rl.ppo.action_lr) or exploration (rl.log_std), in a new --out"
            )
        save_point_goal(net, folder / POINT_GOAL_FILE, f"edge-train {job.recipe.name}, seed {job.recipe.seed}, rl")
        return result
    check_tail(network.action)
    artifacts = export_artifacts(before, job.recipe.model, folder / "artifacts", job.progress.log)
    learner = TailLearner(network, limits, config.log_std, imitation=config.imitation)
    result = improve(job, learner, before, artifacts)
    finish_network(job, STAGE, network)
    return result


def improve(
    job: StageJob, learner: Learner, before: Path, artifacts: Path | None, drive: Drive = drive
) -> dict[str, Any]:
    """Train the learner's policy and value network in place and return the stage's result.

    The policy ends as the best one, or as the first one if the best is not ahead on the final scenarios.
    """
    config = job.recipe.rl
    state = State(job, learner, config)
    orders = _Orders(job, config, before, artifacts)
    state.load()
    if state.iteration == 0:
        state.first = state.best = _evaluate(job, config, orders.evaluation(0, state.write_policy()), drive)
        state.begin()
        state.save()
    while state.iteration < config.iterations:
        iteration = state.iteration
        order = orders.training(iteration, state.write_policy())
        rollout = _driven(job, config, order, drive)
        numbers = _learn(job, config, learner, state, rollout)
        shutil.rmtree(order.out, ignore_errors=True)
        state.iteration += 1
        if state.iteration % config.evaluate_every == 0 or state.iteration == config.iterations:
            score = _evaluate(job, config, orders.evaluation(state.iteration, state.write_policy()), drive)
            numbers |= {"eval_success": score.success, "eval_collided": score.collided, "eval_spl": score.spl}
            numbers["fell_back"] = float(state.judge(score))
        job.run_dir.log(STAGE, state.iteration, **numbers)
        job.progress.update(state.iteration, config.iterations, **numbers)
        state.save()
    final = _choose(job, config, orders, state, drive)
    return {
        "iterations": config.iterations,
        "steps": state.steps,
        "before": asdict(state.first),
        "best": asdict(state.best),
        "gained": _gained(job, config),
        **final,
        "log_std": [round(float(v), 4) for v in learner.log_std.detach()],
    }


def _choose(job: StageJob, config: RlConfig, orders: _Orders, state: State, drive: Drive) -> dict[str, Any]:
    """Load the best policy if it is ahead of the first one on scenarios that selected nothing, else the first."""
    if not state.improved:
        state.take("start")
        return {"kept": "start", "final": {}}
    scores: dict[str, Score] = {}
    for name in ("start", "best"):
        state.take(name)
        scores[name] = _evaluate(job, config, orders.final(name, state.write_policy()), drive)
    kept = "best" if scores["best"].ahead_of(scores["start"]) else "start"
    state.take(kept)
    before, after = scores["start"].success, scores["best"].success
    job.progress.log(f"final scenarios: success {before:g} before, {after:g} after; kept policy: {kept}")
    return {"kept": kept, "final": {name: asdict(score) for name, score in scores.items()}}


def _learn(job: StageJob, config: RlConfig, learner: Learner, state: State, rollout: Rollout) -> dict[str, float]:
    ends = rollout.ends
    numbers = {
        "success": float(np.mean([end.success for end in ends])),
        "collided": float(np.mean([end.collided for end in ends])),
        "reward": float(np.mean([end.reward for end in ends])),
        "steps": float(rollout.steps),
    }
    if rollout.steps < config.ppo.batch:
        return numbers  # almost no semantic state arrived: too few steps for a minibatch
    state.steps += rollout.steps
    learner.take(rollout)
    ppo = config.ppo
    advantages, returns = learner.estimates(gamma=ppo.gamma, lam=ppo.gae_lambda, reward_scale=config.reward_scale)
    generator = job.generator("ppo", state.iteration)
    warm = state.iteration >= config.warmup_iterations
    stats = state.optimiser.update(learner, advantages, returns, generator, policy=warm)
    return {**numbers, **{key: float(value) for key, value in asdict(stats).items()}}


def _driven(job: StageJob, config: RlConfig, order: RolloutOrder, drive: Drive) -> Rollout:
    """Drive the episodes of an order and show progress after each: an iteration takes minutes."""
    ended: list[bool] = []

    def finished(success: bool) -> None:
        ended.append(success)
        job.progress.update(len(ended), len(order.numbers), success=sum(ended) / len(ended))

    return drive(order, jobs=config.jobs, per_job=config.episodes_per_job, finished=finished, stopped=job.should_stop)


def _evaluate(job: StageJob, config: RlConfig, order: RolloutOrder, drive: Drive) -> Score:
    ends = _driven(job, config, order, drive).ends
    write_whole(Path(order.out).with_suffix(".json"), json.dumps([asdict(end) for end in ends], indent=1) + "\n")
    shutil.rmtree(order.out, ignore_errors=True)
    return Score(
        *(
            round(float(np.mean(values)), 6)
            for values in zip(*((e.success, e.collided, e.spl) for e in ends), strict=True)
        )
    )


def _gained(job: StageJob, config: RlConfig) -> dict[str, Any]:
    """Compare the last policy's evaluation with the first's per episode: differences and 95 % intervals over layouts.

    Neither policy was selected by these scores. Empty if an older version started the run without the first file.
    """
    folder = job.run_dir.stage(STAGE) / ROLLOUTS
    files = [folder / f"{_evaluation_name(iteration)}.json" for iteration in (0, config.iterations)]
    if not all(file.is_file() for file in files):
        return {}
    first, last = (read_json(file) for file in files)
    layouts = [str(end["id"]).rsplit("-", 3)[0] for end in first]  # without task, people and robot
    found: dict[str, Any] = {"episodes": len(first), "layouts": len(set(layouts))}
    for name in ("success", "collided", "spl"):
        was, now = ([float(end[name]) for end in ends] for ends in (first, last))
        interval = paired_ci95(was, now, layouts, (0.0, 1.0))
        found[name] = round(float(np.mean(now) - np.mean(was)), 6)
        found[f"{name}_ci95"] = None if interval is None else [round(bound, 6) for bound in interval]
    return found


def _evaluation_name(iteration: int) -> str:
    return f"evaluation-{iteration:05d}"


@dataclass(frozen=True)
class _Orders:
    """Makes the workers' orders of one run."""

    job: StageJob
    config: RlConfig
    before: Path
    artifacts: Path | None

    def training(self, iteration: int, policy: Path) -> RolloutOrder:
        """Make the order of an iteration's exploring episodes."""
        seed = int(self.job.rng("rollout", iteration).integers(2**31))
        out = self.job.run_dir.stage(STAGE) / ROLLOUTS / f"{iteration:05d}"
        numbers, kinds = self.config.numbers(iteration), self.config.kinds(iteration)
        return self._order(policy, out, _SCENES, numbers, kinds, seed, TASKS_PER_SCENE, explore=True)

    def evaluation(self, iteration: int, policy: Path) -> RolloutOrder:
        """Make the order of an evaluation: the mean action, always on the same scenarios, all kinds of the rotation."""
        out = self.job.run_dir.stage(STAGE) / ROLLOUTS / _evaluation_name(iteration)
        return self._mean(policy, out, _EVALUATION_SCENES, self.config.evaluate_episodes)

    def final(self, name: str, policy: Path) -> RolloutOrder:
        """Make the order of a final comparison: the mean action on scenarios that no evaluation uses."""
        out = self.job.run_dir.stage(STAGE) / ROLLOUTS / f"final-{name}"
        return self._mean(policy, out, _FINAL_SCENES, self.config.final_episodes)

    def _mean(self, policy: Path, out: Path, scenes: int, count: int) -> RolloutOrder:
        numbers, kinds = tuple(range(count)), dict.fromkeys(self.config.rotation, 1.0)
        return self._order(policy, out, scenes, numbers, kinds, self.job.seed, _EVALUATION_TASKS, explore=False)

    def _order(
        self, policy: Path, out: Path, scenes: int, numbers: tuple[int, ...], kinds: dict[str, float], seed: int,
        tasks_per_scene: int, *, explore: bool,
    ) -> RolloutOrder:  # fmt: skip
        return RolloutOrder(
            artifacts="" if self.artifacts is None else str(self.artifacts.absolute()),
            network=str(self.before.absolute()),
            model=self.job.recipe.model.to_dict(),
            network_seed=self.job.recipe.seed,
            policy=str(policy.absolute()),
            out=str(out.absolute()),
            scenario_seed=scenes,
            numbers=numbers,
            kinds=kinds,
            delays=self.config.delays(),
            explore=explore,
            drift=self.config.drift,
            max_s=self.config.max_s,
            seed=seed,
            tasks_per_scene=tasks_per_scene,
        )
