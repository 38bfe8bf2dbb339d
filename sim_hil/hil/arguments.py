"""Command line of `edge-hil`: a simulated robot in real time behind its maker's protocol.

This module loads no physics, which takes a second: bad arguments are refused at once.
"""

from __future__ import annotations

import argparse
import math
import os
import socket
from dataclasses import replace
from pathlib import Path
from typing import Final

from edge.core.cli import LONGEST_S, check_result_target
from edge.live.options import add_live_arguments
from firmware_bridge.core.config import ConfigError
from firmware_bridge.system.terminal import CommandParser
from sim_hil.hil.display import check_display
from sim_hil.hil.trace import POSE_HZ
from sim_hil.layouts.scenes import open_scene
from sim_hil.protocols.registry import FLAGS, check_combination, check_flags, protocols, robots
from sim_hil.robots.odometry_noise import LEVELS
from sim_hil.scene.scene import Scene, SceneError, scene_names

MAX_PEOPLE: Final = 500
MAX_POSE_HZ: Final = 500
"""Largest rate of poses in a trace, Hz: one for each step of physics."""
EPILOG: Final = """examples:
  edge-hil --robot go2 --scene corridor --protocol unitree --people 4 --seed 1
  edge-hil --robot go2 --scene my_scene.toml --protocol unitree --start 2.5,-1,90
  edge-hil --robot carter --scene warehouse --protocol can --link serial:carter.can
  edge-hil --robot carter --scene warehouse --protocol can --link serial:carter.can,camera=8091,drop=0.05,corrupt=0.01
  edge-hil --robot carter --scene office --protocol can --link socketcan:can0
  edge-hil --robot carter --scene office --protocol mavlink --link udp:127.0.0.1:14580,to=127.0.0.1:14550
  edge-hil --robot carter --scene office --protocol mavlink --link udp:0.0.0.0:14580,camera=8091,system=2
  edge-hil --robot carter --scene office --protocol ros2 --domain 5 --interface lo
  edge-hil --robot go2 --scene corridor --protocol unitree --duration 60 --trace run.jsonl --json -
  edge-hil --robot go2 --scene corridor --protocol unitree --people 4 --live
  edge-hil --robot go2 --scene corridor --protocol unitree --odometry-noise severe --seed 7 --faults faults.sock
--link of can: INTERFACE:CHANNEL[,camera=PORT][,FAULT=NUMBER...]
  INTERFACE  serial (a serial line; a path that does not exist becomes the client's end of a pty),
             socketcan (a real bus), udp_multicast (between processes of this machine: udp_multicast:239.74.163.2)
  FAULT      drop, corrupt, duplicate, delay: probability per frame; delay_s (0.05); bus_off_every_s (0: never) and
             bus_off_s (0.2); babble_hz (0: none), babble_from_s and babble_s: a node that sends continuously
  default    serial:RUNTIME/carter-can in the user's runtime directory; the ready line names it
--link of mavlink: udp:HOST:PORT[,to=HOST:PORT...][,camera=PORT][,system=NUMBER][,key=FILE]
             [,autopilot=NAME][,IMPAIRMENT=NUMBER...]
  to         address that receives heartbeats unasked; key: file of a signing key, then unsigned packets are ignored
  autopilot  px4 (default) or ardupilot, which it announces
  IMPAIRMENT of both directions: loss_percent, loss_burst (mean length), delay_ms, jitter_ms (standard deviation),
             duplicate_percent, reorder_percent, reorder_ms (20)
  default    udp:127.0.0.1:14580,to=127.0.0.1:14540,to=127.0.0.1:14550
ros2: the base stops by itself after 0.5 s without a Twist on /cmd_vel; it publishes /odom, /imu, /battery_state, /tf,
  /camera/image/compressed and /camera/camera_info
camera: TCP port of the HTTP camera stream, default 8090

with --faults, a datagram with one JSON object switches a fault, such as {"fault": "camera-stop", "on": true}; the
answer contains the time at which it took effect; the answer to an unknown name lists all faults
exit codes: 0 ended by --duration, SIGINT or SIGTERM; 1 the run failed (camera process died, window closed; the result
is still written), or trace or result could not be written; 2 bad arguments"""


def parse_size(text: str) -> tuple[int, int] | None:
    """Parse `WxH` in pixels; `none` gives None. Raises argparse.ArgumentTypeError."""
    if text == "none":
        return None
    width, times, height = text.partition("x")
    if not (times and width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"expected WxH such as 320x180, or none, found {text!r}")
    if not (32 <= int(width) <= 1920 and 32 <= int(height) <= 1080):
        raise argparse.ArgumentTypeError(f"expected 32x32 to 1920x1080, found {text}")
    return int(width), int(height)


