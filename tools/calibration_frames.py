"""Renders the shipped calibration sets: `python -m tools.calibration_frames --out DIR` writes DIR/corridor-go2.

A simulated Go2 walks a corridor among people; each second its camera frame is stored with pose and velocity. The same
call writes the same bytes on the same machine and versions.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from edge.core.cli import EXIT_BAD_INPUT, EXIT_DONE
from edge.core.geometry import SE2, wrap_angle
from export.evaluation.calibration import CLIP_S, Frame
from firmware_bridge.system.terminal import CommandParser
from sim_hil.scene.scene import load_scene
from sim_hil.simulation.camera import CameraWorld
from sim_hil.simulation.physics import Simulation, SportAction

WIDTH, HEIGHT = 320, 180
JPEG_QUALITY = 82
CONTROL_S = 0.1
SLOW_AT_M, STOP_AT_M = 2.0, 0.9


@dataclass(frozen=True)
class Walk:
    """One clip: people, the robot's walk, and the second at which recording begins."""

    name: str
    seed: int
    people: int
    speed_mps: float
    weave_rad: float
    """Swing of the robot's heading to both sides, so that motion offsets are not all straight, rad."""
    period_s: float
    start_s: float
    instruction: str


WALKS = (
    Walk("vending", 3, 6, 0.5, 0.15, 11.0, 0.0, "walk down the corridor and stop at the vending machine"),
    Walk("passing", 11, 8, 0.7, 0.25, 8.0, 9.0, "pass the water dispenser and wait at the vending machine"),
    Walk("crossing", 29, 8, 0.4, 0.35, 14.0, 4.0, "continue slowly and keep a safe distance from the people"),
)


class WalkError(RuntimeError):
    """Walk with a fall or a collision, unusable for calibration."""


def record(walk: Walk, duration_s: float = CLIP_S) -> Iterator[Frame]:
    """Yield a frame per second for `duration_s`, stamps from 0, poses from the robot's start. Raises WalkError."""
    scene = load_scene("corridor")
    simulation = Simulation(scene, people=walk.people, seed=walk.seed)
    world = CameraWorld(scene, people=walk.people, seed=walk.seed)
    try:
        for action, seconds in ((SportAction.STAND_UP, 2.0), (SportAction.BALANCE_STAND, 0.2)):
            simulation.sport(action)
            _steps(simulation, seconds)
        ticks = round((walk.start_s + duration_s) / CONTROL_S)
        first, every = round(walk.start_s / CONTROL_S), round(1.0 / CONTROL_S)
        for tick in range(ticks + 1):
            if tick >= first and (tick - first) % every == 0:
                yield _frame(simulation, world, (tick - first) * 100_000_000)
            simulation.command(*_command(simulation, walk, tick * CONTROL_S))
            _steps(simulation, CONTROL_S)
        if simulation.fell or simulation.collided_with():
            raise WalkError(f"walk {walk.name}: fell or touched {sorted(simulation.collided_with())}")
    finally:
        world.close()
        simulation.close()


def _steps(simulation: Simulation, seconds: float) -> None:
    for _ in range(round(seconds / Simulation.DT_S)):
        simulation.step()


def _command(simulation: Simulation, walk: Walk, time_s: float) -> tuple[float, float, float]:
    """Steer a weaving line along the corridor's middle; slow down for people ahead and turn away from them."""
    truth = simulation.truth()
    x, y, heading = float(truth.position_m[0]), float(truth.position_m[1]), float(truth.rpy_rad[2])
    speed, aside = walk.speed_mps, 0.0
    for px, py, _ in simulation.people():
        distance = math.hypot(px - x, py - y)
        bearing = wrap_angle(math.atan2(py - y, px - x) - heading)
        if abs(bearing) < math.radians(50) and distance < SLOW_AT_M:
            speed = min(speed, walk.speed_mps * max(0.0, (distance - STOP_AT_M) / (SLOW_AT_M - STOP_AT_M)))
            aside -= math.copysign(0.3, bearing)
    wanted = walk.weave_rad * math.sin(2 * math.pi * time_s / walk.period_s) - 0.6 * y + aside
    turn = max(-0.8, min(0.8, 1.5 * wrap_angle(wanted - heading)))
    return speed, 0.0, turn


def _frame(simulation: Simulation, world: CameraWorld, stamp_ns: int) -> Frame:
    truth = simulation.truth()
    heading = float(truth.rpy_rad[2])
    vx, vy = (float(v) for v in truth.velocity_world_mps[:2])
    c, s = math.cos(heading), math.sin(heading)
    pose = SE2(round(float(truth.position_m[0]), 3), round(float(truth.position_m[1]), 3), round(heading, 4))
    velocity = (round(c * vx + s * vy, 3), round(c * vy - s * vx, 3), round(float(truth.gyro_radps[2]), 3))
    return Frame(stamp_ns, world.render(simulation.render_state(), WIDTH, HEIGHT), pose, velocity)


def encode(frame: Frame) -> bytes:
    """Encode the frame's picture as JPEG."""
    bgr = cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR)
    return bytes(np.asarray(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]))


def write_set(directory: Path) -> None:
    """Render every walk into `directory` (pictures and set.toml). Raises WalkError, OSError."""
    directory.mkdir(parents=True, exist_ok=True)
    lines = [
        "# Written by `python -m tools.calibration_frames`; do not edit: the hash of these files goes into manifests.",
        "schema = 1",
        f'name = "{directory.name}"',
        f'description = "{len(WALKS)} walks of {CLIP_S:.0f} s of the simulated Go2 among people, corridor scene"',
    ]
    for walk in WALKS:
        lines += ["", "[[clips]]", f'name = "{walk.name}"', f'instruction = "{walk.instruction}"', "frames = ["]
        for number, frame in enumerate(record(walk)):
            file = f"{walk.name}-{number:02d}.jpg"
            (directory / file).write_bytes(encode(frame))
            pose, velocity = list(frame.T_odom_base.as_tuple()), list(frame.velocity)
            stamp_s = frame.stamp_ns / 1e9
            lines.append(f'    {{ file = "{file}", stamp_s = {stamp_s:.1f}, pose = {pose}, velocity = {velocity} }},')
        lines.append("]")
    (directory / "set.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    parser = CommandParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="example:\n  python -m tools.calibration_frames --out export/evaluation/calibration_sets",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write corridor-go2/ into")
    args = parser.parse_args(argv)
    directory = args.out / "corridor-go2"
    try:
        write_set(directory)
    except (OSError, WalkError) as error:
        print(f"calibration_frames: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    size = sum(path.stat().st_size for path in directory.iterdir())
    print(f"calibration_frames: {directory}: {size / 1000:.0f} kB", file=sys.stderr)
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
