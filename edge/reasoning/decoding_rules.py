"""Rules that constrain how a text is decoded, by earlier texts and by odometry (ours; the paper decodes freely).

Four rules, all off with `--decoding free`, the paper's greedy decoding:

* Progress: the number of turns stays, a turn is followed by itself or by the next one, and a turn is undone only when
  the model chooses so twice in a row.
* Turn distance: the planned turn is no further away than the median of the last observations of it, each less what the
  robot has driven since.
* Turn done: a turn to a side is done once odometry has seen the robot rotate to that side.
* Form: situation and plan follow the grammar.

A replaced token or line is fed to the model, so the rest of the text and the action expert follow it.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, replace
from statistics import median
from typing import Any, Final

from edge.core.geometry import SE2, wrap_angle
from edge.reasoning.line_constraint import Encode, FormConstraint, Line, LineConstraint, TextForms
from edge.state.reasoning_text import (
    AHEAD,
    LEFT,
    MAX_COUNT,
    PLAN_HEAD,
    PROGRESS_HEAD,
    RIGHT,
    Plan,
    Progress,
    Turn,
    format_plan,
    format_progress,
    parse_progress,
    parse_text,
)
from edge.state.ring import EncodedFrame

FREE: Final = "free"
"""Any progress: there is no earlier one, or the rules are off."""
ONWARD: Final = "onward"
"""The same progress, an opening more or less, or the next turn."""
EITHER_WAY: Final = "either way"
"""The previous turn as well: the model was refused once and may be right."""
FOLLOWS: Final = (FREE, ONWARD, EITHER_WAY)
BACK, DONE = "back", "done"
"""Kinds of refused progress: a turn undone; a turn done that the robot cannot have made."""

MAX_OBSERVATIONS: Final = 8
"""Observations of a turn that are kept beside the newest."""
SAME_HEADING_RAD: Final = 0.7
"""Observations made at a heading that differs by more than this, 40°, belong to another leg."""
OVERDUE_M: Final = 1.0
"""An observation is wrong once the robot has driven this far past the turn without turning."""
NOW_M: Final = 1.0
"""Turns nearer than this are written as "now", as in training."""
TURNED_RAD: Final = 0.44
"""Rotation to a side, 25°, from which a robot that still heads there may have made the turn; turns are of 90°."""
ONCE_TURNED_RAD: Final = 0.79
"""Rotation to a side, 45°, from which the robot has made the turn, whatever its present heading."""
EARLIER_NS: Final = 3_000_000_000
"""Longest time by which a turn may begin before the text names it as the next one."""
SETTLED_RAD: Final = 0.09
"""Yaw change below which a turn counts as finished, rad (5° in 1 s)."""
QUARTER_RAD: Final = math.pi / 2
SECOND_NS: Final = 1_000_000_000
MAX_REFUSALS: Final = 6
"""Number of claims in a row after which a turn counts as done."""


@dataclass(frozen=True)
class TurnObservation:
    """The next turn as one text gives it."""

    side: str
    """LEFT, RIGHT; AHEAD: an opening to go through without turning."""
    distance_m: float


@dataclass(frozen=True)
class TurnDistances:
    """Side of the next turn, LEFT or RIGHT, and its distance by each earlier observation, m."""

    side: str
    distances_m: tuple[float, ...]


def observed_turn(plan: Plan | None) -> TurnObservation | None:
    """Return the turn that a plan names; None for another plan."""
    if plan is None or not isinstance(plan.action, Turn):
        return None
    return TurnObservation(plan.action.side, float(plan.action.distance_m))


def limit_distance(plan: Plan, turn: TurnDistances) -> Plan:
    """Return the plan with its turn at the median of all observations where that is nearer, else the same plan."""
    action = plan.action
    if not isinstance(action, Turn) or action.side != turn.side:
        return plan
    distance_m = median((*turn.distances_m, float(action.distance_m)))
    nearer_m = round(distance_m) if distance_m >= NOW_M else 0
    return plan if nearer_m >= action.distance_m else replace(plan, action=replace(action, distance_m=nearer_m))


@dataclass(frozen=True)
class DecodingContext:
    """Inputs of the rules for one generation; the default constrains nothing."""

    before: Progress | None = None
    """The progress of the previous text."""
    follow: str = FREE
    """Which progress may follow it, one of FOLLOWS."""
    turn: TurnDistances | None = None
    turn_may_be_done: bool = True
    """Whether the robot can have made the next turn."""
    keeps_form: bool = False
    """Whether situation and plan follow the grammar."""

    def after(self, text: str, constraint: TextConstraint) -> DecodingContext:
        """Return the context after a text that this one constrained, but for the turn.

        A text without progress keeps the previous one. A refused turn back is allowed next time.
        """
        before = parse_progress(text) or self.before
        follow = EITHER_WAY if constraint.refused == BACK else ONWARD
        return DecodingContext() if before is None else DecodingContext(before, follow)

    def record(self) -> dict[str, Any]:
        """Return the flight log's fields, beside `before`."""
        side, distances_m = (None, None) if self.turn is None else (self.turn.side, self.turn.distances_m)
        return {"follow": self.follow, "turn": side, "turn_left_m": distances_m,
                "turn_may_be_done": self.turn_may_be_done, "keeps_form": self.keeps_form}  # fmt: skip


