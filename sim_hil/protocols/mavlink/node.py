"""MAVLink component of the rover: handles messages and commands, produces answers and reports. Pure: no network.

All messages go to all listeners, as on a shared radio; an acknowledgement contains its addressee.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import isfinite, isnan
from types import MappingProxyType
from typing import Final

from pymavlink.dialects.v20 import common

from sim_hil.protocols.base import Base
from sim_hil.protocols.mavlink import parameters, telemetry
from sim_hil.protocols.mavlink.autopilots import PX4, Autopilot
from sim_hil.protocols.mavlink.parameters import Parameters
from sim_hil.protocols.mavlink.setpoints import SetpointError, Sticks, manual_sticks, override_sticks, read_setpoint
from sim_hil.protocols.mavlink.vehicle import (
    ACCEPTED,
    DENIED,
    Health,
    Station,
    Vehicle,
)
from sim_hil.protocols.mavlink.wire import Counts, Message
from sim_hil.robots.carter.sensors import Sensors

FORCE: Final = 21196  # param2 of an arm or disarm command that skips checks (mavlink.io, MAV_CMD 400)
UNSUPPORTED: Final = int(common.MAV_RESULT_UNSUPPORTED)
COMPONENT: Final = common.MAV_COMP_ID_AUTOPILOT1
READ_S: Final = 1 / telemetry.MAX_HZ
_TEXT_BYTES: Final = 50
_FTP_NAK: Final = 129
_FTP_FILE_NOT_FOUND: Final = 10
_MAX_WAITING_PARAMETERS: Final = 2 * len(parameters.NAMES)
_PARAMETERS_A_STEP: Final = 2  # parameters sent per step, so that a list does not become a burst


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


class MavlinkNode:
    """Component of one rover: call `receive` for every message, then `step` and `due` after every physics step."""

    def __init__(
        self,
        base: Base,
        read: Callable[[], Sensors],
        counts: Counts,
        parameter_values: Parameters | None = None,
        autopilot: Autopilot = PX4,
    ) -> None:
        """Create the component; `read` returns the current sensor reading, `counts` are the packet reader's."""
        self.autopilot = autopilot
        self.parameters = parameter_values or Parameters(autopilot.name)
        self.vehicle = Vehicle(base, self.parameters, stays=autopilot.stays)
        silent = () if autopilot.has_odometry else (common.MAVLINK_MSG_ID_ODOMETRY,)
        self.schedule = telemetry.Schedule(silent)
        self.counts = counts
        self._read = read
        self._tilt = telemetry.TiltFilter()
        self._sensors: Sensors | None = None
        self._now_s = self._stamp_s = 0.0
        self._next_read_s = 0.0
        self._outbox: list[Message] = []
        self._after_ack: list[Message] = []
        self._waiting: list[str] = []
        self._reported_state: tuple[object, ...] | None = None
        self._reported_errors: set[str] = set()

    @property
    def system(self) -> int:
        """MAVLink system number."""
        return int(self.parameters["MAV_SYS_ID"])

    def send_after_ack(self, message: Message) -> None:
        """Send a message that a command requests, after the acknowledgement."""
        self._after_ack.append(message)

    def snapshot(self) -> telemetry.Snapshot:
        """Return the data for reports, from the latest sensor reading."""
        if self._sensors is None:
            self._read_sensors(self._now_s)
        assert self._sensors is not None
        return telemetry.Snapshot(
            self._stamp_s,
            self._sensors,
            self._tilt.roll_rad,
            self._tilt.pitch_rad,
            self.vehicle,
            self.counts.malformed,
            self.parameters["BAT_LOW_THR"],
            self.autopilot,
        )

    def receive(self, message: Message, station: Station, now_s: float) -> bool:
        """Execute and answer one message; return whether it was a request related to motion."""
        handler = HANDLERS.get(message.get_msgId())
        if handler is None:
            return False
        target = getattr(message, "target_system", getattr(message, "target", 0))
        if target not in (0, self.system) or getattr(message, "target_component", 0) not in (0, COMPONENT):
            self.counts.not_for_us += 1
            return False
        self._now_s = now_s
        try:
            return handler(self, message, station, now_s)
        except SetpointError as error:
            self.counts.unusable += 1
            if str(error) not in self._reported_errors and len(self._reported_errors) < 20:
                self._reported_errors.add(str(error))  # only once, because setpoints arrive at 20 Hz
                self.vehicle.send_text(common.MAV_SEVERITY_WARNING, str(error))
            return False

    def step(self, now_s: float) -> None:
        """Advance to `now_s`: read sensors and update the vehicle."""
        self._now_s = now_s
        if now_s >= self._next_read_s:
            self._next_read_s = max(self._next_read_s + READ_S, now_s)
            self._read_sensors(now_s)
            self.vehicle.forget_silent(now_s)
        self.vehicle.step(now_s)

    def _read_sensors(self, now_s: float) -> None:
        sensors = self._sensors = self._read()
        self._stamp_s = now_s
        self._tilt.step(now_s, sensors.gyro_radps, sensors.accel_mps2)
        tilt = max(abs(self._tilt.roll_rad), abs(self._tilt.pitch_rad))
        self.vehicle.health = Health(sensors.charge_percent / 100, tilt, -sensors.T_odom_base.theta_rad)

    def due(self, now_s: float) -> list[Message]:
        """Return the answers, texts and reports to send now; a change of state triggers a heartbeat at once."""
        made = self.answers()
        numbers = self.schedule.due(now_s)
        state = (self.vehicle.armed, self.vehicle.mode, self.vehicle.estop)
        if state != self._reported_state:
            self._reported_state = state
            numbers.append(common.MAVLINK_MSG_ID_HEARTBEAT)
        made += [telemetry.STREAMS[number].make(self.snapshot()) for number in dict.fromkeys(numbers)]
        for name in self._waiting[:_PARAMETERS_A_STEP]:
            made.append(self.parameters.message(name))
        del self._waiting[:_PARAMETERS_A_STEP]
        return made

    def answers(self) -> list[Message]:
        """Return the messages to send at once: acknowledgements and texts."""
        made, self._outbox = self._outbox, []
        for severity, text in self.vehicle.take_texts():
            made.append(common.MAVLink_statustext_message(severity, text.encode("ascii", "replace")[:_TEXT_BYTES]))
        return made

    def answer(self, message: Message) -> None:
        """Send a message as soon as possible."""
        self._outbox.append(message)

    # Handlers

    def _heartbeat(self, message: Message, station: Station, now_s: float) -> bool:
        self.vehicle.heartbeat(station, now_s)  # of any type, because not only ground stations drive
        return False

    def _command(self, message: Message, station: Station, now_s: float) -> bool:
        command = Command.of(message)
        handler = COMMANDS.get(command.number)
        result = UNSUPPORTED if handler is None else handler(self, station, command, now_s)
        self.answer(
            common.MAVLink_command_ack_message(
                command.number, result, 255, 0, message.get_srcSystem(), message.get_srcComponent()
            )
        )
        self._outbox += self._after_ack
        self._after_ack = []
        return command.number in _MOVING

    def _set_mode(self, message: Message, station: Station, now_s: float) -> bool:
        mode = None
        if message.base_mode & common.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
            mode = self.autopilot.mode_of(message.custom_mode)
        self.vehicle.set_mode(station, mode, now_s)
        return True

    def _setpoint(self, message: Message, station: Station, now_s: float) -> bool:
        return self.vehicle.setpoint(station, read_setpoint(message), now_s)

    def _manual(self, message: Message, station: Station, now_s: float) -> bool:
        return self.vehicle.sticks(station, manual_sticks(message), now_s)

    def _override(self, message: Message, station: Station, now_s: float) -> bool:
        sticks: Sticks | None = override_sticks(message)
        return self.vehicle.sticks(station, sticks, now_s)

    def _parameter_list(self, message: Message, station: Station, now_s: float) -> bool:
        self._wait(self.parameters.names)
        return False

    def _parameter_read(self, message: Message, station: Station, now_s: float) -> bool:
        index = message.param_index
        if index == -1 and message.param_id in self.parameters.table:
            self._wait((message.param_id,))
        elif 0 <= index < len(self.parameters.names):
            self._wait((self.parameters.names[index],))
        return False

    def _parameter_set(self, message: Message, station: Station, now_s: float) -> bool:
        name: str | None = message.param_id
        if self.vehicle.may_change(station, now_s):
            name = self.parameters.set(message)
        if name in self.parameters.table:
            self._wait((str(name),))
        return False

    def _wait(self, names: tuple[str, ...]) -> None:
        """Queue parameters for the next steps; the queue is bounded against endless requests."""
        self._waiting = (self._waiting + list(names))[:_MAX_WAITING_PARAMETERS]

    def _mission_list(self, message: Message, station: Station, now_s: float) -> bool:
        self.answer(
            common.MAVLink_mission_count_message(
                message.get_srcSystem(), message.get_srcComponent(), 0, message.mission_type
            )
        )
        return False

    def _mission_clear(self, message: Message, station: Station, now_s: float) -> bool:
        return self._mission_answer(message, common.MAV_MISSION_ACCEPTED)  # there is none

    def _mission_upload(self, message: Message, station: Station, now_s: float) -> bool:
        return self._mission_answer(message, common.MAV_MISSION_UNSUPPORTED)

    def _mission_answer(self, message: Message, result: int) -> bool:
        self.answer(
            common.MAVLink_mission_ack_message(
                message.get_srcSystem(), message.get_srcComponent(), result, message.mission_type
            )
        )
        return False

    def _file_transfer(self, message: Message, station: Station, now_s: float) -> bool:
        """Refuse at once, because there are no files; otherwise the client would wait for its timeout."""
        number, session, opcode = message.payload[0] | message.payload[1] << 8, message.payload[2], message.payload[3]
        head = ((number + 1) & 0xFFFF).to_bytes(2, "little") + bytes((session, _FTP_NAK, 1, opcode, 0, 0))
        payload = (head + bytes(4) + bytes((_FTP_FILE_NOT_FOUND,))).ljust(251, b"\0")
        self.answer(
            common.MAVLink_file_transfer_protocol_message(
                0, message.get_srcSystem(), message.get_srcComponent(), list(payload)
            )
        )
        return False

    def _timesync(self, message: Message, station: Station, now_s: float) -> bool:
        if message.tc1 == 0:  # a request; otherwise an answer
            self.answer(common.MAVLink_timesync_message(round(now_s * 1e9), message.ts1))
        return False

    def _ping(self, message: Message, station: Station, now_s: float) -> bool:
        if message.target_system == 0:
            self.answer(
                common.MAVLink_ping_message(
                    message.time_usec, message.seq, message.get_srcSystem(), message.get_srcComponent()
                )
            )
        return False


