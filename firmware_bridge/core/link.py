"""Datagrams between runner and bridge: fixed binary layouts, checked on arrival, no parser to attack.

Little-endian. Header: magic `TVEB`, version u8, kind u8, payload length u16.
  1 arm       empty
  2 stop      empty
  3 velocity  seq u64, stamp_ns i64 (time.monotonic_ns of the command), vx, vy m/s, wz rad/s as f64
  4 status    stamp_ns i64, state u8, zero_after_stop u8, cause u8, blocked_by u8, permit u8, motion u8, last_seq u64,
              commands u64, rejected u64, robot u64, last command 3 x f64, speed f64, then the reason as UTF-8
  5 release   empty; operator's socket only
  6 state     the robot's newest report (`RobotState`); observers' socket only
  7 battery   its battery; observers' socket only
Version 1 had neither cause nor blocked_by, version 2 had neither permit, motion, speed nor release, version 3 no robot,
version 4 no state without a gyroscope (NaN).
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Final

from firmware_bridge.core.robot_state import BatteryState, RobotState

MAGIC: Final = b"TVEB"
VERSION: Final = 5
STATES: Final = ("disarmed", "arming", "armed", "stopped")
CAUSES: Final = (
    *("none", "client_stop", "client_lost", "deadman", "shutdown", "suspended"),
    *("estop", "remote_takeover", "second_commander", "second_publisher", "link_down"),
    *("state_silent", "wrong_mode", "robot_error", "tipped", "robot_moving"),
    *("not_standing", "battery_low", "wrong_robot", "operator", "unsafe_robot"),
)
"""Why the bridge has stopped or would refuse to arm.

client_stop: the runner requested it; client_lost: its connection has closed; deadman: no good command in time;
shutdown: the bridge ends; suspended: the machine slept; estop: an operator, the local input or the remote's emergency
keys; remote_takeover: a stick or key of the robot's remote; second_commander: motion or mode requests of another
client, or a denied request of ours; second_publisher: an input topic has more than one publisher, or motor commands
have one; link_down: the network does not take our commands; state_silent: no usable report from the robot;
wrong_mode: it left its driving modes; robot_error: its error code; tipped: rolled or pitched beyond 30 degrees;
robot_moving: found moving when the bridge started; not_standing: it did not stand up in time; battery_low: less charge
than the robot file requires; wrong_robot: its sport service has another version than the robot file, or no answer;
operator: the robot file requires an operator's `edge-bridge arm`, which is still missing; unsafe_robot: the robot's
own protection, such as a failsafe parameter, is weaker than the robot file requires.
"""
PERMITS: Final = ("not needed", "needed", "given")
"""Whether the next arming needs an operator's `edge-bridge arm`, and whether it was given."""
MOTIONS: Final = ("unknown", "still", "moving")
"""The robot's own report: still means slower than 0.05 m/s for 200 ms, in a report received after the last stop."""
MAX_REASON_BYTES: Final = 400
MAX_DATAGRAM_BYTES: Final = 512

_ARM, _STOP, _VELOCITY, _STATUS, _RELEASE, _STATE, _BATTERY = 1, 2, 3, 4, 5, 6, 7
_HEADER: Final = struct.Struct("<4sBBH")
_VELOCITY_BODY: Final = struct.Struct("<Qq3d")
_STATUS_BODY: Final = struct.Struct("<qBBBBBBQQQQ4d")
_STATE_BODY: Final = struct.Struct("<q6dqqq4d4i")
_BATTERY_BODY: Final = struct.Struct("<qq2d")


class LinkError(ValueError):
    """The bytes are not a datagram of this link."""


@dataclass(frozen=True)
class Arm:
    """Request of an operator or the runner to arm."""


@dataclass(frozen=True)
class Stop:
    """Request to stop now and stay stopped."""


@dataclass(frozen=True)
class Release:
    """Operator's request that the bridge sends no command, so that a person can use the robot's remote."""


@dataclass(frozen=True)
class Velocity:
    """One velocity command in the body frame; `stamp_ns` is when it was computed."""

    seq: int
    stamp_ns: int
    vx_mps: float
    vy_mps: float
    wz_radps: float


@dataclass(frozen=True)
class BridgeStatus:
    """State of the bridge. `commands`: number of velocity commands written to the robot; `last_command`: the newest.

    `zero_after_stop`: stopped, and since then only zero velocity was written. It is True too when the bridge has never
    commanded the robot. `cause` (of CAUSES): the last stop or refusal to arm, `reason` the same as a sentence.
    `blocked_by` (of CAUSES): the reason against arming now. `permit` is one of PERMITS, `motion` one of MOTIONS,
    `speed_mps` the robot's own speed, -1 without a fresh report. `robot`: `RobotConfig.digest` of its robot file.
    """

    stamp_ns: int
    state: str
    reason: str
    last_seq: int
    commands: int
    rejected: int
    last_command: tuple[float, float, float]
    zero_after_stop: bool
    cause: str = "none"
    blocked_by: str = "none"
    permit: str = "not needed"
    motion: str = "unknown"
    speed_mps: float = -1.0
    robot: int = 0


Message = Arm | Stop | Release | Velocity | BridgeStatus | RobotState | BatteryState


