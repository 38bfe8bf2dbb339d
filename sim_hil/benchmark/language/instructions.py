"""Grammar of instructions: generates thousands of wordings for a described route, all true of the scene.

A wording is opening + steps + stop in one of several orders, each part in many phrasings. `held_out` splits the
sentence patterns (the text without landmarks, sides and counts) into those of benchmark episodes and those of training;
the two are disjoint.
"""

from __future__ import annotations

import hashlib
import re

import numpy as np

from sim_hil.benchmark.language.instruction_words import AREAS, AROUND, NAME, ORDINALS
from sim_hil.benchmark.language.route import Passed, RouteDescription, Step

HELD_OUT_SHARE = 0.2  # share of the sentence patterns that is reserved for the benchmark
MAX_WORDS = 60  # maximum length of a wording, for small language models

_CORRIDOR = {
    "corridor": ("corridor", "hallway", "hall", "passage"),
    "aisle": ("aisle", "row"),
    "sidewalk": ("sidewalk", "pavement"),
}
_GO = ("go", "walk", "move", "drive", "head", "continue")
_TURN = ("turn", "go", "head", "bear")
_CROSSING = ("zebra crossing", "crosswalk")


class WordingError(ValueError):
    """A route without enough wordings; one line."""


class _Writer:
    """Random choices for one wording."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def pick(self, *choices: str) -> str:
        return choices[int(self.rng.integers(len(choices)))]

    def chance(self, share: float) -> bool:
        return bool(self.rng.uniform() < share)


def wordings(route: RouteDescription, count: int, seed: int, *, held_out: bool, first: str = "") -> list[str]:
    """Return `count` different wordings of a route, from the benchmark's patterns (`held_out`) or training's.

    `first`: how the robot must turn on the spot before the route begins, as `tasks.facing` gives it; training's
    wordings may leave it out in a room. Deterministic per seed. Raises WordingError if the grammar does not yield
    enough.
    """
    rng = np.random.default_rng((seed, 5))
    found: list[str] = []
    patterns: set[str] = set()
    for attempt in range(400 + 60 * count):
        text = _compose(_Writer(rng), route, first, told=held_out)
        if len(text.split()) > MAX_WORDS or is_held_out(text) != held_out or text in found:
            continue
        # Prefer a new pattern for each, because wordings that differ in one word add little.
        if pattern(text) in patterns and attempt < 200 + 30 * count:
            continue
        patterns.add(pattern(text))
        found.append(text)
        if len(found) == count:
            return found
    raise WordingError(f"{route.goal_name}: {len(found)} wordings found, {count} wanted")


def pattern(text: str) -> str:
    """Return the sentence without its landmarks, sides and counts."""
    bare = re.sub(NAME, "<thing>", text.lower())
    bare = re.sub(r"\b(left|right)\b", "<side>", bare)
    return re.sub(rf"\b({'|'.join(ORDINALS)})\b", "<count>", bare)


def is_held_out(text: str) -> bool:
    """Return whether a wording's pattern is reserved for the benchmark."""
    digest = hashlib.sha256(pattern(text).encode()).digest()
    return int.from_bytes(digest[:4], "big") < HELD_OUT_SHARE * 2**32


def _compose(w: _Writer, route: RouteDescription, first: str, *, told: bool) -> str:
    clauses = [*_turn_on_the_spot(w, route, first, told=told), *_steps(w, route)]
    goal = route.goal_bare if w.chance(0.5) else route.goal_name
    style = w.pick("route", "route", "route", "goal", "short")
    if style == "goal":
        opening = w.pick(
            f"find the {goal}", f"go to the {goal}", f"your goal is the {goal}", f"we need you at the {goal}",
            f"bring yourself to the {goal}", f"head for the {goal}",
        )  # fmt: skip
        end = w.pick("stop there", "stop when you get there", "wait there", f"stop at the {goal}")
        body = _joined(w, [*clauses, *_last_leg(w, route)])
        if not body:
            body = _straight(w, route.goal_area_kind, route.goal_area_name)
        after = ": " if first else w.pick(". ", ": ")  # a turn after "go to the bench." would come after the way there
        return _polite(w, f"{opening}{after}{body}{w.pick(' and ', ', then ', '. Then ')}{end}")
    stop = _stop(w, route, goal)
    if style == "short":
        parts = [*clauses, w.pick(f"stop at the {goal}", f"stop by the {goal}", f"then the {goal}")]
        return _sentence(
            ", ".join(parts)
            if len(parts) > 1
            else f"{_straight(w, route.goal_area_kind, route.goal_area_name)}, {parts[0]}"
        )
    rest = _last_leg(w, route) if w.chance(0.6) else []
    if not clauses and not rest:
        rest = [_straight(w, route.goal_area_kind, route.goal_area_name)]
    return _polite(w, f"{_joined(w, [*clauses, *rest])}{w.pick(' and ', ', then ', '. Then ', ', and ')}{stop}")


def _joined(w: _Writer, clauses: list[str]) -> str:
    text = ""
    for clause in clauses:
        glue = "" if not text else w.pick(", then ", ", ", ". Then ", ". ", " and then ", ". After that ", "; ")
        text += glue + clause
    return text


