"""Before arming: a fault that would keep the robot from driving blocks arming until it has cleared."""

from __future__ import annotations

import pytest

from edge.safety.faults.findings import Finding
from edge.safety.monitors.watch import Sources, Watch, WatchConfig
from edge.safety.pre_arm import PreArm
from edge.safety.supervisor import State
from edge.state.frame import Frame
from edge.state.pose_history import StampedPose
from tests.support.runner.control_bench import MS, PERIOD_NS, PX, Bench


class Desk:
    """A robot that stands in front of a working camera, checked 20 times a second."""

    def __init__(self) -> None:
        self.bench = Bench()
        self.watch = watch = Watch(
            WatchConfig.standard(self.bench.controller_config, PERIOD_NS, image_px=PX),
            Sources(
                findings=self.bench.findings,
                attitude=lambda: self.bench.attitude,
                states=lambda: self.bench.states,
                malformed=lambda: self.bench.malformed,
            ),
        )
        self.pre_arm = PreArm(
            watch, picture=lambda: self.bench.frame, pose=self.bench.history.newest, clock=lambda: self.bench.now_ns
        )
        self.camera = self.robot = True

    def run(self, seconds: float, *findings: Finding) -> str:
        """The blocking fault after so long; each step has `findings`."""
        why = ""
        for turn in range(round(seconds * 20)):
            self.bench.now_ns += 50 * MS
            if self.robot:
                self.bench.feel(0.0)
            if self.camera and turn % 2 == 0:
                self.bench.look()
            self.bench.findings.put(findings)
            why = self.pre_arm.blocking_fault()
        return why


@pytest.fixture
def desk() -> Desk:
    return Desk()


def test_with_pictures_and_poses_it_is_ready(desk: Desk) -> None:
    assert (desk.run(3), desk.pre_arm.state) == ("", State.READY)


def test_a_picture_and_a_pose_that_arrive_during_the_check_are_no_fault(desk: Desk) -> None:
    bench = desk.bench

    def arrive() -> None:
        bench.now_ns += MS
        bench.see()

    def picture() -> Frame | None:
        arrive()
        return bench.frame

    def pose() -> StampedPose | None:
        arrive()
        return bench.history.newest()

    pre_arm = PreArm(desk.watch, picture=picture, pose=pose, clock=lambda: bench.now_ns)
    for _ in range(60):
        bench.now_ns += 50 * MS
        why = pre_arm.blocking_fault()
    assert why == ""


def test_without_a_picture_it_is_starting(desk: Desk) -> None:
    desk.camera = False
    assert "no new picture" in desk.run(1)
    assert desk.pre_arm.state is State.STARTING


def test_a_camera_that_ends_while_the_runner_waits_blocks_arming_until_it_is_back(desk: Desk) -> None:
    desk.run(3600 / 60)
    desk.camera = False
    assert desk.run(1) != ""
    desk.camera = True
    assert desk.run(3) == ""


def test_a_robot_that_falls_silent_blocks_arming(desk: Desk) -> None:
    desk.run(2)
    desk.robot = False
    assert "pose is too old" in desk.run(0.5)


def test_a_robot_that_was_carried_may_be_armed_once_it_is_put_down(desk: Desk) -> None:
    desk.bench.attitude.roll_rad = 1.0
    assert "leans" in desk.run(2)
    desk.bench.attitude.roll_rad = 0.0
    assert "leans" in desk.run(1), "not at once"
    assert desk.run(2) == ""


def test_a_board_about_to_switch_off_from_heat_blocks_arming(desk: Desk) -> None:
    assert "switch itself off" in desk.run(1, Finding("thermal-trip", "104 °C"))


def test_a_fault_that_only_lowers_the_speed_does_not_block_arming(desk: Desk) -> None:
    assert desk.run(2, Finding("battery-low", "15 %")) == ""
