"""Opens the backend of a robot file's protocol; only that protocol's package and library are loaded.

A protocol is a package firmware_bridge/NAME with two modules: `table` has `robot_table(config)` and
`missing_link(config)` and needs no library; `robot_link` has `RobotLink(config, report)`, a `Backend`.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Final

from firmware_bridge.core.config import RobotConfig
from firmware_bridge.core.robot_table import RobotTable
from firmware_bridge.core.step_types import Backend

_DDS: Final = "pip install 'tic-vla-edge[unitree]' (arm64: edge-install dds)"
INSTALL: Final[Mapping[str, str]] = {
    "unitree": _DDS,
    "mavlink": "pip install 'tic-vla-edge[mavlink]'",
    "can": "pip install 'tic-vla-edge[can]'",
    "ros2": _DDS,
}
"""Command that installs a protocol's library."""


def robot_table(config: RobotConfig) -> RobotTable:
    """Return the table of the robot file's robot; loads no protocol library."""
    table: RobotTable = importlib.import_module(f"firmware_bridge.{config.protocol}.table").robot_table(config)
    return table


def missing_link(config: RobotConfig) -> str | None:
    """Return in one line which link is not there yet; None when the backend can be opened."""
    missing: str | None = importlib.import_module(f"firmware_bridge.{config.protocol}.table").missing_link(config)
    return missing


def backend_opener(config: RobotConfig) -> Callable[[RobotConfig, Callable[[str], None]], Backend]:
    """Import the protocol's library and return `open(config, report)`; `report` takes lines for the operator.

    Raises ModuleNotFoundError for a missing library; `open` raises LinkOpenError or ConfigError.
    """
    opener: Callable[[RobotConfig, Callable[[str], None]], Backend] = importlib.import_module(
        f"firmware_bridge.{config.protocol}.robot_link"
    ).RobotLink
    return opener
