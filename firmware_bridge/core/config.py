"""Robot description files (`firmware_bridge/robots/*.toml`): read, checked key by key, frozen.

Such a file contains every difference between the simulated robot and a real one. Between `go2_sim.toml` and `go2.toml`
only the `[dds]` addresses and `operator_arm` differ. The tables are declared in `sections.py` and `config_*.py`.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Final, get_args, get_type_hints

from firmware_bridge.core.config_can import CanConfig
from firmware_bridge.core.config_mavlink import MavlinkConfig
from firmware_bridge.core.config_ros2 import Ros2Config, Ros2PublishConfig
from firmware_bridge.core.sections import (
    OBSERVER_SUFFIX,
    OPERATOR_SUFFIX,
    BridgeConfig,
    CameraConfig,
    ConfigError,
    DdsConfig,
    LimitsConfig,
    MountConfig,
    OdometryConfig,
    SafetyConfig,
    require,
    runtime_dir,
    runtime_dirs,
    speed_hint,
)
from firmware_bridge.system.input_file import read_toml

__all__ = [
    "BRIDGE_PRIORITY",
    "OBSERVER_SUFFIX",
    "OPERATOR_SUFFIX",
    "ROBOT_FILE_SOCKET",
    "SERVICE_SOCKET",
    "BridgeConfig",
    "CameraConfig",
    "CanConfig",
    "ConfigError",
    "DdsConfig",
    "LimitsConfig",
    "MavlinkConfig",
    "MountConfig",
    "OdometryConfig",
    "RobotConfig",
    "Ros2Config",
    "SafetyConfig",
    "load_robot_config",
    "runtime_dir",
    "runtime_dirs",
]

LINKS: Final[dict[str, tuple[str, ...]]] = {
    "unitree": ("dds",),
    "mavlink": ("mavlink",),
    "can": ("can",),
    "ros2": ("dds", "ros2"),
}
"""Tables that a protocol requires; the others' tables are refused."""
UNITREE_SAFETY: Final = ("sport_version", "remote_estop_keys", "remote_deadband", "robot_lowcmd_publishers")
"""Keys of [safety] that only a Go2 has."""
_FORWARD: Final = {
    "vx_min_mps": (1.0, 2.5),
    "vx_max_mps": (1.5, 3.8),
    "wz_max_radps": (2.0, 4.0),
    "accel_mps2": (4.0, 8.0),
    "alpha_radps2": (10.0, 20.0),
}
# Largest magnitude of each limit by protocol: with people nearby, and with safety.above_walking_speed. The second value
# of each velocity is the documented range of a Go2's Move (protocol facts, "Move"). A Go2's accelerations are not
# documented: 8 m/s² needs a friction coefficient of 0.8, and 20 rad/s² reaches the full yaw rate in 0.2 s. The first
# values are our choice: 1.5 m/s is a brisk human walk.
FASTEST: Final[dict[str, dict[str, tuple[float, float]]]] = {
    "unitree": {**_FORWARD, "vy_max_mps": (0.5, 1.0)},
    "mavlink": {**_FORWARD, "vy_max_mps": (0.0, 0.0)},  # a rover does not move sideways
    "can": {**_FORWARD, "vy_max_mps": (0.0, 0.0)},
    "ros2": {**_FORWARD, "vy_max_mps": (0.5, 1.0)},
}
SERVICE_SOCKET: Final = Path("/run/tic-vla-edge/bridge.sock")  # where `edge-install units` lets the service listen
ROBOT_FILE_SOCKET: Final = "bridge.sock"
"""File name of the bridge's socket in the shipped robot files, in `runtime_dir`."""
BRIDGE_PRIORITY: Final = 60  # real-time priority of that service; no thread of the runner may reach it


@dataclass(frozen=True)
class RobotConfig:
    """One robot as its TOML file describes it."""

    name: str
    protocol: str
    bridge: BridgeConfig
    limits: LimitsConfig
    camera: CameraConfig
    odometry: OdometryConfig
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    mount: MountConfig | None = None
    dds: DdsConfig | None = None
    mavlink: MavlinkConfig | None = None
    can: CanConfig | None = None
    ros2: Ros2Config | None = None
    ros2_publish: Ros2PublishConfig = field(default_factory=Ros2PublishConfig, metadata={"in_table": "ros2"})
    """Keys of the table [ros2] that every protocol may have."""

    def __post_init__(self) -> None:
        require(self.protocol in LINKS, f"protocol: expected one of {', '.join(LINKS)}, found {self.protocol!r}")
        for table in dict.fromkeys(name for names in LINKS.values() for name in names):
            needed, given = table in LINKS[self.protocol], getattr(self, table) is not None
            require(given or not needed, f"missing table [{table}]; protocol {self.protocol} needs it")
            require(needed or not given, f"unexpected table [{table}]; protocol {self.protocol} does not use it")
        self.ros2_publish.check(self.dds, self.ros2, self.camera.source)
        self.camera.check_protocol(self.protocol)
        unasked = self.safety.battery_min_percent == 0
        charge_known = self.ros2 is None or self.ros2.battery != "" or unasked
        require(charge_known, "missing key ros2.battery; without a battery topic write safety.battery_min_percent = 0")
        charge_known = self.can is None or self.can.battery is not None or unasked
        require(charge_known, "missing table [can.battery]; without one write safety.battery_min_percent = 0")
        for key, (walking, fastest) in FASTEST[self.protocol].items():
            value: float = getattr(self.limits, key)
            permitted = fastest if self.safety.above_walking_speed else walking
            if abs(value) > permitted:
                advice = "lower it"
                if abs(value) <= fastest:
                    advice += (
                        f", or write safety.above_walking_speed = true to permit {math.copysign(fastest, value):g}"
                    )
                expected = f"{math.copysign(permitted, value):g} at most"
                hint = speed_hint(key, value)
                raise ConfigError(f"limits.{key}: expected {expected}, found {value}; {advice}{hint}")

    @property
    def network(self) -> DdsConfig:
        """DDS network of a protocol that uses DDS. Raises ConfigError for another protocol."""
        if self.dds is None:
            raise ConfigError(f"protocol {self.protocol}: expected one that uses DDS")
        return self.dds

    @property
    def address(self) -> str:
        """Address of the robot, for messages."""
        if self.mavlink is not None:
            return f"MAVLink {self.mavlink.link}"
        if self.can is not None:
            return f"CAN {self.can.interface}:{self.can.channel}"
        return f"DDS domain {self.network.domain} on {self.network.interface}"

    @property
    def digest(self) -> int:
        """63 bits of the robot's name, protocol and address: runner and bridge must mean the same robot."""
        text = "\0".join((self.name, self.protocol, self.address))
        return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little") >> 1  # fits JSON


