"""Builds the power monitor of a run: the target's meter, its governor, and the program's activity."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from edge.artifacts.manifest import Artifacts
from edge.core.sysfs import SYSFS
from edge.power.governor.governor import Governor, GovernorConfig
from edge.power.governor.plan import PowerPlan, read_power_plan
from edge.power.meters.meter import MeterError, PowerMeter, ReadBattery
from edge.power.meters.select import open_meter
from edge.power.meters.thermal import OverCurrentEvents, ThermalReader
from edge.power.monitor import Activity, PowerMonitor
from edge.safety.faults.findings import Finding


def make_power_monitor(
    artifacts: Artifacts,
    *,
    activity: Callable[[], Activity],
    battery: ReadBattery,
    on_sample: Callable[[int, dict[str, Any]], object],
    on_findings: Callable[[tuple[Finding, ...]], object],
    say: Callable[[str], object],
    sysfs_root: Path = SYSFS,
) -> PowerMonitor:
    """Return the monitor of a target's power plan; raises ArtifactError.

    Without the target's meter the plan's model replaces it and `say` takes a line.
    """
    plan = read_power_plan(artifacts)
    return PowerMonitor(
        _meter(plan, lambda: _energy_j(plan, activity()), say, sysfs_root),
        Governor(GovernorConfig(plan.budget_w, plan.max_new_tokens, plan.max_delay_s, plan.model)),
        activity=activity,
        thermal=ThermalReader(sysfs_root),
        battery=battery,
        over_current=OverCurrentEvents(sysfs_root),
        on_sample=on_sample,
        on_findings=on_findings,
        say=say,
    )


def _meter(
    plan: PowerPlan, energy_j: Callable[[], float], say: Callable[[str], object], sysfs_root: Path
) -> PowerMeter | None:
    if plan.meter == "none":
        return None
    idle_w = None if plan.model is None else plan.model.idle_w
    try:
        return open_meter(plan.meter, sysfs_root=sysfs_root, rail=plan.rail, idle_w=idle_w, energy_j=energy_j)
    except MeterError as error:
        instead = "nothing replaces it" if idle_w is None else "the plan's model replaces it"
        say(f"power: {error}; {instead}")
        return None if idle_w is None else open_meter("modelled", idle_w=idle_w, energy_j=energy_j)


def _energy_j(plan: PowerPlan, activity: Activity) -> float:
    """Return the modelled energy above idle so far, J; a generation's is spread over its duration."""
    model = plan.model
    if model is None:
        return 0.0
    reasoning_j = activity.reasoning_s * model.reasoning_w(plan.max_new_tokens)
    return activity.ticks * (model.encode_j + model.act_j) + reasoning_j
