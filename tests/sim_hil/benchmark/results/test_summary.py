"""From episodes to rates: percent, with intervals that depend on the results alone, and fair comparisons."""

from __future__ import annotations

import random
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sim_hil.benchmark import cli, runs
from sim_hil.benchmark.results.bootstrap import mean_ci95, paired_ci95
from sim_hil.benchmark.results.record import FailedRun, ResultError
from sim_hil.benchmark.results.store import ResultStore
from sim_hil.benchmark.results.summary import compare, summarise
from sim_hil.benchmark.workers.progress import BenchProgress
from tests.support.benchmark import dynanav_fakes as fakes


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


@pytest.mark.parametrize(
    ("content", "current"),
    [
        ('{"summary": {"finished": true}, "episodes": [{}, {}]}', True),
        ('{"summary": {"finished": false}, "episodes": [{}, {}]}', False),
        ('{"summary": {"finished": true}, "episodes": [{}]}', False),
        ('{"summary": {"fin', False),
        ("[]", False),
    ],
)
def test_a_result_of_an_unfinished_run_is_written_again(tmp_path: Path, content: str, current: bool) -> None:
    (tmp_path / "result.json").write_text(content)
    assert runs._is_current(tmp_path / "result.json", 2) is current
    assert not runs._is_current(tmp_path / "missing.json", 2)


@pytest.mark.slow
def test_intervals_do_not_depend_on_the_order_in_which_episodes_finish() -> None:
    results = mixed(31)
    shuffled = random.Random(3).sample(results, len(results))
    assert summarise(results) == summarise(shuffled)


def each_its_own(count: int) -> list[str]:
    return [f"task-{i}" for i in range(count)]


def test_the_interval_is_about_that_of_the_normal_approximation() -> None:
    low, high = mean_ci95([100.0] * 47 + [0.0] * 38, each_its_own(85)) or (0.0, 0.0)
    half = 1.96 * np.sqrt(47 / 85 * 38 / 85 / 85) * 100
    assert high - low == pytest.approx(2 * half, rel=0.05)


def test_a_rate_over_tasks_of_one_episode_has_wilsons_interval() -> None:
    # Wilson (1927) of 15 in 50, as statsmodels.stats.proportion.proportion_confint(15, 50, method="wilson") gives it.
    interval = mean_ci95([100.0] * 15 + [0.0] * 35, each_its_own(50), (0.0, 100.0))
    assert interval == pytest.approx((19.103, 43.751), abs=0.01)


def test_one_episode_has_no_interval_and_none_has_no_rate() -> None:
    assert mean_ci95([1.0], ["a"]) is None and summarise([])["sr"] is None


def test_repeated_episodes_of_one_task_do_not_narrow_the_interval() -> None:
    # 10 tasks of 5 episodes, of which all or none is reached: as uncertain as 10 episodes, not as 50.
    values = [100.0 * (task % 2) for task in range(10) for _ in range(5)]
    tasks = [f"task-{task}" for task in range(10) for _ in range(5)]
    of_tasks, of_episodes = mean_ci95(values, tasks), mean_ci95(values, each_its_own(50))
    alone = mean_ci95([100.0 * (task % 2) for task in range(10)], each_its_own(10))
    assert of_tasks == alone and of_episodes is not None and of_tasks is not None
    assert of_tasks[1] - of_tasks[0] > 2 * (of_episodes[1] - of_episodes[0])


def test_tasks_count_by_their_episodes() -> None:
    # Three of a task that is reached, one of a task that is not: the mean is 75, and a draw may hold only one task.
    low, high = mean_ci95([100.0, 100.0, 100.0, 0.0], ["long", "long", "long", "short"]) or (0.0, 0.0)
    assert (low, high) == (0.0, 100.0)
    one_task = mean_ci95([100.0, 0.0] * 20, ["only"] * 40)
    assert one_task is not None and one_task == pytest.approx((35, 65), abs=3)


@pytest.mark.slow
def test_summaries_resample_the_tasks_of_their_results() -> None:
    made = [fakes.result if task % 2 else fakes.missed for task in range(10)]
    repeated = [make(f"e{task}-{i}", task=f"t{task}") for task, make in enumerate(made) for i in range(5)]
    apart = [make(f"e{task}-{i}") for task, make in enumerate(made) for i in range(5)]
    (low, high), (from_, to) = summarise(repeated)["sr_ci95"], summarise(apart)["sr_ci95"]
    assert high - low > 2 * (to - from_)


def test_rates_of_a_summary_are_never_certain_and_stay_within_what_a_rate_can_be() -> None:
    summary = summarise([fakes.result(f"e{i}", spl=100.0) for i in range(20)])
    assert summary["sr_ci95"] == summary["spl_ci95"] == pytest.approx([83.89, 100.0], abs=0.01)
    assert summary["cr_ci95"] == pytest.approx([0.0, 16.11], abs=0.01)


def test_two_runs_that_ended_alike_may_still_differ() -> None:
    results = mixed(85)
    row = compare(results, results)["differences"]["sr"]
    assert row["difference"] == 0 and row["ci95"] == pytest.approx([-4.32, 4.32], abs=0.01) and not row["significant"]


def test_a_paired_difference_that_is_the_same_everywhere_has_no_width() -> None:
    noise = list(np.random.default_rng(1).normal(size=50) * 100)
    assert paired_ci95(noise, [value + 2 for value in noise], each_its_own(50)) == pytest.approx((2.0, 2.0))


