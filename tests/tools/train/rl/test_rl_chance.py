"""Random numbers of a rollout depend on seed and position; delays and speed limits are the runner's."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from edge.core.geometry import SE2
from edge.inference.latency_profile import LatencyProfile
from edge.motion.controller import Controller, ControllerConfig, ControllerInputs
from edge.safety.monitors.semantic import SemanticConfig
from edge.state.semantic import SemanticState
from sim_hil.benchmark.policies.select import robot_config
from sim_hil.scene.scene import load_scene
from tests.support.benchmark.benchmark_episodes import corridor_episode
from tools.train.drives.scenarios import FIRST_SEED
from tools.train.rl import worker as rl_worker
from tools.train.rl.policies import START_NS, TailPolicy
from tools.train.rl.rollout import PolicyOutput
from tools.train.rl.worker import (
    CONTROL_S,
    CommandLimiter,
    DriveOptions,
    RolloutOrder,
    delays,
    drive_episode,
    scenarios,
    split,
)

TIMES = LatencyProfile("some", "drawn", (1.0, 2.0, 3.0))
ORDER = RolloutOrder("", "", {}, 0, "", "out", 9003, (0, 1, 0, 1, 0), {}, TIMES, True, "none", 10.0, 7)
SOME = replace(ORDER, numbers=(3, 4, 5, 4))


class _Task:
    """As much of a scenario as its worker looks at; made from its number."""

    def __init__(self, number: int) -> None:
        self.episode = corridor_episode(id=f"task-{number}", seed=FIRST_SEED + number)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """(start, count) of what is drawn."""
    asked: list[tuple[int, int]] = []

    def episodes(seed: int, count: int, kinds: Any, *, start: int, tasks_per_scene: int) -> Iterator[Any]:
        asked.append((start, count))
        for number in range(start, start + count):
            yield SimpleNamespace(episode=_Task(number).episode)

    monkeypatch.setattr(rl_worker, "training_episodes", episodes)
    monkeypatch.setattr(rl_worker, "replace", _replaced)
    return asked


def _replaced(made: Any, **changes: Any) -> Any:
    return (
        SimpleNamespace(**{**vars(made), **changes}) if isinstance(made, SimpleNamespace) else replace(made, **changes)
    )


# Random numbers


def test_a_repeated_task_has_another_crowd(drawn: list[tuple[int, int]]) -> None:
    seeds = [scenario.episode.seed for _, scenario in scenarios(ORDER)]
    assert len(set(seeds)) == len(ORDER.numbers) and min(seeds) >= FIRST_SEED
    assert seeds == [scenario.episode.seed for _, scenario in scenarios(ORDER)]


def test_how_an_order_is_split_changes_nothing(drawn: list[tuple[int, int]]) -> None:
    def drawn_for(order: RolloutOrder) -> list[tuple[int, str, int, int]]:
        return [
            (place, made.episode.id, made.episode.seed, delays(order, made, place).draw().total_ns)
            for place, made in scenarios(order)
        ]

    assert drawn_for(ORDER) == [each for part in split(ORDER, 2) for each in drawn_for(part)]


class _Network:
    config = SimpleNamespace(vision=SimpleNamespace(image_px=32))


# Time and age


class _Recorder:
    """A policy that drives straight ahead and records the time of every observation."""

    failure = None
    semantic: Sequence[Any] = ()

    def __init__(self) -> None:
        self.times: list[float] = []

    def observe(self, time_s: float, image: npt.NDArray[np.uint8], T_odom_base: SE2) -> Any:
        self.times.append(time_s)
        return np.zeros((1, 2, 3), np.float32)

    def choose(self, visual: Any, state: Any, goal_m: Any, time_s: float, T_odom_base: SE2) -> PolicyOutput:
        return PolicyOutput((0.8, 0.0))

    def start_generation(self, time_s: float) -> None:
        """Nothing."""


@pytest.mark.slow
def test_a_policy_receives_the_time_to_the_nanosecond() -> None:
    episode = corridor_episode(timeout_s=1.2)
    scenario: Any = SimpleNamespace(
        episode=episode, wordings=episode.instructions, scene=load_scene("corridor"), kind="corridor"
    )
    policy = _Recorder()
    options = DriveOptions(32, None, max_s=1.2)
    drive_episode(scenario, lambda _: policy, robot_config().limits, options, np.random.default_rng(0))
    assert [round(time_s * 1e9) for time_s in policy.times] == [k * 100_000_000 for k in range(13)]


def _policy(age_s: float) -> TailPolicy:
    """A policy at time 0 whose semantic state has that age."""
    runtime = SimpleNamespace(frame_offsets_s=(9.0, 0.0), max_new_tokens=4)
    models: Any = SimpleNamespace(
        ages=SemanticConfig(), artifacts=SimpleNamespace(runtime=runtime), language=None,
        policy=SimpleNamespace(tokens_shape=(1, 2, 3)),
    )  # fmt: skip
    policy = TailPolicy(models, None, None, "go", lambda: None)  # type: ignore[arg-type, return-value]
    anchor_ns = START_NS - round(age_s * 1e9)
    kv = np.zeros((1, 1, 2), np.float32)
    policy.slot.state = SemanticState(1, anchor_ns, SE2(0, 0, 0), anchor_ns, kv, {}, "", None)
    return policy


@pytest.mark.parametrize(("age_s", "given_s"), [(4.0, 4.0), (10.0, 10.0), (13.0, 10.0)])
def test_delay_is_clipped_as_in_the_runner(age_s: float, given_s: float) -> None:
    policy = _policy(age_s)
    assert policy.slot.state is not None
    assert policy.latency(policy.slot.state, 0.0, SE2(0, 0, 0))[0] == given_s


@pytest.mark.parametrize(
    ("age_s", "share"), [(4.0, 1.0), (10.0, 1.0), (12.5, 0.5), (14.0, 0.2), (15.0, 0.0), (20.0, 0.0)]
)
def test_a_semantic_state_that_is_too_old_slows_the_robot_down_and_stops_it(age_s: float, share: float) -> None:
    assert _policy(age_s).speed_scale(0.0) == pytest.approx(share)


@pytest.mark.parametrize("share", [1.0, 0.5, 0.2])
def test_a_scaled_command_equals_the_controllers(share: float) -> None:
    limits = robot_config().limits
    controller, limiter = (
        Controller(ControllerConfig(limits, 0.1, 500.0, odometry_max_age_ms=100.0)),
        CommandLimiter(limits),
    )
    trajectory = np.zeros((30, 3), np.float32)
    trajectory[:, 0] = np.linspace(0.1, 3.0, 30)  # 1 m/s
    now_ns = 1_000_000_000
    controller.step(ControllerInputs(trajectory, 0.0, 0.0, speed_scale=share), now_ns)  # the clock begins
    for _ in range(30):
        now_ns += round(CONTROL_S * 1e9)
        wanted = controller.step(ControllerInputs(trajectory, 0.0, 0.0, speed_scale=share), now_ns)
        found = limiter.limit(min(1.0, limits.vx_max_mps), 0.0, share)
        assert found == pytest.approx((wanted.vx_mps, 0.0, wanted.wz_radps), abs=1e-6)
    assert found[0] == pytest.approx(min(1.0, share * limits.vx_max_mps))
