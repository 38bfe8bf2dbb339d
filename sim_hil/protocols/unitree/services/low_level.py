"""Low-level mode: joints driven by `rt/lowcmd` alone, torque = tau + kp (q* - q) + kd (dq* - dq). Pure.

A command counts when its checksum is right; one that is not is ignored and counted, as the robot's motor board does.
The head does not matter: the maker's examples fill it in, a binding that people drive real robots with leaves it zero.
"""

from __future__ import annotations

import math
import struct
from typing import Final, NamedTuple

from firmware_bridge.unitree.messages.crc import crc_of_words
from sim_hil.protocols.unitree.services.idl_command import LowCmd_
from sim_hil.robots.go2.sport import Measured, motor_torque

LOW_COMMAND_TOPIC: Final = "rt/lowcmd"
LOW_COMMAND_LAYOUT: Final = struct.Struct("<4B4IH2x" + "B3x5f3I" * 20 + "4B" + "55BxI")  # 808 bytes, the crc follows
MODE_FOC: Final = 0x01  # a motor that is driven; 0 stops it
POSITION_STOP_RAD: Final = 2.146e9  # the maker's "no position control": such a number is no angle
VELOCITY_STOP_RADPS: Final = 16000.0
SILENCE_S: Final = 0.2  # our choice: without a command for this long the joints are only damped
_DAMPING_NMS: Final = 2.0  # per rad, what the sport controller's damping has
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
        """What the motor is asked for, N.m; a loop whose target is the maker's stop number is open."""
        if not self.driven:
            return 0.0
        torque = self.tau_nm
        if abs(self.q_rad) < POSITION_STOP_RAD:
            torque += self.kp * (self.q_rad - q_rad)
        if abs(self.dq_radps) < VELOCITY_STOP_RADPS:
            torque += self.kd * (self.dq_radps - dq_radps)
        return torque


def low_command_crc(command: LowCmd_) -> int:
    """Value that belongs into `command.crc`."""
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
    """The 12 joints of a command (FR, FL, RR, RL x hip, thigh, calf); None when it is damaged or no number."""
    if command.crc != low_command_crc(command):
        return None
    targets = tuple(
        MotorTarget(motor.mode == MODE_FOC, motor.q, motor.dq, motor.tau, motor.kp, motor.kd)
        for motor in command.motor_cmd[:_JOINTS]
    )
    return targets if all(math.isfinite(value) for target in targets for value in target) else None


class LowLevel:
    """The joints' drives, and the newest command that they have."""

    def __init__(self) -> None:
        self.rejected = 0
        """Commands that were damaged."""
        self._targets: tuple[MotorTarget, ...] | None = None
        self._taken_s = -math.inf

    def take(self, command: LowCmd_ | None, now_s: float) -> None:
        """A command has arrived; None is one that did not decode."""
        targets = None if command is None else motor_targets(command)
        if targets is None:
            self.rejected += 1
            return
        self._targets, self._taken_s = targets, now_s

    def forget(self) -> None:
        """What was commanded before no longer counts."""
        self._targets, self._taken_s = None, -math.inf

    def torques(self, measured: Measured, now_s: float) -> tuple[float, ...]:
        """The 12 joint torques, N.m, within the motors' limits."""
        targets = self._targets if now_s - self._taken_s <= SILENCE_S else None
        torques = []
        for joint, (q_rad, dq_radps) in enumerate(zip(measured.q_rad, measured.dq_radps, strict=True)):
            wanted = -_DAMPING_NMS * dq_radps if targets is None else targets[joint].torque(q_rad, dq_radps)
            torques.append(motor_torque(joint % 3, wanted, dq_radps))
        return tuple(torques)
