"""The loss of the robot's state messages, found at every rate of ticks."""

from __future__ import annotations

import pytest

from edge.core.geometry import SE2
from edge.safety.monitors.robot import RobotMonitor, RobotWatchConfig
from edge.state.pose_history import StampedPose

MS = 1_000_000


@pytest.mark.parametrize("period_ms", [20, 100, 150])
def test_a_loss_of_half_the_messages_is_found_within_two_seconds(period_ms: int) -> None:
    """50 messages a second for 4 s, then 25."""
    monitor, found_ms = RobotMonitor(RobotWatchConfig()), []
    for now_ms in range(0, 10_000, period_ms):
        pose = StampedPose(now_ms * MS, SE2(0.0, 0.0, 0.0), 0.0, 0.0, 0.0)
        states = min(now_ms, 4000) // 20 + max(0, now_ms - 4000) // 40
        if [finding.name for finding in monitor.step(pose, states, now_ms * MS)] == ["link-lossy"]:
            found_ms.append(now_ms)
    assert found_ms and 4000 < found_ms[0] <= 6000 + period_ms
