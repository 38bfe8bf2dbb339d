"""Received frames to reports: checks every frame, supervises cycle times, builds state and battery. Pure.

The decoder has no clock and no bus, so that any sequence of frames can be tried on it. A frame is used only when its
length, CRC and counter are right; a value outside its signal's range in the DBC file is not used either.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Final

from firmware_bridge.can.codec import Signal
from firmware_bridge.can.database import CanDatabase, Message
from firmware_bridge.can.frame import BusHealth, Frame
from firmware_bridge.can.motion import ERROR_FAULTS, AgreementCheck, WheelOdometry
from firmware_bridge.can.protection import Checker, Verdict
from firmware_bridge.can.table import MODE_WITHOUT_STATE
from firmware_bridge.can.traffic import TrafficWatch
from firmware_bridge.core.config_can import CanConfig
from firmware_bridge.core.robot_state import BatteryState, RobotState, StampOrder, reported_code
from firmware_bridge.core.step_types import Report

_LEAST_MISSING_NS: Final = 200_000_000
"""Time below which no message counts as missing: shorter than the deadman, longer than a busy computer's pauses."""
_COMMANDED_NS: Final = 200_000_000  # a command older than this is not compared with the wheels
_CYCLE_TOLERANCE: Final = 50  # our choice: a cycle differs from that of the DBC file by at most 1/50
_CLOCK_STEP_NS: Final = 100_000_000  # our choice: the base's clock and the counted cycles may differ by this
_STATE_PLACES: Final = ("can.odometry.", "can.wheels.", "can.state.")


class _Stream:
    """Frames of one message: their checker, the newest good frame, and the run of bad ones."""

    def __init__(self, message: Message, missing_cycles: int, now_ns: int) -> None:
        self.message = message
        self.checker = Checker(message.length, message.protection)
        self.data: bytes | None = None
        self.fresh = False
        self.bad_in_a_row = 0
        self.verdict = Verdict.FIRST
        self.good_ns = now_ns
        self.counted_ns = now_ns
        """Time at which the checker last took a counter, ns: of a good frame, or of the first one after a pause."""
        self._missing_ns = max(missing_cycles * message.cycle_ns, _LEAST_MISSING_NS) if message.cycle_ns else 0

    def is_missing(self, now_ns: int) -> bool:
        return self._missing_ns > 0 and now_ns - self.good_ns > self._missing_ns

    def forget_old_counter(self, now_ns: int) -> None:
        """Forget a counter that is too old to compare with; a frame that came since then keeps its own."""
        if now_ns - self.counted_ns > self._missing_ns:
            self.checker.forget()

    def counter(self) -> int | None:
        protection = self.message.protection
        return None if protection is None or self.data is None else protection.counter(self.data)


@dataclass
class Counts:
    """Number of rejected frames by kind, and of values outside their range."""

    wrong: int = 0
    wrong_counter: int = 0
    out_of_range: int = 0


