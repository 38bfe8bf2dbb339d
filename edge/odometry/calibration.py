"""One robot's odometry calibration: `edge-calib odometry` writes it, the runner starts from it."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path

from firmware_bridge.system.input_file import read_toml


class CalibrationError(ValueError):
    """An unusable calibration file; one line for the operator."""


@dataclass(frozen=True)
class OdometryCalibration:
    """Errors of a robot's odometry, each with its standard error; the defaults are those of an unknown robot.

    Scales are reported / true motion: forward, left and yaw. `sideways_m_per_m` is the motion reported to the left per
    metre driven forward. The drifts are the remaining RMS error of one metre, per axis.
    """

    scale_x: float = 1.0
    scale_x_sigma: float = 0.05
    scale_y: float = 1.0
    scale_y_sigma: float = 0.05
    scale_yaw: float = 1.0
    scale_yaw_sigma: float = 0.05
    sideways_m_per_m: float = 0.0
    sideways_sigma: float = 0.05
    gyro_bias_radps: float = 0.0
    gyro_bias_sigma_radps: float = math.radians(0.5)
    drift_m_per_m: float = 0.03
    drift_rad_per_m: float = math.radians(2.0)

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            _require(math.isfinite(value), f"{field.name}: expected a finite number, found {value}")
            if "sigma" in field.name or field.name.startswith("drift"):
                _require(0 < value <= 1, f"{field.name}: expected more than 0 and at most 1, found {value}")
        for name in ("scale_x", "scale_y", "scale_yaw"):
            _require(0.5 <= getattr(self, name) <= 2, f"{name}: expected 0.5..2, found {getattr(self, name)}")
        for name in ("sideways_m_per_m", "gyro_bias_radps"):
            _require(abs(getattr(self, name)) <= 0.5, f"{name}: expected -0.5..0.5, found {getattr(self, name)}")


def load_calibration(path: Path) -> OdometryCalibration:
    """Read a calibration file with exactly the fields' keys. Raises CalibrationError with one clear line."""
    try:
        table = read_toml(path)
    except (OSError, ValueError) as error:
        raise CalibrationError(f"odometry calibration {path}: cannot be read: {error}") from error
    names = [field.name for field in fields(OdometryCalibration)]
    values: dict[str, float] = {}
    try:
        for key, value in table.items():
            _require(key in names, f"unknown key {key}; expected {', '.join(names)}")
            number = isinstance(value, int | float) and not isinstance(value, bool)
            _require(number, f"{key}: expected a number, found {value!r}")
            values[key] = float(value)
        for name in names:
            _require(name in values, f"missing key {name}")
        return OdometryCalibration(**values)
    except CalibrationError as error:
        raise CalibrationError(f"odometry calibration {path}: {error}; run edge-calib odometry again") from error


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise CalibrationError(message)
