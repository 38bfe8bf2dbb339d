"""Checks of the robot itself: the bridge that commands it, its state, its battery, pictures of its camera."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final, TypeVar

import cv2

from edge.deploy.doctor.check import Check, Level, skipped
from edge.robot.camera import decode_frame
from edge.robot.cameras.newest import CameraSource
from edge.robot.reader import RobotReader, open_reader
from firmware_bridge.backends import INSTALL
from firmware_bridge.client import BridgeClient, BridgeUnavailable
from firmware_bridge.core.config import OPERATOR_SUFFIX, RobotConfig
from firmware_bridge.core.link import BridgeStatus
from firmware_bridge.core.robot_state import CameraError, LinkOpenError
from firmware_bridge.state_client import StateReader

T = TypeVar("T")

STATE_TIMEOUT_S: Final = 3.0
MEASURE_S: Final = 1.5
NEEDED_HZ: Final = 20.0
"""Rate of states from which none is older than 100 ms, even when one is lost."""
LEAST_HZ: Final = 10.0
"""Rate of states below which the runner always finds the pose late."""
_RATE_SHARE: Final = 0.8
_POLL_S: Final = 0.02
_DISCOVERY_S: Final = 0.5  # for every participant of the network to be announced
_ADVICE: Final = {
    "estop": "an emergency stop is latched: find out why it was pressed, then `edge-bridge arm` while a runner waits",
    "unsafe_robot": "the robot's own protection is weaker than the robot file requires: correct on the robot what the"
    " bridge names, then restart edge-bridge",
    "link_down": "the bridge cannot send: plug in the robot's cable or adapter; the checks of the link say more",
    "state_silent": "the bridge receives no state: switch the robot on, then check address and rates in the robot file",
    "second_publisher": "two robots, a forger or a motor-command program are on this network: leave one robot on it",
}
"""What to do where arming is refused, by cause."""


def open_robot(robot: RobotConfig) -> tuple[RobotReader, CameraSource]:
    """Open the robot's reports and camera. Raises LinkOpenError, also where the protocol's library is missing."""
    try:
        return open_reader(robot)
    except ModuleNotFoundError as error:
        raise LinkOpenError(f"{error.name} is missing: {INSTALL[robot.protocol]}") from error


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
    opener: Callable[[RobotConfig], tuple[RobotReader, CameraSource]] = open_robot,
    timeout_s: float = STATE_TIMEOUT_S,
    measure_s: float = MEASURE_S,
) -> list[Check]:
    """Whether the robot reports its state, how fast, its battery, and pictures of its camera.

    `timeout_s`: longest wait for the first state and, from a camera of its own, the first picture; `measure_s`: time in
    which rates are measured.
    """
    where = robot.address
    try:
        reader, camera = opener(robot)
    except LinkOpenError as error:
        advice = "bring the interface up or correct the robot file"
        return [Check("robot", Level.FAIL, str(error), where, advice), skipped("camera", "the robot does not answer")]
    try:
        if robot.protocol == "unitree":
            checks = [_go2(reader, robot, timeout_s)]
        else:
            checks = _through_bridge(reader, robot, timeout_s, measure_s)
        if robot.camera.source == "robot" and reader.state() is None:
            return [*checks, skipped("camera", "the robot does not answer")]
        return [*checks, _camera(camera, robot, image_px, timeout_s, measure_s)]
    finally:
        camera.close()
        reader.close()


def _go2(reader: RobotReader, robot: RobotConfig, timeout_s: float) -> Check:
    where, state = robot.address, _wait_for(reader.state, timeout_s)
    if state is None:
        advice = "is the robot on, and its cable in? ping it; compare the robot file's [dds] section"
        return Check("robot", Level.FAIL, f"no state within {timeout_s:g} s", where, advice)
    found = f"{robot.name} reports: mode {state.mode}, error code {state.error_code}"
    surplus = _wait_for(reader.surplus_publishers, min(timeout_s, _DISCOVERY_S))
    level, found = (Level.FAIL, f"{found}; {surplus}") if surplus else (Level.OK, f"{found}; one publisher a topic")
    return Check("robot", level, found, where, _ADVICE["second_publisher"] if surplus else "")


def _through_bridge(reader: RobotReader, robot: RobotConfig, timeout_s: float, measure_s: float) -> list[Check]:
    """Judge the reports that the bridge passes on: their rate, and the battery."""
    name, expected = "robot", f"{NEEDED_HZ:g} states a second or more from {robot.address}"
    state = _wait_for(reader.state, timeout_s)
    if state is None:
        why = reader.link_error if isinstance(reader, StateReader) else ""
        found = f"no state within {timeout_s:g} s{f' ({why})' if why else ''}"
        advice = "the bridge reads the robot's link: `edge-bridge status` shows what it waits for; is the robot on?"
        return [Check(name, Level.FAIL, found, expected, advice), skipped("battery", "the robot does not answer")]
    arrived: list[int] = []
    reader.set_state_listener(lambda report: arrived.append(report.received_ns))
    time.sleep(measure_s)
    reader.set_state_listener(None)
    rate_hz = len(arrived) / measure_s
    found = f"{robot.name} reports: mode {state.mode}, error code {state.error_code}, {rate_hz:.0f} states a second"
    advice = "raise the rate of the robot's odometry: the runner drives at half speed with a state older than 100 ms"
    level = Level.FAIL if rate_hz < LEAST_HZ else Level.WARN if rate_hz < NEEDED_HZ else Level.OK
    return [Check(name, level, found, expected, advice), _battery(reader, robot, timeout_s)]


def _battery(reader: RobotReader, robot: RobotConfig, timeout_s: float) -> Check:
    name, least = "battery", robot.safety.battery_min_percent
    battery = _wait_for(reader.battery, timeout_s if least else 0.0)
    if least == 0 and battery is None:
        return skipped(name, "the robot reports none, and safety.battery_min_percent = 0 asks for none")
    expected = f"{least} % or more"
    if battery is None:
        advice = "without a report arming is refused: let the robot report it, or write safety.battery_min_percent = 0"
        return Check(name, Level.FAIL, "no report", expected, advice)
    found = f"{battery.soc_percent} %, {battery.voltage_v:.1f} V"
    return Check(name, Level.OK if battery.soc_percent >= least else Level.FAIL, found, expected, "charge the battery")


def _wait_for(read: Callable[[], T | None], timeout_s: float) -> T | None:
    """The first value that `read` gives; None when it gives none in time."""
    deadline_ns = time.monotonic_ns() + round(timeout_s * 1e9)
    while (value := read()) is None and time.monotonic_ns() < deadline_ns:
        time.sleep(_POLL_S)
    return value


def _camera(camera: CameraSource, robot: RobotConfig, image_px: int, timeout_s: float, measure_s: float) -> Check:
    name, own = "camera", robot.camera.source == "robot"
    expected = f"a JPEG picture within {robot.camera.timeout_ms} ms"
    request_s, rate = robot.camera.timeout_ms / 1e3, ""
    started_ns = time.monotonic_ns()
    try:
        jpeg = camera.request_frame(request_s if own else max(request_s, timeout_s))
        took_ms = (time.monotonic_ns() - started_ns) / 1e6
        pixels = decode_frame(jpeg, image_px)
        if not own:
            rate_hz = _picture_rate_hz(camera, request_s, measure_s)
            rate, expected = f", {rate_hz:.0f} pictures a second", f"{robot.camera.rate_hz:g} pictures a second"
    except (CameraError, cv2.error) as error:
        advice = "restart the robot's camera service; look at its lens"
        if not own:
            advice = "is the camera on, and camera.source right? open it with another program on this machine"
        return Check(name, Level.FAIL, str(error), expected, advice)
    found = f"{len(jpeg)} bytes in {took_ms:.0f} ms{rate}"
    if int(pixels.max()) == int(pixels.min()):
        return Check(name, Level.FAIL, f"{found}, all of one colour", "a picture", "take the cover off the lens")
    if rate and rate_hz < _RATE_SHARE * robot.camera.rate_hz:
        advice = "raise the camera's rate or its light, or lower camera.rate_hz; below 80 % the robot drives slower"
        return Check(name, Level.WARN, found, expected, advice)
    return Check(name, Level.OK, found, expected)


def _picture_rate_hz(camera: CameraSource, request_s: float, measure_s: float) -> float:
    """Return how many pictures a second a camera of its own delivers. Raises CameraError."""
    began_ns, count = time.monotonic_ns(), 0
    while time.monotonic_ns() - began_ns < measure_s * 1e9:
        camera.request_frame(request_s)
        count += 1
    return count / ((time.monotonic_ns() - began_ns) / 1e9)
