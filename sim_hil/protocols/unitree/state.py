"""State topics of the simulated Go2: `rt/sportmodestate` 50 Hz, `rt/lowstate` 500 Hz, both at 20 Hz under `rt/lf/`.

Also `rt/wirelesscontroller` at 100 Hz (the remote control), and `rt/odommodestate`: the sport state under the topic
name that other robots and bindings use for odometry.
"""

from __future__ import annotations

import struct
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from cyclonedds._clayer import ddspy_write
from cyclonedds.pub import DataWriter

from firmware_bridge.dds.binding import has_reader
from firmware_bridge.dds.bus import DDS_ERRORS, Bus
from firmware_bridge.unitree.messages import ids
from firmware_bridge.unitree.messages.crc import LOW_STATE_LAYOUT, crc_of_words, low_state_values
from firmware_bridge.unitree.messages.idl import IMUState_, PathPoint_, SportModeState_, TimeSpec_, WirelessController_
from firmware_bridge.unitree.messages.idl_low import BmsState_, LowState_, MotorState_
from sim_hil.protocols.unitree.odometry import OdometryFrame
from sim_hil.robots.battery import CELLS, Battery, BatteryReading, load_w
from sim_hil.robots.go2.body import RobotTruth

if TYPE_CHECKING:
    from sim_hil.protocols.unitree.state_faults import StateFaults

WIRELESS_HZ: Final = 100  # as in the maker's MuJoCo simulator
SPORT_STATE_HZ: Final = 50
LOW_STATE_HZ: Final = 500
ODOMETRY_TOPIC: Final = "rt/odommodestate"
LF_HZ: Final = 20  # not documented by the maker; owners report 15 to 20
_MATCH_CHECK_HZ: Final = 10
_MOTORS: Final = 20
_MOTORS_USED: Final = 12
# LowState_ as CDR: members aligned to their own size, no padding after a struct. The binding's own serializer needs
# 0.25 ms per message, which at 500 Hz is an eighth of a core.
_CDR_LITTLE_ENDIAN: Final = b"\0\1\0\0"
_LOW_STATE_CDR: Final = struct.Struct(
    "<4B4IH2x" + "13fB" + "B2x7fB3x3I" + "B3x7fB3x3I" * (_MOTORS - 1) + "4BiH4B15H" + "8hI41B3xf2B2x2f4HII"
)
_REMOTE_BYTES: Final = 40
_FOOT_RAISE_M: Final = 0.09  # from the maker's sample


@dataclass
class Remote:
    """State of the remote control: sticks in -1..1, keys as the bits of WirelessController_.keys."""

    lx: float = 0.0
    ly: float = 0.0
    rx: float = 0.0
    ry: float = 0.0
    keys: int = 0

    def release(self) -> None:
        """Release all sticks and keys."""
        self.lx = self.ly = self.rx = self.ry = 0.0
        self.keys = 0

    def as_bytes(self) -> bytes:
        """Encode as LowState_.wireless_remote: keys at byte 2, then lx, rx, ry at 4, 8, 12 and ly at 20."""
        data = bytearray(_REMOTE_BYTES)
        struct.pack_into("<H", data, 2, self.keys)
        struct.pack_into("<3f", data, 4, self.lx, self.rx, self.ry)
        struct.pack_into("<f", data, 20, self.ly)
        return bytes(data)


def imu_state(truth: RobotTruth, odometry: OdometryFrame) -> IMUState_:
    """Return the IMU part of both state messages."""
    return IMUState_(
        odometry.quaternion(truth.quaternion_wxyz),
        truth.gyro_radps.tolist(),
        truth.accel_mps2.tolist(),
        odometry.rpy(truth.rpy_rad),
        temperature=40,  # degrees C; no thermal model
    )


def sport_mode_state(truth: RobotTruth, odometry: OdometryFrame, progress: float = 0.0) -> SportModeState_:
    """Return the message of `rt/sportmodestate`; position and velocity in the odometry frame, as in MuJoCo."""
    seconds = int(truth.time_s)
    return SportModeState_(
        stamp=TimeSpec_(seconds, int((truth.time_s - seconds) * 1e9)),
        error_code=0,
        imu_state=imu_state(truth, odometry),
        mode=truth.mode,
        progress=progress,
        gait_type=truth.gait_type,
        foot_raise_height=_FOOT_RAISE_M,
        position=odometry.position(truth.position_m),
        body_height=truth.body_height_m,
        velocity=odometry.velocity(truth.velocity_world_mps),
        yaw_speed=odometry.yaw_speed(float(truth.gyro_radps[2])),
        range_obstacle=[0.0] * 4,  # no range sensor; the maker's simulator sends zero
        foot_force=_foot_force(truth),
        foot_position_body=truth.foot_position_body_m.ravel().tolist(),
        foot_speed_body=truth.foot_velocity_body_mps.ravel().tolist(),
        path_point=[PathPoint_(*([0.0] * 7)) for _ in range(10)],
    )


