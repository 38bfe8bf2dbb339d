"""What the services need of the machine to reach one robot and its camera, by protocol and `camera.source`."""

from __future__ import annotations

import grp
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from ipaddress import AddressValueError, IPv4Address, IPv4Network, NetmaskValueError
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from edge.deploy.unit_text import Setting, UnitError, word
from firmware_bridge.core.config import DdsConfig, RobotConfig

SERIAL_GROUP: Final = "dialout"
VIDEO_GROUP: Final = "video"
_SERIAL_DRIVERS: Final = ("ttyACM", "ttyUSB", "ttyAMA", "ttyTHS", "ttyS")
"""Serial drivers as /proc/devices names them; a device of theirs may be plugged in after the service has started."""

WIDEST_PREFIX: Final = 16
"""Shortest prefix of a network that the address filter lets through, bits: a wider one filters hardly anything."""
Addresses = Mapping[str, Sequence[tuple[str, str]]]
"""Return the network interfaces' IPv4 addresses with their netmasks."""


@dataclass(frozen=True)
class LinkRights:
    """Rights beyond the files: those of the bridge for the robot's link, those of the runner for its camera.

    `uses_dds`: both services join the robot's DDS network. `host`: address of a robot behind UDP without DDS.
    `families`: socket families of the bridge's link besides AF_UNIX, AF_INET and AF_NETLINK.
    """

    uses_dds: bool = True
    host: IPv4Network | None = None
    families: tuple[str, ...] = ()
    bridge_devices: tuple[str, ...] = ()
    """Values of DeviceAllow= without their rights."""
    bridge_groups: tuple[str, ...] = ()
    secret: Path | None = None
    """File that only the bridge may read."""
    camera_host: IPv4Network | None = None
    camera_devices: tuple[str, ...] = ()
    camera_groups: tuple[str, ...] = ()


DDS_ONLY: Final = LinkRights()


def link_rights(robot: RobotConfig, group_of: Callable[[Path], str | None] | None = None) -> LinkRights:
    """Return the rights for a robot; `group_of` returns the group of a device, None for one that is absent.

    Raises UnitError for a link that only simulations use, and for a camera whose address must be looked up.
    """
    group_of = group_of or file_group
    device = serial_device(robot)
    devices: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()
    families: tuple[str, ...] = ()
    host: IPv4Network | None = None
    secret: Path | None = None
    if device is not None:
        devices = (word(str(device)), *_driver(device))
        groups = (group_of(device) or SERIAL_GROUP,)
    if robot.can is not None and robot.can.interface not in ("socketcan", "serial"):
        raise UnitError(f"can.interface: expected socketcan or serial for a service, found {robot.can.interface}")
    if robot.can is not None and robot.can.interface == "socketcan":
        families = ("AF_CAN",)
    if robot.mavlink is not None:
        secret = robot.mavlink.signing_key
        if device is None:
            host = _address("mavlink.link", robot.mavlink.link.split(":")[1])
    if robot.ros2_publish.publish:
        interface = robot.ros2_publish.network(robot.dds).interface
        if robot.dds is None or interface != robot.dds.interface:
            raise UnitError(
                f"ros2.publish_interface: a service reaches the robot's network alone, found {interface!r}; expected"
                " the interface of [dds], or ros2.publish = false in the service's robot file"
            )
    kind, _, where = robot.camera.source.partition(":")
    camera_host: IPv4Network | None = None
    cameras: tuple[str, ...] = ()
    if kind == "http":
        camera_host = _address("camera.source", urlsplit(robot.camera.source).hostname or "")
    elif kind in ("v4l2", "gstreamer"):
        cameras = (*((word(where),) if kind == "v4l2" else ()), "char-video4linux")
    return LinkRights(
        robot.dds is not None, host, families, devices, groups, secret, camera_host, cameras,
        (VIDEO_GROUP,) if cameras else (),
    )  # fmt: skip


def serial_device(robot: RobotConfig) -> Path | None:
    """Return the device of a robot on a serial line; None for another link."""
    if robot.mavlink is not None and robot.mavlink.link.startswith("serial:"):
        return Path(robot.mavlink.link.removeprefix("serial:").rpartition(":")[0])
    if robot.can is not None and robot.can.interface == "serial":
        return Path(robot.can.channel)
    return None


def device_lines(devices: tuple[str, ...], groups: tuple[str, ...]) -> list[Setting | str]:
    """Return the lines of a unit that open these devices and nothing else of /dev."""
    opened: list[Setting | str] = [("DeviceAllow", f"{device} rw") for device in devices]
    return [*opened, *([("SupplementaryGroups", " ".join(groups))] if groups else [])]


def file_group(path: Path) -> str | None:
    """Return the name of a file's group; None for a missing file or a group without a name."""
    try:
        return grp.getgrgid(path.stat().st_gid).gr_name
    except (OSError, KeyError):
        return None


def _driver(device: Path) -> tuple[str, ...]:
    """Return the device's driver, so that a device that is plugged in later is open too."""
    target = device.resolve().name
    return next(((f"char-{driver}",) for driver in _SERIAL_DRIVERS if target.startswith(driver)), ())


def _address(key: str, host: str) -> IPv4Network:
    try:
        return IPv4Network(IPv4Address(host))
    except AddressValueError:
        raise UnitError(f"{key}: expected an IPv4 address for the service's address filter, found {host!r}") from None


def check_network(network: IPv4Network, source: str) -> None:
    """Raise UnitError for a network too wide for a useful filter; loopback never leaves the machine."""
    if network.prefixlen < WIDEST_PREFIX and not network.is_loopback:
        raise UnitError(
            f"{source}: {network} has {network.num_addresses} addresses, expected a prefix of /{WIDEST_PREFIX} or "
            f"longer: give the robot's own network with --network, e.g. 192.168.123.0/24"
        )


def robot_networks(dds: DdsConfig, given: Sequence[str], addresses: Callable[[], Addresses]) -> tuple[IPv4Network, ...]:
    """Return the robot's networks: those given, else that of the robot file's interface and its peers.

    Raises UnitError when the file alone does not determine them, or when a network is too wide for a filter.
    """
    networks: set[IPv4Network] = set()
    for text in given:
        try:
            network = IPv4Network(text)
        except (AddressValueError, NetmaskValueError, ValueError) as error:
            raise UnitError(f"--network {text}: {error}; expected for example 192.168.123.0/24") from None
        check_network(network, f"--network {text}")
        networks.add(network)
    if networks:
        return tuple(sorted(networks))
    own = addresses().get(dds.interface, ())
    if not own:
        raise UnitError(
            f"the robot file's interface {dds.interface!r} has no IPv4 address here, so the robot's network is "
            f"unknown: bring it up or give --network, e.g. 192.168.123.0/24"
        )
    networks.update(IPv4Network(f"{address}/{mask}", strict=False) for address, mask in own)
    for network in networks:
        check_network(network, f"the robot file's interface {dds.interface}")
    for peer in dds.peers:
        try:
            address = IPv4Address(peer)
        except AddressValueError:
            raise UnitError(
                f"dds.peers: {peer!r} is no IPv4 address; give the robot's network with --network"
            ) from None
        if not any(address in network for network in networks):
            networks.add(IPv4Network(address))
    return tuple(sorted(networks))
