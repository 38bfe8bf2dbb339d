"""Actions and velocities of the sport service, names of all requests, and a summary of received commands."""

from __future__ import annotations

from typing import Final, Protocol

from firmware_bridge.unitree.messages import ids
from sim_hil.protocols.unitree.services.parameters import parse_numbers, parse_table
from sim_hil.protocols.unitree.services.service import Answer, Received
from sim_hil.robots.go2.sport import SportAction

_ACTIONS: Final = {
    ids.DAMP: SportAction.DAMP,
    ids.BALANCE_STAND: SportAction.BALANCE_STAND,
    ids.STOP_MOVE: SportAction.STOP_MOVE,
    ids.STAND_UP: SportAction.STAND_UP,
    ids.STAND_DOWN: SportAction.STAND_DOWN,
    ids.RECOVERY_STAND: SportAction.RECOVERY_STAND,
}
# Requests that end motion. All others leave the velocity in force or count as if they did: BalanceStand, a
# RecoveryStand of a standing robot and unknown ids have no effect, and StandUp is not meant to stop a robot.
_ENDS_MOTION: Final = frozenset({ids.STOP_MOVE, ids.DAMP, ids.STAND_DOWN})
_VELOCITY_MODE: Final = 0  # mode of an obstacles_avoid Move with a velocity; other modes are poses
AVOID_MOVE: Final = 1003
_RELEASE_MODE: Final = 1003  # API id of the motion switcher
_API_NAMES: Final = {
    ids.SPORT_SERVICE: {
        **ids.SPORT_API_NAMES,
        1007: "Euler", 1009: "Sit", 1010: "RiseSit", 1015: "SpeedLevel", 1016: "Hello", 1017: "Stretch",
        1020: "Content", 1022: "Dance1", 1023: "Dance2", 1027: "SwitchJoystick", 1028: "Pose", 1061: "StaticWalk",
        1062: "TrotRun", 1063: "EconomicGait", 2045: "FreeWalk", 2048: "FreeAvoid", 2049: "ClassicWalk",
        2054: "AutoRecoverySet", 2055: "AutoRecoveryGet", 2058: "SwitchAvoidMode",
    },
    ids.VIDEO_SERVICE: {ids.GET_IMAGE_SAMPLE: "GetImageSample"},
    ids.ROBOT_STATE_SERVICE: {1001: "ServiceSwitch", 1002: "SetReportFreq", 1003: "ServiceList"},
    ids.MOTION_SWITCHER_SERVICE: {
        1001: "CheckMode", 1002: "SelectMode", 1003: "ReleaseMode", 1004: "SetSilent", 1005: "GetSilent",
    },
    ids.OBSTACLES_AVOID_SERVICE: {
        1001: "SwitchSet", 1002: "SwitchGet", AVOID_MOVE: "Move", 1004: "UseRemoteCommandFromApi",
    },
}  # fmt: skip


class Robot(Protocol):
    """Interface of the robot to the sport service."""

    def sport(self, action: SportAction, /) -> int:
        """Start an action; return 0 or a Unitree error code."""
        ...

    def move(self, vx_mps: float, vy_mps: float, wz_radps: float, /) -> None:
        """Command a velocity in the body frame."""
        ...


def api_name(service: str, api_id: int) -> str:
    """Return the name of a request for the trace; its number if the name is unknown."""
    return "Version" if api_id == ids.API_VERSION else _API_NAMES.get(service, {}).get(api_id, str(api_id))


def parse_move(parameter: str) -> tuple[float, float, float] | None:
    """Parse the velocity of a Move, `{"x","y","z"}`; None unless it contains three finite numbers."""
    return _velocity(parameter, "z")


def _velocity(parameter: str, yaw: str) -> tuple[float, float, float] | None:
    numbers = parse_numbers(parameter, "x", "y", yaw)
    return None if numbers is None else (numbers[0], numbers[1], numbers[2])


def handle_sport(robot: Robot, api_id: int, parameter: str) -> Answer:
    """Handle one sport request: 3203 if not implemented, 3204 for a Move without three finite numbers."""
    if api_id == ids.MOVE:
        velocity = parse_move(parameter)
        if velocity is None:
            return ids.ERROR_PARAMETER, ""
        robot.move(*velocity)
        return ids.OK, ""
    action = _ACTIONS.get(api_id)
    return (robot.sport(action), "") if action is not None else (ids.ERROR_NOT_IMPLEMENTED, "")


class CommandLog:
    """Summary of the commands received over sport and obstacles_avoid, for the result."""

    def __init__(self) -> None:
        self.commands = 0
        self.last_move: tuple[float, float, float] | None = None
        self.last_command: str | None = None
        self._at_zero = True  # whether the last motion request was zero

    def note(self, request: Received) -> None:
        """Count one received request."""
        if request.api_id == ids.API_VERSION:
            return
        if request.service == ids.OBSTACLES_AVOID_SERVICE and request.api_id == AVOID_MOVE:
            mode = (parse_table(request.parameter) or {}).get("mode", _VELOCITY_MODE)
            velocity = _velocity(request.parameter, "yaw") if mode == _VELOCITY_MODE else None
            self._moved(request, velocity)
        elif request.service == ids.MOTION_SWITCHER_SERVICE and request.api_id == _RELEASE_MODE:
            self._at_zero = True
        elif request.service == ids.SPORT_SERVICE:
            if request.api_id == ids.MOVE:
                self._moved(request, parse_move(request.parameter))
                return
            self.last_command = api_name(request.service, request.api_id)
            if request.api_id in _ENDS_MOTION:
                self._at_zero = True

    def _moved(self, request: Received, velocity: tuple[float, float, float] | None) -> None:
        self.last_command = api_name(request.service, request.api_id)
        self.commands += 1
        self.last_move = velocity
        self._at_zero = velocity is not None and not any(velocity)

    def summary(self) -> dict[str, object]:
        """Return the `wire` part of the result; without any motion request, `last_command_zero` is true."""
        return {
            "commands": self.commands,
            "last_move": None if self.last_move is None else list(self.last_move),
            "last_command": self.last_command,
            "last_command_zero": self._at_zero,
        }