def _foot_force(truth: RobotTruth) -> list[int]:
    return [max(-32768, min(32767, round(float(force)))) for force in truth.foot_force_n]


class LowStateMessage:
    """Reusable LowState message: creating 20 motor entries 500 times a second would cost too much."""

    def __init__(self) -> None:
        motors = [
            MotorState_(
                mode=1 if index < _MOTORS_USED else 0,
                **dict.fromkeys(("q", "dq", "ddq", "tau_est", "q_raw", "dq_raw", "ddq_raw"), 0.0),
                temperature=30,  # degrees C; no thermal model
                lost=0,
                reserve=[0, 0],
            )
            for index in range(_MOTORS)
        ]
        imu = IMUState_([1.0, 0.0, 0.0, 0.0], [0.0] * 3, [0.0] * 3, [0.0] * 3, 40)
        # Until the first reading: full, at its nominal 28.8 V.
        battery = BmsState_(0, 0, 8, 100, 0, 0, b"\x1e\x1e", b"\x1e\x1e", [3600] * 8 + [0] * 7)
        self.message = LowState_(
            head=b"\xfe\xef",
            level_flag=0xFF,
            frame_reserve=0,
            sn=[0, 0],
            version=[0, 0],
            bandwidth=0,
            imu_state=imu,
            motor_state=motors,
            bms_state=battery,
            foot_force=[0] * 4,
            foot_force_est=[0] * 4,
            tick=0,
            wireless_remote=bytes(40),
            bit_flag=0,
            adc_reel=0.0,
            temperature_ntc1=30,
            temperature_ntc2=30,
            power_v=28.8,
            power_a=0.0,
            fan_frequency=[0] * 4,
            reserve=0,
            crc=0,
        )

    def charge(self, reading: BatteryReading) -> None:
        """Set the reported battery state; the current is negative while discharging."""
        message, battery = self.message, self.message.bms_state
        battery.soc = round(reading.soc_percent)
        battery.current = -round(1000 * reading.current_a)  # mA
        battery.cell_vol = [round(1000 * reading.voltage_v / CELLS)] * CELLS + [0] * 7  # mV
        message.power_v, message.power_a = reading.voltage_v, reading.current_a

    def encode(self) -> bytes:
        """Encode the message with a new checksum; same bytes as `serialize`, but much faster."""
        values = low_state_values(self.message)
        self.message.crc = crc_of_words(LOW_STATE_LAYOUT.pack(*values))
        return _CDR_LITTLE_ENDIAN + _LOW_STATE_CDR.pack(*values, self.message.crc)

    def update(self, truth: RobotTruth, odometry: OdometryFrame) -> LowState_:
        """Fill and return the message for this instant, without checksum."""
        message = self.message
        message.imu_state = imu_state(truth, odometry)
        rows = zip(truth.joint_q_rad.tolist(), truth.joint_dq_radps.tolist(), truth.joint_tau_nm.tolist(), strict=True)
        for motor, (q_rad, dq_radps, tau_nm) in zip(message.motor_state, rows, strict=False):
            motor.q = motor.q_raw = q_rad
            motor.dq = motor.dq_raw = dq_radps
            motor.tau_est = tau_nm
        message.foot_force = message.foot_force_est = _foot_force(truth)
        message.tick = round(truth.time_s * 1000) & 0xFFFFFFFF
        return message


