"""Rows of the Go2: faults of its camera, odometry, state, remote and sport service."""

from __future__ import annotations

import signal
import time
from dataclasses import replace

from tools.faults.rig.processes import Rig
from tools.faults.rows.row import BRIDGE_STOP_MS, SCENE_MS, Judge, Row, clear, harmless, robot_fault

_BETWEEN_JUMPS_S = 5.0
_DEAF_MS = 1200
"""Bound on a robot that receives nothing, ms: it drops a command after 1 s."""


def _jump(rig: Rig) -> int:
    """Jump forward and backward alternately, so that the circle does not move into a wall."""
    effect_ns = rig.robot.inject("odometry-jump", dx_m=rig.jump_m)
    rig.jump_m = -rig.jump_m
    return effect_ns


def _two_jumps(rig: Rig) -> int:
    _jump(rig)
    time.sleep(0.5)
    rig.drives_on(_BETWEEN_JUMPS_S)  # the first jump stops the robot for a second only
    return _jump(rig)


def _late_move(rig: Rig) -> int:
    rig.robot.ask("late-move", delay_s=0.2)
    time.sleep(0.1)  # for one Move to be held back
    rig.send(rig.runner, signal.SIGTERM)
    return rig.robot.effect_ns("late-move", 10.0)


def _stop_unanswered(rig: Rig) -> int:
    rig.robot.inject("stop-unanswered", delay_s=10.0)
    return rig.send(rig.runner, signal.SIGTERM)


def _dead_link(rig: Rig) -> int:
    effect_ns = rig.robot.inject("deaf")
    rig.robot.inject("state-silent")
    return effect_ns


def live() -> tuple[Row, ...]:
    """Return the rows that leave the run alive."""
    return (
        robot_fault("camera stops", "camera-stopped", "camera-stop"),
        robot_fault("camera freezes", "camera-frozen", "camera-freeze"),
        robot_fault("camera repeats two pictures in turn", "camera-frozen", "camera-stale-buffers"),
        replace(robot_fault("clock in a frozen picture", "camera-frozen", "camera-frozen-clock"), bound=SCENE_MS),
        replace(robot_fault("noise on a frozen picture", "camera-frozen", "camera-frozen-noise"), bound=SCENE_MS),
        robot_fault("camera answers 1 s late", "camera-stale", "camera-slow", delay_s=1.0),
        robot_fault("camera at half rate", "camera-slow", "camera-half-rate", rate_hz=5.0),
        robot_fault("camera at a third of its rate", "camera-too-slow", "camera-half-rate", rate_hz=3.0),
        robot_fault("camera covered", "frames-refused", "camera-black"),
        robot_fault("camera blinded", "frames-refused", "camera-saturated"),
        robot_fault("camera pictures torn", "frames-refused", "camera-torn"),
        replace(Row("odometry jumps 1 m once", "odometry-jump", _jump), spacing_s=12.5, share=0.4),
        # Its end is a jump of the pose, and two jumps within 10 s end the run.
        replace(
            robot_fault("odometry freezes at zero speed", "odometry-frozen", "odometry-freeze", velocity="zero"),
            spacing_s=12.5, share=0.4,
        ),
        robot_fault("odometry is NaN", "odometry-not-finite", "odometry-nan"),
        robot_fault("orientation is not one", "odometry-not-finite", "odometry-nan", field="rpy"),
        robot_fault("odometry 200 ms late", "odometry-late", "odometry-lag", delay_s=0.2),
        robot_fault("odometry 300 ms late", "odometry-stale", "odometry-lag", delay_s=0.3),
        robot_fault("robot's state silent", "odometry-stale", "state-silent"),
        robot_fault("half of the states lost", "link-lossy", "state-loss", percent=50.0),
        harmless("every tenth state lost", "state-loss", percent=10.0),
        # Of two reordered states the older one is dropped: half of them are lost.
        robot_fault("states change places", "link-lossy", "state-reorder"),
        harmless("states come twice", "state-duplicate"),
        robot_fault("30 % lost", None, "state-loss", judge=Judge.FRESH, percent=30.0),
        replace(robot_fault("battery at 15 %", "battery-low", "low-battery", soc_percent=15.0), share=0.4),
    )  # fmt: skip


def ending() -> tuple[Row, ...]:
    """Return the rows that end the run."""
    return (
        robot_fault("camera has another size", "camera-swapped", "camera-wrong-size"),
        replace(Row("odometry jumps 1 m twice", "odometry-jumps", _two_jumps), share=0.5),
        robot_fault("odometry freezes at full speed", "odometry-speed-mismatch", "odometry-freeze"),
        robot_fault("speed reads 1 m/s too high", "odometry-speed-mismatch", "odometry-bias"),
        robot_fault("robot tips over", "tipped-over", "tip-over"),
        replace(robot_fault("battery at 3 %", "battery-empty", "low-battery", soc_percent=3.0), share=0.4),
        robot_fault("robot reports an error", "robot-error", "error-code"),
        robot_fault("robot reports damping", "robot-mode-left", "wrong-mode", mode=7.0),
        replace(robot_fault("remote: L2+B", "emergency-stop", "remote-keys"), operator_arms=True, by_bridge=True),
        robot_fault("remote: stick pushed", "emergency-stop", "remote-stick"),
        Row("second commander", "second-commander", lambda rig: rig.rogue(1.0), Rig.wait_alone, by_bridge=True),
        Row("late Move overtakes StopMove", "late-motion", _late_move),
        replace(
            Row("StopMove unanswered for 10 s", "stop-call-blocked", _stop_unanswered, clear),
            judge=Judge.ZERO, bound=BRIDGE_STOP_MS, ends_run=True, share=0.5,
        ),
        replace(
            robot_fault("robot receives nothing", None, "deaf", judge=Judge.ROBOT), bound=_DEAF_MS, starts_anew=True,
            by_bridge=True, share=0.4,
        ),
        replace(
            Row("link dead both ways", "link-lost", _dead_link, clear), judge=Judge.ROBOT, by_bridge=True, share=0.5
        ),
    )  # fmt: skip
