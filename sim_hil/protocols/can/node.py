"""CAN node of the base: which commands it obeys, when it stops by itself, what it reports. Pure: no clock, no bus.

States: idle -> armed -> idle, and from every state an emergency stop, latched until a reset. All times are the robot's
own clock, s. The timeouts fit a wheeled robot without a driver on board: after 100 ms without a valid velocity command
the base stops (openpilot's body: 100 ms), after 500 ms without the controller's heartbeat it disarms.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from edge.core.geometry import wrap_angle
from firmware_bridge.can.frame import ERROR_BUS_OFF, ERROR_RESTARTED, Frame
from firmware_bridge.can.protection import Verdict
from sim_hil.protocols.base import Base
from sim_hil.protocols.can import frames
from sim_hil.protocols.can.frames import Decoder, Encoder, Received
from sim_hil.robots.carter.sensors import Sensors

COMMAND_TIMEOUT_S: Final = 0.100
HEARTBEAT_TIMEOUT_S: Final = 0.500
# A node may rejoin 128 x 11 recessive bits after bus-off (ISO 11898-1: 2.8 ms at 500 kbit/s); ours waits longer, like
# Linux with "restart-ms 100".
BUS_OFF_RECOVERY_S: Final = 0.100
BATTERY_LOW_PERCENT: Final = 10.0
_TICK_S: Final = 1e-6  # tolerance for the rounding error of summed steps
_LEVELS: Final = ("CommandTimeout", "HeartbeatLost", "BatteryLow", "DriveOverload")
_SIDES: Final = ("Front", "Rear", "Left", "Right")


@dataclass
class Counts:
    """Counts of rejected frames, bus-off events and error frames."""

    wrong_crc: int = 0
    wrong_length: int = 0
    wrong_counter: int = 0
    lost: int = 0
    unknown: int = 0
    bus_offs: int = 0
    error_frames: int = 0

    @property
    def malformed(self) -> int:
        """Number of invalid frames; frames for other nodes are not included."""
        return self.wrong_crc + self.wrong_length


class CanNode:
    """Node of one base: call `receive` for every frame, then `step` and `due` after every physics step."""

    def __init__(self, base: Base) -> None:
        self._base = base
        self._decoder = Decoder("Controller")
        self._encoder = Encoder()
        self.counts = Counts()
        self.button = False
        self.state = frames.STATE_IDLE
        self._source = frames.SOURCE_NONE
        self._command_s: float | None = None
        self._heartbeat_s: float | None = None
        self._bus_off_until_s: float | None = None
        self._periods = frames.periods_s("Base")
        self._next_s = dict.fromkeys(self._periods, 0.0)
        self._reported: dict[str, dict[str, float]] = {}
        self._low_battery = False

    @property
    def bus_off(self) -> bool:
        """Whether the node is disconnected from the bus."""
        return self._bus_off_until_s is not None

    def receive(self, frame: Frame, now_s: float) -> Received | None:
        """Check a frame and obey it if valid; None for an error frame and for one that is not for the base."""
        if frame.error:
            self._bus_error(frame.identifier, now_s)
            return None
        if self.bus_off:
            return None
        received = self._decoder.decode(frame)
        if received is None:
            self.counts.unknown += 1
            return None
        self._count(received)
        if received.name == "EstopControl":
            self._estop_control(received)
        elif received.good:
            self._obey(received, now_s)
        return received

    def _count(self, received: Received) -> None:
        counts = self.counts
        counts.lost += received.newly_lost
        counts.wrong_crc += received.verdict is Verdict.WRONG_CRC
        counts.wrong_length += received.verdict is Verdict.WRONG_LENGTH
        counts.wrong_counter += received.verdict in (Verdict.REPEATED, Verdict.OUT_OF_ORDER)

    def _estop_control(self, received: Received) -> None:
        request = received.signals.get("Request", frames.ESTOP_NONE)
        # A stop frame needs a valid CRC only, no valid counter: a repeated stop does no harm.
        if request == frames.ESTOP_STOP:
            self._stop(frames.SOURCE_BUS)
        elif request == frames.ESTOP_RESET and received.good and not self.button:
            self._reset()

    def _obey(self, received: Received, now_s: float) -> None:
        if received.name == "ControllerHeartbeat":
            self._heartbeat_s = now_s
        elif received.name == "VelocityCommand":
            self._command_s = now_s
            if self.state == frames.STATE_ARMED:
                self._base.command(received.signals["Vx"], 0.0, received.signals["Wz"])
        elif received.name == "ModeCommand" and received.signals["Request"] == frames.MODE_DISARM:
            self._disarm()
        elif received.name == "ModeCommand" and received.signals["Request"] == frames.MODE_ARM:
            self._arm(now_s)

    def _arm(self, now_s: float) -> None:
        if self.state == frames.STATE_IDLE and self._heartbeat_alive(now_s) and not self._low_battery:
            self.state = frames.STATE_ARMED
            self._command_s = now_s  # the timeout of the first command starts now
            self._base.stand()

    def _disarm(self) -> None:
        if self.state == frames.STATE_ARMED:
            self.state = frames.STATE_IDLE
            self._base.rest()

    def _stop(self, source: int) -> None:
        if self.state != frames.STATE_ESTOP:
            self.state, self._source = frames.STATE_ESTOP, source
            self._base.press_estop()

    def _reset(self) -> None:
        if self.state == frames.STATE_ESTOP:
            self.state, self._source = frames.STATE_IDLE, frames.SOURCE_NONE
            self._base.release_estop()

    def _bus_error(self, classes: int, now_s: float) -> None:
        self.counts.error_frames += 1
        if classes & ERROR_RESTARTED:
            self._bus_off_until_s = None
        elif classes & ERROR_BUS_OFF and not self.bus_off:
            self.counts.bus_offs += 1
            self._bus_off_until_s = now_s + BUS_OFF_RECOVERY_S
            self._heartbeat_s = None
            self._decoder.forget_all()
            self._disarm()

    def _heartbeat_alive(self, now_s: float) -> bool:
        return self._heartbeat_s is not None and now_s - self._heartbeat_s <= HEARTBEAT_TIMEOUT_S

    def _timed_out(self, now_s: float) -> bool:
        return self._command_s is None or now_s - self._command_s > COMMAND_TIMEOUT_S + _TICK_S

    def step(self, now_s: float) -> None:
        """Apply timeouts, rejoin the bus when due, and apply the emergency stop button."""
        if self._bus_off_until_s is not None and now_s >= self._bus_off_until_s:
            self._bus_off_until_s = None
        if self.button:
            self._stop(frames.SOURCE_BUTTON)
        if self._heartbeat_s is not None and not self._heartbeat_alive(now_s):
            self._heartbeat_s = None
            self._decoder.forget("ControllerHeartbeat")
            self._disarm()
        if self._command_s is not None and self._timed_out(now_s):
            self._command_s = None
            self._decoder.forget("VelocityCommand")
            if self.state == frames.STATE_ARMED:
                self._base.command(0.0, 0.0, 0.0)

    def due(self, now_s: float, read: Callable[[], Sensors]) -> list[Frame]:
        """Return the frames to send now, none while the bus is off; `read` is called only if there are any."""
        if self.bus_off:
            return []
        names = [name for name, at_s in self._next_s.items() if now_s >= at_s]
        changed = self._state_has_changed()
        if not names and not changed:
            return []
        sensors = read()
        self._low_battery = sensors.charge_percent <= BATTERY_LOW_PERCENT
        made = []
        for name in names:
            # Relative to the last due time, to keep the rate; after a pause relative to now, to avoid a burst.
            self._next_s[name] = max(self._next_s[name] + self._periods[name], now_s)
            made.append(self._make(name, now_s, sensors))
        for name in ("EstopState", "Faults"):
            if name not in names and self._reported.get(name) != self._levels(name, sensors, now_s):
                made.append(self._make(name, now_s, sensors))
        return made

    def _state_has_changed(self) -> bool:
        """Return whether the emergency stop's state differs from the last report; fault bits are checked in `due`."""
        return self._reported.get("EstopState") != self._estop_signals()

    def _estop_signals(self) -> dict[str, float]:
        latched = self.state == frames.STATE_ESTOP
        return {"Latched": float(latched), "Button": float(self.button), "Source": float(self._source)}

    def _levels(self, name: str, sensors: Sensors, now_s: float) -> dict[str, float]:
        """Return the signals of a report whose change is sent at once."""
        if name == "EstopState":
            return self._estop_signals()
        late = self.state == frames.STATE_ARMED and self._timed_out(now_s)
        levels = (late, not self._heartbeat_alive(now_s), self._low_battery, sensors.overload)
        return {
            **{key: float(value) for key, value in zip(_LEVELS, levels, strict=True)},
            **{f"Bumper{side}": float(hit) for side, hit in zip(_SIDES, sensors.bumpers, strict=True)},
        }

    def _make(self, name: str, now_s: float, sensors: Sensors) -> Frame:
        if name in ("EstopState", "Faults"):
            self._reported[name] = self._levels(name, sensors, now_s)
        return self._encoder.encode(name, **self._signals(name, now_s, sensors))

    def _signals(self, name: str, now_s: float, sensors: Sensors) -> dict[str, float]:
        left_right = {
            "WheelSpeeds": sensors.wheel_radps,
            "WheelTorques": sensors.wheel_nm,
            "WheelCounts": tuple(count % frames.COUNTS_MODULUS for count in sensors.wheel_counts),
        }
        vectors = {"ImuGyro": sensors.gyro_radps, "ImuAccel": sensors.accel_mps2}
        if name in left_right:
            return dict(zip(("Left", "Right"), left_right[name], strict=True))
        if name in vectors:
            return dict(zip(("X", "Y", "Z"), vectors[name], strict=True))
        if name == "OdometryPosition":
            return {"X": sensors.T_odom_base.x_m, "Y": sensors.T_odom_base.y_m}
        if name == "OdometryMotion":
            heading = wrap_angle(sensors.T_odom_base.theta_rad)
            return {"Heading": heading, "Vx": sensors.v_mps, "Wz": sensors.w_radps}
        if name == "Battery":
            return {"Charge": sensors.charge_percent, "Voltage": sensors.voltage_v, "Current": sensors.current_a}
        if name == "BaseHeartbeat":
            return {"State": self.state, "Version": frames.PROTOCOL_VERSION, "Uptime": frames.uptime_s(now_s)}
        if name == "EstopState":
            return self._estop_signals()
        counts = self.counts
        totals = (counts.wrong_crc + counts.wrong_length, counts.wrong_counter, counts.lost, counts.unknown)
        keys = ("CrcErrors", "CounterErrors", "LostFrames", "UnknownFrames")
        modulo = {key: float(count % 256) for key, count in zip(keys, totals, strict=True)}
        return {**self._levels("Faults", sensors, now_s), **modulo, "BusOffs": float(counts.bus_offs % 256)}
