"""Decides when a generation starts, when its result becomes the semantic state, and when reasoning ends for good.

Paper, Algorithms 3 and 4 and appendix D. Pure: no thread, no clock, no model. Two shells run this cycle:
`edge.run.reasoning_loop` in real time on the robot, `VirtualTimeReasoner` in the benchmark's virtual time.

    IDLE --START--> RUNNING --Finished--> HELD --its release time--> PUBLISH or DISCARD --> IDLE
                    RUNNING --Failed, FrameMissed or Cancelled--> IDLE
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final

from edge.core.geometry import SE2
from edge.state.switches import Decoding

SYNC_DRIVE_S = 0.5
"""Time for which the robot drives after each generation in sync mode (paper, appendix D), s."""
RETRY_S = 0.5
"""Pause after a failed generation, s."""
FAILURES = 5
FAILURE_WINDOW_S = 60.0
"""Fault matrix row 18: `FAILURES` failed generations within this time end reasoning until the next start, s."""
STANDS_MPS = 0.1
STANDS_RADPS = 0.2
"""Speeds below which a robot stands. A simulated Go2 that steps on the spot stays within 2 cm."""
SETTLE_S = 1.0
"""Time after the halt from which the robot counts as standing, s. In simulation a Go2 needed 0.4 to 0.6 s."""


@dataclass(frozen=True)
class ReasoningBudget:
    """Limits of reasoning from the next generation on; they never concern control."""

    allowed: bool = True
    """False: no generation is started, and one under way is cancelled."""
    pause_s: float = 0.0
    """Rest between two generations."""
    max_new_tokens: int | None = None
    """Token cap below the artifacts' own; None: no further cap."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.pause_s) and self.pause_s >= 0):
            raise ValueError(f"pause_s must be 0 or more, found {self.pause_s}")
        if self.max_new_tokens is not None and self.max_new_tokens < 0:
            raise ValueError(f"max_new_tokens must be 0 or more, found {self.max_new_tokens}")


UNLIMITED: Final = ReasoningBudget()


class Mode(Enum):
    """How reasoning and driving take turns (paper, Algorithms 3 and 4, appendix D)."""

    ASYNC = "async"
    """Both at once."""
    SYNC = "sync"
    """The robot halts during each generation, then drives for 0.5 s."""
    NO_REASONING = "no-reasoning"
    """Prefill only: a semantic state without a text."""


@dataclass(frozen=True)
class ReasoningConfig:
    """Configuration of a generation: frame ages, text length, mode and decoding."""

    frame_offsets_s: tuple[float, ...]
    """Ages of the frames relative to the newest one, s; 0 is the newest."""
    max_new_tokens: int
    """Longest text that the artifacts allow, tokens."""
    mode: Mode = Mode.ASYNC
    decoding: Decoding = Decoding.CONSTRAINED
    turns_as_told: bool = True
    """Whether control makes the turn on the spot that an instruction begins with; otherwise the model reads it."""

    def __post_init__(self) -> None:
        if not all(math.isfinite(offset_s) and offset_s >= 0 for offset_s in self.frame_offsets_s):
            raise ValueError(f"frame_offsets_s must be 0 or more, found {self.frame_offsets_s}")
        if self.max_new_tokens < 0:
            raise ValueError(f"max_new_tokens must be 0 or more, found {self.max_new_tokens}")

    @property
    def older_offsets_s(self) -> tuple[float, ...]:
        """Ages of the frames before the newest, s, oldest first."""
        return tuple(sorted({offset_s for offset_s in self.frame_offsets_s if offset_s > 0}, reverse=True))

    @property
    def token_limit(self) -> int:
        """Longest text in this mode, tokens."""
        return 0 if self.mode is Mode.NO_REASONING else self.max_new_tokens


@dataclass(frozen=True)
class Anchored:
    """The generation under way has its newest frame: the next generation needs a newer one."""

    stamp_ns: int


@dataclass(frozen=True)
class FrameMissed:
    """The generation under way was abandoned: there is no frame at the planned instant."""

    newest_ns: int | None = None
    """The next generation needs a frame newer than this, ns; None: any frame."""


