"""Sport service of the simulated Go2: handlers of all requests, their names, and a summary of received commands.

Acrobatics (flips, jumps, hand stand, upright walk) are answered with 3203, not implemented, as by the real robot in a
mode without them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Final, Protocol

from firmware_bridge.unitree.messages import ids
from sim_hil.protocols.base import CommandLog
from sim_hil.protocols.unitree.services.avoidance import Pilot
from sim_hil.protocols.unitree.services.behaviour import GAITS, SPEED_SHARE, Go2Behaviour
from sim_hil.protocols.unitree.services.postures import MODE_POSE, POSE, SHOWS, SIT, Script
from sim_hil.protocols.unitree.services.service import Answer, Received, parse_flag, parse_numbers, parse_table
from sim_hil.robots.go2.sport import ERROR_NOT_STANDING, SportAction

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


def requested_velocity(request: Received) -> tuple[float, float, float] | None:
    """Return a sport request's velocity (m/s, m/s, rad/s): zero for one that ends motion, None for any other."""
    if request.service != ids.SPORT_SERVICE:
        return None
    if request.api_id == ids.MOVE:
        return parse_move(request.parameter)
    return (0.0, 0.0, 0.0) if request.api_id in _ENDS_MOTION else None


class RequestLog(CommandLog):
    """Summary of the commands received over sport and obstacles_avoid."""

    def note(self, request: Received) -> None:
        """Count one received request."""
        service, api_id, name = request.service, request.api_id, api_name(request.service, request.api_id)
        if api_id == ids.API_VERSION:
            return
        if service == ids.OBSTACLES_AVOID_SERVICE and api_id == AVOID_MOVE:
            mode = (parse_table(request.parameter) or {}).get("mode", _VELOCITY_MODE)
            self.move(name, _velocity(request.parameter, "yaw") if mode == _VELOCITY_MODE else None)
        elif service == ids.MOTION_SWITCHER_SERVICE and api_id == _RELEASE_MODE:
            self.at_zero = True
        elif service == ids.SPORT_SERVICE and api_id == ids.MOVE:
            self.move(name, parse_move(request.parameter))
        elif service == ids.SPORT_SERVICE:
            self.last_command = name
            self.at_zero = self.at_zero or api_id in _ENDS_MOTION


AUTO_RECOVERY_GET: Final = 2055
UNLEASED: Final = frozenset({AUTO_RECOVERY_GET})  # read-only
_SHOWS: Final[Mapping[int, str]] = MappingProxyType(
    {1016: "Hello", 1017: "Stretch", 1020: "Content", 1022: "Dance1", 1023: "Dance2"}
)
_GAITS: Final[Mapping[int, str]] = MappingProxyType(
    {1061: "StaticWalk", 1062: "TrotRun", 1063: "EconomicGait", 2045: "FreeWalk", 2049: "ClassicWalk"}
)
_WITHOUT_PARAMETER: Final = frozenset({1061, 1062, 1063, 2045})
_DONE: Final[Answer] = (ids.OK, "")
_BAD: Final[Answer] = (ids.ERROR_PARAMETER, "")


class SportService:
    """Handler of sport requests. SwitchJoystick is accepted without effect, because the robot has no joystick."""

    def __init__(self, behaviour: Go2Behaviour, mover: Pilot) -> None:
        self._behaviour = behaviour
        self._mover = mover
        self._handlers: dict[int, Callable[[str], Answer]] = {
            1007: self._euler,
            1009: lambda _: self._show(SIT),
            1010: self._rise,
            1015: self._speed_level,
            1027: self._joystick,
            1028: self._pose,
            2048: self._avoid,
            2054: self._auto_recovery,
            AUTO_RECOVERY_GET: lambda _: (ids.OK, json.dumps({"data": behaviour.auto_recovery})),
            2058: lambda _: self._set_avoidance(not mover.avoids),
        }

    def handle(self, api_id: int, parameter: str) -> Answer:
        """Handle one request; return code and data. While the sport controller is released, the code is 4202."""
        if self._behaviour.released:
            return ERROR_NOT_STANDING, ""
        if api_id in _SHOWS:
            return self._show(SHOWS[_SHOWS[api_id]])
        if api_id in _GAITS:
            return self._choose_gait(api_id, parameter)
        handler = self._handlers.get(api_id)
        return handler(parameter) if handler is not None else handle_sport(self, api_id, parameter)

    def sport(self, action: SportAction) -> int:
        """Start an action of the sport controller; it cancels velocity and goal."""
        self._mover.stop()
        return self._behaviour.request(action)

    def move(self, vx_mps: float, vy_mps: float, wz_radps: float) -> None:
        """Execute a Move."""
        self._mover.move(vx_mps, vy_mps, wz_radps, avoiding=self._mover.avoids)

    def _euler(self, parameter: str) -> Answer:
        angles = parse_numbers(parameter, "x", "y", "z")
        if angles is None:
            return _BAD
        self._mover.stop()
        return self._behaviour.turn_body(*angles), ""

    def _show(self, script: Script) -> Answer:
        self._mover.stop()
        return self._behaviour.show(script), ""

    def _rise(self, _parameter: str) -> Answer:
        self._mover.stop()
        self._behaviour.stand_again()
        return _DONE

    def _speed_level(self, parameter: str) -> Answer:
        level = parse_numbers(parameter, "data")
        if level is None or level[0] not in SPEED_SHARE:
            return _BAD
        self._behaviour.speed_level = int(level[0])
        return _DONE

    def _joystick(self, parameter: str) -> Answer:
        return _BAD if parse_flag(parameter, "data") is None else _DONE

    def _pose(self, parameter: str) -> Answer:
        enabled = parse_flag(parameter, "data")
        if enabled is None:
            return _BAD
        if enabled:
            return self._show(POSE)
        self._mover.stop()
        if self._behaviour.mode == MODE_POSE:
            self._behaviour.stand_again()
        return _DONE

    def _choose_gait(self, api_id: int, parameter: str) -> Answer:
        wanted = True if api_id in _WITHOUT_PARAMETER else parse_flag(parameter, "data")
        if wanted is None:
            return _BAD
        self._behaviour.gait = GAITS[_GAITS[api_id] if wanted else "ClassicWalk"]
        return _DONE

    def _avoid(self, parameter: str) -> Answer:
        enabled = parse_flag(parameter, "data")
        return _BAD if enabled is None else self._set_avoidance(enabled)

    def _set_avoidance(self, enabled: bool) -> Answer:
        self._mover.avoids = enabled
        return _DONE

    def _auto_recovery(self, parameter: str) -> Answer:
        enabled = parse_flag(parameter, "data")
        if enabled is None:
            return _BAD
        self._behaviour.auto_recovery = enabled
        return _DONE
