"""The words of reasoning traces: phrases for places, things, people and plans, and every sentence that they can make.

A trace has five lines (paper appendix B); each is a few canonical words, so that a small model can learn to say them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import Any, Final

from edge.state.reasoning_text import PLAN_HEAD, PROGRESS_HEAD, WAIT, Progress, format_progress, format_waypoints

SITUATION, OBJECTS, MOTION = "Situation: ", "Objects: ", "Motion: "
MAX_WORDS: Final = 45  # of the five lines together
MAX_RANGE_M: Final = 30
MAX_THINGS: Final = 3
MAX_PEOPLE: Final = 2
SIDES: Final = ("left", "ahead", "right")
WAYS: Final = ("coming", "leaving", "crossing left", "crossing right", "standing")
AREAS: Final = MappingProxyType(
    {
        "corridor": "in a corridor", "aisle": "in an aisle", "room": "in a room", "lobby": "in a lobby",
        "yard": "in a yard", "sidewalk": "on a sidewalk", "crossing": "on a crossing", "plaza": "on a plaza",
        "street": "on a street",
    }
)  # fmt: skip
NO_AREA: Final = "in the open"
CROWDS: Final = ("", ", few people", ", many people")
OPENINGS: Final = MappingProxyType({"room": "doorway", "crossing": "crossing"})
OPENING: Final = "opening"  # of every other kind
NOTHING, NOBODY = "none", "nobody near"
_INTO: Final = MappingProxyType(
    {
        "corridor": "corridor", "aisle": "aisle", "room": "room", "lobby": "lobby", "yard": "yard",
        "sidewalk": "sidewalk", "plaza": "plaza",
    }
)  # fmt: skip


def distance(metres: float) -> str:
    """Whole metres, 1 to 30: "3 m"."""
    return f"{min(max(round(metres), 1), MAX_RANGE_M)} m"


def opening(kind: str) -> str:
    """What an opening into an area of a kind is called."""
    return OPENINGS.get(kind, OPENING)


def seen(name: str, side: str, metres: float) -> str:
    """A thing in view: "vending machine left 6 m"."""
    return f"{name} {side} {distance(metres)}"


def person(side: str, metres: float, way: str) -> str:
    """Somebody in view: "person ahead 2 m coming"."""
    return f"person {side} {distance(metres)} {way}"


def turn(side: str, kind: str, metres: float) -> str:
    """The next step: "turn left into the room in 3 m"; near it "now"."""
    when = "now" if metres < 1.0 else f"in {distance(metres)}"
    if kind == "crossing":
        return f"cross {'ahead' if side == 'straight' else side} {when}"
    if side == "straight":
        return f"go straight to the {_INTO[kind]} {when}"
    return f"turn {side} into the {_INTO[kind]} {when}"


def stop(metres: float) -> str:
    """The end: "stop in 6 m"."""
    return "stop now" if metres < 1.0 else f"stop in {distance(metres)}"


TURN_BACK: Final = "turn back"


@dataclass(frozen=True)
class Trace:
    """The five aspects of one instant (paper appendix B), each in canonical words without its head and full stop."""

    situation: str
    objects: str
    motion: str
    progress: Progress
    plan: str

    def __post_init__(self) -> None:
        if (count := len(self.reasoning().split())) > MAX_WORDS:
            raise ValueError(f"trace: expected at most {MAX_WORDS} words, found {count}: {self.reasoning()!r}")

    @classmethod
    def of(
        cls, situation: str, objects: Sequence[str], motion: Sequence[str], progress: Progress, plan: str
    ) -> Trace:  # fmt: skip
        """From lists of things and people, the most important first; things for which there is no room are left out."""
        moving = ", ".join(motion) or NOBODY
        for count in range(len(objects), 0, -1):
            said = ", ".join(objects[:count])
            if len(_lines(situation, said, moving, progress, plan).split()) <= MAX_WORDS:
                return cls(situation, said, moving, progress, plan)
        return cls(situation, NOTHING, moving, progress, plan)

    def reasoning(self) -> str:
        """The five lines."""
        return _lines(self.situation, self.objects, self.motion, self.progress, self.plan)

    def text(self, waypoints: Sequence[tuple[float, float]]) -> str:
        """The five lines and the waypoints' (x, y), m, at 3, 6 and 9 s: what the model is to answer."""
        return f"{self.reasoning()}\n{format_waypoints(tuple(waypoints))}"

    def to_json(self) -> dict[str, object]:
        """For a drive's header."""
        return asdict(self)

    @classmethod
    def from_json(cls, table: Mapping[str, Any]) -> Trace:
        """What `to_json` wrote; other keys (a frame's number) are left alone. Raises ValueError, KeyError."""
        said = {name: str(table[name]) for name in ("situation", "objects", "motion", "plan")}
        progress = table["progress"]
        return cls(**said, progress=Progress(progress["step"], progress["steps"], progress["passed"]))


def _lines(situation: str, objects: str, motion: str, progress: Progress, plan: str) -> str:
    return "\n".join(
        (
            f"{SITUATION}{situation}.", f"{OBJECTS}{objects}.", f"{MOTION}{motion}.",
            f"{PROGRESS_HEAD}{format_progress(progress)}", f"{PLAN_HEAD}{plan}.",
        )
    )  # fmt: skip


def landmarks() -> list[str]:
    """Names of all things that a trace may speak of: every kind's own words, with and without each colour."""
    # Here: whoever only reads traces needs no simulator.
    from sim_hil.benchmark.language.instruction_words import NOUNS
    from sim_hil.benchmark.language.route import COLOUR_WORDS

    return [*sorted(NOUNS), *(f"{colour} {noun}" for noun in sorted(NOUNS) for colour in sorted(COLOUR_WORDS))]


def corpus() -> Iterator[str]:
    """Texts with every phrase, number and sentence form that traces can hold, for a tokenizer; always the same."""
    situations = [f"{place}{crowd}" for place in (*AREAS.values(), NO_AREA) for crowd in CROWDS]
    metres = list(range(1, MAX_RANGE_M + 1))
    things = [*landmarks(), *sorted(set(OPENINGS.values())), OPENING]
    plans = [turn(side, kind, m) for m in (0, *metres) for side in ("left", "right", "straight")
             for kind in (*_INTO, "crossing")] + [stop(m) for m in (0, *metres)] + [TURN_BACK]  # fmt: skip
    people = [person(side, m, way) for m in metres for side in SIDES for way in WAYS]
    steps = [Progress(k, n, m) for n in range(1, 7) for k in range(1, n + 1) for m in range(9)]
    steps += [Progress(n + 1, n, 0) for n in range(7)]
    for i in range(max(len(things), len(plans), len(people), len(steps))):
        objects = [
            seen(things[(i + 7 * j) % len(things)], SIDES[(i + j) % 3], metres[(7 * i + 11 * j) % MAX_RANGE_M])
            for j in range(1 + i % MAX_THINGS)
        ]
        motion = [people[(i + 7 * j) % len(people)] for j in range(1 + i % MAX_PEOPLE)]
        plan = plans[i % len(plans)]
        situation, progress = situations[i % len(situations)], steps[i % len(steps)]
        x, y = (i * 37 % 91) / 10, ((i * 53) % 121 - 60) / 10
        waypoints = ((x / 3, y / 9), (2 * x / 3, y / 3), (x, y))
        yield Trace.of(situation, objects, motion, progress, plan).text(waypoints)
        if i % 5 == 4:
            yield Trace.of(situation, [], [], progress, f"{WAIT}{plan}").text(waypoints)
