"""What the bridge's rules need to know of one protocol's robot, as data: its modes and the steps that make it ready."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class RobotTable:
    """Modes of a robot and the steps that lead to a mode in which it may drive.

    `identity`: the part of the robot that reports its version, for messages. `version`: the version that it must
    report before it is made ready; None: the protocol has none. `ready_modes`: modes in which arming is complete.
    `armed_modes`: modes in which an armed robot may be; any other mode stops it. `moving_modes`: modes that imply
    motion. `next_step`: step that brings a robot in this mode nearer to a ready one; other modes get `recovery_step`.
    `repeat_ns`: time after which a step without effect is requested again. `holds_command`: the base never stops by
    itself, or late: it may hold the last command of an earlier bridge, also one that it could not follow yet.
    """

    identity: str
    version: str | None
    ready_modes: frozenset[int]
    armed_modes: frozenset[int]
    moving_modes: frozenset[int]
    next_step: Mapping[int, int]
    recovery_step: int
    step_names: Mapping[int, str]
    mode_names: Mapping[int, str] = field(default_factory=dict)
    repeat_ns: int = 3_000_000_000
    holds_command: bool = False

    def __post_init__(self) -> None:
        if not self.ready_modes <= self.armed_modes:
            raise ValueError(f"ready modes {set(self.ready_modes)}: expected some of {set(self.armed_modes)}")
        unnamed = {*self.next_step.values(), self.recovery_step} - set(self.step_names)
        if unnamed:
            raise ValueError(f"steps {unnamed}: expected a name for each")

    def name_of(self, mode: int) -> str:
        """Return `mode N`, or the mode's name where the protocol has one."""
        return f"mode {self.mode_names.get(mode, mode)}"
