"""The scene's looks: floor, walls, ceiling and every kind of object as textured meshes; no physics.

Each kind is one function that builds an object in its own frame: origin at the middle of the underside, x to the front.
"""

from __future__ import annotations

from collections.abc import Callable
from math import pi, sin

import numpy as np

from sim_hil import textures
from sim_hil.mesh import Frame, MeshBuilder
from sim_hil.scene import Scene, SceneObject
from sim_hil.textures import rgb
from sim_hil.world_pieces import Pieces
from sim_hil.world_shell import add_ceiling, add_floor, add_terrain, add_wall
from sim_hil.world_stage import Stage


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


def build_scene(stage: Stage, scene: Scene) -> None:
    """Show everything of the scene that does not move."""
    pieces = Pieces()
    add_floor(pieces, scene)
    add_ceiling(pieces, scene)
    for terrain in scene.terrain:
        add_terrain(pieces, terrain)
    for wall in scene.walls:
        add_wall(pieces, wall)
    for thing in scene.objects:
        build = _BUILDERS.get(thing.kind, _light)
        build(pieces.at(thing.position_m[0], thing.position_m[1]), thing)
    for mesh in pieces.all():
        stage.add(mesh)
