"""A camera that goes on sending pictures of a scene that no longer moves, and live cameras that show little.

The pictures are a texture seen by a pinhole camera: driving ahead enlarges it about its centre, turning shifts it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from edge.core.geometry import SE2
from edge.robot.camera import Frame
from edge.safety.monitors.frame import CONTENTS_KEPT, FrameConfig, FrameMonitor
from edge.safety.monitors.scene import SceneConfig, SceneMonitor, expected_change

PX = 128
TICK_NS = 100_000_000
WALL_M = 8.0

Picture = np.ndarray
Scene = Callable[[float, float], Picture]


def texture(seed: int = 0, contrast: float = 40.0) -> Scene:
    """A wall `WALL_M` ahead with patches of all sizes."""
    rng = np.random.default_rng(seed)
    side = 4 * PX
    wall = sum(
        cv2.resize(rng.normal(0, 1, (cells, cells)), (side, side), interpolation=cv2.INTER_CUBIC)
        for cells in (16, 48, 120)
    )
    grey = np.clip(120 + contrast * wall, 20, 235).astype(np.uint8)

    def seen(x_m: float, theta_rad: float) -> Picture:
        zoom = WALL_M / (WALL_M - x_m % (WALL_M / 2))
        shift = theta_rad * PX / math.radians(80)
        centre = side / 2
        matrix = np.float64([[zoom, 0, PX / 2 - zoom * centre + shift], [0, zoom, PX / 2 - zoom * centre]])
        view = cv2.warpAffine(grey, matrix, (PX, PX), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        return np.repeat(view[:, :, None], 3, axis=2)

    return seen


def blank_wall(x_m: float, theta_rad: float) -> Picture:
    return np.full((PX, PX, 3), 150, dtype=np.uint8)


def blank_corridor(x_m: float, theta_rad: float) -> Picture:
    """Floor, ceiling and two walls without texture: driving ahead changes nothing."""
    v, u = np.mgrid[0:PX, 0:PX] - (PX - 1) / 2
    grey = np.where(np.abs(u) > np.abs(v), np.where(u > 0, 130, 150), np.where(v > 0, 80, 200))
    return np.repeat(grey.astype(np.uint8)[:, :, None], 3, axis=2)


@dataclass
class Drive:
    """A monitor, and a robot whose pose the test moves."""

    monitor: SceneMonitor
    scene: Scene
    rng: np.random.Generator
    x_m: float = 0.0
    theta_rad: float = 0.0
    now_ns: int = 10**12

    def move(self, vx_mps: float, wz_radps: float = 0.0) -> None:
        """One tick of 0.1 s."""
        self.x_m += vx_mps * 0.1
        self.theta_rad += wz_radps * 0.1
        self.now_ns += TICK_NS

    def live(self) -> Picture:
        return self.noisy(self.scene(self.x_m, self.theta_rad))

    def noisy(self, picture: Picture, sigma: float = 1.5) -> Picture:
        """Sensor noise and a JPEG's rounding, new in every picture."""
        levels = picture + self.rng.normal(0, sigma, picture.shape)
        jpeg = cv2.imencode(".jpg", np.clip(levels, 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 80])[1]
        return cv2.imdecode(jpeg, cv2.IMREAD_COLOR)

    def judge(self, picture: Picture) -> str:
        return self.monitor.step(picture[None], SE2(self.x_m, 0.0, self.theta_rad), self.now_ns)

    def run(
        self, ticks: int, vx_mps: float, wz_radps: float = 0.0, shown: Callable[[int], Picture] | None = None
    ) -> list[str]:
        """Verdicts while the robot drives, of a live camera or of the pictures `shown`."""
        verdicts = []
        for index in range(ticks):
            self.move(vx_mps, wz_radps)
            verdicts.append(self.judge(self.live() if shown is None else shown(index)))
        return verdicts

    def until_found(
        self, attack: Callable[[int], Picture], vx_mps: float, wz_radps: float = 0.0
    ) -> tuple[float, float]:
        """Metres and degrees of motion from the first picture of the attack to the verdict."""
        x_m, theta_rad = self.x_m, self.theta_rad
        for index in range(200):
            self.move(vx_mps, wz_radps)
            if self.judge(attack(index)):
                return abs(self.x_m - x_m), math.degrees(abs(self.theta_rad - theta_rad))
        raise AssertionError("never found")


