"""Inputs and outputs of one step of the bridge: frozen values without behaviour."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from firmware_bridge.core.link import BridgeStatus, Message
from firmware_bridge.core.robot_state import BatteryState, RobotState


@dataclass(frozen=True)
class Report:
    """Messages from the robot's network since the last step.

    `remote_in_use`: a person drives the robot by its remote, or has switched it to a mode of the remote.
    `remote_estop`: the robot's own emergency stop was pressed. `taken_over`: a person has changed the mode of the robot
    while the bridge drove it, or has chosen an automatic mode; it latches like an emergency stop. `drives_itself`: the
    robot is in an automatic mode, such as a mission or a return, and may move by it. `foreign` names a
    motion or mode request of another client. `denied` names a request of ours that the robot denied because another
    client holds its lease. `publishers` names the input that has more than one publisher. `version` is the robot's
    answer to `Identify`. `writes_fail`: the network has refused our last commands. `unsafe` names a property of the
    robot that forbids motion, such as a failsafe of its own that is weaker than the bridge's.
    """

    state: RobotState | None = None
    remote_in_use: bool = False
    remote_estop: bool = False
    foreign: str | None = None
    denied: str | None = None
    publishers: str | None = None
    battery: BatteryState | None = None
    version: str | None = None
    writes_fail: bool = False
    unsafe: str | None = None
    taken_over: bool = False
    drives_itself: bool = False


@dataclass(frozen=True)
class Inputs:
    """Events since the last step, oldest first; `client`: a runner is connected now.

    `operator`: messages of the operator's socket. `estop`: the local emergency stop is pressed. `asleep_ns`: time that
    this machine has spent suspended since boot, which the monotonic clock leaves out.
    """

    messages: Sequence[Message] = ()
    client: bool = True
    robot: Report = Report()
    operator: Sequence[Message] = ()
    estop: bool = False
    asleep_ns: int = 0
    shutdown: bool = False


@dataclass(frozen=True)
class Move:
    """Write this velocity to the robot (body frame)."""

    vx_mps: float
    vy_mps: float
    wz_radps: float


@dataclass(frozen=True)
class StopMotion:
    """Request that the robot stops by its own means, without waiting for its answer.

    `pressed`: a person at this computer has pressed the emergency stop, or holds the local input while the robot drives
    itself. It ends an automatic mode of the robot, too, such as a mission; a person who steers the robot keeps it.
    """

    pressed: bool = False


@dataclass(frozen=True)
class Identify:
    """Request the robot's version; a later report contains the answer."""


@dataclass(frozen=True)
class Stand:
    """Request one step of `RobotTable.next_step`, without waiting for its answer."""

    step: int


Request = Move | StopMotion | Identify | Stand


class Backend(Protocol):
    """One protocol's robot as the bridge sees it; no method waits and none raises."""

    def read(self, now_ns: int) -> Report:
        """Return the report of all messages since the last call; send what the protocol needs periodically."""

    def write(self, request: Request) -> None:
        """Send one request; one that the network does not accept is counted."""

    def dropped(self) -> tuple[int, int, int]:
        """Return counts so far: impossible messages, reports out of order, requests that the network refused."""

    def close(self) -> None:
        """Leave the robot's network."""


@dataclass(frozen=True)
class Outputs:
    """Requests to write in this order, the state afterwards, and when `step` must run again at the latest.

    `latch`: reason of a latched emergency stop, empty without one; it must survive a restart of the bridge.
    """

    requests: tuple[Request, ...]
    status: BridgeStatus
    wake_ns: int
    latch: str = ""
