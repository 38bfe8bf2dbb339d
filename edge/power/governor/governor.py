"""Keeps the moving average of power under a budget by shedding reasoning; control is never slowed.

Steps of shedding: a pause between two generations, while the semantic state stays young enough; then fewer new tokens
(half, a quarter, none: the prompt alone still gives a semantic state); then no reasoning at all.

The pause is computed, because feedback alone would oscillate with the generations. The governor learns the power with
and without reasoning and the duration of a generation. It gives the shortest pause that keeps every window of 10 s
below the budget, both in the steady cycle and after the recent draw. An integral of the remaining excess corrects the
budget that it aims at. Pure: no clock, no thread, no I/O.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from edge.power.governor.average import PowerHistory
from edge.power.governor.levels import GenerationTimes, LevelEstimator, Levels, pause_for
from edge.power.governor.limits import HeatAndBattery, LimitsConfig
from edge.power.governor.plan import PowerModel
from edge.power.meters.meter import is_power
from edge.reasoning.generation_cycle import UNLIMITED, ReasoningBudget

LEVELS: Final = ("full", "half", "quarter", "prompt", "off")
"""Names of the steps; each but the last includes the pause."""
OFF: Final = len(LEVELS) - 1
_SHARES: Final = (1.0, 0.5, 0.25, 0.0)
_WORSE_S: Final = 3.0
"""Time with a too long pause after which the governor takes the next step."""
_BETTER_S: Final = 15.0
"""Time with a sufficient shorter pause after which the governor takes a step back."""
_BETTER_SHARE: Final = 0.7
"""Largest share of the longest pause at which it takes a step back, to prevent oscillation."""
_OFF_MARGIN: Final = 0.97
_LOST_S: Final = 1.0
_TRIM_PER_S: Final = 0.05
_TRIM_MOST: Final = 0.05
_TRIM_FORGET_S: Final = 120.0
_LONGEST_PAUSE_S: Final = 60.0
_COARSE_S, _FINE_S = 0.5, 0.1


@dataclass(frozen=True)
class GovernorConfig:
    """The budget, and the values from before the first measurement."""

    budget_w: float | None
    """None: only heat and battery limit reasoning."""
    max_new_tokens: int
    max_delay_s: float = math.inf
    """Largest age of a semantic state, s; pauses that would exceed it become token caps."""
    model: PowerModel | None = None
    window_s: float = 10.0
    limits: LimitsConfig = field(default_factory=LimitsConfig)

    def __post_init__(self) -> None:
        if self.budget_w is not None and not (math.isfinite(self.budget_w) and self.budget_w > 0):
            raise ValueError(f"budget_w must be positive, found {self.budget_w}")
        if self.max_new_tokens < 0 or not (self.max_delay_s > 0 and 0 < self.window_s <= 600):
            raise ValueError("max_new_tokens must be 0 or more, max_delay_s positive, window_s 0 to 600 s")


@dataclass(frozen=True)
class GovernorInputs:
    """Inputs of one step; None for an unknown value."""

    power_w: float | None
    """The meter's newest reading; None without a fresh one."""
    reasoning: bool
    """A generation is under way."""
    reasoning_s: float
    """Total time of generations so far, s; it only grows."""
    generations: int
    """Generations finished so far."""
    throttled: bool = False
    throttle_margin_c: float | None = None
    trip_margin_c: float | None = None
    battery_percent: float | None = None
    abandoned: int = 0
    """Generations begun and not finished so far; `reasoning_s` includes their time."""


@dataclass(frozen=True)
class GovernorOutputs:
    """The budget of reasoning, and the state for the operator."""

    budget: ReasoningBudget = UNLIMITED
    average_w: float | None = None
    """Moving average over the window, metered or modelled."""
    budget_w: float | None = None
    """The present budget, W; a low battery lowers it."""
    level: str = LEVELS[0]
    metered: bool = False
    """False: the meter gives no sample and the model replaces it."""
    over_budget: bool = False
    """Whether reasoning is off and the remaining power alone exceeds the budget."""
    findings: tuple[str, ...] = ()
    """Names of the fault table."""
    message: str | None = None
    """One line for the operator when something has changed."""


