"""What discovery announces of the endpoints of the bridge and the runner, against what rclpy announces and accepts."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from typing import Any

import pytest
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription
from cyclonedds.qos import Policy

from edge.robot.cameras.ros2 import Ros2Camera
from edge.run.ros2_instructions import Ros2Instructions
from firmware_bridge.core.config import DdsConfig
from firmware_bridge.core.robot_state import DdsError
from firmware_bridge.dds.bus import Bus
from firmware_bridge.dds.shared_bus import SharedBus
from firmware_bridge.ros2.robot_link import RobotLink
from tests.firmware_bridge.ros2.test_ros2_robot_link import settings_of
from tests.support.processes import wait_for
from tests.support.robot.fake_ros2_base import FakeRos2Base, second_bus

NEVER = 2**63 - 1  # DDS's infinity, ns
RELIABLE, BEST_EFFORT = "Reliable", "BestEffort"
# rclpy, `ros2 topic info --verbose`: every profile but parameters and services is volatile, without deadline or
# lifespan, with automatic liveliness; "sensor data" is best effort, the default and "system default" are reliable.
BRIDGE = {
    ("rt/cmd_vel", "publishes"): ("geometry_msgs::msg::dds_::Twist_", RELIABLE),
    ("rt/cmd_vel", "subscribes"): ("geometry_msgs::msg::dds_::Twist_", BEST_EFFORT),
    ("rt/odom", "subscribes"): ("nav_msgs::msg::dds_::Odometry_", BEST_EFFORT),
    ("rt/imu", "subscribes"): ("sensor_msgs::msg::dds_::Imu_", BEST_EFFORT),
    ("rt/battery_state", "subscribes"): ("sensor_msgs::msg::dds_::BatteryState_", BEST_EFFORT),
}
RUNNER = {
    ("rt/image", "subscribes"): ("sensor_msgs::msg::dds_::CompressedImage_", BEST_EFFORT),
    ("rt/image_raw", "subscribes"): ("sensor_msgs::msg::dds_::Image_", BEST_EFFORT),
    ("rt/instruction", "subscribes"): ("std_msgs::msg::dds_::String_", RELIABLE),
}


class Discovery:
    """Everything that a domain announces, by topic and direction."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus  # its participant ends when Python forgets it
        self._readers = {
            "publishes": BuiltinDataReader(bus.participant, BuiltinTopicDcpsPublication),
            "subscribes": BuiltinDataReader(bus.participant, BuiltinTopicDcpsSubscription),
        }
        self.found: dict[tuple[str, str], Any] = {}

    def until(self, expected: set[tuple[str, str]]) -> dict[tuple[str, str], Any]:
        wait_for(lambda: self._poll() >= expected, 5, "the announcements")
        return self.found

    def _poll(self) -> set[tuple[str, str]]:
        for direction, reader in self._readers.items():
            for one in reader.take(32):
                if one.topic_name.startswith("rt/"):
                    self.found[one.topic_name, direction] = one
        return set(self.found)


def reliability(one: Any) -> str:
    return type(one.qos[Policy.Reliability]).__name__.rpartition(".")[2]


def check(found: dict[tuple[str, str], Any], expected: dict[tuple[str, str], tuple[str, str]]) -> None:
    assert {key: (one.type_name, reliability(one)) for key, one in found.items()} == expected
    for one in found.values():
        assert one.qos[Policy.Durability] == Policy.Durability.Volatile
        assert one.qos[Policy.Deadline] == Policy.Deadline(NEVER)
        assert one.qos[Policy.Liveliness] == Policy.Liveliness.Automatic(NEVER)
        assert one.qos[Policy.Ownership] == Policy.Ownership.Shared
        assert one.qos[Policy.DestinationOrder] == Policy.DestinationOrder.ByReceptionTimestamp
        assert Policy.Partition not in one.qos
        # rclpy writes and reads the first encoding of CDR only.
        assert one.qos[Policy.DataRepresentation].use_cdrv0_representation


