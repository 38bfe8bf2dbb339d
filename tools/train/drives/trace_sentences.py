"""The reasoning texts that training writes: how long they may be, their file format, and a corpus of all phrases.

The grammar itself is `edge.state.reasoning_text`, which the runner reads the model's texts with.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any, Final

from edge.state.reasoning_text import (
    AHEAD,
    AREAS,
    CROSSING,
    CROWDS,
    ENTERED_AREAS,
    LEFT,
    MOTIONS,
    RIGHT,
    SIDES,
    Plan,
    Progress,
    ReasoningText,
    SeenObject,
    SeenPerson,
    Situation,
    Stop,
    Turn,
    TurnBack,
    format_objects,
    format_people,
    format_plan,
    format_situation,
    format_text,
    parse_objects,
    parse_people,
    parse_plan,
    parse_situation,
)

MAX_WORDS: Final = 45
"""Words of the five aspects together."""
MAX_RANGE_M: Final = 30
MAX_OBJECTS: Final = 3
MAX_PEOPLE: Final = 2
OPENINGS: Final = {"room": "doorway", CROSSING: "crossing"}
OPENING: Final = "opening"
"""Name of an opening into any other kind of area."""
NO_OBJECTS: Final = format_objects(())
NO_PEOPLE: Final = format_people(())


def whole_metres(metres: float) -> int:
    """Round a distance to 1 to 30 m."""
    return min(max(round(metres), 1), MAX_RANGE_M)


def plan_metres(metres: float) -> int:
    """Round a plan's distance to 0 (now: nearer than 1 m) to 30 m."""
    return 0 if metres < 1.0 else whole_metres(metres)


def opening_name(kind: str) -> str:
    """Return the name of an opening into an area of a kind."""
    return OPENINGS.get(kind, OPENING)


def five_aspects(
    situation: Situation, objects: Sequence[SeenObject], people: Sequence[SeenPerson], progress: Progress, plan: Plan
) -> ReasoningText:
    """Put the aspects together; objects beyond MAX_WORDS are left out, the last ones first. Raises ValueError."""
    for count in range(len(objects), -1, -1):
        text = ReasoningText(situation, tuple(objects[:count]), tuple(people), progress, plan)
        if len(format_text(text).split()) <= MAX_WORDS:
            return text
    raise ValueError(f"reasoning text: expected at most {MAX_WORDS} words, found {format_text(text)!r}")


def aspects_json(text: ReasoningText) -> dict[str, Any]:
    """Return the five aspects as a drive's header holds them. Raises ValueError when one is missing."""
    if text.situation is None or text.objects is None or text.people is None or not text.progress or not text.plan:
        raise ValueError(f"reasoning text: expected all five aspects, found {format_text(text)!r}")
    return {
        "situation": format_situation(text.situation),
        "objects": format_objects(text.objects),
        "motion": format_people(text.people),
        "progress": asdict(text.progress),
        "plan": format_plan(text.plan),
    }


def aspects_of_json(table: Mapping[str, Any]) -> ReasoningText:
    """Read what `aspects_json` wrote; other keys, such as the frame's number, are left alone.

    Raises ValueError for an aspect that does not match the grammar, KeyError for a missing one.
    """
    phrases = {name: str(table[name]) for name in ("situation", "objects", "motion", "plan")}
    progress = table["progress"]
    text = ReasoningText(
        parse_situation(phrases["situation"]),
        parse_objects(phrases["objects"]),
        parse_people(phrases["motion"]),
        Progress(progress["step"], progress["steps"], progress["passed"]),
        parse_plan(phrases["plan"]),
    )
    for name, given in (("situation", text.situation), ("plan", text.plan)):
        if given is None:
            raise ValueError(f"{name} {phrases[name]!r}: does not match the grammar of edge/state/reasoning_text.py")
    again = aspects_json(text)
    for name in ("objects", "motion"):
        if again[name] != phrases[name]:
            raise ValueError(f"{name} {phrases[name]!r}: does not match the grammar of edge/state/reasoning_text.py")
    if len(format_text(text).split()) > MAX_WORDS:
        raise ValueError(f"reasoning text: expected at most {MAX_WORDS} words, found {format_text(text)!r}")
    return text


def landmarks() -> list[str]:
    """Return the names of all objects that a text may name: each kind's noun, with and without each colour."""
    # Imported here: code that only reads drives needs no simulator.
    from sim_hil.benchmark.language.instruction_words import COLOUR_WORDS, NOUNS

    return [*sorted(NOUNS), *(f"{colour} {noun}" for noun in sorted(NOUNS) for colour in sorted(COLOUR_WORDS))]


def corpus() -> Iterator[str]:
    """Yield texts with every phrase, number and sentence form of the grammar, for a tokenizer; always the same."""
    situations = [Situation(area, crowd) for area in AREAS for crowd in range(len(CROWDS))]
    metres = list(range(1, MAX_RANGE_M + 1))
    names = [*landmarks(), *sorted(OPENINGS.values()), OPENING]
    plans = [
        *(Plan(Turn(side, area, m)) for m in (0, *metres) for side in (LEFT, RIGHT, AHEAD)
          for area in (*ENTERED_AREAS, CROSSING)),
        *(Plan(Stop(m)) for m in (0, *metres)),
        Plan(TurnBack()),
    ]  # fmt: skip
    people = [SeenPerson(side, m, motion) for m in metres for side in SIDES for motion in MOTIONS]
    steps = [Progress(k, n, m) for n in range(1, 7) for k in range(1, n + 1) for m in range(9)]
    steps += [Progress(n + 1, n, 0) for n in range(7)]
    for i in range(max(len(names), len(plans), len(people), len(steps))):
        objects = [
            SeenObject(names[(i + 7 * j) % len(names)], SIDES[(i + j) % 3], metres[(7 * i + 11 * j) % MAX_RANGE_M])
            for j in range(1 + i % MAX_OBJECTS)
        ]
        near = [people[(i + 7 * j) % len(people)] for j in range(1 + i % MAX_PEOPLE)]
        situation, progress, plan = situations[i % len(situations)], steps[i % len(steps)], plans[i % len(plans)]
        x, y = (i * 37 % 91) / 10, ((i * 53) % 121 - 60) / 10
        waypoints = ((x / 3, y / 9), (2 * x / 3, y / 3), (x, y))
        text = five_aspects(situation, objects, near, progress, plan)
        yield format_text(replace(text, waypoints=waypoints))
        if i % 5 == 4:
            waiting = five_aspects(situation, [], [], progress, replace(plan, waits=True))
            yield format_text(replace(waiting, waypoints=waypoints))
