"""City junction: sidewalks with kerbs, zebra crossings, shops, a plaza with a fountain, a park, uneven ground.

Paper appendix C: "uneven terrain, ramps, streets, and large open spaces … umbrellas, fountains, and storefronts".
"""

from __future__ import annotations

from math import atan2, cos, hypot, pi, radians, sin, tan

import numpy as np

from sim_hil.layouts.builder import Builder, Room
from sim_hil.layouts.building import named
from sim_hil.layouts.plan import LayoutError, Rect
from sim_hil.scene.scene import Floor, Scene, SceneObject, Terrain

_SHOPS = ("BAKERY", "CAFE", "BOOKS", "FLOWERS", "PIZZA", "TOYS", "BANK", "SHOES", "MUSIC", "BIKES")
_SHOP_COLOURS = ("red", "blue", "green", "yellow", "orange", "purple", "white", "pink")
_BRICKS = ((0.70, 0.42, 0.32), (0.78, 0.70, 0.58), (0.56, 0.58, 0.62), (0.62, 0.50, 0.40), (0.72, 0.62, 0.52))
_KERB_M = (0.25, 0.14)  # width, height; too high for a robot
_BUMP_M = 0.04
_PARASOLS = ("red", "blue", "yellow", "green", "orange", "purple")
_RISE_M = 0.3
_RAMP_RAD = radians(7.0)


def sidewalk(rng: np.random.Generator) -> Scene:
    """Generate a junction and its four blocks. Raises LayoutError or SceneError if the random draw is not feasible."""
    builder = Builder("sidewalk", rng, "wall_brick", 0.0)
    length, depth = 120.0, 60.0
    road = [round(float(v), 2) for v in rng.uniform(7.0, 8.0, 2)]
    walk = round(float(rng.uniform(4.6, 5.6)), 2)
    y0 = round(float(rng.uniform(23.0, 29.0)), 2)
    x0 = round(float(rng.uniform(44.0, 68.0)), 2)
    y1, x1 = y0 + road[0], x0 + road[1]
    zebra = 3.6

    crossings = _streets(builder, length, depth, (x0, y0, x1, y1), walk, zebra)
    strips = _sidewalks(builder, length, depth, (x0, y0, x1, y1), walk)
    _kerbs(builder, crossings, (x0, y0, x1, y1), length, depth)
    lots = [
        Rect(0, 0, x0 - walk, y0 - walk), Rect(x1 + walk, 0, length, y0 - walk),
        Rect(0, y1 + walk, x0 - walk, depth), Rect(x1 + walk, y1 + walk, length, depth),
    ]  # fmt: skip
    parts: list[tuple[Rect, bool]] = []
    for lot in lots:
        north = lot.y0 > y0
        cut = round(float(rng.uniform(0.42, 0.58)) * lot.width + lot.x0, 2)
        if lot.width > 40:
            parts += [(Rect(lot.x0, lot.y0, cut, lot.y1), north), (Rect(cut, lot.y0, lot.x1, lot.y1), north)]
        else:
            parts.append((lot, north))
    order = builder.shuffled(parts)
    open_parts = [part for part in order if part[0].width >= 18.0 and part[0].depth >= 18.0]
    if len(open_parts) < 2:
        raise LayoutError("no room for a plaza and a park")
    _plaza(builder, *open_parts[0])
    _park(builder, *open_parts[1])
    colours = builder.shuffled(_SHOP_COLOURS)
    names = builder.shuffled(_SHOPS)
    for part in order:
        if part not in open_parts[:2]:
            _buildings(builder, *part, colours, names)
    _furniture(builder, strips, (x0, y0, x1, y1))
    _bumps(builder, strips)
    for strip in strips:
        along = max(strip.rect.width, strip.rect.depth)
        builder.stand_in(strip.rect, max(2, round(along / 6)))
    south = strips[0].rect
    start = (3.0, south.y0 + 0.45 * walk, 0.0)
    goal = (south.x1 - 1.5, south.y0 + 0.45 * walk)
    return builder.scene(
        "sidewalk", start, goal, floor="paving", ceiling="", walls=[], bounds=Rect(0, 0, length, depth)
    )


