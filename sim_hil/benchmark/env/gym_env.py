"""The benchmark as a Gymnasium environment, `DynaNav-v0`: a reset per episode, a step per control period of 0.1 s.

The reward is the paper's equation 5. The paper names its four terms but does not define them. Our definitions: goal is
1 in the step that reaches it; progress is the decrease of the path length to the goal around obstacles, m; collision is
1 in a step in which a collision begins (`Contacts`); speed is the absolute difference from the target speed, m/s.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from math import hypot, isfinite
from typing import Any, Final

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from edge.core.geometry import SE2
from sim_hil.benchmark.env.observation import Observation
from sim_hil.benchmark.env.world import EpisodeWorld, WorldOptions
from sim_hil.benchmark.suite.episode import Episode, load_suite
from sim_hil.benchmark.suite.robots import robot_grid
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Scene

ENV_ID: Final = "DynaNav-v0"
LOW: Final = (-0.5, -0.35, -1.2)
HIGH: Final = (1.5, 0.35, 1.2)
"""Range of the action: vx m/s, vy m/s, wz rad/s; a robot that cannot move sideways ignores vy."""
MAX_GRIDS: Final = 8
"""Maximum number of navigation grids (one per scene and robot) cached between episodes."""

APART_STEPS: Final = 10
"""Control steps (1 s) without contact after which touching the same object counts as another collision."""

Pictures = NDArray[np.uint8]


@dataclass(frozen=True)
class RewardWeights:
    """Weights w_g, w_p, w_c and w_s of equation 5, and the target speed, m/s."""

    goal: float = 400.0
    progress: float = 5.0
    collision: float = -100.0
    speed: float = -0.1
    target_speed_mps: float = 1.0

    def __post_init__(self) -> None:
        if not all(isfinite(v) for v in (self.goal, self.progress, self.collision, self.speed, self.target_speed_mps)):
            raise ValueError("reward: every weight must be finite")


PAPER = RewardWeights()


class Contacts:
    """Detector of new collisions: repeated contact while scraping along a wall or a person counts once."""

    def __init__(self) -> None:
        self._step = 0
        self._touched: dict[str, int] = {}

    def began(self, touching: Set[str]) -> bool:
        """Return whether a collision begins; call once per control step with the labels of touched objects."""
        self._step += 1
        last = {label: self._touched.get(label) for label in touching}
        self._touched.update(dict.fromkeys(touching, self._step))
        return any(step is None or self._step - step > APART_STEPS for step in last.values())


def reward(
    *,
    reached: bool,
    distance_before_m: float,
    distance_after_m: float,
    collision_began: bool,
    speed_mps: float,
    weights: RewardWeights = PAPER,
) -> float:
    """Return the reward of one control step; distances are path lengths to the goal before and after it, m."""
    return (
        weights.goal * float(reached)
        + weights.progress * (distance_before_m - distance_after_m)
        + weights.collision * float(collision_began)
        + weights.speed * abs(speed_mps - weights.target_speed_mps)
    )


class DynaNavEnv(gymnasium.Env[dict[str, Any], NDArray[np.float32]]):
    """Observations: `image` uint8 [height, width, 3], `state` (vx, vy, wz), `pose` (x, y, theta) and `time`, SI.

    `image` is present only with a camera. `pose` comes from odometry, which drifts as configured. An episode is
    `terminated` at the goal or by a fall, and `truncated` by its timeout. `info` contains the episode's id, its
    instruction, `distance_m` (straight line to the goal) and, at the end, the `outcome`. The reward is the paper's
    equation 5; progress is measured along the shortest feasible path.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 - as Gymnasium types it

    def __init__(
        self,
        suite: str | Sequence[Episode],
        *,
        camera: tuple[int, int] | None = (128, 128),
        drift: str = "none",
        weights: RewardWeights = PAPER,
        scenes: Mapping[str, Scene] | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Load the episodes. `suite`: a name, a file or episodes; `scenes` replaces loading scenes by name.

        There is no default suite, so that nobody trains on "dynanav", the suite for evaluation. Raises SuiteError.
        """
        episodes = load_suite(suite) if isinstance(suite, str) else tuple(suite)
        if not episodes:
            raise ValueError("DynaNav: expected at least one episode")
        self.episodes = {episode.id: episode for episode in episodes}
        self.render_mode = render_mode
        self._options = WorldOptions(camera=camera, drift=drift)
        self._weights = weights
        self._scenes = scenes if scenes is not None else {}
        self._world: EpisodeWorld | None = None
        self._grids: dict[tuple[str, str], NavGrid] = {}
        self.action_space = spaces.Box(np.array(LOW, np.float32), np.array(HIGH, np.float32))
        parts: dict[str, spaces.Space[Any]] = {
            "state": spaces.Box(-np.inf, np.inf, (3,), np.float32),
            "pose": spaces.Box(-np.inf, np.inf, (3,), np.float32),
            "time": spaces.Box(0.0, np.inf, (1,), np.float32),
        }
        if camera is not None:
            parts["image"] = spaces.Box(0, 255, (camera[1], camera[0], 3), np.uint8)
        self.observation_space = spaces.Dict(parts)

    @property
    def world(self) -> EpisodeWorld:
        """World of the running episode, for privileged policies. Raises RuntimeError before the first reset."""
        if self._world is None:
            raise RuntimeError("DynaNav: expected a reset first")
        return self._world

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode; `options` {"episode": ID, "crowd_seed": N, "wording": N}, all optional.

        Without an ID, an episode is drawn at random (seeded by `seed` if given). `crowd_seed` replaces the episode's
        own. Raises ValueError.
        """
        super().reset(seed=seed)
        given = dict(options or {})
        name = given.pop("episode", None)
        crowd_seed, wording = given.pop("crowd_seed", None), int(given.pop("wording", 0))
        if given:
            raise ValueError(f"DynaNav: unknown option {sorted(given)[0]!r}, expected episode, crowd_seed or wording")
        if name is None:
            name = list(self.episodes)[int(self.np_random.integers(len(self.episodes)))]
        if name not in self.episodes:
            raise ValueError(f"DynaNav: no episode {name!r} in this suite")
        episode = self.episodes[name]
        if crowd_seed is not None:
            episode = replace(episode, seed=int(crowd_seed))
        self._close_world()
        self._world = EpisodeWorld(episode, self._options, scene=self._scenes.get(episode.scene))
        self._instruction = episode.instructions[wording % len(episode.instructions)]
        self._contacts = Contacts()
        self._grid = self._grid_of(self._world)
        self._field = self._grid.distance_field(episode.goal_xy)
        self._remaining_m = self._remaining_path_m(float("nan"))
        if not isfinite(self._remaining_m):
            self._close_world()
            raise ValueError(f"DynaNav: episode {name}: expected a path from its start to its goal, found none")
        return self._observation(), self._info()

    def step(self, action: NDArray[np.float32]) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Drive for 0.1 s with (vx m/s, vy m/s, wz rad/s), clipped to the action's range."""
        world = self.world
        vx, vy, wz = (float(v) for v in np.clip(action, LOW, HIGH))
        before, remaining_before_m = world.pose(), self._remaining_m
        world.step((vx, vy, wz))
        after = world.pose()
        self._remaining_m = self._remaining_path_m(remaining_before_m)
        value = reward(
            reached=world.end == "reached",
            distance_before_m=remaining_before_m,
            distance_after_m=self._remaining_m,
            collision_began=self._contacts.began(world.touching),
            speed_mps=10.0 * hypot(after.x_m - before.x_m, after.y_m - before.y_m),
            weights=self._weights,
        )
        return self._observation(), value, world.end in ("reached", "fell"), world.end == "timeout", self._info()

    def _grid_of(self, world: EpisodeWorld) -> NavGrid:
        """Return the robot's navigation grid of the scene, from the cache if possible."""
        robot = world.episode.robot
        key = (world.episode.scene, robot)
        if key not in self._grids:
            if len(self._grids) >= MAX_GRIDS:
                self._grids.pop(next(iter(self._grids)))
            self._grids[key] = robot_grid(world.scene, robot)
        return self._grids[key]

    def _remaining_path_m(self, default_m: float) -> float:
        """Return the path length left to the goal, m; `default_m` where no path exists, such as in a narrow aisle."""
        pose = self.world.pose()
        remaining_m = self._grid.blended_at(self._field, pose.x_m, pose.y_m)
        return remaining_m if isfinite(remaining_m) else default_m

    def _distance(self, pose: SE2) -> float:
        goal_x, goal_y = self.world.episode.goal_xy
        return hypot(goal_x - pose.x_m, goal_y - pose.y_m)

    def _observation(self) -> dict[str, Any]:
        observation: Observation = self.world.observe()
        parts: dict[str, Any] = {
            "state": np.array(observation.state, np.float32),
            "pose": np.array(observation.T_odom_base.as_tuple(), np.float32),
            "time": np.array((observation.time_s,), np.float32),
        }
        if observation.image is not None:
            parts["image"] = observation.image
        return parts

    def _info(self) -> dict[str, Any]:
        world = self.world
        info: dict[str, Any] = {
            "episode": world.episode.id,
            "instruction": self._instruction,
            "distance_m": self._distance(world.pose()),
            "collided": world.collided,
        }
        if world.done:
            info["outcome"] = world.outcome()
        return info

    def render(self) -> Pictures | None:
        """Return the robot's current view, uint8 RGB [180, 320, 3], in render mode rgb_array; else None."""
        return self.world.picture(320, 180) if self.render_mode == "rgb_array" else None

    def _close_world(self) -> None:
        if self._world is not None:
            self._world.close()
            self._world = None

    def close(self) -> None:
        """Release the world; may be called twice."""
        self._close_world()


def register() -> None:
    """Register `DynaNav-v0` with Gymnasium; may be called twice."""
    if ENV_ID not in gymnasium.registry:
        gymnasium.register(id=ENV_ID, entry_point="sim_hil.benchmark.env.gym_env:DynaNavEnv")


register()
