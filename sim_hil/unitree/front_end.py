"""The Unitree protocol as a front end of `edge-hil`: services, state topics, and the camera in its own process."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.config import DdsConfig
from firmware_bridge.unitree import ids
from firmware_bridge.unitree.dds import Bus
from sim_hil.front_end import FrontEndError, FrontEndOptions, Heard
from sim_hil.odometry_noise import LEVELS, OdometryNoise
from sim_hil.simulation import Simulation
from sim_hil.unitree import sport
from sim_hil.unitree.camera_process import CameraProcess
from sim_hil.unitree.drifting import DriftingOdometry
from sim_hil.unitree.remote import Remote
from sim_hil.unitree.service import Received, ServiceServer
from sim_hil.unitree.state import OdometryFrame, StatePublishers

if TYPE_CHECKING:
    from sim_hil.faults.injector import FaultInjector


class UnitreeFrontEnd:
    """A simulated Go2 answering its maker's protocol. Raises DdsError, OSError or ValueError when it cannot."""

    def __init__(self, simulation: Simulation, options: FrontEndOptions, dds: DdsConfig) -> None:
        self._simulation = simulation
        self._dds = dds
        self._faults: FaultInjector | None = None
        self._bus = Bus(dds)
        self._camera = CameraProcess(
            options.scene_source,
            people=options.people,
            seed=options.seed,
            size=options.camera_size,
            dds=dds,
            state_length=len(simulation.render_state()),
            faults=options.faults is not None,
        )
        self._sport = ServiceServer(self._bus, ids.SPORT_SERVICE)
        self._robot_state = ServiceServer(self._bus, sport.ROBOT_STATE_SERVICE)
        self._motion_switcher = ServiceServer(self._bus, sport.MOTION_SWITCHER_SERVICE)
        self._servers = (self._sport, self._robot_state, self._motion_switcher)
        self._waitset = self._bus.waitset(*(server.reader for server in self._servers))
        remote = Remote()
        if options.faults is not None:
            self._faults = self._injector(options.faults, remote)
        self._publishers = StatePublishers(
            self._bus,
            _odometry(options),
            round(1 / Simulation.DT_S),
            remote=remote,
            faults=None if self._faults is None else self._faults.states,
        )
        self._log = sport.CommandLog()
        self._video_frames = 0
        self._video_malformed = 0

    def _injector(self, path: Path, remote: Remote) -> FaultInjector:
        # Imported here: without --faults the code that makes anything go wrong is not even loaded.
        from sim_hil.faults.injector import FaultInjector

        try:
            return FaultInjector(path, remote=remote, camera=self._camera.tell)
        except OSError:
            self.close()
            raise

    def where(self) -> str:
        """Domain and interface."""
        return f"domain {self._dds.domain} on {self._dds.interface}"

    def start(self, render_state: NDArray[np.float64], stop: Sequence[int]) -> bool:
        """Wait for the camera. Raises CameraProcessError."""
        self._camera.show(render_state)
        return self._camera.wait_ready(stop)

    def wait(self, left_ns: int) -> None:
        """Until a request arrives."""
        self._waitset.wait(left_ns)

    def serve(self) -> list[Heard]:
        """Answer what is waiting at every service; the camera's are told of by its process."""
        received = self._serve_sport()
        received += self._robot_state.serve(sport.handle_robot_state)
        received += self._motion_switcher.serve(sport.handle_motion_switcher)
        for event in self._camera.events():
            received += self._of_camera(event)
        for request in received:
            self._log.note(request)
        return [_heard(request) for request in received]

    def _serve_sport(self) -> list[Received]:
        def handle(api_id: int, parameter: str) -> tuple[int, str]:
            return sport.handle_sport(self._simulation, api_id, parameter)

        if self._faults is None:
            return self._sport.serve(handle)
        self._faults.poll(time.monotonic_ns())
        self._publishers.overdue()
        return self._faults.sport.serve(self._sport, handle)

    def _of_camera(self, event: dict[str, object]) -> list[Received]:
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
            return [Received(t_ns, ids.VIDEO_SERVICE, api_id, parameter, 0, noreply=False)]
        return []

    def publish(self, step: int, stamp_s: float) -> None:
        """Write the state topics that are due."""
        due = self._publishers.due(step)
        if due:
            self._publishers.publish(due, self._simulation.truth(), stamp_s)

    def show(self, render_state: NDArray[np.float64]) -> None:
        """Hand the camera process what it renders from now on."""
        self._camera.show(render_state)

    def close(self) -> None:
        """End the camera process and remove the faults' socket."""
        if self._faults is not None:
            self._faults.close()
        self._camera.close()

    def summary(self) -> dict[str, object]:
        """What was heard and sent."""
        malformed = self._video_malformed + sum(server.malformed for server in self._servers)
        return {
            "wire": {**self._log.summary(), "malformed": malformed},
            "video_frames": self._video_frames,
            "states": self._publishers.sport_states_sent,
        }


def open_front_end(simulation: Simulation, options: FrontEndOptions) -> UnitreeFrontEnd:
    """The front end of `--protocol unitree`. Raises FrontEndError, ConfigError, DdsError or OSError."""
    if options.link is not None:
        raise FrontEndError("--link: unitree is reached by --domain and --interface; leave it out")
    peers = ("127.0.0.1",) if options.interface == "lo" else ()
    return UnitreeFrontEnd(simulation, options, DdsConfig(options.domain, options.interface, peers))


def _odometry(options: FrontEndOptions) -> OdometryFrame:
    start = options.scene.start
    if options.odometry_noise == "none":
        return OdometryFrame(start)
    return DriftingOdometry(start, OdometryNoise(LEVELS[options.odometry_noise], options.seed))


def _heard(request: Received) -> Heard:
    name = sport.api_name(request.service, request.api_id)
    return Heard(request.received_ns, request.service, request.api_id, name, request.parameter)
