"""The rover's component: what every message is answered with, and that no message does it harm. No wire."""

from __future__ import annotations

import math
from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from edge.core.geometry import SE2
from sim_hil.protocols.mavlink import telemetry
from sim_hil.protocols.mavlink.node import MavlinkNode
from sim_hil.protocols.mavlink.parameters import NAMES
from sim_hil.protocols.mavlink.vehicle import Mode, Station
from sim_hil.protocols.mavlink.wire import Message, Reader, Writer
from sim_hil.robots.carter.sensors import Sensors
from tests.sim_hil.protocols.mavlink.test_mavlink_wire import setpoint
from tests.support.robot.fake_base import FakeBase

STATION = Station(255, ("127.0.0.1", 1))
ACCEPTED, DENIED = common.MAV_RESULT_ACCEPTED, common.MAV_RESULT_DENIED
UNSUPPORTED = common.MAV_RESULT_UNSUPPORTED


def sensors() -> Sensors:
    return Sensors(
        T_odom_base=SE2(2.0, 1.0, math.pi / 2), v_mps=0.5, w_radps=0.1, wheel_radps=(1.0, 1.0), wheel_nm=(0.0, 0.0),
        wheel_counts=(4096, 0), gyro_radps=(0.0, 0.0, 0.1), accel_mps2=(0.0, 0.0, 9.81), charge_percent=80.0,
        voltage_v=40.0, current_a=2.0, bumpers=(False, False, False, False), overload=False,
    )  # fmt: skip


class Link:
    """A node, and a station that talks to it through packets, as on the wire."""

    def __init__(self) -> None:
        self.base, self.reader = FakeBase(), Reader()
        self.node = MavlinkNode(self.base, sensors, self.reader.counts)
        self._out, self._in, self._from_station = Writer(1, 1), Reader(), Writer(255, 190)
        self.now_s = 0.0
        self.seen: list[Message] = []

    def send(self, *messages: Message) -> list[Message]:
        """Send messages and return the immediate answers."""
        for message in messages:
            for received in self.reader.read(self._from_station.pack(message)):
                self.node.receive(received, STATION, self.now_s)
        return self._over(self.node.answers())

    def run(self, seconds: float) -> list[Message]:
        """Let time pass in steps of 2 ms; return the reports."""
        seen = []
        for _ in range(round(seconds / 0.002)):
            self.now_s += 0.002
            self.node.step(self.now_s)
            seen += self._over(self.node.due(self.now_s))
        return seen

    def _over(self, messages: list[Message]) -> list[Message]:
        return [read for message in messages for read in self._in.read(self._out.pack(message))]


@pytest.fixture
def link() -> Link:
    return Link()


def command(number: int, *params: float) -> Message:
    return common.MAVLink_command_long_message(1, 1, number, 0, *params, *[0.0] * (7 - len(params)))


def result(answers: list[Message]) -> int:
    (ack,) = [answer for answer in answers if answer.get_type() == "COMMAND_ACK"]
    assert (ack.target_system, ack.target_component) == (255, 190)
    return int(ack.result)


def named(messages: list[Message], name: str) -> list[Message]:
    return [message for message in messages if message.get_type() == name]


def test_reports_come_at_their_rates(link: Link) -> None:
    counted = Counter(message.get_msgId() for message in link.run(4.0))
    for number, stream in telemetry.STREAMS.items():
        assert counted[number] == pytest.approx(4.0 * stream.rate_hz, rel=0.05, abs=1), number


