"""The table [mavlink] of a robot file."""

from __future__ import annotations

from dataclasses import dataclass
from ipaddress import IPv4Address
from pathlib import Path
from typing import Final

from firmware_bridge.core.sections import Section, require, within_range

AUTOPILOTS: Final = ("px4", "ardupilot")
BAUDS: Final = (57600, 115200, 230400, 460800, 500000, 921600, 1000000, 1500000, 2000000)
"""Line speeds that carry the rover's reports and that termios(3) knows; 57600 leaves no room for a second program."""
_MAX_DIGITS: Final = 7  # of a port and a line speed


@dataclass(frozen=True)
class MavlinkConfig(Section):
    """Link to a rover's autopilot.

    `link`: `udp:HOST:PORT` of the autopilot with an IPv4 address, or `serial:PATH:BAUD`. `local_port`: UDP port of the
    bridge, 0 for any free one. `system`: the autopilot's MAVLink system number. `own_system`: the bridge's, 0 for the
    autopilot's. `signing_key`: absolute path of a file with the 32-byte signing key; without one, packets are unsigned.
    `setpoint_loss_max_s` and `station_loss_max_s`: longest times after which the autopilot itself must react to missing
    setpoints and to missing heartbeats.
    """

    link: str
    autopilot: str
    system: int = within_range(1, 255, 1)
    own_system: int = within_range(0, 255, 0)
    local_port: int = within_range(0, 65535, 0)
    signing_key: Path | None = None
    setpoint_loss_max_s: float = within_range(0.1, 5, 1.0)
    station_loss_max_s: float = within_range(1, 60, 10.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        kind, _, rest = self.link.partition(":")
        place, _, number = rest.rpartition(":")
        # int() raises an error for more than 4300 digits.
        valid = number.isascii() and number.isdecimal() and len(number) <= _MAX_DIGITS
        form = kind in ("udp", "serial") and place != "" and valid
        require(form, f"mavlink.link: expected udp:HOST:PORT or serial:PATH:BAUD, found {self.link!r}")
        if kind == "udp":
            fits = _is_ipv4(place) and 1 <= int(number) <= 65535
            require(fits, f"mavlink.link: expected an IPv4 address and a port, found {rest!r}")
        else:
            require(place.startswith("/"), f"mavlink.link: expected an absolute device path, found {place!r}")
            speeds = ", ".join(map(str, BAUDS))
            require(int(number) in BAUDS, f"mavlink.link: expected a speed of {speeds}, found {number}")
        known = self.autopilot in AUTOPILOTS
        require(known, f"mavlink.autopilot: expected {' or '.join(AUTOPILOTS)}, found {self.autopilot!r}")
        key_ok = self.signing_key is None or self.signing_key.is_absolute()
        require(key_ok, f"mavlink.signing_key: expected an absolute path, found {self.signing_key}")

    @property
    def serial(self) -> tuple[str, int] | None:
        """Device path and line speed of a serial link; None for UDP."""
        kind, _, rest = self.link.partition(":")
        place, _, number = rest.rpartition(":")
        return (place, int(number)) if kind == "serial" else None

    @property
    def address(self) -> tuple[str, int]:
        """Host and port of a UDP link; of a serial link, its path and speed."""
        place, _, number = self.link.partition(":")[2].rpartition(":")
        return place, int(number)

    @property
    def station(self) -> int:
        """MAVLink system number of the bridge."""
        return self.own_system or self.system


def _is_ipv4(text: str) -> bool:
    """Whether `text` is four decimal numbers; a name would need a resolver, which may wait."""
    try:
        IPv4Address(text)
    except ValueError:
        return False
    return True