def drive(scene: Scene | None = None) -> Drive:
    return Drive(SceneMonitor(), scene or texture(), np.random.default_rng(5))


def clock(picture: Picture, index: int) -> Picture:
    """The time of day drawn into a corner, different in every picture."""
    drawn = picture.copy()
    cv2.rectangle(drawn, (70, 3), (124, 14), (0, 0, 0), -1)
    text = f"12:{index // 60:02d}:{index % 60:02d}.{index * 37 % 100:02d}"
    cv2.putText(drawn, text, (71, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.28, (255, 255, 255), 1)
    return drawn


MOTIONS = [(0.1, 0.0), (0.3, 0.0), (0.8, 0.0), (0.0, 0.6), (0.4, -0.3), (-0.3, 0.0)]


@pytest.mark.parametrize("motion", MOTIONS)
def test_a_live_picture_of_a_robot_that_moves_is_not_frozen(motion: tuple[float, float]) -> None:
    assert not any(drive().run(80, *motion))


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("overlay", [lambda picture, _index: picture, clock], ids=["new noise", "a clock in it"])
def test_a_frozen_picture_is_found_within_a_third_of_a_metre_or_15_degrees(
    overlay: Callable[[Picture, int], Picture], motion: tuple[float, float]
) -> None:
    robot = drive()
    robot.run(20, *motion)
    frozen = robot.live()
    went_m, turned_deg = robot.until_found(lambda index: robot.noisy(overlay(frozen, index)), *motion)
    assert went_m <= 0.33 and turned_deg <= 15.0


@pytest.mark.parametrize("buffers", [2, 3, 4])
def test_stale_buffers_in_turn_with_new_noise_are_found(buffers: int) -> None:
    robot = drive()
    robot.run(20, 0.8)
    stale = []
    for _ in range(buffers):
        stale.append(robot.live())
        robot.run(1, 0.8)
    went_m, _ = robot.until_found(lambda index: robot.noisy(stale[index % buffers]), 0.8)
    assert went_m <= 0.33


def stopped(buffers: int = 1) -> tuple[Drive, list[Picture]]:
    """A robot that has stopped because its camera repeats these pictures."""
    robot = drive()
    robot.run(20, 0.5)
    stale = []
    for _ in range(buffers):
        stale.append(robot.live())
        robot.run(1, 0.5)
    robot.until_found(lambda index: robot.noisy(stale[index % buffers]), 0.5)
    return robot, stale


@pytest.mark.parametrize("buffers", [1, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 8))])
def test_a_robot_that_stopped_for_a_frozen_picture_stands_as_long_as_it_is_frozen(buffers: int) -> None:
    robot, stale = stopped(buffers)
    assert all(robot.run(300, 0.0, shown=lambda index: robot.noisy(stale[index % buffers])))


def test_a_frozen_verdict_ends_a_second_after_the_picture_is_live_again_and_its_pictures_are_forgotten() -> None:
    """Frozen pictures were kept at poses at which they were not captured: back at their true pose they would match."""
    robot, _ = stopped()
    verdicts = robot.run(12, 0.0)
    assert all(verdicts[:9]) and not any(verdicts[9:])
    assert not any(robot.run(20, -0.3))


def test_a_frozen_picture_before_a_robot_that_stands_is_no_fault_until_it_drives() -> None:
    robot = drive()
    frozen = robot.live()
    assert not any(robot.run(300, 0.0, shown=lambda _index: robot.noisy(frozen)))
    went_m, _ = robot.until_found(lambda index: robot.noisy(frozen), 0.3)
    assert went_m <= 0.33


def test_odometry_that_drifts_while_the_robot_stands_is_no_motion() -> None:
    robot = drive()
    seen = robot.live()
    assert not any(robot.run(2000, 0.01, math.radians(0.3), shown=lambda _index: seen))