class _Periodic:
    """Writer that sends every `every` steps while there is a reader; readers are checked 10 times a second."""

    def __init__(self, writer: DataWriter[Any], every: int, steps_per_s: int, *, always: bool) -> None:
        self._writer = writer
        self._always = always
        self._every = every
        self._check_every = steps_per_s // _MATCH_CHECK_HZ
        self._wanted = False
        self.sent = 0

    def due(self, step: int) -> bool:
        if self._always:
            return step % self._every == 0
        if step % self._check_every == 0:
            self._wanted = has_reader(self._writer)
        return self._wanted and step % self._every == 0

    def write(self, message: object) -> None:
        try:
            self._writer.write(message)
        except DDS_ERRORS:
            return  # a reader's queue is full: the next sample replaces this one
        self.sent += 1

    def write_encoded(self, data: bytes) -> None:
        """Write serialized data, as `DataWriter.write` does; its length is a multiple of 4 bytes."""
        if ddspy_write(self._writer._ref, data) >= 0:
            self.sent += 1


class StatePublishers:
    """Publisher of all state topics; everything but the sport state is computed only if there is a reader."""

    def __init__(
        self,
        bus: Bus,
        odometry: OdometryFrame,
        steps_per_s: int,
        *,
        remote: Remote | None = None,
        faults: StateFaults | None = None,
    ) -> None:
        def periodic(topic: str, kind: object, rate_hz: int, *, always: bool = False) -> _Periodic:
            return _Periodic(bus.writer(topic, kind), max(steps_per_s // rate_hz, 1), steps_per_s, always=always)

        self._odometry = odometry
        self._remote = remote or Remote()
        self._faults = faults
        self._battery, self._loaded_s = Battery(), 0.0
        self._low_message = LowStateMessage()
        self._sport = (
            periodic(ids.SPORT_STATE_TOPIC, SportModeState_, SPORT_STATE_HZ, always=True),  # its rate is reported
            periodic("rt/lf/sportmodestate", SportModeState_, LF_HZ),
            periodic(ODOMETRY_TOPIC, SportModeState_, SPORT_STATE_HZ),
        )
        self._low = (
            periodic(ids.LOW_STATE_TOPIC, LowState_, LOW_STATE_HZ),
            periodic("rt/lf/lowstate", LowState_, LF_HZ),
        )
        self._wireless = periodic(ids.REMOTE_TOPIC, WirelessController_, WIRELESS_HZ)

    def due(self, step: int) -> list[_Periodic]:
        """Return the topics that are due after this physics step, for `publish`."""
        return [topic for topic in (*self._sport, *self._low, self._wireless) if topic.due(step)]

    def publish(self, due: list[_Periodic], truth: RobotTruth, stamp_s: float, progress: float = 0.0) -> None:
        """Write one instant to the due topics; `stamp_s`: robot's clock, s; `progress`: of a show, 0 or 1."""
        truth = replace(truth, time_s=stamp_s)
        sport = [topic for topic in due if topic in self._sport]
        if sport:
            self._odometry.update(truth)
            self._empty_battery(truth)
            self._write_sport(sport, sport_mode_state(truth, self._odometry, progress))
        low = [topic for topic in due if topic in self._low]
        if low:
            self._write_low(low, truth)
        if self._wireless in due:
            remote = self._remote
            self._wireless.write(WirelessController_(remote.lx, remote.ly, remote.rx, remote.ry, remote.keys))

    def overdue(self) -> None:
        """Write the messages that faults have delayed until now."""
        if self._faults is not None:
            for late in self._faults.due(time.monotonic_ns()):
                self._sport[0].write(late)

    def _write_sport(self, topics: list[_Periodic], state: SportModeState_) -> None:
        if self._faults is None:
            messages = [state]
        elif self._sport[0] in topics:
            messages = self._faults.deliver(state, time.monotonic_ns())
        else:
            messages = self._faults.beside(state)
        for topic in topics:
            for message in messages:
                topic.write(message)

    def _write_low(self, topics: list[_Periodic], truth: RobotTruth) -> None:
        self._low_message.message.wireless_remote = self._remote.as_bytes()
        message = self._low_message.update(truth, self._odometry)
        if self._faults is not None and not self._faults.alter_low(message):
            return
        data = self._low_message.encode()
        for topic in topics:
            topic.write_encoded(data)

    def _empty_battery(self, truth: RobotTruth) -> None:
        elapsed_s, self._loaded_s = truth.time_s - self._loaded_s, truth.time_s
        self._low_message.charge(self._battery.step(load_w(truth.joint_tau_nm, truth.joint_dq_radps), elapsed_s))

    @property
    def sport_states_sent(self) -> int:
        """Number of samples written to `rt/sportmodestate`."""
        return self._sport[0].sent
