"""Obstacle avoidance of the simulated Go2: what is in the way, how fast that lets one go, and the service about it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.geometry import SE2
from sim_hil.protocols.unitree.services.avoidance import RANGE_M, STOP_M, RangeFinder, allowed_mps, slowed
from sim_hil.robots.go2.sport import SportAction
from sim_hil.scene.scene import Box
from tests.support.robot.go2_services import Desk, Stage


@pytest.fixture
def stage() -> Iterator[Stage]:
    stage = Stage()
    yield stage
    stage.simulation.close()


@pytest.fixture
def desk() -> Desk:
    return Desk()


class TestAvoidance:
    wall = Box((3.0, 0.0, 1.0), (1.0, 0.0), (0.2, 4.0, 2.0))
    nobody = np.zeros((0, 3))

    def test_the_range_is_that_to_the_face_of_a_box(self) -> None:
        assert RangeFinder([self.wall]).free_m(0.0, 0.0, 0.0, self.nobody) == pytest.approx(2.9)
        assert RangeFinder([self.wall]).free_m(0.0, 0.0, math.pi, self.nobody) == RANGE_M

    @given(st.floats(-math.pi, math.pi))
    def test_it_is_the_same_for_a_world_turned_about_the_robot(self, turn: float) -> None:
        c, s = math.cos(turn), math.sin(turn)
        turned = Box((3.0 * c, 3.0 * s, 1.0), (c, s), (0.2, 4.0, 2.0))
        assert RangeFinder([turned]).free_m(0.0, 0.0, turn, self.nobody) == pytest.approx(2.9, abs=1e-6)

    def test_only_obstacles_within_the_robots_width_count(self) -> None:
        finder = RangeFinder([Box((2.0, 0.3, 0.5), (1.0, 0.0), (0.2, 0.1, 1.0))])
        assert finder.free_m(0.0, 0.0, 0.0, self.nobody) == pytest.approx(1.9)
        assert finder.free_m(0.0, -0.1, 0.0, self.nobody) == RANGE_M

    def test_a_lamp_above_and_a_stripe_on_the_floor_do_not_count(self) -> None:
        boxes = [Box((1.0, 0.0, z), (1.0, 0.0), (0.5, 4.0, 0.02)) for z in (0.01, 2.5)]
        assert RangeFinder(boxes).free_m(0.0, 0.0, 0.0, self.nobody) == RANGE_M

    def test_a_person_ahead_is_seen_and_one_behind_is_not(self) -> None:
        finder, people = RangeFinder([]), np.array([[1.5, 0.1, 0.0], [-1.0, 0.0, 0.0]])
        assert 1.0 < finder.free_m(0.0, 0.0, 0.0, people) < 1.5

    @given(st.floats(0, 4), st.floats(0.05, 4))
    def test_nearer_is_never_faster_and_close_is_a_stop(self, free_m: float, more_m: float) -> None:
        assert 0.0 <= allowed_mps(free_m) <= allowed_mps(free_m + more_m)
        assert allowed_mps(STOP_M) == 0.0

    @given(st.floats(-2, 2), st.floats(-1, 1), st.floats(-2, 2), st.floats(0, 4))
    def test_a_slowed_velocity_keeps_its_direction_and_its_turning(
        self, vx: float, vy: float, wz: float, free_m: float
    ) -> None:
        sx, sy, sz = slowed((vx, vy, wz), free_m)
        assert math.hypot(sx, sy) <= max(allowed_mps(free_m), 0.0) + 1e-9
        assert sz == wz and abs(sx * vy - sy * vx) < 1e-9 and sx * vx >= 0.0

    @pytest.mark.slow
    def test_it_walks_up_to_a_wall_and_stops_before_it(self, stage: Stage) -> None:
        assert stage.avoid.handle(1004, '{"is_remote_commands_from_api": true}') == (0, "")
        wall_x = stage.pose().x_m + 2.2
        velocity = '{"x": 0.8, "y": 0, "yaw": 0, "mode": 0}'

        def look() -> None:
            stage.free_m = wall_x - stage.pose().x_m
            assert stage.avoid.handle(1003, velocity) == (0, "")

        stage.run(7.0, look)
        assert 0.35 < wall_x - stage.pose().x_m < STOP_M + 0.25
        assert abs(stage.simulation.truth().velocity_world_mps[0]) < 0.1

    def test_a_velocity_counts_for_a_second_there_too(self, desk: Desk) -> None:
        desk.avoid.handle(1004, '{"is_remote_commands_from_api": true}')
        desk.run(0.2)
        desk.avoid.handle(1003, '{"x": 0.4, "y": 0, "yaw": 0, "mode": 0}')
        desk.run(0.8)
        assert desk.behaviour.commanded[0] == pytest.approx(0.4)
        desk.run(0.4)
        assert desk.behaviour.commanded == (0.0, 0.0, 0.0)

    def test_its_moves_are_ignored_until_the_api_takes_command(self, desk: Desk) -> None:
        desk.avoid.handle(1003, '{"x": 0.4, "y": 0, "yaw": 0, "mode": 0}')
        assert desk.behaviour.commanded == (0.0, 0.0, 0.0)

    @pytest.mark.slow
    @pytest.mark.parametrize(("mode", "goal"), [(1, (0.6, 0.0, 0.5)), (2, None)])
    def test_it_goes_to_a_place(self, stage: Stage, mode: int, goal: tuple[float, float, float] | None) -> None:
        stage.avoid.handle(1004, '{"is_remote_commands_from_api": true}')
        start = stage.pose()
        wanted = start @ SE2(0.6, 0.0, 0.5)
        x, y, yaw = goal if goal is not None else wanted.as_tuple()
        stage.avoid.handle(1003, json.dumps({"x": x, "y": y, "yaw": yaw, "mode": mode}))
        stage.run(6.0)
        left = stage.pose().inverse() @ wanted
        assert math.hypot(left.x_m, left.y_m) < 0.12 and abs(left.theta_rad) < 0.15
        assert stage.behaviour.commanded == (0.0, 0.0, 0.0)

    @pytest.mark.slow
    def test_a_stop_ends_the_way_to_a_place(self, stage: Stage) -> None:
        stage.avoid.handle(1004, '{"is_remote_commands_from_api": true}')
        stage.avoid.handle(1003, '{"x": 3, "y": 0, "yaw": 0, "mode": 1}')
        stage.run(1.0)
        stage.ask(1003)
        stage.run(1.0)
        where = stage.pose()
        stage.run(1.0)
        assert abs(stage.pose().x_m - where.x_m) < 0.05

    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("api_id", "parameter"),
        [(1001, {}), (1005, {}), (1009, {}), (1010, {}), (1016, {}), (1028, {"data": True}), (1028, {"data": False}),
         (1007, {"x": 0.2, "y": 0.0, "z": 0.0})],
    )  # fmt: skip
    def test_a_posture_ends_the_way_to_a_place(self, desk: Desk, api_id: int, parameter: dict[str, object]) -> None:
        desk.avoid.handle(1004, '{"is_remote_commands_from_api": true}')
        desk.avoid.handle(1003, '{"x": 3, "y": 0, "yaw": 0, "mode": 1}')
        desk.run(0.5)
        assert desk.behaviour.commanded[0] > 0
        assert desk.ask(api_id, **parameter) == (0, "")
        desk.run(10.0)  # a show is over by then
        desk.behaviour.request(SportAction.RECOVERY_STAND)
        desk.run(4.0)
        assert desk.behaviour.ready and desk.behaviour.commanded == (0.0, 0.0, 0.0)

    def test_taking_the_joints_ends_the_way_to_a_place(self, desk: Desk) -> None:
        desk.avoid.handle(1004, '{"is_remote_commands_from_api": true}')
        desk.avoid.handle(1003, '{"x": 3, "y": 0, "yaw": 0, "mode": 1}')
        desk.switcher.release()
        desk.run(2.1)
        assert desk.switcher.select("normal") == 0
        desk.behaviour.request(SportAction.RECOVERY_STAND)
        desk.run(4.0)
        assert desk.behaviour.ready and desk.behaviour.commanded == (0.0, 0.0, 0.0)

    def test_the_sport_services_own_moves_are_slowed_once_it_avoids(self, desk: Desk) -> None:
        desk.free_m = 0.2
        desk.ask(1008, x=0.5, y=0, z=0)
        assert desk.behaviour.commanded[0] == 0.5
        assert desk.ask(2048, data=True) == (0, "")
        desk.ask(1008, x=0.5, y=0, z=0.3)
        assert desk.behaviour.commanded == pytest.approx((0.0, 0.0, 0.3))
        assert desk.ask(2058) == (0, "")
        desk.ask(1008, x=0.5, y=0, z=0)
        assert desk.behaviour.commanded[0] == 0.5
