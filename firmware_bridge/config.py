"""Robot description files (`firmware_bridge/robots/*.toml`): read, checked key by key, frozen.

Everything that differs between the simulated robot and a real one is in such a file, and between `go2_sim.toml`
and `go2.toml` only the `[dds]` addresses differ.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final

from firmware_bridge.unitree.ids import REMOTE_KEYS

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PROTOCOLS: Final = ("unitree",)
VELOCITY_FRAMES: Final = ("odom", "body")
OPERATOR_SUFFIX: Final = ".operator"  # of the second socket, for `edge-bridge stop`, `arm` and `status`
MAX_SOCKET_PATH_BYTES: Final = 107  # sizeof(sockaddr_un.sun_path) less its NUL, unix(7)


class ConfigError(ValueError):
    """A robot file that cannot be used; the message is one line for the operator."""


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ConfigError(message)


def _require_between(low: float, value: float, high: float, key: str, *, above: bool = False) -> None:
    """`above`: the lower end itself is not allowed."""
    inside = low < value <= high if above else low <= value <= high
    _require(inside, f"{key}: expected {low:g}..{high:g}, found {value}")


@dataclass(frozen=True)
class DdsConfig:
    """Where the robot is: DDS domain, our network interface, and unicast peers for links without multicast."""

    domain: int
    interface: str
    peers: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _require(0 <= self.domain <= 232, f"dds.domain: expected 0..232 (RTPS port range), found {self.domain}")
        for text in (self.interface, *self.peers):  # they are pasted into Cyclone's XML
            legal = text != "" and all(c.isalnum() or c in ".:-_" for c in text)
            _require(legal, f"dds.interface/peers: expected names or addresses, found {text!r}")


@dataclass(frozen=True)
class BridgeConfig:
    """Timing of the deadman process; a relative socket path lies in the user's runtime directory."""

    socket: Path
    rate_hz: int = 50
    deadman_ms: int = 250
    arm_timeout_s: float = 10.0
    state_timeout_ms: int = 1000

    def __post_init__(self) -> None:
        path = self.socket if self.socket.is_absolute() else runtime_dir() / self.socket
        object.__setattr__(self, "socket", path)
        size = len(os.fsencode(path)) + len(OPERATOR_SUFFIX)
        _require(
            size <= MAX_SOCKET_PATH_BYTES,
            f"bridge.socket: {size} bytes with its suffix {OPERATOR_SUFFIX}, the system allows 107: {path}",
        )
        _require_between(10, self.rate_hz, 200, "bridge.rate_hz")
        # Above 250 ms the promise "zero on the wire within 300 ms" cannot be kept.
        _require_between(20, self.deadman_ms, 250, "bridge.deadman_ms")
        _require_between(1, self.arm_timeout_s, 60, "bridge.arm_timeout_s")
        _require_between(100, self.state_timeout_ms, 5000, "bridge.state_timeout_ms")


@dataclass(frozen=True)
class SafetyConfig:
    """What forbids motion besides the bridge's own rules.

    `sport_version`: what the robot's sport service must answer when asked for its version. `estop_file`: a file that
    reads 0 while the local emergency stop is released (a GPIO value in sysfs); anything else, or no file, is pressed.
    `remote_deadband`: share of a stick's travel that is not yet a hand on it.
    """

    sport_version: str = "1.0.0.1"
    accepted_error_codes: tuple[int, ...] = (0,)
    battery_min_percent: int = 10
    remote_estop_keys: tuple[str, ...] = ("L2", "B")
    remote_deadband: float = 0.1
    estop_file: Path | None = None

    def __post_init__(self) -> None:
        _require_between(0, self.battery_min_percent, 90, "safety.battery_min_percent")
        _require_between(0.01, self.remote_deadband, 0.5, "safety.remote_deadband")
        keys = self.remote_estop_keys
        known = len(keys) > 0 and set(keys) <= set(REMOTE_KEYS)
        _require(known, f"safety.remote_estop_keys: expected one or more of {', '.join(REMOTE_KEYS)}, found {keys}")
        file_ok = self.estop_file is None or self.estop_file.is_absolute()
        _require(file_ok, f"safety.estop_file: expected an absolute path, found {self.estop_file}")


