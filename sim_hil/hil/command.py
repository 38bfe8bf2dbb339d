"""Command line of `edge-hil`: a simulated robot in real time behind its maker's protocol."""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from typing import Final

from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    OutputError,
    command_line,
    stop_signals,
    write_result,
)
from edge.live.feed import LiveFeed
from edge.live.options import LiveOptions, live_options
from firmware_bridge.core.config import ConfigError
from firmware_bridge.core.robot_state import DdsError
from firmware_bridge.dds.bus import DDS_ERRORS
from firmware_bridge.system.terminal import one_line
from sim_hil.hil.arguments import check, parser
from sim_hil.hil.loop import HilLoop
from sim_hil.hil.trace import TraceWriter
from sim_hil.hil.view import HilView
from sim_hil.protocols.front_end import FrontEndError, FrontEndOptions
from sim_hil.protocols.registry import open_front_end
from sim_hil.robots.bullet import pybullet
from sim_hil.scene.scene import Scene, SceneError
from sim_hil.simulation.physics import Simulation

# Errors with an external cause: camera process died, window closed, disk full. Other errors are bugs and keep their
# traceback.
_RUN_FAILURES: Final = (RuntimeError, ValueError, OSError, pybullet.error, *DDS_ERRORS)


@command_line("edge-hil")
def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code (see EPILOG)."""
    args = parser().parse_args(argv)
    with stop_signals() as stop:
        try:
            loop, address = _open(args, check(args), live_options(args))
        except (ConfigError, SceneError, DdsError, FrontEndError, ValueError, OSError) as error:
            return _report_error(error, EXIT_BAD_INPUT)
        try:
            trace = None if args.trace is None else TraceWriter(args.trace)
        except OSError as error:
            loop.close()
            return _report_error(f"--trace {args.trace}: expected a file to write, {error.strerror}", EXIT_BAD_INPUT)
        try:
            code = _run(loop, trace, stop, args, address)
        finally:
            written = _write_results(loop, trace, args)
        return code or written


def _open(args: argparse.Namespace, scene: Scene, live: LiveOptions | None) -> tuple[HilLoop, str]:
    """Open simulation, view and front end; return the loop and the robot's address as text."""
    options = FrontEndOptions(
        robot=args.robot,
        scene_source=args.scene,
        scene=scene,
        people=args.people,
        seed=args.seed,
        camera_size=args.camera,
        odometry_noise=args.odometry_noise,
        faults=args.faults,
        link=args.link,
        domain=0 if args.domain is None else args.domain,
        interface="lo" if args.interface is None else args.interface,
    )
    simulation = Simulation(scene, people=args.people, seed=args.seed, gui=args.gui, robot=args.robot)
    feed: LiveFeed | None = None
    try:
        if live is not None:
            feed = LiveFeed(live, None, lambda: False, _print)
            _print(f"live view: {feed.url}")
            options = replace(options, view_fd=feed.picture_fd)
        front_end = open_front_end(args.protocol, simulation, options)
    except BaseException:
        if feed is not None:
            feed.close()
        simulation.close()
        raise
    view = None if feed is None else HilView(feed)
    return HilLoop(simulation, front_end, options, pose_hz=args.pose_hz, view=view), front_end.where()


def _run(loop: HilLoop, trace: TraceWriter | None, stop: list[int], args: argparse.Namespace, address: str) -> int:
    try:
        try:
            if loop.start(trace, stop):
                _print(f"ready, {address}")
                loop.run(stop, args.duration)
        finally:
            loop.close()
    except _RUN_FAILURES as error:
        return _report_error(f"the run failed: {error}", EXIT_CHECK_FAILED)
    return EXIT_DONE


def _write_results(loop: HilLoop, trace: TraceWriter | None, args: argparse.Namespace) -> int:
    code, summary = EXIT_DONE, loop.summary()
    if trace is not None:
        trace.close(time.monotonic_ns(), **summary)
        if trace.error is not None:
            code = _report_error(f"trace {args.trace} is incomplete: {trace.error}", EXIT_CHECK_FAILED)
    try:
        write_result(args.json, summary)
    except OutputError as error:
        code = _report_error(f"the result could not be written: {error}", EXIT_CHECK_FAILED)
    return code


def _report_error(message: object, code: int) -> int:
    _print(one_line(message))
    return code


def _print(line: str) -> None:
    sys.stderr.write(f"edge-hil: {line}\n")
    sys.stderr.flush()


if __name__ == "__main__":
    sys.exit(main())