def _streets(
    builder: Builder, length: float, depth: float, road: tuple[float, float, float, float], walk: float, zebra: float
) -> list[Room]:  # fmt: skip
    """Add the two streets, with zebra crossings at the junction's four arms and one in mid-block."""
    x0, y0, x1, y1 = road
    inset = (walk - zebra) / 2
    west = (x0 - walk + inset, x0 - inset)
    east = (x1 + inset, x1 + walk - inset)
    mids = []
    for low, high in ((0.0, west[0]), (east[1], length)):
        if high - low > 30:
            middle = round(low + (high - low) * float(builder.rng.uniform(0.4, 0.6)), 2)
            mids.append((middle - zebra / 2, middle + zebra / 2))
    cuts = sorted([west, east, *mids])
    made: list[Room] = []
    edge = 0.0
    for low, high in cuts:
        _street(builder, Rect(edge, y0, low, y1), "asphalt_line", 0.0)
        made.append(_crossing(builder, Rect(low, y0, high, y1), pi / 2))
        edge = high
    _street(builder, Rect(edge, y0, length, y1), "asphalt_line", 0.0)
    south = (y0 - walk + inset, y0 - inset)
    north = (y1 + inset, y1 + walk - inset)
    _street(builder, Rect(x0, 0, x1, south[0]), "asphalt_line", pi / 2)
    made.append(_crossing(builder, Rect(x0, south[0], x1, south[1]), 0.0))
    _street(builder, Rect(x0, south[1], x1, y0), "asphalt", 0.0)
    _street(builder, Rect(x0, y1, x1, north[0]), "asphalt", 0.0)
    made.append(_crossing(builder, Rect(x0, north[0], x1, north[1]), 0.0))
    _street(builder, Rect(x0, north[1], x1, depth), "asphalt_line", pi / 2)
    return made


def _street(builder: Builder, rect: Rect, texture: str, heading_rad: float) -> None:
    builder.room(rect, "street", "street")
    builder.floors.append(Floor(rect.corners(), texture, heading_rad))


def _crossing(builder: Builder, rect: Rect, heading_rad: float) -> Room:
    room = builder.room(rect, "crossing", "zebra crossing")
    builder.floors.append(Floor(rect.corners(), "zebra_crossing", heading_rad))
    return room


def _sidewalks(
    builder: Builder, length: float, depth: float, road: tuple[float, float, float, float], walk: float
) -> list[Room]:  # fmt: skip
    """Add eight sidewalks: first along the main street (with the corners), then along the other."""
    x0, y0, x1, y1 = road
    rects = [
        Rect(0, y0 - walk, x0, y0), Rect(x1, y0 - walk, length, y0),
        Rect(0, y1, x0, y1 + walk), Rect(x1, y1, length, y1 + walk),
        Rect(x0 - walk, 0, x0, y0 - walk), Rect(x1, 0, x1 + walk, y0 - walk),
        Rect(x0 - walk, y1 + walk, x0, depth), Rect(x1, y1 + walk, x1 + walk, depth),
    ]  # fmt: skip
    return [builder.room(rect, "sidewalk", "sidewalk", "paving_light") for rect in rects]