def _arm_disarm(node: MavlinkNode, station: Station, command: Command, now_s: float) -> int:
    arm, force = command.params[:2]
    if arm not in (0, 1) or force not in (0, FORCE):
        return int(DENIED)
    if arm:
        return node.vehicle.arm(station, now_s, forced=force == FORCE)
    if force:
        return node.vehicle.emergency_stop(f"forced disarm by station {station.system}")
    return node.vehicle.disarm(station, now_s)


def _terminate(node: MavlinkNode, station: Station, command: Command, now_s: float) -> int:
    if command.params[0] >= 0.5:
        return node.vehicle.emergency_stop(f"termination by station {station.system}")
    return int(DENIED)


def _set_mode(node: MavlinkNode, station: Station, command: Command, now_s: float) -> int:
    base, main, sub = command.params[:3]
    if not all(map(isfinite, (base, main, sub))) or not int(base) & common.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
        return node.vehicle.set_mode(station, None, now_s)
    return node.vehicle.set_mode(station, node.autopilot.find(int(main), int(sub)), now_s)


def _set_interval(node: MavlinkNode, station: Station, command: Command, now_s: float) -> int:
    number, interval_us = command.params[:2]
    if not (isfinite(number) and isfinite(interval_us)) or not node.vehicle.may_change(station, now_s):
        return int(DENIED)
    return int(ACCEPTED if node.schedule.set_interval(int(number), interval_us, now_s) else DENIED)


