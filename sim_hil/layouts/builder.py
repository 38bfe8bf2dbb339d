"""Builder of a layout: collects rooms, openings, objects and places, and rejects objects that would collide."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import atan2, cos, degrees, hypot, pi, radians, sin
from typing import Any, TypeVar

import numpy as np

from sim_hil.layouts.plan import WALL_THICKNESS_M, Border, LayoutError, Rect, Vec2, shared_border, wall_lines
from sim_hil.scene.scene import KINDS, SKY, Area, Floor, Place, Scene, SceneObject, Terrain, Vec3, Wall

Item = TypeVar("Item")

# Named colours; an instruction may only use them for objects of exactly this colour.
COLOURS: dict[str, Vec3] = {
    "red": (0.80, 0.08, 0.10),
    "blue": (0.10, 0.28, 0.72),
    "green": (0.10, 0.52, 0.22),
    "yellow": (0.95, 0.80, 0.10),
    "orange": (0.94, 0.46, 0.06),
    "purple": (0.46, 0.16, 0.60),
    "white": (0.93, 0.93, 0.91),
    "black": (0.10, 0.10, 0.11),
    "brown": (0.45, 0.28, 0.14),
    "pink": (0.92, 0.45, 0.62),
    "grey": (0.55, 0.56, 0.58),
}
# Height of the underside of objects on walls, m.
_HUNG_M = {
    "window": 1.0, "notice_board": 0.9, "painting": 1.1, "screen": 1.1, "clock": 1.9, "room_sign": 1.45,
    "exit_sign": 2.2, "sign": 2.2, "whiteboard": 0.8, "fire_extinguisher": 0.3, "handrail": 0.0,
}  # fmt: skip
_FACING = {"n": -pi / 2, "s": pi / 2, "w": 0.0, "e": pi}  # heading of an object whose back is on that side
_WALL_GAP_M = 0.012  # gap behind an object, so that its back and the wall do not coincide
_OVERHEAD = frozenset(("light", "sign", "exit_sign", "awning"))
_STEMS: dict[str, Vec3] = {"tree": (0.7, 0.7, 5.0), "lamp_post": (0.3, 0.3, 4.4)}  # size of their parts on the ground
_LYING = frozenset(("carpet",))
PERSON_CLEARANCE_M = 0.32


@dataclass(frozen=True)
class Room:
    """One rectangle of the plan, which becomes an area."""

    label: str
    kind: str
    name: str
    rect: Rect
    floor: str


class Builder:
    """Builder of one layout; `rng` is the only random source, `flip` mirrors and rotates the result."""

    def __init__(self, kind: str, rng: np.random.Generator, wall_texture: str, ceiling_m: float) -> None:
        self.kind, self.rng = kind, rng
        self.wall_texture, self.ceiling_m = wall_texture, ceiling_m
        self.rooms: list[Room] = []
        self.openings: list[tuple[Border, str, str]] = []
        self.things: list[SceneObject] = []
        self.floors: list[Floor] = []
        self.terrain: list[Terrain] = []
        self.places: list[Place] = []
        self._taken: list[Rect] = []  # outlines of placed objects
        self._clear: list[Rect] = []  # areas without solid objects
        self._counts: dict[str, int] = {}

    def number(self, what: str) -> int:
        """Return the next number for a kind of object, so that labels are unique."""
        self._counts[what] = self._counts.get(what, 0) + 1
        return self._counts[what]

    def pick(self, choices: Sequence[str]) -> str:
        """Return a random item."""
        return choices[int(self.rng.integers(len(choices)))]

    def shuffled(self, items: Sequence[Item]) -> list[Item]:
        """Return the items in random order."""
        return [items[int(i)] for i in self.rng.permutation(len(items))]

    def room(self, rect: Rect, kind: str, name: str, floor: str = "") -> Room:
        """Add a rectangle of the plan. Raises LayoutError if it overlaps another."""
        for other in self.rooms:
            if rect.overlaps(other.rect):
                raise LayoutError(f"{name} overlaps {other.label}")
        room = Room(f"{name} {self.number(name)}", kind, name, rect, floor)
        self.rooms.append(room)
        return room

    def open(self, a: Room, b: Room, width_m: float = 0.0, at: float | None = None, margin_m: float = 0.55) -> Border:
        """Open the wall between two rooms: completely (width 0), or by a doorway at `at` or at a random position."""
        border = shared_border(a.rect, b.rect)
        if width_m > 0:
            low, high = border.low + margin_m + width_m / 2, border.high - margin_m - width_m / 2
            if low > high:
                raise LayoutError(f"no room for a door of {width_m} m between {a.label} and {b.label}")
            middle = float(self.rng.uniform(low, high)) if at is None else min(max(at, low), high)
            border = border.cut(middle - width_m / 2, middle + width_m / 2)
        self.openings.append((border, a.label, b.label))
        along, across = border.length / 2 + 0.15, 1.1
        x, y = border.middle
        reach = (along, across) if border.along_x else (across, along)
        self.keep_clear(Rect(x - reach[0], y - reach[1], x + reach[0], y + reach[1]))
        return border

    def keep_clear(self, rect: Rect) -> None:
        """Keep an area free of solid objects."""
        self._clear.append(rect)

    def fits(self, outline: Rect, solid: bool, gap_m: float = 0.1) -> bool:
        """Return whether an object with this outline collides with nothing."""
        if solid and any(outline.overlaps(zone) for zone in self._clear):
            return False
        grown = outline.grown(gap_m)
        return not any(grown.overlaps(taken) for taken in self._taken)

    def put(
        self, kind: str, x: float, y: float, heading_rad: float, *, z: float = 0.0, size: Vec3 | None = None,
        colour: str = "", landmark: str = "", text: str = "", label: str = "", gap_m: float = 0.1, force: bool = False,
        seats: int = 0, queue: int = 0,
    ) -> SceneObject | None:  # fmt: skip
        """Add an object; return None if it would collide, unless `force`.

        `seats`: number of people who can sit on it; `queue`: number of people who can queue before it.
        """
        size = size or KINDS[kind].size_m
        outline = outline_of(x, y, heading_rad, _STEMS.get(kind, size))
        overhead = kind in _OVERHEAD or kind in _LYING
        # A door or elevator is part of a wall, but the space in front of it must stay free.
        if not (force or overhead or self.fits(outline, KINDS[kind].solid, gap_m)):
            return None
        name = label or f"{kind.replace('_', ' ')} {self.number(kind)}"
        tint = COLOURS[colour] if colour else KINDS[kind].colour
        thing = SceneObject(name, kind, (x, y, z), heading_rad, size, tint, text, landmark)
        self.things.append(thing)
        if not overhead:
            self._taken.append(outline)
        if seats:
            self.place("sit", x, y, heading_rad, seats)
        if queue:
            self.place_before(thing, "queue", queue)
        return thing

    def against(
        self, room: Room, kind: str, *, side: str = "", along: float | None = None, size: Vec3 | None = None,
        colour: str = "", landmark: str = "", text: str = "", label: str = "", tries: int = 24, lone: bool = False,
        margin_m: float = 0.25, seats: int = 0, queue: int = 0,
    ) -> SceneObject | None:  # fmt: skip
        """Place an object with its back to one of the room's walls; return None if there is no free space.

        `along`: position as a share of the wall's length; `lone`: also keep the opposite side of a corridor free.
        """
        depth, width, _ = size or KINDS[kind].size_m
        rect = room.rect
        for _ in range(tries):
            where = side or self.pick(("n", "s", "e", "w"))
            share = float(self.rng.uniform(0, 1)) if along is None else along
            back = WALL_THICKNESS_M / 2 + _WALL_GAP_M + depth / 2
            edge = WALL_THICKNESS_M / 2 + margin_m + width / 2
            low, high = (rect.x0, rect.x1) if where in "ns" else (rect.y0, rect.y1)
            if high - low < 2 * edge:
                if side:
                    return None
                continue
            u = low + edge + share * (high - low - 2 * edge)
            x, y = {"n": (u, rect.y1 - back), "s": (u, rect.y0 + back), "w": (rect.x0 + back, u),
                    "e": (rect.x1 - back, u)}[where]  # fmt: skip
            # Flat objects too: over a doorway they would float.
            outline = outline_of(x, y, _FACING[where], size or KINDS[kind].size_m)
            if any(outline.overlaps(zone) for zone in self._clear):
                continue
            thing = self.put(
                kind, x, y, _FACING[where], z=_HUNG_M.get(kind, 0.0), size=size, colour=colour, landmark=landmark,
                text=text, label=label, seats=seats, queue=queue,
            )  # fmt: skip
            if thing is not None:
                if lone and thing.solid:
                    across = (0.5, rect.depth) if where in "ns" else (rect.width, 0.5)
                    dx, dy = across
                    self.keep_clear(Rect(outline.x0 - dx, outline.y0 - dy, outline.x1 + dx, outline.y1 + dy))
                return thing
            if along is not None and side:
                return None
        return None

    def place(self, kind: str, x: float, y: float, heading_rad: float, capacity: int = 1) -> None:
        """Add a place for people; places that are not free in the finished layout are dropped."""
        self.places.append(Place(f"{kind} {self.number('place ' + kind)}", (x, y), heading_rad, kind, capacity))

    def place_before(self, thing: SceneObject, kind: str, capacity: int = 1, gap_m: float = 0.55) -> None:
        """Add a place in front of an object, facing it."""
        reach = thing.size_m[0] / 2 + gap_m
        h = thing.heading_rad
        self.place(kind, thing.position_m[0] + reach * cos(h), thing.position_m[1] + reach * sin(h), h + pi, capacity)

    def stand_in(self, rect: Rect, count: int) -> None:
        """Add places to stand in a free part of a rectangle."""
        for _ in range(count * 4):
            if count <= 0:
                return
            x = float(self.rng.uniform(rect.x0 + 0.5, rect.x1 - 0.5))
            y = float(self.rng.uniform(rect.y0 + 0.5, rect.y1 - 0.5))
            if all(_gap(taken, x, y) > PERSON_CLEARANCE_M + 0.1 for taken in self._taken):
                self.place("stand", x, y, float(self.rng.uniform(-pi, pi)), 2)
                count -= 1

    def walls(self) -> list[Wall]:
        """Return the walls of the rooms."""
        lines = wall_lines([room.rect for room in self.rooms], [border for border, _, _ in self.openings])
        return [
            Wall(f"wall {i + 1}", a, b, WALL_THICKNESS_M, self.ceiling_m, self.wall_texture)
            for i, (a, b) in enumerate(lines)
        ]

    def scene(self, name: str, start: Vec3, goal: Vec2, *, floor: str, ceiling: str = "ceiling_panels",
              walls: list[Wall] | None = None, bounds: Rect | None = None, sky: Vec3 = SKY) -> Scene:  # fmt: skip
        """Return the scene, randomly mirrored and rotated so that left and right turns are equally frequent."""
        walls = self.walls() if walls is None else walls
        bounds = bounds or Rect(
            min(room.rect.x0 for room in self.rooms), min(room.rect.y0 for room in self.rooms),
            max(room.rect.x1 for room in self.rooms), max(room.rect.y1 for room in self.rooms),
        )  # fmt: skip
        patches = [Floor(room.rect.corners(), room.floor) for room in self.rooms if room.floor] + self.floors
        ceiling_m = self.ceiling_m if ceiling else 0.0
        return Scene(
            name=name, start=start, goal_xy=goal, floor_min_m=(bounds.x0, bounds.y0),
            floor_max_m=(bounds.x1, bounds.y1), floor_texture=floor, ceiling_height_m=ceiling_m, walls=tuple(walls),
            objects=tuple(self.things), routes=(), floors=tuple(patches), terrain=tuple(self.terrain),
            areas=tuple(Area(room.label, room.kind, room.rect.corners(), room.name) for room in self.rooms),
            places=tuple(self.places), ceiling_texture=ceiling or "ceiling_panels", sky=sky,
        )  # fmt: skip


def outline_of(x: float, y: float, heading_rad: float, size: Vec3) -> Rect:
    """Return the axis-aligned rectangle around an object, m."""
    c, s = abs(cos(heading_rad)), abs(sin(heading_rad))
    half_x, half_y = (size[0] * c + size[1] * s) / 2, (size[0] * s + size[1] * c) / 2
    return Rect(x - half_x, y - half_y, x + half_x, y + half_y)


def _gap(rect: Rect, x: float, y: float) -> float:
    return hypot(max(rect.x0 - x, x - rect.x1, 0.0), max(rect.y0 - y, y - rect.y1, 0.0))


@dataclass(frozen=True)
class Turn:
    """Symmetry of the square: swap x and y, then mirror either axis; keeps rectangles axis-aligned."""

    swap: bool
    flip_x: bool
    flip_y: bool

    def point(self, p: Vec2) -> Vec2:
        """Transform a point about the origin."""
        x, y = (p[1], p[0]) if self.swap else (p[0], p[1])
        return (-x if self.flip_x else x, -y if self.flip_y else y)

    def heading(self, heading_rad: float) -> float:
        """Transform a heading."""
        x, y = self.point((cos(heading_rad), sin(heading_rad)))
        return radians(round(degrees(atan2(y, x)), 3))


def turned(scene: Scene, turn: Turn) -> Scene:
    """Return the scene under a symmetry, shifted so that its floor begins at (0, 0); numbers rounded to 1 mm."""
    corners = [turn.point(scene.floor_min_m), turn.point(scene.floor_max_m)]
    x0, y0 = min(c[0] for c in corners), min(c[1] for c in corners)
    x1, y1 = max(c[0] for c in corners), max(c[1] for c in corners)

    def at(point: tuple[float, ...]) -> tuple[float, ...]:
        x, y = turn.point((point[0], point[1]))
        return (_mm(x - x0), _mm(y - y0), *(_mm(z) for z in point[2:]))

    def outline(polygon: tuple[Vec2, ...]) -> tuple[tuple[float, ...], ...]:
        moved = tuple(at(point) for point in polygon)
        return moved[::-1] if (turn.swap + turn.flip_x + turn.flip_y) % 2 else moved

    changes: dict[str, Callable[[Any], Any]] = {
        "start_m": at,
        "end_m": at,
        "position_m": at,
        "heading_rad": turn.heading,
        "size_m": lambda size: tuple(_mm(extent) for extent in size),
        "polygon": outline,
    }

    def moved(parts: tuple[Any, ...]) -> tuple[Any, ...]:
        keys = [key for key in changes if parts and hasattr(parts[0], key)]
        return tuple(replace(part, **{key: changes[key](getattr(part, key)) for key in keys}) for part in parts)

    sections = ("walls", "objects", "floors", "terrain", "areas", "places")
    parts: dict[str, Any] = {name: moved(getattr(scene, name)) for name in sections}
    start, goal = at(scene.start[:2]), at(scene.goal_xy)
    return replace(
        scene,
        start=(start[0], start[1], turn.heading(scene.start[2])),
        goal_xy=(goal[0], goal[1]),
        floor_min_m=(0.0, 0.0),
        floor_max_m=(_mm(x1 - x0), _mm(y1 - y0)),
        **parts,
    )


def _mm(value: float) -> float:
    return round(value, 3) + 0.0
