"""Unitree services, API ids and error codes we use, as literal tables.

Source: unitreerobotics/unitree_sdk2_python (BSD-3), go2/sport/sport_api.py, go2/video/video_api.py,
rpc/internal.py; values only.
"""

from __future__ import annotations

from typing import Final

SPORT_SERVICE: Final = "sport"
VIDEO_SERVICE: Final = "videohub"
MOTION_SWITCHER_SERVICE: Final = "motion_switcher"
ROBOT_STATE_SERVICE: Final = "robot_state"
OBSTACLES_AVOID_SERVICE: Final = "obstacles_avoid"
SPORT_STATE_TOPIC: Final = "rt/sportmodestate"
LOW_STATE_TOPIC: Final = "rt/lowstate"
LF_LOW_STATE_TOPIC: Final = "rt/lf/lowstate"  # the same at a low frequency
LOW_COMMAND_TOPIC: Final = "rt/lowcmd"  # motor commands, past the sport service
REMOTE_TOPIC: Final = "rt/wirelesscontroller"

API_VERSION: Final = 1  # every service answers it with its version as bare text
SERVICE_VERSION: Final = "1.0.0.1"

DAMP: Final = 1001
BALANCE_STAND: Final = 1002
STOP_MOVE: Final = 1003
STAND_UP: Final = 1004
STAND_DOWN: Final = 1005
RECOVERY_STAND: Final = 1006
MOVE: Final = 1008  # {"x","y","z"}: m/s, m/s, rad/s in the body frame; never answered
GET_IMAGE_SAMPLE: Final = 1001  # of videohub

SPORT_API_NAMES: Final = {
    API_VERSION: "Version",
    DAMP: "Damp",
    BALANCE_STAND: "BalanceStand",
    STOP_MOVE: "StopMove",
    STAND_UP: "StandUp",
    STAND_DOWN: "StandDown",
    RECOVERY_STAND: "RecoveryStand",
    MOVE: "Move",
}
# The only ids that ever leave this machine: the same field can ask for a back flip (faults table, "Unitree hazards").
BRIDGE_ALLOWED: Final = frozenset({API_VERSION, MOVE, STOP_MOVE, STAND_UP, RECOVERY_STAND, BALANCE_STAND})
# Services that can move the robot or change what moves it, with their requests that only ask. Every other request there
# that is not ours is a second commander's.
COMMANDING_SERVICES: Final = {
    SPORT_SERVICE: frozenset({API_VERSION, 2055}),  # AutoRecoveryGet
    f"{SPORT_SERVICE}_lease": frozenset({API_VERSION}),  # its holder shuts every other client out
    MOTION_SWITCHER_SERVICE: frozenset({API_VERSION, 1001, 1005}),  # CheckMode, GetSilent
    ROBOT_STATE_SERVICE: frozenset({API_VERSION, 1002, 1003}),  # SetReportFreq, ServiceList
    OBSTACLES_AVOID_SERVICE: frozenset({API_VERSION, 1002}),  # SwitchGet
}

OK: Final = 0
ERROR_NOT_IMPLEMENTED: Final = 3203
ERROR_PARAMETER: Final = 3204
LEASE_ERRORS: Final = frozenset({3205, 3206, 3207})  # denied, does not exist, exists: another client holds the lease

# SportModeState_.mode
MODE_IDLE: Final = 0
MODE_BALANCE_STAND: Final = 1
MODE_LOCOMOTION: Final = 3
MODE_LIE_DOWN: Final = 5
MODE_JOINT_LOCK: Final = 6
MODE_DAMPING: Final = 7
MODE_RECOVERY_STAND: Final = 8
LAST_MODE: Final = 13  # front pounce


def request_topic(service: str) -> str:
    """Return the DDS topic on which `service` receives requests."""
    return f"rt/api/{service}/request"


def response_topic(service: str) -> str:
    """DDS topic on which `service` answers."""
    return f"rt/api/{service}/response"


def trusted_publishers(own_motor_publishers: int) -> dict[str, int]:
    """Return how many publishers each trusted topic may have; of motor commands, the robot's own."""
    inputs = (SPORT_STATE_TOPIC, LF_LOW_STATE_TOPIC, REMOTE_TOPIC, response_topic(SPORT_SERVICE))
    return {**dict.fromkeys(inputs, 1), LOW_COMMAND_TOPIC: own_motor_publishers}
