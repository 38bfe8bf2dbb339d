"""The bridge's rules, without clock, socket or DDS: `BridgeCore.step(inputs, now_ns) -> Outputs`.

States: disarmed -> arming -> armed -> stopped -> (explicit arm) arming ...
* disarmed: nothing is ever sent, but for one case: a robot found moving when the bridge starts is stopped. Where the
  robot file says `operator_arm`, the runner's arm is refused until an operator has said `edge-bridge arm`, since this
  process began and since the last stop: one of them serves one arming.
* arming: the robot says what it is and is stood up call by call, each confirmed by the mode it reports; whatever
  forbids motion, or a time-out, refuses with a reason.
* armed: the newest good command goes out at the bridge's own rate through limits and slew.
* stopped: latched. A zero Move and a StopMove go out at once, then zero Moves for ever at the same rate, so that a late
  Move never lasts longer than a period; StopMove again as long as the robot is seen moving. Only while a person steers
  with the robot's own remote do the zeros pause.
A command is good when it is finite, its sequence number is larger than every earlier one of the connection, and its age
lies between zero and the deadman time. Nothing that is received here can raise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from firmware_bridge.config import BridgeConfig, LimitsConfig, SafetyConfig
from firmware_bridge.link import Arm, BridgeStatus, Message, Stop, Velocity
from firmware_bridge.unitree import ids
from firmware_bridge.unitree.state import RobotState

_NS_PER_MS: Final = 1_000_000
_NS_PER_S: Final = 1_000_000_000
_NEVER_NS: Final = -(2**62)
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
_STILL_MPS: Final = 0.05  # fault matrix row 38: stopped means slower than this for half a second
_STILL_RADPS: Final = 0.2  # our choice: well above what a standing robot's gyroscope shows
_STILL_NS: Final = 500 * _NS_PER_MS
_STOP_AGAIN_NS: Final = 100 * _NS_PER_MS
_FOUND_MOVING_NS: Final = _NS_PER_S  # a Go2 holds its last Move for one second after its commander has died
_TILT_RAD: Final = math.radians(30.0)  # fault matrix row 64
_REMOTE_NS: Final = _NS_PER_S  # our choice: how long a remote that was touched counts as in use
_YIELD_NS: Final = 200 * _NS_PER_MS  # zeros that go out before a person at the remote has the robot alone
_COMMANDER_NS: Final = 2 * _NS_PER_S  # twice as long as a Go2 holds a Move
_ASLEEP_NS: Final = 100 * _NS_PER_MS
_BATTERY_NS: Final = 10 * _NS_PER_S  # our choice: ten of the bridge's own looks at it
_NO_STATE: Final = ("state_silent", "the robot reports no state")
_NO_BATTERY: Final = ("battery_low", "no battery report")


@dataclass(frozen=True)
class Report:
    """What came over the robot's network since the last step.

    `remote_in_use`: a stick or key of the robot's remote, `remote_estop`: its emergency-stop keys; `foreign` names a
    motion or mode request that is not ours; `version` is the sport service's answer to our question; `writes_fail`: the
    network has not taken our last commands.
    """

    state: RobotState | None = None
    remote_in_use: bool = False
    remote_estop: bool = False
    foreign: str | None = None
    battery_percent: int | None = None
    version: str | None = None
    writes_fail: bool = False


@dataclass(frozen=True)
class Inputs:
    """What happened since the last step, oldest first; `client` is whether a runner is connected now.

    `operator`: messages of the second socket; `estop`: the local emergency stop is pressed; `asleep_ns`: how long this
    machine has been suspended since it was switched on, which the monotonic clock does not show.
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
    """Requests to write in this order, the state afterwards, and when `step` wants to run again at the latest."""

    requests: tuple[Move | Call, ...]
    status: BridgeStatus
    wake_ns: int


