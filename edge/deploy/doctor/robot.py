"""Checks of the link to the robot: its cable, the bridge that commands it, its state, one picture of its camera."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, Protocol, TypeVar

import cv2

from edge.deploy.doctor.check import Check, Level, skipped
from edge.deploy.units import FIREWALL_FILE, FIREWALL_FOLDER, FIREWALL_UNIT
from edge.run.camera import decode_frame
from firmware_bridge.client import BridgeClient, BridgeUnavailable
from firmware_bridge.core.config import OPERATOR_SUFFIX, RobotConfig
from firmware_bridge.core.link import BridgeStatus
from firmware_bridge.core.robot_state import CameraError, DdsError, RobotState

T = TypeVar("T")

STATE_TIMEOUT_S: Final = 3.0
_POLL_S: Final = 0.02
_DISCOVERY_S: Final = 0.5  # for every participant of the network to be announced
_OWN_CABLE: Final = "a cable of its own, behind the firewall"
_ADVICE: Final = {
    "estop": "an emergency stop is latched: find out why it was pressed, then `edge-bridge arm` while a runner waits",
    "second_publisher": "two robots, a forger or a motor-command program are on this network: leave one robot on it",
}
"""What to do where arming is refused, by cause."""


def cable(interface: str, root: Path) -> Check:
    """Whether only this machine reaches the robot: its interface is no radio, not bridged, not routed, filtered."""
    name = "robot's cable"
    if interface == "lo":
        return skipped(name, "a simulated robot has none")
    device = root / "sys/class/net" / interface
    if not device.exists():
        return Check(name, Level.FAIL, f"no interface {interface}", _OWN_CABLE, "plug it in or correct dds.interface")
    if (device / "master").exists():
        found = f"{interface} is part of {(device / 'master').resolve().name}"
        return Check(
            name, Level.FAIL, found, _OWN_CABLE, f"ip link set {interface} nomaster: other networks reach the robot"
        )
    if (device / "wireless").exists() or (device / "phy80211").exists():
        advice = "use a cable: every program in that radio network can command the robot"
        return Check(name, Level.WARN, f"{interface} is a radio", _OWN_CABLE, advice)
    if interface in _default_routes(root):
        advice = f"remove the default route of {interface}: it leads other traffic to the robot's network"
        return Check(name, Level.WARN, f"the default route leads over {interface}", _OWN_CABLE, advice)
    rules = FIREWALL_FOLDER / FIREWALL_FILE
    if not (root / rules.relative_to("/")).exists():
        advice = f"edge-install units writes it; sudo systemctl enable --now {FIREWALL_UNIT} loads it"
        return Check(name, Level.WARN, f"{interface}, without {rules}", _OWN_CABLE, advice)
    return Check(name, Level.OK, f"{interface}; {rules} is there", _OWN_CABLE)


def _default_routes(root: Path) -> list[str]:
    """Interfaces with a default route, as /proc/net/route lists them (proc(5))."""
    try:
        lines = (root / "proc/net/route").read_text(encoding="ascii").splitlines()[1:]
    except OSError:
        return []
    fields = [line.split() for line in lines]
    return [row[0] for row in fields if len(row) > 7 and row[1] == row[7] == "00000000"]


class Reader(Protocol):
    """What reads the robot; `Go2Reader` in production."""

    def state(self) -> RobotState | None:
        """Newest state."""

    def request_frame(self, timeout_s: float) -> bytes:
        """One JPEG; raises CameraError."""

    def surplus_publishers(self) -> str | None:
        """Which topic of the robot has more publishers than it should have."""

    def close(self) -> None:
        """Leave the bus."""


def open_go2(robot: RobotConfig) -> Reader:
    """Join the robot's DDS domain. Raises DdsError, also where the binding is missing."""
    try:
        from firmware_bridge.unitree.client import Go2Reader
    except ModuleNotFoundError as error:
        advice = "pip install 'tic-vla-edge[unitree]' (arm64: edge-install dds)"
        raise DdsError(f"{error.name} is missing: {advice}") from error
    return Go2Reader(robot)


