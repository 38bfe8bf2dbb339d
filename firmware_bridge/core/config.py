"""Robot description files (`firmware_bridge/robots/*.toml`): read, checked key by key, frozen.

Such a file contains every difference between the simulated robot and a real one. Between `go2_sim.toml` and `go2.toml`
only the `[dds]` addresses differ.
"""

from __future__ import annotations

import math
import os
import sys
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Final

from firmware_bridge.unitree.messages.ids import REMOTE_KEYS

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PROTOCOLS: Final = ("unitree",)
# Largest magnitude of each limit by protocol: with people nearby, and with safety.above_walking_speed. The second value
# of each velocity is the documented range of a Go2's Move (protocol facts, "Move"). A Go2's accelerations are not
# documented: 8 m/s² needs a friction coefficient of 0.8, and 20 rad/s² reaches the full yaw rate in 0.2 s. The first
# values are our choice: 1.5 m/s is a brisk human walk.
FASTEST: Final[dict[str, dict[str, tuple[float, float]]]] = {
    "unitree": {
        "vx_min_mps": (1.0, 2.5),
        "vx_max_mps": (1.5, 3.8),
        "vy_max_mps": (0.5, 1.0),
        "wz_max_radps": (2.0, 4.0),
        "accel_mps2": (4.0, 8.0),
        "alpha_radps2": (10.0, 20.0),
    }
}
VELOCITY_FRAMES: Final = ("odom", "body")
OPERATOR_SUFFIX: Final = ".operator"  # of the second socket, for `edge-bridge stop`, `arm` and `status`
SERVICE_SOCKET: Final = Path("/run/tic-vla-edge/bridge.sock")  # where `edge-install units` lets the service listen
BRIDGE_PRIORITY: Final = 60  # real-time priority of that service; no thread of the runner may reach it
MAX_SOCKET_PATH_BYTES: Final = 107  # sizeof(sockaddr_un.sun_path) less its NUL, unix(7)


class ConfigError(ValueError):
    """A robot file that cannot be used; the message is one line for the operator."""


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ConfigError(message)


def _speed_hint(key: str, value: float) -> str:
    """Return the end of a message about a speed that is too high: the value converted from km/h."""
    return f"; if it is in km/h, write {value / 3.6:.2f}" if key.endswith("_mps") and abs(value) > 2 else ""


def _within(low: float, high: float, default: Any = MISSING, *, above: bool = False) -> Any:
    """Declare a field with values in low..high; `above`: low itself is excluded."""
    return field(default=default, metadata={"range": (low, high, above)})


@dataclass(frozen=True)
class _Section:
    """A table of the robot file, named like its class; it checks the fields declared by `_within`."""

    def __post_init__(self) -> None:
        for each in (each for each in fields(self) if "range" in each.metadata):
            (low, high, above), value = each.metadata["range"], getattr(self, each.name)
            inside = low <= value <= high and not (above and value == low)
            key = f"{type(self).__name__.removesuffix('Config').lower()}.{each.name}"
            _require(inside, f"{key}: expected {low:g}..{high:g}, found {value}{_speed_hint(each.name, value)}")


@dataclass(frozen=True)
class DdsConfig(_Section):
    """Network of the robot: DDS domain, our interface, and unicast peers for links without multicast."""

    domain: int
    interface: str
    peers: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _require(0 <= self.domain <= 232, f"dds.domain: expected 0..232 (RTPS port range), found {self.domain}")
        for text in (self.interface, *self.peers):  # they are pasted into Cyclone's XML
            legal = text != "" and all(c.isalnum() or c in ".:-_" for c in text)
            _require(legal, f"dds.interface/peers: expected names or addresses, found {text!r}")


@dataclass(frozen=True)
class BridgeConfig(_Section):
    """Timing of the bridge; a relative socket path is in the user's runtime directory."""

    socket: Path
    rate_hz: int = _within(10, 200, 50)
    deadman_ms: int = _within(20, 250, 250)  # above, "zero on the wire within 300 ms" cannot be kept
    arm_timeout_s: float = _within(1, 60, 10.0)
    state_timeout_ms: int = _within(100, 5000, 1000)

    def __post_init__(self) -> None:
        super().__post_init__()
        path = self.socket if self.socket.is_absolute() else runtime_dir() / self.socket
        object.__setattr__(self, "socket", path)
        size = len(os.fsencode(path)) + len(OPERATOR_SUFFIX)
        fits = size <= MAX_SOCKET_PATH_BYTES
        _require(fits, f"bridge.socket: {size} bytes with {OPERATOR_SUFFIX}, the system allows 107: {path}")


@dataclass(frozen=True)
class SafetyConfig(_Section):
    """Conditions that forbid motion besides the bridge's own rules.

    `sport_version`: version that the robot's sport service must report. `estop_file`: a file that reads 0 while the
    local emergency stop is released (a GPIO value in sysfs); any other content, or no file, counts as pressed.
    `remote_deadband`: share of a stick's travel that does not count as use. `operator_arm`: every arming needs an
    operator's `edge-bridge arm` before it. `above_walking_speed`: permits limits above those that FASTEST has for
    people nearby. `robot_lowcmd_publishers`: number of the robot's own publishers of rt/lowcmd; one more is a second
    commander.
    """

    sport_version: str = "1.0.0.1"
    accepted_error_codes: tuple[int, ...] = (0,)
    battery_min_percent: int = _within(0, 90, 10)
    remote_estop_keys: tuple[str, ...] = ("L2", "B")
    remote_deadband: float = _within(0.01, 0.5, 0.1)
    estop_file: Path | None = None
    operator_arm: bool = False
    above_walking_speed: bool = False
    robot_lowcmd_publishers: int = _within(0, 4, 0)

    def __post_init__(self) -> None:
        super().__post_init__()
        keys = self.remote_estop_keys
        valid = len(keys) > 0 and set(keys) <= set(REMOTE_KEYS)
        _require(valid, f"safety.remote_estop_keys: expected one or more of {', '.join(REMOTE_KEYS)}, found {keys}")
        file_ok = self.estop_file is None or self.estop_file.is_absolute()
        _require(file_ok, f"safety.estop_file: expected an absolute path, found {self.estop_file}")


