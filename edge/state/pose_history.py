"""Pose history of the drift estimator, without a lock: one thread writes, two threads read."""

from __future__ import annotations

from dataclasses import dataclass

from edge.core.geometry import SE2, interpolate


@dataclass(frozen=True)
class StampedPose:
    """One fused pose: monotonic stamp, `T_odom_base`, body velocity, and the robot's reported attitude."""

    stamp_ns: int
    T_odom_base: SE2
    vx_mps: float
    vy_mps: float
    wz_radps: float
    roll_rad: float = 0.0
    pitch_rad: float = 0.0

    @property
    def velocity(self) -> tuple[float, float, float]:
        """Body velocity: vx m/s, vy m/s, ωz rad/s."""
        return (self.vx_mps, self.vy_mps, self.wz_radps)


class PoseHistory:
    """The last `capacity` poses; one writer, any number of readers, none ever waits.

    Slots are replaced whole, and copying a list is atomic in CPython, so a reader sees complete poses only.
    """

    def __init__(self, capacity: int = 4096) -> None:
        self._slots: list[StampedPose | None] = [None] * capacity
        self._count = 0

    def put(self, pose: StampedPose) -> None:
        """Add the newest pose; poses that do not advance in time are ignored."""
        newest = self.newest()
        if newest is not None and pose.stamp_ns <= newest.stamp_ns:
            return
        self._slots[self._count % len(self._slots)] = pose
        self._count += 1

    def newest(self) -> StampedPose | None:
        """Return the newest pose; None while the history is empty."""
        return self._slots[(self._count - 1) % len(self._slots)] if self._count else None

    def at(self, stamp_ns: int) -> SE2 | None:
        """Return `T_odom_base` at an instant, interpolated; outside the history its nearest end; None while empty."""
        around = self._around(stamp_ns)
        if around is None:
            return None
        before, after, fraction = around
        return interpolate(before.T_odom_base, after.T_odom_base, fraction)

    def attitude_at(self, stamp_ns: int) -> tuple[float, float] | None:
        """Return roll and pitch, rad, at an instant, interpolated like the pose in `at`."""
        around = self._around(stamp_ns)
        if around is None:
            return None
        before, after, f = around
        return (
            before.roll_rad + f * (after.roll_rad - before.roll_rad),
            before.pitch_rad + f * (after.pitch_rad - before.pitch_rad),
        )

    def _around(self, stamp_ns: int) -> tuple[StampedPose, StampedPose, float] | None:
        """Return the poses before and after an instant, and its fraction of the way between them, 0..1."""
        count = self._count
        slots = list(self._slots)
        after: StampedPose | None = None
        # Search backwards from the newest: nearly every request is a fraction of a second old.
        for index in range(count - 1, max(count - len(slots), 0) - 1, -1):
            before = slots[index % len(slots)]
            if before is None or (after is not None and before.stamp_ns >= after.stamp_ns):
                break  # the writer has overwritten this end of the copy
            if before.stamp_ns <= stamp_ns:
                if after is None:
                    return before, before, 0.0
                return before, after, (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
            after = before
        return None if after is None else (after, after, 0.0)
