"""The bridge's end of the link to an autopilot: a `Session` on a UDP socket or a serial line."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from firmware_bridge.core.config import MavlinkConfig, RobotConfig
from firmware_bridge.core.step_types import Report, Request
from firmware_bridge.mavlink.session import Session
from firmware_bridge.mavlink.signing import Signatures, read_key, wall_ticks
from firmware_bridge.mavlink.table import mavlink_of
from firmware_bridge.mavlink.transport import open_transport

_FAILING_WRITES: Final = 3  # in a row: 60 ms at 50 Hz, inside the 100 ms of fault matrix row 46
_CLOCK_WARNING_NS: Final = 10_000_000_000
_PX4_WARNING: Final = (
    "autopilot px4: PX4's rover modules ignore the yaw rate of a setpoint, so a real PX4 rover does not turn as"
    " commanded (read in PX4's source, not tried); the simulated one obeys it"
)


class RobotLink:
    """A rover as the bridge sees it. Raises LinkOpenError for a link, ConfigError for a key that cannot be used."""

    def __init__(self, config: RobotConfig, report: Callable[[str], None]) -> None:
        """`report` takes lines for the operator."""
        mavlink = mavlink_of(config)
        self._report = report
        self._signatures = None
        if mavlink.signing_key is not None:
            self._signatures = Signatures(read_key(mavlink.signing_key), wall_ticks(), time.monotonic_ns())
        self._transport = open_transport(mavlink)
        accepted = config.safety.accepted_error_codes
        self._session = Session(mavlink, report, self._signatures, stream=self._transport.stream, accepted=accepted)
        if mavlink.autopilot == "px4":
            report(_PX4_WARNING)
        self._failing = self._failed = 0
        self._refused, self._warned_ns = 0, -_CLOCK_WARNING_NS

    def read(self, now_ns: int) -> Report:
        """Return the report of all bytes since the last call; send what is due."""
        for data in self._transport.receive(now_ns):
            self._session.take(data, now_ns)
        report = self._session.report(now_ns)
        self._flush()
        self._warn_of_clocks(now_ns)
        if self._failing >= _FAILING_WRITES:
            return Report(**{**vars(report), "writes_fail": True})
        return report

    def write(self, request: Request) -> None:
        """Send one request without waiting. A packet that the system does not take is counted."""
        self._session.write(request, time.monotonic_ns())
        self._flush()

    def _flush(self) -> None:
        for packet in self._session.outgoing():
            taken = self._transport.send(packet)
            self._failing = 0 if taken else self._failing + 1
            self._failed += not taken

    def _warn_of_clocks(self, now_ns: int) -> None:
        """Tell the operator that signed packets are refused because the two clocks differ."""
        future = 0 if self._signatures is None else self._signatures.from_future
        if future > self._refused and now_ns - self._warned_ns >= _CLOCK_WARNING_NS:
            self._refused, self._warned_ns = future, now_ns
            self._report(
                f"{future} signed packets have times more than 60 s ahead of this machine's clock: expected equal"
                " clocks; set this machine's time and restart the bridge"
            )

    def dropped(self) -> tuple[int, int, int]:
        """Return counts so far: rejected packets, states late or out of order, packets that the system refused."""
        return self._session.reader.counts.malformed, self._session.odometry.dropped, self._failed

    def close(self) -> None:
        """Leave the rover in hold, disarmed if it stands; then close the link."""
        self._session.farewell(time.monotonic_ns())
        self._flush()
        self._transport.close()


def decode(data: bytes, config: MavlinkConfig, now_ns: int) -> Report:
    """Return the report of one datagram from an autopilot without history: a pure function for fuzzing."""
    session = Session(config, lambda _: None)
    session.take(data, now_ns)
    return session.report(now_ns)
