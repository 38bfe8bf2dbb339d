"""The numbers of tours: robots that are carried along told ways, for words alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

OF_TOURS: Final = "tours: "
"""How the lines of a budget begin that are not of drives."""


@dataclass(frozen=True)
class TourConfig:
    """How many tours, and how varied. The same numbers and seed give the same tours.

    But for a pixel here and there in those of a layout that was ended in between: a renderer draws what it has drawn
    before in the order in which it first did.
    What is called a share is the chance of each tour.
    """

    count: int = 0
    """0: none."""
    per_layout: int = 8
    people_most: int = 20
    """More people than these a scene never has: they hide what is spoken of, and take their time to be moved."""
    stray_share: float = 0.35
    """Tours that leave their way, as a rule for an opening near theirs, else for some other place, and come back."""
    stray_m: float = 8.0
    """So far they are carried to some other place at most."""
    linger_s: float = 5.0
    """A tour goes on for up to so long after it has arrived, half of it at least: on to the goal, where it stands."""

    def __post_init__(self) -> None:
        if not 0 <= self.count <= 1_000_000 or not 1 <= self.per_layout <= 100:
            raise ValueError(
                f"expected a count of 0 to 1000000 and per_layout of 1 to 100, found {self.count}, {self.per_layout}"
            )
        if not 0 <= self.people_most <= 200 or not 0 <= self.stray_share <= 1:
            raise ValueError("expected people_most from 0 to 200 and stray_share from 0 to 1")
        if not (1 <= self.stray_m <= 50 and 0 <= self.linger_s <= 60):
            raise ValueError("expected stray_m from 1 to 50 and linger_s from 0 to 60")
