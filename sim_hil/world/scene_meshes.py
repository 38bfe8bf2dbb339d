"""Meshes of a scene's floor, terrain, walls, ceiling and objects, divided into squares of floor; no physics.

A renderer skips the squares that it does not see.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from math import atan2, ceil, cos, floor, sin

from sim_hil.scene.scene import KINDS, Floor, Scene, SceneObject, Terrain, Wall
from sim_hil.world import equipment, hung, indoor, outdoor
from sim_hil.world.drawing.kit import Kit
from sim_hil.world.drawing.mesh import Frame, MeshBuilder, Vec2, Vec3
from sim_hil.world.drawing.stage import Stage
from sim_hil.world.drawing.surfaces import SURFACES, surface_picture
from sim_hil.world.drawing.textures import Colour
from sim_hil.world.wall_visibility import Bounds

# The function with the name of a kind builds its mesh.
BUILDERS: dict[str, Callable[[Kit], None]] = {
    kind: getattr(module, kind)
    for module in (indoor, equipment, outdoor, hung)
    for kind in KINDS
    if hasattr(module, kind)
}
_CELL_M = 4.0  # size of the cells into which large surfaces are cut, which limits texture repetitions
_OVERLAP_M = 0.04  # extension of walls below the floor and above the ceiling, against visible seams
_BEYOND_M = 60.0  # extension of open ground beyond the scene


def build_scene(stage: Stage, scene: Scene) -> list[tuple[int, Bounds]]:
    """Show the static parts of a scene; return each piece's handle and its extent on the floor."""
    # Indoors, small pieces permit skipping hidden rooms; outdoors, more pieces only cost time.
    pieces = Pieces(8.0 if scene.ceiling_height_m > 0 else 16.0)
    add_floor(pieces, scene)
    add_ceiling(pieces, scene)
    for terrain in scene.terrain:
        add_terrain(pieces, terrain)
    for wall in scene.walls:
        add_wall(pieces, wall)
    for thing in scene.objects:
        add_object(pieces.at(thing.position_m[0], thing.position_m[1]), thing)
    return [(stage.add(mesh), mesh.bounds()) for mesh in pieces.all()]


def add_object(mesh: MeshBuilder, thing: SceneObject) -> None:
    """Add one object to a mesh, at its place in the scene."""
    BUILDERS[thing.kind](Kit(mesh, thing))


class Pieces:
    """Meshes by square of floor, created by `make`; `around` contains faces far outside the scene."""

    def __init__(self, square_m: float, make: Callable[[], MeshBuilder] = MeshBuilder) -> None:
        self._square_m, self._make = square_m, make
        self._meshes: dict[tuple[int, int], MeshBuilder] = {}
        self.around = make()

    def at(self, x: float, y: float) -> MeshBuilder:
        """Return the mesh of the square that contains a point, m."""
        square = (floor(x / self._square_m), floor(y / self._square_m))
        if square not in self._meshes:
            self._meshes[square] = self._make()
        return self._meshes[square]

    def all(self) -> list[MeshBuilder]:
        """Return all meshes, ordered by position."""
        meshes = [self._meshes[square] for square in sorted(self._meshes)]
        return [mesh for mesh in (*meshes, self.around) if not mesh.empty()]


def surface(mesh: MeshBuilder, texture: str) -> str:
    """Register a repeating texture with a mesh and return its name."""
    if not mesh.has_picture(texture):
        mesh.picture(texture, surface_picture(texture))
    return texture


def clip(polygon: list[Vec2], a: Vec2, b: Vec2, keep_left: bool) -> list[Vec2]:
    """Return the part of a convex polygon on one side of the line from `a` to `b`."""
    sign = 1.0 if keep_left else -1.0
    side = [sign * ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) for x, y in polygon]
    kept: list[Vec2] = []
    for index, (here, there) in enumerate(zip(polygon, polygon[1:] + polygon[:1], strict=True)):
        s, t = side[index], side[(index + 1) % len(side)]
        if s >= 0:
            kept.append(here)
        if (s > 0 > t) or (s < 0 < t):
            share = s / (s - t)
            kept.append((here[0] + share * (there[0] - here[0]), here[1] + share * (there[1] - here[1])))
    return kept if len(kept) >= 3 and _area(kept) > 1e-6 else []


def split(polygon: list[Vec2], cutter: list[Vec2]) -> tuple[list[Vec2], list[list[Vec2]]]:
    """Cut a convex polygon by a counter-clockwise one; return the part inside and the pieces outside."""
    inside, outside = polygon, []
    for a, b in zip(cutter, cutter[1:] + cutter[:1], strict=True):
        beyond = clip(inside, a, b, keep_left=False)
        if beyond:
            outside.append(beyond)
        inside = clip(inside, a, b, keep_left=True)
        if not inside:
            return [], [polygon]
    return inside, outside


