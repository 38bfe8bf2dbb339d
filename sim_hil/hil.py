"""`edge-hil`: the simulated robot on the other end of a real protocol, in real time.

One loop: wait on the bus until the next 4 ms batch is due, answer requests, step the physics to where real time is,
publish. The camera renders in its own process.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Final

import pybullet

from edge.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE, check_result_target, write_result
from firmware_bridge.config import ConfigError, DdsConfig
from firmware_bridge.unitree import ids
from firmware_bridge.unitree.dds import DDS_ERRORS, Bus, DdsError
from sim_hil.odometry_noise import LEVELS, OdometryNoise
from sim_hil.scene import Scene, SceneError, load_scene, scene_names
from sim_hil.simulation import Simulation
from sim_hil.trace import TraceWriter
from sim_hil.unitree import sport
from sim_hil.unitree.camera_process import CameraProcess
from sim_hil.unitree.drifting import DriftingOdometry
from sim_hil.unitree.remote import Remote
from sim_hil.unitree.service import Received, ServiceServer
from sim_hil.unitree.state import OdometryFrame, StatePublishers

if TYPE_CHECKING:
    from sim_hil.faults.injector import FaultInjector

BATCH_NS: Final = 4_000_000
MAX_LAG_NS: Final = 200_000_000  # behind by more than this, the simulated world falls behind instead of racing
POSE_HZ: Final = 10
PEOPLE_HZ: Final = 5
_STEPS_PER_S: Final = round(1 / Simulation.DT_S)
_STEP_NS: Final = 1_000_000_000 // _STEPS_PER_S
# What the world can do to a run: the camera process dies, the window is closed, a disk is full. Anything else is a bug
# and keeps its traceback.
_RUN_FAILURES: Final = (RuntimeError, ValueError, OSError, pybullet.error, *DDS_ERRORS)

EPILOG: Final = """examples:
  edge-hil --robot go2 --scene corridor --protocol unitree --people 4 --seed 1
  edge-hil --robot go2 --scene corridor --protocol unitree --duration 60 --trace run.jsonl --json -
  edge-hil --robot go2 --scene corridor --protocol unitree --odometry-noise severe --seed 7 --faults faults.sock
