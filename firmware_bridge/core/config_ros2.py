"""The table [ros2] of a robot file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Final

from firmware_bridge.core.sections import ConfigError, DdsConfig, Section, require, within_range

PUBLISHED: Final = (
    "odom", "tf", "camera/image/compressed", "camera/camera_info", "plan", "diagnostics", "reasoning", "delta_t",
)  # fmt: skip
"""Topics that a runner publishes, relative to `publish_namespace`."""
_OF_DDS: Final = -1
LONGEST_BASE_TIMEOUT_MS: Final = 2000
"""Longest own timeout of a base that may drive without supervision, ms (our choice: 1.6 m at 0.8 m/s)."""
MAX_NAME_CHARS: Final = 200
BEST_EFFORT: Final = "best_effort"
RELIABLE: Final = "reliable"
# design.ros2.org, "Topic and Service name mapping to DDS"; substitutions such as ~ and {node} need a node's name.
_TOKEN: Final = "[A-Za-z_][A-Za-z0-9_]*"
_NAME: Final = re.compile(f"(?!.*__)/?{_TOKEN}(?:/{_TOKEN})*")
_NAMESPACE: Final = re.compile(f"(?!.*__)(?:/|(?:/{_TOKEN})+)")


@dataclass(frozen=True)
class Ros2Config(Section):
    """Topics of a base that takes a Twist, and how that base stops by itself.

    A topic that starts with "/" is a full name; any other is relative to `namespace`. `imu`, `battery` and
    `instruction` are not used when they are absent. `stamped`: the command is a TwistStamped in `command_frame`.
    `input_reliability` of odometry, IMU, battery and pictures: "best_effort" matches every publisher; "reliable" brings
    lost messages again, but only from reliable publishers. `command_reliability`: "reliable" matches every subscriber.
    `other_command_publishers`: number of other nodes that are known to offer the command topic and to stay silent.
    `base_timeout_ms`: time after which the base stops by itself without a new command, as its maker states or the user
    has measured; 0: it never does. Such a base, and one slower than LONGEST_BASE_TIMEOUT_MS, needs `supervised = true`:
    a person with the base's own emergency stop watches every run, because nothing else stops it when the bridge dies.
    """

    base_timeout_ms: int = within_range(0, 60_000)
    namespace: str = "/"
    odometry: str = "odom"
    command: str = "cmd_vel"
    stamped: bool = False
    command_frame: str = "base_link"
    imu: str = ""
    battery: str = ""
    instruction: str = ""
    input_reliability: str = BEST_EFFORT
    command_reliability: str = RELIABLE
    other_command_publishers: int = within_range(0, 8, 0)
    supervised: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_namespace("ros2.namespace", self.namespace)
        frame_ok = len(self.command_frame) <= MAX_NAME_CHARS and _NAME.fullmatch(self.command_frame)
        require(
            bool(frame_ok), f'ros2.command_frame: expected a frame such as "base_link", found {self.command_frame!r}'
        )
        for key in ("input_reliability", "command_reliability"):
            known = getattr(self, key) in (BEST_EFFORT, RELIABLE)
            require(known, f'ros2.{key}: expected "{BEST_EFFORT}" or "{RELIABLE}", found {getattr(self, key)!r}')
        used: dict[str, str] = {}
        for key in ("odometry", "command", "imu", "battery", "instruction"):
            name: str = getattr(self, key)
            if name:
                check_topic_name(f"ros2.{key}", name)
                earlier = used.setdefault(self.topic(name), key)
                require(earlier == key, f"ros2.{key}: expected a topic of its own, found that of ros2.{earlier}")
        require(
            self.stops_itself or self.supervised,
            f"ros2.base_timeout_ms: expected 1..{LONGEST_BASE_TIMEOUT_MS}, found {self.base_timeout_ms}: the base"
            " drives on when the bridge dies; give the base a command timeout, or write ros2.supervised = true and keep"
            " a person at the base's own emergency stop",
        )

    @property
    def stops_itself(self) -> bool:
        """Whether the base stops soon enough by itself when no command comes."""
        return 0 < self.base_timeout_ms <= LONGEST_BASE_TIMEOUT_MS

    @property
    def reliable_inputs(self) -> bool:
        """Whether odometry, IMU, battery and pictures are read reliably."""
        return self.input_reliability == RELIABLE

    def topic(self, name: str) -> str:
        """Return the DDS name of a topic of this table: `rt` and the full ROS name."""
        return dds_topic(name, self.namespace)


@dataclass(frozen=True)
class Ros2PublishConfig(Section):
    """What a runner publishes as a ROS 2 node, for a robot of any protocol: keys of [ros2] in the robot file.

    `publish_domain` (-1) and `publish_interface` ("") are by default those of [dds].
    """

    table_name: ClassVar[str] = "ros2"

    publish: bool = False
    publish_namespace: str = "/"
    publish_domain: int = within_range(_OF_DDS, 232, _OF_DDS)
    publish_interface: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_namespace("ros2.publish_namespace", self.publish_namespace)

    @staticmethod
    def split(table: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the keys of a table [ros2] that are not of this class, and those that are."""
        own = {each.name for each in fields(Ros2PublishConfig)}
        rest = {key: value for key, value in table.items() if key not in own}
        return rest, {key: value for key, value in table.items() if key in own}

    def topic(self, name: str) -> str:
        """Return the DDS name of one of PUBLISHED."""
        return dds_topic(name, self.publish_namespace)

    def network(self, dds: DdsConfig | None) -> DdsConfig:
        """Return the network on which to publish. Raises ConfigError."""
        if dds is None:
            require(
                bool(self.publish_interface),
                'missing key ros2.publish_interface, such as "wlan0": this protocol has no [dds]',
            )
            dds = DdsConfig(0, self.publish_interface)
        if self.publish_interface and self.publish_interface != dds.interface:
            try:
                dds = DdsConfig(dds.domain, self.publish_interface, participants=dds.participants)
            except ConfigError:
                found = self.publish_interface
                raise ConfigError(f"ros2.publish_interface: expected a name or an address, found {found!r}") from None
        return dds if self.publish_domain == _OF_DDS else replace(dds, domain=self.publish_domain)

    def check(self, dds: DdsConfig | None, base: Ros2Config | None, camera: str) -> None:
        """Check what other tables decide: a network, and no topic that base, bridge or runner use already.

        `camera`: camera.source. Raises ConfigError.
        """
        if not self.publish:
            return
        self.network(dds)
        if base is not None:
            names = (base.odometry, base.command, base.imu, base.battery, base.instruction)
            used = {base.topic(name) for name in names if name} | {dds_topic(camera.partition(":")[2] or "/")}
            own = self.publish_namespace != base.namespace and used.isdisjoint(map(self.topic, PUBLISHED))
            require(
                own,
                'ros2.publish_namespace: expected one that the base does not use, such as "/tic_vla", found'
                f" {self.publish_namespace!r}: the bridge stops on a second publisher of a topic that it reads",
            )


def _check_namespace(where: str, name: str) -> None:
    legal = len(name) <= MAX_NAME_CHARS and _NAMESPACE.fullmatch(name)
    require(bool(legal), f'{where}: expected "/" or a name such as "/robot1", found {name!r}')


def check_topic_name(where: str, name: str) -> None:
    """Check a ROS 2 topic name, full or relative. Raises ConfigError that starts with `where`."""
    legal = len(name) <= MAX_NAME_CHARS and _NAME.fullmatch(name)
    require(bool(legal), f'{where}: expected a ROS 2 topic name such as "odom" or "/robot1/odom", found {name!r}')


def dds_topic(name: str, namespace: str = "/") -> str:
    """Return the DDS name of a ROS 2 topic; a relative name starts in `namespace`."""
    return f"rt{name}" if name.startswith("/") else f"rt{namespace.rstrip('/')}/{name}"
