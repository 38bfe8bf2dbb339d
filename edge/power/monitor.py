"""The power thread: reads meter, heat and battery about ten times a second, steps the governor, publishes its budget.

Each source has its own reader thread, so that a blocked source costs only its own value. The stepping thread takes the
newest value of each; a value that is too old counts as missing. No other thread waits for these threads.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final, Generic, TypeVar

from edge.power.governor.average import PowerStatistics
from edge.power.governor.governor import LEVELS, OFF, Governor, GovernorInputs, GovernorOutputs
from edge.power.meters.meter import MEASURED, MODELLED, BatteryReading, MeterError, PowerMeter, PowerSample, ReadBattery
from edge.power.meters.thermal import OverCurrentEvents, ThermalReader, ThermalState
from edge.reasoning.generation_cycle import ReasoningBudget
from edge.safety.faults.findings import Finding

PERIOD_S: Final = 0.1
STALE_NS: Final = 500_000_000
THERMAL_STALE_NS: Final = 2_000_000_000
BATTERY_STALE_NS: Final = 10_000_000_000
JOIN_S: Final = 0.5

T = TypeVar("T")


@dataclass(frozen=True)
class Activity:
    """The program's activity so far; counts only grow."""

    ticks: int = 0
    reasoning: bool = False
    """A generation is under way."""
    generations: int = 0
    """Finished ones."""
    reasoning_s: float = 0.0
    """Total time of generations, s."""
    abandoned: int = 0
    """Number of generations that were begun and not finished, whatever the reason."""


@dataclass(frozen=True)
class PowerSnapshot:
    """All power readings and results of one step."""

    stamp_ns: int
    sample: PowerSample | None
    """The meter's newest sample; None without a fresh one."""
    outputs: GovernorOutputs
    thermal: ThermalState | None
    battery: BatteryReading | None
    meter_error: str | None
    over_current: dict[str, int]

    def record(self) -> dict[str, Any]:
        """Return the `/power` record of the flight log."""
        outputs, sample = self.outputs, self.sample
        return {
            "stamp_ns": self.stamp_ns,
            "total_w": None if sample is None else sample.total_w,
            "rails": {} if sample is None else dict(sample.rails),
            "average_w": outputs.average_w,
            "budget_w": outputs.budget_w,
            "level": outputs.level,
            "pause_s": outputs.budget.pause_s,
            "token_cap": outputs.budget.max_new_tokens,
            "tagged": MODELLED if sample is None else sample.tagged,
            "source": "none" if sample is None else sample.source,
            "temperature_c": None if self.thermal is None else self.thermal.hottest_c,
        }


class _Source(Generic[T]):
    """Calls a function at a rate in a separate thread and keeps its newest value with its instant."""

    def __init__(self, name: str, read: Callable[[int], T], period_s: float, clock: Callable[[], int]) -> None:
        self._read = read
        self._period_s = period_s
        self._clock = clock
        self.stop = threading.Event()
        self.thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._newest: tuple[int, T] | None = None
        self.error: str | None = None

    def fresh(self, now_ns: int, oldest_ns: int) -> T | None:
        """Return the newest value if it is not too old, else None."""
        newest = self._newest
        return None if newest is None or now_ns - newest[0] > oldest_ns else newest[1]

    def read(self) -> None:
        """Read once in the calling thread; a failure keeps the previous value."""
        began_ns = self._clock()
        try:
            self._newest = (began_ns, self._read(began_ns))
            self.error = None
        except MeterError as error:
            self.error = str(error)
        except Exception as error:  # noqa: BLE001 - an unexpected driver error may cost its value, not the thread
            self.error = f"{type(error).__name__}: {error}"

    def _run(self) -> None:
        while not self.stop.is_set():
            self.read()
            self.stop.wait(self._period_s)