class BridgeCore:
    """State machine and gate. One instance per bridge process; `step` may be called as often as one likes."""

    def __init__(self, bridge: BridgeConfig, limits: LimitsConfig, safety: SafetyConfig, now_ns: int) -> None:
        self.clipped = 0
        self._safety = safety
        self._period_ns = _NS_PER_S // bridge.rate_hz
        self._deadman_ns = bridge.deadman_ms * _NS_PER_MS
        self._arm_timeout_ns = int(bridge.arm_timeout_s * _NS_PER_S)
        self._state_timeout_ns = bridge.state_timeout_ms * _NS_PER_MS
        self._low = (limits.vx_min_mps, -limits.vy_max_mps, -limits.wz_max_radps)
        self._high = (limits.vx_max_mps, limits.vy_max_mps, limits.wz_max_radps)
        # Growth a tick, from the nominal period: a late tick must not allow a larger jump.
        self._growth = tuple(a / bridge.rate_hz for a in (limits.accel_mps2, limits.accel_mps2, limits.alpha_radps2))
        self._state, self._cause, self._reason = "disarmed", "none", "waiting for a client to arm"
        self._robot: RobotState | None = None
        self._battery_percent, self._battery_ns = 0, _NEVER_NS
        self._version: str | None = None
        self._foreign = ""
        self._held = ""  # why an operator's arm is needed before anything moves
        self._writes_fail = self._estop = self._had_client = self._ever_armed = False
        self._permitted = False  # an operator has said arm since the last stop
        self._asleep_ns: int | None = None
        self._first_report_ns: int | None = None
        # When it was last: somebody else's request, a hand on the remote, its emergency keys, motion, our StopMove ...
        self._foreign_ns = self._remote_ns = self._remote_estop_ns = self._moving_ns = self._stop_sent_ns = _NEVER_NS
        self._stopped_ns = self._asked_ns = _NEVER_NS
        self._called: dict[int, int] = {}  # api id -> when, during this arming
        self._arm_until_ns = self._good_until_ns = 0
        self._next_ns = now_ns
        self._target = self._last_command = _ZERO
        self._last_seq, self._commands, self._rejected = -1, 0, 0
        self._requests: list[Move | Call] = []

    def step(self, inputs: Inputs, now_ns: int) -> Outputs:
        """Take what happened, decide what goes to the robot now."""
        self._requests = []
        self._note(inputs, now_ns)
        if self._state == "armed" and now_ns > self._good_until_ns:
            # Before the messages: what has queued up while this process stood still must not feed the deadman.
            self._stop("deadman", "deadman: no good command in time", now_ns)
        danger = self._danger(now_ns)
        if danger is not None:
            self._stop(*danger, now_ns)
            self._permitted = self._permitted and danger[0] != "estop"  # who presses it means a disarmed robot too
        self._stop_if_found_moving(now_ns)
        for message in inputs.messages:
            if isinstance(message, Arm):
                self._arm(now_ns)
            elif isinstance(message, Stop):
                self._stop("client_stop", "stopped by the client", now_ns)
            elif isinstance(message, Velocity):
                self._accept(message, now_ns)
            else:
                self._rejected += 1  # a status is ours to send, not theirs
        if inputs.shutdown:
            self._stop("shutdown", "bridge shut down", now_ns)
        elif not inputs.client:
            self._stop("client_lost", "connection to the runner lost", now_ns)
        if self._state == "arming" and danger is None:
            self._stand_up(now_ns)
        elif self._state == "armed":
            self._watch(now_ns)
        if now_ns >= self._next_ns:
            self._tick(now_ns)
        wake_ns = min(self._next_ns, self._good_until_ns + 1) if self._state == "armed" else self._next_ns
        return Outputs(tuple(self._requests), self.status(now_ns), wake_ns)

    def status(self, now_ns: int) -> BridgeStatus:
        """What a client is told."""
        blocked, zero_after_stop = self._blocked(now_ns), self._state != "armed"
        counters = (max(self._last_seq, 0), self._commands, self._rejected, self._last_command, zero_after_stop)
        causes = (self._cause, "none" if blocked is None else blocked[0])
        return BridgeStatus(now_ns, self._state, self._reason, *counters, *causes)

    def _note(self, inputs: Inputs, now_ns: int) -> None:
        """Remember what the step has brought, whatever the state."""
        report = inputs.robot
        if report.state is not None:
            self._robot, self._first_report_ns = report.state, self._first_report_ns or now_ns
            self._moving_ns = now_ns if _moves(report.state) else self._moving_ns
        self._remote_ns = now_ns if report.remote_in_use else self._remote_ns
        self._remote_estop_ns = now_ns if report.remote_estop else self._remote_estop_ns
        if report.foreign is not None:
            self._foreign, self._foreign_ns = report.foreign, now_ns
        if report.battery_percent is not None:
            self._battery_percent, self._battery_ns = report.battery_percent, now_ns
        self._version = report.version or self._version
        self._writes_fail, self._estop = report.writes_fail, inputs.estop
        if any(isinstance(message, Stop) for message in inputs.operator):  # an arm beside it does not undo it
            self._held, self._permitted = "emergency stop by an operator", False
        elif any(isinstance(message, Arm) for message in inputs.operator):
            self._held, self._permitted = "", True
            if self._cause == "operator":
                self._cause, self._reason = "none", "permitted by an operator, waiting for a client to arm"
        # Only the runner's socket commands.
        self._rejected += sum(not isinstance(message, (Arm, Stop)) for message in inputs.operator)
        if inputs.client and not self._had_client:
            self._last_seq = -1  # numbering is per connection
        self._had_client = inputs.client
        if self._asleep_ns is not None and inputs.asleep_ns - self._asleep_ns > _ASLEEP_NS:
            self._stop("suspended", "this machine was suspended", now_ns)
        self._asleep_ns = inputs.asleep_ns

    def _danger(self, now_ns: int) -> tuple[str, str] | None:
        """(cause, reason) of what forbids motion now, in every state."""
        robot = self._fresh(now_ns, self._state_timeout_ns)
        if self._held:
            return "estop", f"{self._held}; `edge-bridge arm` takes it back"
        if self._estop:
            return "estop", "emergency stop pressed at the local input"
        if now_ns - self._remote_estop_ns < _REMOTE_NS:
            return "estop", "emergency stop pressed on the remote"
        if now_ns - self._remote_ns < _REMOTE_NS:
            return "remote_takeover", "somebody uses the robot's remote"
        if now_ns - self._foreign_ns < _COMMANDER_NS:
            return "second_commander", f"somebody else commands the robot ({self._foreign})"
        if self._writes_fail:
            return "link_down", "the network does not take commands for the robot"
        if robot is not None and max(abs(robot.roll_rad), abs(robot.pitch_rad)) > _TILT_RAD:
            roll, pitch = math.degrees(robot.roll_rad), math.degrees(robot.pitch_rad)
            return "tipped", f"the robot is tipped over or carried (roll {roll:.0f}, pitch {pitch:.0f} degrees)"
        if robot is not None and robot.error_code not in self._safety.accepted_error_codes:
            return "robot_error", f"the robot reports error {robot.error_code}"
        return None

    def _blocked(self, now_ns: int) -> tuple[str, str] | None:
        """(cause, reason) why an arm would be refused now."""
        percent, least, wanted = self._battery_percent, self._safety.battery_min_percent, self._safety.sport_version
        if (danger := self._danger(now_ns)) is not None:
            return danger
        if self._fresh(now_ns, self._state_timeout_ns) is None:
            return _NO_STATE
        if least > 0 and now_ns - self._battery_ns > _BATTERY_NS:
            return _NO_BATTERY
        if percent < least:
            return "battery_low", f"the battery has {percent} %, at least {least} % are needed"
        if self._version not in (None, wanted):
            return "wrong_robot", f"the robot's sport service is {self._version}, the robot file expects {wanted}"
        if self._safety.operator_arm and not self._permitted:
            return "operator", "waiting for an operator's `edge-bridge arm`"
        return None

    def _arm(self, now_ns: int) -> None:
        if self._state in ("arming", "armed"):
            return
        if self._safety.operator_arm and not self._permitted:
            # Before everything else and without a change of state: a runner may ask for hours.
            self._cause, self._reason = "operator", "arm refused: waiting for an operator's `edge-bridge arm`"
            return
        self._state, self._cause, self._reason = "arming", "none", "waiting for the robot's state"
        self._arm_until_ns, self._good_until_ns = now_ns + self._arm_timeout_ns, 0
        self._called, self._version, self._asked_ns = {}, None, _NEVER_NS

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
        vx, vy, wz = (min(max(v, low), high) for v, low, high in zip(velocity, self._low, self._high, strict=True))
        self.clipped += (vx, vy, wz) != velocity
        if self._state == "armed":
            self._target = (vx, vy, wz)

    def _stand_up(self, now_ns: int) -> None:
        robot, blocked, late = self._robot, self._blocked(now_ns), now_ns >= self._arm_until_ns
        waited = f"after {self._arm_timeout_ns / _NS_PER_S:g} s"
        if robot is None or blocked in (_NO_STATE, _NO_BATTERY):  # may still come
            cause, reason = blocked or _NO_STATE
            if late:
                self._stop(cause, f"{reason} {waited}", now_ns)
        elif blocked is not None:
            self._stop(*blocked, now_ns)
        elif late:
            if self._version is None:
                self._stop("wrong_robot", f"the robot's sport service does not answer {waited}", now_ns)
            else:
                self._stop("not_standing", f"the robot is in mode {robot.mode}, not standing {waited}", now_ns)
        elif self._version is None:
            if now_ns - self._asked_ns >= _NS_PER_S:
                self._asked_ns, self._reason = now_ns, "asking the robot what it is"
                self._requests.append(Call(ids.API_VERSION))
        else:
            walks = robot.mode == ids.MODE_BALANCE_STAND and _moves(robot)
            self._stand_up_from(ids.MODE_LOCOMOTION if walks else robot.mode, now_ns)

    def _stand_up_from(self, mode: int, now_ns: int) -> None:
        call = _NEXT_CALL.get(mode, ids.RECOVERY_STAND)
        if mode == ids.MODE_BALANCE_STAND:
            self._state, self._reason, self._ever_armed = "armed", "driving", True
            # The runner streams commands while arming; one that only starts now gets a deadman time to do so.
            self._good_until_ns = max(self._good_until_ns, now_ns + self._deadman_ns)
            self._next_ns = now_ns
        elif now_ns - self._called.get(call, _NEVER_NS) >= _CALL_AGAIN_NS:
            self._called[call] = now_ns
            self._reason = f"{ids.SPORT_API_NAMES[call]} sent, robot in mode {mode}"
            self._requests.append(Call(call))

    def _watch(self, now_ns: int) -> None:
        robot = self._fresh(now_ns, self._state_timeout_ns)
        if robot is None:
            self._stop("state_silent", "the robot's state has gone silent", now_ns)
        elif robot.mode not in _MODES_ARMED:
            self._stop("wrong_mode", f"the robot left its walking modes (mode {robot.mode})", now_ns)

    def _fresh(self, now_ns: int, timeout_ns: int) -> RobotState | None:
        """The robot's newest report if it is not older than this."""
        return None if self._robot is None or now_ns - self._robot.received_ns > timeout_ns else self._robot

    def _stop(self, cause: str, reason: str, now_ns: int) -> None:
        if self._state not in ("arming", "armed"):
            return
        refused = self._state == "arming" and cause not in ("client_stop", "client_lost", "shutdown")
        if self._state == "armed":
            self._move(_ZERO)
            self._next_ns = now_ns + self._period_ns
        if self._state == "armed" or self._called:  # an arming that has sent nothing stays silent
            self._send_stop(now_ns)
            self._held = self._held or (reason if cause == "estop" else "")
        self._state = "disarmed" if refused and not self._ever_armed else "stopped"
        self._cause, self._reason = cause, f"arm refused: {reason}" if refused else reason
        self._target, self._stopped_ns, self._permitted = _ZERO, now_ns, False

    def _stop_if_found_moving(self, now_ns: int) -> None:
        """A bridge that died while driving left a moving robot behind; its successor stops it before anything else."""
        robot, first_ns = self._robot, self._first_report_ns
        if self._state != "disarmed" or self._ever_armed or first_ns is None or robot is None:
            return
        moves = _moves(robot) or robot.mode == ids.MODE_LOCOMOTION
        if moves and now_ns - first_ns <= _FOUND_MOVING_NS < now_ns - self._remote_ns:
            self._state, self._ever_armed = "armed", True  # what its predecessor was
            self._stop("robot_moving", "the robot was moving when the bridge started; stopped it", now_ns)

    def _tick(self, now_ns: int) -> None:
        self._next_ns += self._period_ns
        if self._next_ns <= now_ns:  # after a stall: one command now, no burst
            self._next_ns = now_ns + self._period_ns
        steered = now_ns - self._remote_ns < _REMOTE_NS and now_ns - self._stopped_ns >= _YIELD_NS
        if self._state == "armed":
            blind = self._fresh(now_ns, self._deadman_ns) is None  # not latched yet: a lost report must not end a run
            self._move(_ZERO if blind else self._slew())
        elif self._ever_armed and not steered:  # arming again too: the robot keeps hearing zero
            self._move(_ZERO)
            moving = now_ns - self._moving_ns < _STILL_NS
            if self._state == "stopped" and moving and now_ns - self._stop_sent_ns >= _STOP_AGAIN_NS:
                self._send_stop(now_ns)

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

    def _send_stop(self, now_ns: int) -> None:
        self._stop_sent_ns = now_ns
        self._requests.append(Call(ids.STOP_MOVE))


def _moves(robot: RobotState) -> bool:
    return math.hypot(robot.vx_mps, robot.vy_mps) >= _STILL_MPS or abs(robot.wz_radps) >= _STILL_RADPS
