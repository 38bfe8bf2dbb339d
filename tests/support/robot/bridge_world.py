"""Operator, remote, runner and robot around a bridge core on a fake clock, with the safety rules checked in every step.

The rules are written down a second time here, from the documents: `_Rules` shares no code with the core.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from firmware_bridge.core.link import Arm, Message, Release, Stop, Velocity
from firmware_bridge.core.step_types import Identify, Move, Outputs, Request, Stand
from firmware_bridge.unitree.messages import ids
from firmware_bridge.unitree.remote import StopKeys
from tests.support.robot.bridge_bench import LIMITS, MS, SAFETY, ZERO, Bench

L2, B, A = 1 << 5, 1 << 9, 1 << 8
_STANDING_UP = frozenset({ids.STAND_UP, ids.RECOVERY_STAND, ids.BALANCE_STAND})
_TOGETHER_NS = 500 * MS
_WAITING_NS = 3_000 * MS
_PERMIT_NS = 10_000 * MS
_PERIOD_NS = 20 * MS
_DEADMAN_NS = 250 * MS
_ASLEEP_NS = 100 * MS
_DRIVING = ("arming", "armed")


class WorldRobot:
    """A Go2 that obeys the last Move for 1 s, brakes with 2 m/s2 and needs 1 s to stand up."""

    def __init__(self) -> None:
        self.mode, self.leased = ids.MODE_LIE_DOWN, False
        self._speed_mps = self._target_mps = 0.0
        self._move_ns = self._ready_ns = self._now_ns = 0
        self._next_mode = self.mode

    def take(self, requests: tuple[Request, ...], now_ns: int) -> str | None:
        """Obey; the name of a request that is denied because another client holds the lease."""
        denied = None
        for request in requests:
            if isinstance(request, Move):
                if not self.leased:
                    self._target_mps, self._move_ns = request.vx_mps, now_ns
                continue
            if isinstance(request, Identify):
                continue
            step = request.step if isinstance(request, Stand) else ids.STOP_MOVE
            if self.leased:
                denied = ids.SPORT_API_NAMES[step]
            elif step == ids.STOP_MOVE:
                self._target_mps = 0.0
            elif step in _STANDING_UP:
                up = ids.MODE_JOINT_LOCK if step == ids.STAND_UP else ids.MODE_BALANCE_STAND
                self._next_mode, self._ready_ns = up, now_ns + 1000 * MS
        return denied

    def advance(self, now_ns: int) -> float:
        """Let time pass; the speed afterwards."""
        passed_s = (now_ns - self._now_ns) / 1e9
        self._now_ns = now_ns
        if now_ns >= self._ready_ns:
            self.mode, self._ready_ns = self._next_mode, 2**62
        target = self._target_mps if now_ns - self._move_ns <= 1000 * MS else 0.0
        change = 2.0 * passed_s
        self._speed_mps += min(max(target - self._speed_mps, -change), change)
        return self._speed_mps

    def change_mode(self, mode: int) -> None:
        """Take `mode` without having been asked."""
        self.mode = self._next_mode = mode
        self._ready_ns = 2**62

    @property
    def speed_mps(self) -> float:
        """Speed of the robot itself, whatever it reports."""
        return self._speed_mps

    @property
    def reported_mode(self) -> int:
        """Mode of the report: locomotion while it walks."""
        walks = self.mode == ids.MODE_BALANCE_STAND and abs(self._speed_mps) >= 0.05
        return ids.MODE_LOCOMOTION if walks else self.mode


@dataclass
class _Gate:
    """Reference of which velocity may go out: the newest good command's, within its time, after a runner's arm.

    `asked`: the runner has asked to arm after the last stop, whatever caused that. `goal`: the newest good command of
    an armed bridge, clamped to the limits.
    """

    asked: bool = False
    last_seq: int = -1
    good_until_ns: int = -(2**62)
    goal: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def stop(self) -> None:
        self.asked, self.goal = False, (0.0, 0.0, 0.0)

    def take(self, messages: tuple, now_ns: int, state: str) -> None:
        """Follow the runner's messages of one step, which begins in `state`."""
        for message in messages:
            if isinstance(message, Stop):
                self.stop()
                state = "stopped"
            elif isinstance(message, Arm) and state not in _DRIVING:
                self.asked, self.good_until_ns, state = True, -(2**62), "arming"
            elif isinstance(message, Velocity) and self._is_good(message, now_ns, state):
                self.last_seq, self.good_until_ns = message.seq, message.stamp_ns + _DEADMAN_NS
                if state == "armed":
                    self.goal = (
                        min(max(message.vx_mps, LIMITS.vx_min_mps), LIMITS.vx_max_mps),
                        min(max(message.vy_mps, -LIMITS.vy_max_mps), LIMITS.vy_max_mps),
                        min(max(message.wz_radps, -LIMITS.wz_max_radps), LIMITS.wz_max_radps),
                    )

    def _is_good(self, message: Velocity, now_ns: int, state: str) -> bool:
        finite = all(map(math.isfinite, (message.vx_mps, message.vy_mps, message.wz_radps)))
        fresh = 0 <= now_ns - message.stamp_ns <= _DEADMAN_NS
        return state in _DRIVING and finite and fresh and message.seq > self.last_seq

    def check(self, move: Move, now_ns: int, state: str) -> None:
        """A velocity other than zero needs an armed bridge and a command of at most 250 ms; no component exceeds it."""
        if move == ZERO:
            return
        assert state == "armed", f"motion in state {state}"
        assert self.asked, "motion after a stop without an arm of the runner"
        assert now_ns <= self.good_until_ns, "a command obeyed that is older than the deadman's time"
        for value, goal in zip((move.vx_mps, move.vy_mps, move.wz_radps), self.goal, strict=True):
            # Signs, not a product: that of two of the smallest numbers is zero.
            same_sign = math.copysign(1.0, value) == math.copysign(1.0, goal)
            assert value == 0 or (same_sign and abs(value) <= abs(goal)), "not the newest good command"