class _BaseClock:
    """The base's time of each odometry sample, from its counter and, where there is one, its clock signal.

    `is_known` is False until a base with a clock signal has sent it: a stamp counted before would be of another clock.
    Without that signal the count follows the arrivals slowly: the base's cycle is only about that of the DBC file.
    """

    def __init__(self, cycle_ns: int, period: int, *, is_known: bool) -> None:
        self._cycle_ns, self._period = cycle_ns, period
        self.is_known, self._is_counted = is_known, is_known
        self._offset_ns = 0  # of our clock to the base's, at the first sample
        self._counter: int | None = None
        self._received_ns = 0
        self.stamp_ns = cycle_ns

    def advance(self, counter: int | None, now_ns: int) -> int:
        """Move to the next sample and return the time since the last one, 0 for the first."""
        passed_ns = now_ns - self._received_ns if self._received_ns else 0
        first, last = self._received_ns == 0, self._counter
        self._counter, self._received_ns = counter, now_ns
        clear = passed_ns < (self._period - 1) * self._cycle_ns  # later, the counter is ambiguous
        if clear and not first and counter is not None and last is not None:
            passed_ns = (counter - last) % self._period * self._cycle_ns
        self.stamp_ns += passed_ns
        if first:
            self._offset_ns = now_ns - self.stamp_ns
        elif self._is_counted:
            most_ns = passed_ns // _CYCLE_TOLERANCE
            self.stamp_ns += min(max(now_ns - self._offset_ns - self.stamp_ns, -most_ns), most_ns)
        return passed_ns

    def set(self, uptime_ns: int) -> None:
        """Take the base's own clock where the counted one has left it."""
        self.is_known = True
        if abs(uptime_ns - self.stamp_ns) > max(_CLOCK_STEP_NS, 5 * self._cycle_ns // 2):
            self.stamp_ns = uptime_ns


class BaseReader:
    """Decoder of one base: `put` frames in, `take` one report a step."""

    def __init__(self, config: CanConfig, database: CanDatabase, now_ns: int, accepted: Collection[int]) -> None:
        """`accepted`: error codes of the robot file that hide no other one."""
        self._config, self._database, self._accepted = config, database, accepted
        self.health, self.counts = BusHealth(), Counts()
        self.traffic = TrafficWatch(config.bitrate_bps, now_ns)
        received = database.received.items()
        self._streams = {number: _Stream(message, config.missing_cycles, now_ns) for number, message in received}
        self._by_name = {stream.message.name: stream for stream in self._streams.values()}
        signals = database.signals
        prefix = "can.wheels." if config.odometry is None else "can.odometry."
        samples = [signals[where].message for where in signals if where.startswith(prefix)]
        self._sample = [self._by_name[name] for name in dict.fromkeys(samples)]
        vital = {signal.message for where, signal in signals.items() if where.startswith(_STATE_PLACES)}
        self._vital = [self._by_name[name] for name in vital]
        first = self._sample[0].message
        period = 1 if first.protection is None else first.protection.counter_period
        self._clock = _BaseClock(first.cycle_ns, period, is_known="can.uptime" not in signals)
        self._order = StampOrder()
        self._wheels = None if config.wheels is None else WheelOdometry(config.wheels.track_m)
        self._agreement = AgreementCheck(config.agreement)
        self._command = (0.0, 0.0)
        self._command_ns = -_COMMANDED_NS - 1
        self._imu = [where for where in signals if where.startswith("can.imu.")]
        self._without_value: str | None = None
        self._state: RobotState | None = None
        self._battery: BatteryState | None = None
        self._foreign: str | None = None
        self._stop_pressed = self._latched = self._version_wanted = False

    @property
    def reordered(self) -> int:
        """Number of frames and samples that came out of order."""
        return self.counts.wrong_counter + self._order.dropped

    def expect(self, vx_mps: float, wz_radps: float, now_ns: int) -> None:
        """Take note of the velocity that the base was commanded."""
        self._command, self._command_ns = (vx_mps, wz_radps), now_ns

    def ask_version(self) -> None:
        """Put the base's version into the next report in which it is known."""
        self._version_wanted = True

    def forget_all(self) -> None:
        """Reset all streams after a lost bus: the first frame of each may be old."""
        for stream in self._streams.values():
            stream.checker.forget()
        self.health.forget()

    def put(self, frame: Frame, now_ns: int) -> None:
        """Take one received frame."""
        if frame.error:
            self.health.note(frame)
            return
        identifier, database = frame.identifier, self._database
        self.traffic.note(identifier, len(frame.data), known=identifier in database.known)
        stream = self._streams.get(identifier)
        if stream is not None:
            self._check(stream, frame, now_ns)
        elif identifier in database.ours:
            self._note_second_sender(database.ours[identifier], frame)

    def take(self, now_ns: int) -> Report:
        """Return the report of the frames since the last call; the caller adds failing writes."""
        silent = any(stream.is_missing(now_ns) for stream in self._vital)
        for stream in self._streams.values():
            if stream.is_missing(now_ns):
                stream.forget_old_counter(now_ns)
                if silent and stream not in self._vital:
                    stream.good_ns = now_ns  # its cycle time counts again from the base's return
        state, self._state = self._state, None
        battery, self._battery = self._battery, None
        foreign, self._foreign = self._foreign, None
        estop = self._emergency_stop()
        return Report(
            state=None if silent else state,
            remote_estop=estop,
            foreign=foreign,
            battery=battery,
            version=self._version(),
            unsafe=self._invalid() or (None if silent else self._missing(now_ns) or self._without_value),
        )

    def _check(self, stream: _Stream, frame: Frame, now_ns: int) -> None:
        verdict = stream.checker.check(frame)
        self.counts.wrong += verdict in (Verdict.WRONG_CRC, Verdict.WRONG_LENGTH)
        self.counts.wrong_counter += verdict in (Verdict.REPEATED, Verdict.OUT_OF_ORDER)
        if verdict in (Verdict.FIRST, Verdict.GOOD):
            stream.counted_ns = now_ns
        if verdict is Verdict.FIRST:
            return
        if verdict is not Verdict.GOOD:
            stream.bad_in_a_row, stream.verdict = stream.bad_in_a_row + 1, verdict
            return
        stream.bad_in_a_row, stream.good_ns = 0, now_ns
        stream.data, stream.fresh = frame.data, True
        if stream in self._sample:
            self._complete_sample(now_ns)
        signals = self._database.signals
        if "can.uptime" in signals and signals["can.uptime"].message == stream.message.name:
            uptime_s = self._value("can.uptime")
            if uptime_s is not None:
                self._clock.set(round(uptime_s * 1e9))
        if "can.battery.charge" in signals and signals["can.battery.charge"].message == stream.message.name:
            self._note_battery(now_ns)

    def _note_second_sender(self, name: str, frame: Frame) -> None:
        """Judge a frame with an identifier of ours: an emergency stop by a third party, or a second controller."""
        estop, signal = self._config.estop, self._database.signals.get("can.estop.request")
        if estop is not None and signal is not None and signal.message == name:
            message = self._database.sent[name]
            intact = len(frame.data) == message.length and (
                message.protection is None or message.protection.is_intact(frame.identifier, frame.data)
            )
            request = signal.raw(frame.data) if intact else None
            # A repeated or late stop does no harm, so the counter is not asked.
            self._stop_pressed |= request == estop.stop
            if request in (estop.stop, estop.none):
                return
        self._foreign = f"{name} from another controller on the CAN bus"

    def _complete_sample(self, now_ns: int) -> None:
        """Build the state once all messages of one odometry sample have arrived."""
        if not all(stream.fresh for stream in self._sample):
            return
        counters = {stream.counter() for stream in self._sample}
        odometry = self._config.odometry
        if odometry is not None and odometry.same_counter and len(counters) > 1:
            return
        for stream in self._sample:
            stream.fresh = False
        passed_ns = self._clock.advance(self._sample[0].counter(), now_ns)
        state = self._built_state(passed_ns / 1e9, now_ns)
        if state is not None and self._clock.is_known and self._order.accept(state):
            self._state = state

    def _built_state(self, passed_s: float, now_ns: int) -> RobotState | None:
        motion = self._wheel_motion(passed_s) if self._config.odometry is None else self._reported_motion()
        mode = self._mode()
        if motion is None or mode is None or any(self._signal_data(where) is None for where in self._imu):
            return None
        gyro, roll, pitch = (self._value(f"can.imu.{name}") for name in ("wz", "roll", "pitch"))
        invalid = [where for where in self._imu if self._value(where) is None]
        self.counts.out_of_range += len(invalid)
        # A tilt that cannot be told is not level.
        self._without_value = f"{invalid[0]} is outside its range in the DBC file" if invalid else None
        pose, vx, wz = motion
        armed = self._config.state is None or mode == self._config.state.armed
        commanded = self._command if armed and now_ns - self._command_ns <= _COMMANDED_NS else None
        codes = (*self._faults(), *self._agreement.check(now_ns, (vx, wz), commanded, gyro))
        return RobotState(
            received_ns=now_ns,
            T_odom_base=pose,
            vx_mps=vx,
            vy_mps=0.0,
            wz_radps=wz,
            mode=mode,
            error_code=reported_code(codes, self._accepted),
            robot_stamp_ns=self._clock.stamp_ns,
            position_z_m=0.0,
            roll_rad=roll or 0.0,
            pitch_rad=pitch or 0.0,
            gyro_wz_radps=gyro,
            foot_forces=(0, 0, 0, 0),
        )

    def _reported_motion(self) -> tuple[tuple[float, float, float], float, float] | None:
        x, y, heading, vx, wz = (self._value(f"can.odometry.{name}") for name in ("x", "y", "heading", "vx", "wz"))
        if x is None or y is None or heading is None or vx is None or wz is None:
            self.counts.out_of_range += 1
            return None
        return (x, y, heading), vx, wz

    def _wheel_motion(self, passed_s: float) -> tuple[tuple[float, float, float], float, float] | None:
        left, right, wheels = self._wheel_speed("left"), self._wheel_speed("right"), self._wheels
        if left is None or right is None or wheels is None:
            self.counts.out_of_range += 1
            return None
        wheels.advance(left, right, passed_s)
        return wheels.T_odom_base, *wheels.velocity(left, right)

    def _wheel_speed(self, side: str) -> float | None:
        """Return the speed of a wheel over the floor, m/s."""
        value, table = self._value(f"can.wheels.{side}"), self._config.wheels
        if value is None or table is None:
            return None
        rotates = self._database.signals[f"can.wheels.{side}"].kind == "rotation"
        return value * table.radius_m if rotates else value

    def _note_battery(self, now_ns: int) -> None:
        charge = self._value("can.battery.charge")
        if charge is None:
            self.counts.out_of_range += 1
            return
        voltage, current = self._value("can.battery.voltage"), self._value("can.battery.current")
        self._battery = BatteryState(now_ns, round(charge), voltage or 0.0, current or 0.0)

    def _mode(self) -> int | None:
        return MODE_WITHOUT_STATE if self._config.state is None else self._raw("can.state.signal")

    def _faults(self) -> list[int]:
        """Return the error codes of the fault signals that are set."""
        return [ERROR_FAULTS + index for index in range(len(self._config.faults)) if self._raw(f"can.faults[{index}]")]

    def _emergency_stop(self) -> bool:
        """Return whether the base's button is pressed, or its emergency stop has latched since the last step.

        A stop that stays latched does not count again. Only the reset of a permitted arming ends it.
        """
        state, pressed = self._config.state, self._stop_pressed
        self._stop_pressed = False
        latched = bool(self._raw("can.estop.latched"))
        latched |= state is not None and state.estop >= 0 and self._raw("can.state.signal") == state.estop
        pressed |= latched and not self._latched
        self._latched = latched
        return pressed or bool(self._raw("can.estop.button"))

    def _version(self) -> str | None:
        version = self._raw("can.version.signal") if self._version_wanted else None
        if version is None:
            return None
        self._version_wanted = False
        return str(version)

    def _invalid(self) -> str | None:
        """Return in one line which message was invalid too often in a row."""
        most = 5 if self._config.protection is None else self._config.protection.bad_in_a_row
        for stream in self._streams.values():
            if stream.bad_in_a_row >= most:
                kind = stream.verdict.name.lower().replace("_", " ")
                return f"{most} invalid frames of {stream.message.name} in a row ({kind}): check wiring and DBC file"
        return None

    def _missing(self, now_ns: int) -> str | None:
        """Return in one line which message has not come; a base that is silent altogether only gives no state."""
        for stream in self._streams.values():
            if stream.is_missing(now_ns):
                cycle_ms = stream.message.cycle_ns / 1e6
                return f"{stream.message.name} is missing: expected every {cycle_ms:g} ms"
        return None

    def _signal_data(self, where: str) -> tuple[Signal, bytes] | None:
        signal = self._database.signals.get(where)
        data = None if signal is None else self._by_name[signal.message].data
        return None if signal is None or data is None else (signal, data)

    def _value(self, where: str) -> float | None:
        """Return the newest physical value; None where there is none, or one outside its range."""
        found = self._signal_data(where)
        return None if found is None else found[0].decode(found[1])

    def _raw(self, where: str) -> int | None:
        found = self._signal_data(where)
        return None if found is None else found[0].raw(found[1])
