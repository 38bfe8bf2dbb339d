"""The bridge's rules, without clock, socket or protocol: `BridgeCore.step(inputs, now_ns) -> Outputs`.

States: disarmed -> arming -> armed -> stopped -> (explicit arm) arming ...
* disarmed: the bridge sends nothing, with two exceptions. A robot found moving when the bridge starts is stopped, and a
  base that holds its last command gets zeros then. An emergency stop of this computer sends a zero and a StopMotion,
  again each second while the local input is held and the robot drives itself; a robot that moves when any is pressed is
  stopped (also after an arming that was broken off).
* arming: the robot names its version and is made ready step by step, each confirmed by the mode it reports. A danger
  or a time-out refuses with a reason.
* armed: the newest good command goes out at the bridge's own rate through limits and slew.
* stopped: latched. A zero Move and a StopMotion go out at once, then zero Moves at the same rate without end, so that a
  late Move never lasts longer than a period. StopMotion is repeated while the robot moves. No message of the robot's
  network ends the zeros: only an operator's `edge-bridge release` does, so that a person can use the remote.
An emergency stop (operator, remote keys, local input) latches in every state. Only an operator's arm for a waiting
runner ends it (`permit.py`).
A command is good when it is finite, its sequence number is larger than every earlier one of the connection, and its age
is between zero and the deadman time. No received input can raise an exception.
"""

from __future__ import annotations

import math
from typing import Final

from firmware_bridge.core.config import BridgeConfig, LimitsConfig, SafetyConfig
from firmware_bridge.core.dangers import NO_BATTERY, NO_STATE, DangerWatch, Reason, is_driven, is_moving
from firmware_bridge.core.link import Arm, BridgeStatus, Release, Stop, Velocity
from firmware_bridge.core.permit import OperatorPermit
from firmware_bridge.core.robot_state import RobotState
from firmware_bridge.core.robot_table import RobotTable
from firmware_bridge.core.step_types import Identify, Inputs, Move, Outputs, Request, Stand, StopMotion

_NS_PER_MS: Final = 1_000_000
_NS_PER_S: Final = 1_000_000_000
_NEVER_NS: Final = -(2**62)
_ZERO: Final = (0.0, 0.0, 0.0)
_STOP_AGAIN_NS: Final = 100 * _NS_PER_MS
_FOUND_MOVING_NS: Final = _NS_PER_S  # a Go2 holds its last Move for one second after its commander has died
_STOPPING_NS: Final = 500 * _NS_PER_MS  # our choice: time after a stop from which a moving robot counts as disobeying
_ASLEEP_NS: Final = 100 * _NS_PER_MS
_BURST_NS: Final = 1_000 * _NS_PER_MS  # longer than an operator's command repeats its stop
_TOLD_NS: Final = 1_500 * _NS_PER_MS  # longer than `edge-bridge arm` waits for its confirmation
_ARM_AFTER_NS: Final = 2 * _NS_PER_S  # our choice: longer than `edge-bridge arm` takes from its call to its request
_PRESSES: Final = (
    "emergency stop by an operator",
    "emergency stop pressed at the local input, or its file cannot be read",
    "emergency stop pressed on the remote",
    "a person has changed the robot's mode",
)
_STILL_MOVING: Final = "THE ROBOT STILL MOVES: stop it with its own remote"
_NO_RUNNER: Final = "operator's arm refused: no runner asks to arm; start edge-run or read its last line, then repeat"
_JUST_STOPPED: Final = "operator's arm refused: a stop came or ended less than 2 s before it; look, then repeat it"
_LATCHED: Final = "`edge-bridge arm` ends this while a runner waits"


