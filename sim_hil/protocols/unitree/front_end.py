"""Unitree front end of `edge-hil`: services, state topics, and the camera in its own process."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from edge.core.geometry import SE2
from firmware_bridge.core.config import DdsConfig
from firmware_bridge.dds.bus import Bus, take_each
from firmware_bridge.unitree.messages import ids
from sim_hil.protocols.base import CameraFrontEnd
from sim_hil.protocols.front_end import FrontEndError, FrontEndOptions, ReceivedCommand
from sim_hil.protocols.render_process import RenderProcess
from sim_hil.protocols.unitree.odometry import DriftingOdometry, OdometryFrame
from sim_hil.protocols.unitree.services.avoidance import OBSTACLES_AVOID_VERSION, ObstaclesAvoid, Pilot, RangeFinder
from sim_hil.protocols.unitree.services.behaviour import Go2Behaviour
from sim_hil.protocols.unitree.services.idl_command import LowCmd_
from sim_hil.protocols.unitree.services.low_level import LOW_COMMAND_TOPIC
from sim_hil.protocols.unitree.services.service import Answer, Lease, LeaseServer, Received, ServiceServer
from sim_hil.protocols.unitree.services.sport import UNLEASED, RequestLog, SportService, api_name, requested_velocity
from sim_hil.protocols.unitree.services.switching import VUI_SERVICE, MotionSwitcher, RobotState, Vui
from sim_hil.protocols.unitree.state import Remote, StatePublishers
from sim_hil.robots.go2.body import Go2, RobotTruth
from sim_hil.robots.odometry_noise import LEVELS, OdometryNoise
from sim_hil.simulation.physics import Simulation

if TYPE_CHECKING:
    from sim_hil.protocols.unitree.fault_injector import FaultInjector


PILOT_HZ: Final = 20  # rate of the obstacle check


class UnitreeFrontEnd(CameraFrontEnd):
    """Unitree front end of a simulated Go2. Raises DdsError, OSError or ValueError if it cannot be opened."""

    def __init__(self, simulation: Simulation, options: FrontEndOptions, dds: DdsConfig) -> None:
        if not isinstance(simulation.robot, Go2):
            raise FrontEndError(f"unitree: expected a Go2, found a {type(simulation.robot).__name__}")
        self._simulation = simulation
        self._robot = simulation.robot
        self._dds = dds
        self._faults: FaultInjector | None = None
        self._closed = False
        self.bus = Bus(dds)
        """DDS participant; a process may have one per domain."""
        try:
            self._open(simulation, options)
        except BaseException:
            self.close()
            raise

    def _open(self, simulation: Simulation, options: FrontEndOptions) -> None:
        if options.camera_size is not None:
            more = ["--domain", str(self._dds.domain), "--interface", self._dds.interface]
            for peer in self._dds.peers:
                more += ["--peer", peer]
            if options.faults is not None:
                more += ["--faults"]
            length = len(simulation.render_state())
            self._camera = RenderProcess("sim_hil.protocols.unitree.videohub", options, more, length)
        self._behaviour = Go2Behaviour(self._robot.sport, simulation.dt_s)
        self._robot.sport = self._behaviour  # type: ignore[assignment]  # the calls of a SportController that Go2 makes
        self._odometry = _odometry(options)
        self._range_finder = RangeFinder([box for _, box in options.scene.obstacles()])
        self._pilot = Pilot(self._behaviour.request_move, self._free_m)
        self._steps_per_check = round(simulation.rate_hz / PILOT_HZ)
        self._open_services()
        remote = Remote()
        if options.faults is not None:
            # Imported here, so that without --faults no code that causes faults is loaded.
            from sim_hil.protocols.unitree.fault_injector import FaultInjector

            self._faults = FaultInjector(options.faults, remote=remote, camera=self._send_to_camera)
        self._publishers = StatePublishers(
            self.bus,
            self._odometry,
            simulation.rate_hz,
            remote=remote,
            faults=None if self._faults is None else self._faults.states,
        )
        self._log = RequestLog()
        self._low_level_active = False
        self._video_frames = 0
        self._video_malformed = 0

    def _open_services(self) -> None:
        lease = Lease()
        self._sport = ServiceServer(self.bus, ids.SPORT_SERVICE, lease=lease, unleased=UNLEASED)
        self._leases = LeaseServer(self.bus, ids.SPORT_SERVICE, lease)
        self._sport_service = SportService(self._behaviour, self._pilot)
        switcher = MotionSwitcher(self._behaviour, self._pilot)
        avoid = ObstaclesAvoid(self._pilot, self._reported_pose)
        self._others: tuple[tuple[ServiceServer, Callable[[int, str], Answer]], ...] = (
            (ServiceServer(self.bus, ids.ROBOT_STATE_SERVICE), RobotState(switcher, avoid.switch).handle),
            (ServiceServer(self.bus, ids.MOTION_SWITCHER_SERVICE), switcher.handle),
            (ServiceServer(self.bus, VUI_SERVICE), Vui().handle),
            (
                ServiceServer(self.bus, ids.OBSTACLES_AVOID_SERVICE, version=OBSTACLES_AVOID_VERSION),
                avoid.handle,
            ),
        )
        self._servers = (self._sport, self._leases, *(server for server, _ in self._others))
        self._low_commands = self.bus.reader(LOW_COMMAND_TOPIC, LowCmd_)
        self._waitset = self.bus.waitset(*(server.reader for server in self._servers))

    def _free_m(self, direction_rad: float) -> float:
        (x_m, y_m, _), heading_rad = self._simulation.pose()
        return self._range_finder.free_m(x_m, y_m, heading_rad + direction_rad, self._simulation.people())

    def _reported_pose(self) -> SE2:
        (x_m, y_m, z_m), heading_rad = self._simulation.pose()
        x, y, _ = self._odometry.position((x_m, y_m, z_m))
        return SE2(x, y, self._odometry.rpy((0.0, 0.0, heading_rad))[2])

    def _send_to_camera(self, line: bytes) -> None:
        if self._camera is not None:
            self._camera.send(line)

    def where(self) -> str:
        """Return DDS domain and interface."""
        return f"domain {self._dds.domain} on {self._dds.interface}"

    def wait(self, left_ns: int) -> None:
        """Wait until a request arrives, at most `left_ns`."""
        self._waitset.wait(left_ns)

    def serve(self) -> list[ReceivedCommand]:
        """Answer the requests waiting at every service; the camera process reports its own requests."""
        received = self._serve_sport()
        self._leases.serve_leases()
        for server, handle in self._others:
            received += server.serve(handle)
        self._take_low_command()
        for event in self._camera.events() if self._camera is not None else ():
            received += self._handle_camera_event(event)
        for request in received:
            self._log.note(request)
        return [
            ReceivedCommand(
                one.received_ns,
                one.service,
                one.api_id,
                api_name(one.service, one.api_id),
                one.parameter,
                one.request_id,
                requested_velocity(one),
            )
            for one in received
        ]

    def _serve_sport(self) -> list[Received]:
        if self._faults is None:
            return self._sport.serve(self._sport_service.handle)
        self._faults.poll(time.monotonic_ns())
        self._publishers.overdue()
        return self._faults.sport.serve(self._sport, self._sport_service.handle)

    def _take_low_command(self) -> None:
        """Apply the newest low command; commands sent while the sport controller had the joints are discarded."""
        if not self._behaviour.released:
            self._low_level_active = False
            return
        for command in take_each(self._low_commands):
            if self._low_level_active:
                self._behaviour.low_level.take(command, self._behaviour.time_s)
        self._low_level_active = True

    def _handle_camera_event(self, event: dict[str, object]) -> list[Received]:
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
        """Write the state topics that are due, and check for obstacles."""
        if step % self._steps_per_check == 0:
            self._pilot.step(stamp_s, self._reported_pose)
        due = self._publishers.due(step)
        if due:
            truth = self._simulation.truth()
            assert isinstance(truth, RobotTruth)
            self._publishers.publish(due, truth, stamp_s, self._behaviour.progress)

    def close(self) -> None:
        """End the camera process, remove the fault socket, close the DDS participant."""
        if self._faults is not None:
            self._faults.close()
            self._faults = None
        if self._camera is not None:
            self._camera.close()
            self._camera = None
        if not self._closed:
            self._closed = True
            self.bus.close()

    def summary(self) -> dict[str, object]:
        """Return the counts of received and sent messages."""
        malformed = self._video_malformed + self._behaviour.low_level.rejected
        malformed += sum(server.malformed for server in self._servers)
        return {
            "wire": {**self._log.summary(), "malformed": malformed},
            "video_frames": self._video_frames,
            "states": self._publishers.sport_states_sent,
        }


def open_front_end(simulation: Simulation, options: FrontEndOptions) -> UnitreeFrontEnd:
    """Open the front end of `--protocol unitree`. Raises FrontEndError, ConfigError, DdsError or OSError."""
    if options.faults is not None and options.camera_size is None:
        raise FrontEndError("--faults: expected a camera, found --camera none; omit one of the two options")
    peers = ("127.0.0.1",) if options.interface == "lo" else ()
    return UnitreeFrontEnd(simulation, options, DdsConfig(options.domain, options.interface, peers))


def _odometry(options: FrontEndOptions) -> OdometryFrame:
    start = options.scene.start
    if options.odometry_noise == "none":
        return OdometryFrame(start)
    return DriftingOdometry(start, OdometryNoise(LEVELS[options.odometry_noise], options.seed))
