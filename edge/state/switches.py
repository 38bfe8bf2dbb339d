"""Switches of this project's additions to the paper's method: decoding rules, recoveries and speculation.

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


class Speculation(Enum):
    """Whether a call of the language model verifies guessed tokens (`edge.inference.speculation`); texts are equal."""

    ON = "on"
    OFF = "off"


@dataclass(frozen=True)
class Switches:
    """The values in force in one run."""

    decoding: Decoding = Decoding.CONSTRAINED
    recovery: RecoverySwitch = RecoverySwitch.ON
    stand_at_goal: bool = True
    """Whether the robot stands at the stop that its texts have placed; one of the recoveries."""
    speculation: Speculation = Speculation.ON

    def __post_init__(self) -> None:
        if self.stand_at_goal and self.recovery is RecoverySwitch.OFF:
            raise ValueError("standing at the goal (--stay) is a recovery: expected --recovery on with it, found off")

    @property
    def turns_as_told(self) -> bool:
        """Whether the robot makes the turn on the spot that an instruction begins with, instead of the model."""
        return self.recovery is RecoverySwitch.ON

    def as_json(self) -> dict[str, Any]:
        """Return the fields as results and flight logs hold them."""
        return {
            "decoding": self.decoding.value, "recovery": self.recovery.value, "stand_at_goal": self.stand_at_goal,
            "speculation": self.speculation.value,
        }  # fmt: skip


@dataclass(frozen=True)
class SwitchOptions:
    """Switches of a command line; None: the manifest's default, and the command's own for standing at the goal."""

    decoding: Decoding | None = None
    recovery: RecoverySwitch | None = None
    stand_at_goal: bool | None = None
    speculation: Speculation | None = None

    @staticmethod
    def parse(
        decoding: str | None, recovery: str | None, stand_at_goal: bool | None, speculation: str | None
    ) -> SwitchOptions:
        """Return the options of a command line. Raises ValueError for values that do not exist or contradict."""
        options = SwitchOptions(
            None if decoding is None else Decoding(decoding),
            None if recovery is None else RecoverySwitch(recovery),
            stand_at_goal,
            None if speculation is None else Speculation(speculation),
        )
        options.over(Switches(recovery=options.recovery or RecoverySwitch.ON, stand_at_goal=False), stand_at_goal=True)
        return options

    def over(self, defaults: Switches, *, stand_at_goal: bool) -> Switches:
        """Return the values in force over a manifest's defaults, and over the command's own for standing at the goal.

        Without recovery the robot stands at no goal by default. Raises ValueError when the options ask for standing at
        the goal without recovery.
        """
        recovery = self.recovery or defaults.recovery
        stands = stand_at_goal and recovery is RecoverySwitch.ON if self.stand_at_goal is None else self.stand_at_goal
        return Switches(
            self.decoding or defaults.decoding, recovery, stands, self.speculation or defaults.speculation
        )  # fmt: skip