class BridgeCore:
    """State machine and gate of one bridge process; `step` may be called at any rate."""

    def __init__(
        self,
        bridge: BridgeConfig,
        limits: LimitsConfig,
        safety: SafetyConfig,
        table: RobotTable,
        now_ns: int,
        *,
        latch: str = "",
        robot: int = 0,
    ) -> None:
        """`latch`: reason of an earlier bridge process's emergency stop, or empty; `robot`: `RobotConfig.digest`."""
        self.clipped = 0
        self._robot = robot
        self._table = table
        self._period_ns = _NS_PER_S // bridge.rate_hz
        self._deadman_ns = bridge.deadman_ms * _NS_PER_MS
        self._arm_timeout_ns = int(bridge.arm_timeout_s * _NS_PER_S)
        self._state_timeout_ns = bridge.state_timeout_ms * _NS_PER_MS
        self._low = (limits.vx_min_mps, -limits.vy_max_mps, -limits.wz_max_radps)
        self._high = (limits.vx_max_mps, limits.vy_max_mps, limits.wz_max_radps)
        # Growth per tick, from the nominal period: a late tick must not allow a larger jump.
        self._growth = tuple(a / bridge.rate_hz for a in (limits.accel_mps2, limits.accel_mps2, limits.alpha_radps2))
        self._state, self._cause, self._reason = "disarmed", "none", "waiting for a client to arm"
        self._watch = DangerWatch(safety, table, self._state_timeout_ns)
        self._permit = OperatorPermit(safety.operator_arm, latch)
        self._had_client = self._ever_armed = self._released = False
        self._pressed = (False, False, False, False)
        self._pressed_ns = self._last_pressed_ns = self._told_ns = _NEVER_NS
        self._press_sent_ns = _NEVER_NS
        # In this step, by an operator or at the local input; or held there while the robot drives itself.
        self._pressed_here = False
        self._asleep_ns: int | None = None
        self._stop_sent_ns = self._stopped_ns = self._asked_ns = _NEVER_NS
        self._called: dict[int | None, int] = {}  # step -> when, during this arming
        self._arm_until_ns = self._good_until_ns = 0
        self._next_ns = now_ns
        self._target = self._last_command = _ZERO
        self._last_seq, self._commands, self._rejected = -1, 0, 0
        self._requests: list[Request] = []

    def step(self, inputs: Inputs, now_ns: int) -> Outputs:
        """Take one step's inputs and return the requests and velocity for the robot."""
        self._requests, self._pressed_here = [], False
        self._watch.note(inputs, now_ns)
        self._note_connection(inputs, now_ns)
        if self._state == "armed" and now_ns > self._good_until_ns:
            # Before the messages: those queued while this process was frozen must not satisfy the deadman.
            self._stop("deadman", "deadman: no good command in time", now_ns)
        self._handle_operator(inputs, now_ns)
        danger = self._danger(now_ns)
        if danger is not None:
            self._stop(*danger, now_ns)
        self._stop_if_found_moving(now_ns)
        for message in inputs.messages:
            if isinstance(message, Arm):
                self._arm(now_ns)
            elif isinstance(message, Stop):
                self._stop("client_stop", "stopped by the client", now_ns)
            elif isinstance(message, Velocity):
                self._accept(message, now_ns)
            else:
                self._rejected += 1  # only the bridge sends a status, only an operator releases
        if inputs.shutdown:
            self._stop("shutdown", "bridge shut down", now_ns)
        elif not inputs.client:
            self._stop("client_lost", "connection to the runner lost", now_ns)
        if self._state == "arming" and danger is None:
            self._stand_up(now_ns)
        elif self._state == "armed":
            self._check_armed(now_ns)
        if now_ns >= self._next_ns:
            self._tick(now_ns)
        wake_ns = min(self._next_ns, self._good_until_ns + 1) if self._state == "armed" else self._next_ns
        return Outputs(tuple(self._requests), self.status(now_ns), wake_ns, self._permit.latch)

    def status(self, now_ns: int) -> BridgeStatus:
        """Return the status of the bridge for its clients."""
        blocked, zero_after_stop = self._blocked(now_ns), self._state != "armed" and not self._released
        counters = (max(self._last_seq, 0), self._commands, self._rejected, self._last_command, zero_after_stop)
        causes = (self._cause, "none" if blocked is None else blocked[0])
        motion, speed_mps = self._watch.motion(now_ns, max(self._stopped_ns, self._pressed_ns))
        disobeys = self._state == "stopped" and not self._released and now_ns - self._stopped_ns >= _STOPPING_NS
        reason = f"{self._reason}; {_STILL_MOVING}" if disobeys and motion == "moving" else self._reason
        permit = self._permit.state(now_ns)
        return BridgeStatus(now_ns, self._state, reason, *counters, *causes, permit, motion, speed_mps, self._robot)

    def _note_connection(self, inputs: Inputs, now_ns: int) -> None:
        if inputs.client and not self._had_client:
            self._last_seq = -1  # numbering is per connection
        if not (inputs.client and self._had_client):
            # Also for a new client: the previous client's last Arm may have arrived with its disconnection.
            self._permit.void(disconnected=True)
        self._had_client = inputs.client
        if self._asleep_ns is not None and inputs.asleep_ns - self._asleep_ns > _ASLEEP_NS:
            self._stop("suspended", "this machine was suspended", now_ns)
        self._asleep_ns = inputs.asleep_ns

    def _handle_operator(self, inputs: Inputs, now_ns: int) -> None:
        """Handle emergency stops of every source, then an operator's arm or release; a stop takes precedence."""
        stop = any(isinstance(message, Stop) for message in inputs.operator)
        pressed = (stop, inputs.estop, inputs.robot.remote_estop, inputs.robot.taken_over)
        for is_pressed, reason in zip(pressed, _PRESSES, strict=True):
            if is_pressed:
                self._permit.hold(reason)
        new = [now and not before for now, before in zip(pressed, self._pressed, strict=True)]
        if any(new):
            self._pressed_here = any(new[:2])
            self._told_ns = _NEVER_NS
            self._engage(now_ns)
        if inputs.estop and inputs.robot.drives_itself and self._state != "armed":
            self._pressed_here = True
            self._send_press(now_ns)  # again until it holds, whatever gets lost
        self._last_pressed_ns = now_ns if any(pressed) else self._last_pressed_ns
        self._pressed = pressed
        if not stop and any(isinstance(message, Arm) for message in inputs.operator):
            self._take_permission(now_ns, held=inputs.estop)
        elif not stop and any(isinstance(message, Release) for message in inputs.operator):
            self._release()
        accepted = (Arm, Stop, Release)  # only the runner's socket commands
        self._rejected += sum(not isinstance(message, accepted) for message in inputs.operator)

    def _engage(self, now_ns: int) -> None:
        """Handle a new press: end a release, and stop a robot although this bridge does not drive it."""
        if self._released:
            self._released, self._reason = False, self._permit.latch
        if now_ns - self._pressed_ns > _BURST_NS:  # an operator's stop is repeated until it is confirmed
            self._pressed_ns = now_ns
        robot = self._watch.fresh(now_ns, self._state_timeout_ns)
        idle = self._state in ("disarmed", "stopped") and not self._ever_armed
        if idle and robot is not None and is_driven(robot, self._table):
            self._state, self._ever_armed = "armed", True
            self._stop("estop", self._permit.latch, now_ns)
        elif self._pressed_here and self._state != "armed":
            # Whatever the robot reports: it may have been commanded to move before, or drive by itself.
            self._send_press(now_ns)

    def _send_press(self, now_ns: int) -> None:
        if now_ns - self._press_sent_ns > _BURST_NS:
            self._press_sent_ns = now_ns
            self._move(_ZERO)
            self._send_stop(now_ns)

    def _take_permission(self, now_ns: int, *, held: bool) -> None:
        if not self._permit.is_needed or self._state in ("arming", "armed"):
            return
        if not held and now_ns - self._last_pressed_ns < _ARM_AFTER_NS:
            # It may have been entered before that stop, by somebody who does not know of it.
            self._cause, self._reason, self._told_ns = "operator", _JUST_STOPPED, now_ns
        elif not self._permit.give(now_ns):
            self._cause, self._reason = "operator", _NO_RUNNER
        elif self._watch.danger(now_ns) is None:  # a danger voids it in this same step
            self._told_ns = _NEVER_NS
            self._cause, self._reason = "none", "permitted by an operator, waiting for the runner to arm"

    def _release(self) -> None:
        """Send nothing until the next arming or emergency stop, so that a person can use the remote."""
        if self._state in ("stopped", "disarmed"):
            self._released = True
            self._permit.void()
            self._reason = "released by an operator: the bridge sends no command until the next arming"

    def _danger(self, now_ns: int) -> Reason | None:
        """Return what forbids motion now, in every state."""
        if self._permit.latch and not self._permit.allows(now_ns):
            return "estop", f"{self._permit.latch}; {_LATCHED}"
        return self._watch.danger(now_ns)

    def _blocked(self, now_ns: int) -> Reason | None:
        """Return why an arm would be refused now."""
        reason = self._danger(now_ns) or self._watch.obstacle(now_ns)
        if reason is None and not self._permit.allows(now_ns):
            return "operator", "waiting for an operator's `edge-bridge arm`"
        return reason

    def _arm(self, now_ns: int) -> None:
        if self._state in ("arming", "armed"):
            return
        self._permit.ask(now_ns)
        if not self._permit.allows(now_ns):
            if now_ns - self._told_ns < _TOLD_NS:
                return  # an operator is still to read why the arm was refused
            # Before everything else and without a change of state: a runner may repeat the request for hours.
            latch = f" ({self._permit.latch})" if self._permit.latch else ""
            self._cause, self._reason = "operator", f"arm refused: waiting for an operator's `edge-bridge arm`{latch}"
            return
        self._permit.use()
        self._state, self._cause, self._reason = "arming", "none", "waiting for the robot's state"
        self._released = False
        self._arm_until_ns, self._good_until_ns = now_ns + self._arm_timeout_ns, 0
        self._called, self._watch.version, self._asked_ns = {}, None, _NEVER_NS

    def _accept(self, command: Velocity, now_ns: int) -> None:
        """Take a command if it is good; otherwise it counts as absent, so the deadman keeps running."""
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
        robot, blocked, late = self._watch.robot, self._blocked(now_ns), now_ns >= self._arm_until_ns
        waited = f"after {self._arm_timeout_ns / _NS_PER_S:g} s"
        if robot is None or blocked in (NO_STATE, NO_BATTERY):  # may still arrive
            cause, reason = blocked or NO_STATE
            if late:
                self._stop(cause, f"{reason} {waited}", now_ns)
        elif blocked is not None:
            self._stop(*blocked, now_ns)
        elif late:
            if self._is_unknown():
                self._stop("wrong_robot", f"{self._table.identity} does not answer {waited}", now_ns)
            else:
                mode = self._table.name_of(robot.mode)
                self._stop("not_standing", f"the robot is in {mode}, not ready {waited}", now_ns)
        elif self._is_unknown():
            if now_ns - self._asked_ns >= _NS_PER_S:
                self._asked_ns, self._reason = now_ns, "requesting the robot's version"
                self._requests.append(Identify())
        else:
            self._stand_up_from(robot, now_ns)

    def _is_unknown(self) -> bool:
        return self._table.version is not None and self._watch.version is None

    def _stand_up_from(self, robot: RobotState, now_ns: int) -> None:
        table, ready = self._table, robot.mode in self._table.ready_modes
        if ready and not is_moving(robot):
            self._state, self._reason, self._ever_armed = "armed", "driving", True
            self._permit.finish()
            # The runner streams commands while arming; one that starts only now has a deadman time to do so.
            self._good_until_ns = max(self._good_until_ns, now_ns + self._deadman_ns)
            self._next_ns = now_ns
            return
        step = None if ready else table.next_step.get(robot.mode, table.recovery_step)
        if now_ns - self._called.get(step, _NEVER_NS) >= table.repeat_ns:
            self._called[step] = now_ns
            self._permit.begin()
            name = "stop" if step is None else table.step_names[step]
            self._reason = f"{name} sent, robot in {table.name_of(robot.mode)}"
            self._requests.append(StopMotion() if step is None else Stand(step))

    def _check_armed(self, now_ns: int) -> None:
        robot = self._watch.fresh(now_ns, self._state_timeout_ns)
        if robot is None:
            self._stop("state_silent", "no state from the robot any more", now_ns)
        elif robot.mode not in self._table.armed_modes:
            self._stop("wrong_mode", f"the robot left its driving modes ({self._table.name_of(robot.mode)})", now_ns)

    def _stop(self, cause: str, reason: str, now_ns: int) -> None:
        self._permit.void()
        if self._state not in ("arming", "armed"):
            return
        refused = self._state == "arming" and cause not in ("client_stop", "client_lost", "shutdown")
        if self._state == "armed":
            self._move(_ZERO)
            self._next_ns = now_ns + self._period_ns
        if self._state == "armed" or self._called:  # an arming that has sent nothing stays silent
            self._send_stop(now_ns)
        self._state = "disarmed" if refused and not self._ever_armed else "stopped"
        self._cause, self._reason = cause, f"arm refused: {reason}" if refused else reason
        self._target, self._stopped_ns = _ZERO, now_ns

    def _stop_if_found_moving(self, now_ns: int) -> None:
        """Stop a robot that an earlier, killed bridge left moving, before anything else."""
        robot, first_ns = self._watch.robot, self._watch.first_report_ns
        if self._state != "disarmed" or self._ever_armed or first_ns is None or robot is None:
            return
        if is_driven(robot, self._table) and now_ns - first_ns <= _FOUND_MOVING_NS:
            self._state, self._ever_armed = "armed", True  # the previous bridge's state
            self._stop("robot_moving", "the robot was moving when the bridge started; stopped it", now_ns)

    def _may_hold(self, now_ns: int) -> bool:
        """Return whether a base may still hold the last command of an earlier, killed bridge, though it stands."""
        first_ns = self._watch.first_report_ns
        return self._table.holds_command and first_ns is not None and now_ns - first_ns <= _FOUND_MOVING_NS

    def _tick(self, now_ns: int) -> None:
        self._next_ns += self._period_ns
        if self._next_ns <= now_ns:  # after a stall: one command now, no burst
            self._next_ns = now_ns + self._period_ns
        if self._state == "armed":
            blind = self._watch.fresh(now_ns, self._deadman_ns) is None  # a lost report must not end a run
            self._move(_ZERO if blind else self._slew())
        elif (self._ever_armed or self._may_hold(now_ns)) and not self._released:  # arming again too
            self._move(_ZERO)
            again = self._watch.moved_lately(now_ns) and now_ns - self._stop_sent_ns >= _STOP_AGAIN_NS
            if self._state == "stopped" and again:
                self._send_stop(now_ns)

    def _slew(self) -> tuple[float, float, float]:
        """Approach the target: a component may grow by accel/rate per tick, and shrink or change sign at once."""
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
        self._requests.append(StopMotion(self._pressed_here))
