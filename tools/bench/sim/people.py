"""What a crowd costs, whether it flows, and whether a robot can get through it.

    python -m tools.bench.sim.people --json out/bench/people.json
    python -m tools.bench.sim.people --scenes hospital --counts 20,60 --seconds 30 --drives 0

Three measurements, all per scene and number of people: CPU time of a step (1/30 s; of the thread, so that waiting for a
busy machine does not count) and of reading the rows for a renderer; the number of people who were ever stuck for more
than 15 s, and the smallest distances to each other and to walls; and drives from the scene's start to its goal of a
robot that knows where people are and does nothing but slow down and stop for those ahead: how often anybody's middle
came within 0.5 m of it.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from math import atan2, cos, hypot, pi, sin
from typing import Any

import numpy as np

from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE, check_result_target, command_line, write_result
from sim_hil.crowd.people import UPDATE_HZ, People
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Scene, SceneError, load_scene, scene_names

FAR_AWAY = (-1000.0, -1000.0, 0.0)
STUCK_S = 15.0
COLLISION_M = 0.5
ROBOT_RADIUS_M, CRUISE_MPS, DRIVE_LIMIT_S = 0.4, 0.8, 240.0


def crowd_run(scene: Scene, count: int, seed: int, seconds: float) -> dict[str, Any]:
    """Let a crowd live without a robot and watch it."""
    began = time.thread_time()
    people = People(scene, count, seed)
    build_s = time.thread_time() - began
    longest, step_ms, rows_ms = np.zeros(count), [], []
    closest_m = speed_mps = 0.0
    walls = NavGrid(scene, clearance_m=0.2, resolution_m=0.1, height_m=1.9, max_step_m=0.25) if count else None
    gaps, walls_m = [], []
    for step in range(round(seconds * UPDATE_HZ)):
        a = time.thread_time_ns()
        people.step(*FAR_AWAY)
        b = time.thread_time_ns()
        rows = people.render_rows()
        rows_ms.append((time.thread_time_ns() - b) / 1e6)
        step_ms.append((b - a) / 1e6)
        longest = np.maximum(longest, people.blocked_s())
        up = rows[rows[:, 6] == 0.0]
        if walls is not None and step % 10 == 0 and len(up) > 1:
            between = np.hypot(up[:, None, 0] - up[None, :, 0], up[:, None, 1] - up[None, :, 1])
            between[np.diag_indices(len(up))] = np.inf
            gaps.append(float(between.min()))
            walls_m.append(float(walls.clearances_at(up[:, :2]).min()))
            speed_mps = max(speed_mps, float(np.hypot(*people.velocities().T).max()))
    closest_m = min(gaps, default=float("nan"))
    return {
        "scene": scene.name, "people": count, "seed": seed, "build_s": build_s, "step_ms": step_ms, "rows_ms": rows_ms,
        "stuck": int((longest > STUCK_S).sum()), "closest_m": closest_m, "wall_m": min(walls_m, default=float("nan")),
        "fastest_mps": speed_mps,
    }  # fmt: skip


@dataclass
class Cart:
    """The robot of a drive: a point that turns, rolls, and stops for people ahead."""

    x: float
    y: float
    heading: float
    speed: float = 0.0

    def steer(self, target: tuple[float, float], people: People) -> float:
        """Turn rate rad/s; sets the speed, m/s, with 1 m/s2 at most."""
        off = (atan2(target[1] - self.y, target[0] - self.x) - self.heading + pi) % (2 * pi) - pi
        poses = people.poses()
        rx, ry = poses[:, 0] - self.x, poses[:, 1] - self.y
        ahead = rx * cos(self.heading) + ry * sin(self.heading)
        left = ry * cos(self.heading) - rx * sin(self.heading)
        before = (ahead > -0.1) & (np.abs(left) < 0.72)
        want = min(CRUISE_MPS, max(0.0, 0.7 * (float(ahead[before].min()) - 0.95))) if before.any() else CRUISE_MPS
        if abs(off) > 0.5:
            want = min(want, 0.1)
        self.speed += min(max(want - self.speed, -0.1), 0.1)
        return min(max(2.0 * off, -1.0), 1.0)


def drive(scene: Scene, nav: NavGrid, count: int, seed: int) -> dict[str, Any]:
    """One drive along the shortest path; raises ValueError when there is none."""
    path = nav.path((scene.start[0], scene.start[1]), scene.goal_xy)
    if path is None:
        raise ValueError(f"scene {scene.name}: its goal cannot be reached from its start")
    people = People(scene, count, seed)
    cart = Cart(path[0][0], path[0][1], atan2(path[1][1] - path[0][1], path[1][0] - path[0][0]))
    index, turn, closest_m, waited_s, step = 1, 0.0, float("inf"), 0.0, 0
    while step < DRIVE_LIMIT_S * UPDATE_HZ:
        while index < len(path) - 1 and hypot(path[index][0] - cart.x, path[index][1] - cart.y) < 0.3:
            index += 1
        if index == len(path) - 1 and hypot(path[-1][0] - cart.x, path[-1][1] - cart.y) < 1.5:
            break
        if step % 3 == 0:
            turn = cart.steer(path[index], people)
        cart.heading += turn / UPDATE_HZ
        cart.x += cart.speed * cos(cart.heading) / UPDATE_HZ
        cart.y += cart.speed * sin(cart.heading) / UPDATE_HZ
        people.step(cart.x, cart.y, cart.heading)
        waited_s += (cart.speed < 0.02) / UPDATE_HZ
        poses = people.poses()
        if count:
            closest_m = min(closest_m, float(np.hypot(poses[:, 0] - cart.x, poses[:, 1] - cart.y).min()))
        step += 1
    time_s = step / UPDATE_HZ
    return {
        "scene": scene.name, "people": count, "seed": seed, "closest_m": closest_m, "time_s": time_s,
        "waited_s": waited_s, "arrived": time_s < DRIVE_LIMIT_S,
    }  # fmt: skip


def _print_runs(runs: list[dict[str, Any]]) -> None:
    print("scene        people   build s   step ms mean    p99    max   rows ms   stuck   closest m   wall m")
    for run in runs:
        ms = np.array(run["step_ms"])
        rows_ms = float(np.mean(run["rows_ms"]))
        print(
            f"{run['scene']:<12} {run['people']:>6} {run['build_s']:>9.2f} {ms.mean():>14.3f}"
            f" {np.percentile(ms, 99):>6.2f} {ms.max():>6.2f} {rows_ms:>9.3f} {run['stuck']:>7}"
            f" {run['closest_m']:>11.2f} {run['wall_m']:>8.2f}"
        )


def _print_drives(drives: list[dict[str, Any]]) -> None:
    print("scene        people   drives   within 0.5 m   closest m   arrived   mean s   waited s")
    for scene, count in sorted({(row["scene"], row["people"]) for row in drives}):
        rows = [row for row in drives if (row["scene"], row["people"]) == (scene, count)]
        hits = sum(row["closest_m"] < COLLISION_M for row in rows)
        print(
            f"{scene:<12} {count:>6} {len(rows):>8} {hits:>14} {min(row['closest_m'] for row in rows):>11.2f}"
            f" {sum(row['arrived'] for row in rows):>9} {np.mean([row['time_s'] for row in rows]):>8.0f}"
            f" {np.mean([row['waited_s'] for row in rows]):>10.0f}"
        )


@command_line("people")
def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--scenes", default=",".join(scene_names()), help="names or files (default: all of ours)")
    p.add_argument("--counts", default="0,20,60,200", help="people; what a scene has no room for is left out")
    p.add_argument("--seconds", type=float, default=60.0, help="simulated time of each crowd (default: 60)")
    p.add_argument("--drives", type=int, default=5, help="drives a scene and count (default: 5)")
    p.add_argument("--seed", type=int, default=0, help="first seed (default: 0)")
    p.add_argument("--json", metavar="FILE|-")
    args = p.parse_args(argv)
    runs: list[dict[str, Any]] = []
    drives: list[dict[str, Any]] = []
    try:
        check_result_target(args.json)
        counts = [int(text) for text in args.counts.split(",")]
        for scene in (load_scene(name) for name in args.scenes.split(",")):
            nav = NavGrid(scene, clearance_m=ROBOT_RADIUS_M)
            for count in counts:
                try:
                    runs.append(crowd_run(scene, count, args.seed, args.seconds))
                except ValueError as error:
                    sys.stderr.write(f"{scene.name} {count}: left out: {error}\n")
                    continue
                drives += [drive(scene, nav, count, args.seed + k) for k in range(args.drives if count else 0)]
                sys.stderr.write(f"{scene.name} {count}: done\n")
    except (OSError, ValueError, SceneError) as error:
        sys.stderr.write(f"{error}\n")
        return EXIT_BAD_INPUT
    write_result(args.json, {"crowds": runs, "drives": drives, "tagged": "measured"})
    if args.json != "-":
        _print_runs(runs)
        if drives:
            _print_drives(drives)
    return EXIT_DONE if runs else EXIT_CHECK_FAILED


if __name__ == "__main__":
    sys.exit(main())