def allowed_progress(before: Progress, follow: str) -> tuple[Progress, ...]:
    """Return what may follow a progress, the likeliest first; () for FREE. Raises ValueError for another `follow`."""
    if follow not in FOLLOWS:
        raise ValueError(f"expected one of {', '.join(FOLLOWS)}, found {follow!r}")
    if follow == FREE:
        return ()
    step, steps = before.step, before.steps
    counts = [(step, before.passed)]
    if not before.is_last_leg:
        counts += [(step, before.passed + more) for more in (1, -1, 2)]
        counts += [(step + 1, 0), (step + 1, 1)]
    if follow == EITHER_WAY:
        counts += [(step - 1, passed) for passed in (0, 1, 2, 3)]
    return tuple(
        Progress(step, steps, passed)
        for step, passed in counts
        if step >= 1 and 0 <= passed <= (0 if step > steps else MAX_COUNT)
    )


class TextConstraint:
    """Constrains one text to a context: `choose` for every token, `replace_line` for every line."""

    def __init__(self, context: DecodingContext, encode: Encode, forms: TextForms | None = None) -> None:
        """`encode` returns the model's tokens of a text; `forms`: what a context that keeps the form needs.

        Raises ValueError if it has none.
        """
        if context.keeps_form and forms is None:
            raise ValueError("expected the forms of situation and plan for a context that keeps them")
        self._context = context
        self._form = FormConstraint(forms) if context.keeps_form and forms is not None else None
        self._encode = encode
        self._progress_line = self._constrain_progress()
        self._progress: Progress | None = None
        self.turn: TurnObservation | None = None
        """The turn of the plan before any line was replaced."""
        self.planned = ""
        """The plan's line that was replaced; empty when none was."""
        self.has_plan = False
        """Whether the text has reached the end of a plan that follows the grammar."""

    @property
    def overruled(self) -> bool:
        """Whether the model chose another progress."""
        return self._progress_line is not None and self._progress_line.overruled

    @property
    def refused(self) -> str | None:
        """Kind of the progress that was refused: BACK, DONE or None."""
        return None if self._progress_line is None else self._progress_line.refused

    def choose(self, token: int) -> int:
        """Return the token to take where the model chooses `token`."""
        token = token if self._progress_line is None else self._progress_line.choose(token)
        return token if self._form is None else self._form.choose(token)

    def forced(self) -> Line:
        """Return the next tokens that the context forces."""
        forced = () if self._progress_line is None else self._progress_line.forced()
        return forced if forced or self._form is None else self._form.forced()

    def replace_line(self, line: str) -> Line | None:
        """Return the tokens, line end included, that replace a complete line; None to keep it."""
        if line.startswith(PROGRESS_HEAD):
            self._progress = parse_progress(line)
        if not line.startswith(PLAN_HEAD):
            return None
        plan, turn = parse_text(line).plan, self._context.turn
        if self._form is not None and self._form.replaced:
            return None  # not the model's plan
        self.turn, self.has_plan = observed_turn(plan), True
        if plan is None or turn is None or self._progress != self._context.before:
            return None
        if (limited := limit_distance(plan, turn)) == plan:
            return None
        self.planned = line
        return tuple(self._encode(f"{PLAN_HEAD}{format_plan(limited)}.\n"))

    def _constrain_progress(self) -> LineConstraint | None:
        context, before = self._context, self._context.before
        if before is None or context.follow == FREE:
            return None
        kinds: dict[str, list[Line]] = {"": [], DONE: [], BACK: []}
        for progress in allowed_progress(before, EITHER_WAY):
            kind = DONE if progress.step > before.step else BACK if progress.step < before.step else ""
            kinds[kind].append(tuple(self._encode(f"{PROGRESS_HEAD}{format_progress(progress)}\n")))
        refused = {} if context.turn_may_be_done else {DONE: kinds.pop(DONE)}
        refused |= {} if context.follow == EITHER_WAY else {BACK: kinds.pop(BACK)}
        return LineConstraint([line for found in kinds.values() for line in found], refused)


