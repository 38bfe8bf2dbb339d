"""Rights of the services by protocol and camera: what the robot's link needs, and nothing else."""

from __future__ import annotations

import shutil
from dataclasses import replace
from ipaddress import IPv4Network
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from edge.deploy.link_rights import LinkRights, file_group, link_rights, serial_device
from edge.deploy.unit_check import check_units
from edge.deploy.unit_text import UnitError
from edge.deploy.units import BRIDGE_UNIT, FIREWALL_UNIT, RUNNER_UNIT, ServiceInputs, bridge_unit, runner_unit
from firmware_bridge.core.config import load_robot_config
from firmware_bridge.core.config_ros2 import Ros2PublishConfig
from tests.edge.deploy.test_units import inputs, settings
from tests.support.processes import GO2_SIM

HTTP = "http://127.0.0.1:8080/stream.mjpg"


def robot(
    *, can: str = "", channel: str = "can0", mavlink: str = "", key: Path | None = None, source: str = HTTP
) -> Any:
    """A robot file's parts that decide about rights."""
    return SimpleNamespace(
        dds=None,
        can=SimpleNamespace(interface=can, channel=channel, bitrate_bps=500_000) if can else None,
        mavlink=SimpleNamespace(link=mavlink, signing_key=key) if mavlink else None,
        camera=SimpleNamespace(source=source),
        ros2_publish=Ros2PublishConfig(),
    )


def rights(of: Any) -> LinkRights:
    return link_rights(of, lambda _path: None)


def without_dds(link: LinkRights) -> ServiceInputs:
    return inputs(interface="", networks=(), own=(), link=link)


def units_of(of: Any) -> tuple[dict[str, list[str]], dict[str, list[str]]]:
    made = without_dds(rights(of))
    return settings(bridge_unit(made)), settings(runner_unit(made))


def test_a_go2_keeps_the_rights_that_it_had() -> None:
    assert link_rights(load_robot_config(GO2_SIM)) == LinkRights()


@pytest.mark.parametrize("interface", ["", "lo", "wlan0"])
def test_a_service_publishes_on_the_network_of_its_robot_alone(interface: str) -> None:
    go2 = load_robot_config(GO2_SIM)
    publishing = replace(go2, ros2_publish=Ros2PublishConfig(publish=True, publish_interface=interface))
    if interface == "wlan0":
        with pytest.raises(UnitError, match=r"ros2\.publish_interface: a service reaches the robot's network alone"):
            link_rights(publishing)
    else:
        assert link_rights(publishing) == link_rights(go2)


def test_a_socketcan_bridge_gets_its_socket_family_and_no_network() -> None:
    bridge, runner = units_of(robot(can="socketcan"))
    assert bridge["RestrictAddressFamilies"] == ["AF_UNIX AF_NETLINK AF_CAN"]
    assert bridge["IPAddressDeny"] == ["any"] and "IPAddressAllow" not in bridge
    assert bridge["PrivateDevices"] == ["yes"]
    assert runner["RestrictAddressFamilies"] == ["AF_UNIX AF_INET AF_NETLINK"]
    assert runner["IPAddressAllow"] == ["127.0.0.1/32"]


@pytest.mark.parametrize(
    ("link", "driver"),
    [("serial:/dev/ttyACM0:57600", "char-ttyACM"), ("serial:/dev/ttyTHS1:921600", "char-ttyTHS")],
)
def test_a_serial_bridge_may_open_its_line_and_no_other_device(link: str, driver: str) -> None:
    bridge, runner = units_of(robot(mavlink=link))
    device = link.split(":")[1]
    assert bridge["DeviceAllow"] == [f'"{device}" rw', f"{driver} rw"]
    assert bridge["SupplementaryGroups"] == ["tic-vla-runner tic-vla-operators dialout"]
    assert bridge["DevicePolicy"] == ["closed"] and "PrivateDevices" not in bridge
    assert bridge["RestrictAddressFamilies"] == ["AF_UNIX AF_NETLINK"] and "IPAddressAllow" not in bridge
    assert "DeviceAllow" not in runner and runner["PrivateDevices"] == ["yes"]


def test_the_group_of_the_line_is_that_of_its_device() -> None:
    assert link_rights(robot(can="serial", channel="/dev/ttyUSB0"), lambda _path: "uucp").bridge_groups == ("uucp",)