@dataclass(frozen=True)
class Cancelled:
    """The generation under way was interrupted."""


@dataclass(frozen=True)
class Failed:
    """The generation under way has failed."""

    reason: str


@dataclass(frozen=True)
class Finished:
    """The generation under way has a result, which may become the semantic state at `release_ns`."""

    release_ns: int
    new_tokens: int
    has_waypoints: bool
    needs_waypoints: bool
    """The policy is guided by waypoints alone, so it cannot use a text without waypoints."""


Event = Anchored | FrameMissed | Cancelled | Failed | Finished


@dataclass(frozen=True)
class CycleInputs:
    """Inputs of the cycle at one instant."""

    frames: Sequence[tuple[int, SE2]] = ()
    """Capture stamps, ns, and poses `T_odom_base` of the newest two frames, oldest first; read while idle only."""
    request: int = 0
    """Number of the newest request; an increase replaces the generation under way."""
    budget: ReasoningBudget = UNLIMITED
    stopping: bool = False
    """The run ends: start nothing, and do not count the interrupted generation."""
    event: Event | None = None
    """Report of the generation under way."""


class Action(Enum):
    """The shell's next action."""

    WAIT = "wait"
    """Nothing to do."""
    START = "start"
    """Start a generation with the newest frames and at most `max_new_tokens` tokens."""
    CONTINUE = "continue"
    """Continue the generation under way."""
    INTERRUPT = "interrupt"
    """End the generation under way, then report `Cancelled`."""
    HOLD = "hold"
    """Hold the finished result until its release time."""
    PUBLISH = "publish"
    """Make the result the semantic state."""
    DISCARD = "discard"
    """Drop the result: a newer request has replaced it, or the policy cannot use it."""


@dataclass(frozen=True)
class CycleOutputs:
    """The shell's next action and its limits."""

    action: Action
    max_new_tokens: int
    """Token limit of the current generation."""
    text_complete: bool
    """False: the mode or the budget may have cut the text short."""
    drive_until_ns: int | None
    """End of the time in which the robot may drive, ns; None: no such end."""


class _Phase(Enum):
    IDLE = "idle"
    RUNNING = "running"
    HELD = "held"


def seen_standing(frames: Sequence[tuple[int, SE2]], halted_ns: int | None) -> bool:
    """Return whether a generation may begin with the newest of these frames: the robot must stand.

    A halted robot still coasts, so its frame differs from the one where it will start to drive (paper, appendix D).

    `frames`: stamp, ns, and pose `T_odom_base` of the newest ones, oldest first; `halted_ns`: instant of the halt
    command, None in a mode that keeps driving. The speed is the mean between the newest two.
    """
    if not frames:
        return False
    if halted_ns is None:
        return True
    stamp_ns, T_odom_base = frames[-1]
    if stamp_ns < halted_ns:
        return False  # no frame since the halt
    if stamp_ns - halted_ns >= SETTLE_S * 1e9:
        return True
    if len(frames) < 2:
        return False
    before_ns, T_odom_before = frames[-2]
    moved, seconds = T_odom_before.inverse() @ T_odom_base, (stamp_ns - before_ns) / 1e9
    return math.hypot(moved.x_m, moved.y_m) < STANDS_MPS * seconds and abs(moved.theta_rad) < STANDS_RADPS * seconds