class TurnEstimator:
    """Estimates the next turn: its distance from the last observations, and from headings whether it may be done.

    The model alone places a turn late, and the robot misses a turn that is named late. For one thread.
    """

    def __init__(self) -> None:
        self._observed: tuple[Progress, str] | None = None  # the turn of the kept observations
        self._observations: list[tuple[SE2, float]] = []
        self._headings: deque[tuple[int, float]] = deque(maxlen=600)  # a minute of the ring's poses
        self._rotation = _Rotation(None, 0)
        self._step: tuple[int, int] | None = None
        self._farthest_step = 0
        self._sides: deque[str] = deque(maxlen=MAX_OBSERVATIONS + 1)
        self._refusals = 0
        self._counts_as_done = False

    def put(self, stamp_ns: int, T_odom_base: SE2) -> None:
        """Take a pose; one that is not newer than the newest changes nothing."""
        if self._headings and stamp_ns <= self._headings[-1][0]:
            return
        last_rad = self._headings[-1][1] if self._headings else T_odom_base.theta_rad
        self._headings.append((stamp_ns, last_rad + wrap_angle(T_odom_base.theta_rad - last_rad)))
        self._rotation.put(*self._headings[-1])

    def distances(self, T_odom_base: SE2) -> TurnDistances | None:
        """Return the turn's distance from a pose by each observation that can still be right; None without any."""
        distances_m = tuple(
            left_m
            for pose, distance_m in self._observations
            if abs(wrap_angle(T_odom_base.theta_rad - pose.theta_rad)) <= SAME_HEADING_RAD
            and (left_m := distance_m - _driven_m(pose, T_odom_base)) >= -OVERDUE_M
        )
        return TurnDistances(self._observed[1], distances_m) if self._observed is not None and distances_m else None

    @property
    def may_be_done(self) -> bool:
        """Whether the robot can have made the next turn: it has rotated to the turn's side.

        True as well for a turn made before, and for one claimed MAX_REFUSALS times in a row.
        """
        if self._counts_as_done or (self._step is not None and self._step[0] < self._farthest_step):
            return True
        return (side := self._side()) is None or self._rotation.reached(side)

    def update(
        self, progress: Progress | None, turn: TurnObservation | None, anchor: EncodedFrame, *, overruled: bool,
        claimed: bool,
    ) -> None:  # fmt: skip
        """Take the turn of a text about the frame `anchor`; a text without a turn ends the observations.

        `overruled`: the model chose another progress, or the text was cut short, so its plan is unknown; `claimed`: it
        named a turn as done that cannot be.
        """
        self._refusals = self._refusals + 1 if claimed else 0
        self._counts_as_done = self._counts_as_done or self._refusals >= MAX_REFUSALS
        if progress is not None and (step := (progress.step, progress.steps)) != self._step:
            self._begin_step(step, anchor.stamp_ns)
        if progress is not None and self._observed is not None and progress != self._observed[0]:
            self._observed, self._observations = None, []
        if overruled:
            return
        observed = (progress, turn.side) if progress and turn and turn.side != AHEAD else None
        if observed is None or observed != self._observed:
            self._observed, self._observations = observed, []
        if observed and turn:
            self._observations = [*self._observations[1 - MAX_OBSERVATIONS :], (anchor.T_odom_base, turn.distance_m)]
        if turn is not None:
            self._sides.append(turn.side)

    def _begin_step(self, step: tuple[int, int], anchor_ns: int) -> None:
        """Measure rotation anew for another turn."""
        onward = self._step is not None and step[0] > self._step[0]
        settling, from_ns = self._rotation.made(self._side()) if onward else (None, None)
        self._rotation = _Rotation(settling, anchor_ns if from_ns is None else min(from_ns, anchor_ns))
        for stamp_ns, heading_rad in self._headings:
            if stamp_ns >= anchor_ns - EARLIER_NS:
                self._rotation.put(stamp_ns, heading_rad)
        self._step, self._farthest_step = step, max(step[0], self._farthest_step)
        self._sides.clear()
        self._refusals, self._counts_as_done = 0, False

    def _side(self) -> str | None:
        """The side most often named for this turn; None without a majority."""
        found = Counter(self._sides).most_common(2)
        if not found or found[0][0] == AHEAD or (len(found) > 1 and found[0][1] == found[1][1]):
            return None
        return found[0][0]


