"""Rows of `make faults` for each robot, and the faults of the table that have none."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from sim_hil.realtime.robots import GO2, StackRobot
from tools.faults.rows import go2, processes
from tools.faults.rows.links import link_rows
from tools.faults.rows.row import Judge, Row

__all__ = ["CONTRACT", "NOT_INJECTED", "Judge", "Row", "rows"]

CONTRACT = frozenset(
    {
        *("runner SIGKILL", "runner SIGSTOP, SIGCONT", "bridge SIGKILL", "bridge SIGSTOP"),
        *("link dead both ways", "robot receives nothing", "robot's state silent", "30 % lost", "200 ms jitter"),
        *("odometry 200 ms late", "second commander", "battery at 3 %", "remote: L2+B", "emergency stop button"),
        *("date jumps an hour ahead", "date jumps an hour back"),
        *("every frame twice", "every 20th frame corrupted", "every frame corrupted", "bus-off"),
        *("babbling node, 95 % of the bus", "babbling node, the whole bus"),
        *("unsigned packets", "packets with another key", "recorded packets again", "packets of another system"),
        "pilot's mode switch",
        *("a fifth of the packets late by 100 ms", "every packet twice", "every message twice"),
    }
)
"""Names of the rows of the table of backends and faults; each robot has those that its protocol can suffer."""

NOT_INJECTED: Mapping[str, str] = MappingProxyType(
    {
        "camera-from-future": "the Go2's protocol carries no capture stamp that could lie in the future",
        "frame-refused": "only a message to the operator; three in a row are injected",
        "output-out-of-range": "only a message to the operator; five in a second are injected",
        "reasoning-failed": "only a message to the operator; five in a minute are injected",
        "odometry-stays-frozen": "its cause, one frozen pose, is injected; test of two on a fake clock",
        "robot-blocked": "two frozen poses with motion in between; one is injected, test of both on a fake clock",
        "robot-stays-blocked": "five blocks; test on a fake clock",
        "output-unsteady": "a milder oscillation; the hard one is injected",
        "semantic-old": "precedes an expired semantic state, which is injected",
        "reasoning-hung": "the robot already stands, because its semantic state has expired, which is injected",
        "semantic-delay-invalid": "needs a defect of the runner's stamps; test on a fake clock",
        "instruction-injected": "has no effect by construction; test over a thousand texts",
        "stop-phrase": "for the robot the same as the end of the runner, which is injected; test with edge-say",
        "suspended": "would suspend this machine; test on a fake clock",
        "clock-backwards": "the kernel does not let a process move the monotonic clock; test on a fake clock",
        "thermal-throttle": "needs a board that is hot; test on a fake sysfs tree",
        "thermal-trip": "needs a board that is hot; test on a fake sysfs tree",
        "out-of-memory": "for the robot the same as a killed runner, which is injected",
        "message-flood": "for the bridge the same as old commands after SIGCONT, which are injected",
        "message-reordered": "a local SEQPACKET socket cannot reorder commands; reordered states are injected",
        "latch-lost": "the robot already stands; process tests kill the bridge after a stop",
        "state-from-future": "process test with a second participant that forges reports",
        "lease-taken": "for the robot the same as a second commander, which is injected; process test",
        "stop-denied": "the robot does not obey: process test of the message to the operator",
        "second-publisher": "process test with a second robot in the same domain",
        "motor-commands": "process test with a second participant",
        "emergency-stop-latched": "the robot is not driven; model test and process tests",
        "permission-expired": "the robot is not driven; process test",
        "robot-link-down": "would disable this machine's network; test with failing fake writes",
    }
)
"""Faults of the table without a row, each with the reason."""


def rows(robot: StackRobot = GO2) -> tuple[Row, ...]:
    """Return a robot's rows; those that leave the run alive come first, so that they share a run."""
    live, ending = (go2.live(), go2.ending()) if robot is GO2 else link_rows(robot)
    return (*live, *processes.live(), *processes.ending(robot), *ending)
