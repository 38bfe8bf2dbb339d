"""Low-level mode: joints driven by `rt/lowcmd` only, torque = tau + kp (q* - q) + kd (dq* - dq). Pure.

A command with a wrong checksum is ignored and counted, as by the robot's motor board. The head is not checked: the
maker's examples fill it in, but a binding in use on real robots leaves it zero.
"""

from __future__ import annotations

import math
import struct
from typing import Final, NamedTuple

from firmware_bridge.unitree.messages.crc import crc_of_words
from sim_hil.protocols.unitree.services.idl_command import LowCmd_
from sim_hil.robots.go2.sport import Measured, motor_torque

LOW_COMMAND_TOPIC: Final = "rt/lowcmd"
LOW_COMMAND_LAYOUT: Final = struct.Struct(
    "<4B4IH2x" + "B3x5f3I" * 20 + "4B" + "55BxI"
)  # 808 bytes, followed by the crc
MODE_FOC: Final = 0x01  # motor driven; 0 stops it
POSITION_STOP_RAD: Final = 2.146e9  # the maker's value for "no position control"
VELOCITY_STOP_RADPS: Final = 16000.0
SILENCE_S: Final = 0.2  # our choice: timeout after which the joints are only damped
_DAMPING_NMS: Final = 2.0  # N.m.s per rad, as in the sport controller's damping
_JOINTS: Final = 12


class MotorTarget(NamedTuple):
    """One joint's part of a low command."""

    driven: bool
    q_rad: float
    dq_radps: float
    tau_nm: float
    kp: float
    kd: float

    def torque(self, q_rad: float, dq_radps: float) -> float:
        """Return the requested motor torque, N.m; a target equal to the maker's stop value disables that term."""
        if not self.driven:
            return 0.0
        torque = self.tau_nm
        if abs(self.q_rad) < POSITION_STOP_RAD:
            torque += self.kp * (self.q_rad - q_rad)
        if abs(self.dq_radps) < VELOCITY_STOP_RADPS:
            torque += self.kd * (self.dq_radps - dq_radps)
        return torque


def low_command_crc(command: LowCmd_) -> int:
    """Compute the checksum for `command.crc`."""
    motors: list[float] = []
    for motor in command.motor_cmd:
        motors += (motor.mode, motor.q, motor.dq, motor.tau, motor.kp, motor.kd, *motor.reserve)
    packed = LOW_COMMAND_LAYOUT.pack(
        *(*command.head, command.level_flag, command.frame_reserve, *command.sn, *command.version, command.bandwidth),
        *motors,
        *(command.bms_cmd.off, *command.bms_cmd.reserve),
        *(*command.wireless_remote, *command.led, *command.fan, command.gpio, command.reserve),
    )
    return crc_of_words(packed)


def motor_targets(command: LowCmd_) -> tuple[MotorTarget, ...] | None:
    """Return the 12 joint targets (FR, FL, RR, RL x hip, thigh, calf); None for a wrong checksum or a NaN."""
    if command.crc != low_command_crc(command):
        return None
    targets = tuple(
        MotorTarget(motor.mode == MODE_FOC, motor.q, motor.dq, motor.tau, motor.kp, motor.kd)
        for motor in command.motor_cmd[:_JOINTS]
    )
    return targets if all(math.isfinite(value) for target in targets for value in target) else None


class LowLevel:
    """Joint drives in low-level mode, with the newest command."""

    def __init__(self) -> None:
        self.rejected = 0
        """Number of invalid commands."""
        self._targets: tuple[MotorTarget, ...] | None = None
        self._taken_s = -math.inf

    def take(self, command: LowCmd_ | None, now_s: float) -> None:
        """Apply a received command; None: it could not be decoded."""
        targets = None if command is None else motor_targets(command)
        if targets is None:
            self.rejected += 1
            return
        self._targets, self._taken_s = targets, now_s

    def forget(self) -> None:
        """Discard the last command."""
        self._targets, self._taken_s = None, -math.inf

    def torques(self, measured: Measured, now_s: float) -> tuple[float, ...]:
        """Return the 12 joint torques, N.m, within the motors' limits."""
        targets = self._targets if now_s - self._taken_s <= SILENCE_S else None
        torques = []
        for joint, (q_rad, dq_radps) in enumerate(zip(measured.q_rad, measured.dq_radps, strict=True)):
            wanted = -_DAMPING_NMS * dq_radps if targets is None else targets[joint].torque(q_rad, dq_radps)
            torques.append(motor_torque(joint % 3, wanted, dq_radps))
        return tuple(torques)
