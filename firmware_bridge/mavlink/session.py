"""Conversation with one autopilot: received bytes in, a `Report` and packets to send out. Pure: no socket, no clock.

The bridge is a component of its own, an onboard computer (191). It sends a heartbeat twice a second, and setpoints only
while it arms, drives or keeps the rover stopped. A mode or arming command is sent only for the bridge's rules, and not
after somebody else has changed the mode (`mode_watch.py`), until the next arming or emergency stop at this computer.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as dialect

from firmware_bridge.core.config import MavlinkConfig
from firmware_bridge.core.step_types import Identify, Move, Report, Request, Stand
from firmware_bridge.mavlink import modes, stations
from firmware_bridge.mavlink.clock import VehicleClock
from firmware_bridge.mavlink.commands import ACCEPTED, IN_PROGRESS, CommandQueue
from firmware_bridge.mavlink.failsafes import FailsafeCheck
from firmware_bridge.mavlink.mode_watch import ModeWatch
from firmware_bridge.mavlink.odometry import ERROR_NAMES, OdometryInput
from firmware_bridge.mavlink.signing import Signatures
from firmware_bridge.mavlink.texts import TextFilter
from firmware_bridge.mavlink.wire import Message, Reader, Writer

COMPONENT: Final = 191  # MAV_COMP_ID_ONBOARD_COMPUTER
AUTOPILOT: Final = 1  # MAV_COMP_ID_AUTOPILOT1
SET_MODE: Final = 176
ARM_DISARM: Final = 400
SET_INTERVAL: Final = 511
_ODOMETRY, _ATTITUDE, _POSITION, _SYS_STATUS, _BATTERY, _ESTIMATOR, _EKF = 331, 30, 32, 1, 147, 230, 193
# Our choice: 25 reports a second fit a line of 115200 baud and every second step of a loop of 50 Hz (ArduPilot).
# At 30 Hz they would come 20 and 40 ms apart, which looks like a robot that reports at 50 Hz over a lossy link.
_RATES_HZ: Final = {
    "px4": {_ODOMETRY: 25.0, _ATTITUDE: 25.0, _POSITION: 5.0, _SYS_STATUS: 1.0, _BATTERY: 1.0, _ESTIMATOR: 2.0},
    "ardupilot": {_POSITION: 25.0, _ATTITUDE: 25.0, _SYS_STATUS: 1.0, _BATTERY: 1.0, _EKF: 2.0},
}
# Ignore position, acceleration and yaw; use the velocity and the yaw rate. Unused vz stays: ArduPilot requires it.
_TYPE_MASK: Final = 1 | 2 | 4 | 64 | 128 | 256 | 1024
_BODY_FRAME: Final = 8  # MAV_FRAME_BODY_NED, the only body frame that both autopilots take
_CUSTOM_MODE: Final = 1  # MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
_HEARTBEAT_NS: Final = 500_000_000
_STREAM_NS: Final = 50_000_000  # period of zeros that the bridge's rules do not send themselves: while arming
_STREAM_FOR_NS: Final = 3_000_000_000  # longer than the rules wait before they repeat a step
_PAUSE_NS: Final = 300_000_000  # setpoints further apart begin a new stream
_SILENT_NS: Final = 1_000_000_000
_AGAIN_NS: Final = 2_000_000_000
_CLASH_NS: Final = 2_000_000_000
_REASON_WAIT_NS: Final = 200_000_000  # an autopilot's text may follow its acknowledgement
_OWN_NS: Final = 3_000_000_000
_MAX_DENIALS: Final = 4
_HELD: Final = "in control"
_VEHICLE: Final = (0, _SYS_STATUS, 22, _ATTITUDE, _POSITION, 77, 111, _BATTERY, _EKF, _ESTIMATOR, 253, _ODOMETRY)
_OTHERS: Final = (*stations.MOTION_MESSAGES, stations.COMMAND_INT, stations.COMMAND_LONG)


class Session:
    """State of the conversation; `take` bytes, then `report` once a step, then `outgoing`."""

    def __init__(
        self,
        config: MavlinkConfig,
        tell: Callable[[str], None],
        signatures: Signatures | None = None,
        *,
        stream: bool = False,
        accepted: Collection[int] = (0,),
    ) -> None:
        """`tell` takes lines for the operator; `stream`: packets may be cut anywhere, as on a serial line.

        `accepted`: error codes of the robot file that hide no other one.
        """
        self.watch = ModeWatch(modes.BY_NAME[config.autopilot])
        self.odometry = OdometryInput(accepted)
        self.failsafes = FailsafeCheck(config)
        self.commands = CommandQueue()
        self.reader = Reader((*_VEHICLE, *_OTHERS), signatures, stream=stream)
        self._config = config
        self._autopilot = modes.BY_NAME[config.autopilot]
        self._tell = tell
        self._writer = Writer(config.station, COMPONENT, signatures)
        self._signatures = signatures
        self._clock = VehicleClock()
        self._texts = TextFilter()
        self._handlers: dict[int, Callable[[Message, int], None]] = {
            0: self._heartbeat,
            22: self._parameter,
            77: self._acknowledgement,
            111: self._timesync,
            253: self._text,
        }
        self._outbox: list[bytes] = []
        self._now_ns = 0
        self._foreign: str | None = None
        self._clash_ns = -_CLASH_NS
        self._identifying = self._stopped = False
        self._heartbeat_ns = 0
        self._intervals: list[int] = []
        self._intervals_ns = 0
        self._stream_until_ns = self._stream_since_ns = self._setpoint_ns = -_AGAIN_NS
        self._own_ns: dict[int, int] = {}  # command -> when the bridge has last sent it
        self._denials: list[tuple[int, str, str]] = []  # when, command, result
        self._told: set[str] = set()

    def take(self, data: bytes, now_ns: int) -> None:
        """Read received bytes; what cannot be true is counted."""
        self._now_ns = now_ns
        for message in self.reader.read(data, now_ns):
            self._handle(message, now_ns)

    def _handle(self, message: Message, now_ns: int) -> None:
        number, sender = message.get_msgId(), (message.get_srcSystem(), message.get_srcComponent())
        if sender == (self._config.station, COMPONENT):
            self._clash_ns = now_ns  # an autopilot does not echo: a second bridge, or a forger
        elif number in _OTHERS and sender != (self._config.system, AUTOPILOT):
            command = getattr(message, "command", 0)
            target = getattr(message, "target_system", getattr(message, "target", 0))  # MANUAL_CONTROL: `target`
            if target in (0, self._config.system):
                foreign = stations.foreign_message(number, command, sender)
                self._foreign = foreign or self._foreign
                if foreign is not None and number in stations.COMMAND_MESSAGES:
                    self._give_way()  # whether the autopilot obeys is not known: a person's mode must stay
        elif sender != (self._config.system, AUTOPILOT):
            # Heartbeats of ground stations that watch are welcome; every other value must be the autopilot's.
            self.reader.counts.strange += number != 0
        else:
            newer = self.watch.note_sequence(message.get_seq())
            if number in self._handlers:
                if newer or number != 0:
                    self._handlers[number](message, now_ns)
            elif not self.odometry.take(message, now_ns, self._clock):
                self.reader.counts.strange += 1

    def _heartbeat(self, message: Message, now_ns: int) -> None:
        first = self.watch.mode is None
        values = (message.autopilot, message.custom_mode, message.base_mode, message.system_status)
        self.watch.heartbeat(*values, now_ns)
        if first:
            self._request_intervals()
        self.commands.observe(SET_MODE, self.watch.kind == modes.DRIVE, now_ns)
        self.commands.observe(ARM_DISARM, self.watch.armed, now_ns)
        if self.watch.yielded:
            self.commands.cancel(SET_MODE, ARM_DISARM)
        elif self._stopped and self.watch.kind == modes.DRIVE:
            self._hold()  # a drive mode requested before the stop came after it

    def _give_way(self) -> None:
        """Request no mode until the next arming: another station has commanded the rover."""
        self.watch.give_way()
        self.commands.cancel(SET_MODE, ARM_DISARM)

    def _parameter(self, message: Message, now_ns: int) -> None:
        name = message.param_id.split("\0")[0]
        self.failsafes.value(name, message.param_value, message.param_type)

    def _acknowledgement(self, message: Message, now_ns: int) -> None:
        command, target = message.command, (message.target_system, message.target_component)
        own = (self._config.station, COMPONENT)
        requested = now_ns - self._own_ns.get(command, -_OWN_NS) < _OWN_NS
        foreign = stations.foreign_acknowledgement(command, target, own, requested)
        if foreign is not None:
            self._foreign = foreign
            if message.result in (ACCEPTED, IN_PROGRESS):
                self._give_way()  # the heartbeat with another station's mode may come later than this
        if target not in (own, (0, 0)) or foreign is not None:
            return
        waited = self.commands.waits(command)
        if message.result == ACCEPTED and self.commands.is_careful(command):
            self.watch.accepted(arms=command == ARM_DISARM, now_ns=now_ns)
        failed = self.commands.acknowledge(command, message.result)
        if command == SET_INTERVAL:
            if not waited or self.commands.waits(SET_INTERVAL) or not self._intervals:
                return
            self._intervals.pop(0)  # one that the autopilot does not know is left out
        elif failed is not None:
            name = stations.MOTION_COMMANDS.get(command, f"command {command}")
            self._denials.append((now_ns, name, failed))

    def _timesync(self, message: Message, now_ns: int) -> None:
        if message.tc1 == 0:  # the autopilot asks for our time
            self._send(dialect.MAVLink_timesync_message(now_ns, message.ts1))
        else:
            self._clock.answer(message.tc1, message.ts1, now_ns)

    def _text(self, message: Message, now_ns: int) -> None:
        line = self._texts.take(message.severity, message.text, now_ns)
        if line is not None:
            self._tell(line)

    def report(self, now_ns: int) -> Report:
        """Return the report of everything taken since the last call, and queue the packets that are due."""
        self._now_ns = now_ns
        self.reader.begin_step()
        self._periodic(now_ns)
        denied = self._explain(now_ns)
        foreign, self._foreign = self._foreign, None
        lost = self.watch.is_lost(now_ns)
        state = self.odometry.state(self.watch, lost=lost)
        taken_over, switched = self.watch.is_taken_over, self.watch.take_switched()
        if switched:
            self._tell(f"the rover's mode was changed without the bridge: {self._mode_name()}")
        if state is not None and state.error_code in ERROR_NAMES:
            self._tell_once(f"error {state.error_code} of the rover: {ERROR_NAMES[state.error_code]}")
        clash = now_ns - self._clash_ns < _CLASH_NS
        return Report(
            state=state,
            remote_in_use=switched or self.watch.in_use(),
            remote_estop=self.watch.is_emergency(),
            taken_over=taken_over,
            drives_itself=self.watch.mode == modes.ARMED_OTHER,
            foreign=foreign,
            denied=denied,
            publishers=f"another sender uses our number {self._config.station}/{COMPONENT}" if clash else None,
            battery=self.odometry.take_battery(),
            version=self._version(),
            unsafe=self.failsafes.unsafe,
        )

    def _version(self) -> str | None:
        """Return the answer to an Identify: the autopilot's name, after its parameters were read."""
        if not self._identifying or self.watch.name is None:
            return None
        if self.watch.name == self._autopilot.name and not self.failsafes.is_complete:
            return None  # another autopilot does not have these parameters
        self._identifying = False
        return self.watch.name

    def _periodic(self, now_ns: int) -> None:
        if now_ns - self._heartbeat_ns >= _HEARTBEAT_NS:
            self._heartbeat_ns = now_ns
            self._send(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))  # onboard controller, no autopilot, active
        if self.watch.mode is None:
            return
        if self._clock.due(now_ns):
            self._send(dialect.MAVLink_timesync_message(0, now_ns))
        for name in self.failsafes.due(now_ns):
            self._send(
                dialect.MAVLink_param_request_read_message(self._config.system, AUTOPILOT, name.encode("ascii"), -1)
            )
        self._keep_intervals(now_ns)
        if now_ns < self._stream_until_ns and now_ns - self._setpoint_ns >= _STREAM_NS:
            self._setpoint(0.0, 0.0, 0.0)
        for number, tries, params in self.commands.due(now_ns):
            self._send_command(number, tries, params)

    def _keep_intervals(self, now_ns: int) -> None:
        """Request the messages' rates one after the other, and again while the rover reports no odometry."""
        silent = self.odometry.is_silent(now_ns, _SILENT_NS)
        if silent and not self._intervals and now_ns - self._intervals_ns >= _AGAIN_NS:
            self._request_intervals()
        if self._intervals and not self.commands.waits(SET_INTERVAL):
            number = self._intervals[0]
            rate_hz = _RATES_HZ[self._autopilot.name][number]
            if now_ns - self._intervals_ns >= _AGAIN_NS:  # no answer to all tries: leave it out
                self._intervals.append(self._intervals.pop(0))
            self._intervals_ns = now_ns
            self.commands.request(SET_INTERVAL, number, 1e6 / rate_hz)

    def _request_intervals(self) -> None:
        self._intervals = list(_RATES_HZ[self._autopilot.name])
        self._intervals_ns = self._now_ns

    def _explain(self, now_ns: int) -> str | None:
        """Tell the operator why a command was denied, in the autopilot's own words if they come in time.

        Return the name of a command that was denied because another station is in control: only the text says so.
        """
        held: str | None = None
        waiting: list[tuple[int, str, str]] = []
        for denied_ns, name, result in self._denials:
            reason = self._texts.reason(denied_ns)
            if reason is None and now_ns - denied_ns < _REASON_WAIT_NS:
                waiting.append((denied_ns, name, result))
                continue
            why = "without a reason" if reason is None else f"reason: {reason}"
            self._tell(f"the rover answered {name}: {result}, {why}")
            held = name if reason is not None and _HELD in reason.lower() else held
        self._denials = waiting[-_MAX_DENIALS:]
        return held

    def _tell_once(self, line: str) -> None:
        if line not in self._told:
            self._told.add(line)
            self._tell(line)

    def _mode_name(self) -> str:
        mode = self.watch.mode
        return "unknown" if mode is None else modes.MODE_NAMES[mode]

    def write(self, request: Request, now_ns: int) -> None:
        """Queue the packets of one request."""
        self._now_ns = now_ns
        if isinstance(request, Move):
            self._setpoint(request.vx_mps, request.vy_mps, request.wz_radps)
        elif isinstance(request, Identify):
            if self._identifying and self.failsafes.missing:
                self._tell_once(f"the autopilot does not answer for its parameters {self.failsafes.missing}")
            self._identifying = True
            self._begin_arming()
            self._stream_until_ns = now_ns + _STREAM_FOR_NS
            self.failsafes.begin()
        elif isinstance(request, Stand):
            self._stream_until_ns = now_ns + _STREAM_FOR_NS
            self._stand(request.step, now_ns)
        else:
            if request.pressed and not self.watch.in_use():
                self.watch.take_command()  # it ends a mission, too
            self._stop(now_ns)

    def _begin_arming(self) -> None:
        """Note an arming; a rover that is ready gets no step, only the request before the steps."""
        self._stopped = False
        if not self.watch.in_use():
            self.watch.take_command()

    def _stand(self, step: int, now_ns: int) -> None:
        self._begin_arming()
        if not self.watch.may_command():
            return
        if step == modes.STEP_ARM:
            self.commands.request(ARM_DISARM, 1.0, careful=True)
        elif step == modes.STEP_DRIVE:
            at_ns = self._stream_since_ns + int(self._autopilot.stream_first_s * 1e9)
            streaming = now_ns - self._setpoint_ns < _PAUSE_NS
            wait_ns = at_ns if streaming else now_ns + int(self._autopilot.stream_first_s * 1e9)
            drive = (_CUSTOM_MODE, *map(float, self._autopilot.drive))
            self.commands.request(SET_MODE, *drive, at_ns=wait_ns, careful=True)
        elif step == modes.STEP_HOLD:
            self._hold()

    def _stop(self, now_ns: int) -> None:
        """Zero velocity and hold mode, unless somebody else has changed the mode.

        A requested drive mode that has not come yet is given up, or undone by hold.
        """
        self._setpoint(0.0, 0.0, 0.0)
        self._stopped = True
        self._stream_until_ns = now_ns  # from here on, only the rules' own zeros
        self.commands.cancel(ARM_DISARM)
        requested = self.commands.waits(SET_MODE) or self.watch.has_asked(modes.DRIVE, now_ns)
        if not self.watch.may_command():
            self.commands.cancel(SET_MODE)
        elif requested or self.watch.kind != modes.HOLD:
            self._hold()

    def _hold(self) -> None:
        self.commands.request(SET_MODE, _CUSTOM_MODE, *map(float, self._autopilot.hold))
        for number, tries, params in self.commands.due(self._now_ns):
            self._send_command(number, tries, params)

    def farewell(self, now_ns: int) -> None:
        """Queue the last packets of a rover of ours, or just arming: zero, hold, and disarm if it stands."""
        self._now_ns = now_ns
        ours, standing = self.watch.mode in (modes.ARMED_DRIVE, modes.ARMED_HOLD), self.odometry.stands(now_ns)
        # No heartbeat may show an arming yet; one that moves before then is driven by somebody else.
        arms = standing and now_ns - self._own_ns.get(ARM_DISARM, -_OWN_NS) < _OWN_NS
        if self.watch.yielded or not (arms or (ours and self._own_ns)):
            return
        self._setpoint(0.0, 0.0, 0.0)
        hold = (_CUSTOM_MODE, *map(float, self._autopilot.hold))
        for tries in range(2):  # nobody will repeat them
            self._send_command(SET_MODE, tries, hold)
            if standing:
                self._send_command(ARM_DISARM, tries, (0.0,))

    def _setpoint(self, vx_mps: float, vy_mps: float, wz_radps: float) -> None:
        now_ns = self._now_ns
        if now_ns - self._setpoint_ns > _PAUSE_NS:
            self._stream_since_ns = now_ns
        self._setpoint_ns = now_ns
        boot_ms = now_ns // 1_000_000 & 0xFFFFFFFF
        target = (self._config.system, AUTOPILOT, _BODY_FRAME, _TYPE_MASK)
        velocity = (vx_mps, -vy_mps, 0.0)
        self._send(
            dialect.MAVLink_set_position_target_local_ned_message(
                boot_ms, *target, 0.0, 0.0, 0.0, *velocity, 0.0, 0.0, 0.0, 0.0, -wz_radps
            )
        )

    def _send_command(self, number: int, tries: int, params: tuple[float, ...]) -> None:
        if number == SET_MODE:
            kind = modes.DRIVE if params[1:] == self._autopilot.drive else modes.HOLD
            self.watch.ask(kind, self._now_ns)
        if number in stations.MOTION_COMMANDS:
            self._own_ns[number] = self._now_ns
        values = (*params, *[0.0] * (7 - len(params)))
        target = (self._config.system, AUTOPILOT)
        self._send(dialect.MAVLink_command_long_message(*target, number, tries, *values))

    def _send(self, message: Message) -> None:
        self._outbox.append(self._writer.pack(message, self._now_ns))

    def outgoing(self) -> list[bytes]:
        """Return the packets to send now."""
        packets, self._outbox = self._outbox, []
        return packets