def counter_clockwise(polygon: list[Vec2]) -> list[Vec2]:
    """Return the polygon in counter-clockwise order."""
    return polygon if _area(polygon) > 0 else polygon[::-1]


def _area(polygon: list[Vec2]) -> float:
    return sum(a[0] * b[1] - b[0] * a[1] for a, b in zip(polygon, polygon[1:] + polygon[:1], strict=True)) / 2


def add_floor(pieces: Pieces, scene: Scene) -> None:
    """Build the floor with its patches, and open ground beyond it if there is no ceiling."""
    (x0, y0), (x1, y1) = scene.floor_min_m, scene.floor_max_m
    patches = [(counter_clockwise(list(patch.polygon)), patch, _extent(patch.polygon)) for patch in scene.floors]
    base = Floor(((x0, y0), (x1, y0), (x1, y1), (x0, y1)), scene.floor_texture)
    for left, right in _cells(x0 - _OVERLAP_M, x1 + _OVERLAP_M):
        for low, high in _cells(y0 - _OVERLAP_M, y1 + _OVERLAP_M):
            cell: list[Vec2] = [(left, low), (right, low), (right, high), (left, high)]
            parts = [(cell, base)]
            for polygon, patch, (px0, px1, py0, py1) in patches:
                if px0 >= right or px1 <= left or py0 >= high or py1 <= low:
                    continue
                inside, _ = split(cell, polygon)
                if inside:
                    # A later patch covers earlier ones: the covered part is cut away, so that faces do not coincide.
                    parts = [(rest, other) for part, other in parts for rest in split(part, polygon)[1]]
                    parts.append((inside, patch))
            for part, patch in parts:
                _level(pieces, part, patch.texture, patch.heading_rad, patch.polygon[0], 0.0)
    if scene.ceiling_height_m == 0:
        _beyond(pieces, scene)


def _beyond(pieces: Pieces, scene: Scene) -> None:
    (x0, y0), (x1, y1) = scene.floor_min_m, scene.floor_max_m
    colour, b = _mean(scene.floor_texture), _BEYOND_M
    for i0, i1, j0, j1 in ((x0 - b, x1 + b, y0 - b, y0), (x0 - b, x1 + b, y1, y1 + b),
                           (x0 - b, x0, y0, y1), (x1, x1 + b, y0, y1)):  # fmt: skip
        for left, right in _cells(i0, i1, 4 * _CELL_M):
            for low, high in _cells(j0, j1, 4 * _CELL_M):
                corners: list[Vec3] = [(left, low, 0), (right, low, 0), (right, high, 0), (left, high, 0)]
                pieces.around.face(colour, corners)


def add_ceiling(pieces: Pieces, scene: Scene) -> None:
    """Build the ceiling, visible from below, if the scene has one."""
    if scene.ceiling_height_m <= 0:
        return
    (x0, y0), (x1, y1) = scene.floor_min_m, scene.floor_max_m
    for left, right in _cells(x0 - _OVERLAP_M, x1 + _OVERLAP_M):
        for low, high in _cells(y0 - _OVERLAP_M, y1 + _OVERLAP_M):
            cell: list[Vec2] = [(left, low), (right, low), (right, high), (left, high)]
            _level(pieces, cell[::-1], scene.ceiling_texture, 0.0, (x0, y0), scene.ceiling_height_m)


def _level(pieces: Pieces, polygon: list[Vec2], texture: str, heading_rad: float, origin: Vec2, z: float) -> None:
    """Add a horizontal convex face with a repeating texture along the heading, starting at `origin`."""
    tiling, c, s = SURFACES[texture], cos(heading_rad), sin(heading_rad)
    along = [((x - origin[0]) * c + (y - origin[1]) * s, (y - origin[1]) * c - (x - origin[0]) * s) for x, y in polygon]
    uvs = [(u / tiling.width_m, v / tiling.height_m) for u, v in along]
    # Whole repetitions are subtracted, because the rasteriser's texture coordinates have low precision.
    u0, v0 = floor(min(u for u, _ in uvs)), floor(min(v for _, v in uvs))
    x, y = (sum(point[axis] for point in polygon) / len(polygon) for axis in (0, 1))
    mesh = pieces.at(x, y)
    corners: list[Vec3] = [(px, py, z) for px, py in polygon]
    mesh.patch(surface(mesh, texture), corners, [(u - u0, v - v0) for u, v in uvs])


