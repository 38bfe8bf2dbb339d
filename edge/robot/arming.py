"""Arms the robot through the bridge, and stops it until the bridge confirms the stop.

Arming waits without limit for an operator where the robot file requires one.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final, Protocol

from firmware_bridge.client import BridgeStatus, BridgeUnavailable
from firmware_bridge.core.config import RobotConfig

POLL_S: Final = 0.05
CONFIRM_POLL_S: Final = 0.01
ASK_AGAIN_S: Final = 1.0
"""Period at which the arm request is repeated while the bridge waits for an operator."""
ANSWER_NS: Final = 200_000_000
"""A status this much newer than the request is an answer to it: ten steps of the bridge."""
WAITING: Final = "waiting to be armed"
ARMING: Final = "arming"
LASTS_S: Final = 6.0
"""An obstacle to arming that clears within this time is no reason to refuse."""


class RefusedError(RuntimeError):
    """The robot must not be driven now; one line for the operator."""


class StoppedEarlyError(RuntimeError):
    """A stop was requested before the robot was armed."""


class Bridge(Protocol):
    """The methods of `BridgeClient` that arming uses."""

    def arm(self) -> bool:
        """Send the bridge a request to stand the robot up and to accept commands."""

    def send_velocity(self, seq: int, stamp_ns: int, vx_mps: float, vy_mps: float, wz_radps: float) -> bool:
        """Send one velocity command; returns whether it was sent."""

    def poll(self) -> BridgeStatus | None:
        """Newest status; raises BridgeUnavailable."""


class StoppableBridge(Protocol):
    """The methods of `BridgeClient` that stopping uses."""

    def stop(self) -> bool:
        """Send the bridge a request to stop the robot."""

    def poll(self) -> BridgeStatus | None:
        """Newest status; raises BridgeUnavailable."""


class _Gate:
    """Checks whether arming may be requested: nothing may keep the robot from driving."""

    def __init__(
        self, obstacle: Callable[[], str], operator: bool, clock: Callable[[], int], say: Callable[[str], None]
    ) -> None:
        self._obstacle = obstacle
        self._operator = operator
        self._clock = clock
        self._say = say
        self._since_ns: int | None = None
        self._reported = ""
        self.why = ""

    def is_clear(self, status: BridgeStatus | None) -> bool:
        """Check once. Raises RefusedError when an obstacle remains although the robot may be armed."""
        now_ns, self.why = self._clock(), self._obstacle()
        permitted = not self._operator or (status is not None and status.blocked_by == "none")
        if not self.why or not permitted or self._since_ns is None:
            self._since_ns = now_ns
        elif now_ns - self._since_ns > LASTS_S * 1e9:
            # An operator's permission is not kept for later: the robot would start unexpectedly.
            raise RefusedError(f"not armed: {self.why}")
        if self.why and self.why != self._reported:
            self._reported = self.why
            self._say(f"not armed yet: {self.why}")
        return not self.why


def check_bridge(status: BridgeStatus | None, robot: RobotConfig) -> None:
    """Raise RefusedError when the bridge serves another robot, or lets a runner arm without the operator required.

    It read the robot file when it started: the file may have changed, or another file's bridge has the same socket.
    """
    if status is None:
        return
    restart = f"restart edge-bridge with this robot file, or give both a --socket of their own ({robot.bridge.socket})"
    if status.robot != robot.digest:
        raise RefusedError(f"the bridge serves another robot than {robot.name}, {robot.address}: {restart}")
    if robot.safety.operator_arm and status.permit == "not needed":
        raise RefusedError(f"safety.operator_arm: this robot file requires an operator, the bridge does not: {restart}")


def arm(
    bridge: Bridge,
    *,
    limit_s: float,
    stop_requested: Callable[[], bool],
    say: Callable[[str], None],
    on_wait: Callable[[str], None],
    obstacle: Callable[[], str] = lambda: "",
    operator: bool = False,
    clock: Callable[[], int] = time.monotonic_ns,
    sleep: Callable[[float], None] = time.sleep,
) -> int:
    """Arm the robot; send zero velocities until the bridge reports `armed`; return the last sequence number.

    `limit_s`: for the arming itself; waiting for an operator has no limit. `on_wait(WAITING or ARMING)`: every 50 ms
    from when that waiting began. `obstacle()`: what blocks arming, empty if nothing, checked every 50 ms; with
    `operator` it is waited for until it is empty. Raises RefusedError,
    StoppedEarlyError or BridgeUnavailable.
    """
    gate = _Gate(obstacle, operator, clock, say)
    while True:
        clear = gate.is_clear(bridge.poll())
        if stop_requested():
            raise StoppedEarlyError("stopped before the robot was armed")
        if clear:
            break
        if operator:
            on_wait(f"{WAITING} ({gate.why})")
        sleep(POLL_S)
    seq, waits, waited = 0, False, False
    asked_ns, begun = _ask(bridge, clock), False
    while True:
        if not waits:
            seq += 1
            bridge.send_velocity(seq, clock(), 0.0, 0.0, 0.0)
        status = bridge.poll()
        state = "disarmed" if status is None else status.state
        if state == "armed":
            return seq
        if state == "arming":
            begun, waits = True, False
        elif status is not None and (begun or status.stamp_ns >= asked_ns + ANSWER_NS):
            if status.cause not in ("none", "operator"):
                raise RefusedError(f"the bridge refused to arm: {status.reason}")
            waits = waits or status.cause == "operator"
        if waits and not waited:
            waited = True
            say("waiting for `edge-bridge arm`")
        if stop_requested():
            raise StoppedEarlyError("stopped while waiting to be armed" if waits else "stopped while arming")
        passed_s = (clock() - asked_ns) / 1e9
        clear = not waits or gate.is_clear(status)
        if waits and clear and passed_s >= ASK_AGAIN_S:
            asked_ns, begun = _ask(bridge, clock), False
        elif not waits and passed_s > limit_s:
            raise RefusedError(f"the bridge did not arm in {limit_s:.0f} s (its state is {state})")
        if waited:
            on_wait(ARMING if not waits else WAITING if clear else f"{WAITING} ({gate.why})")
        sleep(POLL_S)


def disarm(
    bridge: StoppableBridge,
    *,
    limit_s: float,
    clock: Callable[[], int] = time.monotonic_ns,
    sleep: Callable[[float], None] = time.sleep,
) -> bool:
    """Stop the robot; return whether within `limit_s` only zeros went out and the robot reported standing still."""
    asked_ns = clock()
    while clock() - asked_ns < limit_s * 1e9:
        bridge.stop()  # repeated: a second request changes nothing, and one may be lost in a full queue
        try:
            status = bridge.poll()
        except BridgeUnavailable:
            return False  # closing the connection stops the robot, but nothing confirms it
        stopped = status is not None and status.stamp_ns >= asked_ns and status.state in ("stopped", "disarmed")
        if status is not None and stopped and status.zero_after_stop and status.motion == "still":
            return True
        sleep(CONFIRM_POLL_S)
    return False


def _ask(bridge: Bridge, clock: Callable[[], int]) -> int:
    """Instant of the request, ns."""
    now_ns = clock()
    bridge.arm()
    return now_ns
