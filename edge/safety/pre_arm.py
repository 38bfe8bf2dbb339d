"""Before arming: is everything there that driving needs? The same monitors and table, with nobody armed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from edge.safety.monitors.frame import Picture
from edge.safety.monitors.watch import Watch
from edge.safety.supervisor import State, Supervisor, SupervisorInputs
from edge.state.pose_history import StampedPose

STOPPED_NS: Final = 2_000_000_000
"""What would end a run keeps from arming until it has not been found for this long."""


class PreArm:
    """Looks at pictures, poses and what other threads find; STARTING until nothing is in the way, then READY."""

    def __init__(
        self,
        watch: Watch,
        *,
        picture: Callable[[], Picture | None],
        pose: Callable[[], StampedPose | None],
        clock: Callable[[], int],
    ) -> None:
        """`watch`: one of its own, since a run begins with fresh monitors."""
        self._watch = watch
        self._picture = picture
        self._pose = pose
        self._clock = clock
        self._supervisor = Supervisor()
        self._stopped_ns: int | None = None
        self._stopped = ""
        self.state = State.STARTING

    def in_the_way(self) -> str:
        """One look, several times a second: the worst fault that would keep the robot from moving; empty: none."""
        now_ns = self._clock()
        findings = self._watch.standing(self._picture(), self._pose(), now_ns)
        outputs = self._supervisor.step(SupervisorInputs(findings, armed=False), now_ns)
        if outputs.stop:
            # Nothing has been armed that could be latched: it counts from anew.
            self._supervisor, self._stopped_ns, self._stopped = Supervisor(), now_ns, outputs.says
        elif self._stopped_ns is not None and now_ns - self._stopped_ns >= STOPPED_NS:
            self._stopped_ns = None
        why = outputs.says if outputs.speed_scale <= 0 else ""
        if self._stopped_ns is not None:
            why = self._stopped
        self.state = State.STARTING if why else State.READY
        return why