def add_wall(pieces: Pieces, wall: Wall) -> None:
    """Build a wall: both long faces, the ends and the top."""
    box = wall.box
    length, thickness, height = box.size_m
    frame = Frame((box.centre_m[0], box.centre_m[1], 0.0), atan2(box.axis[1], box.axis[0]))
    tiling, edge = SURFACES[wall.texture], _mean(wall.texture, upper=True)
    y, tall = thickness / 2, height + _OVERLAP_M
    rise = 1.0 if tiling.height_m == 0 else height / tiling.height_m
    low, high = -_OVERLAP_M / height * rise, tall / height * rise
    if tiling.height_m == 0:
        low, high = 0.0, 1.0  # not repeated, else the skirting board would appear at the top
    for a, b in _cells(-length / 2, length / 2):
        mesh = pieces.at(*frame.point(((a + b) / 2, 0, 0))[:2])
        name = surface(mesh, wall.texture)
        for side, (left, right) in ((-1.0, (a, b)), (1.0, (b, a))):
            corners = [frame.point((u, side * y, z)) for u, z in
                       ((left, -_OVERLAP_M), (right, -_OVERLAP_M), (right, tall), (left, tall))]  # fmt: skip
            start = (left + length / 2) / tiling.width_m * -side
            start -= floor(start)
            mesh.quad(name, corners, ((b - a) / tiling.width_m, high - low), (start, low))
        mesh.face(edge, [frame.point((u, v, height)) for u, v in ((a, -y), (b, -y), (b, y), (a, y))])
    for end in (-1, 1):
        x = end * length / 2
        mesh = pieces.at(*frame.point((x, 0, 0))[:2])
        corners = [frame.point((x, v, z)) for v, z in ((-y, 0), (y, 0), (y, height), (-y, height))]
        mesh.face(edge, corners if end > 0 else corners[::-1])


def add_terrain(pieces: Pieces, terrain: Terrain) -> None:
    """Build terrain: the top in its texture, the sides in a darker mean colour of it."""
    tiling = SURFACES[terrain.texture]
    colour = _mean(terrain.texture, 0.85)
    half, line = terrain.size_m[1] / 2, terrain.profile()
    for (a, low), (b, high) in itertools.pairwise(line):
        for u0, u1 in _cells(a, b):
            h0, h1 = (low + (high - low) * (u - a) / (b - a) for u in (u0, u1))
            for v0, v1 in _cells(-half, half):
                corners = [terrain.point(*p) for p in ((u0, v0, h0), (u1, v0, h1), (u1, v1, h1), (u0, v1, h0))]
                mesh = pieces.at(*_middle(corners))
                start = (u0 / tiling.width_m, v0 / tiling.height_m)
                mesh.quad(
                    surface(mesh, terrain.texture), corners,
                    ((u1 - u0) / tiling.width_m, (v1 - v0) / tiling.height_m),
                    (start[0] - floor(start[0]), start[1] - floor(start[1])),
                )  # fmt: skip
            for v, ends in ((-half, ((u0, h0), (u1, h1))), (half, ((u1, h1), (u0, h0)))):
                (p, hp), (q, hq) = ends
                corners = [terrain.point(p, v, 0), terrain.point(q, v, 0), terrain.point(q, v, hq)]
                corners += [terrain.point(p, v, hp)] if hp > 0 else []
                pieces.at(*_middle(corners)).face(colour, corners)
    for u, h, turn in ((line[0][0], line[0][1], -1), (line[-1][0], line[-1][1], 1)):
        if h > 1e-6:
            corners = [terrain.point(u, -half, 0), terrain.point(u, half, 0), terrain.point(u, half, h),
                       terrain.point(u, -half, h)]  # fmt: skip
            pieces.at(*_middle(corners)).face(colour, corners if turn > 0 else corners[::-1])


def _extent(polygon: tuple[Vec2, ...]) -> tuple[float, float, float, float]:
    xs, ys = zip(*polygon, strict=True)
    return (min(xs), max(xs), min(ys), max(ys))


def _middle(corners: list[Vec3]) -> Vec2:
    return (sum(x for x, _, _ in corners) / len(corners), sum(y for _, y, _ in corners) / len(corners))


def _cells(start: float, end: float, cell_m: float = _CELL_M) -> list[tuple[float, float]]:
    """Divide a length into equal parts of at most a cell's length."""
    count = max(ceil((end - start) / cell_m - 1e-9), 1)
    edges = [start + (end - start) * k / count for k in range(count + 1)]
    return list(itertools.pairwise(edges))


def _mean(texture: str, brightness: float = 1.0, upper: bool = False) -> Colour:
    picture = surface_picture(texture)
    picture = picture[: len(picture) // 3] if upper else picture
    red, green, blue = (round(float(channel) * brightness) for channel in picture.reshape(-1, 3).mean(axis=0))
    return (red, green, blue)
