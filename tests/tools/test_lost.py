"""How soon a lost robot notices it: stretches, what a detector reads, its ROC curve, and the command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED
from edge.state.reasoning_text import Plan, Progress, ReasoningText, Stop, Turn, TurnBack
from tests.support.benchmark import dynanav_fakes as fakes
from tools.findings import lost
from tools.findings.lost_detector import (
    FEATURES,
    area_under_roc,
    detector_figures,
    detector_scores,
    features,
    fit,
    threshold_at,
)
from tools.findings.lost_instants import LOST_M, Instant, deviations, instants_of
from tools.findings.split_worker import result_path, scenario_of


def text(step: int = 1, plan: Turn | Stop | TurnBack | None = None, passed: int = 0) -> ReasoningText:
    return ReasoningText(progress=Progress(step, 2, passed), plan=Plan(plan or Turn("left", "room", 4)))


def instant(
    time_s: float, *, strayed_m: float = 0.0, said: ReasoningText | None = None, driven_m: float = 0.0
) -> Instant:
    return Instant(time_s, driven_m, 0.0, said or text(), False, False, True, strayed_m)


AWAY = LOST_M + 1.0
BACK = text(plan=TurnBack())


def test_a_robot_is_lost_off_its_route_and_where_the_true_plan_is_to_turn_back() -> None:
    assert instant(0.0, strayed_m=AWAY).lost and replace(instant(0.0), true_back=True).lost
    assert not instant(0.0, strayed_m=LOST_M).lost


def test_each_deviation_has_its_times_to_the_text_that_notices_it_and_to_the_route() -> None:
    first, second = deviations(
        [
            instant(0.0), instant(2.0, strayed_m=AWAY), instant(4.0, strayed_m=AWAY, said=BACK),
            instant(6.0, said=BACK), instant(8.0, strayed_m=AWAY),
        ]
    )  # fmt: skip
    assert (first.begin_s, first.noticed_s, first.back_s) == (2.0, 2.0, 4.0)
    assert (second.begin_s, second.noticed_s, second.back_s) == (8.0, None, None)
    assert not first.contains(instant(6.0)) and first.contains(instant(4.0)) and second.contains(instant(9.0))


def test_a_turn_that_does_not_come_nearer_is_read_as_receding_and_then_as_overdue() -> None:
    said = text(plan=Turn("left", "room", 4))
    rows = features([instant(2.0 * k, said=said, driven_m=2.0 * k) for k in range(4)])
    overdue, receding = (rows[:, FEATURES.index(name)] for name in ("overdue", "receding"))
    assert receding.tolist() == [0.0, 2.0, 4.0, 6.0] and overdue.tolist() == [-4.0, -2.0, 0.0, 2.0]


def test_a_turn_that_comes_nearer_as_the_robot_drives_is_not_receding() -> None:
    rows = features([instant(k, said=text(plan=Turn("left", "room", 8 - 2 * k)), driven_m=2.0 * k) for k in range(4)])
    assert not rows[:, FEATURES.index("receding")].any()


def test_the_features_of_an_instant_do_not_depend_on_later_ones() -> None:
    some = [instant(2.0 * k, said=text(1 + k // 3, passed=0), driven_m=k) for k in range(6)]
    assert np.array_equal(features(some)[:4], features(some[:4]))


def test_the_area_under_the_curve_counts_pairs_and_halves_ties() -> None:
    labels = np.array([False, False, True, True])
    assert area_under_roc(np.array([0.0, 1.0, 2.0, 3.0]), labels) == 1.0
    assert area_under_roc(np.zeros(4), labels) == 0.5
    assert area_under_roc(np.array([0.0, 2.0, 1.0, 3.0]), labels) == 0.75
    assert area_under_roc(np.zeros(4), np.zeros(4, bool)) is None


@pytest.mark.parametrize("share", [0.0, 0.01, 0.1, 0.5])
def test_a_threshold_holds_the_share_of_false_alarms(share: float) -> None:
    scores, labels = np.arange(100.0), np.zeros(100, bool)
    assert np.mean(scores > threshold_at(scores, labels, share)) <= share


def test_a_regression_finds_the_column_that_decides() -> None:
    rng = np.random.default_rng(1)
    rows = rng.normal(size=(400, 3))
    labels = rows[:, 1] + 0.1 * rng.normal(size=400) > 0.5
    assert (area_under_roc(fit(rows, labels)(rows), labels) or 0.0) > 0.99


def test_an_episode_is_scored_by_weights_that_have_not_seen_it() -> None:
    """Labels without a rule are learned by heart, and give no more than chance elsewhere."""
    rng = np.random.default_rng(2)
    rows = [rng.normal(size=(1, 40)) for _ in range(40)]
    labels = [np.array([bool(k % 2)]) for k in range(40)]
    own = fit(np.concatenate(rows), np.concatenate(labels))(np.concatenate(rows))
    others = np.concatenate(detector_scores(rows, labels))
    assert (area_under_roc(own, np.concatenate(labels)) or 0.0) > 0.95
    assert 0.2 < (area_under_roc(others, np.concatenate(labels)) or 0.0) < 0.8


def test_texts_that_say_so_make_a_good_detector_and_its_alarms_have_times() -> None:
    episode = [instant(2.0 * k, strayed_m=AWAY * (k > 4), said=BACK if k > 5 else text()) for k in range(10)]
    found = detector_figures([episode] * 10)
    assert found is not None and found["area_under_roc"] > 0.85 and found["alarms"] == 10
    assert 0.0 <= found["alarm_s_median"] <= 2.0 and set(found["weights"]) == set(FEATURES)


def test_without_a_lost_robot_there_is_no_detector() -> None:
    assert detector_figures([[instant(0.0)]]) is None


def test_the_page_gives_every_figure() -> None:
    episode = [instant(2.0 * k, strayed_m=AWAY * (k > 4), said=BACK if k > 5 else text()) for k in range(10)]
    content = lost.figures([episode] * 10)
    assert (content["lost"], content["deviations"], content["noticed"]) == (50, 10, 10)
    assert content["back_recall"] == 0.8 and content["back_precision"] == 1.0 and content["noticed_s_median"] == 2.0
    page = lost.markdown(content)
    assert "| lost at | 50 generations |" in page and "10; 10, 2.0 s" in page and "recall at 5% false alarms" in page


@pytest.mark.slow
def test_the_truth_of_a_robot_at_its_start_is_its_first_turn_and_it_is_not_lost() -> None:
    scenario = scenario_of(3)
    x, y, theta = scenario.episode.start
    columns = {"time_s": [0.0], "x_m": [x], "y_m": [y], "theta_rad": [theta], "odom_x_m": [0.0], "odom_y_m": [0.0]}
    said = "Progress: turn 1 of 1, passed 0.\nPlan: turn back."
    log = {"columns": columns, "generations": [{"anchor_s": 0.0, "text": said, "overruled": False}]}
    (found,) = instants_of(log, scenario)
    assert not found.lost and found.says_back and found.strayed_m < LOST_M


def test_a_split_without_episodes_is_a_failure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert lost.main(["--split", str(tmp_path)]) == EXIT_CHECK_FAILED
    assert capsys.readouterr().err.count("\n") == 1


def test_an_episode_whose_log_is_gone_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = result_path(tmp_path, "ours", 0)
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(fakes.result("e0").as_json()))
    assert lost.main(["--split", str(tmp_path)]) == EXIT_BAD_INPUT
    found = capsys.readouterr().err
    assert "e0.json" in found and found.count("\n") == 1
