"""The words of instructions: counts and names of things, as a pattern that finds them in a sentence."""

from __future__ import annotations

from sim_hil.benchmark.language.route import COLOUR_WORDS
from sim_hil.scene.scene import KINDS

# Areas that are called by their names rather than counted.
AREAS = (
    "reception", "waiting area", "service area", "open office", "elevator lobby", "loading area", "main aisle",
    "back aisle", "plaza", "park",
)  # fmt: skip
ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth")
# What landmarks may be called: every kind's own name, and what a scene's maker calls them besides.
NOUNS = tuple(
    sorted({kind.words for kind in KINDS.values()} | {"exit door", "desk", "umbrella"}, key=len, reverse=True)
)
NAME = rf"\b(?:(?:{'|'.join(sorted(COLOUR_WORDS))}) )?(?:{'|'.join(NOUNS)})\b"
