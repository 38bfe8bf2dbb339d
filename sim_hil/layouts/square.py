"""Open spaces: a plaza with a fountain, parasols and a terrace with ramps; a park with trees and benches."""

from __future__ import annotations

from math import atan2, cos, hypot, pi, radians, sin, tan

from sim_hil.layouts.builder import Builder
from sim_hil.layouts.furnish import named, sit_on
from sim_hil.layouts.plan import LayoutError, Rect
from sim_hil.scene.scene import Terrain

_PARASOLS = ("red", "blue", "yellow", "green", "orange", "purple")
_RISE_M = 0.3
_RAMP_RAD = radians(7.0)


def plaza(builder: Builder, lot: Rect, north: bool) -> None:
    """Add a paved plaza, open to the sidewalk, with a hedge on the far side."""
    builder.room(lot, "plaza", "plaza", "cobbles")
    rng = builder.rng
    cx, cy = lot.centre
    fx, fy = cx + float(rng.uniform(-0.12, 0.12)) * lot.width, cy + float(rng.uniform(-0.1, 0.1)) * lot.depth
    fountain = builder.put("fountain", fx, fy, 0.0, landmark=named("fountain"), label="fountain")
    if fountain is None:
        raise LayoutError("no room for the fountain")
    for index in range(6):
        angle = 2 * pi * index / 6
        reach = 3.2
        builder.place("stand", fx + reach * cos(angle), fy + reach * sin(angle), angle + pi, 3)
    for index in range(4):
        angle = pi / 4 + pi / 2 * index
        x, y = fx + 4.6 * cos(angle), fy + 4.6 * sin(angle)
        bench = builder.put("park_bench", x, y, atan2(fy - y, fx - x), gap_m=0.4)
        if bench is not None:
            sit_on(builder, bench, 2)
    terrace(builder, lot, (fx, fy))
    colours = [_PARASOLS[int(i)] for i in rng.permutation(len(_PARASOLS))]
    for index in range(7):
        single = index < 4
        kind = "umbrella" if single else "umbrella_table"
        colour = colours[index] if index < len(colours) else "white"
        for _ in range(40):
            x = float(rng.uniform(lot.x0 + 2.5, lot.x1 - 2.5))
            y = float(rng.uniform(lot.y0 + 2.5, lot.y1 - 2.5))
            if hypot(x - fx, y - fy) < 6.0:
                continue
            thing = builder.put(kind, x, y, 0.0, colour=colour, gap_m=0.9, landmark=f"{colour} umbrella")
            if thing is not None:
                for angle in (0.0, pi / 2, pi, -pi / 2):
                    builder.place("stand", x + 1.6 * cos(angle), y + 1.6 * sin(angle), angle + pi, 1)
                break
    _somewhere(builder, lot, "kiosk", 1, 1.5, landmark=True)
    if builder.things[-1].kind != "kiosk":
        raise LayoutError("no room for the kiosk")
    _somewhere(builder, lot, "planter", 3, 1.2)
    _somewhere(builder, lot, "tree", 4, 0.6)
    _edge(builder, lot, north)
    builder.stand_in(lot, 10)


def terrace(builder: Builder, lot: Rect, avoid: tuple[float, float]) -> None:
    """Add a raised platform with a ramp at each end."""
    rng = builder.rng
    size = (round(float(rng.uniform(4.0, 5.5)), 2), round(float(rng.uniform(3.2, 4.4)), 2))
    run = round(_RISE_M / tan(_RAMP_RAD), 2)
    for _ in range(60):
        x = float(rng.uniform(lot.x0 + 1 + run + size[0] / 2, lot.x1 - 1 - run - size[0] / 2))
        y = float(rng.uniform(lot.y0 + 2 + size[1] / 2, lot.y1 - 2 - size[1] / 2))
        zone = Rect(
            x - size[0] / 2 - run - 1.2, y - size[1] / 2 - 0.8, x + size[0] / 2 + run + 1.2, y + size[1] / 2 + 0.8
        )
        if builder.fits(zone, True) and hypot(x - avoid[0], y - avoid[1]) > 7.0:
            break
    else:
        return
    builder.keep_clear(zone)
    builder.terrain.append(Terrain("terrace", "platform", (x, y, 0.0), 0.0, size, _RISE_M, "paving"))
    for name, side, heading in (("west", -1, 0.0), ("east", 1, pi)):
        at = (round(x + side * (size[0] / 2 + run / 2), 3), y, 0.0)
        builder.terrain.append(
            Terrain(f"{name} ramp", "ramp", at, heading, (run, round(size[1] * 0.7, 2)), _RISE_M, "concrete")
        )


def park(builder: Builder, lot: Rect, north: bool) -> None:
    """Add a park with grass, a paved path from the sidewalk, trees, benches and a statue."""
    builder.room(lot, "plaza", "park", "grass")
    cx, cy = lot.centre
    statue = builder.put("statue", cx, cy, pi / 2 if not north else -pi / 2, landmark=named("statue"), label="statue")
    if statue is None:
        raise LayoutError("no room for the statue")
    for angle in (0.0, 2.1, 4.2):
        builder.place("stand", cx + 1.9 * cos(angle), cy + 1.9 * sin(angle), angle + pi, 3)
    _somewhere(builder, lot, "park_bench", 4, 1.2)
    _somewhere(builder, lot, "tree", 10, 0.8)
    _edge(builder, lot, north)
    builder.stand_in(lot, 8)


def _somewhere(builder: Builder, lot: Rect, kind: str, count: int, gap_m: float, landmark: bool = False) -> None:
    for _ in range(count):
        for _ in range(30):
            x = float(builder.rng.uniform(lot.x0 + 2.0, lot.x1 - 2.0))
            y = float(builder.rng.uniform(lot.y0 + 2.0, lot.y1 - 2.0))
            heading = float(builder.rng.choice([0.0, pi / 2, pi, -pi / 2]))
            thing = builder.put(kind, x, y, heading, gap_m=gap_m, landmark=named(kind) if landmark else "")
            if thing is not None:
                if kind == "park_bench":
                    sit_on(builder, thing, 2)
                elif kind == "kiosk":
                    builder.place_before(thing, "queue", 4, gap_m=0.7)
                break


def _edge(builder: Builder, lot: Rect, north: bool) -> None:
    """Add a hedge along the side away from the street, where the scene ends."""
    y = lot.y1 - 0.5 if north else lot.y0 + 0.5
    count = int(lot.width // 3.2)
    for index in range(count):
        x = lot.x0 + (index + 0.5) * lot.width / count
        builder.put("hedge", x, y, pi / 2, size=(0.7, 3.0, 1.4), gap_m=0.0)
