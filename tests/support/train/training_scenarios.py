"""A few training scenarios of every kind, drawn once for all tests."""

from __future__ import annotations

import itertools
from functools import cache
from math import atan2, hypot

import numpy as np

from edge.core.geometry import SE2
from tests.support.train.train_drives import made_up_drive
from tools.train.config.collect import KINDS
from tools.train.drives.drive import Drive
from tools.train.drives.progress_labels import RouteProgress
from tools.train.drives.scenarios import Scenario, scenario_group
from tools.train.drives.trace_sentences import NO_OBJECTS, NO_PEOPLE, aspects_json
from tools.train.drives.traces import Tracer

SEED = 5
SPEED_MPS = 0.8
_NO_PEOPLE = (np.zeros((0, 2)), np.zeros((0, 2)))
EACH = {"hospital": 2, "office": 2, "warehouse": 2, "sidewalk": 1, "corridor": 2}


@cache
def scenarios(kind: str) -> tuple[Scenario, ...]:
    """Some of one kind, all of one layout as a rule."""
    return tuple(scenario_group(SEED, KINDS.index(kind), {kind: 1.0}, EACH[kind]))


def all_scenarios() -> tuple[Scenario, ...]:
    """Those of every kind."""
    return tuple(scenario for kind in KINDS for scenario in scenarios(kind))


@cache
def progress_of(scenario: Scenario) -> RouteProgress:
    """Worked out once for each."""
    return RouteProgress(scenario)


def _poses_along(scenario: Scenario) -> np.ndarray:
    """[N, 3]: along the told way at SPEED_MPS, looking along it."""
    poses = []
    for a, b in itertools.pairwise(scenario.task.path):
        length, heading = hypot(b[0] - a[0], b[1] - a[1]), atan2(b[1] - a[1], b[0] - a[0])
        count = max(1, round(length / (SPEED_MPS / 10)))
        poses += [(a[0] + (b[0] - a[0]) * k / count, a[1] + (b[1] - a[1]) * k / count, heading) for k in range(count)]
    poses[0] = scenario.task.start
    return np.array(poses)


def drive_along(scenario: Scenario, drive_id: str = "a", *, motion: str = NO_PEOPLE) -> Drive:
    """Along the told way with what a tracer says of it, for the next 3 s straight ahead."""
    poses = _poses_along(scenario)
    tracer, traces = Tracer(scenario, progress_of(scenario)), []
    for k in range(0, len(poses), 10):
        pose = SE2(*map(float, poses[k]))
        said = {**aspects_json(tracer.trace(pose, *_NO_PEOPLE, [(2.4, 0.0)])), "off_m": tracer.off_m(pose)}
        things = said["objects"] if motion == NO_PEOPLE else NO_OBJECTS  # for both there is no room
        traces.append({"k": k, **said, "objects": things, "motion": motion})
    plain = made_up_drive(
        drive_id, len(poses), layout_seed=scenario.layout_seed, kind=scenario.kind, scene=scenario.scene.name,
        robot=scenario.episode.robot, goal_xy=scenario.episode.goal_xy, threshold_m=scenario.episode.threshold_m,
        wordings=scenario.wordings, told=tuple(scenario.steps_json()), traces=tuple(traces),
    )  # fmt: skip
    state = np.zeros((len(poses), 3), np.float32)
    state[:, 0] = SPEED_MPS
    odometry = poses + np.array((7.0, -3.0, 0.0))
    arrays = {name: getattr(plain, name) for name in ("jpeg", "jpeg_end", "future", "future_steps", "plan_xy", "by")}
    return Drive(about=plain.about, pose=poses, pose_odom=odometry, state=state, **arrays)
