"""Noise comes in bursts and is marked as such; in DAgger whole stretches are the expert's."""

from __future__ import annotations

import itertools
from math import isclose

import numpy as np

from tools.train.collect.steering import NoiseConfig, SharedControl, SteeringNoise, Velocity
from tools.train.drives.drive import EXPERT, NOISE

WANTED: Velocity = (0.7, 0.0, 0.1)
POLICYS: Velocity = (0.2, 0.0, -0.4)


def _bursts(seed: int, ticks: int = 3000) -> list[tuple[Velocity, int]]:
    noise = SteeringNoise(np.random.default_rng(seed))
    return [noise.command(WANTED) for _ in range(ticks)]


def _runs(by: list[int]) -> list[tuple[int, int]]:
    """(who, ticks) of each stretch, without the first and the last, which are cut off."""
    return [(who, len(list(group))) for who, group in itertools.groupby(by)][1:-1]


def test_outside_a_burst_the_experts_command_is_not_touched() -> None:
    assert all(command == WANTED for command, by in _bursts(1) if by == EXPERT)


def test_bursts_and_pauses_last_as_long_as_they_should() -> None:
    config = NoiseConfig()
    runs = _runs([by for _, by in _bursts(2)])
    bursts, pauses = ([ticks / 10 for who, ticks in runs if who == kind] for kind in (NOISE, EXPERT))
    assert len(bursts) > 20
    assert config.burst_s[0] <= min(bursts) and max(bursts) <= config.burst_s[1]
    assert config.pause_s[0] - 0.2 <= min(pauses) and max(pauses) <= config.pause_s[1]


def test_a_burst_is_one_drifting_push_and_not_a_new_one_each_time() -> None:
    pairs = [
        (one[0][2] - 0.1, other[0][2] - 0.1)
        for one, other in itertools.pairwise(_bursts(3))
        if one[1] == other[1] == NOISE
    ]
    first, second = np.array(pairs).T
    assert np.corrcoef(first, second)[0, 1] > 0.6
    assert 0.3 < np.std(first) < 0.8


def test_nothing_is_commanded_beyond_what_a_robot_may_do() -> None:
    commands = [command for command, _ in _bursts(4)]
    assert all(-0.3 <= vx <= 1.1 and abs(wz) <= 1.2 for vx, _, wz in commands)


def _shared(beta: float, ticks: int = 4000) -> list[tuple[Velocity, int]]:
    shared = SharedControl(np.random.default_rng(1), beta)
    return [shared.command(WANTED, POLICYS) for _ in range(ticks)]


def test_the_experts_share_is_about_its_chance() -> None:
    assert isclose(np.mean([by == EXPERT for _, by in _shared(0.3, 20_000)]), 0.3, abs_tol=0.06)


def test_nobody_drives_for_less_than_two_seconds() -> None:
    assert min(ticks for _, ticks in _runs([by for _, by in _shared(0.5)])) >= 20
