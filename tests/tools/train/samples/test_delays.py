"""The ages that are trained under are those of the paper, or those that a device's runner acts on."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from edge.inference.latency_profile import LatencyError, LatencyProfile
from tools.train.config.imitate import DelayConfig
from tools.train.imitate.data import Delays


def test_the_papers_delays_are_uniform_from_0_to_10_s() -> None:
    mass = Delays.of(DelayConfig()).mass
    assert len(mass) == 101
    np.testing.assert_allclose(mass[1:100], 0.01)
    # Half of what rounds to 0.0 s would be below 0, half of what rounds to 10.0 s beyond 10.
    assert mass[0] == pytest.approx(0.005) and mass[100] == pytest.approx(0.005)
    assert Delays.of(DelayConfig()).mean_s == pytest.approx(5.0)


def test_a_share_of_the_ages_can_be_near_without_the_others_going() -> None:
    config = DelayConfig(near_share=0.6, near_s=4.0)
    mass = Delays.of(config).mass
    np.testing.assert_allclose(mass[1:40], 0.4 * 0.01 + 0.6 * 0.025)
    np.testing.assert_allclose(mass[41:100], 0.4 * 0.01)
    assert Delays.of(config).mean_s == pytest.approx(0.4 * 5.0 + 0.6 * 2.0)


@pytest.mark.parametrize("seconds", [0.4, 2.0, 7.0])
def test_generations_that_all_take_as_long_are_between_one_and_two_of_their_times_old(seconds: float) -> None:
    delays = Delays.of_profile(LatencyProfile.constant(seconds))
    tenths = round(10 * seconds)
    assert set(np.flatnonzero(delays.mass)) == set(range(tenths, 2 * tenths + 1))
    np.testing.assert_allclose(delays.mass[tenths + 1 : 2 * tenths], 0.1 / seconds)
    assert delays.mean_s == pytest.approx(1.5 * seconds)


@pytest.mark.parametrize("late_anchor", [False, True])
def test_a_profiles_ages_are_those_that_a_run_with_its_times_has(late_anchor: bool) -> None:
    rng = np.random.default_rng(1)
    times = rng.gamma(4.0, 0.5, 60).clip(0.3, 8.0)
    anchors = 0.4 * times if late_anchor else 0.0 * times
    profile = LatencyProfile("p", "drawn", tuple(times), tuple(anchors))
    # The runner: a generation starts when the one before it is released, and is acted on until its own successor is.
    taken = rng.integers(len(times), size=40_000)
    released = np.cumsum(times[taken])
    anchored = released - times[taken] + anchors[taken]
    ticks = np.arange(released[0], released[-1], 0.1)
    ages = ticks - anchored[np.searchsorted(released, ticks, side="right") - 1]
    seen = np.bincount(np.round(10 * ages).astype(int)) / len(ticks)
    mass = Delays.of_profile(profile).mass
    longest = max(len(seen), len(mass))
    difference = np.pad(seen, (0, longest - len(seen))) - np.pad(mass, (0, longest - len(mass)))
    assert np.abs(np.cumsum(difference)).max() < 0.01


def test_a_profile_of_no_time_at_all_is_no_delay() -> None:
    assert Delays.of_profile(LatencyProfile.constant(0.0)).mass.tolist() == [1.0]
    assert Delays.none().mean_s == 0.0 and Delays.none().beyond.tolist() == [0.0]


def test_a_profile_is_read_from_the_file_that_the_recipe_names(tmp_path: Path) -> None:
    path = tmp_path / "orin.json"
    path.write_text(json.dumps(LatencyProfile.constant(2.0).as_json()))
    np.testing.assert_allclose(
        Delays.of(DelayConfig(profile=str(path))).mass, Delays.of_profile(LatencyProfile.constant(2.0)).mass
    )
    with pytest.raises(LatencyError, match="cannot be read"):
        Delays.of(DelayConfig(profile=str(tmp_path / "none.json")))
