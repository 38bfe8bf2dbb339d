"""Contact sheets: every kind of object from a robot's height, or a robot's views in a scene."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import ceil, cos, hypot, pi, radians, sin
from pathlib import Path

import numpy as np

from edge.core.cli import check_result_target, command_line, write_named
from sim_hil.scene.kinds import Kind
from sim_hil.scene.scene import KINDS, Scene, SceneError, SceneObject, Wall, load_scene, scene_names
from sim_hil.simulation.camera import CAMERA_HFOV_RAD
from sim_hil.simulation.renderer import Renderer
from sim_hil.world.drawing.textures import DARK, WHITE, Image, plain, png_bytes, write
from sim_hil.world.scene_meshes import build_scene

EYE_M = 0.36  # the Go2's camera, standing
_STRIP_PX = 22
_TEXTS = {"door": "101", "storage_rack": "A3", "building": "CITY HALL", "storefront": "BAKERY", "sign": "RECEPTION >>",
          "room_sign": "204", "notice_board": "NOTICES", "double_door": "WARD B", "statue": "1888", "kiosk": "NEWS",
          "sign_post": "STATION"}  # fmt: skip
_HUNG_M = {"window": 1.0, "notice_board": 1.0, "whiteboard": 0.9, "screen": 1.2, "painting": 1.3, "clock": 2.0,
           "sign": 1.9, "room_sign": 1.4, "exit_sign": 2.0, "light": 2.4, "awning": 2.2}  # fmt: skip


@dataclass(frozen=True)
class View:
    """One image of a sheet: name, viewpoint and heading."""

    name: str
    eye_m: tuple[float, float, float]
    heading_rad: float


def showroom(kind: Kind) -> Scene:
    """Return a scene with one object of a kind at the origin, with a wall behind flat objects."""
    z = _HUNG_M.get(kind.name, 0.0)
    thing = SceneObject(
        "it", kind.name, (0.0, 0.0, z), 0.0, kind.size_m, kind.colour, _TEXTS.get(kind.name, ""), kind.words
    )
    depth, width, _ = kind.size_m
    walls: tuple[Wall, ...] = ()
    if not kind.solid and kind.name not in ("carpet", "light"):
        half = max(width, 3.0)
        walls = (Wall("wall", (-depth / 2 - 0.08, -half), (-depth / 2 - 0.08, half), 0.15, 3.4, "wall_office"),)
    return Scene(
        kind.name, (8.0, 0.0, pi), (6.0, 0.0), (-30.0, -30.0), (30.0, 30.0), "concrete", 0.0, walls, (thing,), ()
    )


def view_of(kind: Kind) -> View:
    """Return a viewpoint at a robot's height from which the object fills most of a 16:9 image of 100 degrees."""
    depth, width, height = kind.size_m
    top = _HUNG_M.get(kind.name, 0.0) + height
    # From the front and slightly aside, so that the sides are visible.
    gap = max(0.62 * width, 1.7 * (top - EYE_M), 0.6 * depth, 0.7) + depth / 2
    turn = radians(28.0 if kind.solid else 15.0)
    return View(kind.name, (gap * cos(turn), gap * sin(turn), EYE_M), turn + pi)


def kinds_sheet(names: Sequence[str], columns: int, width: int, height: int) -> Image:
    """Render one named tile per kind."""
    tiles = []
    for name in names:
        with _shown(showroom(KINDS[name])) as renderer:
            tiles.append(_tile(renderer, view_of(KINDS[name]), width, height, width / height))
    return _tiled(tiles, columns)


def scene_views(scene: Scene, count: int) -> Iterator[View]:
    """Return viewpoints: the start, then well-visible views of each landmark, then the centres of named areas."""
    yield View("start", (*scene.start[:2], EYE_M + scene.ground_height_m(*scene.start[:2])), scene.start[2])
    picked: list[View] = []
    for thing in scene.landmarks():
        (x, y, _), (depth, width, height) = thing.position_m, thing.size_m
        gap = depth / 2 + max(1.2 * width, 1.2 * height, 1.5)
        for turn in (0.0, 0.5, -0.5):
            heading = thing.heading_rad + turn
            ex, ey = x + gap * cos(heading), y + gap * sin(heading)
            if _free(scene, ex, ey):
                eye = (ex, ey, EYE_M + scene.ground_height_m(ex, ey))
                picked.append(View(thing.landmark, eye, heading + pi))
                break
    for area in scene.areas:
        x, y = (sum(point[axis] for point in area.polygon) / len(area.polygon) for axis in (0, 1))
        if _free(scene, x, y):
            a, b = max(
                zip(area.polygon, area.polygon[1:] + area.polygon[:1], strict=True),
                key=lambda edge: hypot(edge[1][0] - edge[0][0], edge[1][1] - edge[0][1]),
            )
            heading = float(np.arctan2(b[1] - a[1], b[0] - a[0]))
            picked.append(View(area.name, (x, y, EYE_M + scene.ground_height_m(x, y)), heading))
    step = max(len(picked) / max(count - 1, 1), 1.0)
    for index in range(min(count - 1, len(picked))):
        yield picked[int(index * step)]