with --faults, one JSON object a datagram switches a fault on or off, such as {"fault": "camera-stop", "on": true}; the
answer says when it took effect, and an unknown name is answered with all that there are
exit codes: 0 ended by --duration, SIGINT or SIGTERM; 1 the run failed (camera process died, window closed), its result
is written all the same, or trace or result could not be written; 2 bad arguments"""


class Go2Hil:
    """A simulated Go2 answering the Unitree protocol. Raises DdsError or ValueError when it cannot be built."""

    def __init__(self, scene: Scene, args: argparse.Namespace, dds: DdsConfig) -> None:
        self._scene = scene
        self._args = args
        self._trace: TraceWriter | None = None
        self._faults: FaultInjector | None = None
        self._simulation = Simulation(scene, people=args.people, seed=args.seed, gui=args.gui)
        try:
            self._bus = Bus(dds)
            self._camera = CameraProcess(
                scene.name,
                people=args.people,
                seed=args.seed,
                size=args.camera,
                dds=dds,
                state_length=len(self._simulation.render_state()),
                faults=args.faults is not None,
            )
        except BaseException:
            self._simulation.close()
            raise
        self._sport = ServiceServer(self._bus, ids.SPORT_SERVICE)
        self._robot_state = ServiceServer(self._bus, sport.ROBOT_STATE_SERVICE)
        self._motion_switcher = ServiceServer(self._bus, sport.MOTION_SWITCHER_SERVICE)
        self._servers = (self._sport, self._robot_state, self._motion_switcher)
        self._waitset = self._bus.waitset(*(server.reader for server in self._servers))
        remote = Remote()
        if args.faults is not None:
            self._faults = self._injector(args.faults, remote)
        self._publishers = StatePublishers(
            self._bus,
            _odometry(scene, args),
            _STEPS_PER_S,
            remote=remote,
            faults=None if self._faults is None else self._faults.states,
        )
        self._log = sport.CommandLog()
        self._steps = 0
        self._slipped_s = 0.0
        self._was_commanded = False
        self._duration_s = 0.0
        self._video_frames = 0
        self._video_malformed = 0
        self._path_m = 0.0
        self._last_xy: tuple[float, float] | None = None

    def _injector(self, path: Path, remote: Remote) -> FaultInjector:
        # Imported here: without --faults the code that makes anything go wrong is not even loaded.
        from sim_hil.faults.injector import FaultInjector

        try:
            return FaultInjector(path, remote=remote, camera=self._camera.tell)
        except OSError:
            self.close()
            raise

    def start(self, trace: TraceWriter | None, stop: list[int]) -> bool:
        """Write the first line of `trace`, wait for the camera; False when a signal number appears in `stop` first.

        Raises CameraProcessError.
        """
        self._trace = trace
        footprints = [
            {"label": f.label, "kind": f.kind, "polygon": [list(map(float, corner)) for corner in f.polygon]}
            for f in self._scene.footprints()
        ]
        start, goal = list(self._scene.start), list(self._scene.goal_xy)
        self._note("scene", name=self._scene.name, start=start, goal=goal, footprints=footprints)
        self._camera.show(self._simulation.render_state())
        return self._camera.wait_ready(stop)

    def run(self, stop: list[int], duration_s: float | None) -> None:
        """Simulate in real time until a signal number appears in `stop`. Raises one of _RUN_FAILURES."""
        begin_ns = schedule_ns = next_ns = time.monotonic_ns()
        end_ns = None if duration_s is None else begin_ns + int(duration_s * 1e9)
        try:
            while not stop and (end_ns is None or time.monotonic_ns() < end_ns):
                left_ns = next_ns - time.monotonic_ns()
                if left_ns > 0:
                    self._waitset.wait(left_ns)  # wakes up early for a request
                self._serve()
                now_ns = time.monotonic_ns()
                if now_ns < next_ns:
                    continue
                lag_ns = now_ns - schedule_ns - self._steps * _STEP_NS
                if lag_ns > MAX_LAG_NS:
                    schedule_ns += lag_ns - MAX_LAG_NS
                    self._slipped_s += (lag_ns - MAX_LAG_NS) / 1e9  # the robot's clock does not stand still with it
                for _ in range(min(lag_ns, MAX_LAG_NS) // _STEP_NS):
                    self._step()
                self._camera.show(self._simulation.render_state())
                next_ns = max(next_ns + BATCH_NS, now_ns)
        finally:
            self._duration_s = (time.monotonic_ns() - begin_ns) / 1e9

    def close(self) -> None:
        """End the camera process and the simulation."""
        if self._faults is not None:
            self._faults.close()
        self._camera.close()
        self._simulation.close()

    def _serve_sport(self) -> list[Received]:
        def handle(api_id: int, parameter: str) -> tuple[int, str]:
            return sport.handle_sport(self._simulation, api_id, parameter)

        if self._faults is None:
            return self._sport.serve(handle)
        self._faults.poll(time.monotonic_ns())
        self._publishers.overdue()
        return self._faults.sport.serve(self._sport, handle)

    def _serve(self) -> None:
        for request in self._serve_sport():
            self._heard(request)
        for request in self._robot_state.serve(sport.handle_robot_state):
            self._heard(request)
        for request in self._motion_switcher.serve(sport.handle_motion_switcher):
            self._heard(request)
        for event in self._camera.events():
            if event["event"] == "frame":
                self._video_frames += 1
            elif event["event"] == "malformed":
                count = event["count"]
                assert isinstance(count, int)
                self._video_malformed += count
            elif event["event"] == "fault" and self._faults is not None:
                fault, effect_ns = event["fault"], event["t_ns"]
                assert isinstance(fault, str) and isinstance(effect_ns, int)
                self._faults.took_effect(fault, effect_ns)
            elif event["event"] == "request":
                t_ns, api_id, parameter = event["t_ns"], event["api_id"], event["parameter"]
                assert isinstance(t_ns, int) and isinstance(api_id, int) and isinstance(parameter, str)
                self._heard(Received(t_ns, ids.VIDEO_SERVICE, api_id, parameter, 0, noreply=False))

    def _heard(self, request: Received) -> None:
        self._log.note(request)
        if self._trace is not None:
            self._trace.put(
                request.received_ns,
                "wire",
                service=request.service,
                api_id=request.api_id,
                name=sport.api_name(request.service, request.api_id),
                parameter=request.parameter,
            )

    def _step(self) -> None:
        self._simulation.step()
        self._steps += 1
        step = self._steps
        due = self._publishers.due(step)
        if due:
            self._publishers.publish(due, self._simulation.truth(), step * Simulation.DT_S + self._slipped_s)
        if self._faults is not None:
            self._note_command()
        if step % (_STEPS_PER_S // POSE_HZ) == 0:
            self._note_pose()
        if step % (_STEPS_PER_S // PEOPLE_HZ) == 0:
            self._note("people", poses=[[float(v) for v in row] for row in self._simulation.people()])

    def _note_command(self) -> None:
        """Trace when the robot itself begins and ends to obey a velocity: what it hears may have come late, or not."""
        commanded = self._simulation.commanded
        if any(commanded) != self._was_commanded:
            self._was_commanded = any(commanded)
            self._note("commanded", velocity=list(commanded))

    def _note_pose(self) -> None:
        truth = self._simulation.truth()
        x, y, z = (float(v) for v in truth.position_m)
        theta = float(truth.rpy_rad[2])
        vx_world, vy_world = float(truth.velocity_world_mps[0]), float(truth.velocity_world_mps[1])
        if self._last_xy is not None:
            self._path_m += math.hypot(x - self._last_xy[0], y - self._last_xy[1])
        self._last_xy = (x, y)
        wz = float(truth.gyro_radps[2])
        self._note("pose", x=x, y=y, z=z, theta=theta, vx=vx_world, vy=vy_world, wz=wz, mode=truth.mode)

    def _note(self, kind: str, **fields: object) -> None:
        if self._trace is not None:
            self._trace.put(time.monotonic_ns(), kind, **fields)

    def summary(self) -> dict[str, object]:
        """The result, of a run that has ended or never begun."""
        duration_s = self._duration_s
        malformed = self._video_malformed + sum(server.malformed for server in self._servers)
        return {
            "robot": self._args.robot,
            "scene": self._scene.name,
            "seed": self._args.seed,
            "people": self._args.people,
            "duration_s": round(duration_s, 3),
            "real_time_factor": round(self._steps * Simulation.DT_S / duration_s, 4) if duration_s > 0 else 0.0,
            "wire": {**self._log.summary(), "malformed": malformed},
            "path_m": round(self._path_m, 3),
            "fell": self._simulation.fell,
            "collisions": sorted(self._simulation.collided_with()),
            "video_frames": self._video_frames,
            "state_hz": round(self._publishers.sport_states_sent / duration_s, 2) if duration_s > 0 else 0.0,
        }


def _odometry(scene: Scene, args: argparse.Namespace) -> OdometryFrame:
    if args.odometry_noise == "none":
        return OdometryFrame(scene.start)
    return DriftingOdometry(scene.start, OdometryNoise(LEVELS[args.odometry_noise], args.seed))


@contextlib.contextmanager
def stop_signals() -> Iterator[list[int]]:
    """A list that receives the number of every SIGINT and SIGTERM until the end of the block."""
    received: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        received.append(number)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def parse_size(text: str) -> tuple[int, int]:
    """`WxH` in pixels; raises argparse.ArgumentTypeError."""
    width, times, height = text.partition("x")
    if not (times and width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"expected WxH such as 320x180, found {text!r}")
    if not (32 <= int(width) <= 1920 and 32 <= int(height) <= 1080):
        raise argparse.ArgumentTypeError(f"expected 32x32 to 1920x1080, found {text}")
    return int(width), int(height)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="edge-hil",
        description="A simulated robot that answers its maker's protocol, in real time.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--robot", required=True, choices=("go2",), help="which robot")
    parser.add_argument("--scene", required=True, metavar="NAME", help=f"one of: {', '.join(scene_names())}")
    parser.add_argument("--protocol", required=True, choices=("unitree",), help="what it speaks")
    parser.add_argument("--people", type=int, default=0, metavar="N", help="walking people (default 0)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of people and odometry noise (default 0)")
    parser.add_argument("--duration", type=float, metavar="S", help="end after S seconds (default: at a signal)")
    parser.add_argument("--domain", type=int, default=0, metavar="N", help="DDS domain (default 0)")
    parser.add_argument("--interface", default="lo", help="network interface (default lo)")
    parser.add_argument("--camera", type=parse_size, default=(320, 180), metavar="WxH", help="default 320x180")
    parser.add_argument(
        "--odometry-noise", choices=tuple(LEVELS), default="none", help="let the reported pose drift (default none)"
    )
    parser.add_argument("--faults", type=Path, metavar="PATH", help="take faults at this local datagram socket")
    parser.add_argument("--trace", type=Path, metavar="FILE.jsonl", help="write what happened, one object a line")
    parser.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    parser.add_argument("--gui", action="store_true", help="show the physics in a window")
    return parser


def main(argv: list[str] | None = None) -> int:
    """Command line; see EPILOG for the exit codes."""
    args = _parser().parse_args(argv)
    with stop_signals() as stop:
        try:
            dds = _checked(args)
            hil = Go2Hil(load_scene(args.scene), args, dds)
        except (ConfigError, SceneError, DdsError, ValueError, OSError) as error:
            return _complain(error, EXIT_BAD_INPUT)
        try:
            trace = None if args.trace is None else TraceWriter(args.trace)
        except OSError as error:
            hil.close()
            return _complain(f"--trace {args.trace}: expected a file to write, {error.strerror}", EXIT_BAD_INPUT)
        try:
            code = _run(hil, trace, stop, args, dds)
        finally:
            written = _write_results(hil, trace, args)
        return code or written


def _checked(args: argparse.Namespace) -> DdsConfig:
    """Refuse bad arguments before anything is started or overwritten; raises ConfigError or OSError."""
    if args.gui and not os.environ.get("DISPLAY"):
        raise ConfigError("--gui: expected a display, DISPLAY is not set; run without --gui or on a desktop")
    if args.duration is not None and not 0 < args.duration < math.inf:
        raise ConfigError(f"--duration: expected seconds above 0, found {args.duration}")
    for flag, value in (("--people", args.people), ("--seed", args.seed)):
        if value < 0:
            raise ConfigError(f"{flag}: expected 0 or more, found {value}")
    check_result_target(args.json)
    return DdsConfig(args.domain, args.interface, ("127.0.0.1",) if args.interface == "lo" else ())


def _run(hil: Go2Hil, trace: TraceWriter | None, stop: list[int], args: argparse.Namespace, dds: DdsConfig) -> int:
    try:
        try:
            if hil.start(trace, stop):
                sys.stderr.write(f"edge-hil: ready, domain {dds.domain} on {dds.interface}\n")
                sys.stderr.flush()
                hil.run(stop, args.duration)
        finally:
            hil.close()
    except _RUN_FAILURES as error:
        return _complain(f"the run has failed: {error}", EXIT_CHECK_FAILED)
    return EXIT_DONE


def _write_results(hil: Go2Hil, trace: TraceWriter | None, args: argparse.Namespace) -> int:
    code, summary = EXIT_DONE, hil.summary()
    if trace is not None:
        trace.close(time.monotonic_ns(), **summary)
        if trace.error is not None:
            code = _complain(f"trace {args.trace} is incomplete: {trace.error}", EXIT_CHECK_FAILED)
    try:
        write_result(args.json, summary)
    except OSError as error:
        code = _complain(f"the result could not be written: {error}", EXIT_CHECK_FAILED)
    return code


def _complain(what: object, code: int) -> int:
    sys.stderr.write(f"edge-hil: {what}\n")
    return code


if __name__ == "__main__":
    sys.exit(main())