def _kerbs(
    builder: Builder, crossings: list[Room], road: tuple[float, float, float, float], length: float, depth: float
) -> None:
    """Add kerb stones along every edge between sidewalk and street; they are lowered at crossings."""
    x0, y0, x1, y1 = road
    width, rise = _KERB_M
    lines: list[tuple[bool, float, float, float]] = []
    for low, high in ((0.0, x0), (x1, length)):
        lines += [(True, y0 - width / 2, low, high), (True, y1 + width / 2, low, high)]
    for low, high in ((0.0, y0 - width), (y1 + width, depth)):
        lines += [(False, x0 - width / 2, low, high), (False, x1 + width / 2, low, high)]
    for along_x, at, low, high in lines:
        gaps = []
        for crossing in crossings:
            r = crossing.rect
            near = min(abs(r.y0 - at), abs(r.y1 - at)) if along_x else min(abs(r.x0 - at), abs(r.x1 - at))
            span = (r.x0, r.x1) if along_x else (r.y0, r.y1)
            if near < width and span[0] < high and span[1] > low:
                gaps.append(span)
        edges = [low, *(v for span in sorted(gaps) for v in span), high]
        for a, b in zip(edges[::2], edges[1::2], strict=True):
            if b - a < 0.1:
                continue
            middle = (a + b) / 2
            x, y = (middle, at) if along_x else (at, middle)
            builder.terrain.append(
                Terrain(f"kerb {builder.number('kerb')}", "kerb", (x, y, 0.0), 0.0 if along_x else pi / 2,
                        (round(b - a, 3), width), rise, "kerb_stone")
            )  # fmt: skip
    for crossing in crossings:
        builder.keep_clear(crossing.rect.grown(2.1))


def _buildings(
    builder: Builder, lot: Rect, north: bool, colours: list[str], names: list[str]
) -> None:  # fmt: skip
    """Fill a lot with a row of houses, each with a shop towards the main street."""
    count = max(1, round(lot.width / float(builder.rng.uniform(9.0, 13.0))))
    edges = [lot.x0 + lot.width * i / count for i in range(count + 1)]
    front, heading = (lot.y0, -pi / 2) if north else (lot.y1, pi / 2)
    shop_depth = 0.8
    for index in range(count):
        low, high = edges[index], edges[index + 1]
        x, width = (low + high) / 2, high - low
        height = float(builder.rng.uniform(8.0, 14.0))
        depth = lot.depth - shop_depth - 0.02
        y = front + (1 if north else -1) * (shop_depth + 0.01 + depth / 2)
        thing = SceneObject(
            f"building {builder.number('building')}", "building", (x, y, 0.0), heading, (depth, width - 0.02, height),
            _BRICKS[int(builder.rng.integers(len(_BRICKS)))], "", "",
        )  # fmt: skip
        builder.things.append(thing)
        colour = colours.pop() if colours else ""
        text = names.pop() if names else "SHOP"
        sy = front + (1 if north else -1) * shop_depth / 2
        shop = builder.put(
            "storefront", x, sy, heading, size=(shop_depth, min(width - 0.4, 8.0), 4.2), colour=colour or "grey",
            landmark=named("storefront", colour) if colour else "", text=text, force=True,
        )  # fmt: skip
        if shop is not None:
            builder.place_before(shop, "door", 3, gap_m=0.6)
            builder.keep_clear(Rect(x - 2.0, sy - 3.2, x + 2.0, sy + 3.2))


