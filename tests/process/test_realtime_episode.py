"""The benchmark's episodes in real time: what goes with that clock, and when an episode is over."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from edge.flightlog.explain.flight import read_flight
from edge.live.options import LiveOptions
from sim_hil.benchmark.conditions.conditions import Conditions, ConditionsError, PolicySpec
from sim_hil.benchmark.conditions.latency import LatencyProfile
from sim_hil.benchmark.env.metrics import FRAME_HZ, Outcome
from sim_hil.benchmark.suite.episode import Episode, load_suite
from sim_hil.benchmark.workers import realtime_episode as realtime
from sim_hil.benchmark.workers.realtime_episode import check_realtime, drivable
from sim_hil.benchmark.workers.task import EpisodeTask
from sim_hil.realtime.children import Child, Children, StepError
from sim_hil.realtime.robots import ROBOTS
from sim_hil.realtime.stack import Stack, StackOptions
from sim_hil.realtime.truth import TruePose
from tests.support.benchmark import dynanav_fakes as fakes
from tests.support.runner import explained_flights as flights

POLICY = PolicySpec("artifacts", "out/nano")
GOOD = Conditions(POLICY, clock="realtime", mode="async", robot="go2")
ALONE = {"jobs": 1, "cluster": False, "video": "none"}
S = 1_000_000_000


def test_artifacts_on_one_stack_at_a_time_are_accepted() -> None:
    check_realtime(GOOD, jobs=1, cluster=False, video="none")


@pytest.mark.parametrize(
    ("conditions", "named"),
    [
        (Conditions(PolicySpec("expert"), clock="realtime", robot="go2"), "--policy"),
        (
            Conditions(POLICY, clock="realtime", mode="async", robot="go2", latency=LatencyProfile.constant(2.0)),
            "--latency",
        ),
        (Conditions(POLICY, clock="realtime", mode="async", robot="go2", camera="128x128"), "--camera"),
    ],
)
def test_conditions_that_need_virtual_time_are_refused(conditions: Conditions, named: str) -> None:
    with pytest.raises(ConditionsError, match=named):
        check_realtime(conditions, jobs=1, cluster=False, video="none")


@pytest.mark.parametrize("jobs, cluster, video", [(2, False, "none"), (1, True, "none"), (1, False, "all")])
def test_options_that_disturb_the_clock_are_refused(jobs: int, cluster: bool, video: str) -> None:
    with pytest.raises(ConditionsError, match="--clock realtime"):
        check_realtime(GOOD, jobs=jobs, cluster=cluster, video=video)


@pytest.mark.parametrize(("robot", "body", "other"), [("go2", "go2", "carter"), ("carter-can", "carter", "go2")])
def test_episodes_of_another_body_are_left_out_by_name(robot: str, body: str, other: str) -> None:
    suite = load_suite("dynanav")
    kept, skipped = drivable(suite, ROBOTS[robot])
    assert {episode.robot for episode in kept} == {body}
    assert len(kept) + len(skipped) == len(suite) and all(other in name for name in skipped)


def test_a_robot_is_named_with_real_time_alone() -> None:
    with pytest.raises(ConditionsError, match="robot: expected one with clock realtime"):
        Conditions(POLICY, clock="realtime", mode="async")
    with pytest.raises(ConditionsError, match="robot: expected one with clock realtime"):
        Conditions(PolicySpec("expert"), robot="go2")


def test_a_result_in_real_time_from_before_there_were_other_robots_is_the_go2s() -> None:
    content = GOOD.as_json()
    del content["robot"]
    assert Conditions.of_json(content).robot == "go2"


def episode() -> Episode:
    return next(one for one in load_suite("dynanav") if one.robot == "go2")


def followed(*poses: TruePose) -> realtime.RealtimeDrive:
    drive = realtime.RealtimeDrive([poses[0]])
    for pose in poses[1:]:
        if realtime.is_over(drive, pose, episode()):
            break
    return drive


def test_an_episode_is_reached_by_ground_truth() -> None:
    goal = episode().goal_xy
    drive = followed(TruePose(0, 0, 0, 0, ()), TruePose(S, goal[0] + 1.4, goal[1], 0, ()), TruePose(2 * S, 0, 0, 0, ()))
    assert (drive.end, drive.time_s) == ("reached", 1.0)


def test_the_episode_ends_at_its_timeout() -> None:
    end_ns = round(episode().timeout_s * S)
    drive = followed(TruePose(0, -50, 0, 0, ()), TruePose(end_ns - 1, -50, 0, 0, ()), TruePose(end_ns, -50, 0, 0, ()))
    assert drive.end == "timeout" and len(drive.poses) == 3


def test_the_first_contact_is_remembered() -> None:
    touches = [(), ("wall 1",), (), ("person",)]
    drive = followed(*(TruePose(t * S, -50, 0, 0, touching) for t, touching in enumerate(touches)))
    assert drive.collisions == {"wall 1", "person"} and drive.first_collision_s == 1.0


def test_the_true_path_is_sampled_as_in_lockstep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def start(_children: Children, step: str, command: Sequence[str], **_: object) -> Child:
        asked.extend(command)
        raise StepError(step)

    monkeypatch.setattr(Children, "start", start)
    task = EpisodeTask(episode(), GOOD, tmp_path)
    with pytest.raises(StepError, match="edge-hil"):
        realtime.run_realtime(task, lambda _seconds: None)
    assert asked[asked.index("--pose-hz") + 1] == str(FRAME_HZ)


def test_the_runner_of_an_episode_serves_the_live_view_of_the_benchmark(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    live = LiveOptions(port=8770, token_file=tmp_path / "token")
    task = EpisodeTask.of_json(json.loads(json.dumps(EpisodeTask(episode(), GOOD, tmp_path, live=live).as_json())))
    assert task.live == live
    asked: list[str] = []

    def start(_children: Children, step: str, command: Sequence[str]) -> Child:
        asked.extend(command)
        raise StepError(step)

    monkeypatch.setattr(Children, "start", start)
    monkeypatch.setattr(Stack, "start_robot", lambda *_: None)
    monkeypatch.setattr(Stack, "start_bridge", lambda *_: None)
    with pytest.raises(StepError, match="edge-run"):
        realtime.run_realtime(task, lambda _seconds: None)
    at = asked.index("--live")
    assert asked[at : at + 6] == live.arguments()


class EndedStack:
    """What a stack leaves: the runner's flight log of 12 s, and a trace with 30 poses a second."""

    def __init__(self, folder: Path) -> None:
        self._log, self.trace = folder / "flight.mcap", folder / "trace.jsonl"
        flights.write(self._log)
        lines: list[dict[str, Any]] = [{"t_ns": flights.at(0.0), "kind": "people", "poses": [[3.0, 0.0, 0.0]]}]
        for step in range(360):
            pose = {"x": step / 60, "y": 0.0, "theta": 0.0, "touching": ["plant"] if step == 90 else []}
            lines.append({"t_ns": flights.at(step / 30), "kind": "pose", **pose})
        self.trace.write_text("".join(json.dumps(line) + "\n" for line in lines))

    def flight_log(self, _number: int) -> Path:
        return self._log


