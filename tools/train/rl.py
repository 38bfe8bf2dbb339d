"""Stage 3: reinforcement learning with asynchronous guidance (paper Algorithm 2, equation 5, Table 9, appendix D).

Where this differs from the paper it says so: rollouts are whole episodes, each in a fresh simulator, instead of 1,024
steps across them, so that a run resumes exactly and has the same result on any number of processes; rewards are scaled
for the value network; a policy that does worse on fixed training scenes is taken back to its best; and the best, which
was chosen there by numbers that are partly luck, replaces the policy it began with only if it is ahead on fresh ones.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edge.cli import write_whole
from export.model.network import initialise
from sim_hil.benchmark.bootstrap import paired_ci95
from sim_hil.benchmark.latency import LatencyProfile, load_profile
from sim_hil.benchmark.policies import robot_config
from tools.train.action_tail import check_tail
from tools.train.command_policy import LOG_STD_RANGE, CommandLimits
from tools.train.exported import export_artifacts
from tools.train.job import StageFailedError, StageJob
from tools.train.network_file import START, finish_network, is_trained, read_network, weights_before
from tools.train.point_goal_net import build_point_goal, save_point_goal
from tools.train.ppo import PpoConfig
from tools.train.rl_learners import Learner, PointGoalLearner, TailLearner
from tools.train.rl_state import ROLLOUTS, STAGE, RlError, Score, State
from tools.train.rl_worker import RolloutOrder
from tools.train.rollout import Rollout
from tools.train.scenarios import KEPT_SEEDS, SHARES, TASKS_PER_SCENE
from tools.train.vector_env import drive

if TYPE_CHECKING:
    from tools.train.recipe import Recipe

POLICIES: Final = ("action", "point-goal")
POINT_GOAL_FILE: Final = "point_goal.safetensors"
# Seeds of scenarios that no other stage draws: to learn from, to choose the best by, to say whether it is better.
_EVALUATION_SCENES, _SCENES, _FINAL_SCENES = KEPT_SEEDS[1:]
_EVALUATION_TASKS: Final = 2  # of one layout: more layouts tell more than more tasks in one
_DELAYS: Final = 41
STEPS_PER_EPISODE: Final = 300
"""As a rule: 30 s. For the plan of a run alone."""


@dataclass(frozen=True)
class RlConfig:
    """Online reinforcement learning of the last layer and the head."""

    policy: str = "action"
    """What is trained: the action expert's last layer and head, or the paper's `point-goal` baseline from nothing."""
    iterations: int = 300
    episodes: int = 16
    """Whole episodes of one iteration; with some 250 steps each, 4,000 steps (the paper: 1,024)."""
    episodes_per_job: int = TASKS_PER_SCENE
    """One layout's: a job that begins inside a layout has to draw the tasks before its own too."""
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
    """Tasks of each kind, all of one layout, each time with another crowd; 0: always another one."""
    drift: str = "typical"
    max_s: float = 90.0
    warmup_iterations: int = 3
    """In which the value network learns and the policy does not."""
    imitation: float = 0.0
    """Weight of a penalty on leaving the imitated commands; the paper has none."""
    evaluate_every: int = 10
    evaluate_episodes: int = 24
    keep_margin: float = 0.06
    """By how much more the evaluation's success must be than the best's to replace it: the best of many is luck too."""
    fall_back: float = 0.08
    """By how much success may drop below the best's, or collisions rise at no more success, before that one is taken up
    again."""
    final_episodes: int = 32
    """On fresh scenarios, with the policy it began with and with the best; the best is kept if it is ahead there."""
    jobs: int = 0
    """Worker processes; 0: as many as there are cores. Changes nothing in what comes out."""

    def __post_init__(self) -> None:
        driven = (self.episodes, self.episodes_per_job, self.evaluate_episodes, self.final_episodes)
        counts = (self.iterations, self.evaluate_every, *driven)
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
        if not (self.imitation >= 0 and 0 <= self.fall_back <= 1 and 0 <= self.keep_margin <= 1):
            raise ValueError("expected imitation from 0 on, fall_back and keep_margin from 0 to 1")

    def kinds(self, iteration: int) -> dict[str, float]:
        """Shares of the kinds of scenes that an iteration drives in."""
        if self.rotate_every == 0:
            return dict.fromkeys(self.rotation, 1.0)
        return {self.rotation[(iteration // self.rotate_every) % len(self.rotation)]: 1.0}

    def numbers(self, iteration: int) -> tuple[int, ...]:
        """Scenarios that an iteration drives in, of their seed."""
        first = iteration * self.episodes
        return tuple(n % self.tasks if self.tasks else n for n in range(first, first + self.episodes))

    def delays(self) -> LatencyProfile:
        """Reasoning times to draw from, with how late each captures its newest frame. Raises LatencyError."""
        if self.delay_profile:
            return load_profile(Path(self.delay_profile))
        times = tuple(round(float(v), 4) for v in np.linspace(0.0, 2 * self.mean_delay_s, _DELAYS))
        return LatencyProfile("training", "drawn", times)


def budget(recipe: Recipe) -> list[tuple[str, int, str]]:
    """(what, number of samples, key of the throughput) of a run of this stage."""
    config = recipe.rl
    if config is None:
        return []
    evaluations = 1 + -(-config.iterations // config.evaluate_every)
    episodes = config.iterations * config.episodes + evaluations * config.evaluate_episodes + 2 * config.final_episodes
    return [("steps driven and learned from", episodes * STEPS_PER_EPISODE, "ppo")]


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
    imitated = before.parent.name == "imitate" or (before.parent.name == START and is_trained(before))
    if config.policy == "action" and not imitated:
        raise RlError(f"{before}: its action expert has learned nothing yet; run imitate first")
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
                f"rl: {config.iterations} iterations made nothing that drives better than chance; give it more "
                "(rl.iterations), other steps (rl.ppo.action_lr) or more to explore (rl.log_std), in a new --out"
            )
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
    """Train the learner's policy and value network in place; gives its scores. Ends with the best, or as it began."""
    config = job.recipe.rl or RlConfig()
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
    assert state.first is not None and state.best is not None
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
    """End with the best if it is ahead of the policy it began with on scenarios that have chosen nothing."""
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
    job.progress.say(f"on fresh scenarios: success {before:g} before, {after:g} after; the {kept} is kept")
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
        return numbers  # hardly a semantic state came: nothing to learn from
    state.steps += rollout.steps
    learner.take(rollout)
    ppo = config.ppo
    found = learner.estimates(gamma=ppo.gamma, lam=ppo.gae_lambda, reward_scale=config.reward_scale)
    generator = job.generator("ppo", state.iteration)
    warm = state.iteration >= config.warmup_iterations
    stats = state.optimiser.update(learner, found.advantages, found.returns, generator, policy=warm)
    return {**numbers, **{key: float(value) for key, value in asdict(stats).items()}}


def _driven(job: StageJob, config: RlConfig, order: RolloutOrder, drive: Drive) -> Rollout:
    """An order's episodes, each told as it ends: an iteration takes minutes."""
    ended: list[bool] = []

    def told(success: bool) -> None:
        ended.append(success)
        job.progress.update(len(ended), len(order.numbers), success=sum(ended) / len(ended))

    return drive(order, jobs=config.jobs, per_job=config.episodes_per_job, told=told, stopped=job.should_stop)


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
    """The last policy's evaluation less the first's, episode by episode, with 95 % intervals over their layouts.

    Neither was chosen by it. Empty where a run that was begun by an older version has not told its first one.
    """
    folder = job.run_dir.stage(STAGE) / ROLLOUTS
    files = [folder / f"{_evaluation_name(iteration)}.json" for iteration in (0, config.iterations)]
    if not all(file.is_file() for file in files):
        return {}
    first, last = (json.loads(file.read_text(encoding="utf-8")) for file in files)
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
    """What workers are told."""

    job: StageJob
    config: RlConfig
    before: Path
    artifacts: Path | None

    def training(self, iteration: int, policy: Path) -> RolloutOrder:
        """Exploring, on the iteration's scenarios."""
        seed = int(self.job.rng("rollout", iteration).integers(2**31))
        out = self.job.run_dir.stage(STAGE) / ROLLOUTS / f"{iteration:05d}"
        numbers, kinds = self.config.numbers(iteration), self.config.kinds(iteration)
        return self._order(policy, out, _SCENES, numbers, kinds, seed, TASKS_PER_SCENE, explore=True)

    def evaluation(self, iteration: int, policy: Path) -> RolloutOrder:
        """The mean action, always on the same scenarios, all kinds of the rotation."""
        out = self.job.run_dir.stage(STAGE) / ROLLOUTS / _evaluation_name(iteration)
        return self._mean(policy, out, _EVALUATION_SCENES, self.config.evaluate_episodes)

    def final(self, name: str, policy: Path) -> RolloutOrder:
        """The same on scenarios that no evaluation has."""
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