def _get_interval(node: MavlinkNode, station: Station, command: Command, now_s: float) -> int:
    number = command.params[0]
    interval_us = node.schedule.interval_us(int(number)) if isfinite(number) else None
    if interval_us is None:
        return int(DENIED)
    node.send_after_ack(common.MAVLink_message_interval_message(int(number), interval_us))
    return int(ACCEPTED)


def _request(node: MavlinkNode, station: Station, command: Command, now_s: float) -> int:
    number = command.params[0]
    return _send(node, int(number)) if isfinite(number) else int(DENIED)


def _send(node: MavlinkNode, number: int) -> int:
    if number == common.MAVLINK_MSG_ID_AUTOPILOT_VERSION:
        node.send_after_ack(telemetry.autopilot_version(node.system))
    elif number in telemetry.STREAMS:
        node.send_after_ack(telemetry.STREAMS[number].make(node.snapshot()))
    else:
        return int(DENIED)
    return int(ACCEPTED)


CommandHandler = Callable[[MavlinkNode, Station, Command, float], int]
COMMANDS: Final[Mapping[int, CommandHandler]] = MappingProxyType(
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
"""Handlers of COMMAND_LONG and COMMAND_INT; every other command is acknowledged as unsupported."""
_MOVING: Final = (
    common.MAV_CMD_COMPONENT_ARM_DISARM,
    common.MAV_CMD_DO_SET_MODE,
    common.MAV_CMD_DO_FLIGHTTERMINATION,
)
Handler = Callable[[MavlinkNode, Message, Station, float], bool]
HANDLERS: Final[Mapping[int, Handler]] = MappingProxyType(
    {
        common.MAVLINK_MSG_ID_HEARTBEAT: MavlinkNode._heartbeat,
        common.MAVLINK_MSG_ID_COMMAND_LONG: MavlinkNode._command,
        common.MAVLINK_MSG_ID_COMMAND_INT: MavlinkNode._command,
        common.MAVLINK_MSG_ID_SET_MODE: MavlinkNode._set_mode,
        common.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED: MavlinkNode._setpoint,
        common.MAVLINK_MSG_ID_MANUAL_CONTROL: MavlinkNode._manual,
        common.MAVLINK_MSG_ID_RC_CHANNELS_OVERRIDE: MavlinkNode._override,
        common.MAVLINK_MSG_ID_PARAM_REQUEST_LIST: MavlinkNode._parameter_list,
        common.MAVLINK_MSG_ID_PARAM_REQUEST_READ: MavlinkNode._parameter_read,
        common.MAVLINK_MSG_ID_PARAM_SET: MavlinkNode._parameter_set,
        common.MAVLINK_MSG_ID_MISSION_REQUEST_LIST: MavlinkNode._mission_list,
        common.MAVLINK_MSG_ID_MISSION_CLEAR_ALL: MavlinkNode._mission_clear,
        common.MAVLINK_MSG_ID_MISSION_COUNT: MavlinkNode._mission_upload,
        common.MAVLINK_MSG_ID_FILE_TRANSFER_PROTOCOL: MavlinkNode._file_transfer,
        common.MAVLINK_MSG_ID_TIMESYNC: MavlinkNode._timesync,
        common.MAVLINK_MSG_ID_PING: MavlinkNode._ping,
    }
)