def test_an_episode_is_explained_from_the_runners_records_and_the_truth(tmp_path: Path) -> None:
    here = replace(fakes.episode("a"), scene="corridor", goal_xy=(13.0, 0.6))
    task = EpisodeTask(here, GOOD, tmp_path)
    poses = [TruePose(flights.at(second), 0.0, 0.0, 0.0, ()) for second in (1.0, 10.0)]
    flight = realtime.episode_flight(EndedStack(tmp_path), task, poses)  # type: ignore[arg-type]
    outcome = Outcome("a", False, "timeout", 7.0, 0.0, False, (), None, False, 1.0, 12.0, 60.0, "0" * 64)
    flight.settle("failed", outcome, tmp_path)
    found = read_flight(task.flight_path)
    assert found.last_tick_ns == flights.at(10.0) and len(found.frames_ns) == 101
    assert (found.truths[0].stamp_ns, len(found.truths)) == (flights.at(1.0), 91)
    assert found.truths[0].people == ((3.0, 0.0),) and any(truth.touching == ("plant",) for truth in found.truths)
    assert found.result["end"] == "timeout"


def test_a_speed_limit_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="speed limit"):
        StackOptions(tmp_path, tmp_path, "office", (0.0, 0.0, 0.0), 0, 0, 1, speed_limit_mps=0.0)
