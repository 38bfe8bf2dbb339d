"""The scene's looks: floor, raised ground, walls, ceiling and every object as textured meshes; no physics."""

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
    """Add one object to a mesh, where the scene has it."""
    BUILDERS[thing.kind](Kit(mesh, thing))


def build_scene(stage: Stage, scene: Scene) -> list[tuple[int, Bounds]]:
    """Show everything of the scene that does not move; the handle and the extent on the floor of each piece."""
    # Rooms hide each other, and small pieces follow that closely; in the open more pieces are only more work.
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