class Governor:
    """The governor (see the module); one thread calls it, and `now_ns` must not decrease."""

    def __init__(self, config: GovernorConfig) -> None:
        self._config = config
        model = config.model
        start = (
            None if model is None else Levels(model.idle_w + model.control_w, model.reasoning_w(config.max_new_tokens))
        )
        self._estimate = LevelEstimator(start)
        self._times = GenerationTimes(OFF)
        self._history = PowerHistory(config.window_s)
        self._shares = PowerHistory(config.window_s)
        self._limits = HeatAndBattery(config.limits, OFF)
        self._level = 0
        self._applied = 0
        self._cap = 0
        self._worse_ns: int | None = None
        self._better_ns: int | None = None
        self._trim_w = 0.0
        self._last: tuple[int, GovernorInputs] | None = None
        self._ended_ns: int | None = None
        self._metered_ns: int | None = None
        self._reported: tuple[int, bool, bool, tuple[str, ...]] = (0, True, False, ())

    def step(self, inputs: GovernorInputs, now_ns: int) -> GovernorOutputs:
        """Run one step, about ten times a second; any rate and any gap is allowed."""
        config = self._config
        self._learn(inputs, now_ns)
        metered = self._metered_ns is not None and now_ns - self._metered_ns <= _LOST_S * 1e9
        average_w = self._history.average_w(now_ns, config.window_s)
        least = self._limits.update(
            now_ns,
            throttled=inputs.throttled,
            throttle_margin_c=inputs.throttle_margin_c,
            trip_margin_c=inputs.trip_margin_c,
            battery_percent=inputs.battery_percent,
        )
        budget_w = None if config.budget_w is None else config.budget_w * self._limits.budget_share
        levels = self._estimate.levels
        pause_s = 0.0
        if budget_w is not None and levels is not None:
            aim_w = self._aim(budget_w, average_w, now_ns)
            self._choose_level(levels, aim_w, now_ns)
            if self._level < OFF:
                pause_s = max(
                    self._steady_pause(levels, aim_w, self._level),
                    self._pause_after_now(levels, aim_w, inputs, now_ns),
                )
        else:
            self._level = 0
        level = self._applied = max(self._level, least)
        if least and level < OFF:
            pause_s = max(pause_s, self._generation_s(level) or 0.0)
        over = level == OFF and budget_w is not None and average_w is not None and average_w > budget_w * 1.02
        self._last = (now_ns, inputs)
        return GovernorOutputs(
            budget=self._budget(level, pause_s),
            average_w=average_w,
            budget_w=budget_w,
            level=LEVELS[level],
            metered=metered,
            over_budget=over,
            findings=self._limits.findings,
            message=self._message(level, metered, over, average_w, budget_w),
        )

    def _learn(self, inputs: GovernorInputs, now_ns: int) -> None:
        """Append the sample, or its modelled value, to the history; learn levels and durations."""
        share, dt_s = float(inputs.reasoning), 0.0
        if self._metered_ns is None:
            self._metered_ns = now_ns  # a meter that has just been opened may take its time
        if self._last is not None:
            last_ns, last = self._last
            dt_s = max(0.0, (now_ns - last_ns) / 1e9)
            if dt_s > 0:
                share = min(1.0, max(0.0, (inputs.reasoning_s - last.reasoning_s) / dt_s))
            ended = last.reasoning and not inputs.reasoning
            # One that began and ended between two steps, or was followed by the next at once.
            missed = inputs.generations > last.generations and inputs.reasoning_s > last.reasoning_s
            if ended or missed:
                self._ended_ns = now_ns
            self._shares.add(last_ns, share)
        self._times.update(inputs.generations, inputs.reasoning_s, self._cap, inputs.abandoned)
        if not inputs.reasoning:
            self._cap = self._applied  # what the next generation starts with
        power_w = inputs.power_w
        if power_w is not None and is_power(power_w):
            self._metered_ns = now_ns
            self._estimate.add(power_w, share, min(dt_s, 1.0))
            self._history.add(now_ns, power_w)
        elif (levels := self._estimate.levels) is not None:
            self._history.add(now_ns, levels.at(share))

    def _aim(self, budget_w: float, average_w: float | None, now_ns: int) -> float:
        """Return the budget less the integral of the excess so far, W."""
        dt_s = 0.0 if self._last is None else min(1.0, (now_ns - self._last[0]) / 1e9)
        over_w = 0.0 if average_w is None else max(0.0, average_w - budget_w)
        self._trim_w += (over_w * _TRIM_PER_S - self._trim_w / _TRIM_FORGET_S) * dt_s
        self._trim_w = min(max(self._trim_w, 0.0), _TRIM_MOST * budget_w)
        return budget_w - self._trim_w

    def _generation_s(self, level: int) -> float | None:
        """Return a generation's duration at a level, s: measured, scaled from another, or planned; else None."""
        cap, model = min(level, OFF - 1), self._config.model
        measured = self._times.nearest(cap)
        if measured is None:
            return None if model is None else model.generation_s(self._tokens(cap))
        if model is None:
            # Without a plan the share of decoding in a generation is unknown: half of a full one.
            return measured[1] * (1 + _SHARES[cap]) / (1 + _SHARES[measured[0]])
        return measured[1] * model.generation_s(self._tokens(cap)) / model.generation_s(self._tokens(measured[0]))

    def _tokens(self, level: int) -> int:
        return round(self._config.max_new_tokens * _SHARES[min(level, OFF - 1)])

    def _steady_pause(self, levels: Levels, aim_w: float, level: int) -> float:
        """Return the pause of a steady cycle of generations whose worst window meets the aim, s."""
        generation_s = self._generation_s(level)
        if levels.at(1.0) <= aim_w:
            return 0.0
        if levels.base_w >= aim_w:
            return math.inf
        if generation_s is None:
            return 0.0
        return pause_for((aim_w - levels.base_w) / levels.rise_w, generation_s, self._config.window_s)

    def _pause_after_now(self, levels: Levels, aim_w: float, inputs: GovernorInputs, now_ns: int) -> float:
        """Return the pause after the last generation with which the next one meets the aim, s."""
        longest, mean_s = self._times.longest_s(min(self._level, OFF - 1)), self._generation_s(self._level)
        if levels.at(1.0) <= aim_w or mean_s is None:
            return 0.0
        generation_s = max(longest or 0.0, mean_s)
        metered_j, busy_s = self._history.energy_since(now_ns), self._shares.energy_since(now_ns)
        window_s = self._config.window_s
        ended_ns = now_ns if inputs.reasoning or self._ended_ns is None else self._ended_ns

        def fits(wait_s: float) -> bool:
            end_ns = now_ns + round((wait_s + generation_s) * 1e9)
            rest_s = min(wait_s, max(0.0, window_s - generation_s))
            since_ns = min(now_ns, end_ns - round(window_s * 1e9))
            # Whichever is more: a meter that averages shows the end of a generation late.
            known_j = levels.base_w * (now_ns - since_ns) / 1e9 + levels.rise_w * busy_s(since_ns)
            spent_j = max(metered_j(since_ns), known_j)
            busy_j = levels.at(1.0) * min(generation_s, window_s)
            return spent_j + levels.base_w * rest_s + busy_j <= aim_w * window_s

        wait_s = _first(fits, window_s)
        return (now_ns - ended_ns) / 1e9 + wait_s if wait_s > 0 else 0.0

    def _longest_pause(self, level: int) -> float:
        """Return the pause at the age limit of the state, s: Δt is at most two generations and a pause."""
        if level >= OFF - 1 or not math.isfinite(self._config.max_delay_s):
            return _LONGEST_PAUSE_S
        return max(0.0, self._config.max_delay_s - 2 * (self._generation_s(level) or 0.0))

    def _choose_level(self, levels: Levels, aim_w: float, now_ns: int) -> None:
        pause_s = math.inf if self._level == OFF else self._steady_pause(levels, aim_w, self._level)
        if self._level < OFF and pause_s > self._longest_pause(self._level):
            self._better_ns = None
            self._worse_ns = now_ns if self._worse_ns is None else self._worse_ns
            if now_ns - self._worse_ns >= _WORSE_S * 1e9:
                self._change_level(1)
            return
        self._worse_ns = None
        if self._level == 0 or not self._would_do(levels, aim_w, self._level - 1):
            self._better_ns = None
            return
        self._better_ns = now_ns if self._better_ns is None else self._better_ns
        if now_ns - self._better_ns >= _BETTER_S * 1e9:
            self._change_level(-1)

    def _would_do(self, levels: Levels, aim_w: float, level: int) -> bool:
        margin = _OFF_MARGIN if level == OFF - 1 else 1.0
        return self._steady_pause(levels, aim_w * margin, level) <= _BETTER_SHARE * self._longest_pause(level)

    def _change_level(self, by: int) -> None:
        self._level += by
        self._worse_ns = self._better_ns = None

    def _budget(self, level: int, pause_s: float) -> ReasoningBudget:
        if level == OFF:
            return ReasoningBudget(allowed=False)
        cap = None if level == 0 else self._tokens(level)
        return ReasoningBudget(pause_s=min(max(pause_s, 0.0), _LONGEST_PAUSE_S), max_new_tokens=cap)

    def _message(
        self, level: int, metered: bool, over: bool, average_w: float | None, budget_w: float | None
    ) -> str | None:
        state = (level, metered, over, self._limits.findings)
        if state == self._reported:
            return None
        before, self._reported = self._reported, state
        parts: list[str] = []
        if state[0] != before[0]:
            parts.append(f"reasoning: {_DESCRIPTIONS[level]}")
        if state[1] != before[1]:
            parts.append("power is metered" if metered else "no power reading: the budget is held by the model")
        if over:
            parts.append("above the budget without any reasoning: lower the clocks or raise the budget")
        parts += [name for name in state[3] if name not in before[3]]
        if average_w is not None and budget_w is not None:
            parts.append(f"{average_w:.1f} W of {budget_w:.1f} W")
        return "; ".join(parts) or None


def _first(fits: Callable[[float], bool], most_s: float) -> float:
    """Return the shortest wait that meets the aim, to 0.1 s; `most_s` if none does."""
    wait_s = 0.0
    while wait_s < most_s and not fits(wait_s):
        wait_s += _COARSE_S
    while wait_s > 0 and wait_s <= most_s and fits(wait_s - _FINE_S):
        wait_s -= _FINE_S
    return min(max(wait_s, 0.0), most_s)


_DESCRIPTIONS: Final = (
    "as planned",
    "half of the tokens",
    "a quarter of the tokens",
    "prompt only, no new tokens",
    "off",
)
