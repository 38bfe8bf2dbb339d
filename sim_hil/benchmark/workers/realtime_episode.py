"""One episode of the benchmark in real time: edge-hil, edge-bridge and edge-run drive it, ground truth judges it.

The record and its 30 Hz trajectory are as in lockstep. But delays are those of this machine, and results are not
reproducible.
"""

from __future__ import annotations

import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from edge.core.geometry import SE2
from edge.flightlog.reader import RecordingError, jpeg_bytes, read_messages
from edge.flightlog.schemas import SCHEMAS
from firmware_bridge.system.input_file import read_json
from sim_hil.benchmark.conditions.conditions import Conditions, ConditionsError
from sim_hil.benchmark.conditions.variants import artifact_directory
from sim_hil.benchmark.env.metrics import FRAME_HZ, is_success, measure
from sim_hil.benchmark.results.flight import EpisodeFlight
from sim_hil.benchmark.results.record import EpisodeLog, EpisodeResult
from sim_hil.benchmark.suite.episode import Episode
from sim_hil.benchmark.workers.task import EpisodeTask, episode_result
from sim_hil.layouts.scenes import open_scene
from sim_hil.realtime.robots import GO2, ROBOTS, StackRobot, free_domain
from sim_hil.realtime.stack import Stack, StackOptions
from sim_hil.realtime.truth import TruePose, TruthTail, read_lines

ARM_TIMEOUT_S: Final = 90.0
POLL_S: Final = 0.05
FOLDER: Final = "realtime"
_TRUTH_NS: Final = 100_000_000
"""Time between two truths in the flight log, ns: one a tick, as in lockstep."""

OnTime = Callable[[float], None]


def check_realtime(conditions: Conditions, *, jobs: int, cluster: bool, video: str) -> None:
    """Check that the options are compatible with this clock. Raises ConditionsError."""
    wrong = (
        (conditions.policy.kind != "artifacts", "--policy artifacts:DIR, because edge-run drives"),
        (conditions.latency is not None, "no --latency: it is this machine's own"),
        (conditions.camera != "auto", "no --camera: it is the simulated robot's own"),
        (jobs != 1 or cluster, "--jobs 1 and no --cluster: parallel episodes would slow each other down"),
        (video != "none", "no --video: the flight logs below realtime/ contain the images"),
    )
    for fails, expected in wrong:
        if fails:
            raise ConditionsError(f"--clock realtime: expected {expected}")


def drivable(episodes: Sequence[Episode], robot: StackRobot) -> tuple[list[Episode], list[str]]:
    """Return the episodes of this robot's body, and the ids of the others."""
    return (
        [episode for episode in episodes if episode.robot == robot.hil_robot],
        [episode.id for episode in episodes if episode.robot != robot.hil_robot],
    )


@dataclass
class RealtimeDrive:
    """Ground truth recorded during the episode."""

    poses: list[TruePose] = field(default_factory=list)
    end: str = "stopped"
    collisions: set[str] = field(default_factory=set)
    first_collision_s: float | None = None
    time_s: float = 0.0


def run_realtime(task: EpisodeTask, on_time: OnTime) -> EpisodeResult:
    """Run one episode. Raises StepError when a process of the stack fails, ConditionsError for another robot."""
    started_ns = time.monotonic_ns()
    episode, conditions = task.episode, task.conditions
    robot = ROBOTS[conditions.robot or GO2.name]
    if episode.robot != robot.hil_robot:
        raise ConditionsError(f"episode {episode.id}: expected the robot {robot.hil_robot}, found {episode.robot}")
    folder = task.folder / FOLDER / episode.id
    shutil.rmtree(folder, ignore_errors=True)  # left by a previous attempt
    folder.mkdir(parents=True)
    options = StackOptions(
        folder=folder,
        artifacts=artifact_directory(Path(conditions.policy.where), conditions.variant),
        scene=episode.scene,
        start=episode.start,
        people=episode.people,
        seed=episode.seed,
        domain=free_domain(),
        robot=robot,
        mode=conditions.mode or "async",
        odometry_noise=conditions.drift,
        switches=conditions.switches,
        live=task.live,
        pose_hz=FRAME_HZ,
    )
    with _asked_to_end(), Stack(options) as stack:
        drive = _run(stack, task, on_time)
        stack.end("runner")
        stack.end("bridge")
        stack.end("robot")
    fell = bool(_json(stack.result("edge-hil")).get("fell", False))
    if fell and drive.end != "reached":
        drive.end = "fell"
    outcome = measure(
        episode,
        np.array([(pose.x_m, pose.y_m, pose.theta_rad) for pose in drive.poses], float),
        end=drive.end,
        time_s=drive.time_s,
        collisions=tuple(sorted(drive.collisions)),
        first_collision_s=drive.first_collision_s,
        fell=fell,
    )
    log, generations = _log(stack, drive.poses)
    log.write(task.log_path, generations, _last_people(stack.trace), episode.goal_xy)
    if task.flights != "none":
        episode_flight(stack, task, drive.poses).settle(task.flights, outcome, task.folder)
    stopped_by = next(iter(_json(stack.result("edge-run-1")).get("faults", [])), "") if drive.end == "stopped" else ""
    return episode_result(
        task, outcome, log, generations=len(generations), stopped_by=str(stopped_by), started_ns=started_ns
    )


