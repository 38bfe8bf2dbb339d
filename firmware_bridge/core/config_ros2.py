"""The table [ros2] of a robot file."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from firmware_bridge.core.sections import Section, require, within_range

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
        legal = len(self.namespace) <= MAX_NAME_CHARS and _NAMESPACE.fullmatch(self.namespace)
        require(bool(legal), f'ros2.namespace: expected "/" or a name such as "/robot1", found {self.namespace!r}')
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
        stops = 0 < self.base_timeout_ms <= LONGEST_BASE_TIMEOUT_MS
        require(
            stops or self.supervised,
            f"ros2.base_timeout_ms: expected 1..{LONGEST_BASE_TIMEOUT_MS}, found {self.base_timeout_ms}: the base"
            " drives on when the bridge dies; give the base a command timeout, or write ros2.supervised = true and keep"
            " a person at the base's own emergency stop",
        )

    @property
    def reliable_inputs(self) -> bool:
        """Whether odometry, IMU, battery and pictures are read reliably."""
        return self.input_reliability == RELIABLE

    def topic(self, name: str) -> str:
        """Return the DDS name of a topic of this table: `rt` and the full ROS name."""
        return dds_topic(name, self.namespace)


def check_topic_name(where: str, name: str) -> None:
    """Check a ROS 2 topic name, full or relative. Raises ConfigError that starts with `where`."""
    legal = len(name) <= MAX_NAME_CHARS and _NAME.fullmatch(name)
    require(bool(legal), f'{where}: expected a ROS 2 topic name such as "odom" or "/robot1/odom", found {name!r}')


def dds_topic(name: str, namespace: str = "/") -> str:
    """Return the DDS name of a ROS 2 topic; a relative name starts in `namespace`."""
    return f"rt{name}" if name.startswith("/") else f"rt{namespace.rstrip('/')}/{name}"