def encode(message: Message) -> bytes:
    """Encode a message as a datagram; the reason of a status is cut to fit."""
    if isinstance(message, Arm):
        return _frame(_ARM, b"")
    if isinstance(message, Stop):
        return _frame(_STOP, b"")
    if isinstance(message, Release):
        return _frame(_RELEASE, b"")
    if isinstance(message, Velocity):
        velocity = (message.vx_mps, message.vy_mps, message.wz_radps)
        return _frame(_VELOCITY, _VELOCITY_BODY.pack(message.seq, message.stamp_ns, *velocity))
    if isinstance(message, RobotState):
        return _frame(_STATE, _pack_state(message))
    if isinstance(message, BatteryState):
        battery = (message.received_ns, message.soc_percent, message.voltage_v, message.current_a)
        return _frame(_BATTERY, _BATTERY_BODY.pack(*battery))
    reason = message.reason.encode("utf-8")[:MAX_REASON_BYTES].decode("utf-8", "ignore").encode("utf-8")
    counters = (message.last_seq, message.commands, message.rejected, message.robot)
    flags = (STATES.index(message.state), message.zero_after_stop)
    causes = (CAUSES.index(message.cause), CAUSES.index(message.blocked_by))
    robot = (PERMITS.index(message.permit), MOTIONS.index(message.motion))
    body = _STATUS_BODY.pack(
        message.stamp_ns, *flags, *causes, *robot, *counters, *message.last_command, message.speed_mps
    )
    return _frame(_STATUS, body + reason)


def decode(data: bytes) -> Message:
    """Decode a datagram; raises LinkError for bytes that `encode` cannot produce."""
    if len(data) < _HEADER.size:
        raise LinkError(f"{len(data)} bytes, shorter than a header")
    magic, version, kind, length = _HEADER.unpack_from(data)
    body = data[_HEADER.size :]
    if (magic, kind, length) == (MAGIC, _STOP, 0) and not body:
        return Stop()  # of any version: during an update the operator's program is newer than the running bridge
    if (magic, version) != (MAGIC, VERSION) or length != len(body):
        raise LinkError(f"magic {magic!r}, version {version}, length {length} of {len(body)}")
    if kind == _ARM and not body:
        return Arm()
    if kind == _RELEASE and not body:
        return Release()
    if kind == _VELOCITY and len(body) == _VELOCITY_BODY.size:
        return Velocity(*_VELOCITY_BODY.unpack(body))
    if kind == _STATUS and _STATUS_BODY.size <= len(body) <= _STATUS_BODY.size + MAX_REASON_BYTES:
        return _decode_status(body)
    if kind == _STATE and len(body) == _STATE_BODY.size:
        return _unpack_state(body)
    if kind == _BATTERY and len(body) == _BATTERY_BODY.size:
        return BatteryState(*_BATTERY_BODY.unpack(body))
    raise LinkError(f"kind {kind} with {len(body)} bytes")


def _pack_state(state: RobotState) -> bytes:
    motion = (*state.T_odom_base, state.vx_mps, state.vy_mps, state.wz_radps)
    gyro_wz_radps = math.nan if state.gyro_wz_radps is None else state.gyro_wz_radps
    attitude = (state.position_z_m, state.roll_rad, state.pitch_rad, gyro_wz_radps)
    codes = (state.mode, state.error_code, state.robot_stamp_ns)
    return _STATE_BODY.pack(state.received_ns, *motion, *codes, *attitude, *state.foot_forces)


def _unpack_state(body: bytes) -> RobotState:
    received_ns, x, y, theta, vx, vy, wz, *rest = _STATE_BODY.unpack(body)
    mode, error_code, stamp_ns, z, roll, pitch, gyro_wz, *feet = rest
    fr, fl, rr, rl = feet
    pose, gyro = (x, y, theta), None if math.isnan(gyro_wz) else gyro_wz
    return RobotState(received_ns, pose, vx, vy, wz, mode, error_code, stamp_ns, z, roll, pitch, gyro, (fr, fl, rr, rl))


def _decode_status(body: bytes) -> BridgeStatus:
    stamp_ns, state, zero, cause, blocked, permit, motion, *counters, vx, vy, wz, speed = _STATUS_BODY.unpack_from(body)
    valid = state < len(STATES) and zero <= 1 and permit < len(PERMITS) and motion < len(MOTIONS)
    if not valid or max(cause, blocked) >= len(CAUSES):
        raise LinkError(f"state {state}, flag {zero}, causes {cause} and {blocked}, permit {permit}, motion {motion}")
    try:
        reason = body[_STATUS_BODY.size :].decode("utf-8")
    except UnicodeDecodeError as error:
        raise LinkError("reason is not UTF-8") from error
    last_seq, commands, rejected, robot = counters
    head = (stamp_ns, STATES[state], reason, last_seq, commands, rejected, (vx, vy, wz), zero == 1)
    return BridgeStatus(*head, CAUSES[cause], CAUSES[blocked], PERMITS[permit], MOTIONS[motion], speed, robot)


def _frame(kind: int, body: bytes) -> bytes:
    return _HEADER.pack(MAGIC, VERSION, kind, len(body)) + body