def test_the_bridge_is_announced_as_rclpy_announces_a_controller(dds_domain: int) -> None:
    link = RobotLink(settings_of(dds_domain), lambda _: None)
    try:
        check(Discovery(second_bus(dds_domain)).until(set(BRIDGE)), BRIDGE)
    finally:
        link.close()


def test_a_stamped_command_in_a_namespace_is_announced_with_its_type_and_full_name(dds_domain: int) -> None:
    link = RobotLink(settings_of(dds_domain, stamped=True, namespace="/robot1"), lambda _: None)
    try:
        found = Discovery(second_bus(dds_domain)).until({("rt/robot1/cmd_vel", "publishes")})
        command = found["rt/robot1/cmd_vel", "publishes"]
        assert command.type_name == "geometry_msgs::msg::dds_::TwistStamped_"
    finally:
        link.close()


def test_the_runner_is_announced_as_rclpys_subscribers(dds_domain: int) -> None:
    with ExitStack() as stack:
        shared = SharedBus(DdsConfig(dds_domain, "lo", ("127.0.0.1",)))
        stack.callback(shared.close)
        for topic, raw in (("/image", False), ("/image_raw", True)):
            stack.enter_context(closing(Ros2Camera(shared, topic, raw)))
        instructions = Ros2Instructions(shared, "rt/instruction", lambda _: None, lambda: True, lambda _: None)
        check(Discovery(shared.open()).until(set(RUNNER)), RUNNER)
        instructions.close()


Opener = Callable[..., tuple[RobotLink, FakeRos2Base]]


@pytest.fixture
def opened(dds_domain: int) -> Iterator[Opener]:
    """The link and a base whose publishers and subscriber are reliable, or best effort."""
    links: list[RobotLink] = []

    def open_both(*, base_reliable: bool, **changes: str) -> tuple[RobotLink, FakeRos2Base]:
        links.append(RobotLink(settings_of(dds_domain, **changes), lambda _: None))
        return links[0], FakeRos2Base(second_bus(dds_domain), reliable=base_reliable)

    yield open_both
    links[0].close()


@pytest.mark.parametrize(
    ("base_reliable", "changes", "hears", "matches"),
    [
        (True, {}, True, True),
        (False, {}, True, True),
        (True, {"input_reliability": "reliable"}, True, True),
        (False, {"input_reliability": "reliable"}, False, True),
        (True, {"command_reliability": "best_effort"}, True, False),
        (False, {"command_reliability": "best_effort"}, True, True),
    ],
)
def test_the_robot_files_qos_decides_which_bases_match(
    opened: Opener, base_reliable: bool, changes: dict[str, str], hears: bool, matches: bool
) -> None:
    """Defaults match every base; without a match the bridge has no state, or says that nothing takes its commands."""
    link, base = opened(base_reliable=base_reliable, **changes)
    heard = matched = False
    end_ns = time.monotonic_ns() + (5_000_000_000 if hears and matches else 700_000_000)
    while time.monotonic_ns() < end_ns and not (heard and matched):
        base.report()
        report = link.read(time.monotonic_ns())
        heard = heard or report.state is not None
        matched = matched or report.unsafe is None or "no node subscribes" not in report.unsafe
        time.sleep(0.02)
    assert (heard, matched) == (hears, matches)


def test_a_machine_full_of_nodes_needs_room_for_more_participants(dds_domain: int) -> None:
    """Ports of the first ten participants are taken, as on a robot's computer with ten ROS 2 nodes."""
    with ExitStack() as stack:
        for number in range(10):
            for offset in (10, 11):  # DDSI-RTPS 2.5, 9.6.2.4: unicast discovery and unicast data
                taken = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
                taken.bind(("0.0.0.0", 7400 + 250 * dds_domain + offset + 2 * number))
        with pytest.raises(DdsError, match=r"at most 10 programs .*dds\.participants"):
            Bus(DdsConfig(dds_domain, "lo", ("127.0.0.1",)))
        Bus(DdsConfig(dds_domain, "lo", ("127.0.0.1",), participants=12)).close()