def test_people_who_walk_past_a_robot_that_stands_are_no_fault() -> None:
    robot = drive()

    def passed(index: int) -> Picture:
        picture = robot.live()
        picture[30:115, (index * 4) % PX : (index * 4) % PX + 24] = 50
        return picture

    assert not any(robot.run(100, 0.0, shown=passed))


@pytest.mark.parametrize("motion", MOTIONS)
def test_a_blank_wall_is_no_evidence_of_a_frozen_picture(motion: tuple[float, float]) -> None:
    assert not any(drive(blank_wall).run(60, *motion))


def test_a_blank_corridor_seen_ahead_need_not_change() -> None:
    assert not any(drive(blank_corridor).run(60, 0.6))


@pytest.mark.parametrize("speed_mps", [0.3, 0.5, 0.8])
def test_a_corridor_whose_panels_repeat_every_metre_is_no_fault(speed_mps: float) -> None:
    panels = texture()
    assert not any(drive(lambda x_m, theta_rad: panels(x_m % 1.0, theta_rad)).run(80, speed_mps))


@pytest.mark.parametrize("motion", [*MOTIONS, (0.0, 0.0)])
def test_a_brightness_that_flickers_is_no_fault(motion: tuple[float, float]) -> None:
    robot = drive()

    def flickering(index: int) -> Picture:
        gain = 1.0 + 0.15 * math.sin(2.1 * index)
        return np.clip(robot.live() * gain, 0, 255).astype(np.uint8)

    assert not any(robot.run(80, *motion, shown=flickering))


@pytest.mark.parametrize(
    "change",
    [
        {"moved_m": 0.0},
        {"copies": 0},
        {"frozen_share": 1.0},
        {"spacing_m": 0.2},
        {"min_cells": 65},
        {"moved_rad": math.nan},
    ],
)
def test_a_configuration_that_cannot_judge_is_refused(change: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="scene monitor"):
        replace(SceneConfig(), **change)


@pytest.mark.parametrize("hfov_deg", [40.0, 70.0, 100.0])
def test_a_camera_up_to_that_of_the_go2_is_judged_as_before(hfov_deg: float) -> None:
    assert SceneConfig.for_hfov(hfov_deg) == SceneConfig()


def test_a_wider_camera_is_expected_to_show_less_motion() -> None:
    grey, turn = np.random.default_rng(0).integers(0, 255, (32, 32)).astype(np.int16), SE2(0.0, 0.0, 0.05)
    wide = expected_change(grey, turn, SceneConfig.for_hfov(140.0).focal_blocks)
    assert wide.sum() < 0.6 * expected_change(grey, turn).sum()


# --- pictures that are equal byte for byte ---------------------------------------------------------------------------


def frozen_after(buffers: int, ticks: int, speed_mps: float, standing: int = 0) -> list[bool]:
    """Whether each picture counts as frozen after so many buffers come again and again, then while the robot stands."""
    monitor, random = FrameMonitor(FrameConfig(PX, 10.0)), np.random.default_rng(1)
    stale = [random.integers(40, 200, (1, PX, PX, 3), dtype=np.uint8) for _ in range(buffers)]
    found, x_m, now_ns = [], 0.0, 10**12
    for index in range(buffers + ticks + standing):
        now_ns += TICK_NS
        x_m += speed_mps * 0.1 if index < buffers + ticks else 0.0
        out = monitor.step(Frame(now_ns, stale[index % buffers], b""), SE2(x_m, 0.0, 0.0), now_ns)
        found.append(any(finding.name == "camera-frozen" for finding in out.findings))
    assert not any(found[:buffers])
    return found[buffers:]


@pytest.mark.parametrize("buffers", [2, 3, 8, CONTENTS_KEPT])
def test_the_first_stale_buffer_that_comes_again_is_found(buffers: int) -> None:
    assert all(frozen_after(buffers, 20, 0.3))


@pytest.mark.parametrize("buffers", [1, 2, 8])
def test_equal_pictures_stay_found_while_the_robot_stands(buffers: int) -> None:
    assert all(frozen_after(buffers, 20, 0.3, standing=100)[5:])


def test_stale_buffers_before_a_robot_that_stands_are_no_fault() -> None:
    assert not any(frozen_after(2, 50, 0.0))
