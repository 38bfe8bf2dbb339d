"""The table [ros2] of a robot file: topic names, and what a base without a command timeout needs."""

from __future__ import annotations

from pathlib import Path

import pytest

from firmware_bridge.core.config import ConfigError, load_robot_config
from firmware_bridge.core.config_ros2 import Ros2Config, dds_topic
from tests.support.processes import GO2_SIM

CARTER_ROS2 = GO2_SIM.with_name("carter_ros2_sim.toml")


@pytest.mark.parametrize("name", ["carter_ros2_sim.toml", "ros2_base.toml"])
def test_the_shipped_files_are_valid(name: str) -> None:
    config = load_robot_config(GO2_SIM.with_name(name))
    assert config.protocol == "ros2" and config.ros2 is not None


@pytest.mark.parametrize(
    ("namespace", "name", "topic"),
    [
        ("/", "cmd_vel", "rt/cmd_vel"),
        ("/robot1", "cmd_vel", "rt/robot1/cmd_vel"),
        ("/robot1", "/cmd_vel", "rt/cmd_vel"),
        ("/a/b", "c/d_e", "rt/a/b/c/d_e"),
    ],
)
def test_a_topic_is_relative_to_the_namespace_or_full(namespace: str, name: str, topic: str) -> None:
    assert dds_topic(name, namespace) == topic
    assert Ros2Config(500, namespace=namespace, command=name).topic(name) == topic


@pytest.mark.parametrize(
    "name",
    ["a//b", "a/", "1a", "a/2b", "a-b", "a b", "~/a", "{node}/a", "a__b", "/", "ä", "a\n", "a" * 201, "a\0", "/a/"],
)
def test_an_illegal_topic_name_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=r"ros2\.odometry: expected a ROS 2 topic name"):
        Ros2Config(500, odometry=name)


@pytest.mark.parametrize("namespace", ["robot1", "/robot1/", "", "//", "/a__b", "/1"])
def test_an_illegal_namespace_is_refused(namespace: str) -> None:
    with pytest.raises(ConfigError, match=r"ros2\.namespace"):
        Ros2Config(500, namespace=namespace)


def test_two_keys_with_one_topic_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"ros2\.command: expected a topic of its own, found that of ros2\.odometry"):
        Ros2Config(500, odometry="/cmd_vel")


@pytest.mark.parametrize("timeout_ms", [0, 2001])
def test_a_base_that_does_not_stop_by_itself_needs_supervision(timeout_ms: int) -> None:
    with pytest.raises(ConfigError, match=r"ros2\.base_timeout_ms: .*supervised = true"):
        Ros2Config(timeout_ms)
    assert Ros2Config(timeout_ms, supervised=True).supervised


@pytest.mark.parametrize(
    ("before", "after", "complaint"),
    [
        ("base_timeout_ms = 500", "", "missing key ros2.base_timeout_ms"),
        ("base_timeout_ms = 500", "base_timeout_ms = -1", "ros2.base_timeout_ms: expected 0..60000, found -1"),
        ('command = "cmd_vel"', 'cmd = "cmd_vel"', "unknown key ros2.cmd"),
        ('imu = "imu"', 'imu = ""', "ros2.imu: expected str"),
        ('imu = "imu"', 'input_reliability = "sensor"', 'ros2.input_reliability: expected "best_effort" or "reliable"'),
        ('imu = "imu"', 'command_reliability = "best"', "ros2.command_reliability: expected"),
        ("domain = 0", "domain = 0\nparticipants = 121", "dds.participants: expected 1..120, found 121"),
        ('battery = "battery_state"', "", "missing key ros2.battery"),
        ("battery_min_percent = 10", 'sport_version = "1"', "safety.sport_version: only protocol unitree"),
        ("vy_max_mps = 0.0", "vy_max_mps = 0.6", "limits.vy_max_mps: expected 0.5 at most"),
    ],
)
def test_a_wrong_file_is_refused_in_one_line(tmp_path: Path, before: str, after: str, complaint: str) -> None:
    text, path = CARTER_ROS2.read_text(), tmp_path / "robot.toml"
    assert before in text
    path.write_text(text.replace(before, after))
    with pytest.raises(ConfigError) as error:
        load_robot_config(path)
    assert complaint in str(error.value) and "\n" not in str(error.value)


