"""Real-time loop of `edge-hil`: serve requests until the next batch (4 ms) is due, step the physics, publish.

The physics follows real time. After a pause of the machine, time missed beyond MAX_LAG_NS is skipped.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Final

from sim_hil.hil.trace import POSE_HZ, TraceWriter
from sim_hil.hil.view import RATE_HZ, HilView
from sim_hil.protocols.front_end import FrontEnd, FrontEndOptions
from sim_hil.simulation.physics import Simulation

BATCH_NS: Final = 4_000_000
MAX_LAG_NS: Final = 200_000_000  # largest lag that is caught up; beyond it, the simulated world falls behind
MAX_STEPS: Final = 4  # physics steps between two services of the front end, also while catching up
PEOPLE_HZ: Final = 5
STEPS_PER_S: Final = round(1 / Simulation.DT_S)
_STEP_NS: Final = 1_000_000_000 // STEPS_PER_S


class HilLoop:
    """Real-time loop of one simulated robot and one front end."""

    def __init__(
        self,
        simulation: Simulation,
        front_end: FrontEnd,
        options: FrontEndOptions,
        *,
        pose_hz: int = POSE_HZ,
        view: HilView | None = None,
    ) -> None:
        """Take ownership of the first two and `view`, which `close` closes; `pose_hz`: trace poses a second."""
        self._pose_hz = pose_hz
        self._view = view
        self._simulation = simulation
        self._front_end = front_end
        self._options = options
        self._trace: TraceWriter | None = None
        self._steps = 0
        self._slipped_s = 0.0
        self._was_commanded = False
        self._duration_s = 0.0
        self._path_m = 0.0
        self._last_xy: tuple[float, float] | None = None

    def start(self, trace: TraceWriter | None, stop: Sequence[int]) -> bool:
        """Write the first line of `trace` and wait for the front end; return False if `stop` gets an element first.

        Raises RuntimeError or OSError.
        """
        self._trace = trace
        if self._view is not None:
            self._view.start(self._options)
        scene = self._options.scene
        solids = [(wall.label, "wall", wall.box) for wall in scene.walls]
        solids += [(thing.label, thing.kind, thing.box) for thing in scene.objects]
        footprints = [
            {"label": label, "kind": kind, "polygon": [list(map(float, corner)) for corner in box.corners()]}
            for label, kind, box in solids
        ]
        start, goal = list(scene.start), list(scene.goal_xy)
        self._note("scene", name=scene.name, start=start, goal=goal, footprints=footprints)
        return self._front_end.start(self._simulation.render_state(), stop)

    def run(self, stop: Sequence[int], duration_s: float | None) -> None:
        """Simulate in real time until `stop` gets an element or `duration_s` is over.

        Raises the errors of the simulation and the front end.
        """
        begin_ns = schedule_ns = next_ns = time.monotonic_ns()
        end_ns = None if duration_s is None else begin_ns + int(duration_s * 1e9)
        try:
            while not stop and (end_ns is None or time.monotonic_ns() < end_ns):
                left_ns = next_ns - time.monotonic_ns()
                if left_ns > 0:
                    self._front_end.wait(left_ns)  # returns early on a request
                self._serve()
                now_ns = time.monotonic_ns()
                if now_ns < next_ns:
                    continue
                lag_ns = now_ns - schedule_ns - self._steps * _STEP_NS
                if lag_ns > MAX_LAG_NS:
                    schedule_ns += lag_ns - MAX_LAG_NS
                    self._slipped_s += (lag_ns - MAX_LAG_NS) / 1e9  # the robot's clock still follows real time
                missing = min(lag_ns, MAX_LAG_NS) // _STEP_NS
                for _ in range(min(missing, MAX_STEPS)):
                    self._step()
                self._front_end.show(self._simulation.render_state())
                next_ns = now_ns if missing > MAX_STEPS else max(next_ns + BATCH_NS, now_ns)
        finally:
            self._duration_s = (time.monotonic_ns() - begin_ns) / 1e9

    def close(self) -> None:
        """Close the front end, the view and the simulation."""
        self._front_end.close()
        if self._view is not None:
            self._view.close()
        self._simulation.close()

    def _serve(self) -> None:
        for command in self._front_end.serve():
            if self._trace is not None:
                self._trace.put(
                    command.received_ns,
                    "wire",
                    service=command.service,
                    api_id=command.api_id,
                    name=command.name,
                    parameter=command.parameter,
                    request_id=command.request_id,
                    velocity=command.velocity,
                    source=command.source,
                )

    def _step(self) -> None:
        self._simulation.step()
        self._steps += 1
        step = self._steps
        self._front_end.publish(step, step * Simulation.DT_S + self._slipped_s)
        if self._options.faults is not None:
            self._note_command()
        if step * self._pose_hz // STEPS_PER_S != (step - 1) * self._pose_hz // STEPS_PER_S:
            self._note_pose()
        if self._view is not None and step % (STEPS_PER_S // RATE_HZ) == 0:
            self._view.show(self._simulation, self._front_end)
        if step % (STEPS_PER_S // PEOPLE_HZ) == 0:
            self._note("people", poses=[[float(v) for v in row] for row in self._simulation.people()])

    def _note_command(self) -> None:
        """Trace when the robot starts and stops obeying a velocity; commands on the wire may be late or lost."""
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
        mode = getattr(truth, "mode", None)  # None for a robot without modes
        touching = sorted(self._simulation.touching)  # contacts of the last 0.1 s, so no contact between lines is lost
        self._note("pose", x=x, y=y, z=z, theta=theta, vx=vx_world, vy=vy_world, wz=wz, mode=mode, touching=touching)

    def _note(self, kind: str, **fields: object) -> None:
        if self._trace is not None:
            self._trace.put(time.monotonic_ns(), kind, **fields)

    def summary(self) -> dict[str, object]:
        """Return the result of a run that has ended or never begun."""
        duration_s, options = self._duration_s, self._options
        wire = self._front_end.summary()
        states = wire["states"]
        assert isinstance(states, int)
        return {
            "robot": options.robot,
            "scene": options.scene.name,
            "seed": options.seed,
            "people": options.people,
            "duration_s": round(duration_s, 3),
            "real_time_factor": round(self._steps * Simulation.DT_S / duration_s, 4) if duration_s > 0 else 0.0,
            "wire": wire["wire"],
            "path_m": round(self._path_m, 3),
            "fell": self._simulation.fell,
            "collisions": sorted(self._simulation.collided_with()),
            "video_frames": wire["video_frames"],
            "state_hz": round(states / duration_s, 2) if duration_s > 0 else 0.0,
        }
