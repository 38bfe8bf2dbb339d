"""The scene's looks: floor, walls, ceiling and every kind of object as textured meshes; no physics.

Each kind is one function that builds an object in its own frame: origin at the middle of the underside, x to the front.
"""

from __future__ import annotations

from collections.abc import Callable
from math import ceil, pi, sin

import numpy as np

from sim_hil import textures
from sim_hil.mesh import Frame, MeshBuilder, Vec3
from sim_hil.scene import Scene, SceneObject, Wall
from sim_hil.textures import rgb
from sim_hil.world_stage import Stage

_PATCH_M = 2.0  # large surfaces are cut up: a face that reaches behind the camera costs precision
_WALL_EDGE = (206, 200, 186)


def _textured(
    mesh: MeshBuilder, thing: SceneObject, drawing: Callable[[SceneObject], textures.Image], suffix: str
) -> str:
    return mesh.picture(f"{thing.label} {suffix}", drawing(thing))


def _slab(mesh: MeshBuilder, thing: SceneObject, drawing: Callable[[SceneObject], textures.Image]) -> None:
    depth, width, height = thing.size_m
    frame = Frame(thing.position_m, thing.heading_rad)
    front = _textured(mesh, thing, drawing, "front")
    mesh.box(frame, (0, 0, height / 2), (depth, width, height), rgb(thing.colour, 0.6), front)


def _vending_machine(mesh: MeshBuilder, thing: SceneObject) -> None:
    depth, width, height = thing.size_m
    frame = Frame(thing.position_m, thing.heading_rad)
    front = _textured(mesh, thing, textures.vending_front, "front")
    sides = _textured(mesh, thing, textures.vending_side, "side")
    mesh.box(frame, (0, 0, height / 2), (depth, width, height), rgb(thing.colour, 0.7), front, sides)


def _bench(mesh: MeshBuilder, thing: SceneObject) -> None:
    depth, width, height = thing.size_m
    frame = Frame(thing.position_m, thing.heading_rad)
    wood, metal = rgb(thing.colour), (70, 72, 76)
    for row in (-1, 0, 1):
        mesh.box(frame, (row * depth / 3, 0, height - 0.02), (depth * 0.29, width, 0.04), wood)
    for side in (-1, 1):
        mesh.box(frame, (0, side * width * 0.4, (height - 0.04) / 2), (depth * 0.8, 0.06, height - 0.04), metal)


def _plant(mesh: MeshBuilder, thing: SceneObject) -> None:
    depth, width, height = thing.size_m
    frame = Frame(thing.position_m, thing.heading_rad)
    pot = 0.30 * height
    mesh.prism(
        frame, (((0, 0, 0), 0.28 * depth, 0.28 * width), ((0, 0, pot), 0.40 * depth, 0.40 * width)), (176, 92, 58)
    )
    mesh.prism(frame, (((0, 0, pot), 0.03, 0.03), ((0, 0, 0.7 * height), 0.02, 0.02)), (92, 66, 40), 5)
    rng = np.random.default_rng(round(abs(thing.position_m[0]) * 100))
    for index in range(7):
        turn, out = 2 * pi * index / 7, 0.20 + 0.12 * rng.random()
        x, y = out * depth * float(np.cos(turn)), out * width * sin(turn)
        z = height * (0.5 + 0.30 * rng.random())
        shade = 0.8 + 0.45 * rng.random()
        mesh.ball(frame, (x, y, z), (0.20 * depth, 0.20 * width, 0.13 * height), rgb(thing.colour, shade), 6)
    mesh.ball(frame, (0, 0, 0.87 * height), (0.22 * depth, 0.22 * width, 0.13 * height), rgb(thing.colour, 1.1), 6)


def _water_dispenser(mesh: MeshBuilder, thing: SceneObject) -> None:
    depth, width, height = thing.size_m
    frame = Frame(thing.position_m, thing.heading_rad)
    front = _textured(mesh, thing, textures.dispenser_front, "front")
    body = 0.68 * height
    mesh.box(frame, (0, 0, body / 2), (depth, width, body), rgb(thing.colour, 0.95), front)
    rings = ((body, 0.22), (body + 0.04, 0.42), (height - 0.04, 0.42), (height, 0.34))
    bottle = tuple(((0.0, 0.0, z), share * depth, share * width) for z, share in rings)
    mesh.prism(frame, bottle, (96, 170, 232))


def _trash_bin(mesh: MeshBuilder, thing: SceneObject) -> None:
    depth, width, height = thing.size_m
    frame = Frame(thing.position_m, thing.heading_rad)
    front = _textured(mesh, thing, textures.bin_front, "front")
    mesh.box(frame, (0, 0, 0.48 * height), (depth, width, 0.96 * height), rgb(thing.colour), front)
    mesh.box(frame, (0, 0, 0.98 * height), (depth * 1.05, width * 1.05, 0.04 * height), (40, 42, 46))


