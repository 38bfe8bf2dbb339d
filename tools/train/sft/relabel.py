"""Relabelling of drives and tours with instructions for other goals: other routes from the same start, true texts.

A drive follows one of many routes that its first images allow. A model that sees every corridor with one instruction
memorises the corridor and its turn; with several instructions it must read them. Behind the point where the drive
leaves the other route, the relabelled drive shows a missed turn. Only texts are relabelled, and only where no person is
near: the people's positions are not recorded, so occlusion and avoidance on the other route are unknown.

Relabels are JSON files, one for each drive, in a folder named by the hash of their configuration. They are written
atomically, so that an interrupted build continues with the next drive.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from math import hypot
from pathlib import Path
from typing import Any, Final
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from edge.core.cli import write_whole
from edge.state.reasoning_text import ReasoningText
from sim_hil.benchmark.language.route import RouteError
from sim_hil.benchmark.language.tasks import begins_ahead, make_task
from sim_hil.benchmark.policies.expert import NEAR, along, driving_of, from_here
from sim_hil.benchmark.policies.expert_route import RoutePlanner
from sim_hil.layouts import LayoutError
from sim_hil.scene.scene import SceneObject, Vec3
from tools.train.config.checks import TrainError
from tools.train.config.collect import TRACE_EVERY
from tools.train.config.sft import RelabelConfig
from tools.train.drives.drive import PLAN_TIMES_S, Dataset, Drive, Entry
from tools.train.drives.progress_labels import RouteProgress
from tools.train.drives.scenarios import Scenario, ScenarioError, Site, SiteError, is_sound, scenario_of
from tools.train.drives.trace_sentences import NO_PEOPLE, aspects_json, aspects_of_json, five_aspects
from tools.train.drives.traces import Sight, Tracer, turning_first
from tools.train.run.distributed import SINGLE, Ranks
from tools.train.run.job import QuietProgress, StageProgress
from tools.train.samples.anchors import Anchor, anchors_of

FOLDER: Final = "retold"
FORMAT: Final = 3
LEAST_FRAMES: Final = 50
"""Shortest useful relabel, frames."""
_APART_M: Final = 2.0  # smallest distance between two goals
_FREE: Final = 0.9  # least share of a drive's poses on free floor if the scene is unchanged; policies touch walls
_ARRIVE_SHARE: Final = 0.7  # share of the success distance at which a relabel ends, as drives do
_REACH_M: Final = 10.0  # planned length of a route: 9 s of driving
_TAG: Final = 0x2E7E11


@dataclass(frozen=True)
class InstructionRelabel:
    """Another instruction for the first N frames of a drive.

    `told`: steps of its route; `plan_xy` [N, 3, 2]: positions on it in 3, 6 and 9 s, m in the robot frame; `traces`:
    one per second.
    """

    wordings: tuple[str, ...]
    told: tuple[dict[str, Any], ...]
    goal_xy: tuple[float, float]
    plan_xy: NDArray[np.float32]
    traces: tuple[dict[str, Any], ...]

    def __len__(self) -> int:
        return len(self.plan_xy)

    def of(self, drive: Drive) -> Drive:
        """Return the relabelled drive, without action labels and images."""
        count = len(self)
        about = replace(
            drive.about, wordings=self.wordings, told=self.told, goal_xy=self.goal_xy, traces=self.traces
        )  # fmt: skip
        return Drive(
            about=about,
            jpeg=np.zeros(0, np.uint8),
            jpeg_end=drive.jpeg_end[:count],
            pose=drive.pose[:count],
            pose_odom=drive.pose_odom[:count],
            state=drive.state[:count],
            future=np.zeros_like(drive.future[:count]),
            future_steps=np.zeros_like(drive.future_steps[:count]),
            plan_xy=self.plan_xy,
            by=drive.by[:count],
        )

    def as_json(self) -> dict[str, Any]:
        """Return the content that `of_json` reads."""
        plan = [[[round(float(v), 3) for v in point] for point in frame] for frame in self.plan_xy]
        return {**asdict(self), "plan_xy": plan}

    @staticmethod
    def of_json(content: dict[str, Any]) -> InstructionRelabel:
        """Build the relabel that `as_json` wrote. Raises KeyError, TypeError, ValueError."""
        x, y = content["goal_xy"]
        lists = {name: tuple(content[name]) for name in ("wordings", "told", "traces")}
        plan = np.array(content["plan_xy"], np.float32).reshape(-1, len(PLAN_TIMES_S), 2)
        return InstructionRelabel(goal_xy=(float(x), float(y)), plan_xy=plan, **lists)


class InstructionRelabels:
    """Relabels of a data set's drives with one configuration."""

    def __init__(self, dataset: Dataset, config: RelabelConfig, seed: int, speed_mps: float) -> None:
        """Open the existing relabels; `build` computes missing ones. `speed_mps`: the expert's speed."""
        per_drive = {"ways": config.ways, "tries": config.tries, "off_m": config.off_m}
        per_drive |= {"turned": True} if config.turned else {}
        numbers = {"format": FORMAT, "seed": seed, "speed_mps": speed_mps, **per_drive}
        self.key = hashlib.sha256(json.dumps(numbers, sort_keys=True).encode()).hexdigest()
        self.folder = dataset.folder / FOLDER / self.key[:16]
        self._dataset, self._config, self._seed, self._speed_mps = dataset, config, seed, speed_mps
        self._entries = {entry.id: entry for entry in dataset.entries}

    def build(
        self, ids: Sequence[str], *, ranks: Ranks = SINGLE, progress: StageProgress | None = None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:  # fmt: skip
        """Compute the missing relabels of these drives. Ranks share the layouts; all must call this function.

        Raises TrainError, OSError, and KeyboardInterrupt when `stopped` on any rank.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        ranks.barrier()
        missing = [self._entries[drive_id] for drive_id in ids if self._read(drive_id) is None]
        ranks.barrier()  # all ranks have checked before any writes
        places: dict[tuple[str, int], list[Entry]] = {}
        for entry in missing:
            places.setdefault((entry.kind, entry.layout_seed), []).append(entry)
        own = [places[place] for place in sorted(places)[ranks.rank :: ranks.world]]
        done, count = 0, sum(map(len, own))
        for entries in own:
            kind, layout_seed = entries[0].kind, entries[0].layout_seed
            site = _site(kind, layout_seed)
            for entry in entries:
                if stopped():
                    break
                drive = self._dataset.load(entry.id, pictures=False)
                found = [] if site is None else relabel(drive, site, self._config, self._seed, self._speed_mps)
                content = {"drive_sha256": entry.sha256, "ways": [each.as_json() for each in found]}
                write_whole(self._path(entry.id), json.dumps(content, separators=(",", ":")) + "\n")
                done += 1
                (progress or QuietProgress()).update(done, count)
        if ranks.any(stopped()):
            raise KeyboardInterrupt

    def anchors(self, drive: Drive) -> list[Anchor]:
        """Return a drive's relabelled anchors without a person near. Raises TrainError before `build`."""
        found = self._read(drive.id)
        if found is None:
            raise TrainError(f"{self._path(drive.id)}: not the relabels of this drive; build them first")
        alone = {int(trace["k"]) for trace in drive.traces if trace["motion"] == NO_PEOPLE}
        return [anchor for each in found for anchor in anchors_of(each.of(drive)) if anchor.k in alone]

    def _read(self, drive_id: str) -> list[InstructionRelabel] | None:
        """Read a drive's relabels; None if there are none, they are damaged, or the drive has changed."""
        try:
            content = json.loads(self._path(drive_id).read_text(encoding="utf-8"))
            found = [InstructionRelabel.of_json(each) for each in content["ways"]]
        except (OSError, KeyError, TypeError, ValueError):
            return None
        return found if content["drive_sha256"] == self._entries[drive_id].sha256 else None

    def _path(self, drive_id: str) -> Path:
        return self.folder / f"{drive_id}.json"


def _site(kind: str, layout_seed: int) -> Site | None:
    """Build the scene; None if it is not a generated training scene."""
    try:
        return Site(kind, layout_seed)
    except (SiteError, LayoutError):
        return None


def relabel(drive: Drive, site: Site, config: RelabelConfig, seed: int, speed_mps: float) -> list[InstructionRelabel]:
    """Relabel a drive for other goals of its scene, in random order; equal arguments give equal relabels."""
    rng = np.random.default_rng((seed, _TAG, crc32(drive.id.encode())))
    things = [site.goals[int(index)] for index in rng.permutation(len(site.goals))[: config.tries]]
    first = drive.T_world_base(0)
    start = (round(first.x_m, 2), round(first.y_m, 2), round(first.theta_rad, 3))
    lines = _Remembered(site.lines)
    found: list[InstructionRelabel] = []
    if not drive.traces or not _was_here(drive, site) or not site.grid.is_free(*start[:2]):
        return found
    for thing in things:
        if len(found) >= config.ways:
            break
        scenario = _to(site, start, thing, drive, int(rng.integers(2**31)), turned=config.turned)
        if scenario is not None and (one := relabel_along(drive, scenario, speed_mps, config.off_m, lines)):
            found.append(one)
    return found


def _was_here(drive: Drive, site: Site) -> bool:
    """Return whether the scene is the one in which the drive was recorded: same name, and no path through walls."""
    free = [site.robot_grid(drive.about.robot).is_free(float(x), float(y)) for x, y, _ in drive.pose[::TRACE_EVERY]]
    return drive.about.scene == site.scene.name and float(np.mean(free)) >= _FREE


def _to(
    site: Site, start: Vec3, thing: SceneObject, drive: Drive, wording_seed: int, *, turned: bool
) -> Scenario | None:
    """Make the task to go from a drive's start to an object; None if it has no instruction, or is the drive's own.

    `turned`: also if its route does not begin ahead of the robot.
    """
    about = drive.about
    try:
        task = make_task(site.scene, site.grid, start, thing)
        gaps = [hypot(task.goal[0] - x, task.goal[1] - y) for x, y in (about.goal_xy, start[:2])]
        if gaps[0] < _APART_M or gaps[1] < site.threshold_m + _APART_M:
            return None
        if not is_sound(site, task) or not (turned or begins_ahead(task)):
            return None
        return scenario_of(site, task, wording_seed, about.robot, about.people, 0, 0)
    except (RouteError, ScenarioError):
        return None


def relabel_along(
    drive: Drive, scenario: Scenario, speed_mps: float, off_m: float, lines: Sight | None = None
) -> InstructionRelabel | None:
    """Relabel a drive with a scenario that has the same start; None if fewer than LEAST_FRAMES frames are usable.

    It ends where the drive is `off_m` from the scenario's route, or has arrived. `lines`: see `Tracer`.
    """
    progress = RouteProgress(scenario)
    count = _shown_frames(drive, scenario, progress, off_m)
    plan = _plans(drive, scenario, speed_mps, count) if count >= LEAST_FRAMES else None
    if plan is None:
        return None
    tracer = Tracer(scenario, progress, lines)
    driving = driving_of(scenario.episode.robot)
    traces = []
    for own in drive.traces:
        k = int(own["k"])
        if k >= count:
            break
        means = [turning_first((float(plan[k, 0, 0]), float(plan[k, 0, 1])), driving.turn_radps, speed_mps)]
        pose = drive.T_world_base(k)
        alone = tracer.trace(pose, np.zeros((0, 2)), np.zeros((0, 2)), means)
        text = _with_people(alone, aspects_of_json(own))
        traces.append({"k": k, **aspects_json(text), "off_m": tracer.off_m(pose)})
    steps = tuple(scenario.steps_json())
    return InstructionRelabel(scenario.wordings, steps, scenario.episode.goal_xy, plan, tuple(traces))


def _with_people(alone: ReasoningText, own: ReasoningText) -> ReasoningText:
    """The text of an instant without people, with situation and people of another text of the same instant."""
    assert own.situation is not None and alone.progress is not None and alone.plan is not None
    return five_aspects(own.situation, alone.objects or (), own.people or (), alone.progress, alone.plan)


def _shown_frames(drive: Drive, scenario: Scenario, progress: RouteProgress, off_m: float) -> int:
    """Count a drive's frames until it arrives at the other goal, or is too far from the route to it."""
    x, y = scenario.episode.goal_xy
    near = np.hypot(drive.pose[:, 0] - x, drive.pose[:, 1] - y) < _ARRIVE_SHARE * scenario.episode.threshold_m
    for k in range(len(drive)):
        if progress.strayed_m(drive.T_world_base(k)) > off_m:
            return k
        if near[k]:
            return k + 1
    return len(drive)


def _plans(drive: Drive, scenario: Scenario, speed_mps: float, count: int) -> NDArray[np.float32] | None:
    """Return positions on the route in 3, 6 and 9 s from every frame [count, 3, 2]; None if the goal is unreachable."""
    episode = scenario.episode
    ground = scenario.site.planner_ground(episode.robot)
    planner = RoutePlanner(ground, episode.goal_xy, NEAR * episode.threshold_m, scenario.task.path)
    driving = replace(driving_of(episode.robot), speed_mps=speed_mps)
    plan = np.zeros((count, len(PLAN_TIMES_S), 2), np.float32)
    route = np.zeros((0, 2))
    for k in range(count):
        pose = drive.T_world_base(k)
        if k % (TRACE_EVERY // 2) == 0:
            if not planner.reachable(pose.x_m, pose.y_m):
                return None
            route = planner.route((pose.x_m, pose.y_m), np.zeros((0, 2)), _REACH_M)
        route = from_here(route, pose)
        plan[k] = along(route, pose, max(float(drive.state[k, 0]), 0.0), driving, PLAN_TIMES_S)
    return plan


class _Remembered:
    """Cache of sightlines, which several relabels of one drive share."""

    def __init__(self, lines: Sight) -> None:
        self._lines = lines
        self._known: dict[tuple[object, ...], float] = {}

    def pixels(self, eye: Vec3, heading_rad: float, thing: SceneObject, range_m: float) -> float:
        """See `Sightlines.pixels`."""
        key = (eye, heading_rad, thing.label, thing.position_m, range_m)
        if key not in self._known:
            self._known[key] = self._lines.pixels(eye, heading_rad, thing, range_m)
        return self._known[key]
