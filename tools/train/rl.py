"""Stage 3: reinforcement learning with asynchronous guidance (paper Algorithm 2, equation 5, Table 9, appendix D).

Where this differs from the paper it says so: rollouts are whole episodes, each in a fresh simulator, instead of 1,024
steps across them, so that a run resumes exactly and has the same result on any number of processes; rewards are scaled
for the value network; and a policy whose success on fixed training scenes drops is taken back to its best.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import torch

from export.model.network import initialise
from export.model.weights import weights_sha256
from sim_hil.benchmark.latency import load_profile
from sim_hil.benchmark.policies import robot_config
from tools.train import checkpoint
from tools.train.action_tail import check_tail
from tools.train.command_policy import LOG_STD_RANGE, CommandLimits
from tools.train.exported import export_artifacts
from tools.train.job import StageJob
from tools.train.network_file import finish_network, read_network, weights_before
from tools.train.point_goal_net import build_point_goal, save_point_goal
from tools.train.ppo import PpoConfig, PpoOptimiser
from tools.train.rl_learners import Learner, PointGoalLearner, TailLearner
from tools.train.rl_worker import RolloutOrder
from tools.train.rollout import Rollout
from tools.train.scenarios import SHARES
from tools.train.vector_env import drive

if TYPE_CHECKING:
    from tools.train.recipe import Recipe

STAGE: Final = "rl"
POLICIES: Final = ("action", "point-goal")
POINT_GOAL_FILE: Final = "point_goal.safetensors"
_SCENES, _EVALUATION_SCENES = 9003, 9002  # seeds of scenarios that no other stage draws
_DELAYS: Final = 41
STEPS_PER_EPISODE: Final = 300
"""As a rule: 30 s. For the plan of a run alone."""


class RlError(ValueError):
    """Nothing to improve, or a checkpoint of another run; one line."""


@dataclass(frozen=True)
class RlConfig:
    """Online reinforcement learning of the last layer and the head."""

    policy: str = "action"
    """What is trained: the action expert's last layer and head, or the paper's `point-goal` baseline from nothing."""
    iterations: int = 50
    episodes: int = 12
    """Whole episodes of one iteration; with some 250 steps each, 3,000 steps (the paper: 1,024)."""
    episodes_per_job: int = 3
    ppo: PpoConfig = field(default_factory=PpoConfig)
    log_std: tuple[float, ...] = (-1.9, -1.5)
    """Of the exploration of v and ω at the start: 0.15 m/s and 0.22 rad/s."""
    reward_scale: float = 0.01
    mean_delay_s: float = 5.0
    """Times of a generation are drawn evenly from 0 to twice this (paper: some 50 environment steps on average)."""
    delay_profile: str = ""
    """A file of `edge-calib latency` to draw from instead."""
    rotation: tuple[str, ...] = ("office", "hospital", "warehouse")
    rotate_every: int = 100
    """Iterations in one kind of scene before the next; 0: all kinds in every iteration."""
    tasks: int = 3
    """Tasks (layouts with a start and a goal) of each kind; 0: another one in every episode."""
    drift: str = "typical"
    max_s: float = 90.0
    warmup_iterations: int = 3
    """In which the value network learns and the policy does not."""
    imitation: float = 0.0
    """Weight of a penalty on leaving the imitated commands; the paper has none."""
    evaluate_every: int = 10
    evaluate_episodes: int = 24
    fall_back: float = 0.08
    """By how much the evaluation's success may drop below the best before that one is taken up again."""
    jobs: int = 0
    """Worker processes; 0: as many as there are cores. Changes nothing in what comes out."""

    def __post_init__(self) -> None:
        counts = (self.iterations, self.episodes, self.episodes_per_job, self.evaluate_every, self.evaluate_episodes)
        if self.policy not in POLICIES:
            raise ValueError(f"policy {self.policy!r}: expected one of {', '.join(POLICIES)}")
        if min(counts) < 1 or min(self.rotate_every, self.tasks, self.warmup_iterations, self.jobs) < 0:
            raise ValueError("expected counts of 1 or more, and rotate_every, tasks, warmup_iterations, jobs from 0 on")
        if len(self.log_std) != 2 or not all(LOG_STD_RANGE[0] <= v <= LOG_STD_RANGE[1] for v in self.log_std):
            raise ValueError(f"log_std: expected two numbers within {LOG_STD_RANGE}, found {self.log_std}")
        if unknown := sorted(set(self.rotation) - set(SHARES)):
            raise ValueError(f"rotation: unknown kind {unknown[0]!r}, expected of {', '.join(SHARES)}")
        if not self.rotation or self.drift not in ("none", "typical", "severe"):
            raise ValueError("expected a rotation of one kind or more, and drift none, typical or severe")
        if not (self.reward_scale > 0 and 0 <= self.mean_delay_s <= 30 and 5 <= self.max_s <= 3600):
            raise ValueError("expected reward_scale above 0, mean_delay_s from 0 to 30 and max_s from 5 to 3600")
        if not (self.imitation >= 0 and 0 <= self.fall_back <= 1):
            raise ValueError("expected imitation from 0 on and fall_back from 0 to 1")

    def kinds(self, iteration: int) -> dict[str, float]:
        """Shares of the kinds of scenes that an iteration drives in."""
        if self.rotate_every == 0:
            return dict.fromkeys(self.rotation, 1.0)
        return {self.rotation[(iteration // self.rotate_every) % len(self.rotation)]: 1.0}

    def numbers(self, iteration: int) -> tuple[int, ...]:
        """Scenarios that an iteration drives in, of their seed."""
        first = iteration * self.episodes
        return tuple(n % self.tasks if self.tasks else n for n in range(first, first + self.episodes))

    def generation_s(self) -> tuple[float, ...]:
        """Reasoning times to draw from, s. Raises LatencyError."""
        if self.delay_profile:
            return load_profile(Path(self.delay_profile)).generation_s
        return tuple(round(float(v), 4) for v in np.linspace(0.0, 2 * self.mean_delay_s, _DELAYS))


def budget(recipe: Recipe) -> list[tuple[str, int, str]]:
    """(what, number of samples, key of the throughput) of a run of this stage."""
    config = recipe.rl
    if config is None:
        return []
    evaluations = 1 + -(-config.iterations // config.evaluate_every)
    episodes = config.iterations * config.episodes + evaluations * config.evaluate_episodes
    return [("steps driven and learned from", episodes * STEPS_PER_EPISODE, "ppo")]


@dataclass(frozen=True)
class Score:
    """Of one evaluation by the mean action."""

    success: float
    collided: float
    spl: float

    @property
    def order(self) -> tuple[float, float]:
        """The higher the better."""
        return (self.success - 0.5 * self.collided, self.spl)


Drive = Callable[..., Rollout]


def run(job: StageJob) -> dict[str, Any]:
    """Improve the newest weights of the run. Raises RlError, ActionTailError, RolloutFailedError, KeyboardInterrupt."""
    if job.ranks.world > 1:
        raise RlError(
            "torchrun: reinforcement learning shares its work among processes itself (rl.jobs); start it alone"
        )
    config = job.recipe.rl or RlConfig()
    before = weights_before(job.run_dir.out, STAGE)
    if before is None:
        raise RlError(f"{job.run_dir.out}: no policy to improve; run imitate first")
    network = read_network(before, job.recipe.model, job.recipe.seed).to(job.device)
    bounds = robot_config().limits
    limits = CommandLimits(bounds.vx_max_mps, bounds.wz_max_radps)
    initialise(network, job.seed, ("value",))
    folder = job.run_dir.stage(STAGE)
    if config.policy == "point-goal":
        net = build_point_goal(job.recipe.model, job.generator("point-goal")).to(job.device)
        result = improve(job, PointGoalLearner(network, net, limits, config.log_std), before, None)
        save_point_goal(net, folder / POINT_GOAL_FILE, f"edge-train {job.recipe.name}, seed {job.recipe.seed}, rl")
        return result
    check_tail(network.action)
    artifacts = export_artifacts(before, job.recipe.model, folder / "artifacts", job.progress.say)
    learner = TailLearner(network, limits, config.log_std, imitation=config.imitation)
    result = improve(job, learner, before, artifacts)
    finish_network(job, STAGE, network)
    return result


def improve(
    job: StageJob, learner: Learner, before: Path, artifacts: Path | None, drive: Drive = drive
) -> dict[str, Any]:
    """Train the learner's policy and value network in place; gives first and best scores. Ends with the best."""
    config = job.recipe.rl or RlConfig()
    state = _State(job, learner, PpoOptimiser(learner, config.ppo))
    orders = _Orders(job, config, before, artifacts)
    state.load()
    if state.iteration == 0:
        state.first = state.best = _evaluate(job, config, orders, state, drive)
        state.keep_best()
        state.save()
    while state.iteration < config.iterations:
        iteration = state.iteration
        order = orders.training(iteration, state.write_policy())
        rollout = drive(order, jobs=config.jobs, per_job=config.episodes_per_job, stopped=job.should_stop)
        numbers = _learn(job, config, learner, state, rollout)
        shutil.rmtree(order.out, ignore_errors=True)
        state.iteration += 1
        if state.iteration % config.evaluate_every == 0 or state.iteration == config.iterations:
            score = _evaluate(job, config, orders, state, drive)
            numbers |= {"eval_success": score.success, "eval_collided": score.collided, "eval_spl": score.spl}
            numbers["fell_back"] = float(state.judge(score, config.fall_back))
        job.run_dir.log(STAGE, state.iteration, **numbers)
        job.progress.update(state.iteration, config.iterations, **numbers)
        state.save()
    state.take_best()
    assert state.first is not None and state.best is not None
    return {
        "iterations": config.iterations,
        "steps": state.steps,
        "before": asdict(state.first),
        "best": asdict(state.best),
        "log_std": [round(float(v), 4) for v in learner.log_std.detach()],
    }


def _learn(job: StageJob, config: RlConfig, learner: Learner, state: _State, rollout: Rollout) -> dict[str, float]:
    ends = rollout.ends
    numbers = {
        "success": float(np.mean([end.success for end in ends])),
        "collided": float(np.mean([end.collided for end in ends])),
        "reward": float(np.mean([end.reward for end in ends])),
        "steps": float(rollout.steps),
    }
    if rollout.steps < config.ppo.batch:
        return numbers  # hardly a semantic state came: nothing to learn from
    state.steps += rollout.steps
    learner.take(rollout)
    ppo = config.ppo
    found = learner.estimates(gamma=ppo.gamma, lam=ppo.gae_lambda, reward_scale=config.reward_scale)
    generator = job.generator("ppo", state.iteration)
    warm = state.iteration >= config.warmup_iterations
    stats = state.optimiser.update(learner, found.advantages, found.returns, generator, policy=warm)
    return {**numbers, **{key: float(value) for key, value in asdict(stats).items()}}


def _evaluate(job: StageJob, config: RlConfig, orders: _Orders, state: _State, drive: Drive) -> Score:
    order = orders.evaluation(state.iteration, state.write_policy())
    ends = drive(order, jobs=config.jobs, per_job=config.episodes_per_job, stopped=job.should_stop).ends
    shutil.rmtree(order.out, ignore_errors=True)
    return Score(
        *(
            round(float(np.mean(values)), 6)
            for values in zip(*((e.success, e.collided, e.spl) for e in ends), strict=True)
        )
    )


@dataclass(frozen=True)
class _Orders:
    """What workers are told."""

    job: StageJob
    config: RlConfig
    before: Path
    artifacts: Path | None

    def training(self, iteration: int, policy: Path) -> RolloutOrder:
        """Exploring, on the iteration's scenarios."""
        seed = int(self.job.rng("rollout", iteration).integers(2**31))
        out = self.job.run_dir.stage(STAGE) / "rollouts" / f"{iteration:05d}"
        return self._order(
            policy, out, _SCENES, self.config.numbers(iteration), self.config.kinds(iteration), seed, explore=True
        )

    def evaluation(self, iteration: int, policy: Path) -> RolloutOrder:
        """The mean action, always on the same scenarios, all kinds of the rotation."""
        out = self.job.run_dir.stage(STAGE) / "rollouts" / f"evaluation-{iteration:05d}"
        numbers = tuple(range(self.config.evaluate_episodes))
        kinds = dict.fromkeys(self.config.rotation, 1.0)
        return self._order(policy, out, _EVALUATION_SCENES, numbers, kinds, self.job.seed, explore=False)

    def _order(
        self, policy: Path, out: Path, scenes: int, numbers: tuple[int, ...], kinds: dict[str, float], seed: int,
        *, explore: bool,
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
            generation_s=self.config.generation_s(),
            explore=explore,
            drift=self.config.drift,
            max_s=self.config.max_s,
            seed=seed,
        )


class _State:
    """The stage's checkpoint: policy, value network, exploration, moments, the best policy so far."""

    def __init__(self, job: StageJob, learner: Learner, optimiser: PpoOptimiser) -> None:
        self._job, self._learner, self.optimiser = job, learner, optimiser
        folder = job.run_dir.stage(STAGE)
        self._path, self._policy = folder / "checkpoint.safetensors", folder / "policy.safetensors"
        content = {
            "rl": asdict(job.recipe.rl or RlConfig()),
            "seed": job.seed,
            "before": weights_sha256(learner.network),
        }
        content["rl"].pop("jobs")
        self._key = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
        self.iteration = 0
        self.steps = 0
        self.first: Score | None = None
        self.best: Score | None = None
        self._best: dict[str, torch.Tensor] = {}

    def write_policy(self) -> Path:
        """What workers drive with now."""
        log_std = [float(v) for v in self._learner.log_std.detach().clamp(*LOG_STD_RANGE)]
        checkpoint.save(self._policy, self._learner.policy_tensors(), {"log_std": log_std})
        return self._policy

    def keep_best(self) -> None:
        """The policy as it is now is the best."""
        self._best = self._learner.policy_tensors()

    def take_best(self) -> None:
        """Go back to the best policy."""
        self._learner.load_policy(self._best)

    def judge(self, score: Score, fall_back: float) -> bool:
        """Keep a better policy; take the best up again when it has fallen too far, which is what is returned."""
        if self.best is None or score.order > self.best.order:
            self.best = score
            self.keep_best()
            return False
        if score.success < self.best.success - fall_back:
            self.take_best()
            return True
        return False

    def save(self) -> None:
        """After every iteration."""
        learner, optimiser = self._learner, self.optimiser
        tensors = {
            **checkpoint.with_prefix("policy", learner.policy_tensors()),
            **checkpoint.with_prefix("best", self._best),
            **checkpoint.with_prefix("value", learner.network.value.state_dict()),
            **checkpoint.with_prefix("actor", checkpoint.optimiser_tensors(optimiser.actor)),
            **checkpoint.with_prefix("critic", checkpoint.optimiser_tensors(optimiser.critic)),
            "log_std": learner.log_std.detach(),
        }
        scores = {name: asdict(score) for name in ("first", "best") if (score := getattr(self, name)) is not None}
        meta = {"key": self._key, "iteration": self.iteration, "steps": self.steps, **scores}
        checkpoint.save(self._path, tensors, meta)

    def load(self) -> None:
        """Go on if asked to and able to. Raises RlError for another run's checkpoint."""
        if not (self._job.resume and self._path.exists()):
            self._job.run_dir.rewind(STAGE, -1)
            shutil.rmtree(self._path.parent / "rollouts", ignore_errors=True)
            return
        tensors, meta = checkpoint.load(self._path)
        if meta["key"] != self._key:
            raise RlError(f"{self._path}: of another policy or another recipe; delete it to begin anew")
        learner, optimiser = self._learner, self.optimiser
        learner.load_policy(checkpoint.under("policy", tensors))
        self._best = checkpoint.under("best", tensors)
        learner.network.value.load_state_dict(checkpoint.under("value", tensors))
        checkpoint.restore_optimiser(optimiser.actor, checkpoint.under("actor", tensors))
        checkpoint.restore_optimiser(optimiser.critic, checkpoint.under("critic", tensors))
        learner.log_std.data.copy_(tensors["log_std"])
        self.iteration, self.steps = int(meta["iteration"]), int(meta["steps"])
        self.first, self.best = _score(meta.get("first")), _score(meta.get("best"))
        self._job.run_dir.rewind(STAGE, self.iteration)


def _score(content: Mapping[str, float] | None) -> Score | None:
    return None if content is None else Score(**content)
