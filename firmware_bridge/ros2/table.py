"""A base that takes a Twist has no modes and no identity: it is always ready."""

from __future__ import annotations

from typing import Final

from firmware_bridge.core.config import RobotConfig
from firmware_bridge.core.robot_table import RobotTable
from firmware_bridge.dds.interface import missing_interface

MODE: Final = 0


def missing_link(config: RobotConfig) -> str | None:
    """Return in one line that the network interface is missing; None once it is up."""
    return missing_interface(config.network.interface)


def robot_table(config: RobotConfig) -> RobotTable:
    """Return the table of a base with one mode, in which it may always drive."""
    return RobotTable(
        identity="the base",
        version=None,
        ready_modes=frozenset({MODE}),
        armed_modes=frozenset({MODE}),
        moving_modes=frozenset(),
        next_step={},
        recovery_step=0,
        step_names={0: "nothing"},  # never requested: every mode is ready
        mode_names={MODE: "always ready"},
        holds_command=config.ros2 is not None and not config.ros2.stops_itself,
    )