def test_a_bridge_over_udp_may_reach_the_autopilot_only() -> None:
    bridge, runner = units_of(robot(mavlink="udp:192.168.7.2:14550"))
    assert bridge["IPAddressAllow"] == ["192.168.7.2/32"]
    assert runner["IPAddressAllow"] == ["127.0.0.1/32"]


def test_the_signing_key_is_bound_for_the_bridge_alone() -> None:
    bridge, runner = units_of(robot(mavlink="udp:192.168.7.2:14550", key=Path("/root/key")))
    assert bridge["BindReadOnlyPaths"] == ['"/root/key"']
    assert "BindReadOnlyPaths" not in runner


@pytest.mark.parametrize(
    ("source", "devices"),
    [
        ("v4l2:/dev/video2", ['"/dev/video2" rw', "char-video4linux rw"]),
        ("gstreamer:v4l2src ! appsink", ["char-video4linux rw"]),
    ],
)
def test_the_runner_may_open_its_camera(source: str, devices: list[str]) -> None:
    bridge, runner = units_of(robot(can="socketcan", source=source))
    assert runner["DeviceAllow"] == devices and runner["SupplementaryGroups"] == ["video"]
    assert "IPAddressAllow" not in runner and "PrivateDevices" not in runner
    assert "DeviceAllow" not in bridge


def test_without_dds_there_is_no_firewall_and_no_wait_for_the_network() -> None:
    made = without_dds(rights(robot(can="socketcan")))
    text = bridge_unit(made) + runner_unit(made)
    assert FIREWALL_UNIT not in text and "network-online.target" not in text and "239.255.0.1" not in text


def test_with_dds_a_camera_server_is_let_through_for_the_runner_only() -> None:
    made = inputs(link=LinkRights(camera_host=IPv4Network("10.0.0.9/32")))
    assert "10.0.0.9/32" in settings(runner_unit(made))["IPAddressAllow"][0]
    assert "10.0.0.9/32" not in settings(bridge_unit(made))["IPAddressAllow"][0]


@pytest.mark.parametrize(
    ("of", "message"),
    [
        (robot(can="virtual"), "can.interface: expected socketcan or serial for a service, found virtual"),
        (robot(can="socketcan", source="http://camera.local/s"), "camera.source: expected an IPv4 address"),
        (robot(mavlink="udp:rover:14550"), "mavlink.link: expected an IPv4 address"),
    ],
)
def test_a_link_that_no_filter_can_describe_is_refused(of: Any, message: str) -> None:
    with pytest.raises(UnitError, match=message):
        rights(of)


def test_only_a_serial_link_has_a_device() -> None:
    assert serial_device(robot(mavlink="serial:/dev/serial/by-id/usb-A:1:57600")) == Path("/dev/serial/by-id/usb-A:1")
    assert serial_device(robot(can="socketcan")) is None and serial_device(robot(mavlink="udp:1.2.3.4:5")) is None


def test_a_device_that_is_absent_has_no_group(tmp_path: Path) -> None:
    assert file_group(tmp_path / "ttyUSB0") is None and file_group(tmp_path) is not None


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd-analyze here")
@pytest.mark.parametrize(
    "of",
    [
        robot(can="socketcan", source="v4l2:/dev/video0"),
        robot(mavlink="serial:/dev/ttyACM0:57600"),
        robot(mavlink="udp:192.168.7.2:14550"),
    ],
    ids=["can", "serial", "udp"],
)
def test_systemd_accepts_the_units_of_every_protocol(of: Any, tmp_path: Path) -> None:
    made = without_dds(rights(of))
    paths = [tmp_path / BRIDGE_UNIT, tmp_path / RUNNER_UNIT]
    for path, text in zip(paths, (bridge_unit(made), runner_unit(made)), strict=True):
        path.write_text(
            text.replace("/opt/tic-vla/bin/edge-bridge", "/usr/bin/true")
            .replace("/opt/tic-vla/bin/edge-run", "/usr/bin/true")
            .replace("/opt/tic-vla/bin/python", "/usr/bin/true")
        )
    verdict = check_units(paths)
    assert verdict.good, (verdict.complaints, verdict.exposure)
