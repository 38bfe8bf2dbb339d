"""Battery of the simulated Carter: 36 V and 1033 Wh (NVIDIA), discharged by electronics and motors. Pure."""

from __future__ import annotations

from typing import Final

from sim_hil.robots.battery import BatteryReading, open_circuit_v

CELLS: Final = 10  # of 3.6 V each: 36 V
CAPACITY_WH: Final = 1033.0
_CAPACITY_C: Final = CAPACITY_WH * 3600.0 / 36.0
# Our choice, which gives the maker's "over 8 hours" with ordinary driving.
PACK_OHM: Final = 0.06
ELECTRONICS_W: Final = 90.0
MOTOR_EFFICIENCY: Final = 0.75
MEAN_S: Final = 0.1  # of the reported current


def load_w(left_nm: float, left_radps: float, right_nm: float, right_radps: float) -> float:
    """Return the power drawn by electronics and both motors, W; braking recovers no energy."""
    work_w = max(left_nm * left_radps, 0.0) + max(right_nm * right_radps, 0.0)
    return ELECTRONICS_W + work_w / MOTOR_EFFICIENCY


class CarterBattery:
    """Battery that starts full; `draw` takes energy as it is used, `read` reports."""

    def __init__(self) -> None:
        self._charge_c = _CAPACITY_C
        self._used_j = self._used_s = 0.0
        self._load_w = ELECTRONICS_W

    def draw(self, power_w: float, dt_s: float) -> None:
        """Discharge by `power_w` for `dt_s`; an empty battery stays empty."""
        self._charge_c = max(self._charge_c - power_w * dt_s / open_circuit_v(self._charge_c / _CAPACITY_C, CELLS), 0.0)
        self._used_j += power_w * dt_s
        self._used_s += dt_s
        if self._used_s >= MEAN_S - dt_s / 2:  # half a step: sums of steps are not exact
            self._load_w = self._used_j / self._used_s
            self._used_j = self._used_s = 0.0

    def read(self) -> BatteryReading:
        """Return the current state; the reported current is the mean over the last full MEAN_S."""
        open_v = open_circuit_v(self._charge_c / _CAPACITY_C, CELLS)
        current_a = self._load_w / open_v
        return BatteryReading(100.0 * self._charge_c / _CAPACITY_C, open_v - current_a * PACK_OHM, current_a)
