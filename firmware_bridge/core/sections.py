"""Tables of a robot file: their keys, types and ranges. `config.py` puts them together."""

from __future__ import annotations

import os
import re
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar, Final

REMOTE_KEYS: Final = (
    *("R1", "L1", "start", "select", "R2", "L2", "F1", "F2"),
    *("A", "B", "X", "Y", "up", "right", "down", "left"),
)
"""Bits of a Go2's WirelessController_.keys, lowest first."""
VELOCITY_FRAMES: Final = ("odom", "body")
OPERATOR_SUFFIX: Final = ".operator"  # of the second socket, for `edge-bridge stop`, `arm` and `status`
OBSERVER_SUFFIX: Final = ".state"  # of the third socket, on which the bridge passes on the robot's reports
CAMERA_SOURCES: Final = {
    "http": "http://HOST:PORT/PATH of an MJPEG stream",
    "v4l2": "v4l2:/dev/videoN or v4l2:/dev/v4l/...",
    "gstreamer": "gstreamer:PIPELINE that ends in an appsink",
    "ros2": "ros2:/TOPIC of sensor_msgs/CompressedImage",
    "ros2raw": "ros2raw:/TOPIC of sensor_msgs/Image",
}
"""Values of camera.source other than "robot" by the part before the first colon, as messages describe them."""
_TOPIC: Final = r"(/[A-Za-z_][A-Za-z0-9_]*)+"
_ADDRESSES: Final = {
    "http": r"//([A-Za-z0-9.-]+|\[[0-9A-Fa-f:.]+\])(:(?P<port>[0-9]{1,5}))?(/[!-\"$-~]*)?",
    "v4l2": r"/dev/(video[0-9]{1,3}|v4l/[A-Za-z0-9_.:/-]+)",
    "gstreamer": r"[ -~]+![ ]*appsink( [ -~]*)?",
    "ros2": _TOPIC,
    "ros2raw": _TOPIC,
}
"""What follows that colon."""
RUN_USER: Final = Path("/run/user")  # of systemd's login manager
TMP: Final = Path("/tmp")
MAX_SOCKET_PATH_BYTES: Final = 107  # sizeof(sockaddr_un.sun_path) less its NUL, unix(7)


class ConfigError(ValueError):
    """A robot file that cannot be used; the message is one line for the operator."""


def require(condition: bool, message: str) -> None:
    if not condition:
        raise ConfigError(message)


def speed_hint(key: str, value: float) -> str:
    """Return the end of a message about a speed that is too high: the value converted from km/h."""
    return f"; if it is in km/h, write {value / 3.6:.2f}" if key.endswith("_mps") and abs(value) > 2 else ""


def within_range(low: float, high: float, default: Any = MISSING, *, above: bool = False) -> Any:
    """Declare a field with values in low..high; `above`: low itself is excluded."""
    return field(default=default, metadata={"range": (low, high, above)})


@dataclass(frozen=True)
class Section:
    """A table of the robot file, named like its class or `table_name`; checks the fields declared by `within_range`."""

    table_name: ClassVar[str] = ""

    def __post_init__(self) -> None:
        for each in (each for each in fields(self) if "range" in each.metadata):
            (low, high, above), value = each.metadata["range"], getattr(self, each.name)
            inside = low <= value <= high and not (above and value == low)
            table = self.table_name or type(self).__name__.removesuffix("Config").lower()
            key = f"{table}.{each.name}"
            require(inside, f"{key}: expected {low:g}..{high:g}, found {value}{speed_hint(each.name, value)}")


def runtime_dir() -> Path:
    """Return the directory of this user's sockets: `$XDG_RUNTIME_DIR/tic-vla-edge`, else one in /tmp by user id."""
    base = os.environ.get("XDG_RUNTIME_DIR", "")
    return Path(base) / "tic-vla-edge" if base else TMP / f"tic-vla-edge-{os.getuid()}"


def runtime_dirs() -> tuple[Path, ...]:
    """Return the directories in which a bridge that this user has started by hand may listen, `runtime_dir()` first.

    A shell of `su` or cron has no XDG_RUNTIME_DIR, so that the same user's bridge listens elsewhere. One that is not
    the login manager's was chosen on purpose: then there is no other.
    """
    own, session = os.environ.get("XDG_RUNTIME_DIR", ""), RUN_USER / str(os.getuid())
    if own and Path(own) != session:
        return (runtime_dir(),)
    return tuple(dict.fromkeys((runtime_dir(), session / "tic-vla-edge", TMP / f"tic-vla-edge-{os.getuid()}")))


@dataclass(frozen=True)
class DdsConfig(Section):
    """Network of the robot: DDS domain, our interface, and unicast peers for links without multicast.

    `participants`: most programs on one machine that use the domain. A Go2 has room for 10.
    """

    domain: int
    interface: str
    peers: tuple[str, ...] = ()
    participants: int = within_range(1, 120, 10)  # DDSI-RTPS 2.5, 9.6.2.4: 120 of them have ports of their own

    def __post_init__(self) -> None:
        super().__post_init__()
        require(0 <= self.domain <= 232, f"dds.domain: expected 0..232 (RTPS port range), found {self.domain}")
        for text in (self.interface, *self.peers):  # they are pasted into Cyclone's XML
            legal = text != "" and all(c.isalnum() or c in ".:-_" for c in text)
            require(legal, f"dds.interface/peers: expected names or addresses, found {text!r}")