def test_reports_turn_the_bases_axes_into_those_of_mavlink(link: Link) -> None:
    seen = {message.get_type(): message for message in link.run(2.0)}
    position, attitude, odometry = seen["LOCAL_POSITION_NED"], seen["ATTITUDE"], seen["ODOMETRY"]
    assert (position.x, position.y) == pytest.approx((2.0, -1.0))  # 1 m to the left is 1 m to the west
    assert (position.vx, position.vy) == pytest.approx((0.0, -0.5), abs=1e-6)
    assert attitude.yaw == pytest.approx(-math.pi / 2) and attitude.yawspeed == pytest.approx(-0.1)
    assert (odometry.vx, odometry.vy) == pytest.approx((0.5, 0.0)) and odometry.q[3] == pytest.approx(-math.sqrt(0.5))
    assert seen["VFR_HUD"].heading == 270 and seen["GLOBAL_POSITION_INT"].hdg == 27000
    assert seen["WHEEL_DISTANCE"].distance[0] == pytest.approx(2 * math.pi * telemetry.WHEEL_RADIUS_M)
    assert seen["SYS_STATUS"].battery_remaining == 80


@pytest.mark.parametrize("mode", list(Mode))
def test_a_heartbeat_contains_the_mode(link: Link, mode: Mode) -> None:
    link.send(setpoint(), command(common.MAV_CMD_DO_SET_MODE, 1, *mode.value))
    beat = named(link.run(0.01), "HEARTBEAT")[-1]
    assert beat.custom_mode == mode.custom_mode and beat.type == common.MAV_TYPE_GROUND_ROVER


@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        (command(common.MAV_CMD_COMPONENT_ARM_DISARM, 1), ACCEPTED),
        (command(common.MAV_CMD_COMPONENT_ARM_DISARM, 1, *[math.nan] * 6), ACCEPTED),
        (command(common.MAV_CMD_COMPONENT_ARM_DISARM, 2), DENIED),
        (command(common.MAV_CMD_COMPONENT_ARM_DISARM, 0, 12345), DENIED),
        (command(common.MAV_CMD_DO_SET_MODE, 1, 4, 3), ACCEPTED),
        (command(common.MAV_CMD_DO_SET_MODE, 1, 9, 9), DENIED),
        (command(common.MAV_CMD_SET_MESSAGE_INTERVAL, 32, 100_000), ACCEPTED),
        (command(common.MAV_CMD_SET_MESSAGE_INTERVAL, 99999, 100_000), DENIED),
        (command(common.MAV_CMD_SET_MESSAGE_INTERVAL, 0, -1), DENIED),
        (command(common.MAV_CMD_SET_MESSAGE_INTERVAL, math.inf, 1), DENIED),
        (command(common.MAV_CMD_REQUEST_MESSAGE, 148), ACCEPTED),
        (command(common.MAV_CMD_REQUEST_MESSAGE, 99999), DENIED),
        (command(common.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, 1), ACCEPTED),
        (command(common.MAV_CMD_DO_FLIGHTTERMINATION, 1), ACCEPTED),
        (command(common.MAV_CMD_NAV_TAKEOFF), UNSUPPORTED),
        (command(common.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1), UNSUPPORTED),
        (common.MAVLink_command_int_message(1, 1, 0, 400, 0, 0, 1, 0, 0, 0, 0, 0, 0), ACCEPTED),
    ],
)
def test_every_command_is_acknowledged(link: Link, asked: Message, expected: int) -> None:
    assert result(link.send(asked)) == expected


def test_a_message_that_is_requested_follows_the_acknowledgement(link: Link) -> None:
    answers = link.send(command(common.MAV_CMD_REQUEST_MESSAGE, 148))
    assert [answer.get_type() for answer in answers] == ["COMMAND_ACK", "AUTOPILOT_VERSION"]
    assert answers[1].capabilities & common.MAV_PROTOCOL_CAPABILITY_MAVLINK2


def test_a_requested_rate_is_limited_to_50_hz(link: Link) -> None:
    for interval_us, expected in ((100_000, 10), (1_000, 50), (-1, 0), (0, 20)):
        link.send(command(common.MAV_CMD_SET_MESSAGE_INTERVAL, 32, interval_us))
        assert len(named(link.run(1.0), "LOCAL_POSITION_NED")) == pytest.approx(expected, abs=1)


