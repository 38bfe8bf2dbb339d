"""Checks all inputs before arming with the same monitors and fault table as while driving."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from edge.safety.monitors.watch import Watch
from edge.safety.supervisor import State, Supervisor, SupervisorInputs
from edge.state.frame import Frame
from edge.state.pose_history import StampedPose

STOPPED_NS: Final = 2_000_000_000
"""Time for which a fault that would end a run must be absent before arming, ns."""


class PreArm:
    """Checks pictures, poses and the findings of other threads; STARTING while a fault blocks arming, then READY."""

    def __init__(
        self,
        watch: Watch,
        *,
        picture: Callable[[], Frame | None],
        pose: Callable[[], StampedPose | None],
        clock: Callable[[], int],
    ) -> None:
        """`watch`: not shared with the run, which begins with fresh monitors."""
        self._watch = watch
        self._picture = picture
        self._pose = pose
        self._clock = clock
        self._supervisor = Supervisor()
        self._stopped_ns: int | None = None
        self._stopped = ""
        self.state = State.STARTING

    def blocking_fault(self) -> str:
        """Return the worst fault that would keep the robot from moving, for the operator; empty: none."""
        picture, pose = self._picture(), self._pose()
        now_ns = self._clock()  # read last: a newer pose would have a negative age, which is a fault
        findings = self._watch.standing(picture, pose, now_ns)
        outputs = self._supervisor.step(SupervisorInputs(findings, armed=False), now_ns)
        if outputs.stop:
            # The robot is not armed, so nothing latches: start over.
            self._supervisor, self._stopped_ns, self._stopped = Supervisor(), now_ns, outputs.message
        elif self._stopped_ns is not None and now_ns - self._stopped_ns >= STOPPED_NS:
            self._stopped_ns = None
        why = outputs.message if outputs.speed_scale <= 0 else ""
        if self._stopped_ns is not None:
            why = self._stopped
        self.state = State.STARTING if why else State.READY
        return why
