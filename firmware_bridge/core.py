"""The bridge's rules, without clock, socket or DDS: `BridgeCore.step(inputs, now_ns) -> Outputs`.

States: disarmed -> arming -> armed -> stopped -> (explicit arm) arming ...
* disarmed: nothing is ever sent to the robot.
* arming: the robot is stood up call by call, each confirmed by the mode it reports; a time-out refuses with a reason.
* armed: the newest good command goes out at the bridge's own rate through limits and slew.
* stopped: latched. A zero Move and a StopMove go out at once, then zero Moves for ever at the same rate.
A command is good when it is finite, its sequence number is larger than every earlier one of the connection, and its age
lies between zero and the deadman time. Nothing that is received here can raise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from firmware_bridge.config import BridgeConfig, LimitsConfig
from firmware_bridge.link import Arm, BridgeStatus, Message, Stop, Velocity
from firmware_bridge.unitree import ids

_NS_PER_MS: Final = 1_000_000
_NS_PER_S: Final = 1_000_000_000
_ZERO: Final = (0.0, 0.0, 0.0)
# What brings a robot in this mode one step nearer to walking; a mode that is not listed gets RecoveryStand, which the
# maker documents as working from any posture.
_NEXT_CALL: Final = {
    ids.MODE_IDLE: ids.STAND_UP,
    ids.MODE_LIE_DOWN: ids.STAND_UP,
    ids.MODE_JOINT_LOCK: ids.BALANCE_STAND,
    ids.MODE_LOCOMOTION: ids.STOP_MOVE,  # somebody else was driving: stop first
}
_CALL_AGAIN_NS: Final = 3 * _NS_PER_S  # standing up takes up to 2 s and must not be started over
_MODES_ARMED: Final = frozenset({ids.MODE_IDLE, ids.MODE_BALANCE_STAND, ids.MODE_LOCOMOTION})


@dataclass(frozen=True)
class Feedback:
    """Newest report of the robot: when it arrived and its SportModeState mode."""

    received_ns: int
    mode: int


@dataclass(frozen=True)
class Inputs:
    """What happened since the last step, oldest first; `client` is whether a runner is connected now."""

    messages: Sequence[Message] = ()
    client: bool = True
    feedback: Feedback | None = None
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
    """Requests to write in this order, the state afterwards, and when `step` wants to run again at the latest."""

    requests: tuple[Move | Call, ...]
    status: BridgeStatus
    wake_ns: int


class BridgeCore:
    """State machine and gate. One instance per bridge process; `step` may be called as often as one likes."""

    def __init__(self, bridge: BridgeConfig, limits: LimitsConfig, now_ns: int) -> None:
        self._period_ns = _NS_PER_S // bridge.rate_hz
        self._deadman_ns = bridge.deadman_ms * _NS_PER_MS
        self._arm_timeout_ns = int(bridge.arm_timeout_s * _NS_PER_S)
        self._state_timeout_ns = bridge.state_timeout_ms * _NS_PER_MS
        self._low = (limits.vx_min_mps, -limits.vy_max_mps, -limits.wz_max_radps)
        self._high = (limits.vx_max_mps, limits.vy_max_mps, limits.wz_max_radps)
        # Growth a tick, from the nominal period: a late tick must not allow a larger jump.
        self._growth = tuple(a / bridge.rate_hz for a in (limits.accel_mps2, limits.accel_mps2, limits.alpha_radps2))
        self._state = "disarmed"
        self._reason = "waiting for a client to arm"
        self._feedback: Feedback | None = None
        self._had_client = False
        self._ever_armed = False
        self._arm_until_ns = 0
        self._called: dict[int, int] = {}  # api id -> when, during this arming
        self._target = _ZERO
        self._good_until_ns = 0
        self._next_ns = now_ns
        self._last_seq = -1
        self._last_command = _ZERO
        self._commands = 0
        self._rejected = 0
        self._zero_after_stop = True
        self._requests: list[Move | Call] = []

    def step(self, inputs: Inputs, now_ns: int) -> Outputs:
        """Take what happened, decide what goes to the robot now."""
        self._requests = []
        self._feedback = inputs.feedback or self._feedback
        if inputs.client and not self._had_client:
            self._last_seq = -1  # numbering is per connection
        self._had_client = inputs.client
        for message in inputs.messages:
            if isinstance(message, Arm):
                self._arm(now_ns)
            elif isinstance(message, Stop):
                self._stop("stopped by the client", now_ns)
            elif isinstance(message, Velocity):
                self._accept(message, now_ns)
            else:
                self._rejected += 1  # a status is ours to send, not theirs
        if inputs.shutdown:
            self._stop("bridge shut down", now_ns)
        elif not inputs.client:
            self._stop("connection to the runner lost", now_ns)
        if self._state == "arming":
            self._stand_up(now_ns)
        elif self._state == "armed":
            self._watch(now_ns)
        if now_ns >= self._next_ns:
            self._tick(now_ns)
        return Outputs(tuple(self._requests), self.status(now_ns), self._wake_ns())

    def status(self, now_ns: int) -> BridgeStatus:
        """What a client is told."""
        counters = (max(self._last_seq, 0), self._commands, self._rejected)
        return BridgeStatus(now_ns, self._state, self._reason, *counters, self._last_command, self._zero_after_stop)

    def _arm(self, now_ns: int) -> None:
        if self._state in ("arming", "armed"):
            return
        self._state, self._reason = "arming", "waiting for the robot's state"
        self._arm_until_ns = now_ns + self._arm_timeout_ns
        self._good_until_ns = 0
        self._called = {}

    def _accept(self, command: Velocity, now_ns: int) -> None:
        """The gate. A command that is not good counts as absent, so the deadman goes on running."""
        velocity = (command.vx_mps, command.vy_mps, command.wz_radps)
        fresh = 0 <= now_ns - command.stamp_ns <= self._deadman_ns
        driving = self._state in ("arming", "armed")
        if not (driving and fresh and command.seq > self._last_seq and all(map(math.isfinite, velocity))):
            self._rejected += 1
            return
        self._last_seq = command.seq
        self._good_until_ns = command.stamp_ns + self._deadman_ns
        if self._state == "armed":
            vx, vy, wz = (min(max(v, low), high) for v, low, high in zip(velocity, self._low, self._high, strict=True))
            self._target = (vx, vy, wz)

    def _stand_up(self, now_ns: int) -> None:
        mode = self._feedback.mode if self._feedback is not None and not self._silent(now_ns) else None
        if mode == ids.MODE_BALANCE_STAND:
            self._state, self._reason = "armed", "driving"
            self._ever_armed, self._zero_after_stop = True, False
            # The runner streams commands while arming; one that only starts now gets a deadman time to do so.
            self._good_until_ns = max(self._good_until_ns, now_ns + self._deadman_ns)
            self._next_ns = now_ns
            return
        if now_ns >= self._arm_until_ns:
            waited = f"{self._arm_timeout_ns / _NS_PER_S:g} s"
            found = "the robot reports no state" if mode is None else f"the robot is in mode {mode}, not standing"
            self._state = "stopped" if self._ever_armed else "disarmed"
            self._reason = f"arm refused: {found} after {waited}"
            return
        if mode is None:
            return
        call = _NEXT_CALL.get(mode, ids.RECOVERY_STAND)
        if now_ns - self._called.get(call, now_ns - _CALL_AGAIN_NS) >= _CALL_AGAIN_NS:
            self._called[call] = now_ns
            self._reason = f"{ids.SPORT_API_NAMES[call]} sent, robot in mode {mode}"
            self._requests.append(Call(call))

    def _watch(self, now_ns: int) -> None:
        if now_ns > self._good_until_ns:
            self._stop("deadman: no good command in time", now_ns)
        elif self._silent(now_ns):
            self._stop("the robot's state has gone silent", now_ns)
        elif self._feedback is not None and self._feedback.mode not in _MODES_ARMED:
            self._stop(f"the robot left its walking modes (mode {self._feedback.mode})", now_ns)

    def _silent(self, now_ns: int) -> bool:
        return self._feedback is None or now_ns - self._feedback.received_ns > self._state_timeout_ns

    def _stop(self, reason: str, now_ns: int) -> None:
        if self._state not in ("arming", "armed"):
            return
        if self._state == "armed":
            self._move(_ZERO)
            self._next_ns = now_ns + self._period_ns
        if self._state == "armed" or self._called:  # an arming that has sent nothing stays silent
            self._requests.append(Call(ids.STOP_MOVE))
        self._state, self._reason, self._target = "stopped", reason, _ZERO
        self._zero_after_stop = True

    def _tick(self, now_ns: int) -> None:
        self._next_ns += self._period_ns
        if self._next_ns <= now_ns:  # after a stall: one command now, no burst
            self._next_ns = now_ns + self._period_ns
        if self._state == "armed":
            self._move(self._slew())
        elif self._ever_armed:  # arming again too: the robot keeps hearing zero
            self._move(_ZERO)

    def _slew(self) -> tuple[float, float, float]:
        """The target, approached: each component may grow by accel/rate a tick, and shrink or change sign at once."""
        vx, vy, wz = (
            math.copysign(min(abs(to), (abs(at) if at * to > 0 else 0.0) + growth), to)
            for to, at, growth in zip(self._target, self._last_command, self._growth, strict=True)
        )
        return vx, vy, wz

    def _move(self, velocity: tuple[float, float, float]) -> None:
        self._requests.append(Move(*velocity))
        self._last_command = velocity
        self._commands += 1

    def _wake_ns(self) -> int:
        return min(self._next_ns, self._good_until_ns + 1) if self._state == "armed" else self._next_ns
