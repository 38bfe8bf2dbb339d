"""From episodes to rates: percent, with intervals that depend on the results alone, and fair comparisons."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest

from sim_hil.benchmark import cli
from sim_hil.benchmark.bootstrap import mean_ci95, paired_ci95
from sim_hil.benchmark.store import ResultStore
from sim_hil.benchmark.summary import compare, crowd_level, summarise
from tests import dynanav_fakes as fakes


def mixed(count: int = 20) -> list[fakes.EpisodeResult]:
    """Every other one reached."""
    return [fakes.result(f"e{i}") if i % 2 else fakes.missed(f"e{i}") for i in range(count)]


def test_rates_are_percent_of_episodes() -> None:
    hit = {"collided": True, "collisions": ("person",)}
    summary = summarise([fakes.result("a"), fakes.result("b", spl=60.0, **hit), fakes.missed("c"), fakes.missed("d")])
    assert (summary["episodes"], summary["sr"], summary["spl"], summary["ne_m"], summary["cr"]) == (4, 50, 35, 4, 25)


def test_every_group_has_the_same_numbers() -> None:
    summary = summarise([fakes.result("a", scene="office", people=30, robot="carter"), *mixed()])
    assert set(summary["by_scene"]) == {"corridor", "office"} and set(summary["by_robot"]) == {"go2", "carter"}
    assert list(summary["by_crowd"]) == ["0", "21-40"]
    assert summary["by_scene"]["office"]["sr"] == 100 and summary["by_scene"]["office"]["sr_ci95"] is None


def test_intervals_do_not_depend_on_the_order_in_which_episodes_finish() -> None:
    results = mixed(31)
    shuffled = random.Random(3).sample(results, len(results))
    assert summarise(results) == summarise(shuffled)


def test_an_interval_holds_the_mean_and_shrinks_with_more_episodes() -> None:
    few, many = summarise(mixed(10))["sr_ci95"], summarise(mixed(200))["sr_ci95"]
    assert few[0] < 50 < few[1] and many[0] < 50 < many[1] and many[1] - many[0] < (few[1] - few[0]) / 2


def test_the_interval_is_about_that_of_the_normal_approximation() -> None:
    low, high = mean_ci95([100.0] * 47 + [0.0] * 38) or (0.0, 0.0)
    half = 1.96 * np.sqrt(47 / 85 * 38 / 85 / 85) * 100
    assert high - low == pytest.approx(2 * half, rel=0.05)


def test_one_episode_has_no_interval_and_none_has_no_rate() -> None:
    assert mean_ci95([1.0]) is None and summarise([])["sr"] is None


def test_a_paired_difference_that_is_the_same_everywhere_has_no_width() -> None:
    noise = list(np.random.default_rng(1).normal(size=50) * 100)
    assert paired_ci95(noise, [value + 2 for value in noise]) == pytest.approx((2.0, 2.0))


def test_a_comparison_is_of_the_episodes_that_both_have() -> None:
    before = [fakes.missed("a"), fakes.missed("b"), fakes.result("c"), fakes.result("x")]
    after = [fakes.result("c"), fakes.result("a"), fakes.missed("b"), fakes.result("y")]
    found = compare(before, after)
    assert found["episodes"] == 3 and found["only_before"] == ["x"] and found["only_after"] == ["y"]
    assert found["succeeded_in_after_only"] == ["a"] and not found["succeeded_in_before_only"]
    assert found["differences"]["sr"]["difference"] == pytest.approx(100 / 3, abs=1e-3)


def test_a_difference_whose_interval_holds_zero_is_not_called_significant() -> None:
    some = compare([fakes.missed(f"e{i}") for i in range(20)], mixed())["differences"]["sr"]
    one = compare([fakes.missed("a"), *mixed()], [fakes.result("a"), *mixed()])["differences"]["sr"]
    assert some["significant"] and some["ci95"][0] > 0
    assert not one["significant"] and one["ci95"][0] == 0


@pytest.mark.parametrize(
    ("people", "level"), [(0, "0"), (1, "1-20"), (20, "1-20"), (60, "41-60"), (200, "61 and more")]
)
def test_crowd_levels(people: int, level: str) -> None:
    assert crowd_level(people) == level


def run_of(folder: Path, results: list[fakes.EpisodeResult], suite: str = "dynanav") -> Path:
    config = {"suite": suite, "conditions": fakes.STILL.as_json(), "episodes": []}
    store = ResultStore.create(folder, config)
    for each in results:
        store.add(each)
    store.close()
    return folder


def test_compare_says_both_runs_and_their_difference(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = run_of(tmp_path / "a", [fakes.missed("e1"), fakes.missed("e3")]), run_of(tmp_path / "b", mixed(4))
    assert cli.main(["compare", str(a), str(b)]) == 0
    said = capsys.readouterr().out
    assert "2 episodes in both" in said and "+100.00" in said and "succeeded in B only: e1, e3" in said


@pytest.mark.parametrize("other", ["nowhere", "another-suite", "other-episodes"])
def test_compare_of_what_cannot_be_compared_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], other: str
) -> None:
    run_of(tmp_path / "a", [fakes.missed("e1")])
    run_of(tmp_path / "another-suite", [fakes.missed("e1")], suite="mine")
    run_of(tmp_path / "other-episodes", [fakes.missed("e2")])
    assert cli.main(["compare", str(tmp_path / "a"), str(tmp_path / other)]) == 2
    said = capsys.readouterr().err
    assert said.startswith("edge-bench compare: ") and said.count("\n") == 1
