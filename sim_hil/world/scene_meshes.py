"""Appearance of a scene: floor, terrain, walls, ceiling and all objects as textured meshes; no physics."""

from __future__ import annotations

from collections.abc import Callable

from sim_hil.scene.scene import Scene, SceneObject
from sim_hil.world import equipment as world_equipment
from sim_hil.world import hung as world_hung
from sim_hil.world import indoor as world_indoor
from sim_hil.world import outdoor as world_outdoor
from sim_hil.world.drawing.kit import Kit
from sim_hil.world.drawing.mesh import MeshBuilder
from sim_hil.world.drawing.stage import Stage
from sim_hil.world.pieces import Pieces
from sim_hil.world.shell import add_ceiling, add_floor, add_terrain, add_wall
from sim_hil.world.wall_visibility import Bounds

BUILDERS: dict[str, Callable[[Kit], None]] = {
    **world_indoor.BUILDERS,
    **world_equipment.BUILDERS,
    **world_outdoor.BUILDERS,
    **world_hung.BUILDERS,
}


def add_object(mesh: MeshBuilder, thing: SceneObject) -> None:
    """Add one object to a mesh, at its place in the scene."""
    BUILDERS[thing.kind](Kit(mesh, thing))


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
