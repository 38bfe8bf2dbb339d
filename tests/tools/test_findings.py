"""Findings: verdicts from paired differences and their intervals; runs of equal conditions are shared and resumed."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from edge.artifacts.files import SCHEMA_VERSION, SECTIONS, seal
from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE, EXIT_INTERRUPTED
from sim_hil.benchmark.conditions.conditions import Conditions, ConditionsError
from sim_hil.benchmark.conditions.latency import LatencyProfile
from sim_hil.benchmark.conditions.rewording import reworded
from sim_hil.benchmark.results.record import EpisodeResult, ResultError
from sim_hil.benchmark.results.store import ResultStore, StoreError
from sim_hil.benchmark.runs import RunsError
from sim_hil.benchmark.suite.episode import Episode, load_suite
from sim_hil.scene.scene import load_scene
from tests.support.benchmark.dynanav_fakes import missed, result, suite_text
from tools.findings import __main__ as findings
from tools.findings.__main__ import main, plan_lines, plan_of
from tools.findings.rows import CLAIMS, ROWS, RUNS, Finding, Level, runs_of
from tools.findings.verdict import FAILS, HOLDS, OPEN, judge, judge_all, verdict_of
from tools.train.config.checks import TrainError
from tools.train.config.rl import EvaluateConfig
from tools.train.pipeline.evaluate import write_suite

TWO_S = LatencyProfile.constant(2.0)


def outcomes(*reached: int, task: str = "") -> list[EpisodeResult]:
    """One result an episode, reached (1) or not (0), each of a task of its own."""
    return [(result if hit else missed)(f"e{n:02d}", task=task or f"t{n}") for n, hit in enumerate(reached)]


def models(root: Path, *names: str, alike: bool = False) -> Path:
    """Exported models; each with graphs of its own, or (`alike`) all with the same."""
    for name in names:
        (root / name).mkdir(parents=True)
        files = {"action_expert.onnx": {"sha256": "same" if alike else name}, "report.html": {"sha256": name}}
        sections = {key: {} for key in SECTIONS} | {"schema_version": SCHEMA_VERSION, "files": files}
        (root / name / "manifest.json").write_text(json.dumps(seal(sections)))
    return root


# What holds


def test_a_difference_holds_when_its_whole_interval_does() -> None:
    claim = Finding("async", "async beats sync", "Table 1", (("sync", "async"),))
    found = judge(claim, {"sync": outcomes(*[0] * 30), "async": outcomes(*[1, 1, 0] * 10)})
    assert found.verdict == HOLDS and found.value == pytest.approx(66.667) and found.n == 30
    assert found.before == 0 and found.after == pytest.approx(66.667) and found.ci95 is not None and found.ci95[0] > 0
    assert set(found.also) == {"spl", "ne_m", "cr"}


def test_a_gain_over_several_latencies_is_averaged_by_episode() -> None:
    claim = Finding("rl", "", "", (("a1", "b1"), ("a2", "b2")))
    runs = {"a1": outcomes(0, 0), "b1": outcomes(1, 0), "a2": outcomes(0, 1), "b2": outcomes(1, 1)}
    found = judge(claim, runs)
    assert (found.before, found.after, found.value) == pytest.approx((25.0, 75.0, 50.0))


def test_a_gain_is_compared_with_another_gain() -> None:
    claim = Finding("rl", "", "", (("a1", "b1"),), minus=(("a2", "b2"),))
    runs = {
        "a1": outcomes(*[0] * 9),
        "b1": outcomes(*[1] * 9),
        "a2": outcomes(*[0] * 9),
        "b2": outcomes(*[1, 0, 0] * 3),
    }
    assert judge(claim, runs).value == pytest.approx(100 - 100 / 3, abs=1e-2)


def test_only_episodes_that_all_runs_have_count() -> None:
    claim = Finding("async", "", "", (("sync", "async"),))
    assert judge(claim, {"sync": outcomes(0, 0, 0), "async": outcomes(1, 1)}).n == 2
    with pytest.raises(ResultError, match="no episode in common"):
        judge(claim, {"sync": outcomes(0)[:1], "async": [result("other")]})


def test_one_name_for_two_different_episodes_is_refused() -> None:
    claim = Finding("async", "", "", (("sync", "async"),))
    with pytest.raises(ResultError, match="expected the same people"):
        judge(claim, {"sync": [result("a"), result("b")], "async": [result("a", people=9), result("b")]})


def test_a_level_holds_above_its_bound_or_below_it() -> None:
    good = {"rl": outcomes(*[1] * 70, *[0] * 15)}
    at_least = Level("score", "", "", "rl", "sr", 55.0)
    assert judge(at_least, good).verdict == HOLDS
    assert judge(at_least, {"rl": outcomes(*[1] * 20, *[0] * 65)}).verdict == FAILS
    calm = {"rl": [result(f"e{n}", task=f"t{n}") for n in range(85)]}
    wild = {"rl": [result(f"e{n}", task=f"t{n}", collided=True, collisions=("person",), first_collision_s=1.0)
                   for n in range(85)]}  # fmt: skip
    at_most = Level("score", "", "", "rl", "cr", 28.0, -1)
    assert judge(at_most, calm).verdict == HOLDS and judge(at_most, wild).verdict == FAILS


@pytest.mark.parametrize(
    ("interval", "least", "verdict"),
    [((1.0, 5.0), 0.0, HOLDS), ((-5.0, -1.0), 0.0, FAILS), ((-1.0, 1.0), 0.0, OPEN), (None, 0.0, OPEN),
     ((29.0, 60.0), 30.0, OPEN), ((31.0, 60.0), 30.0, HOLDS), ((-9.0, 3.0), -10.0, HOLDS)],
)  # fmt: skip
def test_the_verdict_is_the_intervals(interval: Any, least: float, verdict: str) -> None:
    assert verdict_of(interval, least) == verdict


def test_claims_are_judged_whose_runs_are_all_there() -> None:
    found = judge_all({"rl": outcomes(1, 0, 1), "rl-sync": outcomes(0, 0, 1)})
    assert [each.row for each in found] == ["score", "score", "score", "async"]


# What is run


def test_every_claim_is_about_runs_that_exist() -> None:
    assert {name for claim in CLAIMS for name in claim.runs} <= set(RUNS)
    assert {name for row in ROWS for name in runs_of([row])} == set(RUNS)


def test_runs_of_the_same_conditions_are_run_once(tmp_path: Path) -> None:
    plan = plan_of(models(tmp_path, "rl", "no-rl"), ["score", "rl", "offset"], TWO_S)
    assert plan.folders["rl-2s"] == plan.folders["rl"] == "rl" and plan.folders["rl-3s"] == "rl-3s"
    assert len(set(plan.folders.values())) == 2 + 2 * 4
    assert any("the same as rl" in line for line in plan_lines(plan, 85))
    # The row about the offset lacks its models.
    assert list(plan.missing) == ["no-motion-offset", "full"] and "full: no artifacts" in plan.missing["full"]


def test_a_profile_keeps_its_shape_at_every_latency(tmp_path: Path) -> None:
    base = LatencyProfile("orin", "measured there", (1.0, 3.0), (), "measured")
    plan = plan_of(models(tmp_path, "rl", "no-rl"), ["rl"], base)
    latency = plan.conditions["rl-4s"].latency
    assert latency is not None and latency.generation_s == pytest.approx((2.0, 6.0)) and latency.tagged == "modelled"


def test_reasoning_is_judged_by_a_model_trained_without_it_where_there_is_one(tmp_path: Path) -> None:
    both = plan_of(models(tmp_path / "both", "rl", "full", "no-reasoning"), ["reasoning"], TWO_S)
    assert set(both.conditions) == {"no-reasoning", "full"} and both.conditions["no-reasoning"].mode == "no-reasoning"
    assert both.conditions["full"].mode == "async"
    alone = plan_of(models(tmp_path / "alone", "rl"), ["reasoning"], TWO_S)
    assert set(alone.conditions) == {"rl-no-reasoning", "rl"} and set(alone.missing) == {"no-reasoning", "full"}


def test_rows_that_compare_equal_weights_are_left_out(tmp_path: Path) -> None:
    plan = plan_of(models(tmp_path, "rl", "no-rl", alike=True), ["score", "async", "rl"], TWO_S)
    assert set(plan.conditions) == {"rl", "rl-sync"}
    assert plan.missing == {"row rl": "no-rl and rl have the same weights: there is nothing to compare"}
    assert not any(claim.row == "rl" for claim in plan.claims)


def test_wordings_are_not_judged_on_a_suite_of_trainings_patterns(tmp_path: Path) -> None:
    plan = plan_of(models(tmp_path, "rl"), ["score", "wordings"], TWO_S, held_out=False)
    assert list(plan.conditions) == ["rl"] and "training's patterns" in plan.missing["row wordings"]
    assert all(claim.row != "wordings" for claim in plan.claims)


def test_artifacts_alone_are_the_shipped_model(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text("{}")
    plan = plan_of(tmp_path, ["score", "latency"], TWO_S)
    assert list(plan.conditions) == ["rl"] and plan.conditions["rl"].variant is None


# The command


class Bench:
    """Runs that end at once: which episodes of which run reach their goal is known beforehand."""

    def __init__(self, reached: dict[str, Sequence[int]]) -> None:
        self.reached, self.ran = reached, []  # type: ignore[var-annotated]
        self.ends: BaseException | None = None

    def __call__(
        self, suite: str, episodes: Sequence[Episode], conditions: Conditions, out: Path, **_: Any
    ) -> list[EpisodeResult]:  # fmt: skip
        self.ran.append(out.name)
        if self.ends is not None and len(self.ran) > 1:
            raise self.ends
        store = ResultStore.create(out, {"conditions": conditions.as_json()})
        for made in outcomes(*self.reached.get(out.name, [0] * len(episodes))):
            store.add(made)
        store.close()
        (out / "result.json").write_text(json.dumps({"summary": {"finished": True}, "trained": True}))
        return store.results


@pytest.fixture
def suite(tmp_path: Path) -> Path:
    path = tmp_path / "suite.toml"
    path.write_text(suite_text(*(f"e{n:02d}" for n in range(30))))
    return path


def run(root: Path, out: Path, suite: Path, *more: str) -> int:
    return main(["--artifacts", str(root), "--out", str(out), "--suite", str(suite), *more])


@pytest.mark.slow
def test_a_page_a_picture_and_json_are_written(
    tmp_path: Path, suite: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setattr(findings, "run_episodes", Bench({"rl": [1, 1, 0] * 10}))
    root, out = models(tmp_path / "models", "rl", "no-rl"), tmp_path / "out"
    assert run(root, out, suite, "--rows", "async,rl,latency", "--json", "-") == EXIT_DONE
    found = json.loads(capsys.readouterr().out)
    by_claim = {each["claim"]: each for each in found["findings"]}
    assert by_claim["asynchronous inference beats synchronous"]["verdict"] == HOLDS
    page = (out / "findings.md").read_text()
    assert "**holds**" in page and "**undecided**" in page and "no-latency: " in page and "| rl-sync | 30 |" in page
    assert json.loads((out / "findings.json").read_text()) == found
    assert (out / "findings.png").stat().st_size > 0 and (out / "latency.png").stat().st_size > 0


@pytest.mark.slow
def test_an_interrupted_run_is_reported_as_far_as_it_has_results(
    tmp_path: Path, suite: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench({})
    bench.ends = KeyboardInterrupt()
    monkeypatch.setattr(findings, "run_episodes", bench)
    root, out = models(tmp_path / "models", "rl"), tmp_path / "out"
    assert run(root, out, suite, "--rows", "score,async") == EXIT_INTERRUPTED
    page = (out / "findings.md").read_text()
    assert "SR of the shipped model" in page and "rl-sync: 0 of 30 episodes so far" in page


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ends", "code"),
    [
        (RunsError("two episodes have no result"), EXIT_CHECK_FAILED),
        (StoreError("expected the code of the run, found other code"), EXIT_CHECK_FAILED),
        (ConditionsError("swapped instructions: expected two tasks or more in hall, found 1"), EXIT_DONE),
    ],
    ids=["a run that lacks episodes", "a run of other code", "a run that does not suit"],
)
def test_one_failed_run_does_not_end_the_others(
    ends: Exception, code: int, tmp_path: Path, suite: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench({})
    bench.ends = ends
    monkeypatch.setattr(findings, "run_episodes", bench)
    root, out = models(tmp_path / "models", "rl"), tmp_path / "out"
    assert run(root, out, suite, "--rows", "score,async,words") == code
    assert bench.ran == ["rl", "rl-sync", "rl-swapped"]
    page = (out / "findings.md").read_text()
    assert "SR of the shipped model" in page
    assert ("* rl-swapped: swapped instructions: expected two tasks" in page) == (code == EXIT_DONE)


@pytest.mark.slow
def test_the_suite_that_training_writes_is_taken(tmp_path: Path, capsys: Any) -> None:
    suite = write_suite(tmp_path / "evaluate", EvaluateConfig(episodes=2, kinds={"corridor": 1.0}))
    root = models(tmp_path / "models", "rl")
    assert run(root, tmp_path / "out", suite, "--dry-run") == EXIT_DONE
    found = capsys.readouterr().err
    assert "runs of 2 episodes" in found and "not run: row wordings: the episodes' wordings have training" in found
    episodes = load_suite(suite)
    assert {load_scene(each.scene).name for each in episodes} == {Path(each.scene).stem for each in episodes}
    for name in ("rl-swapped", "rl-training-words"):
        conditions = RUNS[name].conditions(root, TWO_S)
        other = reworded(episodes, conditions, lambda: load_suite(suite))
        assert all(a.instructions != b.instructions for a, b in zip(episodes, other, strict=True))


def test_a_suite_of_other_numbers_is_not_taken_for_this_one(tmp_path: Path) -> None:
    few = EvaluateConfig(episodes=1, kinds={"corridor": 1.0})
    path = write_suite(tmp_path, few)
    before = path.stat().st_mtime_ns
    assert write_suite(tmp_path, replace(few, latency_s=1.0)) == path and path.stat().st_mtime_ns == before
    with pytest.raises(TrainError, match="delete"):
        write_suite(tmp_path, replace(few, episodes=2))


def test_a_dry_run_leaves_nothing(tmp_path: Path, suite: Path, capsys: Any) -> None:
    root, out = models(tmp_path / "models", "rl"), tmp_path / "out"
    assert run(root, out, suite, "--dry-run") == EXIT_DONE
    assert "runs of 30 episodes" in capsys.readouterr().err and not out.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--rows", "nothing"), "--rows nothing"),
        (("--latency", "soon"), "--latency 'soon'"),
        (("--episodes", "zoo-*"), "none matches"),
        (("--rows", "offset"), "no artifacts"),
    ],
)
def test_bad_arguments_are_one_line(
    arguments: tuple[str, ...], message: str, tmp_path: Path, suite: Path, capsys: Any
) -> None:
    assert run(models(tmp_path / "models", "rl"), tmp_path / "out", suite, *arguments) == EXIT_BAD_INPUT
    found = capsys.readouterr().err
    assert message in found and found.count("\n") == 1