def test_messages_for_another_system_or_component_are_ignored(link: Link) -> None:
    for target in ((2, 1), (1, 154)):
        message = common.MAVLink_command_long_message(*target, 400, 0, 1, 0, 0, 0, 0, 0, 0)
        assert link.send(message) == [] and not link.node.vehicle.armed
    assert link.reader.counts.not_for_us == 2


def test_the_list_of_parameters_is_whole(link: Link) -> None:
    link.send(common.MAVLink_param_request_list_message(1, 1))
    assert [message.param_id for message in named(link.run(0.1), "PARAM_VALUE")] == list(NAMES)


def test_a_parameter_is_read_by_name_and_by_index_and_answered_when_set(link: Link) -> None:
    link.send(common.MAVLink_param_request_read_message(1, 1, b"COM_OF_LOSS_T", -1))
    link.send(common.MAVLink_param_request_read_message(1, 1, b"", 0))
    link.send(common.MAVLink_param_set_message(1, 1, b"COM_OF_LOSS_T", 0.75, common.MAV_PARAM_TYPE_REAL32))
    values = [(message.param_id, message.param_value) for message in named(link.run(0.1), "PARAM_VALUE")]
    assert [name for name, _ in values] == ["COM_OF_LOSS_T", NAMES[0], "COM_OF_LOSS_T"] and values[2][1] == 0.75


def test_there_is_no_mission_and_none_is_taken(link: Link) -> None:
    (count,) = link.send(common.MAVLink_mission_request_list_message(1, 1))
    assert count.get_type() == "MISSION_COUNT" and count.count == 0
    (ack,) = link.send(common.MAVLink_mission_count_message(1, 1, 3))
    assert ack.type == common.MAV_MISSION_UNSUPPORTED


def test_time_requests_are_answered_and_answers_are_not(link: Link) -> None:
    link.run(0.5)
    (answer,) = link.send(common.MAVLink_timesync_message(0, 77))
    assert answer.ts1 == 77 and answer.tc1 == pytest.approx(0.5e9)
    assert link.send(common.MAVLink_timesync_message(5, 77)) == []
    (back,) = link.send(common.MAVLink_ping_message(1, 9, 0, 0))
    assert back.seq == 9 and back.target_system == 255


def test_an_unusable_setpoint_is_counted_and_reported_once(link: Link) -> None:
    answers = link.send(*[setpoint(mask=0)] * 5)
    assert link.reader.counts.unusable == 5
    assert [answer.get_type() for answer in answers] == ["STATUSTEXT"]


_CLASSES = sorted(common.mavlink_map.items())


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(_CLASSES), st.binary(min_size=255, max_size=255)), max_size=8))
def test_any_content_of_any_message_is_harmless(chosen: list[tuple[tuple[int, type], bytes]]) -> None:
    """Whole packets with random fields: it goes on, its speed stays finite and within the limits."""
    link = Link()
    for (number, kind), content in chosen:
        payload = content[: kind.unpacker.size]  # type: ignore[attr-defined]
        head = bytes((0xFD, len(payload), 0, 0, 0, 255, 190)) + number.to_bytes(3, "little")
        crc = common.x25crc(head[1:] + payload)
        crc.accumulate(bytes((kind.crc_extra,)))  # type: ignore[attr-defined]
        for message in link.reader.read(head + payload + crc.crc.to_bytes(2, "little")):
            # To us, so that it is not left alone.
            for name, value in (("target_system", 1), ("target_component", 1), ("target", 1)):
                if hasattr(message, name):
                    setattr(message, name, value)
            link.node.receive(message, STATION, link.now_s)
        link.run(0.004)
    assert link.reader.counts.broken == 0
    vx, _, wz = link.base.velocity
    assert abs(vx) <= 1.5 and abs(wz) <= math.radians(115) + 1e-9
