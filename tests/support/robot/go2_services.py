"""The services of a simulated Go2 without a wire: with physics (`Stage`) and without (`Desk`)."""

from __future__ import annotations

import json
from collections.abc import Callable

from edge.core.geometry import SE2
from sim_hil.protocols.unitree.services.avoidance import RANGE_M, ObstaclesAvoid, Pilot
from sim_hil.protocols.unitree.services.behaviour import Go2Behaviour
from sim_hil.protocols.unitree.services.postures import STANDING
from sim_hil.protocols.unitree.services.sport import SportService
from sim_hil.protocols.unitree.services.switching import MotionSwitcher, RobotState
from sim_hil.robots.go2.body import Go2
from sim_hil.robots.go2.gait import BodyMotion
from sim_hil.robots.go2.sport import Measured, SportAction, SportController
from sim_hil.scene.scene import load_scene
from sim_hil.simulation.physics import Simulation


class Services:
    """The services of a Go2 that stands balanced."""

    def __init__(self, behaviour: Go2Behaviour) -> None:
        self.behaviour = behaviour
        self.free_m = RANGE_M
        self.pilot = Pilot(behaviour.request_move, lambda _direction: self.free_m)
        self.sport = SportService(behaviour, self.pilot)
        self.switcher = MotionSwitcher(behaviour, self.pilot)
        self.avoid = ObstaclesAvoid(self.pilot, self.pose)
        self.robot_state = RobotState(self.switcher, self.avoid.switch)

    def pose(self) -> SE2:
        return SE2(0.0, 0.0, 0.0)

    def advance(self) -> None:
        raise NotImplementedError

    def run(self, seconds: float, each_tenth: Callable[[], object] = lambda: None) -> None:
        for index in range(round(seconds * 500)):
            if index % 50 == 0:
                each_tenth()
            if index % 25 == 0:
                self.pilot.step(self.behaviour.time_s, self.pose)
            self.advance()

    def ask(self, api_id: int, **parameter: object) -> tuple[int, str]:
        return self.sport.handle(api_id, json.dumps(parameter))


class Desk(Services):
    """Without physics: a body that always is where it should be, unless `measured` is changed."""

    def __init__(self) -> None:
        super().__init__(Go2Behaviour(SportController(0.002), 0.002))
        self.measured = Measured(STANDING, (0.0,) * 12, BodyMotion(*[0.0] * 8), 1.0)
        self.behaviour.request(SportAction.RECOVERY_STAND)
        self.run(2.1)
        assert self.behaviour.mode == 1

    def advance(self) -> None:
        self.behaviour.step(self.measured)


class Stage(Services):
    """In physics, in the corridor."""

    def __init__(self) -> None:
        self.simulation = Simulation(load_scene("corridor"), people=0, seed=0)
        robot = self.simulation.robot
        assert isinstance(robot, Go2)
        super().__init__(Go2Behaviour(robot.sport, self.simulation.dt_s))
        robot.sport = self.behaviour  # type: ignore[assignment]
        self.simulation.settle()

    def pose(self) -> SE2:
        (x, y, _), heading = self.simulation.pose()
        return SE2(x, y, heading)

    def advance(self) -> None:
        self.simulation.step()

    @property
    def tilt(self) -> tuple[float, float, float]:
        roll, pitch, yaw = self.simulation.truth().rpy_rad
        return float(roll), float(pitch), float(yaw)
