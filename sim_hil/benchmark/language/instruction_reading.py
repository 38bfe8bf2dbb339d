"""Parser of instructions into claims (turns, counts, passed landmarks, goal), and their check against a route.

It is independent of the grammar that generates instructions. Unreadable sentences and omitted turns are problems too.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from sim_hil.benchmark.language.instruction_words import AREAS, AROUND, NAME, ORDINALS
from sim_hil.benchmark.language.openings import opening_class
from sim_hil.benchmark.language.route import RouteDescription, Step

_TURN = "(?:turn|go|head|bear)"
_CORRIDOR = "(?:(?:main|cross|back) aisle|corridor|hallway|hall|passage|aisle|row|sidewalk|pavement)"
_ZEBRA = "(?:zebra crossing|crosswalk)"
_SIDE = "(left|right)"
_COUNT = f"({'|'.join(ORDINALS)})"
_AREA = f"({'|'.join(AREAS)})"
_NAME = f"({NAME})"
_BESIDE = "(?:on|to) (?:the|your)"


@dataclass(frozen=True)
class Claim:
    """One claim of a sentence; `kind`: face, turn, cross, pass, leave, end or goal; missing details are "" or 0."""

    kind: str
    side: str = ""
    ordinal: int = 0
    noun: str = ""
    name: str = ""
    at_end: bool = False


# In the order in which they are tried: s = side, c = count, n = object, a = area.
_PATTERNS: tuple[tuple[str, str, str], ...] = (
    ("face", rf"turn {_SIDE} on the spot", "s"),
    ("face", rf"turn on the spot to the {_SIDE}", "s"),
    ("face", rf"turn to face {_SIDE}", "s"),
    ("around", r"turn (?:around|round)", ""),
    ("pass", rf"(?:pass|past|keep) the {_NAME} on (?:the|your) {_SIDE}", "ns"),
    ("turn end", rf"{_TURN} {_SIDE} at the end of the {_CORRIDOR}", "s"),
    ("turn end", rf"at the end of the {_CORRIDOR} {_TURN} {_SIDE}", "s"),
    ("turn end", rf"go to the end of the {_CORRIDOR} and {_TURN} {_SIDE}", "s"),
    ("turn end", rf"where the {_CORRIDOR} ends {_TURN} {_SIDE}", "s"),
    ("turn room", rf"enter the room on the {_SIDE} at the {_NAME}", "sn"),
    ("turn room", rf"at the {_NAME} enter the room on the {_SIDE}", "ns"),
    ("turn room", rf"at the {_NAME} turn {_SIDE} into the room", "ns"),
    ("cross", rf"turn {_SIDE} at the {_COUNT} {_ZEBRA} and cross the street", "sc"),
    ("cross", rf"cross the street to the {_SIDE} at the {_COUNT} {_ZEBRA}", "sc"),
    ("cross", rf"take the {_COUNT} {_ZEBRA} on your {_SIDE} over the street", "cs"),
    ("cross", rf"cross the street (?:at|on) the {_ZEBRA}", ""),
    ("cross", rf"go straight over the {_ZEBRA}", ""),
    ("turn room", rf"(?:enter|go into|go through|take) the {_COUNT} (?:room|door) on (?:your|the) {_SIDE}", "cs"),
    ("turn room", rf"turn {_SIDE} into the {_COUNT} room", "sc"),
    ("turn passage", rf"(?:take|enter|go into) the {_COUNT} {_CORRIDOR} {_BESIDE} {_SIDE}", "cs"),
    ("turn passage", rf"{_TURN} {_SIDE} (?:into|at) the {_COUNT} {_CORRIDOR}", "sc"),
    ("turn passage", rf"(?:take|make) the {_COUNT} {_SIDE}(?: turn)?", "cs"),
    ("turn named", rf"(?:turn|go) {_SIDE} (?:into|onto) the {_AREA}", "sa"),
    ("turn named", rf"go (?:into|onto) the {_AREA} on (?:the|your) {_SIDE}", "as"),
    ("straight named", rf"go straight(?: ahead)? (?:into|onto) the {_AREA}", "a"),
    ("straight room", r"go straight ahead into the room|enter the room straight ahead", ""),
    ("turn", rf"{_TURN} {_SIDE} (?:at|by) the {_NAME}", "sn"),
    ("turn", rf"(?:at|when you reach) the {_NAME} {_TURN} {_SIDE}", "ns"),
    ("turn", rf"{_TURN} (?:to the )?{_SIDE}(?: along the {_CORRIDOR})?", "s"),
    ("leave", r"(?:leave|exit|go out of) (?:the|this) room", ""),
    ("end", rf"go to the end of the {_CORRIDOR}|follow the {_CORRIDOR} to its end", ""),
    ("goal", rf"the {_NAME}(?: on (?:the|your) {_SIDE})?", "ns"),
)
_MASTER = re.compile("|".join(f"(?P<p{i}>{text})" for i, (_, text, _) in enumerate(_PATTERNS)))
# Words that determine the route; none may remain once the claims are removed.
_LEFTOVER = re.compile(rf"\b(?:left|right|{'|'.join(ORDINALS)}|{_ZEBRA})\b|{NAME}")


def read(text: str) -> list[Claim]:
    """Parse an instruction into its claims, in order. Raises ValueError if a part cannot be read."""
    lower = re.sub(r"\ball right\b", "okay", text.lower())
    found, rest = [], lower
    for match in _MASTER.finditer(lower):
        index = int(str(match.lastgroup)[1:]) if match.lastgroup else -1
        kind, pattern, order = _PATTERNS[index]
        inner = re.fullmatch(pattern, match.group())
        if inner is None:
            raise ValueError(f"cannot be read: {match.group()!r}")
        values = dict(zip(order, inner.groups(), strict=True))
        found.append(_claim(kind, values))
        rest = rest.replace(match.group(), " ", 1)
    if left := _LEFTOVER.search(rest):
        raise ValueError(f"cannot be read: {left.group()!r} in {text!r}")
    return found


def _claim(kind: str, values: dict[str, str | None]) -> Claim:
    verb, _, detail = kind.partition(" ")
    count = values.get("c")
    name = values.get("n") or values.get("a") or ""
    side = values.get("s") or {"straight": "straight", "cross": "straight", "around": AROUND}.get(verb, "")
    return Claim(
        {"straight": "turn", "around": "face"}.get(verb, verb),
        side,
        ORDINALS.index(count) + 1 if count else 0,
        detail if detail not in ("end", "") else "",
        name,
        detail == "end",
    )


def untrue(text: str, route: RouteDescription, first: str = "") -> list[str]:
    """Return the false or missing claims of an instruction about a route, one line each; empty if it is correct.

    `first`: how the robot must turn on the spot before the route begins (`tasks.facing`).
    """
    try:
        claims = read(text)
    except ValueError as error:
        return [str(error)]
    problems: list[str] = []
    steps = [s for s in route.steps if not (s.side == "straight" and s.kind in ("sidewalk", "corridor", "aisle"))]
    taken = 0
    if first and not route.leaves_room and not any(claim.kind == "face" for claim in claims):
        problems.append(f"does not say that the robot must turn {first} on the spot")
    for claim in claims:
        if claim.kind == "face" and claim.side != first:
            problems.append(f"turn on the spot: expected {first or 'none'}, found {claim.side}")
        elif claim.kind in ("turn", "cross"):
            if taken >= len(steps):
                problems.append(f"one turn too many: {claim.side}")
                continue
            problems += _wrong_step(claim, steps[taken])
            taken += 1
        elif claim.kind == "pass":
            problems += _wrong_pass(claim, route, steps, taken)
        elif claim.kind == "leave" and not route.leaves_room:
            problems.append("leaves a room, but the start is in none")
        elif claim.kind == "end" and not (taken == len(steps) and route.goal_at_end):
            problems.append("goes to the end, but the goal is not there")
        elif claim.kind == "goal":
            if claim.name not in (route.goal_name, route.goal_bare):
                problems.append(f"goal: expected {route.goal_name}, found {claim.name}")
            if claim.side and claim.side != route.goal_side:
                problems.append(f"side of the goal: expected {route.goal_side or 'none'}, found {claim.side}")
    if taken < len(steps):
        problems.append(f"leaves out {len(steps) - taken} of {len(steps)} turns")
    if not any(claim.kind == "goal" for claim in claims):
        problems.append("names no goal")
    return problems


def _wrong_step(claim: Claim, step: Step) -> list[str]:
    where = f"turn into the {step.name}"
    if (claim.kind == "cross") != (step.kind == "crossing"):
        return [f"{where}: expected {step.kind}, found {claim.kind}"]
    if claim.side != step.side:
        return [f"{where}: expected {step.side}, found {claim.side}"]
    found = []
    if claim.ordinal and claim.ordinal != step.ordinal:
        found.append(f"{where}: expected number {step.ordinal}, found {claim.ordinal}")
    if claim.at_end and not step.at_end:
        found.append(f"{where}: is not at the end")
    if claim.noun == "named":
        if claim.name != step.name:
            found.append(f"{where}: found {claim.name}")
    elif claim.noun and claim.noun != _counted_as(step.kind):
        found.append(f"{where}: expected {step.kind}, found {claim.noun}")
    elif claim.name and claim.name not in [thing.name for thing in step.near]:
        found.append(f"{where}: the {claim.name} does not mark it")
    # A turn without count, end or landmark must be the only possible one: out of a room, or off a crossing.
    bare = not (claim.ordinal or claim.at_end or claim.name or claim.noun)
    if claim.kind == "turn" and bare and step.before_kind not in ("room", "crossing", "plaza"):
        found.append(f"{where}: is ambiguous")
    return found


def _counted_as(kind: str) -> str:
    """Return the class of a noun; a sidewalk that branches off counts as a passage."""
    return "passage" if kind == "sidewalk" else opening_class(kind)


def _wrong_pass(claim: Claim, route: RouteDescription, steps: list[Step], taken: int) -> list[str]:
    """Check that a landmark is passed on the next segment, or on one that continues straight from it."""
    stretches = [route.passed] if taken >= len(steps) else [steps[taken].passed]
    index = route.steps.index(steps[taken]) if taken < len(steps) else len(route.steps)
    while index > 0 and route.steps[index - 1].side == "straight" and route.steps[index - 1] not in steps:
        index -= 1
        stretches.append(route.steps[index].passed)
    for stretch in stretches:
        for thing in stretch:
            if thing.name == claim.name:
                return [] if thing.side == claim.side else [f"passes the {claim.name} on the {thing.side}"]
    return [f"does not pass the {claim.name} there"]
