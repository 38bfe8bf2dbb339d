"""A robot at the wire, nothing behind it: answers the sport service, reports its mode, notes what it receives."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass

import numpy as np

from firmware_bridge.core.config import DdsConfig
from firmware_bridge.dds.bus import Bus
from firmware_bridge.unitree.messages import ids
from firmware_bridge.unitree.messages.idl import SportModeState_, WirelessController_
from firmware_bridge.unitree.messages.idl_low import LowState_
from sim_hil.protocols.unitree.odometry import OdometryFrame
from sim_hil.protocols.unitree.services.service import APPLY, ERROR_DENIED, RENEW, Lease, LeaseServer, ServiceServer
from sim_hil.protocols.unitree.services.sport import handle_sport, parse_move
from sim_hil.protocols.unitree.state import LowStateMessage, sport_mode_state
from sim_hil.robots.go2.body import RobotTruth
from sim_hil.robots.go2.sport import SportAction

_ACCEL_MPS2 = 2.0
_HOLD_NS = 1_000_000_000  # as long as a Go2 holds a Move

_MODE_AFTER = {
    SportAction.STAND_UP: ids.MODE_JOINT_LOCK,
    SportAction.BALANCE_STAND: ids.MODE_BALANCE_STAND,
    SportAction.RECOVERY_STAND: ids.MODE_BALANCE_STAND,
    SportAction.DAMP: ids.MODE_DAMPING,
    SportAction.STAND_DOWN: ids.MODE_LIE_DOWN,
}


@dataclass(frozen=True)
class ReceivedCommand:
    """One request: when, which, and the velocity of a Move."""

    received_ns: int
    api_id: int
    velocity: tuple[float, float, float] | None


class FakeGo2:
    """Serves in a thread of its own until `close`.

    `reporting = False` makes it fall silent; `truth` changes what it reports (fields of RobotTruth); `remote` is what
    its remote sends: lx, ly, rx, ry, keys; requests in `unanswered` are noted and never answered. With `walks` it moves
    as commanded and reports that. Another client that holds `lease` shuts everybody else out.
    """

    def __init__(self, domain: int, bus: Bus | None = None) -> None:
        """`bus`: participant to use, by default one of its own."""
        self.received: list[ReceivedCommand] = []
        self.lease = Lease()
        self.reset()
        self.bus = Bus(DdsConfig(domain, "lo", ("127.0.0.1",))) if bus is None else bus
        self._server = ServiceServer(self.bus, ids.SPORT_SERVICE)
        self._leases = LeaseServer(self.bus, ids.SPORT_SERVICE, self.lease)
        self._state = self.bus.writer(ids.SPORT_STATE_TOPIC, SportModeState_)
        self._low_state = self.bus.writer(ids.LF_LOW_STATE_TOPIC, LowState_)
        self._low_message = LowStateMessage().message  # a full battery
        self._remote = self.bus.writer(ids.REMOTE_TOPIC, WirelessController_)
        self._waitset = self.bus.waitset(self._server.reader)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def sport(self, action: SportAction) -> int:
        if action is SportAction.STOP_MOVE:
            self._target_mps = 0.0
        self.mode = _MODE_AFTER.get(action, self.mode)
        return 0

    def move(self, vx_mps: float, vy_mps: float, wz_radps: float) -> None:
        self._target_mps, self._move_ns = vx_mps, time.monotonic_ns()

    def take_lease(self, vx_mps: float | None = None) -> None:
        """Another client holds the lease from now on, unseen by anybody, and drives at `vx_mps` (None: not at all)."""
        self.lease.handle(APPLY, "{}", 0, time.monotonic_ns())
        self._other_mps, self._other_holds = vx_mps, True

    def give_lease_back(self) -> None:
        """That client renews the lease no more; it ends within a second."""
        self._other_holds, self._other_mps = False, None

    def track_since(self, since_ns: int) -> list[tuple[int, float, float]]:
        """Time, speed in m/s and distance in m of every step of a robot that walks."""
        return [point for point in list(self.track) if point[0] >= since_ns]

    def reset(self) -> None:
        """Lie down, behave, and forget what was received."""
        self.mode, self.reporting, self.truth, self.version = ids.MODE_LIE_DOWN, True, {}, ids.SERVICE_VERSION
        self.remote, self.unanswered = (0.0, 0.0, 0.0, 0.0, 0), set()
        self.walks, self.speed_mps = False, 0.0
        self._other_holds = False
        self._target_mps, self._move_ns, self._other_mps = 0.0, 0, None
        self.track: deque[tuple[int, float, float]] = deque(maxlen=20_000)
        self.received.clear()

    def moves(self) -> list[ReceivedCommand]:
        return [command for command in list(self.received) if command.api_id == ids.MOVE]

    def is_driven(self) -> bool:
        """Whether the newest Move is not zero."""
        moves = self.moves()
        return bool(moves) and moves[-1].velocity != (0.0, 0.0, 0.0)

    def close(self) -> None:
        self._closing.set()
        self._thread.join()
        self.bus.close()

    def _serve(self) -> None:
        report_ns = low_report_ns = 0
        while not self._closing.is_set():
            self._waitset.wait(5_000_000)
            for request in self._server.requests():
                velocity = parse_move(request.parameter) if request.api_id == ids.MOVE else None
                self.received.append(ReceivedCommand(request.received_ns, request.api_id, velocity))
                if request.api_id == ids.API_VERSION:
                    self._server.reply(request, ids.OK, self.version)
                elif self.lease.denies(request.lease_id, request.received_ns):
                    self._server.reply(request, ERROR_DENIED)
                elif request.api_id not in self.unanswered:
                    self._server.reply(request, *handle_sport(self, request.api_id, request.parameter))
            self._leases.serve_leases()
            now_ns = time.monotonic_ns()
            truth = self._walk(now_ns) if self.walks else {}
            if self.reporting and now_ns - report_ns >= 20_000_000:
                report_ns = now_ns
                self._remote.write(WirelessController_(*self.remote))
                reported = standing(self.mode, time_s=now_ns / 1e9, **{**truth, **self.truth})
                self._state.write(sport_mode_state(reported, OdometryFrame((0.0, 0.0, 0.0))))
            if self.reporting and now_ns - low_report_ns >= 200_000_000:
                low_report_ns = now_ns
                self._low_state.write(self._low_message)

    def _walk(self, now_ns: int) -> dict[str, object]:
        """Approach what was last commanded with 2 m/s2; a Move holds for 1 s. Returns what the robot reports then."""
        if self._other_holds:
            self.lease.handle(RENEW, "", self.lease.holder(now_ns), now_ns)
        held = self._target_mps if now_ns - self._move_ns <= _HOLD_NS else 0.0
        target_mps = held if self._other_mps is None else self._other_mps
        before_ns, _, distance_m = self.track[-1] if self.track else (now_ns, 0.0, 0.0)
        passed_s = (now_ns - before_ns) / 1e9
        change_mps = _ACCEL_MPS2 * passed_s
        self.speed_mps += min(max(target_mps - self.speed_mps, -change_mps), change_mps)
        distance_m += self.speed_mps * passed_s
        self.track.append((now_ns, self.speed_mps, distance_m))
        return {
            "velocity_world_mps": np.array((self.speed_mps, 0.0, 0.0)),
            "position_m": np.array((distance_m, 0.0, 0.0)),
        }


def standing(mode: int = ids.MODE_BALANCE_STAND, **changes: object) -> RobotTruth:
    """A robot that stands still at the origin, with `changes`."""
    zeros = np.zeros
    values: dict[str, object] = {
        "time_s": 1.25, "position_m": zeros(3), "quaternion_wxyz": np.array((1.0, 0, 0, 0)), "rpy_rad": zeros(3),
        "velocity_world_mps": zeros(3), "gyro_radps": zeros(3), "accel_mps2": zeros(3), "joint_q_rad": zeros(12),
        "joint_dq_radps": zeros(12), "joint_tau_nm": zeros(12), "foot_force_n": zeros(4),
        "foot_position_body_m": zeros((4, 3)), "foot_velocity_body_mps": zeros((4, 3)), "mode": mode, "gait_type": 0,
        "body_height_m": 0.31, "commanded": (0.0, 0.0, 0.0),
    }  # fmt: skip
    return RobotTruth(**{**values, **changes})  # type: ignore[arg-type]