def parse_start(text: str) -> tuple[float, float, float]:
    """Parse `X,Y,DEG` to (x_m, y_m, theta_rad). Raises argparse.ArgumentTypeError."""
    try:
        x_m, y_m, degrees = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected X,Y,DEG such as 1.5,-2,90, found {text!r}") from None
    if not all(map(math.isfinite, (x_m, y_m, degrees))):
        raise argparse.ArgumentTypeError(f"expected finite X,Y,DEG, found {text!r}")
    return x_m, y_m, math.radians(degrees)


def parser() -> argparse.ArgumentParser:
    """Build the command line of `edge-hil`."""
    parser = CommandParser(
        prog="edge-hil",
        description="Simulate a robot in real time behind its maker's protocol.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--robot", required=True, choices=robots(), help="robot to simulate")
    parser.add_argument(
        "--scene", required=True, metavar="NAME|FILE", help=f"a scene file, or one of: {', '.join(scene_names())}"
    )
    parser.add_argument("--protocol", required=True, choices=protocols(), help="protocol of the robot")
    parser.add_argument(
        "--start", type=parse_start, metavar="X,Y,DEG", help="start pose, m and degrees (default: the scene's)"
    )
    parser.add_argument("--people", type=int, default=0, metavar="N", help="walking people (default 0)")
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="random seed of people and odometry noise (default 0)"
    )
    parser.add_argument(
        "--duration", type=float, metavar="S", help="end after S seconds (default: at SIGINT or SIGTERM)"
    )
    parser.add_argument("--domain", type=int, metavar="N", help="unitree, ros2: DDS domain (default 0)")
    parser.add_argument("--interface", metavar="NAME", help="unitree, ros2: network interface (default lo)")
    parser.add_argument("--link", metavar="ADDRESS", help="mavlink, can: address; forms and defaults below")
    parser.add_argument(
        "--camera", type=parse_size, default=(320, 180), metavar="WxH|none", help="camera image size (default 320x180)"
    )
    parser.add_argument(
        "--odometry-noise", choices=tuple(LEVELS), default="none", help="drift of the reported pose (default none)"
    )
    parser.add_argument("--faults", type=Path, metavar="PATH", help="accept faults at this local datagram socket")
    parser.add_argument(
        "--trace", type=Path, metavar="FILE.jsonl", help="write poses, commands and people, one JSON object per line"
    )
    parser.add_argument(
        "--pose-hz", type=int, default=POSE_HZ, metavar="N", help=f"poses a second in the trace (default {POSE_HZ})"
    )
    add_live_arguments(parser)
    parser.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    parser.add_argument("--gui", action="store_true", help="show the physics in a window")
    return parser


def check(args: argparse.Namespace) -> Scene:
    """Check the arguments before anything is started; return the scene. Raises ValueError or OSError with one line."""
    check_combination(args.robot, args.protocol)
    check_flags(args.protocol, [flag for flag in FLAGS if getattr(args, flag.removeprefix("--")) is not None])
    if args.gui:
        check_display(os.environ.get("DISPLAY"))
    if args.duration is not None and not 0 < args.duration <= LONGEST_S:
        raise ConfigError(f"--duration: expected seconds above 0 and up to {LONGEST_S:g}, found {args.duration}")
    if args.people > MAX_PEOPLE:
        raise ConfigError(f"--people: expected at most {MAX_PEOPLE}, found {args.people}")
    if args.interface is not None and args.interface not in [name for _, name in socket.if_nameindex()]:
        raise ConfigError(f"--interface {args.interface}: this machine has no such network interface")
    for flag, value in (("--people", args.people), ("--seed", args.seed)):
        if value < 0:
            raise ConfigError(f"{flag}: expected 0 or more, found {value}")
    if not 1 <= args.pose_hz <= MAX_POSE_HZ:
        raise ConfigError(f"--pose-hz: expected 1..{MAX_POSE_HZ}, found {args.pose_hz}")
    check_result_target(args.json)
    return _scene(args)


def _scene(args: argparse.Namespace) -> Scene:
    scene = open_scene(args.scene)
    if args.start is None:
        return scene
    (x_m, y_m, _), (x0, y0), (x1, y1) = args.start, scene.floor_min_m, scene.floor_max_m
    if not (x0 < x_m < x1 and y0 < y_m < y1):
        raise SceneError(f"--start: expected a point on the floor, {x0:g}..{x1:g}, {y0:g}..{y1:g} m, found {x_m},{y_m}")
    return replace(scene, start=args.start)