def test_a_comparison_is_of_the_episodes_that_both_have() -> None:
    before = [fakes.missed("a"), fakes.missed("b"), fakes.result("c"), fakes.result("x")]
    after = [fakes.result("c"), fakes.result("a"), fakes.missed("b"), fakes.result("y")]
    found = compare(before, after)
    assert found["episodes"] == 3 and found["only_before"] == ["x"] and found["only_after"] == ["y"]
    assert found["succeeded_in_after_only"] == ["a"] and not found["succeeded_in_before_only"]
    assert found["differences"]["sr"]["difference"] == pytest.approx(100 / 3, abs=1e-3)


@pytest.mark.parametrize(
    ("name", "other"),
    [("seed", 2), ("shortest_m", 3.5), ("timeout_s", 30.0), ("robot", "carter"), ("people", 5), ("task", "another")],
)
def test_two_episodes_of_one_name_are_no_pair(name: str, other: object) -> None:
    with pytest.raises(ResultError, match=f"episode b: expected the same {name} in both runs, found .* and {other}"):
        compare([fakes.result("a"), fakes.result("b")], [fakes.result("a"), fakes.result("b", **{name: other})])


def test_a_difference_whose_interval_holds_zero_is_not_called_significant() -> None:
    some = compare([fakes.missed(f"e{i}") for i in range(20)], mixed())["differences"]["sr"]
    one = compare([fakes.missed("a"), *mixed()], [fakes.result("a"), *mixed()])["differences"]["sr"]
    assert some["significant"] and some["ci95"][0] > 0
    assert not one["significant"] and one["ci95"][0] == 0


def fresh(task: str, **changed: object) -> fakes.EpisodeResult:
    make = fakes.result if changed.pop("reached", True) else fakes.missed
    return make(f"{task}-0-go2", task=task, scene="-".join(task.split("-")[:2]), **changed)


FRESH = [
    fresh("office-60-1-turn-desk-1", shortest_m=8.0),
    fresh("office-61-2-turns-coffee-machine-2", shortest_m=13.0, reached=False),
    fresh("hospital-60-3-turns-bench-1", shortest_m=20.0, collided=True, collisions=("person",)),
]


def test_a_stratified_suite_is_summarised_by_kind_length_and_turns() -> None:
    summary = summarise(FRESH)
    assert {key: each["episodes"] for key, each in summary["by_scene"].items()} == {"hospital": 1, "office": 2}
    assert list(summary["by_length"]) == ["short", "middle", "long"] and list(summary["by_turns"]) == ["1", "2", "3"]
    assert summary["by_length"]["middle"]["sr"] == 0 and summary["by_turns"]["3"]["cr"] == 100


def test_another_suite_has_no_strata() -> None:
    assert not {"by_length", "by_turns"} & set(summarise([*FRESH, fakes.result("a")]))


def run_of(folder: Path, results: list[fakes.EpisodeResult], suite: str = "dynanav") -> Path:
    config = {"suite": suite, "conditions": fakes.STILL.as_json(), "episodes": []}
    config |= {"suite_sha256": "0" * 64, "versions": {}}
    store = ResultStore.create(folder, config)
    for each in results:
        store.add(each)
    store.close()
    return folder


def test_compare_prints_both_runs_and_their_difference(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = run_of(tmp_path / "a", [fakes.missed("e1"), fakes.missed("e3")]), run_of(tmp_path / "b", mixed(4))
    assert cli.main(["compare", str(a), str(b)]) == 0
    message = capsys.readouterr().out
    assert "2 episodes in both" in message and "+100.00" in message and "succeeded in B only: e1, e3" in message


@pytest.mark.slow
def test_no_output_about_the_fresh_suite_names_an_episode(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a = run_of(tmp_path / "a", FRESH, suite="dynanav-fresh")
    b = run_of(tmp_path / "b", [replace(FRESH[0], success=False, spl=0.0)], suite="dynanav-fresh")
    assert cli.main(["compare", str(a), str(b)]) == 0
    message = capsys.readouterr().out
    assert "succeeded in A only: 1" in message
    assert cli.main(["report", str(a)]) == 0
    html = (a / "report.html").read_text()
    BenchProgress(2, 0, blind=True).watcher.finished(FRESH[0])
    message += (seen := capsys.readouterr().err)
    assert "[1/2] 9 s simulated" in seen
    assert "length: middle" in html and "turns: 3" in html
    for each in FRESH:
        assert each.id not in message + html and each.scene not in message + html


@pytest.mark.parametrize("other", ["nowhere", "another-suite", "other-episodes", "changed-episode"])
def test_incomparable_runs_are_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], other: str
) -> None:
    run_of(tmp_path / "a", [fakes.missed("e1")])
    run_of(tmp_path / "another-suite", [fakes.missed("e1")], suite="mine")
    run_of(tmp_path / "other-episodes", [fakes.missed("e2")])
    run_of(tmp_path / "changed-episode", [fakes.missed("e1", timeout_s=55.0)])
    assert cli.main(["compare", str(tmp_path / "a"), str(tmp_path / other)]) == 2
    message = capsys.readouterr().err
    assert message.startswith("edge-bench compare: ") and message.count("\n") == 1


def test_a_report_that_is_written_again_still_names_the_episodes_without_a_result(tmp_path: Path) -> None:
    folder = run_of(tmp_path / "a", [])
    store = ResultStore(folder, {}, ())
    store.add_failed(FailedRun("e7", 2, "its process ended by SIGKILL"))
    assert cli.main(["report", str(folder)]) == 0
    html = (folder / "report.html").read_text()
    assert "e7" in html and "its process ended by SIGKILL" in html
