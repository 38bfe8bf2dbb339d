"""Checks the action expert's plan: not finite, out of range, wavering, constant."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from edge.motion.controller import TARGET_TIME_S, arc_to, is_plan, scale_to_limits, target_of
from edge.safety.faults.findings import Finding
from firmware_bridge.core.config import LimitsConfig

OUT_OF_RANGE = 5.0
"""Multiple of the speed limit from which a plan is out of range: the training data stayed near the limits."""
WINDOW_S = 1.0
UNSTEADY, OSCILLATING = 0.2, 0.5
"""Shares of the ticks of a second in which the plan reversed its change (fault matrix, row 15)."""
CONSTANT_NS = 2_000_000_000
CHANGED_PICTURES = 5


@dataclass(frozen=True)
class OutputConfig:
    """The robot's limits and the time base of plan and tick."""

    limits: LimitsConfig
    step_s: float
    period_s: float

    def __post_init__(self) -> None:
        if self.step_s <= 0 or self.period_s <= 0:
            raise ValueError(f"output monitor: times must be positive, found {self.step_s} and {self.period_s}")


class OutputMonitor:
    """Keeps the last plan and the changes of its velocity within a second."""

    def __init__(self, config: OutputConfig) -> None:
        self._config = config
        self._velocity: tuple[float, float] | None = None
        self._change = (0.0, 0.0)
        self._turns: deque[bool] = deque(maxlen=max(5, round(WINDOW_S / config.period_s)))
        self._plan: npt.NDArray[np.float32] | None = None
        self._plan_ns = 0
        self._content = 0
        self._changed = 0

    def step(self, trajectory: npt.NDArray[np.float32] | None, content: int, now_ns: int) -> tuple[Finding, ...]:
        """Check a plan [steps, 3], None where the action expert did not run. `content`: hash of the picture."""
        if trajectory is None:
            self._velocity, self._plan = None, None
            self._turns.clear()
            return ()
        if not is_plan(trajectory):
            return (Finding("output-not-finite"),)
        findings: list[Finding] = []
        self._judge_velocity(trajectory, findings)
        self._judge_constancy(trajectory, content, now_ns, findings)
        return tuple(findings)

    def _judge_velocity(self, trajectory: npt.NDArray[np.float32], findings: list[Finding]) -> None:
        limits, config = self._config.limits, self._config
        speed, yaw_rate = arc_to(target_of(trajectory, config.step_s), TARGET_TIME_S)
        if speed > OUT_OF_RANGE * limits.vx_max_mps or abs(yaw_rate) > OUT_OF_RANGE * limits.wz_max_radps:
            findings.append(Finding("output-out-of-range", f"{speed:.1f} m/s, {yaw_rate:.1f} rad/s"))
        velocity = scale_to_limits(speed, yaw_rate, limits, 1.0)
        if self._velocity is not None:
            change = (velocity[0] - self._velocity[0], velocity[1] - self._velocity[1])
            # A change beyond the slew limit of a tick, then its reversal: an ordinary start is a limited change
            # too, but it does not reverse.
            steps = (limits.accel_mps2 * config.period_s, limits.alpha_radps2 * config.period_s)
            turned = any(
                now * before < 0 and min(abs(now), abs(before)) > step
                for now, before, step in zip(change, self._change, steps, strict=True)
            )
            self._turns.append(turned)
            self._change = change
        self._velocity = velocity
        turns, window = sum(self._turns), self._turns.maxlen or 1
        detail = f"turned back {turns} times in the last {window} ticks"
        if turns > OSCILLATING * window:
            findings.append(Finding("output-oscillating", detail))
        elif turns > UNSTEADY * window:
            findings.append(Finding("output-unsteady", detail))

    def _judge_constancy(
        self, trajectory: npt.NDArray[np.float32], content: int, now_ns: int, findings: list[Finding]
    ) -> None:
        if self._plan is None or not np.array_equal(trajectory, self._plan):
            self._plan, self._plan_ns, self._changed = trajectory.copy(), now_ns, 0
        elif content != self._content:
            self._changed += 1
        self._content = content
        if self._changed >= CHANGED_PICTURES and now_ns - self._plan_ns >= CONSTANT_NS:
            findings.append(Finding("output-constant", f"the same for {(now_ns - self._plan_ns) / 1e9:.1f} s"))
