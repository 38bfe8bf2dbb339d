"""Robots that the real-time tools drive: simulated body, protocol, shipped robot file, and the addresses of one run."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import tomli_w

import firmware_bridge
from firmware_bridge.system.input_file import read_toml

ROBOT_FILES: Final = Path(firmware_bridge.__file__).parent / "robots"
MAX_DOMAIN: Final = 232
"""Largest DDS domain whose ports exist."""
BRIDGE_SOCKET: Final = "bridge"
"""Name of the bridge's socket in the folder of a run's sockets."""


class StackRobotError(ValueError):
    """A robot that cannot be driven here; one line: what, expected, found."""


@dataclass(frozen=True)
class RunAddress:
    """Addresses that belong to one run alone; `folder` has a short path and contains its sockets and its pty."""

    folder: Path
    domain: int
    """DDS domain."""
    udp_port: int
    camera_port: int
    """TCP port of the HTTP camera."""

    def __post_init__(self) -> None:
        if not 0 <= self.domain <= MAX_DOMAIN:
            raise ValueError(f"--domain: expected 0 to 232 (DDS), found {self.domain}")

    @staticmethod
    def free(folder: Path, domain: int | None = None) -> RunAddress:
        """Return addresses that no program of this machine uses; None: a free DDS domain. Raises ValueError."""
        number = free_domain() if domain is None else domain
        return RunAddress(folder, number, free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_STREAM))

    def filled(self, template: str) -> str:
        """Replace the names of the fields in braces by their values."""
        # One address of 239.74.0.0/16 for each UDP port.
        can_group = f"239.74.{self.udp_port >> 8}.{self.udp_port & 255}"
        return template.format(**vars(self), can_group=can_group)


@dataclass(frozen=True)
class StackRobot:
    """One robot of the stack.

    `hil_robot` and `protocol`: options of edge-hil. `shipped`: robot file of the simulated robot. `hil`: edge-hil's
    further arguments. `values`: keys of the robot file that differ in each run. Both are templates with the fields of
    `RunAddress` in braces. `own_timeout_s`: time without a command after which the robot stops by itself.
    """

    name: str
    hil_robot: str
    protocol: str
    shipped: str
    hil: tuple[str, ...]
    values: tuple[tuple[str, str], ...]
    own_timeout_s: float

    @property
    def file(self) -> Path:
        """Shipped robot file."""
        return ROBOT_FILES / self.shipped

    def hil_arguments(self, address: RunAddress) -> list[str]:
        """Return edge-hil's arguments that select the robot, its protocol and its addresses."""
        link = [address.filled(each) for each in self.hil]
        return ["--robot", self.hil_robot, "--protocol", self.protocol, *link]

    def write_file(self, path: Path, address: RunAddress, speed_limit_mps: float | None = None) -> Path:
        """Write the run's own robot file to `path` and return it; None keeps the shipped forward speed limit.

        Raises StackRobotError if the shipped file cannot be used, OSError if `path` cannot be written.
        """
        try:
            content = read_toml(self.file)
        except (OSError, ValueError) as error:
            raise StackRobotError(f"--robot {self.name}: {self.file}: cannot be read: {error}") from error
        for key, template in (("bridge.socket", f"{{folder}}/{BRIDGE_SOCKET}"), *self.values):
            _put(content, key, address.filled(template))
        if speed_limit_mps is not None:
            _put(content, "limits.vx_max_mps", speed_limit_mps)
        path.write_text(tomli_w.dumps(content), encoding="utf-8")
        return path


def _put(content: dict[str, Any], key: str, value: str | float) -> None:
    """Replace `TABLE.KEY`; digits that replace a number become one."""
    table, _, name = key.partition(".")
    before = content.setdefault(table, {}).get(name)
    content[table][name] = int(value) if isinstance(before, int) and isinstance(value, str) else value


_CAMERA: Final = ("camera.source", "http://127.0.0.1:{camera_port}/stream.mjpg")
_DOMAIN: Final = ("dds.domain", "{domain}")
_ON_LOOPBACK: Final = ("--interface", "lo", "--domain={domain}")

ROBOTS: Mapping[str, StackRobot] = MappingProxyType(
    {
        robot.name: robot
        for robot in (
            StackRobot("go2", "go2", "unitree", "go2_sim.toml", _ON_LOOPBACK, (_DOMAIN,), 1.0),
            StackRobot(
                "carter-can",
                "carter",
                "can",
                "carter_can_sim.toml",
                ("--link=serial:{folder}/can,camera={camera_port}",),
                (("can.channel", "{folder}/can"), ("can.dbc", str(ROBOT_FILES / "carter.dbc")), _CAMERA),
                0.1,
            ),
            StackRobot(
                "carter-mavlink",
                "carter",
                "mavlink",
                "carter_mavlink_sim.toml",
                ("--link=udp:127.0.0.1:{udp_port},camera={camera_port}",),
                (("mavlink.link", "udp:127.0.0.1:{udp_port}"), _CAMERA),
                0.5,
            ),
            StackRobot(
                "carter-ros2",
                "carter",
                "ros2",
                "carter_ros2_sim.toml",
                _ON_LOOPBACK,
                (_DOMAIN,),
                0.5,
            ),
        )
    }
)
"""Every robot by name."""

GO2: Final = ROBOTS["go2"]
CAN_BETWEEN_PROCESSES: Final = replace(
    ROBOTS["carter-can"],
    hil=("--link=udp_multicast:{can_group},camera={camera_port}",),
    values=(("can.interface", "udp_multicast"), ("can.channel", "{can_group}"), *ROBOTS["carter-can"].values[1:]),
)
"""The robot on CAN with a bus that further processes can join: a sniffer, a second controller."""
MAVLINK_KEY: Final = "mavlink.key"
"""Name of the signing key in the folder of a run's sockets, for MAVLINK_SIGNED."""
MAVLINK_SIGNED: Final = replace(
    ROBOTS["carter-mavlink"],
    hil=(f"{ROBOTS['carter-mavlink'].hil[0]},key={{folder}}/{MAVLINK_KEY}",),
    values=(*ROBOTS["carter-mavlink"].values, ("mavlink.signing_key", f"{{folder}}/{MAVLINK_KEY}")),
)
"""The robot on MAVLink with a signed link."""


def robot_of(name: str) -> StackRobot:
    """Return a robot by name. Raises StackRobotError for an unknown name."""
    if name not in ROBOTS:
        raise StackRobotError(f"--robot: expected one of {', '.join(ROBOTS)}, found {name!r}")
    return ROBOTS[name]


def free_port(kind: socket.SocketKind) -> int:
    """Return an unused port of the loopback interface; `kind`: SOCK_DGRAM for UDP, SOCK_STREAM for TCP."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def free_domain(udp_tables: Sequence[Path] = (Path("/proc/net/udp"), Path("/proc/net/udp6"))) -> int:
    """Return a DDS domain in 1..90 with unused UDP ports (RTPS: 250 ports from 7400 + 250 · domain)."""
    used: set[int] = set()
    for table in udp_tables:
        try:
            for line in table.read_text(encoding="ascii").splitlines()[1:]:
                used.add((int(line.split()[1].rsplit(":", 1)[1], 16) - 7400) // 250)
        except OSError:
            continue  # not Linux, or no IPv6
    # From a different place in every process: two started together then rarely want the same one.
    candidates = [1 + (os.getpid() + i) % 90 for i in range(90)]
    for domain in candidates:
        if domain not in used:
            return domain
    raise ValueError("no free DDS domain between 1 and 90; name one with --domain")
