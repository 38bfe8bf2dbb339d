"""Milliseconds for a picture of the camera: small and wide, in small and large scenes, with more and more people.

    python -m tools.bench.sim.render --json out/bench/render.json
    python -m tools.bench.sim.render --scene warehouse --people 20 --frames 300

Every frame is from another spot and heading where the robot fits, so nothing is as the frame before left it; people
stand where the crowd starts. `tiny` is PyBullet's own software renderer with the same meshes, for comparison: it draws
everything, wherever it is. All frames are drawn in several rounds, and of each frame the fastest counts, in processor
time of the one thread that draws: what a picture costs when nobody else wants the machine. All samples are kept.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from math import atan, cos, degrees, pi, sin, tan
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pybullet
from numpy.typing import NDArray

from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE, check_result_target, command_line, write_result
from sim_hil.crowd.people import RENDER_FIELDS, People, appearances
from sim_hil.robots.go2.body import RENDER_FIELDS as ROBOT_FIELDS
from sim_hil.scene.scene import Scene, SceneError, load_scene
from sim_hil.simulation.camera import CAMERA_HFOV_RAD, CameraWorld
from sim_hil.simulation.person_body import PersonBody
from sim_hil.world.drawing.stage import BulletStage
from sim_hil.world.scene_meshes import build_scene

Array = NDArray[np.float64]
SIZES = {"128x128": (128, 128, 16 / 9), "320x180": (320, 180, 16 / 9)}
EYE_M = 0.36
ROUNDS = 7
TINY_FRAMES, TINY_ROUNDS = 10, 3
_STANDING = (0.0, 0.85, -1.7) * 4


@dataclass(frozen=True)
class Timing:
    """One row: milliseconds a picture, over frames (the fastest of the rounds each); `raw_ms` is [round][frame]."""

    renderer: str
    scene: str
    objects: int
    people: int
    size: str
    build_ms: float
    p50_ms: float
    p95_ms: float
    all_p50_ms: float
    raw_ms: tuple[tuple[float, ...], ...]


def views(scene: Scene, count: int, seed: int) -> list[tuple[float, float, float]]:
    """Spots at least 0.4 m from every obstacle, each with a heading."""
    rng = np.random.default_rng((seed, 71))
    boxes = [box for _, box in scene.obstacles()]
    centres = np.array([box.centre_m[:2] for box in boxes]).reshape(-1, 2)
    axes = np.array([box.axis for box in boxes]).reshape(-1, 2)
    halves = np.array([box.size_m[:2] for box in boxes]).reshape(-1, 2) / 2 + 0.4
    found: list[tuple[float, float, float]] = []
    while len(found) < count:
        x, y = rng.uniform(scene.floor_min_m, scene.floor_max_m)
        d = np.array((x, y)) - centres
        along, across = (d * axes).sum(axis=1), d[:, 1] * axes[:, 0] - d[:, 0] * axes[:, 1]
        if not ((np.abs(along) < halves[:, 0]) & (np.abs(across) < halves[:, 1])).any():
            found.append((float(x), float(y), float(rng.uniform(-pi, pi))))
    return found


def _measure(frames: int, rounds: int, draw: Callable[[int], object]) -> Array:
    """Processor time, ms [round, frame], after a round that builds the people's bodies, as an episode's start does."""
    samples = np.zeros((rounds + 1, frames))
    for turn in range(rounds + 1):
        for index in range(frames):
            begin_ns = time.thread_time_ns()
            draw(index)
            samples[turn, index] = (time.thread_time_ns() - begin_ns) / 1e6
    return samples[1:]


def time_ours(scene: Scene, people: int, rows: Array, sizes: list[str], frames: int, seed: int) -> list[Timing]:
    """CameraWorld.render."""
    begin_ns = time.thread_time_ns()
    world = CameraWorld(scene, people=people, seed=seed)
    spots = views(scene, frames, seed)
    states = [
        np.array((x, y, 0.31 + scene.ground_height_m(x, y), 0, 0, sin(h / 2), cos(h / 2), *_STANDING, *rows.ravel()))
        for x, y, h in spots
    ]
    world.render(states[0], 128, 128, 16 / 9)
    build_ms = (time.thread_time_ns() - begin_ns) / 1e6
    made = []
    for size in sizes:
        width, height, aspect = SIZES[size]
        samples = _measure(frames, ROUNDS, partial(_render, world, states, (width, height, aspect)))
        made.append(_timing("ours", scene, people, size, build_ms, samples))
    world.close()
    return made


def _render(world: CameraWorld, states: list[Array], shape: tuple[int, int, float], index: int) -> None:
    world.render(states[index], *shape)


def time_tiny(scene: Scene, people: int, rows: Array, sizes: list[str], seed: int) -> list[Timing]:
    """PyBullet's TinyRenderer on the same meshes."""
    begin_ns = time.thread_time_ns()
    client = pybullet.connect(pybullet.DIRECT)
    with TemporaryDirectory(prefix="edge-bench-render-") as folder:
        stage = BulletStage(client, Path(folder))
        build_scene(stage, scene)
        bodies = [PersonBody(stage, look) for look in appearances(people, seed, scene.name)]
    build_ms = (time.thread_time_ns() - begin_ns) / 1e6
    spots = views(scene, TINY_FRAMES, seed)
    made = []
    for size in sizes:
        width, height, aspect = SIZES[size]
        vertical = degrees(2 * atan(tan(CAMERA_HFOV_RAD / 2) / aspect))
        projection = pybullet.computeProjectionMatrixFOV(vertical, aspect, 0.02, 60.0)

        def draw(index: int, w: int = width, h: int = height, lens: object = projection) -> None:
            x, y, heading = spots[index]
            for body, row in zip(bodies, rows, strict=True):
                body.pose(row)
            target = (x + cos(heading), y + sin(heading), EYE_M)
            eye = pybullet.computeViewMatrix((x, y, EYE_M), target, (0.0, 0.0, 1.0))
            pybullet.getCameraImage(
                w, h, eye, lens, shadow=0, renderer=pybullet.ER_TINY_RENDERER,
                flags=pybullet.ER_NO_SEGMENTATION_MASK, physicsClientId=client,
            )  # fmt: skip

        samples = _measure(TINY_FRAMES, TINY_ROUNDS, draw)
        made.append(_timing("tiny", scene, people, size, build_ms, samples))
    pybullet.disconnect(client)
    return made


