"""What one step of the bridge reads and writes: frozen values without behaviour."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from firmware_bridge.core.link import BridgeStatus, Message
from firmware_bridge.core.robot_state import RobotState


@dataclass(frozen=True)
class Report:
    """What arrived over the robot's network since the last step.

    `remote_in_use`: a stick or key of the robot's remote is in use. `remote_estop`: its emergency-stop keys were
    pressed. `foreign` names a motion or mode request of another client. `denied` names a request of ours that the
    robot denied because another client holds its lease. `publishers` names the input topic that has more than one
    publisher, or that a foreign program publishes motor commands. `version` is the sport service's answer to our
    question. `writes_fail`: the network has refused our last commands.
    """

    state: RobotState | None = None
    remote_in_use: bool = False
    remote_estop: bool = False
    foreign: str | None = None
    denied: str | None = None
    publishers: str | None = None
    battery_percent: int | None = None
    version: str | None = None
    writes_fail: bool = False


@dataclass(frozen=True)
class Inputs:
    """What happened since the last step, oldest first; `client`: a runner is connected now.

    `operator`: messages of the operator's socket. `estop`: the local emergency stop is pressed. `asleep_ns`: time for
    which this machine has been suspended since it was switched on, which the monotonic clock leaves out.
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
class Call:
    """Write this request of the sport service to the robot, without waiting for its answer."""

    api_id: int


@dataclass(frozen=True)
class Outputs:
    """Requests to write in this order, the state afterwards, and when `step` must run again at the latest.

    `latch`: why an emergency stop holds, empty without one; it must survive a restart of the bridge.
    """

    requests: tuple[Move | Call, ...]
    status: BridgeStatus
    wake_ns: int
    latch: str = ""
