"""Handlers of MAVLink commands (COMMAND_LONG and COMMAND_INT); each returns the MAV_RESULT of the acknowledgement."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import isfinite, isnan
from types import MappingProxyType
from typing import Final, Protocol

from pymavlink.dialects.v20 import common

from sim_hil.protocols.mavlink.telemetry import STREAMS, Schedule, Snapshot, autopilot_version
from sim_hil.protocols.mavlink.vehicle import ACCEPTED, DENIED, Station, Vehicle, find_mode
from sim_hil.protocols.mavlink.wire import Message

FORCE: Final = 21196  # param2 of an arm or disarm command that skips checks (mavlink.io, MAV_CMD 400)
UNSUPPORTED: Final = int(common.MAV_RESULT_UNSUPPORTED)


@dataclass(frozen=True)
class Command:
    """One received command; `params` are param1..param7, where COMMAND_INT has x and y.

    NaN marks an unused parameter (MAVSDK sends it); it is read as 0.
    """

    number: int
    params: tuple[float, ...]

    @staticmethod
    def of(message: Message) -> Command:
        """Read a COMMAND_LONG or COMMAND_INT."""
        params = [message.param1, message.param2, message.param3, message.param4]
        if message.get_msgId() == common.MAVLINK_MSG_ID_COMMAND_INT:
            params += [message.x, message.y, message.z]
        else:
            params += [message.param5, message.param6, message.param7]
        return Command(message.command, tuple(0.0 if isnan(value) else value for value in params))

    @property
    def is_emergency_stop(self) -> bool:
        """Whether the command is a forced disarm or a flight termination."""
        p1, p2 = self.params[:2]
        if self.number == common.MAV_CMD_DO_FLIGHTTERMINATION:
            return p1 >= 0.5
        return self.number == common.MAV_CMD_COMPONENT_ARM_DISARM and p1 == 0 and p2 == FORCE


class CommandTarget(Protocol):
    """Component on which commands act."""

    vehicle: Vehicle
    schedule: Schedule

    @property
    def system(self) -> int:
        """MAVLink system number."""
        ...

    def send_after_ack(self, message: Message) -> None:
        """Send a message that a command requests, after the acknowledgement."""
        ...

    def snapshot(self) -> Snapshot:
        """Return the data for reports, from the latest sensor reading."""
        ...


Handler = Callable[[CommandTarget, Station, Command, float], int]


def _arm_disarm(node: CommandTarget, station: Station, command: Command, now_s: float) -> int:
    arm, force = command.params[:2]
    if arm not in (0, 1) or force not in (0, FORCE):
        return int(DENIED)
    if arm:
        return node.vehicle.arm(station, now_s, forced=force == FORCE)
    if force:
        return node.vehicle.emergency_stop(f"forced disarm by station {station.system}")
    return node.vehicle.disarm(station, now_s)


def _terminate(node: CommandTarget, station: Station, command: Command, now_s: float) -> int:
    if command.is_emergency_stop:
        return node.vehicle.emergency_stop(f"termination by station {station.system}")
    return int(DENIED)


def _set_mode(node: CommandTarget, station: Station, command: Command, now_s: float) -> int:
    base, main, sub = command.params[:3]
    if not all(map(isfinite, (base, main, sub))) or not int(base) & common.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
        return node.vehicle.set_mode(station, None, now_s)
    return node.vehicle.set_mode(station, find_mode(int(main), int(sub)), now_s)


def _set_interval(node: CommandTarget, station: Station, command: Command, now_s: float) -> int:
    number, interval_us = command.params[:2]
    if not (isfinite(number) and isfinite(interval_us)) or not node.vehicle.may_change(station, now_s):
        return int(DENIED)
    return int(ACCEPTED if node.schedule.set_interval(int(number), interval_us, now_s) else DENIED)


def _get_interval(node: CommandTarget, station: Station, command: Command, now_s: float) -> int:
    number = command.params[0]
    interval_us = node.schedule.interval_us(int(number)) if isfinite(number) else None
    if interval_us is None:
        return int(DENIED)
    node.send_after_ack(common.MAVLink_message_interval_message(int(number), interval_us))
    return int(ACCEPTED)


def _request(node: CommandTarget, station: Station, command: Command, now_s: float) -> int:
    number = command.params[0]
    return _send(node, int(number)) if isfinite(number) else int(DENIED)


def _send(node: CommandTarget, number: int) -> int:
    if number == common.MAVLINK_MSG_ID_AUTOPILOT_VERSION:
        node.send_after_ack(autopilot_version(node.system))
    elif number in STREAMS:
        node.send_after_ack(STREAMS[number].make(node.snapshot()))
    else:
        return int(DENIED)
    return int(ACCEPTED)


HANDLERS: Final[Mapping[int, Handler]] = MappingProxyType(
    {
        common.MAV_CMD_COMPONENT_ARM_DISARM: _arm_disarm,
        common.MAV_CMD_DO_SET_MODE: _set_mode,
        common.MAV_CMD_DO_FLIGHTTERMINATION: _terminate,
        common.MAV_CMD_SET_MESSAGE_INTERVAL: _set_interval,
        common.MAV_CMD_GET_MESSAGE_INTERVAL: _get_interval,
        common.MAV_CMD_REQUEST_MESSAGE: _request,
        common.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: lambda node, *_: _send(
            node, common.MAVLINK_MSG_ID_AUTOPILOT_VERSION
        ),
        common.MAV_CMD_GET_HOME_POSITION: lambda node, *_: _send(node, common.MAVLINK_MSG_ID_HOME_POSITION),
    }
)
"""Handlers by command number; every other command is acknowledged as unsupported."""


def obey(node: CommandTarget, station: Station, command: Command, now_s: float) -> int:
    """Execute a command and return its MAV_RESULT."""
    handler = HANDLERS.get(command.number)
    return UNSUPPORTED if handler is None else int(handler(node, station, command, now_s))
