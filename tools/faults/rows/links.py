"""Rows of the robots on CAN, MAVLink and ROS 2: their link, their battery, and what their protocol alone can suffer."""

from __future__ import annotations

from dataclasses import replace

from sim_hil.protocols.mavlink import forger
from sim_hil.realtime.robots import StackRobot
from tools.faults.rig.processes import Rig
from tools.faults.rows.row import Judge, Row, clear, own_stop_ms, robot_fault

TAKEOVER_MS = 100
"""Bound on the stop after a pilot's switch, ms: a heartbeat at once and one period of the bridge."""
BABBLE_HZ = 3650.0
"""Frames of a babbling node that fill 95 % of a bus of 500 kbit/s, 130 bits each, 1/s."""
_ALL_HZ = 4000.0  # more than the bus carries


def link_rows(robot: StackRobot) -> tuple[tuple[Row, ...], tuple[Row, ...]]:
    """Return the rows that leave the run alive, and those that end it."""
    own_ms = own_stop_ms(robot)
    only = {"can": _can, "mavlink": _mavlink, "ros2": _ros2}[robot.protocol]
    live, ending = only(own_ms)
    return live, (
        *(replace(row, by_bridge=True) for row in ending),
        _robot_stands("link dead both ways", "mute", own_ms),
        _robot_stands("robot receives nothing", "deaf", own_ms),
        replace(robot_fault("robot's state silent", "odometry-stale", "silent"), starts_anew=True),
        robot_fault("battery at 3 %", "battery-empty", "battery_empty"),
    )


def _robot_stands(name: str, injected: str, bound_ms: float) -> Row:
    return replace(
        robot_fault(name, None, injected, judge=Judge.ROBOT), bound=bound_ms, starts_anew=True, by_bridge=True
    )


def _degraded(name: str, bound_ms: float, **plan: float) -> Row:
    """Create the row of a link that gets worse: the robot obeys no command beyond its own timeout."""

    def inject(rig: Rig) -> int:
        return max(rig.robot.inject(field, value=value) for field, value in plan.items())

    return Row(name, None, inject, clear, judge=Judge.FRESH, bound=bound_ms)


def _second_commander() -> Row:
    return Row("second commander", "second-commander", lambda rig: rig.rogue(1.0), Rig.wait_alone)


def _can(own_ms: float) -> tuple[tuple[Row, ...], tuple[Row, ...]]:
    live = (
        _degraded("30 % lost", own_ms, drop=0.3),
        _degraded("every frame twice", own_ms, duplicate=1.0),
        _degraded("every 20th frame corrupted", own_ms, corrupt=0.05),
        replace(_degraded("babbling node, 95 % of the bus", own_ms, babble_hz=BABBLE_HZ), fault="can-bus-overloaded"),
    )
    return live, (
        replace(
            _degraded("every frame corrupted", own_ms, corrupt=1.0),
            fault="can-frames-invalid",
            judge=None,
            bound=None,
            starts_anew=True,
        ),
        Row("bus-off", "can-bus-off", Rig.bus_off, Rig.bus_restarted),
        replace(
            _degraded("babbling node, the whole bus", own_ms, babble_hz=_ALL_HZ), judge=Judge.ROBOT, starts_anew=True
        ),
        replace(robot_fault("emergency stop button", "emergency-stop", "button"), operator_arms=True),
        _second_commander(),
    )


def _mavlink(own_ms: float) -> tuple[tuple[Row, ...], tuple[Row, ...]]:
    return (
        _degraded("30 % lost", own_ms, loss_percent=30.0),
        _degraded("200 ms jitter", own_ms, jitter_ms=200.0),
        _degraded("a fifth of the packets late by 100 ms", own_ms, reorder_percent=20.0, reorder_ms=100.0),
        _degraded("every packet twice", own_ms, duplicate_percent=100.0),
    ), (
        robot_fault("unsigned packets", "mavlink-forged", forger.UNSIGNED),
        robot_fault("packets with another key", "mavlink-forged", forger.WRONG_KEY),
        robot_fault("recorded packets again", "mavlink-forged", forger.REPLAYED),
        robot_fault("packets of another system", "mavlink-forged", forger.OTHER_SYSTEM),
        replace(robot_fault("pilot's mode switch", "emergency-stop", "pilot"), bound=TAKEOVER_MS, operator_arms=True),
        _second_commander(),
    )


def _ros2(own_ms: float) -> tuple[tuple[Row, ...], tuple[Row, ...]]:
    return (
        _degraded("30 % lost", own_ms, loss_percent=30.0),
        _degraded("200 ms jitter", own_ms, jitter_ms=200.0),
        _degraded("every message twice", own_ms, duplicate_percent=100.0),
    ), (_second_commander(),)
