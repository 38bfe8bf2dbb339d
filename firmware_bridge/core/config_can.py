"""The table [can] of a robot file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from firmware_bridge.core.sections import Section, require

INTERFACES: Final = ("socketcan", "serial", "udp_multicast", "virtual")


@dataclass(frozen=True)
class CanConfig(Section):
    """Bus of a wheeled base. `interface` and `channel` are python-can's; `dbc` describes the frames.

    A relative `dbc` is one of the shipped files beside the robot files.
    """

    interface: str
    channel: str
    dbc: Path

    def __post_init__(self) -> None:
        super().__post_init__()
        known = self.interface in INTERFACES
        require(known, f"can.interface: expected one of {', '.join(INTERFACES)}, found {self.interface!r}")