def _fire_extinguisher(mesh: MeshBuilder, thing: SceneObject) -> None:
    depth, width, height = thing.size_m
    frame = Frame(thing.position_m, thing.heading_rad)
    rings = ((0.0, 0.46), (0.68, 0.46), (0.78, 0.2))
    mesh.prism(frame, tuple(((0, 0, s * height), r * depth, r * width) for s, r in rings), rgb(thing.colour))
    mesh.box(frame, (0, 0, 0.84 * height), (0.3 * depth, 0.3 * width, 0.12 * height), (30, 30, 32))
    mesh.box(frame, (0.1 * depth, 0, 0.93 * height), (0.8 * depth, 0.2 * width, 0.06 * height), (30, 30, 32))
    mesh.box(frame, (0.47 * depth, 0, 0.38 * height), (0.02, 0.5 * width, 0.25 * height), (245, 240, 220))


def _cabinet(mesh: MeshBuilder, thing: SceneObject) -> None:
    _slab(mesh, thing, textures.cabinet_front)


def _light(mesh: MeshBuilder, thing: SceneObject) -> None:
    depth, width, height = thing.size_m
    frame = Frame(thing.position_m, thing.heading_rad)
    mesh.box(frame, (0, 0, height / 2), (depth, width, height), rgb(thing.colour))


_BUILDERS: dict[str, Callable[[MeshBuilder, SceneObject], None]] = {
    "vending_machine": _vending_machine,
    "bench": _bench,
    "plant": _plant,
    "water_dispenser": _water_dispenser,
    "trash_bin": _trash_bin,
    "fire_extinguisher": _fire_extinguisher,
    "cabinet": _cabinet,
    "light": _light,
    "door": lambda mesh, thing: _slab(mesh, thing, textures.door),
    "notice_board": lambda mesh, thing: _slab(mesh, thing, textures.notice_board),
    "sign": lambda mesh, thing: _slab(mesh, thing, textures.sign),
    "window": lambda mesh, thing: _slab(mesh, thing, textures.window),
}


def _level_patches(mesh: MeshBuilder, texture: str, scene: Scene, z: float, period_m: float, up: bool) -> None:
    """A horizontal surface over the whole floor, seen from above or from below."""
    (x0, y0), (x1, y1) = scene.floor_min_m, scene.floor_max_m
    columns, rows = ceil((x1 - x0) / _PATCH_M), ceil((y1 - y0) / _PATCH_M)
    for i in range(columns):
        for j in range(rows):
            a, b = x0 + i * _PATCH_M, min(x0 + (i + 1) * _PATCH_M, x1)
            c, d = y0 + j * _PATCH_M, min(y0 + (j + 1) * _PATCH_M, y1)
            corners: list[Vec3] = [(a, c, z), (b, c, z), (b, d, z), (a, d, z)]
            if not up:
                corners = [(a, d, z), (b, d, z), (b, c, z), (a, c, z)]
            mesh.quad(texture, corners, ((b - a) / period_m, (d - c) / period_m))


def _wall(mesh: MeshBuilder, wall: Wall) -> None:
    """Both long faces in patches, plus the ends and the top in a plain colour."""
    box = wall.box
    length, thickness, height = box.size_m
    frame = Frame((box.centre_m[0], box.centre_m[1], 0.0), float(np.arctan2(box.axis[1], box.axis[0])))
    patches = ceil(length / _PATCH_M)
    for index in range(patches):
        a = -length / 2 + index * _PATCH_M
        b = min(a + _PATCH_M, length / 2)
        for side in (-1.0, 1.0):
            left, right = (a, b) if side < 0 else (b, a)
            y = side * thickness / 2
            corners = [frame.point(p) for p in ((left, y, 0), (right, y, 0), (right, y, height), (left, y, height))]
            mesh.quad(wall.texture, corners, ((b - a) / 2.0, 1.0))
        y = thickness / 2
        mesh.face(
            _WALL_EDGE, [frame.point(p) for p in ((a, -y, height), (b, -y, height), (b, y, height), (a, y, height))]
        )
    for end in (-1, 1):
        mesh.box(frame, (end * length / 2, 0, height / 2), (0.01, thickness, height), _WALL_EDGE)


def build_scene(stage: Stage, scene: Scene) -> None:
    """Show everything of the scene that does not move."""
    mesh = MeshBuilder()
    mesh.picture("floor_tiles", textures.floor_tiles())
    mesh.picture("wall_wainscot", textures.wall_wainscot())
    mesh.picture("ceiling_panels", textures.ceiling_panels())
    _level_patches(mesh, scene.floor_texture, scene, 0.0, 2.0, up=True)
    if scene.ceiling_height_m > 0:
        _level_patches(mesh, "ceiling_panels", scene, scene.ceiling_height_m, 1.2, up=False)
    for wall in scene.walls:
        _wall(mesh, wall)
    for thing in scene.objects:
        _BUILDERS[thing.kind](mesh, thing)
    stage.add(mesh)