def scene_sheet(scene: Scene, count: int, columns: int, width: int, height: int) -> Image:
    """Render a robot's views of a scene; square images are scaled like a policy's input."""
    with _shown(scene) as renderer:
        tiles = [_tile(renderer, view, width, height, 16 / 9) for view in scene_views(scene, count)]
    return _tiled(tiles, columns)


@contextmanager
def _shown(scene: Scene) -> Iterator[Renderer]:
    renderer = Renderer(scene.sky)
    try:
        build_scene(renderer, scene)
        yield renderer
    finally:
        renderer.close()


def _free(scene: Scene, x: float, y: float) -> bool:
    (x0, y0), (x1, y1) = scene.floor_min_m, scene.floor_max_m
    if not (x0 < x < x1 and y0 < y < y1):
        return False
    for _, box in scene.obstacles():
        dx, dy = x - box.centre_m[0], y - box.centre_m[1]
        u, v = dx * box.axis[0] + dy * box.axis[1], dy * box.axis[0] - dx * box.axis[1]
        if abs(u) < box.size_m[0] / 2 + 0.3 and abs(v) < box.size_m[1] / 2 + 0.3:
            return False
    return True


def _tile(renderer: Renderer, view: View, width: int, height: int, aspect: float) -> Image:
    forward = np.array((cos(view.heading_rad), sin(view.heading_rad), 0.0))
    picture = renderer.picture(
        np.array(view.eye_m), forward, np.array((0.0, 0.0, 1.0)), CAMERA_HFOV_RAD, width, height, aspect
    )
    strip = plain(width, _STRIP_PX, DARK)
    write(strip, view.name, 0.01, 0.08, 0.99, 0.92, WHITE)
    return np.vstack((picture, strip))


def _tiled(tiles: list[Image], columns: int) -> Image:
    rows = ceil(len(tiles) / columns)
    height, width = tiles[0].shape[:2]
    sheet = plain(columns * (width + 4), rows * (height + 4), DARK)
    for index, tile in enumerate(tiles):
        y, x = index // columns * (height + 4), index % columns * (width + 4)
        sheet[y : y + height, x : x + width] = tile
    return sheet


@command_line("world_sheet")
def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m sim_hil.simulation.contact_sheet",
        description="Picture of every kind of object, or of a scene, as a robot sees it (0.36 m high, 100 degrees).",
        epilog="examples:\n  python -m sim_hil.simulation.contact_sheet --out kinds.png\n"
        "  python -m sim_hil.simulation.contact_sheet --kind forklift --kind pallet --out two.png\n"
        "  python -m sim_hil.simulation.contact_sheet --scene hospital --views 24 --size 128x128 --out hospital.png",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--out", required=True, metavar="FILE.png")
    parser.add_argument("--kind", action="append", choices=sorted(KINDS), metavar="KIND", help="may be repeated")
    parser.add_argument("--scene", metavar="NAME|FILE", help=f"one of {', '.join(scene_names())}, or a TOML file")
    parser.add_argument("--views", type=int, default=18, metavar="N", help="pictures of a scene (default 18)")
    parser.add_argument("--size", default="320x180", metavar="WxH", help="of each picture (default 320x180)")
    parser.add_argument("--columns", type=int, default=0, metavar="N", help="default: about 1300 pixels across")
    args = parser.parse_args(argv)
    try:
        width, height = (int(part) for part in args.size.split("x"))
        if min(width, height, args.views) < 1 or args.columns < 0 or max(width, height) > 4096:
            raise ValueError
    except ValueError:
        parser.error(f"--size, --views, --columns: expected e.g. 320x180 and positive numbers, found {args.size}")
    columns = args.columns or max(1300 // (width + 4), 1)
    try:
        check_result_target(args.out, "--out")
        if args.scene:
            sheet = scene_sheet(load_scene(args.scene), args.views, columns, width, height)
        else:
            sheet = kinds_sheet(args.kind or sorted(KINDS), columns, width, height)
        write_named(Path(args.out), png_bytes(sheet))
    except (SceneError, OSError) as error:
        sys.stderr.write(f"world_sheet: {error}\n")
        return 2
    sys.stderr.write(f"world_sheet: wrote {args.out}, {sheet.shape[1]} x {sheet.shape[0]} pixels\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