def _furniture(builder: Builder, strips: list[Room], road: tuple[float, float, float, float]) -> None:
    """Add lamps, trees, bins, benches, a bus stop and parked cars; the middle of every sidewalk stays free."""
    x0, y0, x1, y1 = road
    for number, strip in enumerate(strips):
        rect, along_x = strip.rect, number < 4
        low, high = (rect.x0, rect.x1) if along_x else (rect.y0, rect.y1)
        if along_x:
            kerb_y = rect.y1 - 0.85 if rect.y1 <= y0 + 1e-6 else rect.y0 + 0.85
            facing = -pi / 2 if rect.y1 <= y0 + 1e-6 else pi / 2
        else:
            kerb_y = rect.x1 - 0.85 if rect.x1 <= x0 + 1e-6 else rect.x0 + 0.85
            facing = pi if rect.x1 <= x0 + 1e-6 else 0.0
        wanted = builder.shuffled(("tree", "lamp_post", "park_bench", "tree", "trash_bin", "mailbox", "bicycle_rack",
                                   "sign_post", "planter", "lamp_post"))  # fmt: skip
        has_stop = any(thing.kind == "bus_stop" for thing in builder.things)
        if number == int(builder.rng.integers(4)) or (number == 3 and not has_stop):
            wanted.insert(0, "bus_stop")
        u, index = low + 2.0, 0
        while u < high - 2.0:
            kind = wanted[index % len(wanted)]
            index += 1
            named_kind = kind in ("park_bench", "mailbox", "bus_stop", "bicycle_rack", "planter", "trash_bin")
            if index > len(wanted) and named_kind:
                kind, named_kind = "tree", False
            x, y = (u, kerb_y) if along_x else (kerb_y, u)
            size = {"bus_stop": (1.0, 3.0, 2.5), "bicycle_rack": (1.0, 1.8, 1.05)}.get(kind)
            thing = builder.put(
                kind, x, y, facing, size=size, landmark=named(kind) if named_kind else "", gap_m=0.4,
                text="BUS" if kind == "bus_stop" else "", seats=2 if kind == "park_bench" else 0,
            )  # fmt: skip
            if thing is not None and kind == "bus_stop":
                builder.place_before(thing, "queue", 5, gap_m=0.7)
            u += float(builder.rng.uniform(4.0, 6.5))
    colours = ("red", "blue", "white", "black", "grey", "green")
    length = max(strip.rect.x1 for strip in strips)
    for lane_y, heading in ((y0 + 1.3, 0.0), (y1 - 1.3, pi)):
        for _ in range(14):
            x = float(builder.rng.uniform(4.0, length - 4.0))
            if not x0 - 12 < x < x1 + 12:
                builder.put("car", x, lane_y, heading, colour=builder.pick(colours), gap_m=0.35)
    builder.put("car", x0 + 1.3, float(builder.rng.uniform(4.0, 12.0)), -pi / 2, colour=builder.pick(colours))


def _bumps(builder: Builder, strips: list[Room]) -> None:
    """Add low bumps across a sidewalk, like paving lifted by tree roots."""
    for strip in strips[:4]:
        rect = strip.rect
        for _ in range(2):
            x = float(builder.rng.uniform(rect.x0 + 4, rect.x1 - 4))
            size = (round(float(builder.rng.uniform(0.5, 0.9)), 2), round(rect.depth - 0.8, 2))
            builder.terrain.append(
                Terrain(
                    f"bump {builder.number('bump')}", "bump", (x, rect.centre[1], 0.0), 0.0, size, _BUMP_M, "cobbles"
                )
            )


def _plaza(builder: Builder, lot: Rect, north: bool) -> None:
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
        builder.put("park_bench", x, y, atan2(fy - y, fx - x), gap_m=0.4, seats=2)
    _terrace(builder, lot, (fx, fy))
    colours = builder.shuffled(_PARASOLS)
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


def _terrace(builder: Builder, lot: Rect, avoid: tuple[float, float]) -> None:
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


def _park(builder: Builder, lot: Rect, north: bool) -> None:
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
            thing = builder.put(kind, x, y, heading, gap_m=gap_m, landmark=named(kind) if landmark else "",
                                seats=2 if kind == "park_bench" else 0)  # fmt: skip
            if thing is not None:
                if kind == "kiosk":
                    builder.place_before(thing, "queue", 4, gap_m=0.7)
                break


def _edge(builder: Builder, lot: Rect, north: bool) -> None:
    """Add a hedge along the side away from the street, where the scene ends."""
    y = lot.y1 - 0.5 if north else lot.y0 + 0.5
    count = int(lot.width // 3.2)
    for index in range(count):
        x = lot.x0 + (index + 0.5) * lot.width / count
        builder.put("hedge", x, y, pi / 2, size=(0.7, 3.0, 1.4), gap_m=0.0)
