"""The semantic state: the last released generation, as the control thread reads it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from edge.core.geometry import SE2
from edge.state.reasoning_text import WAYPOINT_TIMES_S, Waypoints, plans_to_wait
from edge.state.ring import TokenRing

PREEMPTED_NS = 500_000
"""A Δt older than this when the action expert is called is taken again, ns: half of what a prompt resolves."""
CLOCK_READINGS = 3
"""Most times that it is taken."""

STRAIGHT_AHEAD: Waypoints = tuple((time_s / 2, 0.0) for time_s in WAYPOINT_TIMES_S)
"""Waypoints at 0.5 m/s, with which graphs are warmed up and timed."""

Context = Mapping[str, npt.NDArray[np.generic]]
"""The semantic context by tensor name: `context.0.key` [1, heads, d, T], `context.0.value` [1, heads, T, d], …"""


@dataclass(frozen=True)
class LatencyInput:
    """The action expert's input `latency`: [Δt s, Δx m, Δy m, Δθ rad] (Algorithm 4, line 19)."""

    delay_s: float
    offset: SE2
    """(Δx, Δy, Δθ): the current pose in the robot frame at the anchor."""


@dataclass(frozen=True)
class SemanticState:
    """Immutable result of one generation, with the anchor that its keys and values belong to.

    It is published by a single reference assignment, so keys, values and anchor can never be of two generations.
    """

    generation: int
    anchor_ns: int
    T_odom_anchor: SE2
    ready_ns: int
    last_layer_kv: npt.NDArray[np.float32]
    """K‖V of the language model's last layer, [1, T, kv_dim]."""
    context: Context
    text: str
    waypoints: Waypoints | None
    text_complete: bool = True
    """False: the mode or the power budget cut the text short, so an invalid text is no model fault."""
    T_odom_stop: SE2 | None = None
    """Where this text and those before it plan to stop (`edge.reasoning.instruction_state`)."""

    @cached_property
    def waits(self) -> bool:
        """Whether the text plans to let a person pass first; read once, not in every tick."""
        return plans_to_wait(self.text)

    def delay_s(self, now_ns: int) -> float:
        """Δt: now − anchor (inference time plus time since it finished)."""
        return (now_ns - self.anchor_ns) / 1e9

    def motion_offset(self, T_odom_base: SE2) -> SE2:
        """(Δx, Δy, Δθ): the current pose in the robot frame at the anchor."""
        return self.T_odom_anchor.inverse() @ T_odom_base

    def latency_input(self, now_ns: int, T_odom_base: SE2, trained_delay_s: float) -> LatencyInput:
        """Return the motion offset and Δt clamped to 0..`trained_delay_s`, the largest in the policy's training."""
        delay_s = min(max(self.delay_s(now_ns), 0.0), trained_delay_s)
        return LatencyInput(delay_s, self.motion_offset(T_odom_base))

    def latency_input_at_call(
        self, clock: Callable[[], int], T_odom_base: SE2, trained_delay_s: float
    ) -> tuple[LatencyInput, int, int]:
        """Return the input for a call that follows at once, the time of its Δt, and the time now, ns.

        A thread that lost the processor in between takes the time again.
        """
        for _ in range(CLOCK_READINGS):
            now_ns = clock()
            latency = self.latency_input(now_ns, T_odom_base, trained_delay_s)
            called_ns = clock()
            if called_ns - now_ns < PREEMPTED_NS:
                break
        return latency, now_ns, called_ns


def waypoints_now(waypoints: Waypoints, offset: SE2) -> npt.NDArray[np.float32]:
    """Transform waypoints (x m, y m) of the anchor's robot frame to [1, points, 2] in the current one (appendix C).

    `offset` is the robot's motion since the anchor. A policy guided by waypoints reads them instead of keys and values.
    """
    cos, sin = math.cos(offset.theta_rad), math.sin(offset.theta_rad)
    relative = [(x - offset.x_m, y - offset.y_m) for x, y in waypoints]
    points = [(cos * dx + sin * dy, cos * dy - sin * dx) for dx, dy in relative]
    return np.array([points], dtype=np.float32)


def leading_waypoints(semantic: SemanticState | None, offset: SE2) -> npt.NDArray[np.float32] | None:
    """Return the last text's waypoints [points, 2], m in the current robot frame; None where it plans to wait."""
    if semantic is None or semantic.waypoints is None or semantic.waits:
        return None
    points: npt.NDArray[np.float32] = waypoints_now(semantic.waypoints, offset)[0]
    return points


@dataclass(frozen=True, eq=False)
class ToldTurn:
    """A turn on the spot that an instruction begins with; no two are the same, also with equal angles."""

    turn_rad: float
    """Positive to the left."""


class SemanticSlot:
    """The slot of the reasoning thread's newest result; reading and replacing a field are single operations."""

    def __init__(self) -> None:
        self._told: ToldTurn | None = None  # written where instructions come from
        self._made: ToldTurn | None = None  # written by control alone: neither overwrites the other's turn
        self.state: SemanticState | None = None
        self.drive_until_ns: int | None = None
        """End of the time in which the robot may drive, ns; None: no such end."""

    @property
    def turn(self) -> ToldTurn | None:
        """The turn that control makes before reasoning goes on; None: there is none, or it has ended."""
        turn = self._told
        return None if turn is self._made else turn

    def tell(self, turn: ToldTurn | None) -> None:
        """Replace the turn; where one was under way, nothing from before it drives the robot."""
        if self.turn is not None:
            self.state = None
        self._told = turn

    def end(self, turn: ToldTurn) -> None:
        """End a turn; nothing from before its end drives the robot."""
        self.state = None
        self._made = turn


@dataclass(frozen=True)
class SharedState:
    """The data that the two loops exchange: encoded frames to reasoning, the semantic state to control."""

    ring: TokenRing
    slot: SemanticSlot