def ask_bridge(robot: RobotConfig) -> BridgeStatus | None:
    """Status of the bridge over the operator's socket, which leaves the runner its own; raises BridgeUnavailable."""
    client = BridgeClient(f"{robot.bridge.socket}{OPERATOR_SUFFIX}")
    try:
        return client.poll()
    finally:
        client.close()


def bridge(robot: RobotConfig, ask: Callable[[RobotConfig], BridgeStatus | None] = ask_bridge) -> Check:
    """Whether the bridge answers, and whether it would arm."""
    name = "bridge"
    try:
        status = ask(robot)
    except BridgeUnavailable as error:
        return Check(name, Level.FAIL, str(error), "a bridge that answers", "start edge-bridge or its service")
    if status is None:
        return Check(name, Level.FAIL, "it sends no status", "a bridge that answers", "restart edge-bridge")
    found = f"{status.state}: {status.reason}" if status.reason else status.state
    if status.blocked_by == "operator":  # comes last: nothing else is in the way
        return Check(name, Level.OK, f"{found}; waits for `edge-bridge arm`", "ready to arm")
    if status.blocked_by != "none":
        advice = _ADVICE.get(
            status.blocked_by, f"arming is refused because of {status.blocked_by}; edge-bridge status shows more"
        )
        return Check(name, Level.FAIL, f"{found}; blocked by {status.blocked_by}", "ready to arm", advice)
    return Check(name, Level.OK, found, "ready to arm")


def robot_link(
    robot: RobotConfig,
    image_px: int,
    *,
    open_reader: Callable[[RobotConfig], Reader] = open_go2,
    timeout_s: float = STATE_TIMEOUT_S,
) -> list[Check]:
    """Whether the robot reports its state, and one picture of its camera."""
    where = robot.address
    try:
        reader = open_reader(robot)
    except DdsError as error:
        advice = "bring the interface up or correct the robot file"
        return [Check("robot", Level.FAIL, str(error), where, advice), skipped("camera", "the robot does not answer")]
    try:
        state = _wait_for(reader.state, timeout_s)
        if state is None:
            found = f"no state within {timeout_s:g} s"
            advice = "is the robot on, and its cable in? ping it; compare the robot file's [dds] section"
            return [Check("robot", Level.FAIL, found, where, advice), skipped("camera", "the robot does not answer")]
        found = f"{robot.name} reports: mode {state.mode}, error code {state.error_code}"
        surplus = _wait_for(reader.surplus_publishers, min(timeout_s, _DISCOVERY_S))
        level, found = (Level.FAIL, f"{found}; {surplus}") if surplus else (Level.OK, f"{found}; one publisher a topic")
        advice = _ADVICE["second_publisher"] if surplus else ""
        return [Check("robot", level, found, where, advice), _camera(reader, robot, image_px)]
    finally:
        reader.close()


def _wait_for(read: Callable[[], T | None], timeout_s: float) -> T | None:
    """The first value that `read` gives; None when it gives none in time."""
    deadline_ns = time.monotonic_ns() + round(timeout_s * 1e9)
    while (value := read()) is None and time.monotonic_ns() < deadline_ns:
        time.sleep(_POLL_S)
    return value


def _camera(reader: Reader, robot: RobotConfig, image_px: int) -> Check:
    name = "camera"
    expected = f"a JPEG picture within {robot.camera.timeout_ms} ms"
    started_ns = time.monotonic_ns()
    try:
        jpeg = reader.request_frame(robot.camera.timeout_ms / 1e3)
        took_ms = (time.monotonic_ns() - started_ns) / 1e6
        pixels = decode_frame(jpeg, image_px)
    except (CameraError, cv2.error) as error:
        return Check(name, Level.FAIL, str(error), expected, "restart the robot's camera service; look at its lens")
    found = f"{len(jpeg)} bytes in {took_ms:.0f} ms"
    if int(pixels.max()) == int(pixels.min()):
        return Check(name, Level.FAIL, f"{found}, all of one colour", "a picture", "take the cover off the lens")
    return Check(name, Level.OK, found, expected)
