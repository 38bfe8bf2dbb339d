"""The stage of reinforcement learning with made-up rollouts: logging, evaluation, reset and resume."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from edge.inference.latency_profile import LatencyProfile
from export.model.network import TicVla
from tests.tools.train.rl.test_rl_tail import LIMITS, tiny_config, tiny_episode, tiny_network
from tools.train.config.checks import TrainError
from tools.train.config.recipe import Recipe
from tools.train.config.rl import PpoConfig, RlConfig
from tools.train.rl import rollout
from tools.train.rl.ppo import TailLearner
from tools.train.rl.rl import STAGE, Score, improve, run
from tools.train.rl.worker import RolloutOrder
from tools.train.run.job import StageJob, StopFlag
from tools.train.run.network_file import finish_network
from tools.train.run.run_dir import RunDir

PPO = PpoConfig(batch=4, epochs=2, action_lr=1e-3, value_lr=1e-3)


pytestmark = pytest.mark.usefixtures("one_thread")


def _job(out: Path, config: RlConfig, *, resume: bool = False, stop: StopFlag | None = None) -> StageJob:
    recipe = Recipe("test", 0, tiny_config(), rl=config)
    out.mkdir(parents=True, exist_ok=True)
    return StageJob(recipe, RunDir(out), resume=resume, seed=7, stop=stop or StopFlag())


def _imitated(job: StageJob) -> Path:
    return finish_network(job, "imitate", tiny_network())


FINAL = {"final-start": -1, "final-best": -2}


def _driver(network: TicVla, success: Callable[[int], bool], stop: tuple[StopFlag, int] | None = None) -> Any:
    """Rollouts by the number of the call; evaluations succeed as `success` of their iteration says."""
    calls = 0

    def drive(order: RolloutOrder, **_: Any) -> rollout.Rollout:
        nonlocal calls
        calls += 1
        if stop is not None and calls == stop[1]:
            raise KeyboardInterrupt
        folder = Path(order.out)
        folder.mkdir(parents=True, exist_ok=True)
        iteration = FINAL.get(folder.name) or int(folder.name.split("-")[-1])
        steps, end = tiny_episode(network, 8, order.seed % 97, reward=0.3)
        if not order.explore:
            end = rollout.EpisodeEnd(**{**vars(end), "success": success(iteration)})
        rollout.save(folder / "0.safetensors", [(steps, end)])
        return rollout.read([folder / "0.safetensors"])

    return drive


def _improved(out: Path, config: RlConfig, drive: Any, *, resume: bool = False) -> tuple[TicVla, dict[str, Any]]:
    job = _job(out, config, resume=resume)
    before = _imitated(job)
    network = tiny_network()
    learner = TailLearner(network, LIMITS, config.log_std)
    return network, improve(job, learner, before, out / "artifacts", drive)


@pytest.mark.slow
def test_every_iteration_is_logged_and_evaluations_in_between(tmp_path: Path) -> None:
    config = RlConfig(iterations=4, evaluate_every=2, warmup_iterations=0, ppo=PPO)
    _, result = _improved(tmp_path, config, _driver(tiny_network(), lambda _: True))
    lines = [line for line in RunDir(tmp_path).lines() if line["stage"] == STAGE]
    assert [line["step"] for line in lines] == [1, 2, 3, 4]
    assert ["eval_success" in line for line in lines] == [False, True, False, True]
    assert result["iterations"] == 4 and result["steps"] == 32


@pytest.mark.slow
@pytest.mark.parametrize(("last", "gained"), [(True, 1.0), (False, 0.0)])
def test_the_gain_is_the_last_evaluation_less_the_first_with_an_interval(
    last: bool, gained: float, tmp_path: Path
) -> None:
    config = RlConfig(iterations=4, evaluate_every=2, warmup_iterations=0, ppo=PPO)
    driver = _driver(tiny_network(), lambda k: k == 2 or (last and k == 4))

    def drive(order: RolloutOrder, **options: Any) -> rollout.Rollout:
        driven = driver(order, **options)
        if order.explore:
            return driven
        return replace(driven, ends=[replace(driven.ends[0], id=f"t1-site-{n}-0-go2") for n in range(4)])

    _, result = _improved(tmp_path, config, drive)
    found = result["gained"]
    assert (found["episodes"], found["layouts"], found["success"]) == (4, 1, gained)
    low, high = found["success_ci95"]
    assert low <= gained <= high and (low < gained or high > gained)
    ends = json.loads((tmp_path / "rl" / "rollouts" / "evaluation-00004.json").read_text())
    assert [end["success"] for end in ends] == [last] * 4


@pytest.mark.slow
@pytest.mark.parametrize("ended", [4, 9])  # in between, and before the last call: the best on fresh scenarios
def test_a_run_that_was_ended_goes_on_exactly(ended: int, tmp_path: Path) -> None:
    config = RlConfig(iterations=4, evaluate_every=2, warmup_iterations=1, ppo=PPO, fall_back=1.0)
    whole, result = _improved(tmp_path / "whole", config, _driver(tiny_network(), lambda k: k in (4, -2)))
    with pytest.raises(KeyboardInterrupt):
        _improved(tmp_path / "parts", config, _driver(tiny_network(), lambda k: k in (4, -2), (StopFlag(), ended)))
    parts, again = _improved(tmp_path / "parts", config, _driver(tiny_network(), lambda k: k in (4, -2)), resume=True)
    assert again == result and result["kept"] == "best"
    for name, tensor in whole.state_dict().items():
        assert torch.equal(tensor, parts.state_dict()[name]), name


@pytest.mark.slow
def test_a_policy_that_gets_worse_is_taken_back(tmp_path: Path) -> None:
    config = RlConfig(iterations=2, evaluate_every=2, warmup_iterations=0, ppo=PPO)
    network, result = _improved(tmp_path, config, _driver(tiny_network(), lambda k: k == 0))
    assert result["best"] == result["before"]
    began = tiny_network().state_dict()
    tails = [name for name in began if name.startswith(("action.layers.2.", "action.head.", "action.out."))]
    assert tails and all(torch.equal(network.state_dict()[name], began[name]) for name in tails)
    (last,) = [line for line in RunDir(tmp_path).lines() if line["step"] == 2]
    assert last["fell_back"] == 1.0


def test_success_counts_first_and_collisions_where_it_is_no_less() -> None:
    some = Score(0.5, 0.2, 0.4)
    assert Score(0.6, 0.9, 0.4).ahead_of(some) and not Score(0.4, 0.0, 0.4).ahead_of(some)
    assert Score(0.5, 0.1, 0.4).ahead_of(some) and not Score(0.5, 0.1, 0.4).ahead_of(some, by=0.1)
    assert not some.ahead_of(some)


@pytest.mark.slow
@pytest.mark.parametrize(("fresh", "kept"), [((-2,), "best"), ((-1,), "start"), ((-1, -2), "start"), ((), "start")])
def test_the_best_is_kept_only_if_it_is_ahead_on_fresh_scenarios(
    fresh: tuple[int, ...], kept: str, tmp_path: Path
) -> None:
    config = RlConfig(iterations=2, evaluate_every=2, warmup_iterations=0, ppo=PPO)
    network, result = _improved(tmp_path, config, _driver(tiny_network(), lambda k: k == 2 or k in fresh))
    began, now = tiny_network().state_dict(), network.state_dict()
    same = all(torch.equal(now[name], began[name]) for name in began if name.startswith("action."))
    assert result["kept"] == kept and same == (kept == "start")
    assert set(result["final"]) == {"start", "best"}


@pytest.mark.slow
def test_evaluation_and_final_scenarios_differ_and_spread_over_layouts(tmp_path: Path) -> None:
    orders: list[RolloutOrder] = []
    driver = _driver(tiny_network(), lambda k: k == 2)

    def drive(order: RolloutOrder, **options: Any) -> rollout.Rollout:
        orders.append(order)
        return driver(order, **options)

    config = RlConfig(iterations=2, evaluate_every=2, warmup_iterations=0, ppo=PPO, final_episodes=5)
    _improved(tmp_path, config, drive)
    explored = {order.scenario_seed for order in orders if order.explore}
    evaluated = [order for order in orders if not order.explore]
    by_seed = {order.scenario_seed: len(order.numbers) for order in evaluated}
    assert len(by_seed) == 2 and set(by_seed.values()) == {24, 5} and not explored & set(by_seed)
    assert {order.tasks_per_scene for order in evaluated} == {2}


@pytest.mark.slow
def test_a_checkpoint_of_other_numbers_is_not_gone_on_from(tmp_path: Path) -> None:
    config = RlConfig(iterations=2, evaluate_every=2, warmup_iterations=0, ppo=PPO)
    _improved(tmp_path, config, _driver(tiny_network(), lambda _: True))
    other = RlConfig(iterations=2, evaluate_every=2, warmup_iterations=0, ppo=PPO, reward_scale=0.5)
    job = StageJob(Recipe("test", 0, tiny_config(), rl=other), RunDir(tmp_path), resume=True, seed=7)
    with pytest.raises(TrainError, match="another recipe"):
        improve(
            job,
            TailLearner(tiny_network(), LIMITS, other.log_std),
            tmp_path / "imitate" / "model.safetensors",
            tmp_path,
            _driver(tiny_network(), bool),
        )


@pytest.mark.slow
def test_a_devices_delays_reach_the_workers_with_their_late_frames(tmp_path: Path) -> None:
    profile = LatencyProfile("orin", "measured there", (2.0, 3.0), (0.5, 0.7))
    (tmp_path / "orin.json").write_text(json.dumps(profile.as_json()))
    config = RlConfig(iterations=1, warmup_iterations=0, ppo=PPO, delay_profile=str(tmp_path / "orin.json"))
    received: list[LatencyProfile] = []
    driver = _driver(tiny_network(), lambda _: True)

    def drive(order: RolloutOrder, **options: Any) -> rollout.Rollout:
        received.append(RolloutOrder.of_json(json.loads(json.dumps(order.to_json()))).delays)
        return driver(order, **options)

    _improved(tmp_path / "run", config, drive)
    assert received and set(received) == {profile}


def test_without_a_policy_there_is_nothing_to_improve(tmp_path: Path) -> None:
    with pytest.raises(TrainError, match="run imitate first"):
        run(_job(tmp_path, RlConfig()))


def test_an_untrained_action_expert_is_refused(tmp_path: Path) -> None:
    job = _job(tmp_path, RlConfig())
    finish_network(job, "sft", tiny_network())
    with pytest.raises(TrainError, match=r"sft/model.safetensors: the action expert is untrained"):
        run(job)
