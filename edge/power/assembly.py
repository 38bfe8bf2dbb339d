"""A run's power monitor from what the artifacts say: meter, budget, model; and what to do where there is no meter."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from edge.findings import Finding
from edge.power.battery import ReadBattery
from edge.power.governor import Governor, GovernorConfig
from edge.power.meter import MeterError, PowerMeter
from edge.power.modelled import ModelledMeter
from edge.power.monitor import Activity, PowerMonitor
from edge.power.overcurrent import OverCurrentEvents
from edge.power.plan import PowerModel, PowerPlan
from edge.power.select import open_meter
from edge.power.sysfs import SYSFS
from edge.power.thermal import ThermalReader


class RunEnergy:
    """Modelled energy above idle of a run, in J, from its ticks and from the time that generations take."""

    def __init__(
        self,
        model: PowerModel,
        max_new_tokens: int,
        activity: Callable[[], Activity],
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._tick_j = model.encode_j + model.act_j
        self._reasoning_w = model.reasoning_w(max_new_tokens)
        self._activity = activity
        self._clock = clock
        self._last: tuple[int, bool, float | None] | None = None
        self._reasoning_j = 0.0

    def __call__(self) -> float:
        """Energy so far."""
        now_ns, activity = self._clock(), self._activity()
        if self._last is not None:
            last_ns, was_reasoning, last_s = self._last
            if activity.reasoning_s is not None and last_s is not None:
                self._reasoning_j += self._reasoning_w * max(0.0, activity.reasoning_s - last_s)
            elif was_reasoning:
                self._reasoning_j += self._reasoning_w * (now_ns - last_ns) / 1e9
        self._last = (now_ns, activity.reasoning, activity.reasoning_s)
        return self._tick_j * activity.ticks + self._reasoning_j


def run_meter(
    plan: PowerPlan, activity: Callable[[], Activity], say: Callable[[str], object], sysfs_root: Path = SYSFS
) -> PowerMeter | None:
    """The target's meter; where it cannot be opened the plan's model, or without one nothing, each with one line."""
    try:
        meter = open_meter(plan.meter, sysfs_root=sysfs_root, rail=plan.rail)
    except MeterError as error:
        if plan.model is None:
            say(f"power: not measured ({error})")
            return None
        say(f"power: modelled, not measured ({error})")
        return ModelledMeter(plan.model.idle_w, RunEnergy(plan.model, plan.max_new_tokens, activity))
    say(f"power: {meter.source}{f', {meter.caveat}' if meter.caveat else ''}")
    return meter


def run_monitor(
    plan: PowerPlan,
    *,
    activity: Callable[[], Activity],
    say: Callable[[str], object],
    battery: ReadBattery | None = None,
    on_sample: Callable[[int, dict[str, Any]], object] | None = None,
    on_findings: Callable[[tuple[Finding, ...]], object] | None = None,
    budget_w: float | None = None,
    sysfs_root: Path = SYSFS,
) -> PowerMonitor:
    """A run's monitor, not started; `budget_w` replaces the target's. Nothing is raised for a missing meter."""
    config = GovernorConfig(
        budget_w=plan.budget_w if budget_w is None else budget_w,
        max_new_tokens=plan.max_new_tokens,
        max_delay_s=plan.max_delay_s,
        model=plan.model,
    )
    return PowerMonitor(
        run_meter(plan, activity, say, sysfs_root),
        Governor(config),
        activity=activity,
        thermal=ThermalReader(sysfs_root),
        battery=battery,
        over_current=OverCurrentEvents(sysfs_root),
        on_sample=on_sample,
        on_findings=on_findings,
        say=say,
    )
