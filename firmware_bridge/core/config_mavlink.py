"""The table [mavlink] of a robot file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from firmware_bridge.core.sections import Section, require, within_range

AUTOPILOTS: Final = ("px4", "ardupilot")


@dataclass(frozen=True)
class MavlinkConfig(Section):
    """Link to a rover's autopilot.

    `link`: `udp:HOST:PORT` of the autopilot, or `serial:PATH:BAUD`. `system`: the autopilot's MAVLink system number.
    `signing_key`: absolute path of a file with the 32-byte signing key; without one, packets are unsigned.
    """

    link: str
    autopilot: str
    system: int = within_range(1, 255, 1)
    signing_key: Path | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        kind, _, rest = self.link.partition(":")
        form = kind in ("udp", "serial") and rest.rpartition(":")[2].isdecimal() and rest.rpartition(":")[0] != ""
        require(form, f"mavlink.link: expected udp:HOST:PORT or serial:PATH:BAUD, found {self.link!r}")
        known = self.autopilot in AUTOPILOTS
        require(known, f"mavlink.autopilot: expected {' or '.join(AUTOPILOTS)}, found {self.autopilot!r}")
        key_ok = self.signing_key is None or self.signing_key.is_absolute()
        require(key_ok, f"mavlink.signing_key: expected an absolute path, found {self.signing_key}")
