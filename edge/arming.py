"""Arming: asks the bridge until the robot stands, however long an operator takes where the robot file wants one."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final, Protocol

from firmware_bridge.client import BridgeStatus

POLL_S: Final = 0.05
ASK_AGAIN_S: Final = 1.0
"""How often the bridge is asked again while it waits for an operator."""
ANSWER_NS: Final = 200_000_000
"""A status that is younger than the question by this much was made after it was read: ten steps of the bridge."""
WAITING: Final = "waiting to be armed"
ARMING: Final = "arming"


class RefusedError(RuntimeError):
    """The robot must not be driven now; one line for the operator."""


class StoppedEarlyError(RuntimeError):
    """A stop was asked for before the robot had been armed."""


class Bridge(Protocol):
    """What arming needs of a `BridgeClient`."""

    def arm(self) -> bool:
        """Ask it to stand the robot up and take commands."""

    def send_velocity(self, seq: int, stamp_ns: int, vx_mps: float, vy_mps: float, wz_radps: float) -> bool:
        """One command."""

    def poll(self) -> BridgeStatus | None:
        """Newest status; raises BridgeUnavailable."""


def arm(
    bridge: Bridge,
    *,
    limit_s: float,
    stop_requested: Callable[[], bool],
    say: Callable[[str], None],
    on_wait: Callable[[str], None],
    clock: Callable[[], int] = time.monotonic_ns,
    sleep: Callable[[float], None] = time.sleep,
) -> int:
    """Arm, and keep the bridge fed with zeros until it has the robot on its feet; the last sequence number used.

    `limit_s`: for the arming itself; waiting for an operator has no limit. `on_wait(WAITING or ARMING)`: every 50 ms
    from when that waiting began. Raises RefusedError, StoppedEarlyError or BridgeUnavailable.
    """
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
        if waits and passed_s >= ASK_AGAIN_S:
            asked_ns, begun = _ask(bridge, clock), False
        elif not waits and passed_s > limit_s:
            raise RefusedError(f"the bridge did not arm in {limit_s:.0f} s (its state is {state})")
        if waited:
            on_wait(WAITING if waits else ARMING)
        sleep(POLL_S)


def _ask(bridge: Bridge, clock: Callable[[], int]) -> int:
    """When it was asked, ns."""
    now_ns = clock()
    bridge.arm()
    return now_ns
