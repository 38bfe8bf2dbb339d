"""`edge-doctor` and the topics of a ROS 2 base: who publishes and subscribes, with which type and QoS, how often."""

from __future__ import annotations

import contextlib
import threading
import time
from dataclasses import replace
from typing import Any

import pytest

from edge.deploy.doctor.check import Level
from edge.deploy.doctor.topics import (
    Endpoint,
    Survey,
    TopicUse,
    dds_type,
    judge,
    ros2_topics,
    survey_domain,
    topic_uses,
)
from firmware_bridge.core.config import RobotConfig, load_robot_config
from firmware_bridge.core.robot_state import DdsError
from firmware_bridge.dds.bus import DDS_ERRORS, Bus
from tests.support.processes import GO2_SIM
from tests.support.robot.fake_ros2_base import FakeRos2Base, second_bus

CARTER = GO2_SIM.with_name("carter_ros2_sim.toml")
ODOMETRY = TopicUse("ros2.odometry", "rt/odom", "nav_msgs/msg/Odometry", False, alone=True, least_hz=10.0)
COMMAND = TopicUse("ros2.command", "rt/cmd_vel", "geometry_msgs/msg/Twist", True, commands=True)
INSTRUCTION = TopicUse("ros2.instruction", "rt/instruction", "std_msgs/msg/String", True)
CAMERA = TopicUse("camera.source", "rt/image", "sensor_msgs/msg/CompressedImage", False, least_hz=8.0)


def end_of(use: TopicUse, message: str = "", *, reliable: bool = True) -> Endpoint:
    """The endpoint of another node that fits a use, with changes."""
    return Endpoint(use.topic, dds_type(message or use.message), not use.commands, reliable, "base")


def watcher(use: TopicUse) -> list[Endpoint]:
    """The endpoints of a program that publishes on a topic and reads what others publish there."""
    return [replace(end_of(use), publishes=publishes, participant="bridge") for publishes in (True, False)]


def robot(domain: int = 0, **changes: Any) -> RobotConfig:
    config = load_robot_config(CARTER, domain=domain)
    assert config.ros2 is not None
    return replace(config, ros2=replace(config.ros2, **changes))


@pytest.mark.parametrize(
    ("use", "ends", "rate_hz", "level", "text"),
    [
        (ODOMETRY, [end_of(ODOMETRY)], 50.0, Level.OK, "1 publisher, 50.0 messages a second"),
        (ODOMETRY, [end_of(ODOMETRY, reliable=False)], 50.0, Level.OK, "1 publisher"),
        (ODOMETRY, [], 0.0, Level.FAIL, "no publisher of any type; start the node; compare ros2.odometry"),
        (ODOMETRY, [end_of(ODOMETRY)], 4.0, Level.FAIL, "4.0 messages a second; raise the node's rate"),
        (
            ODOMETRY,
            [end_of(ODOMETRY)] * 2,
            50.0,
            Level.FAIL,
            "2 publishers, 50.0 messages a second; the bridge",
        ),
        (ODOMETRY, [end_of(ODOMETRY, "nav_msgs/msg/Path")], 0.0, Level.FAIL, "1 publishers of nav_msgs/Path"),
        (
            replace(ODOMETRY, reliable=True),
            [end_of(ODOMETRY, reliable=False)],
            0.0,
            Level.FAIL,
            'write ros2.input_reliability = "best_effort"',
        ),
        (COMMAND, [end_of(COMMAND)], 0.0, Level.OK, "1 subscriber"),
        (COMMAND, [], 0.0, Level.FAIL, "no subscriber of any type"),
        (COMMAND, watcher(COMMAND), 0.0, Level.FAIL, "no subscriber of any type"),
        (COMMAND, [end_of(COMMAND), *watcher(COMMAND)], 0.0, Level.OK, "1 subscriber"),
        (COMMAND, [end_of(COMMAND, "geometry_msgs/msg/TwistStamped")], 0.0, Level.FAIL, "correct ros2.stamped"),
        (replace(COMMAND, reliable=False), [end_of(COMMAND, reliable=False)], 0.0, Level.OK, "1 subscriber"),
        (
            replace(COMMAND, reliable=False),
            [end_of(COMMAND)],
            0.0,
            Level.FAIL,
            'write ros2.command_reliability = "reliable"',
        ),
        (INSTRUCTION, [], 0.0, Level.OK, "no publisher yet"),
        (INSTRUCTION, [end_of(INSTRUCTION, reliable=False)], 0.0, Level.FAIL, "a lost stop phrase"),
        (CAMERA, [end_of(CAMERA)], 5.0, Level.WARN, "5.0 messages a second"),
        (CAMERA, [end_of(CAMERA)], 0.0, Level.FAIL, "0.0 messages a second"),
    ],
)
def test_a_topic_is_judged_by_its_endpoints_and_its_rate(
    use: TopicUse, ends: list[Endpoint], rate_hz: float, level: Level, text: str
) -> None:
    check = judge(use, Survey(ends, {use.topic: rate_hz}))
    assert check.level is level and text in f"{check.found}; {check.advice}"


def test_every_topic_of_the_robot_file_is_checked_under_its_full_name() -> None:
    found = [(use.topic, use.message) for use in topic_uses(robot(namespace="/robot1", stamped=True))]
    assert found == [
        ("rt/robot1/odom", "nav_msgs/msg/Odometry"),
        ("rt/robot1/imu", "sensor_msgs/msg/Imu"),
        ("rt/robot1/battery_state", "sensor_msgs/msg/BatteryState"),
        ("rt/robot1/instruction", "std_msgs/msg/String"),
        ("rt/robot1/cmd_vel", "geometry_msgs/msg/TwistStamped"),
        ("rt/camera/image/compressed", "sensor_msgs/msg/CompressedImage"),
    ]
    assert topic_uses(load_robot_config(GO2_SIM)) == []


@pytest.mark.parametrize("error", [DdsError("cannot join"), ModuleNotFoundError("No module named 'cyclonedds'")])
def test_a_domain_that_cannot_be_joined_skips_the_topics(error: Exception) -> None:
    def fail(_robot: RobotConfig, _uses: object) -> Survey:
        raise error

    [check] = ros2_topics(robot(), fail)
    assert check.level is Level.SKIP and str(error) in check.found


@pytest.mark.slow
def test_a_domain_is_surveyed_by_discovery_and_by_counting(dds_domain: int) -> None:
    """The doctor's participant is the first of this process; the base joins after it."""
    config = robot(dds_domain)
    ended = threading.Event()

    def publish() -> None:
        time.sleep(0.2)
        base = FakeRos2Base(second_bus(dds_domain))
        with contextlib.suppress(*DDS_ERRORS):  # the doctor leaves the domain and takes this process's base with it
            while not ended.wait(0.02):
                base.report()

    node = threading.Thread(target=publish)
    node.start()
    try:
        checks = ros2_topics(config, lambda of, uses: survey_domain(of, uses, measure_s=3.0))
    finally:
        ended.set()
        node.join()
    by_name = {check.name: check for check in checks}
    for topic in ("/odom", "/imu", "/battery_state", "/cmd_vel"):
        assert by_name[f"topic {topic}"].level is Level.OK, by_name[f"topic {topic}"]
    assert "1 publisher, " in by_name["topic /odom"].found and by_name["topic /cmd_vel"].found == "1 subscriber"
    assert by_name["topic /camera/image/compressed"].level is Level.FAIL
    Bus(config.network).close()  # the domain is free for the camera and the bridge's reader
