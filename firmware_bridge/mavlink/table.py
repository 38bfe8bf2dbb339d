"""Modes of a rover and the commands that make it ready to drive by setpoints."""

from __future__ import annotations

import errno
import os
import socket
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
_NO_ROUTE: Final = (errno.ENETUNREACH, errno.EHOSTUNREACH, errno.ENETDOWN)


def mavlink_of(config: RobotConfig) -> MavlinkConfig:
    """Return the table [mavlink]. Raises ConfigError for another protocol."""
    if config.mavlink is None:
        raise ConfigError(f"protocol {config.protocol}: expected mavlink")
    return config.mavlink


def missing_link(config: RobotConfig) -> str | None:
    """Return in one line that the serial device or the route to a UDP address is missing; None once it is there."""
    mavlink = mavlink_of(config)
    if mavlink.serial is not None:
        path = mavlink.serial[0]
        return None if Path(path).exists() else f"serial device {path} does not exist"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        error = probe.connect_ex(mavlink.address)  # sends nothing
    return f"waiting for a route to {mavlink.address[0]}: {os.strerror(error)}" if error in _NO_ROUTE else None


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