@contextmanager
def _asked_to_end() -> Iterator[None]:
    """Let SIGTERM, which ends a worker, unwind the stack: first the runner, then the rest."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def unwind(number: int, _frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    before = signal.signal(signal.SIGTERM, unwind)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _run(stack: Stack, task: EpisodeTask, on_time: OnTime) -> RealtimeDrive:
    """Start the stack and record the robot until the episode is over; its time starts when the robot is armed."""
    stack.start_robot(lambda: None)
    stack.start_bridge(lambda: None)
    runner = stack.start_runner(task.instruction)
    deadline_ns = time.monotonic_ns() + round(ARM_TIMEOUT_S * 1e9)
    while not stack.armed():
        stack.check()
        if not runner.running:
            raise runner.failure(f"refused to drive, exit code {runner.process.returncode}")
        if time.monotonic_ns() > deadline_ns:
            raise runner.failure(f"not armed within {ARM_TIMEOUT_S:g} s")
        time.sleep(POLL_S)
    tail, drive = TruthTail(stack.trace), RealtimeDrive()
    before = tail.update()
    drive.poses = before[-1:]
    while not drive.poses:
        time.sleep(POLL_S)
        drive.poses = tail.update()[:1]
    while runner.running:
        stack.check()
        for pose in tail.update():
            if is_over(drive, pose, task.episode):
                return drive
        on_time(drive.time_s)
        time.sleep(POLL_S)
    return drive


def is_over(drive: RealtimeDrive, pose: TruePose, episode: Episode) -> bool:
    drive.poses.append(pose)
    drive.time_s = (pose.t_ns - drive.poses[0].t_ns) / 1e9
    if pose.touching and drive.first_collision_s is None:
        drive.first_collision_s = drive.time_s
    drive.collisions.update(pose.touching)
    if is_success((pose.x_m, pose.y_m), episode.goal_xy, episode.threshold_m):
        drive.end = "reached"
    elif drive.time_s >= episode.timeout_s:
        drive.end = "timeout"
    else:
        return False
    return True


def _log(stack: Stack, poses: Sequence[TruePose]) -> tuple[EpisodeLog, list[Mapping[str, Any]]]:
    """Read one row per tick and the generations within the episode from the flight log."""
    log = EpisodeLog()
    generations: list[Mapping[str, Any]] = []
    at = np.array([pose.t_ns for pose in poses], np.int64)
    columns = [np.array([getattr(pose, name) for pose in poses]) for name in ("x_m", "y_m", "theta_rad")]
    columns[2] = np.unwrap(columns[2])
    T_odom_start: SE2 | None = None
    try:
        for topic, _, record in read_messages(stack.flight_log(1)):
            if topic == "/semantic" and record["ready_ns"] <= at[-1]:
                generations.append(_generation(record, int(at[0])))
            elif topic == "/tick" and record["pose"] is not None and at[0] <= record["now_ns"] <= at[-1]:
                T_odom_base = SE2(*record["pose"])
                T_odom_start = T_odom_start or T_odom_base
                truth = SE2(*(float(np.interp(record["now_ns"], at, column)) for column in columns))
                moved = T_odom_start.inverse() @ T_odom_base
                time_s = (record["now_ns"] - int(at[0])) / 1e9
                log.add(time_s, truth, moved, tuple(record["command"]), record["delay_s"])
    except (OSError, RecordingError):
        pass  # the runner ended before its first record; keep the rows read so far
    return log, generations


def episode_flight(stack: Stack, task: EpisodeTask, poses: Sequence[TruePose]) -> EpisodeFlight:
    """Read the flight log of the episode from the runner's and from the trace of the robot's side."""
    flight = EpisodeFlight(task.flight_path, open_scene(task.episode.scene), task.episode)
    begin_ns, end_ns = poses[0].t_ns, poses[-1].t_ns
    try:
        for topic, stamp_ns, record in read_messages(stack.flight_log(1)):
            ours = topic in SCHEMAS and topic not in ("/truth", "/result")
            if not ours or (topic != "/run" and stamp_ns > end_ns):
                continue
            flight.put(topic, stamp_ns, jpeg_bytes(record) if topic == "/camera" else record)
    except (OSError, RecordingError, ValueError):
        pass  # the runner ended before its first record, or the log is damaged; keep what was read
    people, due_ns = np.empty((0, 3)), begin_ns
    for line in read_lines(stack.trace):
        if line.get("kind") == "people":
            people = np.array(line["poses"], float).reshape(-1, 3)
        elif line.get("kind") == "pose" and due_ns <= line["t_ns"] <= end_ns:
            due_ns = line["t_ns"] + _TRUTH_NS
            flight.see(line["t_ns"], SE2(line["x"], line["y"], line["theta"]), people, line["touching"])
    return flight


def _generation(record: Mapping[str, Any], begin_ns: int) -> dict[str, Any]:
    """Return a generation in the format of lockstep, with times since the episode began, s."""
    times = {
        "started_s": record["started_ns"],
        "anchor_s": record["anchor_ns"],
        "released_s": record["ready_ns"],
    }
    return {
        "generation": record["generation"],
        **{name: round((stamp_ns - begin_ns) / 1e9, 4) for name, stamp_ns in times.items()},
        "text": record["text"],
        "waypoints": record["waypoints"],
    }


def _last_people(trace: Path) -> NDArray[np.float64]:
    last: list[list[float]] = []
    for line in read_lines(trace):
        if line.get("kind") == "people":
            last = line["poses"]
    return np.array(last, float).reshape(-1, 3)


def _json(path: Path) -> dict[str, Any]:
    try:
        content = read_json(path)
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