class GenerationCycle:
    """State machine of one generation at a time. One thread calls `step`; any thread may read the counts."""

    def __init__(self, config: ReasoningConfig) -> None:
        self._token_limit = config.token_limit
        self._phase = _Phase.IDLE
        self._result: Finished | None = None
        self._request = 0
        self._token_cap = self._token_limit
        self._anchor_ns = -1
        self._finished_ns: int | None = None
        self._retry_ns = 0
        self._failures: deque[int] = deque(maxlen=FAILURES)
        self.drive_until_ns: int | None = 0 if config.mode is Mode.SYNC else None
        """End of the time in which the robot may drive, ns; None: no such end."""
        self.failure: str | None = None
        """Why reasoning has ended until the next start (latched); None while it continues."""
        self.published = 0
        self.failed = 0
        self.cancelled = 0
        self.missed_frames = 0
        """Generations abandoned because there was no frame at the planned instant."""
        self.invalid_texts = 0
        """Complete texts that do not follow the grammar; a text that was cut short is not counted."""
        self.invalid_in_a_row = 0
        """The same, counted since the last valid text."""

    def pause(self) -> None:
        """Wait for a turn on the spot: the texts from before it hold no robot that is to turn."""
        self.invalid_in_a_row = 0

    def step(self, inputs: CycleInputs, now_ns: int) -> CycleOutputs:
        """Take the inputs and return the next action; pure apart from this object's own state."""
        if inputs.event is not None and self._phase is _Phase.RUNNING:
            self._take(inputs.event, inputs.stopping, now_ns)
        action = self._next(inputs, now_ns)
        return CycleOutputs(
            action, min(self._token_limit, self._token_cap), self._result_is_complete(), self.drive_until_ns
        )

    def _take(self, event: Event, stopping: bool, now_ns: int) -> None:
        if isinstance(event, Anchored):
            self._anchor_ns = event.stamp_ns
            return
        if isinstance(event, Finished):
            self._phase, self._result, self._finished_ns = _Phase.HELD, event, now_ns
            return
        self._phase = _Phase.IDLE
        if isinstance(event, FrameMissed):
            self.missed_frames += 1
            if event.newest_ns is not None:
                self._anchor_ns = event.newest_ns
        elif isinstance(event, Cancelled):
            self.cancelled += not stopping
        else:
            self._fail(event.reason, now_ns)

    def _next(self, inputs: CycleInputs, now_ns: int) -> Action:
        replaced = inputs.stopping or inputs.request != self._request
        if self._phase is _Phase.RUNNING:
            return Action.INTERRUPT if replaced or not inputs.budget.allowed else Action.CONTINUE
        if self._phase is _Phase.HELD:
            assert self._result is not None
            if replaced:
                self._phase = _Phase.IDLE
                self.cancelled += not inputs.stopping
                return Action.DISCARD
            if now_ns < self._result.release_ns:
                return Action.HOLD
            return self._release(self._result, now_ns)
        if not self._may_start(inputs, now_ns):
            return Action.WAIT
        cap = inputs.budget.max_new_tokens
        self._phase, self._request, self._result = _Phase.RUNNING, inputs.request, None
        self._token_cap = self._token_limit if cap is None else cap
        return Action.START

    def _may_start(self, inputs: CycleInputs, now_ns: int) -> bool:
        """Return whether every pause is over and there is a frame that no generation has used."""
        if self.failure is not None or inputs.stopping or not inputs.budget.allowed or now_ns < self._retry_ns:
            return False
        if not inputs.frames or inputs.frames[-1][0] <= self._anchor_ns:
            return False
        if not seen_standing(inputs.frames, self.drive_until_ns):
            return False
        return self._finished_ns is None or now_ns - self._finished_ns >= inputs.budget.pause_s * 1e9

    def _release(self, result: Finished, now_ns: int) -> Action:
        self._phase = _Phase.IDLE
        if self._result_is_complete():
            self.invalid_in_a_row = 0 if result.has_waypoints else self.invalid_in_a_row + 1
            self.invalid_texts += not result.has_waypoints
        if result.needs_waypoints and not result.has_waypoints:
            return Action.DISCARD  # the semantic state ages, and the supervisor slows the robot down by its age
        self.published += 1
        if self.drive_until_ns is not None:
            self.drive_until_ns = now_ns + round(SYNC_DRIVE_S * 1e9)
        return Action.PUBLISH

    def _result_is_complete(self) -> bool:
        if self._result is None or self._token_limit == 0:
            return False
        return self._token_cap >= self._token_limit or self._result.new_tokens < self._token_cap

    def _fail(self, reason: str, now_ns: int) -> None:
        self.failed += 1
        self._retry_ns = now_ns + round(RETRY_S * 1e9)
        self._failures.append(now_ns)
        if len(self._failures) == FAILURES and now_ns - self._failures[0] <= FAILURE_WINDOW_S * 1e9:
            self.failure = f"{FAILURES} generations failed within {FAILURE_WINDOW_S:g} s, the last one: {reason}"