@dataclass(frozen=True)
class BridgeConfig(Section):
    """Timing of the bridge; a relative socket path is in the user's runtime directory."""

    socket: Path
    rate_hz: int = within_range(10, 200, 50)
    deadman_ms: int = within_range(20, 250, 250)  # above, "zero on the wire within 300 ms" cannot be kept
    arm_timeout_s: float = within_range(1, 60, 10.0)
    state_timeout_ms: int = within_range(100, 5000, 1000)

    def __post_init__(self) -> None:
        super().__post_init__()
        path = self.socket if self.socket.is_absolute() else runtime_dir() / self.socket
        object.__setattr__(self, "socket", path)
        size = len(os.fsencode(path)) + len(OPERATOR_SUFFIX)
        fits = size <= MAX_SOCKET_PATH_BYTES
        require(fits, f"bridge.socket: {size} bytes with {OPERATOR_SUFFIX}, the system allows 107: {path}")


@dataclass(frozen=True)
class SafetyConfig(Section):
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
    battery_min_percent: int = within_range(0, 90, 10)
    remote_estop_keys: tuple[str, ...] = ("L2", "B")
    remote_deadband: float = within_range(0.01, 0.5, 0.1)
    estop_file: Path | None = None
    operator_arm: bool = False
    above_walking_speed: bool = False
    robot_lowcmd_publishers: int = within_range(0, 4, 0)

    def __post_init__(self) -> None:
        super().__post_init__()
        keys = self.remote_estop_keys
        valid = len(keys) > 0 and set(keys) <= set(REMOTE_KEYS)
        require(valid, f"safety.remote_estop_keys: expected one or more of {', '.join(REMOTE_KEYS)}, found {keys}")
        file_ok = self.estop_file is None or self.estop_file.is_absolute()
        require(file_ok, f"safety.estop_file: expected an absolute path, found {self.estop_file}")


@dataclass(frozen=True)
class LimitsConfig(Section):
    """Velocity limits and speeding-up limits enforced on every command; slowing down is never limited."""

    # A Go2's Move limits as its maker documents them; a robot file may only lower them (protocol facts, "Move").
    vx_min_mps: float = within_range(-2.5, 0)
    vx_max_mps: float = within_range(0, 3.8, above=True)
    vy_max_mps: float = within_range(0, 1)
    wz_max_radps: float = within_range(0, 4, above=True)
    accel_mps2: float = within_range(0, 20, above=True)
    alpha_radps2: float = within_range(0, 50, above=True)


@dataclass(frozen=True)
class CameraConfig(Section):
    """Front camera: request rate, age of a frame when it arrives, timeout of a request.

    `source`: "robot" for pictures over the robot's own protocol, else one of CAMERA_SOURCES.
    """

    rate_hz: float = within_range(0, 60, above=True)
    latency_ms: float = within_range(0, 2000)
    timeout_ms: int = within_range(10, 10000)
    source: str = "robot"

    def __post_init__(self) -> None:
        super().__post_init__()
        kind, _, address = self.source.partition(":")
        found = re.fullmatch(_ADDRESSES.get(kind, "(?!)"), address)
        valid = self.source == "robot" or (found and 0 < int(found.groupdict().get("port") or 80) < 65536)
        expected = CAMERA_SOURCES.get(kind) or f"robot, {' or '.join(CAMERA_SOURCES.values())}"
        require(bool(valid), f"camera.source: expected {expected}, found {self.source!r}")

    def check_protocol(self, protocol: str) -> None:
        """Raise ConfigError unless a robot of this protocol can have this source."""
        own, kind = self.source == "robot", self.source.partition(":")[0]
        others = f"protocol {protocol} carries no pictures; expected {' or '.join(CAMERA_SOURCES.values())}"
        require(not own or protocol == "unitree", f"camera.source: {others}, found {self.source!r}")
        ros = kind.startswith("ros2")
        require(not ros or protocol == "ros2", f"camera.source: {kind} needs protocol ros2, found protocol {protocol}")


@dataclass(frozen=True)
class MountConfig(Section):
    """Mount of the front camera: horizontal field of view, lens height above the floor and distance ahead of the base
    while the robot stands, and pitch downwards. Visual odometry needs it.
    """

    hfov_deg: float = within_range(20, 160)
    height_m: float = within_range(0.05, 3)
    pitch_deg: float = within_range(-45, 80)
    forward_m: float = within_range(-2, 2)


@dataclass(frozen=True)
class OdometryConfig(Section):
    """Frame of the robot's velocity report, and the age from which its pose is too old for driving.

    `calibration`: absolute path of this robot's output of `edge-calib odometry`.
    """

    velocity_frame: str
    max_age_ms: int = within_range(20, 2000)
    calibration: Path | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        file_ok = self.calibration is None or self.calibration.is_absolute()
        require(file_ok, f"odometry.calibration: expected an absolute path, found {self.calibration}")
        frame_ok = self.velocity_frame in VELOCITY_FRAMES
        require(frame_ok, f'odometry.velocity_frame: expected "odom" or "body", found {self.velocity_frame!r}')
