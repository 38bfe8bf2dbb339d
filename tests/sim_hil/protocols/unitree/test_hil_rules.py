"""`edge-hil`'s pure parts: the sport service's rules, the log of commands, the odometry frame, the shared pose."""

from __future__ import annotations

import math
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.unitree.messages import ids
from firmware_bridge.unitree.rpc import move_parameter
from sim_hil.protocols.snapshot import SnapshotReader, SnapshotWriter, TornSnapshotError
from sim_hil.protocols.unitree.odometry import OdometryFrame
from sim_hil.protocols.unitree.services.service import Received
from sim_hil.protocols.unitree.services.sport import RequestLog, handle_sport, parse_move
from sim_hil.robots.go2.sport import SportAction


class Recorder:
    """A robot that notes what the sport service makes of a request."""

    def __init__(self) -> None:
        self.did: list[object] = []

    def sport(self, action: SportAction) -> int:
        self.did.append(action)
        return 0

    def move(self, *velocity: float) -> None:
        self.did.append(velocity)


class TestSportRules:
    @pytest.mark.parametrize(
        ("api_id", "action"),
        [(1001, "DAMP"), (1002, "BALANCE_STAND"), (1003, "STOP_MOVE"), (1004, "STAND_UP"), (1005, "STAND_DOWN"),
         (1006, "RECOVERY_STAND")],
    )  # fmt: skip
    def test_each_id_is_its_action(self, api_id: int, action: str) -> None:
        robot = Recorder()
        assert handle_sport(robot, api_id, "") == (0, "")
        assert robot.did == [SportAction[action]]

    @pytest.mark.parametrize("api_id", [0, 1007, 1009, 1016, 1030, 2043, 9999])
    def test_anything_else_is_not_implemented(self, api_id: int) -> None:
        robot = Recorder()
        assert handle_sport(robot, api_id, "{}") == (3203, "")
        assert robot.did == []

    def test_move_takes_three_numbers(self) -> None:
        robot = Recorder()
        assert handle_sport(robot, 1008, '{"x": 0.5, "y": 0, "z": -1}') == (0, "")
        assert robot.did == [(0.5, 0.0, -1.0)]

    @pytest.mark.parametrize(
        "text",
        ["", "nonsense", "[]", "3", "null", '{"x":1,"y":2}', '{"x":1,"y":2,"z":"3"}', '{"x":1,"y":2,"z":NaN}',
         '{"x":1,"y":2,"z":1e999}', '{"x":true,"y":0,"z":0}', '{"x":1,"y":2,"z":null}', "[" * 4000],
    )  # fmt: skip
    def test_a_bad_move_is_a_parameter_error_and_moves_nothing(self, text: str) -> None:
        robot = Recorder()
        assert handle_sport(robot, 1008, text) == (3204, "")
        assert robot.did == []

    @given(st.text(max_size=200))
    def test_no_text_breaks_the_parser(self, text: str) -> None:
        assert parse_move(text) is None or len(parse_move(text) or ()) == 3

    @given(*[st.floats(-100, 100)] * 3)
    def test_the_bridges_parameter_is_understood(self, vx: float, vy: float, wz: float) -> None:
        assert parse_move(move_parameter(vx, vy, wz)) == (vx, vy, wz)


