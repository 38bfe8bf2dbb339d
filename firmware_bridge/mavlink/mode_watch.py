"""Follows a rover's heartbeats: its mode, and mode changes that the bridge did not request. Pure.

A change that the bridge did not request comes from a person (the remote's switch, a ground station) or from a failsafe.
It always wins: the bridge sends no mode command until the next arming, or until a person presses its emergency stop
while nobody steers the rover, or holds the local input while the rover drives itself.
"""

from __future__ import annotations

from typing import Final

from firmware_bridge.mavlink import modes
from firmware_bridge.mavlink.commands import RETRY_NS
from firmware_bridge.mavlink.modes import Autopilot, mode_of, name_of_heartbeat

_ARMED_FLAG: Final = 128  # MAV_MODE_FLAG_SAFETY_ARMED
_CRITICAL: Final = 5  # MAV_STATE
_EMERGENCY: Final = 6
_TERMINATED: Final = 8
_ASKED_NS: Final = 3_000_000_000  # our choice: all retries of a command, and the heartbeat after it
LOST_NS: Final = 3_500_000_000  # fault matrix row 42: three heartbeats at 1 Hz are missing
_OLD_PACKETS: Final = 32
"""A heartbeat up to this many packets older than the newest is a late one; more is an autopilot that has restarted."""


class ModeWatch:
    """Mode of one rover by its newest heartbeat."""

    def __init__(self, autopilot: Autopilot) -> None:
        self.name: str | None = None
        self.mode: int | None = None
        self.kind = modes.OTHER
        self.armed = False
        self.yielded = False
        self.is_taken_over = False
        """Whether, since the last `take_switched`, a person changed the mode of a rover that the bridge drove, or chose
        an automatic mode, such as a mission, at any time."""
        self._autopilot = autopilot
        self._status = 0
        self._custom_mode = 0
        self._asked: dict[str, int] = {}  # kind -> when it was last requested
        self._drive_ns: int | None = None  # when the autopilot accepted the drive mode, until a heartbeat shows it
        self._arm_ns: int | None = None  # the same of arming
        self._heard_ns = 0
        self._sequence: int | None = None
        self._switched = False

    def ask(self, kind: str, now_ns: int) -> None:
        """Note that the bridge requests a mode of this kind."""
        self._asked[kind] = now_ns
        if kind != modes.DRIVE:
            self._drive_ns = None  # the bridge itself ends the mode that it was given

    def accepted(self, *, arms: bool, now_ns: int) -> None:
        """Note that the autopilot has accepted to arm, or the drive mode."""
        if arms:
            self._arm_ns = now_ns
        else:
            self._drive_ns = now_ns

    def has_asked(self, kind: str, now_ns: int) -> bool:
        """Return whether a requested mode of this kind may still come."""
        return now_ns - self._asked.get(kind, -_ASKED_NS) < _ASKED_NS

    def take_command(self) -> None:
        """Note that the bridge arms, or that its emergency stop was pressed: it may request modes again."""
        self.yielded = False

    def give_way(self) -> None:
        """Note that another station commands the rover: no mode command until the next arming."""
        self.yielded = True
        self._asked.clear()
        self._drive_ns = self._arm_ns = None

    def note_sequence(self, sequence: int) -> bool:
        """Take a packet's sequence number; return whether the packet is newer than every earlier one."""
        old = self._sequence is not None and (self._sequence - sequence) % 256 < _OLD_PACKETS
        if not old:
            self._sequence = sequence
        return not old

    def heartbeat(self, autopilot: int, custom_mode: int, base_mode: int, status: int, now_ns: int) -> None:
        """Take the newest heartbeat."""
        self._heard_ns, self._status = now_ns, status
        self.name = name_of_heartbeat(autopilot)
        kind, known = self._autopilot.kind_of(custom_mode), self.mode is not None
        if known and custom_mode != self._custom_mode:
            asked_ns = self._asked.pop(kind, None)
            if asked_ns is None or now_ns - asked_ns > _ASKED_NS:
                self._switched = True
                self.give_way()
                # With a failsafe of its own, the autopilot declares a critical state.
                self.is_taken_over |= self.mode == modes.ARMED_DRIVE and status < _CRITICAL
        self.kind, self._custom_mode = kind, custom_mode
        self.armed = bool(base_mode & _ARMED_FLAG)
        self._drive_ns = None if kind == modes.DRIVE else self._drive_ns
        self._arm_ns = None if self.armed else self._arm_ns
        if any(at_ns is not None and now_ns - at_ns >= RETRY_NS for at_ns in (self._drive_ns, self._arm_ns)):
            self._switched = True  # back at what it was, before a heartbeat came
            self.give_way()
        before, self.mode = self.mode, mode_of(kind, self.armed)
        # The bridge never requests this mode; without a latch the next arming would end the mission.
        begins = self.mode == modes.ARMED_OTHER and before != modes.ARMED_OTHER
        self.is_taken_over |= begins and status < _CRITICAL

    def take_switched(self) -> bool:
        """Return whether a mode change that the bridge did not request was seen since the last call."""
        switched, self._switched, self.is_taken_over = self._switched, False, False
        return switched

    def in_use(self) -> bool:
        """Return whether a person may be driving: the motors are armed in a mode of the remote."""
        return self.mode == modes.ARMED_PILOT

    def may_command(self) -> bool:
        """Return whether the bridge may request a mode now."""
        return not self.yielded and not self.in_use()

    def is_lost(self, now_ns: int) -> bool:
        """Return whether heartbeats have come and then stopped."""
        return self.mode is not None and now_ns - self._heard_ns > LOST_NS

    def is_emergency(self) -> bool:
        """Return whether the autopilot declares an emergency or has terminated."""
        return self._status in (_EMERGENCY, _TERMINATED)

    def is_critical(self) -> bool:
        """Return whether the autopilot drives by setpoints in spite of an active failsafe.

        In other modes it is the state in which the failsafe has left the rover; only a new mode ends it.
        """
        return self._status == _CRITICAL and self.kind == modes.DRIVE and self.armed