@dataclass
class _Rules:
    """Reference of what the bridge may do, kept beside it; `required`: the robot file's `safety.operator_arm`."""

    required: bool = False

    held: bool = False
    asked_ns: int | None = None
    permit_ns: int | None = None
    arming_is_permitted: bool = False
    released: bool = False
    l2_ns: int | None = None
    b_ns: int | None = None
    gate: _Gate = field(default_factory=_Gate)

    @property
    def needs_operator(self) -> bool:
        return self.held or self.required

    def press(self, keys: int, now_ns: int) -> bool:
        """Whether both keys were pressed within 500 ms of each other and one of them now."""
        self.l2_ns = now_ns if keys & L2 else self.l2_ns
        self.b_ns = now_ns if keys & B else self.b_ns
        if not keys or self.l2_ns is None or self.b_ns is None:
            return False
        return max(now_ns - self.l2_ns, now_ns - self.b_ns) <= _TOGETHER_NS

    def forget_permission(self, *, disconnected: bool = False) -> None:
        self.permit_ns, self.arming_is_permitted = None, False
        self.asked_ns = None if disconnected else self.asked_ns


class World:
    """Everything around one bridge; `core_steps` counts every step of the core."""

    core_steps = 0

    def __init__(self, *, operator_arm: bool = False) -> None:
        self._safety = replace(SAFETY, operator_arm=operator_arm)
        self.bench = Bench(mode=None, client=False, safety=self._safety)
        self.robot, self.rules = WorldRobot(), _Rules(required=operator_arm)
        self.keys = StopKeys(SAFETY.remote_estop_keys)
        self.silent = self.tipped = self.broken = self.forged = self.gpio = self.writes_fail = False
        self.publishers: str | None = None
        self.denied: str | None = None
        self._state, self._latch, self._had_client, self._asleep_ns = "disarmed", "", False, 0
        self._last_move: Move = ZERO
        self._last_move_ns: int | None = None
        self.step()

    @property
    def state(self) -> str:
        return self._state

    def step(
        self,
        *messages: Message,
        operator: tuple[Message, ...] = (),
        keys: int = 0,
        stick: bool = False,
        foreign: str | None = None,
        shutdown: bool = False,
    ) -> Outputs:
        """One step of the core, everything that it wrote compared with the rules."""
        bench, rules, now_ns = self.bench, self.rules, self.bench.now_ns
        self._report()
        bench.estop = self.gpio
        pressed = self.keys.press(keys, now_ns)
        assert pressed == rules.press(keys, now_ns)
        dangers = [self.gpio, pressed, keys != 0 or stick, foreign, self.denied, self.publishers, self.writes_fail]
        dangers += [not self.silent and not self.forged and (self.tipped or self.broken)]
        stop = self.gpio or pressed or any(isinstance(message, Stop) for message in operator)
        before, latched_before = self._state, rules.held
        heard = {"remote_in_use": keys != 0 or stick, "remote_estop": pressed, "foreign": foreign}
        heard |= {"denied": self.denied, "publishers": self.publishers, "writes_fail": self.writes_fail}
        self._follow(messages, operator, stop=stop, danger=any(dangers))
        self._follow_gate(messages, stop=stop or any(dangers), shutdown=shutdown)
        outputs = bench.step(*messages, operator=operator, shutdown=shutdown, **heard)
        World.core_steps += 1
        self._check(outputs, messages, before, latched_before, stop=stop, danger=any(dangers))
        self.denied = self.robot.take(outputs.requests, now_ns)
        self._state, self._latch = outputs.status.state, outputs.latch
        return outputs

    def wait(self, ms: int) -> None:
        """Step at every wake-up that the core asks for."""
        end_ns = self.bench.now_ns + ms * MS
        wake_ns = self.step().wake_ns
        while wake_ns <= end_ns:
            self.bench.now_ns = max(wake_ns, self.bench.now_ns + 1)
            wake_ns = self.step().wake_ns
        self.bench.now_ns = end_ns

    def stall(self, ms: int) -> None:
        """The bridge gets no processor for this long."""
        self.bench.now_ns += ms * MS
        self.step()

    def change_client(self, *parting: Message, reconnects: bool = True) -> None:
        """The runner's connection ends with its last messages in the same step; the next one may follow at once."""
        self.bench.client = False
        self.step(*parting)
        if reconnects:
            self.bench.client = True
            self.step()

    def recover(self) -> None:
        """Nothing is wrong any more, the old runner has gone and a new one is connected."""
        self.silent = self.tipped = self.broken = self.forged = self.gpio = self.writes_fail = False
        self.robot.leased, self.publishers, self.bench.battery, self.bench.client = False, None, 80, False
        self.stall(1_100)
        self.bench.client = True
        self.stall(1_100)

    def restart_bridge(self) -> None:
        """SIGKILL, and a new process that takes over the latch; its clients have to connect again."""
        now_ns, asleep_ns = self.bench.now_ns + 300 * MS, self.bench.asleep_ns
        clock = {"now_ns": now_ns, "asleep_ns": asleep_ns}
        self.bench = Bench(mode=None, client=False, latch=self._latch, safety=self._safety, **clock)
        self.rules.gate, self._had_client, self._asleep_ns = _Gate(), False, asleep_ns
        self.rules.forget_permission(disconnected=True)
        self.rules.released = False
        self._state, self._last_move, self._last_move_ns = "disarmed", ZERO, None
        self.step()

    def _report(self) -> None:
        """Put the robot's report of this instant into the bench."""
        bench, speed_mps = self.bench, self.robot.advance(self.bench.now_ns)
        bench.mode = None if self.silent else self.robot.reported_mode
        bench.robot = {"vx_mps": speed_mps, "roll_rad": 1.5 if self.tipped else 0.0, "error_code": int(self.broken)}
        if self.forged:
            bench.robot, bench.mode = {}, ids.MODE_BALANCE_STAND

    def _follow(self, messages: tuple, operator: tuple, *, stop: bool, danger: bool) -> None:
        """What the events of this step permit."""
        rules, now_ns = self.rules, self.bench.now_ns
        idle = self._state not in _DRIVING
        if not self.bench.client:
            rules.forget_permission(disconnected=True)
        if stop:
            rules.held = True
            rules.forget_permission()
        if any(isinstance(message, Stop) for message in operator):
            self._end_release()
        elif any(isinstance(message, Arm) for message in operator):
            waiting = rules.asked_ns is not None and now_ns - rules.asked_ns <= _WAITING_NS
            if rules.needs_operator and waiting and idle and not stop:
                rules.permit_ns = now_ns
        elif any(isinstance(message, Release) for message in operator) and idle:
            rules.released = True
            rules.forget_permission()
        if danger:
            rules.forget_permission()
        for message in messages:
            if isinstance(message, Stop):
                rules.forget_permission()
            elif isinstance(message, Arm):
                valid = rules.permit_ns is not None and now_ns - rules.permit_ns <= _PERMIT_NS
                rules.arming_is_permitted = rules.arming_is_permitted or valid
                rules.asked_ns = now_ns if self.bench.client else None

    def _follow_gate(self, messages: tuple, *, stop: bool, shutdown: bool) -> None:
        """What this step's events leave of the runner's arm and of its commands."""
        gate, bench = self.rules.gate, self.bench
        if bench.client and not self._had_client:
            gate.last_seq = -1
        slept = bench.asleep_ns - self._asleep_ns > _ASLEEP_NS
        late = self._state == "armed" and bench.now_ns > gate.good_until_ns
        if stop or slept or late:
            gate.stop()
        gate.take(messages, bench.now_ns, "stopped" if stop or slept or late else self._state)
        if shutdown or not bench.client:
            gate.stop()
        self._had_client, self._asleep_ns = bench.client, bench.asleep_ns

    def _check(
        self, outputs: Outputs, messages: tuple, before: str, latched_before: bool, *, stop: bool, danger: bool
    ) -> None:
        rules, now_ns, status = self.rules, self.bench.now_ns, outputs.status
        moves = [request for request in outputs.requests if isinstance(request, Move)]
        calls = {request.step for request in outputs.requests if isinstance(request, Stand)}
        moves_robot = bool(calls & _STANDING_UP) or any(move != ZERO for move in moves)
        assert not (stop and moves_robot), "a command that moves the robot in the step of an emergency stop"
        assert not (danger and any(move != ZERO for move in moves)), "motion in spite of a danger"
        if (rules.held and moves_robot) or (rules.required and calls & _STANDING_UP):
            assert rules.arming_is_permitted, "motion after an emergency stop without an accepted arm of an operator"
        if before not in _DRIVING and status.state in _DRIVING:
            armed = any(isinstance(message, Arm) for message in messages)
            assert armed and self.bench.client, "the bridge armed without a runner's own request"
        if rules.needs_operator and before != "armed" and status.state == "armed":
            assert rules.arming_is_permitted, "armed without the operator that is needed"
            rules.held, rules.permit_ns = False, None
        if before != "armed" and status.state == "armed":
            rules.gate.good_until_ns = max(rules.gate.good_until_ns, now_ns + _DEADMAN_NS)
        if status.state in _DRIVING:
            self._end_release()
        if status.state == "armed" or status.state not in _DRIVING:
            rules.arming_is_permitted = False
        assert bool(outputs.latch) == rules.held, "the latch that is handed out is wrong"
        assert bool(outputs.latch) or not stop
        assert status.permit != "given" or rules.permit_ns is not None or status.state == "arming", "a permit too many"
        assert status.state not in _DRIVING or rules.gate.asked, "armed without a runner's arm after the last stop"
        for move in moves:
            rules.gate.check(move, now_ns, status.state)
            self._check_limits(move)
            self._last_move = move
        late = self._last_move_ns is not None and now_ns - self._last_move_ns >= _PERIOD_NS
        if before == status.state == "stopped" and late and not rules.released:
            assert moves, "the zeros have ended"
        assert status.state != "armed" or now_ns <= rules.gate.good_until_ns, "the deadman has not stopped the robot"
        assert status.state == "armed" or self._last_move == ZERO, "the last velocity of a stopped robot is not zero"
        # A press sends one zero to a robot that the bridge has neither driven nor found moving: no stream of them.
        streams = "armed" in (before, status.state) or (before, status.state) == ("disarmed", "stopped")
        if moves and (self._last_move_ns is not None or streams):
            self._last_move_ns = now_ns

    def _end_release(self) -> None:
        if self.rules.released and self._last_move_ns is not None:
            self._last_move_ns = self.bench.now_ns  # the zeros come back within a period
        self.rules.released = False

    def _check_limits(self, move: Move) -> None:
        last, step = self._last_move, LIMITS.accel_mps2 / 50
        assert LIMITS.vx_min_mps <= move.vx_mps <= LIMITS.vx_max_mps
        assert abs(move.vy_mps) <= LIMITS.vy_max_mps and abs(move.wz_radps) <= LIMITS.wz_max_radps
        for now, before, growth in (
            (move.vx_mps, last.vx_mps, step),
            (move.vy_mps, last.vy_mps, step),
            (move.wz_radps, last.wz_radps, LIMITS.alpha_radps2 / 50),
        ):
            assert abs(now) <= (abs(before) if now * before > 0 else 0.0) + growth
            assert math.isfinite(now)

    def command(self, vx: float, vy: float, wz: float, age_ms: int) -> None:
        """A runner's velocity command that was computed `age_ms` ago (negative: in the future)."""
        self.bench.seq += 1
        self.step(Velocity(self.bench.seq, self.bench.now_ns - age_ms * MS, vx, vy, wz))

    def command_queue(self, entries: list[tuple[int, int, float]]) -> None:
        """Commands in one step: each with what is added to the last sequence number, its age in ms, and its speed."""
        queue = []
        for more, age_ms, vx in entries:
            self.bench.seq = max(self.bench.seq + more, 0)
            queue.append(Velocity(self.bench.seq, self.bench.now_ns - age_ms * MS, vx, 0.0, -vx))
        self.step(*queue)

    def end(self) -> None:
        """The runner disconnects and is not replaced: within a step the last velocity is zero, and stays zero."""
        self.bench.client = False
        self.step()
        assert self._last_move == ZERO and self._state != "armed"
        self.wait(300)