class PowerMonitor:
    """Shell of the governor; `budget` and `snapshot` are single reads of a reference, from any thread."""

    def __init__(
        self,
        meter: PowerMeter | None,
        governor: Governor,
        *,
        activity: Callable[[], Activity],
        thermal: ThermalReader | None = None,
        battery: ReadBattery | None = None,
        over_current: OverCurrentEvents | None = None,
        on_sample: Callable[[int, dict[str, Any]], object] | None = None,
        on_findings: Callable[[tuple[Finding, ...]], object] | None = None,
        say: Callable[[str], object] | None = None,
        period_s: float = PERIOD_S,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`activity` and `battery` must not block. `on_sample` takes (stamp_ns, `/power` record) in every step,
        `on_findings` the findings of every step with any, `say` a line on every change."""
        self._meter = meter
        self._governor = governor
        self._activity = activity
        self._battery = battery
        self._on_sample, self._on_findings, self._say = on_sample, on_findings, say
        self._period_s = period_s
        self._clock = clock
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="power", daemon=True)
        self._power = None if meter is None else _Source("power-meter", meter.read, period_s, clock)
        self._heat = None if thermal is None else _Source("thermal", thermal.read, 2 * period_s, clock)
        self._events = (
            None if over_current is None else _Source("over-current", lambda _: over_current.read(), 1.0, clock)
        )
        self._judged_heat: ThermalState | None = None
        self._heat_lost = False
        self._statistics = PowerStatistics()
        self._measured = True
        self._failed: str | None = None
        self._snapshot = PowerSnapshot(clock(), None, GovernorOutputs(), None, None, None, {})

    def start(self) -> None:
        """Start the threads; before the first step nothing is limited."""
        for source in self._sources():
            source.thread.start()
        self._thread.start()

    def close(self) -> None:
        """Stop the threads; wait at most 0.5 s in all for hanging readings, which end with the process."""
        self._stop.set()
        for source in self._sources():
            source.stop.set()
        deadline_s = time.monotonic() + JOIN_S
        for thread in (self._thread, *(source.thread for source in self._sources())):
            if thread.ident is not None:
                thread.join(max(0.0, deadline_s - time.monotonic()))

    def budget(self) -> ReasoningBudget:
        """The current budget of reasoning."""
        return self._snapshot.outputs.budget

    def snapshot(self) -> PowerSnapshot:
        """The readings and results of the last step."""
        return self._snapshot

    def statistics(self) -> dict[str, Any]:
        """Return `power_w` of a result: mean and p99 of the metered samples, W, and their source."""
        mean_w, p99_w = self._statistics.mean_w, self._statistics.percentile_w(0.99)
        result: dict[str, Any] = {
            "mean": None if mean_w is None else round(mean_w, 3),
            "p99": None if p99_w is None else round(p99_w, 2),
            "source": "none" if self._meter is None or mean_w is None else self._meter.source,
            "tagged": MEASURED if mean_w is not None and self._measured else MODELLED,
        }
        if self._snapshot.over_current:
            result["over_current_events"] = dict(self._snapshot.over_current)
        return result

    def read(self) -> None:
        """Read every source once in the calling thread, for a caller of `step` without threads."""
        for source in self._sources():
            source.read()

    def step(self, now_ns: int) -> PowerSnapshot:
        """Run one step of the stepping thread, without its clock."""
        sample = None if self._power is None else self._power.fresh(now_ns, STALE_NS)
        thermal = None if self._heat is None else self._heat.fresh(now_ns, THERMAL_STALE_NS)
        heat = self._judge_heat(thermal)
        events = None if self._events is None else self._events.fresh(now_ns, 10 * THERMAL_STALE_NS)
        battery = None if self._battery is None else self._battery()
        if battery is not None and now_ns - battery.received_ns > BATTERY_STALE_NS:
            battery = None
        activity = self._activity()
        outputs = self._governor.step(
            GovernorInputs(
                power_w=None if sample is None else sample.total_w,
                reasoning=activity.reasoning,
                reasoning_s=activity.reasoning_s,
                generations=activity.generations,
                abandoned=activity.abandoned,
                throttled=heat is not None and heat.throttled,
                throttle_margin_c=None if heat is None else heat.throttle_margin_c,
                trip_margin_c=None if heat is None else heat.trip_margin_c,
                battery_percent=None if battery is None else battery.soc_percent,
            ),
            now_ns,
        )
        if sample is not None:
            self._statistics.add(sample.stamp_ns, sample.total_w)
            self._measured = self._measured and sample.tagged == MEASURED
        error = None if self._power is None else self._power.error
        self._snapshot = PowerSnapshot(now_ns, sample, outputs, thermal, battery, error, events or {})
        return self._snapshot

    def _judge_heat(self, thermal: ThermalState | None) -> ThermalState | None:
        """Return the newest distances; a missing one keeps its last value."""
        last, lost = self._judged_heat, self._judged_heat is not None and thermal is None
        if lost != self._heat_lost and self._say is not None:
            self._say(f"power: temperatures {'are not read: what heat limits stays as it is' if lost else 'are read'}")
        self._heat_lost = lost
        if thermal is not None:
            passive_c, trip_c = thermal.throttle_margin_c, thermal.trip_margin_c
            self._judged_heat = (
                thermal
                if last is None
                else replace(
                    thermal,
                    throttle_margin_c=last.throttle_margin_c if passive_c is None else passive_c,
                    trip_margin_c=last.trip_margin_c if trip_c is None else trip_c,
                )
            )
        return self._judged_heat

    def _sources(self) -> list[_Source[Any]]:
        return [source for source in (self._power, self._heat, self._events) if source is not None]

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                snapshot = self.step(self._clock())
                self._publish(snapshot)
                self._failed = None
            except Exception as error:  # noqa: BLE001 - no error here may end the governing
                self._fail(f"{type(error).__name__}: {error}")
            self._stop.wait(self._period_s)

    def _publish(self, snapshot: PowerSnapshot) -> None:
        outputs = snapshot.outputs
        if self._on_findings is not None and outputs.findings:
            self._on_findings(tuple(Finding(name, _detail(name, snapshot)) for name in outputs.findings))
        if self._on_sample is not None:
            self._on_sample(snapshot.stamp_ns, snapshot.record())
        if self._say is not None and outputs.message is not None:
            self._say(f"power: {outputs.message}")

    def _fail(self, why: str) -> None:
        """Without a governor nothing keeps the budget: reasoning stops, control goes on."""
        last = self._snapshot
        outputs = GovernorOutputs(ReasoningBudget(allowed=False), level=LEVELS[OFF], message=why)
        self._snapshot = PowerSnapshot(self._clock(), None, outputs, last.thermal, last.battery, why, last.over_current)
        if self._failed != why and self._say is not None:
            self._failed = why
            self._say(f"power: the governor failed, reasoning is off ({why})")


def _detail(name: str, snapshot: PowerSnapshot) -> str:
    thermal, battery = snapshot.thermal, snapshot.battery
    if name.startswith("thermal") and thermal is not None and thermal.hottest_c is not None:
        what = f" ({', '.join(thermal.throttling)})" if thermal.throttling else ""
        return f"{thermal.hottest_c:.0f} °C{what}"
    if name.startswith("battery") and battery is not None:
        return f"{battery.soc_percent} %"
    return ""
