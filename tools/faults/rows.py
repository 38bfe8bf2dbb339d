"""Rows of `make faults`: fault of the table, injection, required reaction."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from types import MappingProxyType

from edge.safety.faults.table import FAULTS, Action
from sim_hil.protocols.fault_socket import TIMEOUT_S
from tools.faults.rig import Rig

BRIDGE_STOP_MS = 300
"""Bound on the stop after SIGTERM to the bridge or the runner, ms: as after a dead runner."""

SCENE_MS = 1000
"""A scene that stays the same is found by distance: 0.25 m or 12° take 0.4 s on the circle, more where it slows."""


class Judge(Enum):
    """Criterion of a row."""

    ZERO = "zero"
    """Time to the lasting zero velocity."""
    LIMIT = "limit"
    """Time to commands that stay within the limit's share of the speed limit."""
    ROBOT = "robot"
    """Time until the robot obeys no velocity."""
    UNCHANGED = "unchanged"
    """Longest time without a moving command; nothing else may change."""


@dataclass(frozen=True)
class Row:
    """One kind of injection. `inject` returns the time of the effect, ns; `undo` ends it."""

    name: str
    fault: str | None
    inject: Callable[[Rig], int]
    undo: Callable[[Rig], None] | None = None
    judge: Judge | None = None
    """None: derived from the fault's action."""
    bound: float | None = None
    """Bound, ms; None: the fault's."""
    share: float = 1.0
    """Share of --per-row; slow injections are made less often."""
    ends_run: bool = False
    """Whether the run ends and a new runner is started, even if the fault does not latch."""
    spacing_s: float = 0.0
    """Time between two injections, for faults that escalate when repeated, s."""
    operator_arms: bool = False
    """Whether an operator must then permit the next runner to arm (`edge-bridge arm`)."""
    thaw: bool = False
    """Whether to send SIGCONT to the runner afterwards, which must not move the robot."""

    def __post_init__(self) -> None:
        if self.fault is None and self.judge is None:
            raise ValueError(f"row {self.name}: expected a fault of the table or a judge")
        if self.fault is not None and self.fault not in FAULTS:
            raise ValueError(f"row {self.name}: {self.fault!r} is not in the fault table")

    @property
    def judged_by(self) -> Judge:
        """The given judge, or the one of the fault's action."""
        if self.judge is not None:
            return self.judge
        assert self.fault is not None
        fault = FAULTS[self.fault]
        if fault.action is Action.LIMIT:
            return Judge.LIMIT
        if fault.action is Action.NOTHING:
            return Judge.UNCHANGED
        return Judge.ROBOT if fault.where == "robot" else Judge.ZERO

    @property
    def bound_ms(self) -> float:
        """Longest time from the effect to the judged event, ms; for UNCHANGED the longest gap between two commands."""
        if self.bound is not None:
            return self.bound
        if self.judged_by is Judge.UNCHANGED:
            return UNCHANGED_GAP_MS
        return FAULTS[self.fault].bound_ms if self.fault is not None else BRIDGE_STOP_MS

    @property
    def speed_scale(self) -> float:
        """Remaining share of the speed limit under a limiting fault."""
        return FAULTS[self.fault].speed_scale if self.fault is not None else 1.0

    @property
    def kills_bridge(self) -> bool:
        """Whether the bridge has ended or hangs afterwards."""
        return self.name.startswith("bridge ")

    @property
    def latches(self) -> bool:
        """Whether the fault ends the run."""
        return self.ends_run or (self.fault is not None and FAULTS[self.fault].latch)


