"""World of one episode: control steps of 0.1 s in virtual time, with its own physics client."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from edge.core.geometry import SE2
from sim_hil.benchmark.env.metrics import FRAME_HZ, Outcome, is_success, measure
from sim_hil.benchmark.env.observation import CAMERA_ASPECT, Observation, Odometer
from sim_hil.benchmark.suite.episode import Episode
from sim_hil.layouts.scenes import open_scene
from sim_hil.robots.interface import Robot
from sim_hil.robots.odometry_noise import LEVELS
from sim_hil.scene.scene import Scene
from sim_hil.simulation.physics import Simulation

if TYPE_CHECKING:
    from sim_hil.simulation.camera import CameraWorld

Array = NDArray[np.float64]

FRAMES_PER_STEP: Final = 3  # control at 10 Hz; the action is constant in between (paper appendix D)
MAX_PIXELS: Final = 2048


@dataclass(frozen=True)
class WorldOptions:
    """Options of an episode's world.

    `camera`: image size (width, height), px; None: no image. `drift`: none, typical or severe. `rate_hz`: physics steps
    a second, a multiple of 30. `linger_s`: time that the world continues after the goal was reached, s; the benchmark
    uses 0, training observes whether the robot stays at the goal. `glides`: the robot's stand-in without legs or wheels
    drives (sim_hil/simulation/gliding.py), for which 120 Hz are enough.
    """

    camera: tuple[int, int] | None = None
    drift: str = "none"
    rate_hz: int = 480  # under random commands the Go2 fell once in half an hour at 240 Hz, never in an hour at 480 Hz
    linger_s: float = 0.0
    glides: bool = False

    def __post_init__(self) -> None:
        if self.camera is not None and not all(16 <= size <= MAX_PIXELS for size in self.camera):
            raise ValueError(f"world: expected a camera of 16..{MAX_PIXELS} px, found {self.camera}")
        if self.drift not in LEVELS:
            raise ValueError(f"world: expected a drift of {', '.join(LEVELS)}, found {self.drift!r}")
        if self.rate_hz % FRAME_HZ or not 120 <= self.rate_hz <= 1200:
            raise ValueError(f"world: expected a whole multiple of {FRAME_HZ} steps a second, found {self.rate_hz}")
        if not 0 <= self.linger_s <= 600:
            raise ValueError(f"world: expected linger_s of 0 to 600 s, found {self.linger_s}")


class EpisodeWorld:
    """World of one episode from its start; the same episode and options give identical results on every machine.

    Raises SceneError or ValueError if the world cannot be built.
    """

    def __init__(
        self,
        episode: Episode,
        options: WorldOptions | None = None,
        *,
        scene: Scene | None = None,
    ) -> None:
        """Build the world and let the robot settle; `scene` replaces loading the episode's scene by name."""
        self.episode = episode
        self.options = options if options is not None else WorldOptions()
        self._camera: CameraWorld | None = None
        self._simulation = Simulation(
            scene if scene is not None else open_scene(episode.scene),
            people=episode.people,
            seed=episode.seed,
            robot=episode.robot,
            start=episode.start,
            rate_hz=self.options.rate_hz,
            glides=self.options.glides,
        )
        try:
            self._simulation.settle()
        except BaseException:
            self._simulation.close()
            raise
        self._substeps = self.options.rate_hz // FRAME_HZ
        self._frames = 0
        self._trajectory = [self._pose()]
        self._odometer = Odometer(self.options.drift, episode.seed, SE2(*self._trajectory[0]))
        self._first_collision_s: float | None = None
        self._end: str | None = None
        self._reached_frame: int | None = None
        self._observed: tuple[int, Observation] | None = None

    def _pose(self) -> tuple[float, float, float]:
        (x, y, _), heading = self._simulation.pose()
        return (x, y, heading)

    @property
    def scene(self) -> Scene:
        """The scene, with the episode's start."""
        return self._simulation.scene

    @property
    def robot(self) -> Robot:
        """The robot, for its footprint and limits."""
        return self._simulation.robot

    @property
    def time_s(self) -> float:
        """Time since the episode began, s."""
        return self._frames / FRAME_HZ

    @property
    def done(self) -> bool:
        """Whether the episode is over."""
        return self._end is not None

    @property
    def end(self) -> str | None:
        """Why the episode ended (see Outcome); None while it runs."""
        return self._end

    @property
    def collided(self) -> bool:
        """Whether a collision has occurred so far, as counted by the outcome."""
        return self._first_collision_s is not None

    @property
    def touching(self) -> frozenset[str]:
        """Labels of the objects that the robot touches now; "person" also counts one within 0.5 m."""
        return self._simulation.touching

    def observe(self) -> Observation:
        """Return the current observation; repeated calls without a step return the same object."""
        if self._observed is None or self._observed[0] != self._frames:
            observation = Observation(
                time_s=self.time_s,
                image=None if self.options.camera is None else self.picture(*self.options.camera),
                state=self._odometer.velocity(),
                T_odom_base=self._odometer.pose,
                collided=bool(self._simulation.contacts()),
                touching=bool(self._simulation.in_contact),
            )
            self._observed = (self._frames, observation)
        return self._observed[1]

    def picture(self, width: int, height: int) -> NDArray[np.uint8]:
        """Render the forward camera's current view, uint8 RGB [height, width, 3]: 16:9 scaled to that size."""
        if self._camera is None:
            # Imported here: most policies need no image, and the renderer takes half of an episode's memory.
            from sim_hil.simulation.camera import CameraWorld

            episode = self.episode
            self._camera = CameraWorld(self.scene, people=episode.people, seed=episode.seed, robot=episode.robot)
        return self._camera.render(self._simulation.render_state(), width, height, aspect=CAMERA_ASPECT)

    def step(self, velocity: tuple[float, float, float]) -> None:
        """Drive for one control period (0.1 s, shorter if the episode ends) with (vx m/s, vy m/s, wz rad/s).

        Raises ValueError unless all three are finite, RuntimeError when the episode is over.
        """
        if self.done:
            raise RuntimeError(f"episode {self.episode.id} is over: expected no further step")
        if len(velocity) != 3 or not all(isfinite(v) for v in velocity):
            raise ValueError(f"episode {self.episode.id}: expected three finite velocities, found {velocity}")
        self._simulation.command(*(float(v) for v in velocity))
        for _ in range(FRAMES_PER_STEP):
            self._frame()
            if self.done:
                return

    def _frame(self) -> None:
        for _ in range(self._substeps):
            self._simulation.step()
        self._frames += 1
        pose = self._pose()
        self._trajectory.append(pose)
        self._odometer.step(SE2(*pose), 1 / FRAME_HZ)
        if self._first_collision_s is None and self._simulation.collided_with():
            self._first_collision_s = self.time_s
        if self._reached_frame is None and is_success(pose[:2], self.episode.goal_xy, self.episode.threshold_m):
            self._reached_frame = self._frames
        self._end = self._ended()

    def _ended(self) -> str | None:
        if self._reached_frame is not None:
            if self._frames - self._reached_frame >= round(self.options.linger_s * FRAME_HZ):
                return "reached"
            return "fell" if self._simulation.fell else None
        if self._simulation.fell:
            return "fell"
        return "timeout" if self._frames >= round(self.episode.timeout_s * FRAME_HZ) else None

    def stop(self) -> None:
        """End the episode now, with its current state as the outcome."""
        if self._end is None:
            self._end = "stopped"

    def pose(self) -> SE2:
        """Return the robot's true planar pose `T_world_base`."""
        return SE2(*self._trajectory[-1])

    def people(self) -> Array:
        """Return the pose of every person [n, 3]: x m, y m, heading rad."""
        return self._simulation.people()

    def people_velocities(self) -> Array:
        """Return the velocity of every person [n, 2] in the world frame, m/s."""
        return self._simulation.people_velocities()

    def trajectory(self) -> Array:
        """Return the robot's poses so far at 30 Hz [n, 3]: x m, y m, heading rad; the start included."""
        return np.array(self._trajectory, dtype=np.float64)

    def outcome(self) -> Outcome:
        """Return the metrics of the finished episode. Raises RuntimeError before it is over."""
        if self._end is None:
            raise RuntimeError(f"episode {self.episode.id} is not over yet: expected `done` or `stop()` first")
        return measure(
            self.episode,
            self.trajectory(),
            end=self._end,
            time_s=self.time_s,
            collisions=tuple(sorted(self._simulation.collided_with())),
            first_collision_s=self._first_collision_s,
            fell=self._simulation.fell,
        )

    def close(self) -> None:
        """Close physics and renderer; may be called twice."""
        self._simulation.close()
        if self._camera is not None:
            self._camera.close()
            self._camera = None

    def __enter__(self) -> EpisodeWorld:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
