"""What the services of the simulated Go2 do with their requests: sport, robot_state, motion_switcher."""

from __future__ import annotations

import json
import math
from typing import Final, Protocol

from firmware_bridge.unitree import ids
from sim_hil.sport import SportAction
from sim_hil.unitree.service import Answer, Received

ROBOT_STATE_SERVICE: Final = "robot_state"
MOTION_SWITCHER_SERVICE: Final = "motion_switcher"
_SERVICE_LIST: Final = 1003  # of robot_state
_CHECK_MODE: Final = 1001  # of motion_switcher

_ACTIONS: Final = {
    ids.DAMP: SportAction.DAMP,
    ids.BALANCE_STAND: SportAction.BALANCE_STAND,
    ids.STOP_MOVE: SportAction.STOP_MOVE,
    ids.STAND_UP: SportAction.STAND_UP,
    ids.STAND_DOWN: SportAction.STAND_DOWN,
    ids.RECOVERY_STAND: SportAction.RECOVERY_STAND,
}
# A request that is not here leaves the velocity in force, or is counted as if it did: BalanceStand, a RecoveryStand on
# its feet and an unknown id change nothing, and StandUp is not a way to stop a robot.
_ENDS_MOTION: Final = frozenset({ids.STOP_MOVE, ids.DAMP, ids.STAND_DOWN})
_API_NAMES: Final = {
    ids.SPORT_SERVICE: ids.SPORT_API_NAMES,
    ids.VIDEO_SERVICE: {ids.GET_IMAGE_SAMPLE: "GetImageSample"},
    ROBOT_STATE_SERVICE: {_SERVICE_LIST: "ServiceList"},
    MOTION_SWITCHER_SERVICE: {_CHECK_MODE: "CheckMode"},
}


class Robot(Protocol):
    """The part of the simulation that the sport service commands."""

    def sport(self, action: SportAction, /) -> int:
        """Start an action; 0 or a Unitree error code."""
        ...

    def move(self, vx_mps: float, vy_mps: float, wz_radps: float, /) -> None:
        """Command a velocity in the body frame."""
        ...


def api_name(service: str, api_id: int) -> str:
    """Name of a request for the trace; the number where we know no name."""
    return "Version" if api_id == ids.API_VERSION else _API_NAMES.get(service, {}).get(api_id, str(api_id))


def parse_move(parameter: str) -> tuple[float, float, float] | None:
    """Velocity of a Move's parameter `{"x","y","z"}`; None unless it is three finite numbers."""
    try:
        table = json.loads(parameter)
    except (ValueError, RecursionError):
        return None
    values = [table.get(key) for key in ("x", "y", "z")] if isinstance(table, dict) else []
    numbers = [float(v) for v in values if isinstance(v, (int, float)) and not isinstance(v, bool) and abs(v) < 1e9]
    if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
        return None
    return numbers[0], numbers[1], numbers[2]


def handle_sport(robot: Robot, api_id: int, parameter: str) -> Answer:
    """One sport request: 3203 for what this robot cannot do, 3204 for a Move without three finite numbers."""
    if api_id == ids.MOVE:
        velocity = parse_move(parameter)
        if velocity is None:
            return ids.ERROR_PARAMETER, ""
        robot.move(*velocity)
        return ids.OK, ""
    action = _ACTIONS.get(api_id)
    return (robot.sport(action), "") if action is not None else (ids.ERROR_NOT_IMPLEMENTED, "")


def handle_robot_state(api_id: int, _parameter: str) -> Answer:
    """robot_state: which services run; switching them off is not simulated."""
    if api_id != _SERVICE_LIST:
        return ids.ERROR_NOT_IMPLEMENTED, ""
    names = ("sport_mode", "video_hub", "robot_state", "motion_switcher")
    return ids.OK, json.dumps([{"name": name, "status": 1, "protect": 0} for name in names])


def handle_motion_switcher(api_id: int, _parameter: str) -> Answer:
    """motion_switcher: the sport controller is active; releasing it is not simulated."""
    if api_id != _CHECK_MODE:
        return ids.ERROR_NOT_IMPLEMENTED, ""
    return ids.OK, json.dumps({"form": "0", "name": "normal"})


class CommandLog:
    """What has been commanded over the sport service, for the result: the sniffer's truth, not the commander's."""

    def __init__(self) -> None:
        self.commands = 0
        self.last_move: tuple[float, float, float] | None = None
        self.last_command: str | None = None
        self._at_zero = True  # what the last motion request asked for

    def note(self, request: Received) -> None:
        """Count one received request."""
        if request.service != ids.SPORT_SERVICE or request.api_id == ids.API_VERSION:
            return
        self.last_command = api_name(request.service, request.api_id)
        if request.api_id == ids.MOVE:
            self.commands += 1
            self.last_move = parse_move(request.parameter)
            self._at_zero = self.last_move is not None and not any(self.last_move)
        elif request.api_id in _ENDS_MOTION:
            self._at_zero = True

    def summary(self) -> dict[str, object]:
        """The `wire` part of the result; a robot that was never told to move was last told zero."""
        return {
            "commands": self.commands,
            "last_move": None if self.last_move is None else list(self.last_move),
            "last_command": self.last_command,
            "last_command_zero": self._at_zero,
        }
