"""Vocabulary of instructions: ordinals and names of objects, also as a pattern."""

from __future__ import annotations

from sim_hil.scene.scene import KINDS

# Areas that instructions refer to by name instead of by count.
AREAS = (
    "reception", "waiting area", "service area", "open office", "elevator lobby", "loading area", "main aisle",
    "back aisle", "plaza", "park",
)  # fmt: skip
COLOUR_WORDS = frozenset(
    ("red", "blue", "green", "yellow", "orange", "purple", "white", "black", "brown", "pink", "grey")
)
AROUND = "around"
"""The turn on the spot before a route that begins behind the robot; before others it is a side, or "" if ahead."""
ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth")
# Names of landmarks: those of all kinds, and additional names used in scenes.
NOUNS = tuple(sorted({kind.noun for kind in KINDS.values()} | {"exit door", "desk", "umbrella"}, key=len, reverse=True))
NAME = rf"\b(?:(?:{'|'.join(sorted(COLOUR_WORDS))}) )?(?:{'|'.join(NOUNS)})\b"
