"""Robot description files (`firmware_bridge/robots/*.toml`): read, checked key by key, frozen.

Everything that differs between the simulated robot and a real one is in such a file, and between `go2_sim.toml`
and `go2.toml` only the `[dds]` addresses differ.
"""

from __future__ import annotations

import math
import os
import sys
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PROTOCOLS: Final = ("unitree",)
VELOCITY_FRAMES: Final = ("odom", "body")
MAX_SOCKET_PATH_BYTES: Final = 107  # sizeof(sockaddr_un.sun_path) less its NUL, unix(7)
# Go2 Move limits as the maker documents them; a robot file may only lower them (protocol facts, "Move: body frame").
GO2_VX_MPS: Final = (-2.5, 3.8)
GO2_VY_MPS: Final = 1.0
GO2_WZ_RADPS: Final = 4.0


class ConfigError(ValueError):
    """A robot file that cannot be used; the message is one line for the operator."""


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ConfigError(message)


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
        size = len(os.fsencode(path))
        _require(size <= MAX_SOCKET_PATH_BYTES, f"bridge.socket: {size} bytes, the system allows 107: {path}")
        _require(10 <= self.rate_hz <= 200, f"bridge.rate_hz: expected 10..200, found {self.rate_hz}")
        # Above 250 ms the promise "zero on the wire within 300 ms" cannot be kept.
        _require(20 <= self.deadman_ms <= 250, f"bridge.deadman_ms: expected 20..250, found {self.deadman_ms}")
        _require(1 <= self.arm_timeout_s <= 60, f"bridge.arm_timeout_s: expected 1..60, found {self.arm_timeout_s}")
        in_range = 100 <= self.state_timeout_ms <= 5000
        _require(in_range, f"bridge.state_timeout_ms: expected 100..5000, found {self.state_timeout_ms}")


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
        low, high = GO2_VX_MPS
        _require(low <= self.vx_min_mps <= 0, f"limits.vx_min_mps: expected {low}..0, found {self.vx_min_mps}")
        _require(0 < self.vx_max_mps <= high, f"limits.vx_max_mps: expected 0..{high}, found {self.vx_max_mps}")
        _require(0 <= self.vy_max_mps <= GO2_VY_MPS, f"limits.vy_max_mps: expected 0..1, found {self.vy_max_mps}")
        wz_ok = 0 < self.wz_max_radps <= GO2_WZ_RADPS
        _require(wz_ok, f"limits.wz_max_radps: expected 0..{GO2_WZ_RADPS}, found {self.wz_max_radps}")
        _require(0 < self.accel_mps2 <= 20, f"limits.accel_mps2: expected 0..20, found {self.accel_mps2}")
        _require(0 < self.alpha_radps2 <= 50, f"limits.alpha_radps2: expected 0..50, found {self.alpha_radps2}")


@dataclass(frozen=True)
class CameraConfig:
    """Front camera: how often to ask, how old a frame is when its answer arrives, how long to wait for one."""

    rate_hz: float
    latency_ms: float
    timeout_ms: int

    def __post_init__(self) -> None:
        _require(0 < self.rate_hz <= 60, f"camera.rate_hz: expected 0..60, found {self.rate_hz}")
        _require(0 <= self.latency_ms <= 2000, f"camera.latency_ms: expected 0..2000, found {self.latency_ms}")
        _require(10 <= self.timeout_ms <= 10000, f"camera.timeout_ms: expected 10..10000, found {self.timeout_ms}")


@dataclass(frozen=True)
class OdometryConfig:
    """Frame of the robot's velocity report, and the age from which its pose is too old to drive by."""

    velocity_frame: str
    max_age_ms: int

    def __post_init__(self) -> None:
        frame_ok = self.velocity_frame in VELOCITY_FRAMES
        _require(frame_ok, f'odometry.velocity_frame: expected "odom" or "body", found {self.velocity_frame!r}')
        _require(20 <= self.max_age_ms <= 2000, f"odometry.max_age_ms: expected 20..2000, found {self.max_age_ms}")


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
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
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
    if kind == "float" and isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value):
        return float(value)
    if kind == "str" and isinstance(value, str) and value:
        return value
    if kind == "Path" and isinstance(value, str) and value:
        return Path(value)
    if kind == "tuple[str, ...]" and isinstance(value, list) and all(isinstance(item, str) for item in value):
        return tuple(value)
    raise ConfigError(f"{where}: expected {kind}, found {value!r}")