def written(tmp_path: Path, robot: str, ros2: str) -> Path:
    """A shipped robot file with further lines in its [ros2]."""
    text, path = GO2_SIM.with_name(robot).read_text(), tmp_path / "robot.toml"
    before, _, after = text.partition("\n[ros2]")
    comment, _, after = after.partition("\n")
    path.write_text(f"{before}\n[ros2]{comment}\n{ros2}\n{after}")
    return path


def test_nothing_is_published_unless_asked() -> None:
    assert not load_robot_config(GO2_SIM).ros2_publish.publish


def test_a_go2_publishes_on_its_own_network_unless_another_is_named(tmp_path: Path) -> None:
    config = load_robot_config(written(tmp_path, "go2_sim.toml", "publish = true"))
    assert config.ros2_publish.network(config.dds) == config.dds and config.ros2 is None
    more = 'publish = true\npublish_interface = "wlan0"\npublish_domain = 7'
    other = load_robot_config(written(tmp_path, "go2_sim.toml", more))
    network = other.ros2_publish.network(other.dds)
    assert (network.interface, network.domain, network.peers) == ("wlan0", 7, ())


def test_a_robot_without_dds_names_the_interface(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"missing key ros2\.publish_interface"):
        load_robot_config(written(tmp_path, "carter_can_sim.toml", "publish = true"))
    config = load_robot_config(written(tmp_path, "carter_can_sim.toml", 'publish = true\npublish_interface = "lo"'))
    assert config.ros2_publish.network(config.dds).domain == 0 and config.ros2 is None


def test_the_topics_of_a_ros2_base_are_never_published_a_second_time(tmp_path: Path) -> None:
    """The bridge would stop: a second publisher of its odometry is another robot or a forger."""
    with pytest.raises(ConfigError, match=r"ros2\.publish_namespace: expected one that the base does not use"):
        load_robot_config(written(tmp_path, "carter_ros2_sim.toml", "publish = true"))
    path = written(tmp_path, "carter_ros2_sim.toml", 'publish = true\npublish_namespace = "/tic_vla"')
    assert load_robot_config(path).ros2_publish.topic("odom") == "rt/tic_vla/odom"


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ('instruction = "instruction"', 'instruction = "/tic_vla/reasoning"'),
        ('source = "ros2:/camera/image/compressed"', 'source = "ros2:/tic_vla/camera/image/compressed"'),
    ],
)
def test_the_runner_never_reads_what_it_publishes(tmp_path: Path, before: str, after: str) -> None:
    path = written(tmp_path, "carter_ros2_sim.toml", 'publish = true\npublish_namespace = "/tic_vla"')
    assert before in path.read_text()
    path.write_text(path.read_text().replace(before, after))
    with pytest.raises(ConfigError, match=r"ros2\.publish_namespace: expected one that the base does not use"):
        load_robot_config(path)


@pytest.mark.parametrize(
    ("lines", "complaint"),
    [
        ("publish = 1", "ros2.publish: expected bool, found 1"),
        ('publish = true\nodometry = "o"', "unknown key ros2.odometry: protocol unitree has only ros2.publish"),
        ('publish = true\npublish_namespace = "x"', "ros2.publish_namespace: expected"),
        ("publish = true\npublish_domain = 233", "ros2.publish_domain: expected -1..232, found 233"),
        ('publish = true\npublish_interface = "a<b"', "ros2.publish_interface: expected a name or an address"),
        ("[ros2_publish]\npublish = true", "unknown key ros2_publish"),
        ('command = "c"', "unknown key ros2.command: protocol unitree has only ros2.publish"),
    ],
)
def test_a_wrong_key_of_publishing_is_refused_in_one_line(tmp_path: Path, lines: str, complaint: str) -> None:
    with pytest.raises(ConfigError) as error:
        load_robot_config(written(tmp_path, "go2_sim.toml", lines))
    assert complaint in str(error.value) and "\n" not in str(error.value)
