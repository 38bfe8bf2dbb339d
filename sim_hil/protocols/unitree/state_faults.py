"""Faults of the state messages: wrong values, and messages that are lost, late, duplicated or swapped.

Pure: messages and `now_ns` in, messages out. A fault takes effect with the first message that it changes or withholds.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any, Final

import numpy as np

from sim_hil.protocols.unitree.fault_commands import FaultCommand
from sim_hil.robots.battery import CELLS, open_circuit_v

_NAN: Final = math.nan
# Faults that take effect with the next sport state; the others take effect at once.
_IN_A_STATE: Final = frozenset(
    {"odometry-jump", "odometry-freeze", "odometry-nan", "odometry-bias", "tip-over", "error-code", "wrong-mode",
     "state-reorder", "state-duplicate"}
)  # fmt: skip


def quaternion_of(roll_rad: float, pitch_rad: float, yaw_rad: float) -> list[float]:
    """Return the quaternion (w, x, y, z) of roll, pitch and yaw, applied in the order yaw, pitch, roll."""
    cr, sr = math.cos(roll_rad / 2), math.sin(roll_rad / 2)
    cp, sp = math.cos(pitch_rad / 2), math.sin(pitch_rad / 2)
    cy, sy = math.cos(yaw_rad / 2), math.sin(yaw_rad / 2)
    return [
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    ]


class StateFaults:
    """Active faults of the state topics, and the times at which they took effect."""

    def __init__(self, seed: int = 0) -> None:
        self._on: dict[str, FaultCommand] = {}
        self._waiting: set[str] = set()  # switched on, but not yet applied to a message
        self._effects: list[tuple[str, int]] = []
        self._rng = np.random.default_rng(seed)
        self._jump = (0.0, 0.0, 0.0)
        self._frozen: dict[str, Any] | None = None
        self._late: deque[tuple[int, Any]] = deque()
        self._swapped: Any = None

    def set(self, command: FaultCommand, now_ns: int) -> None:
        """Switch a fault on or off."""
        name = command.fault
        if not command.on:
            self._on.pop(name, None)
            self._waiting.discard(name)
            if name == "odometry-freeze":
                self._frozen = None
            self._effects.append((name, now_ns))
            return
        if name == "odometry-jump":
            step = (command.number("dx_m"), command.number("dy_m"), command.number("dtheta_rad"))
            x, y, theta = (a + b for a, b in zip(self._jump, step, strict=True))
            self._jump = (x, y, theta)
        else:
            self._on[name] = command
        if name in _IN_A_STATE:
            self._waiting.add(name)
        else:
            self._effects.append((name, now_ns))

    def clear(self) -> None:
        """Switch everything off; the offset of a past jump remains."""
        self._on.clear()
        self._waiting.clear()
        self._frozen = None

    def effects(self) -> list[tuple[str, int]]:
        """Return (fault, time ns) of the faults that have taken effect since the last call."""
        effects, self._effects = self._effects, []
        return effects

    def deliver(self, message: object, now_ns: int) -> list[Any]:
        """Return the messages to send instead of a new sport state; modifies the message."""
        self._alter(message)
        out = self._delivered(message, now_ns)
        self._effects += [(name, now_ns) for name in self._waiting]
        self._waiting.clear()
        return out

    def beside(self, message: object) -> list[Any]:
        """Return the messages to send on a slower topic; modifies the message."""
        self._alter(message)
        return [] if "state-silent" in self._on else [message]

    def due(self, now_ns: int) -> list[Any]:
        """Return the sport states whose delay is over, and those withheld by a fault that is now off."""
        out = []
        if self._swapped is not None and "state-reorder" not in self._on:
            out.append(self._swapped)
            self._swapped = None
        while self._late and (self._late[0][0] <= now_ns or "odometry-lag" not in self._on):
            out.append(self._late.popleft()[1])
        return out

    def alter_low(self, message: Any) -> bool:
        """Modify a low state; return False if it must not be sent. The caller updates the checksum."""
        if "tip-over" in self._on:
            self._tip(message.imu_state)
        if "low-battery" in self._on:
            soc_percent = self._on["low-battery"].number("soc_percent")
            message.bms_state.soc = round(soc_percent)
            message.power_v = open_circuit_v(0.01 * soc_percent)
            message.bms_state.cell_vol = [round(1000 * message.power_v / CELLS)] * CELLS + [0] * 7
        return not self._lost()

    def _delivered(self, message: object, now_ns: int) -> list[Any]:
        if self._lost():
            return []
        if "odometry-lag" in self._on:
            self._late.append((now_ns + round(self._on["odometry-lag"].number("delay_s") * 1e9), message))
            return []
        if "state-reorder" in self._on:
            if self._swapped is None:
                self._swapped = message
                return []
            older, self._swapped = self._swapped, None
            return [message, older]
        return [message, message] if "state-duplicate" in self._on else [message]

    def _lost(self) -> bool:
        if "state-silent" in self._on:
            return True
        loss = self._on.get("state-loss")
        return loss is not None and 100.0 * float(self._rng.random()) < loss.number("percent")

    def _alter(self, message: Any) -> None:
        if any(self._jump):
            self._move(message)
        if "odometry-freeze" in self._on:
            self._freeze(message)
        if "odometry-bias" in self._on:
            dv_mps, yaw_rad = self._on["odometry-bias"].number("dv_mps"), message.imu_state.rpy[2]
            vx, vy, vz = message.velocity
            message.velocity = [vx + dv_mps * math.cos(yaw_rad), vy + dv_mps * math.sin(yaw_rad), vz]
        if "tip-over" in self._on:
            self._tip(message.imu_state)
        if "error-code" in self._on:
            message.error_code = round(self._on["error-code"].number("code"))
        if "wrong-mode" in self._on:
            message.mode = round(self._on["wrong-mode"].number("mode"))
        if "odometry-nan" in self._on:
            self._poison(message, self._on["odometry-nan"].text("field"))

    def _move(self, message: Any) -> None:
        dx_m, dy_m, dtheta_rad = self._jump
        x, y, z = message.position
        message.position = [x + dx_m, y + dy_m, z]
        roll, pitch, yaw = message.imu_state.rpy
        yaw = math.atan2(math.sin(yaw + dtheta_rad), math.cos(yaw + dtheta_rad))
        message.imu_state.rpy = [roll, pitch, yaw]
        message.imu_state.quaternion = quaternion_of(roll, pitch, yaw)
        c, s = math.cos(dtheta_rad), math.sin(dtheta_rad)
        vx, vy, vz = message.velocity
        message.velocity = [c * vx - s * vy, s * vx + c * vy, vz]

    def _freeze(self, message: Any) -> None:
        imu = message.imu_state
        if self._frozen is None:
            self._frozen = {
                "position": message.position, "velocity": message.velocity, "yaw_speed": message.yaw_speed,
                "stamp": message.stamp, "rpy": imu.rpy, "quaternion": imu.quaternion,
            }  # fmt: skip
        held = self._frozen
        message.position, message.velocity, message.yaw_speed = held["position"], held["velocity"], held["yaw_speed"]
        imu.rpy, imu.quaternion = held["rpy"], held["quaternion"]
        if self._on["odometry-freeze"].text("velocity") == "zero":
            message.velocity, message.yaw_speed = [0.0] * 3, 0.0
        if self._on["odometry-freeze"].text("stamp") == "frozen":
            message.stamp = held["stamp"]

    def _tip(self, imu: Any) -> None:
        roll, pitch = self._on["tip-over"].number("roll_rad"), self._on["tip-over"].number("pitch_rad")
        imu.rpy = [roll, pitch, imu.rpy[2]]
        imu.quaternion = quaternion_of(roll, pitch, imu.rpy[2])

    def _poison(self, message: Any, field: str) -> None:
        if field == "position":
            message.position = [_NAN, *message.position[1:]]
        elif field == "velocity":
            message.velocity = [_NAN, *message.velocity[1:]]
        else:
            message.imu_state.rpy = [_NAN] * 3
            message.imu_state.quaternion = [0.0] * 4