class _Rotation:
    """Largest rotation to each side since some instant."""

    def __init__(self, settling: str | None, from_ns: int) -> None:
        """`settling`: side of the previous turn, which the robot may still be making from `from_ns` on."""
        self._settling, self._from_ns = settling, from_ns
        self._recent: deque[tuple[int, float]] = deque()
        self._first_rad = {LEFT: math.inf, RIGHT: math.inf}
        self._start_rad = {LEFT: math.inf, RIGHT: math.inf}
        self._now_rad = {LEFT: 0.0, RIGHT: 0.0}
        self._most_rad = {LEFT: 0.0, RIGHT: 0.0}
        self._made_ns: dict[str, int] = {}

    def put(self, stamp_ns: int, heading_rad: float) -> None:
        """Take a heading that is unwrapped beyond half a revolution."""
        self._recent.append((stamp_ns, heading_rad))
        while len(self._recent) > 1 and self._recent[1][0] <= stamp_ns - SECOND_NS:
            self._recent.popleft()
        then_ns, then_rad = self._recent[0]
        if self._from_ns <= then_ns <= stamp_ns - SECOND_NS and abs(heading_rad - then_rad) < SETTLED_RAD:
            self._settling = None
        for side, aside_rad in ((LEFT, heading_rad), (RIGHT, -heading_rad)):
            if self._first_rad[side] == math.inf and stamp_ns >= self._from_ns:
                self._first_rad[side] = aside_rad
            # During the previous turn, this one begins at the present heading, but no later than after 90° of that
            # turn: a robot that turns round a rack makes two without a pause.
            begun_rad = self._first_rad[side] + QUARTER_RAD if side == self._settling else self._start_rad[side]
            start_rad = min(begun_rad, aside_rad)
            self._start_rad[side], self._now_rad[side] = start_rad, aside_rad - start_rad
            self._most_rad[side] = max(self._most_rad[side], aside_rad - start_rad)
            if self._most_rad[side] >= ONCE_TURNED_RAD:
                self._made_ns.setdefault(side, stamp_ns)

    def made(self, named: str | None) -> tuple[str | None, int | None]:
        """Return (side, ns; None: it may go on) of the made turn: the named one, unless only the other was seen."""
        only_other = len(self._made_ns) == 1 and named not in self._made_ns
        side = next(iter(self._made_ns)) if only_other else named
        return side, None if side is None else self._made_ns.get(side)

    def reached(self, side: str) -> bool:
        """Whether the robot has rotated far enough to a side."""
        return self._now_rad[side] >= TURNED_RAD or self._most_rad[side] >= ONCE_TURNED_RAD


def _driven_m(T_odom_then: SE2, T_odom_now: SE2) -> float:
    """Distance driven between two poses, m; negative backwards."""
    moved = T_odom_then.inverse() @ T_odom_now
    return math.copysign(math.hypot(moved.x_m, moved.y_m), moved.x_m)
