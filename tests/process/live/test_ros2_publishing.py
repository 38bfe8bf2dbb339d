"""The process that publishes a run as a ROS 2 node: what it announces, what arrives, and how it ends."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from typing import Any

import psutil
import pytest

from edge.live.feed import Ros2Feed
from edge.live.options import LiveError
from edge.live.ros2_messages import KINDS
from firmware_bridge.core.config import DdsConfig, RobotConfig, load_robot_config
from firmware_bridge.core.config_ros2 import Ros2PublishConfig
from firmware_bridge.dds.bus import Bus, take_each
from tests.edge.live.test_live_ros2_messages import tick
from tests.edge.live.test_live_view import MOUNT, SIZE
from tests.firmware_bridge.ros2.test_ros2_announcements import RELIABLE, Discovery, check
from tests.support.processes import GO2_SIM, wait_for

pytestmark = pytest.mark.process

# rclpy 7.1 (Jazzy), `ros2 topic info --verbose` of a publisher of each type with the default profile.
ANNOUNCED = {
    ("rt/watch/odom", "publishes"): ("nav_msgs::msg::dds_::Odometry_", RELIABLE),
    ("rt/watch/tf", "publishes"): ("tf2_msgs::msg::dds_::TFMessage_", RELIABLE),
    ("rt/watch/camera/image/compressed", "publishes"): ("sensor_msgs::msg::dds_::CompressedImage_", RELIABLE),
    ("rt/watch/camera/camera_info", "publishes"): ("sensor_msgs::msg::dds_::CameraInfo_", RELIABLE),
    ("rt/watch/plan", "publishes"): ("nav_msgs::msg::dds_::Path_", RELIABLE),
    ("rt/watch/diagnostics", "publishes"): ("diagnostic_msgs::msg::dds_::DiagnosticArray_", RELIABLE),
    ("rt/watch/reasoning", "publishes"): ("std_msgs::msg::dds_::String_", RELIABLE),
    ("rt/watch/delta_t", "publishes"): ("std_msgs::msg::dds_::Float64_", RELIABLE),
}


def robot(domain: int, **changed: Any) -> RobotConfig:
    publish = Ros2PublishConfig(publish=True, publish_namespace="/watch", **changed)
    return replace(load_robot_config(GO2_SIM, domain=domain), ros2_publish=publish)


@pytest.fixture
def feed(dds_domain: int) -> Iterator[Ros2Feed]:
    with closing(Ros2Feed(robot(dds_domain), lambda line: None)) as found:
        yield found


@pytest.fixture
def listener(dds_domain: int) -> Iterator[Bus]:
    bus = Bus(DdsConfig(dds_domain, "lo", ("127.0.0.1",)))
    yield bus
    bus.close()


def put_all(feed: Ros2Feed) -> None:
    now = time.monotonic_ns()
    feed.put("/run", now, {"instruction": "go", "mount": MOUNT})
    feed.put("/camera", now, SIZE + bytes(20_000))
    feed.put("/tick", now, {**tick(), "now_ns": now})
    feed.put("/odometry", now, {"pose": (1.0, 2.0, 0.0), "velocity": (0.3, 0.0, 0.0)})
    feed.put("/semantic", now, {"text": "Scene: a corridor.", "anchor_pose": None, "waypoints": None})


@pytest.mark.slow
def test_it_is_announced_as_rclpy_announces_publishers(feed: Ros2Feed, listener: Bus) -> None:
    check(Discovery(listener).until(set(ANNOUNCED)), ANNOUNCED)


def test_every_topic_arrives_at_a_reliable_and_at_a_best_effort_subscriber(feed: Ros2Feed, listener: Bus) -> None:
    readers = {
        (topic, reliable): listener.reader(f"rt/watch/{topic}", kind, depth=8, reliable=reliable)
        for topic, kind in KINDS.items()
        for reliable in (True, False)
    }
    newest: dict[tuple[str, bool], Any] = {}

    def all_came() -> bool:
        put_all(feed)
        for key, reader in readers.items():
            for sample in take_each(reader):
                newest[key] = sample
        return newest.keys() == readers.keys()

    wait_for(all_came, 10, "a message of every topic")
    assert newest["odom", True].pose.pose.position.x == 1.0
    assert newest["reasoning", False].data == "Scene: a corridor."
    stamp = newest["odom", True].header.stamp
    assert abs(stamp.sec - time.clock_gettime(time.CLOCK_REALTIME)) < 5


@pytest.mark.slow
def test_it_reads_nothing_from_the_network(feed: Ros2Feed, listener: Bus) -> None:
    found = Discovery(listener).until(set(ANNOUNCED))
    assert {direction for _, direction in found} == {"publishes"}


def test_a_network_that_cannot_be_joined_is_one_line(dds_domain: int) -> None:
    with pytest.raises(LiveError, match=r"^ros2\.publish: DDS: cannot join domain \d+ on interface 'none0'[^\n]*$"):
        Ros2Feed(robot(dds_domain, publish_interface="none0"), lambda line: None)


@pytest.mark.slow
def test_it_ends_with_the_runner(feed: Ros2Feed) -> None:
    process = next(each for each in psutil.Process().children() if "edge.live.ros2_publisher" in each.cmdline())
    feed.close()
    process.wait(5)
    assert not process.is_running()


@pytest.mark.slow
def test_a_frozen_process_costs_records_and_nobody_waits(feed: Ros2Feed) -> None:
    process = next(each for each in psutil.Process().children() if "edge.live.ros2_publisher" in each.cmdline())
    process.suspend()
    longest_s, deadline = 0.0, time.monotonic() + 20
    try:
        while feed.dropped == 0 and time.monotonic() < deadline:
            begin = time.monotonic()
            feed.put("/camera", 1, SIZE + bytes(200_000))
            longest_s = max(longest_s, time.monotonic() - begin)
            time.sleep(0.01)
        assert feed.dropped > 0 and longest_s < 0.05
    finally:
        process.resume()