class TestRequestLog:
    @staticmethod
    def after(*requests: tuple[int, str]) -> dict[str, object]:
        log = RequestLog()
        for api_id, parameter in requests:
            log.note(Received(0, ids.SPORT_SERVICE, api_id, parameter, 0, noreply=True))
        return log.summary()

    def test_moves_are_counted_and_the_last_is_kept(self) -> None:
        summary = self.after((1008, '{"x":1,"y":0,"z":0}'), (1008, '{"x":0,"y":0,"z":0}'))
        assert (summary["commands"], summary["last_move"], summary["last_command_zero"]) == (2, [0.0, 0.0, 0.0], True)

    def test_a_moving_robot_is_not_at_zero(self) -> None:
        assert self.after((1008, '{"x":0,"y":0,"z":0.1}'))["last_command_zero"] is False

    def test_stop_move_after_a_move_is_zero(self) -> None:
        summary = self.after((1008, '{"x":1,"y":0,"z":0}'), (1003, ""))
        assert (summary["last_command"], summary["last_command_zero"]) == ("StopMove", True)

    def test_a_move_that_nobody_can_read_does_not_count_as_zero(self) -> None:
        assert self.after((1008, "?"))["last_command_zero"] is False

    @pytest.mark.parametrize("api_id", [1002, 1004, 1006, 1016, 9999])
    def test_a_move_stays_in_force_whatever_is_said_after_it_that_is_no_motion(self, api_id: int) -> None:
        summary = self.after((1008, '{"x":0.5,"y":0,"z":0}'), (api_id, ""))
        assert (summary["last_move"], summary["last_command_zero"]) == ([0.5, 0.0, 0.0], False)

    @pytest.mark.parametrize("api_id", [1001, 1003, 1005])
    def test_what_ends_a_motion_is_zero_also_when_something_else_follows(self, api_id: int) -> None:
        assert self.after((1008, '{"x":0.5,"y":0,"z":0}'), (api_id, ""), (1016, ""))["last_command_zero"] is True

    def test_a_robot_that_was_never_told_to_move_is_at_zero(self) -> None:
        assert self.after((1004, ""))["last_command_zero"] is True


class TestOdometryFrame:
    starts = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-math.pi, math.pi))

    @given(starts)
    def test_it_starts_at_zero(self, start: tuple[float, float, float]) -> None:
        frame = OdometryFrame(start)
        assert frame.position((start[0], start[1], 0.3)) == pytest.approx([0, 0, 0.3], abs=1e-9)
        assert frame.rpy((0.1, 0.2, start[2]))[2] == pytest.approx(0, abs=1e-9)
        half = start[2] / 2
        quaternion = frame.quaternion((math.cos(half), 0.0, 0.0, math.sin(half)))
        assert quaternion == pytest.approx([1, 0, 0, 0], abs=1e-9)

    @given(starts, st.floats(-5, 5))
    def test_walking_straight_ahead_is_along_x(self, start: tuple[float, float, float], distance: float) -> None:
        x, y, theta = start
        ahead = (x + distance * math.cos(theta), y + distance * math.sin(theta), 0.3)
        assert OdometryFrame(start).position(ahead) == pytest.approx([distance, 0, 0.3], abs=1e-9)


class TestSnapshot:
    def test_the_newest_value_is_read(self) -> None:
        writer = SnapshotWriter(5)
        reader = SnapshotReader(writer.fd, 5)
        assert reader.read() is None
        for value in range(3):
            writer.write(np.full(5, float(value)))
        assert reader.read().tolist() == [2.0] * 5
        reader.close()
        writer.close()

    def test_a_torn_value_is_never_returned(self) -> None:
        writer = SnapshotWriter(2)
        reader = SnapshotReader(writer.fd, 2)
        writer.write(np.array((1.0, 2.0)))
        writer._memory[-8:] = np.array(3.0).tobytes()  # the next value, half-written
        with pytest.raises(TornSnapshotError, match="no consistent snapshot"):
            reader.read()
        reader.close()
        writer.close()

    def test_a_writer_that_was_interrupted_for_a_few_milliseconds_is_waited_for(self) -> None:
        writer = SnapshotWriter(2)
        reader = SnapshotReader(writer.fd, 2)
        writer.write(np.array((1.0, 2.0)))
        writer._memory[-8:] = np.array(3.0).tobytes()
        back = threading.Timer(0.02, writer.write, (np.array((1.0, 3.0)),))
        back.start()
        assert reader.read().tolist() == [1.0, 3.0]
        back.join()
        reader.close()
        writer.close()

    def test_another_length_is_refused(self) -> None:
        writer = SnapshotWriter(3)
        with pytest.raises(ValueError, match="shape"):
            writer.write(np.zeros(4))
        with pytest.raises(ValueError, match="bytes"):
            SnapshotReader(writer.fd, 4)
        writer.close()