def _sentence(text: str) -> str:
    """Capitalise the sentences and add a full stop."""
    parts = re.split(r"(\. )", text.strip())
    text = "".join(part[:1].upper() + part[1:] if not part.startswith(". ") else part for part in parts)
    return text if text.endswith((".", "?", "!")) else text + "."


def _polite(w: _Writer, text: str) -> str:
    kind = w.pick("plain", "plain", "plain", "please", "robot", "could", "now")
    statement = text.startswith(("your goal", "we need", "at ", "when ", "where ")) or ". " in text or ": " in text
    if kind == "please" and not statement:
        return _sentence(f"please {text}" if w.chance(0.6) else f"{text}, please")
    if kind == "robot":
        return _sentence(f"{w.pick('robot', 'hey robot', 'hello')}, {text}")
    if kind == "could" and not statement:
        return _sentence(f"{w.pick('could you', 'would you', 'I want you to', 'you should')} {text}")
    if kind == "now":
        return _sentence(f"{w.pick('now', 'okay', 'all right')}, {text}")
    return _sentence(text)


def _noun(w: _Writer, kind: str, name: str) -> str:
    """Return a noun for the area that is followed."""
    if kind == "corridor" and name.endswith("aisle"):
        return name
    return w.pick(*_CORRIDOR.get(kind, (name,)))


def _straight(w: _Writer, kind: str, name: str = "") -> str:
    go = w.pick(*_GO)
    along = _noun(w, kind, name) if kind in _CORRIDOR else ""
    if along and w.chance(0.5):
        return w.pick(f"follow the {along}", f"{go} along the {along}", f"{go} down the {along}")
    return w.pick(f"{go} straight ahead", f"{go} straight on", f"{go} straight", f"{go} forward")


def _pass(w: _Writer, thing: Passed) -> str:
    beside = w.pick("on your", "on the")
    return w.pick(
        f"pass the {thing.name} {beside} {thing.side}", f"{w.pick(*_GO)} past the {thing.name} {beside} {thing.side}",
        f"keep the {thing.name} {beside} {thing.side}",
    )  # fmt: skip


def _last_leg(w: _Writer, route: RouteDescription) -> list[str]:
    """Return the clauses about the route after the last turn."""
    out = []
    if route.passed and w.chance(0.35):
        out.append(_pass(w, route.passed[int(w.rng.integers(len(route.passed)))]))
    elif route.last_m > 3.0 and w.chance(0.5):
        along = _noun(w, route.goal_area_kind, route.goal_area_name) if route.goal_area_kind in _CORRIDOR else ""
        if route.goal_at_end and along and w.chance(0.6):
            out.append(w.pick(f"go to the end of the {along}", f"follow the {along} to its end"))
        elif route.goal_area_kind in _CORRIDOR:
            out.append(_straight(w, route.goal_area_kind, route.goal_area_name))
    return out


def _stop(w: _Writer, route: RouteDescription, goal: str) -> str:
    side = ""
    if route.goal_side in ("left", "right") and w.chance(0.4):
        side = w.pick(f" on your {route.goal_side}", f" on the {route.goal_side}")
    goal += side
    return w.pick(
        f"stop at the {goal}", f"stop in front of the {goal}", f"stop next to the {goal}", f"stop by the {goal}",
        f"stop beside the {goal}", f"halt at the {goal}", f"wait at the {goal}", f"go to the {goal} and stop",
        f"go up to the {goal}", f"continue until you see the {goal} and stop there",
        f"keep going until you reach the {goal}", f"go on until you are at the {goal}",
        f"stop when you get to the {goal}", f"stop once you have reached the {goal}", f"come to a halt by the {goal}",
    )  # fmt: skip


def _turn_on_the_spot(w: _Writer, route: RouteDescription, first: str, *, told: bool) -> list[str]:
    """Return the clause by which the robot faces its route; unless `told`, it may be left out in a room."""
    if not first or (not told and route.leaves_room and (first != AROUND or w.chance(0.5))):
        return []
    if first == AROUND:
        return [w.pick("turn around", "turn round")]
    return [w.pick(f"turn {first} on the spot", f"turn on the spot to the {first}", f"turn to face {first}")]


def _steps(w: _Writer, route: RouteDescription) -> list[str]:
    out: list[str] = []
    for index, step in enumerate(route.steps):
        leave = index == 0 and route.leaves_room
        if leave:
            out.append(w.pick("leave the room", "go out of the room", "exit the room", "leave this room"))
        elif (passed := [thing for thing in step.passed if thing not in step.near]) and w.chance(0.3):
            out.append(_pass(w, passed[int(w.rng.integers(len(passed)))]))
        elif index == 0 and step.before_m > 3.0 and w.chance(0.4):
            out.append(_straight(w, step.before_kind, step.before_name))
        out.append(_step(w, step, leave))
    return out


