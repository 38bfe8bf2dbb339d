"""Records of the robot's side for the flight log, as `edge.flightlog.schemas` describes them, and how often they are
due."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from edge.core.geometry import SE2
from edge.flightlog.part import Payload
from edge.flightlog.recorder import RecordSink
from edge.odometry.drift_rate import DriftRate
from firmware_bridge.core.robot_state import BatteryState, RobotState


class RecordSinks:
    """Several sinks as one."""

    def __init__(self, *sinks: RecordSink) -> None:
        self._sinks = sinks

    @staticmethod
    def of(*sinks: RecordSink | None) -> RecordSinks | None:
        """Return those that there are as one sink; None without any."""
        found = [sink for sink in sinks if sink is not None]
        return RecordSinks(*found) if found else None

    def put(self, topic: str, stamp_ns: int, payload: Payload) -> None:
        """Give the record to every sink."""
        for sink in self._sinks:
            sink.put(topic, stamp_ns, payload)


class Throttle:
    """Rate limiter: one record per period; for one thread."""

    def __init__(self, rate_hz: float) -> None:
        if not 0 < rate_hz <= 1000:
            raise ValueError(f"rate_hz must be above 0 and at most 1000, found {rate_hz}")
        self._period_ns = round(1e9 / rate_hz)
        self._due_ns = 0

    def due(self, now_ns: int) -> bool:
        """Return whether a record is due now; if so, schedule the next one a period later."""
        if now_ns < self._due_ns:
            return False
        # Keep the time grid where possible, so that a source slightly faster than the rate is not halved.
        self._due_ns = max(self._due_ns + self._period_ns, now_ns + self._period_ns // 2)
        return True


def odometry_record(
    state: RobotState,
    fused: SE2 | None,
    covariance: npt.NDArray[np.float64] | None,
    drift: DriftRate | None,
    command: tuple[float, float, float] | None,
) -> dict[str, Any]:
    """Return the `/odometry` record: the report, the fused pose, and the last commanded velocity."""
    rad_per_m = None if drift is None else drift.rad_per_m
    return {
        "raw_pose": state.T_odom_base,
        "velocity": (state.vx_mps, state.vy_mps, state.wz_radps),
        "gyro_wz_radps": state.gyro_wz_radps,
        "roll_rad": state.roll_rad,
        "pitch_rad": state.pitch_rad,
        "foot_forces": state.foot_forces,
        "pose": None if fused is None else fused.as_tuple(),
        "covariance": covariance,
        "drift_m_per_m": None if drift is None else drift.m_per_m,
        "drift_deg_per_m": None if rad_per_m is None else math.degrees(rad_per_m),
        "command": command,
    }


def battery_record(battery: BatteryState) -> dict[str, Any]:
    """Return the `/battery` record: charge, voltage and current as the robot reports them."""
    return {"soc_percent": battery.soc_percent, "voltage_v": battery.voltage_v, "current_a": battery.current_a}
