"""Battery of the simulated Go2: a modelled pack discharged by electronics and motors. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

# Our choice, of the size of the maker's long-endurance pack: 8 cells in series, nominal 28.8 V.
CELLS: Final = 8
CAPACITY_C: Final = 15.0 * 3600.0
CELL_EMPTY_V: Final = 3.0
CELL_FULL_V: Final = 4.15
PACK_OHM: Final = 0.05
# Our choice: computers and sensors; a motor turns this share of electric into mechanical work, and brakes for nothing.
ELECTRONICS_W: Final = 60.0
MOTOR_EFFICIENCY: Final = 0.7


@dataclass(frozen=True)
class BatteryReading:
    """Reading of the battery management; `current_a` is positive while discharging."""

    soc_percent: float
    voltage_v: float
    current_a: float


def open_circuit_v(soc: float, cells: int = CELLS) -> float:
    """Return the open-circuit voltage of a pack of lithium cells for a charge of 0..1, V; linear."""
    return cells * (CELL_EMPTY_V + soc * (CELL_FULL_V - CELL_EMPTY_V))


class Battery:
    """State of charge; `step` takes the load."""

    def __init__(self, soc: float = 1.0) -> None:
        """`soc`: charge at the start, 0 to 1."""
        if not 0.0 <= soc <= 1.0:
            raise ValueError(f"battery: expected a charge of 0 to 1, found {soc}")
        self._charge_c = soc * CAPACITY_C

    def step(self, load_w: float, dt_s: float) -> BatteryReading:
        """Discharge by `load_w` for `dt_s` and return the reading; an empty battery stays empty."""
        open_v = open_circuit_v(self._charge_c / CAPACITY_C)
        current_a = load_w / open_v
        self._charge_c = max(self._charge_c - current_a * dt_s, 0.0)
        return BatteryReading(100.0 * self._charge_c / CAPACITY_C, open_v - current_a * PACK_OHM, current_a)


def load_w(torque_nm: NDArray[np.float64], speed_radps: NDArray[np.float64]) -> float:
    """Return the power drawn by electronics and joint motors, W."""
    return ELECTRONICS_W + float(np.maximum(torque_nm * speed_radps, 0.0).sum()) / MOTOR_EFFICIENCY
