"""Sport service of the simulated Go2: handlers of all requests.

Acrobatics (flips, jumps, hand stand, upright walk) are answered with 3203, not implemented, as by the real robot in a
mode without them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Final, Protocol

from firmware_bridge.unitree.messages import ids
from sim_hil.protocols.unitree.services.behaviour import GAITS, SPEED_SHARE, Go2Behaviour
from sim_hil.protocols.unitree.services.parameters import parse_flag, parse_numbers
from sim_hil.protocols.unitree.services.postures import MODE_POSE, POSE, SHOWS, SIT, Script
from sim_hil.protocols.unitree.services.service import Answer
from sim_hil.protocols.unitree.services.sport import handle_sport
from sim_hil.robots.go2.sport import ERROR_NOT_STANDING, SportAction

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


class Mover(Protocol):
    """Receiver of velocities."""

    avoids: bool
    """Whether velocities are reduced before obstacles."""

    def move(self, vx_mps: float, vy_mps: float, wz_radps: float, /, *, avoiding: bool) -> None:
        """Command a velocity in the body frame for 1 s."""
        ...

    def stop(self) -> None:
        """Discard velocity and goal."""
        ...


class SportService:
    """Handler of sport requests. SwitchJoystick is accepted without effect, because the robot has no joystick."""

    def __init__(self, behaviour: Go2Behaviour, mover: Mover) -> None:
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
