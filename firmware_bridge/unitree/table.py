"""Modes of a Go2 and the calls of its sport service that stand it up."""

from __future__ import annotations

from typing import Final

from firmware_bridge.core.config import RobotConfig
from firmware_bridge.core.robot_table import RobotTable
from firmware_bridge.dds.interface import missing_interface
from firmware_bridge.unitree.messages import ids

# Other modes get RecoveryStand, which the maker documents as working from any posture.
_NEXT_CALL: Final = {
    ids.MODE_IDLE: ids.STAND_UP,
    ids.MODE_LIE_DOWN: ids.STAND_UP,
    ids.MODE_JOINT_LOCK: ids.BALANCE_STAND,
    ids.MODE_LOCOMOTION: ids.STOP_MOVE,  # another client was driving: stop first
}


def missing_link(config: RobotConfig) -> str | None:
    """Return in one line that the network interface is missing; None once it is up."""
    return missing_interface(config.network.interface)


def robot_table(config: RobotConfig) -> RobotTable:
    """Return the table of a Go2; a step is an API id of its sport service."""
    return RobotTable(
        identity="the robot's sport service",
        version=config.safety.sport_version,
        ready_modes=frozenset({ids.MODE_BALANCE_STAND}),
        armed_modes=frozenset({ids.MODE_IDLE, ids.MODE_BALANCE_STAND, ids.MODE_LOCOMOTION}),
        moving_modes=frozenset({ids.MODE_LOCOMOTION}),
        next_step=_NEXT_CALL,
        recovery_step=ids.RECOVERY_STAND,
        step_names=ids.SPORT_API_NAMES,
    )