def load_robot_config(path: Path | str, *, socket: Path | None = None, domain: int | None = None) -> RobotConfig:
    """Read a robot file; `socket` and `domain` replace its own. Raises ConfigError with one clear line."""
    try:
        table = read_toml(Path(path))
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(f"robot file {path}: cannot be read: {reason}") from error
    try:
        safety = table.get("safety")
        if _protocol_of(table) not in (None, "unitree") and isinstance(safety, dict):
            for key in UNITREE_SAFETY:
                require(key not in safety, f"unknown key safety.{key}: only protocol unitree has it")
        table, published = _split_ros2(table)
        config: RobotConfig = _build(RobotConfig, table, "", ros2_publish=published)
        dds = config.dds if domain is None else replace(config.network, domain=domain)
        can = None if config.can is None else config.can.with_files_of(Path(path).absolute().parent)
        bridge = config.bridge if socket is None else replace(config.bridge, socket=socket.absolute())
        return replace(config, dds=dds, can=can, bridge=bridge)
    except ConfigError as error:
        raise ConfigError(f"robot file {path}: {error}") from error


def _protocol_of(table: dict[str, Any]) -> str | None:
    """Return the protocol of a robot file's table; None where it is none of LINKS."""
    protocol = table.get("protocol")
    return protocol if isinstance(protocol, str) and protocol in LINKS else None


def _split_ros2(table: dict[str, Any]) -> tuple[dict[str, Any], Ros2PublishConfig]:
    """Take the keys of [ros2] that every protocol may have out of a robot file's table."""
    ros2, protocol = table.get("ros2"), _protocol_of(table)
    if not isinstance(ros2, dict):
        return table, Ros2PublishConfig()
    rest, published = Ros2PublishConfig.split(ros2)
    if protocol is not None and "ros2" not in LINKS[protocol]:
        for key in rest:
            raise ConfigError(f"unknown key ros2.{key}: protocol {protocol} has only ros2.publish and ros2.publish_*")
        table = {key: value for key, value in table.items() if key != "ros2"}
    else:
        table = {**table, "ros2": rest}
    return table, _build(Ros2PublishConfig, published, "ros2.")


def _build(cls: Any, table: object, prefix: str, **built: object) -> Any:
    """Build dataclass `cls` from a TOML table; every key must exist, have the declared type and be finite.

    `built`: fields that are no table of their own.
    """
    if not isinstance(table, dict):
        raise ConfigError(f"[{prefix[:-1]}]: expected a table, found {table!r}")
    declared = {each.name: each for each in fields(cls) if "in_table" not in each.metadata}
    hints = get_type_hints(cls)
    for key in table:
        require(key in declared, f"unknown key {prefix}{key}; expected {', '.join(declared)}")
    values: dict[str, Any] = dict(built)
    for key, each in declared.items():
        if key not in table:
            optional = each.default is not MISSING or each.default_factory is not MISSING
            require(optional, f"missing key {prefix}{key}")
        elif (nested := _table_of(hints[key])) is not None:
            values[key] = _build(nested, table[key], f"{prefix}{key}.")
        else:
            values[key] = _convert(table[key], str(each.type), prefix + key)
    return cls(**values)


def _table_of(hint: Any) -> type | None:
    """Return the dataclass of a field that is a table, required or not; None for a field with a value."""
    return next((kind for kind in (hint, *get_args(hint)) if is_dataclass(kind) and isinstance(kind, type)), None)


def _convert(value: object, kind: str, where: str) -> object:
    if kind == "int" and isinstance(value, int) and not isinstance(value, bool):
        return value
    if kind == "float" and isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e300:
        return float(value)
    if kind == "bool" and isinstance(value, bool):
        return value
    if kind == "str" and isinstance(value, str) and value:
        return value
    if kind in ("Path", "Path | None") and isinstance(value, str) and value and "\0" not in value:
        return Path(value)
    if kind.startswith("tuple[") and isinstance(value, list):
        return tuple(_convert(each, kind[len("tuple[") :].partition(",")[0], where) for each in value)
    raise ConfigError(f"{where}: expected {kind}, found {value!r}")
