"""A robot at the wire, nothing behind it: answers the sport service, reports its mode, notes what it hears."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

import numpy as np

from firmware_bridge.config import DdsConfig
from firmware_bridge.unitree import ids
from firmware_bridge.unitree.dds import Bus
from firmware_bridge.unitree.idl import SportModeState_, WirelessController_
from firmware_bridge.unitree.idl_low import LowState_
from sim_hil.go2 import RobotTruth
from sim_hil.sport import SportAction
from sim_hil.unitree.service import ServiceServer
from sim_hil.unitree.sport import handle_sport, parse_move
from sim_hil.unitree.state import LowStateMessage, OdometryFrame, sport_mode_state

_MODE_AFTER = {
    SportAction.STAND_UP: ids.MODE_JOINT_LOCK,
    SportAction.BALANCE_STAND: ids.MODE_BALANCE_STAND,
    SportAction.RECOVERY_STAND: ids.MODE_BALANCE_STAND,
    SportAction.DAMP: ids.MODE_DAMPING,
    SportAction.STAND_DOWN: ids.MODE_LIE_DOWN,
}


@dataclass(frozen=True)
class Heard:
    """One request: when, which, and the velocity of a Move."""

    received_ns: int
    api_id: int
    velocity: tuple[float, float, float] | None


class FakeGo2:
    """Serves in a thread of its own until `close`.

    `reporting = False` makes it fall silent; `truth` changes what it reports (fields of RobotTruth); `remote` is what
    its remote sends: lx, ly, rx, ry, keys; requests in `unanswered` are heard and never answered.
    """

    def __init__(self, domain: int) -> None:
        self.heard: list[Heard] = []
        self.reset()
        self.bus = Bus(DdsConfig(domain, "lo", ("127.0.0.1",)))
        self._server = ServiceServer(self.bus, ids.SPORT_SERVICE)
        self._state = self.bus.writer(ids.SPORT_STATE_TOPIC, SportModeState_)
        self._low_state = self.bus.writer(ids.LF_LOW_STATE_TOPIC, LowState_)
        self._low_message = LowStateMessage().message  # a full battery
        self._remote = self.bus.writer(ids.REMOTE_TOPIC, WirelessController_)
        self._waitset = self.bus.waitset(self._server.reader)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def sport(self, action: SportAction) -> int:
        self.mode = _MODE_AFTER.get(action, self.mode)
        return 0

    def move(self, vx_mps: float, vy_mps: float, wz_radps: float) -> None:
        pass

    def reset(self) -> None:
        """Lie down, behave, and forget what was heard."""
        self.mode, self.reporting, self.truth, self.version = ids.MODE_LIE_DOWN, True, {}, ids.SERVICE_VERSION
        self.remote, self.unanswered = (0.0, 0.0, 0.0, 0.0, 0), set()
        self.heard.clear()

    def moves(self) -> list[Heard]:
        return [heard for heard in list(self.heard) if heard.api_id == ids.MOVE]

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
                self.heard.append(Heard(request.received_ns, request.api_id, velocity))
                if request.api_id == ids.API_VERSION:
                    self._server.reply(request, ids.OK, self.version)
                elif request.api_id not in self.unanswered:
                    self._server.reply(request, *handle_sport(self, request.api_id, request.parameter))
            now_ns = time.monotonic_ns()
            if self.reporting and now_ns - report_ns >= 20_000_000:
                report_ns = now_ns
                self._remote.write(WirelessController_(*self.remote))
                truth = standing(self.mode, time_s=now_ns / 1e9, **self.truth)
                self._state.write(sport_mode_state(truth, OdometryFrame((0.0, 0.0, 0.0))))
            if self.reporting and now_ns - low_report_ns >= 200_000_000:
                low_report_ns = now_ns
                self._low_state.write(self._low_message)


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
