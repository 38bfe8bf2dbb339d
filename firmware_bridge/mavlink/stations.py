"""Other stations on the link: a ground station may watch, but not command the rover. Pure.

An autopilot does not pass on other stations' commands, but it acknowledges them on every link, with their number. A
router passes on their packets themselves.
"""

from __future__ import annotations

from typing import Final

MOTION_COMMANDS: Final = {
    11: "SET_MODE",  # ArduPilot acknowledges this message by its number
    20: "NAV_RETURN_TO_LAUNCH",
    21: "NAV_LAND",
    176: "DO_SET_MODE",
    178: "DO_CHANGE_SPEED",
    185: "DO_FLIGHTTERMINATION",
    192: "DO_REPOSITION",
    193: "DO_PAUSE_CONTINUE",
    194: "DO_SET_REVERSE",
    209: "DO_MOTOR_TEST",
    300: "MISSION_START",
    310: "ACTUATOR_TEST",
    400: "COMPONENT_ARM_DISARM",
    43000: "GUIDED_CHANGE_SPEED",
    43002: "GUIDED_CHANGE_HEADING",
}
"""MAV_CMD that change a rover's mode, arming or motion."""
MOTION_MESSAGES: Final = {
    11: "SET_MODE",
    69: "MANUAL_CONTROL",
    70: "RC_CHANNELS_OVERRIDE",
    82: "SET_ATTITUDE_TARGET",
    84: "SET_POSITION_TARGET_LOCAL_NED",
    86: "SET_POSITION_TARGET_GLOBAL_INT",
}
"""Messages that do."""
COMMAND_INT: Final = 75
COMMAND_LONG: Final = 76
COMMAND_MESSAGES: Final = (11, COMMAND_INT, COMMAND_LONG)
"""Messages that can change the mode or the arming: SET_MODE and commands."""


def foreign_acknowledgement(command: int, target: tuple[int, int], own: tuple[int, int], requested: bool) -> str | None:
    """Return the motion command of another station that an acknowledgement reveals; None for one of ours.

    `target` and `own` are (system, component). Old firmware leaves the target at 0: then `requested` decides, whether
    the bridge itself has sent this command lately.
    """
    name = MOTION_COMMANDS.get(command)
    ours = target == own or (target == (0, 0) and requested)
    if name is None or ours:
        return None
    return f"{name} of station {target[0]}/{target[1]}" if target != (0, 0) else f"{name} of an unnamed station"


def foreign_message(number: int, command: int, sender: tuple[int, int]) -> str | None:
    """Return the motion command in another station's own packet; `command`: that of a COMMAND_LONG or COMMAND_INT."""
    name = MOTION_COMMANDS.get(command) if number in (COMMAND_LONG, COMMAND_INT) else MOTION_MESSAGES.get(number)
    return None if name is None else f"{name} of station {sender[0]}/{sender[1]}"