@dataclass(frozen=True)
class LimitsConfig:
    """Velocity limits and speeding-up limits enforced on every command; slowing down is never limited."""

    vx_min_mps: float
    vx_max_mps: float
    vy_max_mps: float
    wz_max_radps: float
    accel_mps2: float
    alpha_radps2: float

    def __post_init__(self) -> None:
        # A Go2's Move limits as its maker documents them; a robot file may only lower them (protocol facts, "Move").
        _require_between(-2.5, self.vx_min_mps, 0, "limits.vx_min_mps")
        _require_between(0, self.vx_max_mps, 3.8, "limits.vx_max_mps", above=True)
        _require_between(0, self.vy_max_mps, 1, "limits.vy_max_mps")
        _require_between(0, self.wz_max_radps, 4, "limits.wz_max_radps", above=True)
        _require_between(0, self.accel_mps2, 20, "limits.accel_mps2", above=True)
        _require_between(0, self.alpha_radps2, 50, "limits.alpha_radps2", above=True)


@dataclass(frozen=True)
class CameraConfig:
    """Front camera: how often to ask, how old a frame is when its answer arrives, how long to wait for one."""

    rate_hz: float
    latency_ms: float
    timeout_ms: int

    def __post_init__(self) -> None:
        _require_between(0, self.rate_hz, 60, "camera.rate_hz", above=True)
        _require_between(0, self.latency_ms, 2000, "camera.latency_ms")
        _require_between(10, self.timeout_ms, 10000, "camera.timeout_ms")


@dataclass(frozen=True)
class OdometryConfig:
    """Frame of the robot's velocity report, and the age from which its pose is too old to drive by."""

    velocity_frame: str
    max_age_ms: int

    def __post_init__(self) -> None:
        frame_ok = self.velocity_frame in VELOCITY_FRAMES
        _require(frame_ok, f'odometry.velocity_frame: expected "odom" or "body", found {self.velocity_frame!r}')
        _require_between(20, self.max_age_ms, 2000, "odometry.max_age_ms")


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

    def __post_init__(self) -> None:
        _require(self.protocol in PROTOCOLS, f"protocol: expected one of {PROTOCOLS}, found {self.protocol!r}")


def runtime_dir() -> Path:
    """Directory for this user's sockets: `$XDG_RUNTIME_DIR/tic-vla-edge`, else one under /tmp named by user id."""
    base = os.environ.get("XDG_RUNTIME_DIR", "")
    return Path(base) / "tic-vla-edge" if base else Path("/tmp") / f"tic-vla-edge-{os.getuid()}"


def load_robot_config(path: Path | str, *, socket: Path | None = None, domain: int | None = None) -> RobotConfig:
    """Read a robot file; `socket` and `domain` replace what it says. Raises ConfigError with one clear line."""
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


_SECTIONS: Final = {
    "dds": DdsConfig,
    "bridge": BridgeConfig,
    "limits": LimitsConfig,
    "camera": CameraConfig,
    "odometry": OdometryConfig,
    "safety": SafetyConfig,
}


def _build(cls: Any, table: object, section: str) -> Any:
    """Dataclass `cls` from a TOML table, every key known, of the declared type and finite."""
    _require(isinstance(table, dict), f"[{section}]: expected a table, found {table!r}")
    assert isinstance(table, dict)
    prefix = f"{section}." if section else ""
    known = {field.name: field for field in fields(cls)}
    for key in table:
        _require(key in known, f"unknown key {prefix}{key}; expected {', '.join(known)}")
    values: dict[str, Any] = {}
    for key, field in known.items():
        if key not in table:
            required = repr(field.default).startswith("<dataclasses._MISSING")
            _require(not required, f"missing key {prefix}{key}")
        elif not section and key in _SECTIONS:
            values[key] = _build(_SECTIONS[key], table[key], key)
        else:
            values[key] = _convert(table[key], str(field.type), prefix + key)
    return cls(**values)


def _convert(value: object, kind: str, where: str) -> object:
    if kind == "int" and isinstance(value, int) and not isinstance(value, bool):
        return value
    if kind == "float" and isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e300:
        return float(value)
    if kind == "str" and isinstance(value, str) and value:
        return value
    if kind in ("Path", "Path | None") and isinstance(value, str) and value and "\0" not in value:
        return Path(value)
    if kind.startswith("tuple[") and isinstance(value, list):
        item = kind[len("tuple[") :].partition(",")[0]
        return tuple(_convert(each, item, where) for each in value)
    raise ConfigError(f"{where}: expected {kind}, found {value!r}")
