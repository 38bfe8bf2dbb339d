"""Modes of a rover and the commands that make it ready to drive by setpoints."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from firmware_bridge.core.config import ConfigError, MavlinkConfig, RobotConfig
from firmware_bridge.core.robot_table import RobotTable
from firmware_bridge.mavlink import modes

# The mode comes first, so that the rover is never armed in a mode in which sticks move it.
_NEXT_STEP: Final = {
    modes.DISARMED: modes.STEP_DRIVE,
    modes.DISARMED_DRIVE: modes.STEP_ARM,
    modes.ARMED_HOLD: modes.STEP_DRIVE,
}
_REPEAT_NS: Final = 2_000_000_000  # longer than all retries of one command


def mavlink_of(config: RobotConfig) -> MavlinkConfig:
    """Return the table [mavlink]. Raises ConfigError for another protocol."""
    if config.mavlink is None:
        raise ConfigError(f"protocol {config.protocol}: expected mavlink")
    return config.mavlink


def missing_link(config: RobotConfig) -> str | None:
    """Return in one line that the serial device is missing; None for UDP, whose socket opens without a robot."""
    serial = mavlink_of(config).serial
    if serial is None or Path(serial[0]).exists():
        return None
    return f"serial device {serial[0]} does not exist"


def robot_table(config: RobotConfig) -> RobotTable:
    """Return the table of a rover; the version is the autopilot's name, answered after its parameters were read."""
    return RobotTable(
        identity="the rover's autopilot",
        version=mavlink_of(config).autopilot,
        ready_modes=frozenset({modes.ARMED_DRIVE}),
        armed_modes=frozenset({modes.ARMED_DRIVE}),
        moving_modes=frozenset(),
        next_step=_NEXT_STEP,
        recovery_step=modes.STEP_HOLD,
        step_names=modes.STEP_NAMES,
        mode_names=modes.MODE_NAMES,
        repeat_ns=_REPEAT_NS,
    )
