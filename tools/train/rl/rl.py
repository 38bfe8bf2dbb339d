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
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from edge.core.cli import write_whole
from export.model.network import initialise
from sim_hil.benchmark.policies.select import robot_config
from sim_hil.benchmark.results.bootstrap import paired_ci95
from tools.train.config.recipe import Recipe
from tools.train.config.rl import RlConfig
from tools.train.config.scenes import TASKS_PER_SCENE
from tools.train.imitate.point_goal_net import build_point_goal, save_point_goal
from tools.train.rl.action_tail import check_tail
from tools.train.rl.command_policy import CommandLimits
from tools.train.rl.learners import Learner, PointGoalLearner, TailLearner
from tools.train.rl.rollout import Rollout
from tools.train.rl.state import ROLLOUTS, STAGE, RlError, Score, State
from tools.train.rl.vector_env import drive
from tools.train.rl.worker import RolloutOrder
from tools.train.run.exported import export_artifacts
from tools.train.run.job import StageFailedError, StageJob
from tools.train.run.network_file import START, finish_network, is_trained, read_network, weights_before
from tools.train.scenes.scenarios import KEPT_SEEDS

POINT_GOAL_FILE: Final = "point_goal.safetensors"
# Seeds of scenarios that no other stage draws: to learn from, to choose the best by, to say whether it is better.
_EVALUATION_SCENES, _SCENES, _FINAL_SCENES = KEPT_SEEDS[1:]
_EVALUATION_TASKS: Final = 2  # of one layout: more layouts tell more than more tasks in one
STEPS_PER_EPISODE: Final = 300
"""As a rule: 30 s. For the plan of a run alone."""


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
