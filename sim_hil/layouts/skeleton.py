"""Skeleton of a building: two long corridors, cross corridors between them, dead ends, and rows of rooms."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

from sim_hil.layouts.builder import Builder, Room
from sim_hil.layouts.plan import LayoutError, Rect, Vec2


@dataclass(frozen=True)
class Bones:
    """Ranges (low, high), m, of a building's random dimensions."""

    length_m: Vec2
    corridor_m: Vec2  # width
    outer_row_m: Vec2  # depth of the rows of rooms along the outside
    inner_row_m: Vec2  # depth of each of the two rows back to back between the corridors
    room_m: Vec2  # width of a room along its corridor
    cross: tuple[int, int]  # number of cross corridors, from and to
    stubs: tuple[int, int]  # number of dead-end corridors to the outside
    door_m: float
    corridor_floor: str


@dataclass
class Building:
    """Rooms of a skeleton by type; `slots` are rooms without a purpose yet, with their corridor."""

    builder: Builder
    long: list[Room] = field(default_factory=list)
    cross: list[Room] = field(default_factory=list)
    stubs: list[Room] = field(default_factory=list)
    slots: list[tuple[Rect, Room]] = field(default_factory=list)


def raise_bones(builder: Builder, bones: Bones) -> Building:
    """Place corridors and rooms. Raises LayoutError if the random dimensions are not feasible."""
    rng = builder.rng
    building = Building(builder)
    length = _drawn(builder, bones.length_m)
    widths = [_drawn(builder, bones.corridor_m) for _ in range(2)]
    rows = [_drawn(builder, bones.outer_row_m), _drawn(builder, bones.outer_row_m)]
    inner = [_drawn(builder, bones.inner_row_m), _drawn(builder, bones.inner_row_m)]
    y = [0.0, rows[0]]
    y += [y[1] + widths[0]]
    y += [y[2] + inner[0]]
    y += [y[3] + inner[1]]
    y += [y[4] + widths[1]]
    y += [y[5] + rows[1]]
    y = [round(v, 2) for v in y]
    south = builder.room(Rect(0, y[1], length, y[2]), "corridor", "corridor", bones.corridor_floor)
    north = builder.room(Rect(0, y[4], length, y[5]), "corridor", "corridor", bones.corridor_floor)
    building.long += [south, north]

    cross_spans = _spans(builder, length, int(rng.integers(bones.cross[0], bones.cross[1] + 1)), bones)
    for low, high in cross_spans:
        room = builder.room(Rect(low, y[2], high, y[4]), "corridor", "corridor", bones.corridor_floor)
        builder.open(room, south)
        builder.open(room, north)
        building.cross.append(room)
    stubs = int(rng.integers(bones.stubs[0], bones.stubs[1] + 1))
    sides = [(0, y[0], y[1], south), (1, y[5], y[6], north)]
    taken: dict[int, list[Vec2]] = {0: [], 1: []}
    for _ in range(stubs):
        side, low_y, high_y, corridor = sides[int(rng.integers(2))]
        span = _stub_span(builder, length, cross_spans, taken[side], bones)
        if span is None:
            continue
        taken[side].append(span)
        stub = builder.room(Rect(span[0], low_y, span[1], high_y), "corridor", "corridor", bones.corridor_floor)
        builder.open(stub, corridor)
        building.stubs.append(stub)

    for side, low_y, high_y, corridor in sides:
        for a, b in _gaps(taken[side], length):
            for low, high in _split(builder, a, b, bones.room_m):
                building.slots.append((Rect(low, low_y, high, high_y), corridor))
    for a, b in _gaps(cross_spans, length):
        for low_y, high_y, corridor in ((y[2], y[3], south), (y[3], y[4], north)):
            for low, high in _split(builder, a, b, bones.room_m):
                building.slots.append((Rect(low, low_y, high, high_y), corridor))
    return building


def _drawn(builder: Builder, limits: Vec2) -> float:
    return round(float(builder.rng.uniform(*limits)), 2)


def _spans(builder: Builder, length: float, count: int, bones: Bones) -> list[Vec2]:
    """Return the positions of cross corridors: two rooms apart, at an end of the building or a room away from it."""
    for _ in range(200):
        spans = []
        for _ in range(count):
            width = _drawn(builder, bones.corridor_m)
            low = round(float(builder.rng.uniform(0, length - width)), 2)
            if low < bones.room_m[0] * 0.6:
                low = 0.0
            elif length - width - low < bones.room_m[0] * 0.6:
                low = length - width
            spans.append((low, round(low + width, 2)))
        spans.sort()
        edges = [0.0, *(v for span in spans for v in span), length]
        gaps = [b - a for a, b in zip(edges[::2], edges[1::2], strict=True)]
        ends = all(gap < 1e-6 or gap >= bones.room_m[0] for gap in (gaps[0], gaps[-1]))
        if ends and all(gap >= 1.9 * bones.room_m[0] for gap in gaps[1:-1]):
            return spans
    raise LayoutError("cross corridors do not fit")


def _stub_span(
    builder: Builder, length: float, cross: list[Vec2], taken: list[Vec2], bones: Bones
) -> Vec2 | None:  # fmt: skip
    """Return the position of a dead end: opposite a cross corridor, or far from all of them."""
    for _ in range(40):
        if cross and builder.rng.uniform() < 0.5:
            span = cross[int(builder.rng.integers(len(cross)))]
        else:
            width = _drawn(builder, bones.corridor_m)
            low = round(float(builder.rng.uniform(bones.room_m[0], length - bones.room_m[0] - width)), 2)
            span = (low, round(low + width, 2))
            if any(abs(sum(span) - sum(other)) / 2 < 5.0 for other in cross):
                continue
        inside = min(span[0], length - span[1])
        if inside > 1e-6 and inside < bones.room_m[0]:
            continue
        if all(span[1] + bones.room_m[0] <= o[0] or o[1] + bones.room_m[0] <= span[0] for o in taken):
            return span
    return None


def _gaps(spans: list[Vec2], length: float) -> list[Vec2]:
    edges = [0.0, *(v for span in sorted(spans) for v in span), length]
    return [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > 1e-6]


def _split(builder: Builder, low: float, high: float, room_m: Vec2) -> list[Vec2]:
    """Divide a segment into rooms of random width."""
    stretch = high - low
    count = max(1, round(stretch / float(builder.rng.uniform(*room_m))))
    while count > 1 and stretch / count < room_m[0]:
        count -= 1
    weights = builder.rng.uniform(0.85, 1.15, count)
    cuts = [low]
    for share in weights[:-1].cumsum() / weights.sum():
        cuts.append(round(low + stretch * float(share), 2))
    cuts.append(high)
    return list(itertools.pairwise(cuts))
