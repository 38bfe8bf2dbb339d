"""The grammar of the reasoning text: its parts, how they are written and how they are read.

A text has six lines (aspects: paper, appendix B; the wording is ours):

    Situation: in a corridor, few people.
    Objects: vending machine left 6 m, doorway right 3 m.
    Motion: person ahead 2 m coming.
    Progress: turn 2 of 3, passed 1.
    Plan: wait, then turn left into the room in 3 m.
    waypoints: (1.2, 0.0) (2.4, 0.1) (3.6, 0.3)

Training writes its answers with `format_text`; the runner reads the model's texts with `parse_text`, which gives the
same parts back. The model's text is untrusted: it is never evaluated, and a part that does not match the grammar
counts as missing. The cost is bounded: at most `MAX_TEXT_CHARS` are read, and every expression matches in one way.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, TypeAlias, TypeVar

MAX_TEXT_CHARS = 4096
MAX_LINE_CHARS = len("waypoints: ") + 3 * len("(-99.99, -99.99) ") - 1
MAX_PROGRESS_CHARS = len("last leg of 99, passed 99.")
WAYPOINT_TIMES_S = (3.0, 6.0, 9.0)
FARTHEST_M = 99.9
"""Largest coordinate that is written, m; farther waypoints are clamped."""
MAX_COUNT = 99
"""Largest number of turns, and of passed openings."""
MAX_DISTANCE_M: Final = 99
"""Largest distance of an object, a person or a plan, m."""
MAX_ITEMS: Final = 8
"""Number of objects, and of people, that are read from one text."""

SITUATION_HEAD: Final = "Situation: "
OBJECTS_HEAD: Final = "Objects: "
PEOPLE_HEAD: Final = "Motion: "
PROGRESS_HEAD: Final = "Progress: "
PLAN_HEAD: Final = "Plan: "

LEFT, AHEAD, RIGHT = "left", "ahead", "right"
SIDES: Final = (LEFT, AHEAD, RIGHT)
MOTIONS: Final = ("coming", "leaving", "crossing left", "crossing right", "standing")
OPEN_AREA: Final = "open"
AREAS: Final = MappingProxyType(
    {
        "corridor": "in a corridor", "aisle": "in an aisle", "room": "in a room", "lobby": "in a lobby",
        "yard": "in a yard", "sidewalk": "on a sidewalk", "crossing": "on a crossing", "plaza": "on a plaza",
        "street": "on a street", OPEN_AREA: "in the open",
    }
)  # fmt: skip
"""Where the robot is: the phrase of each kind of area."""
CROWDS: Final = ("", ", few people", ", many people")
"""The phrase of each level of crowding."""
CROSSING: Final = "crossing"
ENTERED_AREAS: Final = ("corridor", "aisle", "room", "lobby", "yard", "sidewalk", "plaza")
"""Areas that a plan can turn into; a plan can also cross at a CROSSING."""

Waypoints: TypeAlias = tuple[tuple[float, float], ...]

_NO_OBJECT, _NO_PERSON = "none", "nobody near"
_WAIT = "wait, then "
_TURN_BACK = "turn back"
_NUMBER = r"(-?\d{1,2}\.\d{1,2})"
_POINT = rf"\({_NUMBER}, {_NUMBER}\)"
_WAYPOINTS = re.compile(rf"waypoints: {_POINT} {_POINT} {_POINT}", re.ASCII)
_COUNT = r"(0|[1-9]\d?)"
_TURN_PROGRESS = re.compile(rf"turn {_COUNT} of {_COUNT}, passed {_COUNT}\.", re.ASCII)
_LAST_LEG = re.compile(rf"last leg of {_COUNT}, passed 0\.", re.ASCII)
_NAME = re.compile(r"[A-Za-z][A-Za-z -]{2,40}", re.ASCII)
_METRES = r"([1-9]\d?) m"
_OBJECT = re.compile(rf"({_NAME.pattern}) ({'|'.join(SIDES)}) {_METRES}", re.ASCII)
_PERSON = re.compile(rf"person ({'|'.join(SIDES)}) {_METRES} ({'|'.join(MOTIONS)})", re.ASCII)
_WHEN = rf"(?:now|in {_METRES})"
_TURN = re.compile(rf"turn ({LEFT}|{RIGHT}) into the ({'|'.join(ENTERED_AREAS)}) {_WHEN}", re.ASCII)
_STRAIGHT = re.compile(rf"go straight to the ({'|'.join(ENTERED_AREAS)}) {_WHEN}", re.ASCII)
_CROSS = re.compile(rf"cross ({'|'.join(SIDES)}) {_WHEN}", re.ASCII)
_STOP = re.compile(rf"stop {_WHEN}", re.ASCII)

_Part = TypeVar("_Part")


def _require(holds: bool, what: str, found: object) -> None:
    if not holds:
        raise ValueError(f"{what}, found {found!r}")


@dataclass(frozen=True)
class Situation:
    """Kind of area around the robot, and how crowded it is."""

    area: str
    """A key of AREAS."""
    crowd: int = 0
    """Index into CROWDS."""

    def __post_init__(self) -> None:
        _require(self.area in AREAS, f"area must be one of {', '.join(AREAS)}", self.area)
        _require(0 <= self.crowd < len(CROWDS), f"crowd must be 0 to {len(CROWDS) - 1}", self.crowd)


@dataclass(frozen=True)
class SeenObject:
    """An object or an opening in view."""

    name: str
    """3 to 41 letters, spaces and hyphens, a letter first."""
    side: str
    distance_m: int

    def __post_init__(self) -> None:
        _require(_NAME.fullmatch(self.name) is not None, "name must be 3 to 41 letters, spaces and hyphens", self.name)
        _check_place(self.side, self.distance_m)


@dataclass(frozen=True)
class SeenPerson:
    """A person in view, and how the person moves over the ground as seen from the robot."""

    side: str
    distance_m: int
    motion: str
    """One of MOTIONS."""

    def __post_init__(self) -> None:
        _check_place(self.side, self.distance_m)
        _require(self.motion in MOTIONS, f"motion must be one of {', '.join(MOTIONS)}", self.motion)


def _check_place(side: str, distance_m: int) -> None:
    _require(side in SIDES, f"side must be one of {', '.join(SIDES)}", side)
    _require(1 <= distance_m <= MAX_DISTANCE_M, f"distance must be 1 to {MAX_DISTANCE_M} m", distance_m)


@dataclass(frozen=True)
class Progress:
    """How far along the route the robot is (the paper's "task progress", appendix B)."""

    step: int
    """Number of the next turn, from 1; `steps` + 1 on the last leg, when all turns are done."""
    steps: int
    """Number of turns of the route."""
    passed: int
    """Openings of the next turn's kind passed on its side since the last turn; 0 on the last leg."""

    def __post_init__(self) -> None:
        _require(0 <= self.steps <= MAX_COUNT, f"steps must be 0 to {MAX_COUNT}", self.steps)
        _require(1 <= self.step <= self.steps + 1, f"step must be 1 to {self.steps + 1} (the last leg)", self.step)
        most = 0 if self.is_last_leg else MAX_COUNT
        _require(0 <= self.passed <= most, f"passed must be 0 to {MAX_COUNT}, on the last leg 0", self.passed)

    @property
    def is_last_leg(self) -> bool:
        """Whether all turns are done."""
        return self.step > self.steps


@dataclass(frozen=True)
class Turn:
    """Enter an area on a side, go straight into it (AHEAD), or cross at a crossing."""

    side: str
    area: str
    """One of ENTERED_AREAS, or CROSSING."""
    distance_m: int
    """0: now."""

    def __post_init__(self) -> None:
        _require(self.side in SIDES, f"side must be one of {', '.join(SIDES)}", self.side)
        _require(self.area in (*ENTERED_AREAS, CROSSING), "area must be one that a plan can enter", self.area)
        _check_plan_distance(self.distance_m)


@dataclass(frozen=True)
class Stop:
    """Stop at the goal."""

    distance_m: int
    """0: now."""

    def __post_init__(self) -> None:
        _check_plan_distance(self.distance_m)


@dataclass(frozen=True)
class TurnBack:
    """Turn round: the robot has left the route."""


def _check_plan_distance(distance_m: int) -> None:
    _require(0 <= distance_m <= MAX_DISTANCE_M, f"distance must be 0 (now) to {MAX_DISTANCE_M} m", distance_m)


@dataclass(frozen=True)
class Plan:
    """What the robot does next."""

    action: Turn | Stop | TurnBack
    waits: bool = False
    """Whether the robot first lets a person pass; the waypoints still lead along the route."""


@dataclass(frozen=True)
class ReasoningText:
    """The parts of one text. None: the text lacks the part, or the part does not match the grammar."""

    situation: Situation | None = None
    objects: tuple[SeenObject, ...] | None = None
    """The most important first."""
    people: tuple[SeenPerson, ...] | None = None
    """The nearest first."""
    progress: Progress | None = None
    plan: Plan | None = None
    waypoints: Waypoints | None = None
    """(x m, y m) at 3, 6 and 9 s after the anchor, in the anchor's robot frame."""

    def __post_init__(self) -> None:
        for items in (self.objects, self.people):
            _require(items is None or len(items) <= MAX_ITEMS, f"expected at most {MAX_ITEMS} items", items)


def format_text(parts: ReasoningText) -> str:
    """Write one line for each part that there is."""
    lines: list[str] = []
    if parts.situation is not None:
        lines.append(f"{SITUATION_HEAD}{format_situation(parts.situation)}.")
    if parts.objects is not None:
        lines.append(f"{OBJECTS_HEAD}{format_objects(parts.objects)}.")
    if parts.people is not None:
        lines.append(f"{PEOPLE_HEAD}{format_people(parts.people)}.")
    if parts.progress is not None:
        lines.append(f"{PROGRESS_HEAD}{format_progress(parts.progress)}")
    if parts.plan is not None:
        lines.append(f"{PLAN_HEAD}{format_plan(parts.plan)}.")
    if parts.waypoints is not None:
        lines.append(format_waypoints(parts.waypoints))
    return "\n".join(lines)


def parse_text(text: str) -> ReasoningText:
    """Read each part from the one line that begins with its head, and the waypoints from the last line."""
    if len(text) > MAX_TEXT_CHARS:
        return ReasoningText()
    lines = text.split("\n")
    return ReasoningText(
        situation=_parse_line(lines, SITUATION_HEAD, parse_situation),
        objects=_parse_line(lines, OBJECTS_HEAD, parse_objects),
        people=_parse_line(lines, PEOPLE_HEAD, parse_people),
        progress=parse_progress(text),
        plan=_parse_line(lines, PLAN_HEAD, parse_plan),
        waypoints=parse_waypoints(text),
    )


def _only_line(lines: Sequence[str], head: str) -> str | None:
    """The line with this head, without the head; None for no such line or more than one."""
    found = [line[len(head) :] for line in lines if line.startswith(head)]
    return found[0] if len(found) == 1 else None


def _parse_line(lines: Sequence[str], head: str, parse: Callable[[str], _Part | None]) -> _Part | None:
    phrase = _only_line(lines, head)
    return None if phrase is None or not phrase.endswith(".") else parse(phrase[:-1])


def format_situation(situation: Situation) -> str:
    """Write a situation: "in a corridor, few people"."""
    return AREAS[situation.area] + CROWDS[situation.crowd]


def parse_situation(phrase: str) -> Situation | None:
    """Read what `format_situation` writes."""
    place, comma, crowd = phrase.partition(",")
    area = next((area for area, known in AREAS.items() if known == place), None)
    return Situation(area, CROWDS.index(comma + crowd)) if area is not None and comma + crowd in CROWDS else None


def format_objects(objects: Sequence[SeenObject]) -> str:
    """Write objects in view: "vending machine left 6 m, doorway right 3 m", or "none"."""
    return ", ".join(f"{seen.name} {seen.side} {seen.distance_m} m" for seen in objects) or _NO_OBJECT


def parse_objects(phrase: str) -> tuple[SeenObject, ...]:
    """Read the first MAX_ITEMS objects of a phrase; items that do not match the grammar are left out."""
    found = (_OBJECT.fullmatch(item) for item in phrase.split(", ")[:MAX_ITEMS])
    return tuple(SeenObject(match[1], match[2], int(match[3])) for match in found if match is not None)


def format_people(people: Sequence[SeenPerson]) -> str:
    """Write people in view: "person ahead 2 m coming", or "nobody near"."""
    return ", ".join(f"person {seen.side} {seen.distance_m} m {seen.motion}" for seen in people) or _NO_PERSON


def parse_people(phrase: str) -> tuple[SeenPerson, ...]:
    """Read the first MAX_ITEMS people of a phrase; items that do not match the grammar are left out."""
    found = (_PERSON.fullmatch(item) for item in phrase.split(", ")[:MAX_ITEMS])
    return tuple(SeenPerson(match[1], int(match[2]), match[3]) for match in found if match is not None)


def format_progress(progress: Progress) -> str:
    """Write progress with its full stop: "turn 2 of 3, passed 1." or "last leg of 3, passed 0."."""
    if progress.is_last_leg:
        return f"last leg of {progress.steps}, passed 0."
    return f"turn {progress.step} of {progress.steps}, passed {progress.passed}."


def parse_progress(text: str) -> Progress | None:
    """Read the text's `Progress:` line; None without one, with two, or for one that does not match the grammar."""
    if len(text) > MAX_TEXT_CHARS:
        return None
    phrase = _only_line(text.split("\n"), PROGRESS_HEAD)
    if phrase is None or len(phrase) > MAX_PROGRESS_CHARS:
        return None
    if (turn := _TURN_PROGRESS.fullmatch(phrase)) is not None:
        step, steps, passed = (int(group) for group in turn.groups())
        return Progress(step, steps, passed) if 1 <= step <= steps else None
    if (last := _LAST_LEG.fullmatch(phrase)) is not None:
        steps = int(last[1])
        return Progress(steps + 1, steps, 0)
    return None


def format_plan(plan: Plan) -> str:
    """Write a plan: "wait, then turn left into the room in 3 m"; at distance 0 "now"."""
    action = plan.action
    if isinstance(action, TurnBack):
        phrase = _TURN_BACK
    else:
        when = f"in {action.distance_m} m" if action.distance_m else "now"
        if isinstance(action, Stop):
            phrase = f"stop {when}"
        elif action.area == CROSSING:
            phrase = f"cross {action.side} {when}"
        elif action.side == AHEAD:
            phrase = f"go straight to the {action.area} {when}"
        else:
            phrase = f"turn {action.side} into the {action.area} {when}"
    return (_WAIT if plan.waits else "") + phrase


def parse_plan(phrase: str) -> Plan | None:
    """Read what `format_plan` writes."""
    waits = phrase.startswith(_WAIT)
    action = _parse_action(phrase.removeprefix(_WAIT))
    return None if action is None else Plan(action, waits)


def _parse_action(phrase: str) -> Turn | Stop | TurnBack | None:
    if phrase == _TURN_BACK:
        return TurnBack()
    if (stop := _STOP.fullmatch(phrase)) is not None:
        return Stop(int(stop[1] or 0))
    if (turn := _TURN.fullmatch(phrase)) is not None:
        return Turn(turn[1], turn[2], int(turn[3] or 0))
    if (straight := _STRAIGHT.fullmatch(phrase)) is not None:
        return Turn(AHEAD, straight[1], int(straight[2] or 0))
    if (cross := _CROSS.fullmatch(phrase)) is not None:
        return Turn(cross[1], CROSSING, int(cross[2] or 0))
    return None


def plans_to_wait(text: str) -> bool:
    """Whether a plan begins with waiting, even where the rest of it does not match the grammar."""
    return any(line.startswith(PLAN_HEAD + _WAIT) for line in text[:MAX_TEXT_CHARS].split("\n"))


def format_waypoints(waypoints: Waypoints) -> str:
    """Write the waypoint line, with one decimal."""
    return "waypoints: " + " ".join(f"({_tenths(x)}, {_tenths(y)})" for x, y in waypoints)


def parse_waypoints(text: str) -> Waypoints | None:
    """Read the waypoints from the text's last line, with one or two decimals; None for any other last line."""
    if len(text) > MAX_TEXT_CHARS:
        return None
    line = text.rstrip("\n").rsplit("\n", 1)[-1]
    match = _WAYPOINTS.fullmatch(line) if len(line) <= MAX_LINE_CHARS else None
    if match is None:
        return None
    values = [float(group) for group in match.groups()]
    return tuple(zip(values[::2], values[1::2], strict=True))


def _tenths(value: float) -> str:
    """One decimal, without a negative zero, and no more digits than are read."""
    return f"{round(min(max(value, -FARTHEST_M), FARTHEST_M), 1) + 0.0:.1f}"
