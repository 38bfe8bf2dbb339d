"""Switches of this project's additions to the paper's method: the decoding rules and the recoveries.

A manifest's `runtime` section has a default of each; `edge-run` and `edge-bench` have an option of each that overrides
it; results and flight logs record the values in force.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any


class Decoding(Enum):
    """How texts are decoded."""

    FREE = "free"
    """Greedy, as in the paper."""
    CONSTRAINED = "constrained"
    """Greedy within the rules of `edge.reasoning.decoding_rules`."""


class RecoverySwitch(Enum):
    """Whether the recoveries of `edge.motion.recovery` may replace a command."""

    ON = "on"
    OFF = "off"


@dataclass(frozen=True)
class Switches:
    """The values in force in one run."""

    decoding: Decoding = Decoding.CONSTRAINED
    recovery: RecoverySwitch = RecoverySwitch.ON
    stand_at_goal: bool = True
    """Whether the robot stands at the stop that its texts have placed; one of the recoveries."""

    def __post_init__(self) -> None:
        if self.stand_at_goal and self.recovery is RecoverySwitch.OFF:
            raise ValueError("standing at the goal (--stay) is a recovery: expected --recovery on with it, found off")

    def as_json(self) -> dict[str, Any]:
        """Return the fields as results and flight logs hold them."""
        return {
            "decoding": self.decoding.value, "recovery": self.recovery.value, "stand_at_goal": self.stand_at_goal,
        }  # fmt: skip


@dataclass(frozen=True)
class SwitchOptions:
    """Switches of a command line; None: the manifest's default, and the command's own for standing at the goal."""

    decoding: Decoding | None = None
    recovery: RecoverySwitch | None = None
    stand_at_goal: bool | None = None

    @staticmethod
    def parse(decoding: str | None, recovery: str | None, stand_at_goal: bool | None) -> SwitchOptions:
        """Return the options of a command line. Raises ValueError for values that do not exist or contradict."""
        options = SwitchOptions(
            None if decoding is None else Decoding(decoding),
            None if recovery is None else RecoverySwitch(recovery),
            stand_at_goal,
        )
        options.over(Decoding.CONSTRAINED, options.recovery or RecoverySwitch.ON, stand_at_goal=True)
        return options

    def over(self, decoding: Decoding, recovery: RecoverySwitch, *, stand_at_goal: bool) -> Switches:
        """Return the values in force over these defaults; without recovery the robot stands at no goal by default.

        Raises ValueError when the options ask for standing at the goal without recovery.
        """
        recovery = self.recovery or recovery
        stands = stand_at_goal and recovery is RecoverySwitch.ON if self.stand_at_goal is None else self.stand_at_goal
        return Switches(self.decoding or decoding, recovery, stands)