def _step(w: _Writer, step: Step, leaving: bool) -> str:
    if step.kind == "crossing":
        return _cross(w, step)
    if step.side == "straight":
        return _ahead(w, step)
    modes = []
    if step.kind == "room" and step.before_kind != "room":
        modes = ["room"] * 2 + (["near_room"] if step.near else [])
    elif step.kind in ("lobby", "plaza", "yard"):
        modes = ["named"]
    elif leaving or step.before_kind in ("crossing", "plaza"):
        modes = ["plain"]
    elif step.kind == "corridor" and step.name in AREAS:
        modes = ["named"]
    else:
        if 0 < step.ordinal <= len(ORDINALS) - 1:
            modes += ["count"] * 3
        if step.at_end:
            modes += ["end"] * 3
        if step.near:
            modes += ["near"] * 2
    if not modes:
        raise WordingError("a turn that cannot be described")
    return {
        "room": _room, "near_room": _near_room, "named": _named, "plain": _plain, "count": _count, "end": _end,
        "near": _near,
    }[w.pick(*modes)](w, step)  # fmt: skip


def _count(w: _Writer, step: Step) -> str:
    count, side = ORDINALS[step.ordinal - 1], step.side
    noun = _noun(w, step.kind, step.name)
    beside = w.pick("on your", "on the", "to the", "to your")
    return w.pick(
        f"take the {count} {noun} {beside} {side}", f"turn {side} into the {count} {noun}",
        f"{w.pick(*_TURN)} {side} at the {count} {noun}", f"go into the {count} {noun} {beside} {side}",
        *((f"take the {count} {side}", f"take the {count} {side} turn", f"make the {count} {side} turn")
          if step.kind == "corridor" else (f"enter the {count} {noun} {beside} {side}",)),
    )  # fmt: skip


def _end(w: _Writer, step: Step) -> str:
    along = _noun(w, step.before_kind, step.before_name)
    turn = w.pick(*_TURN)
    return w.pick(
        f"{turn} {step.side} at the end of the {along}", f"at the end of the {along} {turn} {step.side}",
        f"go to the end of the {along} and {turn} {step.side}", f"where the {along} ends {turn} {step.side}",
    )  # fmt: skip


def _near(w: _Writer, step: Step) -> str:
    thing = step.near[int(w.rng.integers(len(step.near)))].name
    turn = w.pick(*_TURN)
    return w.pick(
        f"{turn} {step.side} at the {thing}", f"at the {thing} {turn} {step.side}",
        f"when you reach the {thing} {turn} {step.side}", f"{turn} {step.side} by the {thing}",
    )  # fmt: skip


def _room(w: _Writer, step: Step) -> str:
    if not 0 < step.ordinal <= len(ORDINALS):
        raise WordingError("a door that cannot be counted")
    count, side = ORDINALS[step.ordinal - 1], step.side
    beside = w.pick("on your", "on the")
    return w.pick(
        f"enter the {count} room {beside} {side}", f"go into the {count} room {beside} {side}",
        f"go through the {count} door {beside} {side}", f"take the {count} door {beside} {side}",
        f"turn {side} into the {count} room",
    )  # fmt: skip


def _near_room(w: _Writer, step: Step) -> str:
    thing = step.near[int(w.rng.integers(len(step.near)))].name
    return w.pick(
        f"enter the room on the {step.side} at the {thing}", f"at the {thing} enter the room on the {step.side}",
        f"at the {thing} turn {step.side} into the room",
    )  # fmt: skip


def _named(w: _Writer, step: Step) -> str:
    into = "onto" if step.kind == "plaza" else "into"
    return w.pick(
        f"turn {step.side} {into} the {step.name}", f"go {step.side} {into} the {step.name}",
        f"go {into} the {step.name} on the {step.side}", f"go {into} the {step.name} on your {step.side}",
    )  # fmt: skip


def _plain(w: _Writer, step: Step) -> str:
    along = _noun(w, step.kind, step.name)
    turn = w.pick(*_TURN)
    return w.pick(f"{turn} {step.side}", f"{turn} {step.side} along the {along}", f"{turn} to the {step.side}")


def _cross(w: _Writer, step: Step) -> str:
    zebra = w.pick(*_CROSSING)
    if step.side == "straight":
        return w.pick(
            f"cross the street at the {zebra}", f"cross the street on the {zebra}", f"go straight over the {zebra}",
        )  # fmt: skip
    count = ORDINALS[step.ordinal - 1] if 0 < step.ordinal <= len(ORDINALS) else ""
    if not count:
        raise WordingError("a crossing that cannot be counted")
    return w.pick(
        f"turn {step.side} at the {count} {zebra} and cross the street",
        f"cross the street to the {step.side} at the {count} {zebra}",
        f"take the {count} {zebra} on your {step.side} over the street",
    )  # fmt: skip


def _ahead(w: _Writer, step: Step) -> str:
    if step.kind == "room":
        return w.pick("go straight ahead into the room", "enter the room straight ahead")
    if step.kind in ("lobby", "plaza", "yard"):
        into = "onto" if step.kind == "plaza" else "into"
        return w.pick(f"go straight ahead {into} the {step.name}", f"go straight {into} the {step.name}")
    along = _noun(w, step.kind, step.name)
    return w.pick(f"go straight on along the {along}", f"keep straight along the {along}")
