"""Limits of reasoning by heat and battery, apart from the power budget; pure."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class LimitsConfig:
    """Thresholds: choices of ours, none is a property of a board."""

    throttle_clear_c: float = 3.0
    """Degrees below the passive trip at which throttling is over."""
    trip_margin_c: float = 3.0
    """Degrees below the critical trip at which the board counts as about to switch off."""
    trip_clear_c: float = 8.0
    clear_s: float = 10.0
    """Time for which the board must have been cool, s."""
    worsen_s: float = 20.0
    """Duration of heat after which the next step is taken, s."""
    low_percent: float = 20.0
    empty_percent: float = 10.0
    battery_clear_percent: float = 2.0
    low_budget: float = 0.8
    """Share of the budget at a low battery."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be positive, found {value}")
        if self.empty_percent >= self.low_percent or self.low_budget > 1:
            raise ValueError("empty_percent must be below low_percent, low_budget at most 1")


class HeatAndBattery:
    """Keeps heat and battery states until they end; a missing value changes nothing."""

    def __init__(self, config: LimitsConfig, steps: int) -> None:
        """`steps`: number of shedding steps; the last is reasoning off."""
        self._config = config
        self._last_step = steps
        self._hot_ns: int | None = None
        self._cool_ns: int | None = None
        self._tripped = False
        self._low = False
        self._empty = False

    @property
    def findings(self) -> tuple[str, ...]:
        """Names of the active faults."""
        found = (
            ("thermal-trip", self._tripped),
            ("thermal-throttle", self._hot_ns is not None),
            ("battery-empty", self._empty),
            ("battery-low", self._low),
        )
        return tuple(name for name, there in found if there)

    @property
    def budget_share(self) -> float:
        """Return the share of the budget that the battery leaves."""
        return self._config.low_budget if self._low else 1.0

    def update(
        self,
        now_ns: int,
        *,
        throttled: bool,
        throttle_margin_c: float | None,
        trip_margin_c: float | None,
        battery_percent: float | None,
    ) -> int:
        """Return the smallest shedding step that heat and battery require: 0 none, the last one reasoning off."""
        config = self._config
        if trip_margin_c is not None and math.isfinite(trip_margin_c):
            limit_c = config.trip_clear_c if self._tripped else config.trip_margin_c
            self._tripped = trip_margin_c <= limit_c
        self._update_throttle(now_ns, throttled, throttle_margin_c)
        if battery_percent is not None and 0 <= battery_percent <= 100:
            self._low = battery_percent <= config.low_percent + config.battery_clear_percent * self._low
            self._empty = battery_percent <= config.empty_percent + config.battery_clear_percent * self._empty
        step = 0
        if self._low:
            step = self._last_step // 2
        if self._hot_ns is not None:
            lasted = math.floor((now_ns - self._hot_ns) / (config.worsen_s * 1e9))
            step = max(step, self._last_step // 2 + lasted)
        if self._tripped or self._empty:
            step = self._last_step
        return min(step, self._last_step)

    def _update_throttle(self, now_ns: int, throttled: bool, margin_c: float | None) -> None:
        margin_c = margin_c if margin_c is not None and math.isfinite(margin_c) else None
        if throttled or (margin_c is not None and margin_c <= 0):
            self._hot_ns = now_ns if self._hot_ns is None else self._hot_ns
            self._cool_ns = None
        elif self._hot_ns is not None and (margin_c is None or margin_c >= self._config.throttle_clear_c):
            self._cool_ns = now_ns if self._cool_ns is None else self._cool_ns
            if now_ns - self._cool_ns >= self._config.clear_s * 1e9:
                self._hot_ns = self._cool_ns = None
        else:
            self._cool_ns = None