def _timing(renderer: str, scene: Scene, people: int, size: str, build_ms: float, samples: Array) -> Timing:
    best = samples.min(axis=0)
    p50, p95, everything = (
        round(float(value), 3) for value in (np.percentile(best, 50), np.percentile(best, 95), np.median(samples))
    )
    raw = tuple(tuple(round(float(sample), 3) for sample in turn) for turn in samples)
    return Timing(renderer, scene.name, len(scene.objects), people, size, round(build_ms, 1), p50, p95, everything, raw)


@command_line("render")
def main(argv: list[str] | None = None) -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.bench.sim.render",
        description="Time the camera's renderer.",
        epilog="example: python -m tools.bench.sim.render --scene sidewalk --people 200 --json out/bench/render.json",
    )
    parser.add_argument("--scene", action="append", metavar="NAME|FILE", help="default: corridor, hospital, sidewalk")
    parser.add_argument("--people", action="append", type=int, metavar="N", help="default: 0, 20, 60 and 200")
    parser.add_argument("--size", action="append", choices=sorted(SIZES), help="default: both")
    parser.add_argument("--frames", type=int, default=40, metavar="N", help="spots a row (default 40)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--without-tiny", action="store_true", help="leave the comparison out")
    parser.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    args = parser.parse_args(argv)
    if args.frames < 1 or any(count < 0 for count in args.people or ()):
        parser.error("--frames, --people: expected positive numbers")
    try:
        check_result_target(args.json)
        scenes = [load_scene(name) for name in args.scene or ("corridor", "hospital", "sidewalk")]
    except (SceneError, OSError) as error:
        sys.stderr.write(f"bench render: {error}\n")
        return EXIT_BAD_INPUT
    sizes = args.size or sorted(SIZES)
    timings: list[Timing] = []
    for scene in scenes:
        for count in args.people or (0, 20, 60, 200):
            try:
                rows = People(scene, count, args.seed).render_rows()
            except ValueError as error:
                sys.stderr.write(f"{scene.name}, {count} people: left out: {error}\n")
                continue
            assert rows.shape == (count, RENDER_FIELDS) and len(_STANDING) + 7 == ROBOT_FIELDS
            made = time_ours(scene, count, rows, sizes, args.frames, args.seed)
            if not args.without_tiny:
                made += time_tiny(scene, count, rows, sizes, args.seed)
            for row in made:
                sys.stderr.write(
                    f"{row.renderer:5} {row.scene:10} {row.people:4d} people {row.size}: {row.p50_ms:8.2f} ms"
                    f" (p95 {row.p95_ms:.2f}, of all samples {row.all_p50_ms:.2f}); ready after {row.build_ms:.0f} ms\n"
                )
            timings += made
    write_result(args.json, {"frames": args.frames, "timings": [asdict(row) for row in timings]})
    return EXIT_DONE if timings else EXIT_CHECK_FAILED


if __name__ == "__main__":
    sys.exit(main())