NOT_INJECTED: Mapping[str, str] = MappingProxyType(
    {
        "camera-from-future": "the Go2's protocol carries no capture stamp that could lie in the future",
        "frame-refused": "only a message to the operator; three in a row are injected",
        "output-out-of-range": "only a message to the operator; five in a second are injected",
        "reasoning-failed": "only a message to the operator; five in a minute are injected",
        "odometry-stays-frozen": "its cause, one frozen pose, is injected; test of two on a fake clock",
        "output-unsteady": "a milder oscillation; the hard one is injected",
        "semantic-old": "precedes an expired semantic state, which is injected",
        "reasoning-hung": "the robot already stands, because its semantic state has expired, which is injected",
        "semantic-delay-invalid": "needs a defect of the runner's stamps; test on a fake clock",
        "instruction-injected": "has no effect by construction; test over a thousand texts",
        "stop-phrase": "for the robot the same as the end of the runner, which is injected; test with edge-say",
        "tick-overrun": "such a long tick also exceeds the bridge's deadman (commands-late), which is injected",
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

UNCHANGED_GAP_MS = 100.0
"""Largest gap between two commands, ms: five periods of the bridge and one tick."""
_BETWEEN_JUMPS_S = 5.0
_INSIDE_S = 30.0
"""Timeout of an injection into the runner, s: a fault of reasoning takes effect in the next generation."""


def _robot(name: str, fault: str, injected: str, **values: float | str) -> Row:
    return Row(
        name,
        fault,
        lambda rig: rig.robot.inject(injected, on=True, timeout_s=TIMEOUT_S, **values),
        lambda rig: _off(rig, injected),
    )


def _harmless(name: str, injected: str, **values: float | str) -> Row:
    """Create the row of a robot-side fault that must change nothing."""
    row = _robot(name, "message-reordered", injected, **values)
    return replace(row, fault=None, judge=Judge.UNCHANGED, share=0.4)


def _clear(rig: Rig) -> None:
    rig.clear()


def _off(rig: Rig, injected: str) -> None:
    rig.robot.inject(injected, on=False)


def _inside(name: str, fault: str, injected: str, **values: float | str) -> Row:
    return Row(name, fault, lambda rig: rig.inside.inject(injected, on=True, timeout_s=_INSIDE_S, **values), _clear)


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


def _wall_clock(seconds_s: float) -> Callable[[Rig], int]:
    def inject(rig: Rig) -> int:
        # No onboard code reads the date, so there is no effect to wait for.
        rig.inside.ask("wall-clock", seconds_s=seconds_s)
        return time.monotonic_ns()

    return inject


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


def rows() -> tuple[Row, ...]:
    """Return all rows; those that leave the run alive come first, so that they share a run."""
    live = (
        _robot("camera stops", "camera-stopped", "camera-stop"),
        _robot("camera freezes", "camera-frozen", "camera-freeze"),
        _robot("camera repeats two pictures in turn", "camera-frozen", "camera-stale-buffers"),
        replace(_robot("clock in a frozen picture", "camera-frozen", "camera-frozen-clock"), bound=SCENE_MS),
        replace(_robot("noise on a frozen picture", "camera-frozen", "camera-frozen-noise"), bound=SCENE_MS),
        _robot("camera answers 1 s late", "camera-stale", "camera-slow", delay_s=1.0),
        _robot("camera at half rate", "camera-slow", "camera-half-rate", rate_hz=5.0),
        _robot("camera at a third of its rate", "camera-too-slow", "camera-half-rate", rate_hz=3.0),
        _robot("camera covered", "frames-refused", "camera-black"),
        _robot("camera blinded", "frames-refused", "camera-saturated"),
        _robot("camera pictures torn", "frames-refused", "camera-torn"),
        replace(Row("odometry jumps 1 m once", "odometry-jump", _jump), spacing_s=12.5, share=0.4),
        # Its end is a jump of the pose, and two jumps within 10 s end the run.
        replace(
            _robot("odometry freezes at zero speed", "odometry-frozen", "odometry-freeze", velocity="zero"),
            spacing_s=12.5, share=0.4,
        ),
        _robot("odometry is NaN", "odometry-not-finite", "odometry-nan"),
        _robot("orientation is not one", "odometry-not-finite", "odometry-nan", field="rpy"),
        _robot("odometry 200 ms late", "odometry-late", "odometry-lag", delay_s=0.2),
        _robot("odometry 300 ms late", "odometry-stale", "odometry-lag", delay_s=0.3),
        _robot("robot's state silent", "odometry-stale", "state-silent"),
        _robot("half of the states lost", "link-lossy", "state-loss", percent=50.0),
        _harmless("every tenth state lost", "state-loss", percent=10.0),
        # Of two reordered states the older one is dropped: half of them are lost.
        _robot("states change places", "link-lossy", "state-reorder"),
        _harmless("states come twice", "state-duplicate"),
        replace(_robot("battery at 15 %", "battery-low", "low-battery", soc_percent=15.0), share=0.4),
        _inside("plan is NaN", "output-not-finite", "nan-output"),
        _inside("action expert fails", "output-not-finite", "act-error"),
        _inside("plan never changes", "output-constant", "constant-output"),
        _inside("plan swings at every tick", "output-oscillating", "oscillating-output"),
        _inside("encoder fails", "camera-stopped", "encoder-error"),
        _inside("action expert takes 0.1 s more", "tick-late", "tick-slow", seconds_s=0.1),
        replace(_inside("reasoning hangs", "semantic-expired", "reasoning-hang"), share=0.25),
        replace(_inside("reasoning's third bad text", "semantic-text-invalid", "garbage-text", after=3.0), share=0.4),
        replace(_inside("flight log's disk stalls", "log-disk-stalled", "disk-stall", seconds_s=3.0), share=0.4),
        replace(Row("date jumps an hour ahead", "wall-clock-moved", _wall_clock(3600.0), _clear), share=0.4),
        replace(Row("date jumps an hour back", "wall-clock-moved", _wall_clock(-3600.0), _clear), share=0.4),
    )  # fmt: skip
    over = (
        Row("runner SIGKILL", "runner-killed", lambda rig: rig.send(rig.runner, signal.SIGKILL)),
        Row("runner SIGSTOP, SIGCONT", "runner-frozen", lambda rig: rig.send(rig.runner, signal.SIGSTOP), thaw=True),
        Row("runner SIGTERM", None, lambda rig: rig.send(rig.runner, signal.SIGTERM), judge=Judge.ZERO, ends_run=True),
        _inside("control thread dies", "control-thread-dead", "control-death"),
        replace(_inside("flight log's disk full", "log-disk-full", "disk-full"), ends_run=True, share=0.4),
        _inside("action expert takes 0.6 s", "commands-late", "tick-slow", seconds_s=0.6),
        _inside("graph does not come back", "graph-hung", "control-hang"),
        replace(_inside("reasoning thread dies", "semantic-expired", "reasoning-death"), ends_run=True, share=0.5),
        _inside("reasoning fails five times", "reasoning-failing", "reasoning-error", after=5.0),
        _inside("plan ten times too long", "output-out-of-range-often", "scaled-output"),
        _robot("camera has another size", "camera-swapped", "camera-wrong-size"),
        replace(Row("odometry jumps 1 m twice", "odometry-jumps", _two_jumps), share=0.5),
        _robot("odometry freezes at full speed", "odometry-speed-mismatch", "odometry-freeze"),
        _robot("speed reads 1 m/s too high", "odometry-speed-mismatch", "odometry-bias"),
        _robot("robot tips over", "tipped-over", "tip-over"),
        replace(_robot("battery at 3 %", "battery-empty", "low-battery", soc_percent=3.0), share=0.4),
        _robot("robot reports an error", "robot-error", "error-code"),
        _robot("robot reports damping", "robot-mode-left", "wrong-mode", mode=7.0),
        replace(_robot("remote: L2+B", "emergency-stop", "remote-keys"), operator_arms=True),
        _robot("remote: stick pushed", "emergency-stop", "remote-stick"),
        Row("second commander", "second-commander", lambda rig: rig.rogue(1.0), Rig.wait_alone),
        Row("late Move overtakes StopMove", "late-motion", _late_move),
        replace(
            Row("StopMove unanswered for 10 s", "stop-call-blocked", _stop_unanswered, _clear),
            judge=Judge.ZERO, bound=BRIDGE_STOP_MS, ends_run=True, share=0.5,
        ),
        replace(Row("link dead both ways", "link-lost", _dead_link, _clear), judge=Judge.ROBOT, share=0.5),
        Row("bridge SIGTERM", None, lambda rig: rig.send(rig.bridge, signal.SIGTERM), judge=Judge.ZERO, ends_run=True),
        Row("bridge SIGKILL", "bridge-killed", lambda rig: rig.send(rig.bridge, signal.SIGKILL)),
        replace(Row("bridge SIGSTOP", "bridge-hung", lambda rig: rig.send(rig.bridge, signal.SIGSTOP)), share=0.5),
    )  # fmt: skip
    return (*live, *over)
