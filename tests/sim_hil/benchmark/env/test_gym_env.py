"""The Gymnasium environment: what any agent written for one may expect."""

from __future__ import annotations

from collections.abc import Iterator
from math import pi

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from sim_hil.benchmark.env.gym_env import APART_STEPS, ENV_ID, Contacts, DynaNavEnv
from sim_hil.benchmark.env.metrics import Outcome
from tests.support.benchmark.benchmark_episodes import block, corridor_episode, hall

FORWARD = np.array((0.8, 0.0, 0.0), np.float32)
EPISODES = (
    corridor_episode(id="short", goal_xy=(2.6, 0.0), shortest_m=2.6),
    corridor_episode(id="long", people=2, timeout_s=1.0),
)


@pytest.fixture
def env() -> Iterator[DynaNavEnv]:
    env = DynaNavEnv(EPISODES, camera=None)
    yield env
    env.close()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_gymnasiums_own_check_passes() -> None:
    env = DynaNavEnv(EPISODES, camera=(48, 32), render_mode="rgb_array")
    check_env(env, skip_render_check=True)
    picture = env.render()
    assert picture is not None and picture.shape == (180, 320, 3)
    env.close()


@pytest.mark.slow
def test_it_is_registered() -> None:
    made = gymnasium.make(ENV_ID, suite=EPISODES, camera=None)
    _, info = made.reset(seed=1, options={"episode": "short"})
    assert info["episode"] == "short"
    made.close()


@pytest.mark.slow
def test_the_episode_named_is_begun_with_the_wording_named(env: DynaNavEnv) -> None:
    _, info = env.reset(options={"episode": "long", "wording": 1})
    assert (info["episode"], info["instruction"]) == ("long", "Go straight on.")


@pytest.mark.slow
def test_without_a_name_the_seed_draws_the_episode(env: DynaNavEnv) -> None:
    drawn = [env.reset(seed=seed)[1]["episode"] for seed in range(3)]
    assert drawn == [env.reset(seed=seed)[1]["episode"] for seed in range(3)] and len(set(drawn)) == 2


@pytest.mark.parametrize("options", [{"episode": "none"}, {"weather": "fine"}])
def test_unknown_options_are_refused(env: DynaNavEnv, options: dict[str, str]) -> None:
    with pytest.raises(ValueError, match="DynaNav"):
        env.reset(options=options)


@pytest.mark.slow
def test_reaching_the_goal_terminates_with_the_goals_reward_and_an_outcome(env: DynaNavEnv) -> None:
    env.reset(options={"episode": "short"})
    rewards, terminated, truncated, info = [], False, False, {}
    while not (terminated or truncated):
        _, reward, terminated, truncated, info = env.step(FORWARD)
        rewards.append(reward)
    assert terminated and not truncated
    assert rewards[-1] > 400.0 and max(rewards[:-1]) < 2.0
    assert isinstance(info["outcome"], Outcome) and info["outcome"].success


def _begun(*touching: str) -> list[bool]:
    contacts = Contacts()
    return [contacts.began(frozenset(labels.split())) for labels in touching]


def test_a_collision_that_goes_on_or_comes_back_at_once_is_one() -> None:
    assert _begun("", "wall", "wall", "", "wall") == [False, True, False, False, False]


def test_after_a_second_apart_it_is_another_one() -> None:
    assert _begun("wall", *[""] * APART_STEPS, "wall")[-1]
    assert not _begun("wall", *[""] * (APART_STEPS - 1), "wall")[-1]


def test_another_object_is_another_collision() -> None:
    assert _begun("wall", "wall person", "person") == [True, True, False]


@pytest.mark.slow
def test_a_detour_round_a_wall_is_progress_though_the_goal_grows_no_nearer() -> None:
    """A cabinet 4 m wide stands between start and goal: sideways is the way."""
    episode = corridor_episode(id="detour", start=(-2.0, 0.0, pi / 2), goal_xy=(4.0, 0.0), scene="hall")
    env = DynaNavEnv([episode], camera=None, scenes={"hall": hall(block(0.0, 0.0, 0.5, 4.0))})
    _, info = env.reset()
    far_m = info["distance_m"]
    total = 0.0
    for _ in range(25):
        _, reward, _, _, info = env.step(FORWARD)
        total += reward
    env.close()
    assert info["distance_m"] > far_m and total > 2.0


@pytest.mark.slow
def test_an_episode_without_a_way_is_refused_at_its_reset() -> None:
    walled = hall(block(0.0, 0.0, 0.5, 10.0))
    env = DynaNavEnv([corridor_episode(id="walled", start=(-2.0, 0.0, 0.0))], camera=None, scenes={"corridor": walled})
    with pytest.raises(ValueError, match="expected a path"):
        env.reset()
    env.close()


def test_no_suite_is_the_default() -> None:
    with pytest.raises(TypeError, match="suite"):
        gymnasium.make(ENV_ID)


@pytest.mark.slow
def test_the_timeout_truncates(env: DynaNavEnv) -> None:
    env.reset(options={"episode": "long"})
    ends = [env.step(np.zeros(3, np.float32))[2:4] for _ in range(10)]
    assert ends == [(False, False)] * 9 + [(False, True)]


@pytest.mark.slow
def test_an_action_out_of_range_is_clipped(env: DynaNavEnv) -> None:
    env.reset(options={"episode": "short"})
    observation, *_ = env.step(np.array((0.0, 0.0, 9.0), np.float32))
    assert env.observation_space.contains(observation)
    assert env.world.robot.truth(0.0).commanded[2] == pytest.approx(1.2)


@pytest.mark.slow
def test_another_crowd_seed_makes_other_people(env: DynaNavEnv) -> None:
    env.reset(options={"episode": "long"})
    before = env.world.people()
    env.reset(options={"episode": "long", "crowd_seed": 99})
    assert not np.allclose(before, env.world.people())


def test_a_world_before_the_first_reset_is_refused(env: DynaNavEnv) -> None:
    with pytest.raises(RuntimeError, match="reset"):
        _ = env.world