@dataclass(frozen=True)
class LimitsConfig(_Section):
    """Velocity limits and speeding-up limits enforced on every command; slowing down is never limited."""

    # A Go2's Move limits as its maker documents them; a robot file may only lower them (protocol facts, "Move").
    vx_min_mps: float = _within(-2.5, 0)
    vx_max_mps: float = _within(0, 3.8, above=True)
    vy_max_mps: float = _within(0, 1)
    wz_max_radps: float = _within(0, 4, above=True)
    accel_mps2: float = _within(0, 20, above=True)
    alpha_radps2: float = _within(0, 50, above=True)


@dataclass(frozen=True)
class CameraConfig(_Section):
    """Front camera: request rate, age of a frame when its answer arrives, timeout of a request."""

    rate_hz: float = _within(0, 60, above=True)
    latency_ms: float = _within(0, 2000)
    timeout_ms: int = _within(10, 10000)


@dataclass(frozen=True)
class MountConfig(_Section):
    """Mount of the front camera: horizontal field of view, lens height above the floor and distance ahead of the base
    while the robot stands, and pitch downwards. Visual odometry needs it.
    """

    hfov_deg: float = _within(20, 160)
    height_m: float = _within(0.05, 3)
    pitch_deg: float = _within(-45, 80)
    forward_m: float = _within(-2, 2)


@dataclass(frozen=True)
class OdometryConfig(_Section):
    """Frame of the robot's velocity report, and the age from which its pose is too old for driving.

    `calibration`: absolute path of this robot's output of `edge-calib odometry`.
    """

    velocity_frame: str
    max_age_ms: int = _within(20, 2000)
    calibration: Path | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        file_ok = self.calibration is None or self.calibration.is_absolute()
        _require(file_ok, f"odometry.calibration: expected an absolute path, found {self.calibration}")
        frame_ok = self.velocity_frame in VELOCITY_FRAMES
        _require(frame_ok, f'odometry.velocity_frame: expected "odom" or "body", found {self.velocity_frame!r}')


@dataclass(frozen=True)
class RobotConfig:
    """One robot as its TOML file describes it."""

    name: str
    protocol: str
    dds: DdsConfig
    bridge: BridgeConfig
    limits: LimitsConfig
    camera: CameraConfig
    odometry: OdometryConfig
    safety: SafetyConfig = SafetyConfig()
    mount: MountConfig | None = None

    def __post_init__(self) -> None:
        _require(self.protocol in PROTOCOLS, f"protocol: expected one of {PROTOCOLS}, found {self.protocol!r}")
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
                hint = _speed_hint(key, value)
                raise ConfigError(f"limits.{key}: expected {expected}, found {value}; {advice}{hint}")


_SECTIONS: Final = {kind.__name__.removesuffix("Config").lower(): kind for kind in _Section.__subclasses__()}


def runtime_dir() -> Path:
    """Return the directory of this user's sockets: `$XDG_RUNTIME_DIR/tic-vla-edge`, else one in /tmp by user id."""
    base = os.environ.get("XDG_RUNTIME_DIR", "")
    return Path(base) / "tic-vla-edge" if base else Path("/tmp") / f"tic-vla-edge-{os.getuid()}"


def load_robot_config(path: Path | str, *, socket: Path | None = None, domain: int | None = None) -> RobotConfig:
    """Read a robot file; `socket` and `domain` replace its own. Raises ConfigError with one clear line."""
    try:
        table = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, RecursionError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"robot file {path}: cannot be read: {error}") from error
    try:
        config: RobotConfig = _build(RobotConfig, table, "")
        dds = config.dds if domain is None else replace(config.dds, domain=domain)
        bridge = config.bridge if socket is None else replace(config.bridge, socket=socket.absolute())
        return replace(config, dds=dds, bridge=bridge)
    except ConfigError as error:
        raise ConfigError(f"robot file {path}: {error}") from error


def _build(cls: Any, table: object, prefix: str) -> Any:
    """Build dataclass `cls` from a TOML table; every key must exist, have the declared type and be finite."""
    if not isinstance(table, dict):
        raise ConfigError(f"[{prefix[:-1]}]: expected a table, found {table!r}")
    declared = {each.name: each for each in fields(cls)}
    for key in table:
        _require(key in declared, f"unknown key {prefix}{key}; expected {', '.join(declared)}")
    values: dict[str, Any] = {}
    for key, each in declared.items():
        if key not in table:
            _require(each.default is not MISSING, f"missing key {prefix}{key}")
        elif cls is RobotConfig and key in _SECTIONS:
            values[key] = _build(_SECTIONS[key], table[key], f"{key}.")
        else:
            values[key] = _convert(table[key], str(each.type), prefix + key)
    return cls(**values)


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
