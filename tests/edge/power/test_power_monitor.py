"""The power thread's shell: nobody waits for a meter, and whatever fails costs its own value only."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest

from edge.flightlog.schemas import SCHEMAS
from edge.power.governor.governor import Governor, GovernorConfig, GovernorInputs, GovernorOutputs
from edge.power.meters.meter import MeterError, ModelledMeter, PowerSample
from edge.power.meters.thermal import ThermalReader, ThermalState
from edge.power.monitor import Activity, PowerMonitor
from edge.safety.faults.findings import FindingQueue

SECOND = 1_000_000_000


class FakeMeter:
    """Gives one value, or fails, or hangs."""

    source, caveat = "fake", None

    def __init__(self, read: Callable[[int], PowerSample]) -> None:
        self.read = read


def steady(power_w: float = 20.0) -> FakeMeter:
    return FakeMeter(lambda now_ns: PowerSample(now_ns, power_w, {"VDD_IN": power_w}, source="fake"))


def monitor(meter: Any, **options: Any) -> PowerMonitor:
    governor = options.pop("governor", None) or Governor(GovernorConfig(25.0, 48))
    return PowerMonitor(meter, governor, activity=Activity, period_s=0.005, **options)


def until(reached: Callable[[], bool]) -> bool:
    deadline_s = time.monotonic() + 20
    while not reached() and time.monotonic() < deadline_s:
        time.sleep(0.005)
    return reached()


def test_a_meter_that_works_gives_samples_records_and_statistics() -> None:
    records: list[tuple[int, dict[str, Any]]] = []
    running = monitor(steady(), on_sample=lambda stamp_ns, record: records.append((stamp_ns, record)))
    running.start()
    try:
        assert until(lambda: running.statistics()["mean"] is not None)
    finally:
        running.close()
    statistics = running.statistics()
    assert (statistics["mean"], statistics["source"], statistics["tagged"]) == (20.0, "fake", "measured")
    assert statistics["p99"] == pytest.approx(20.0, abs=0.06)
    stamp_ns, record = records[-1]
    assert (record["stamp_ns"], record["total_w"], record["tagged"]) == (stamp_ns, 20.0, "measured")


def test_a_record_has_the_fields_that_the_flight_log_describes() -> None:
    record = monitor(steady()).step(SECOND).record()
    assert set(SCHEMAS["/power"]["properties"]) <= set(record)


def test_a_hanging_meter_costs_its_value_and_delays_no_caller() -> None:
    hang = threading.Event()

    def read(now_ns: int) -> PowerSample:
        hang.wait(60)
        raise MeterError("too late")

    running = monitor(FakeMeter(read))
    before_ns = running.snapshot().stamp_ns
    running.start()
    try:
        assert until(lambda: running.snapshot().stamp_ns > before_ns)
        assert running.snapshot().sample is None
        assert running.budget().allowed
        closed = threading.Thread(target=running.close)
        closed.start()
        closed.join(20)
        assert not closed.is_alive()
    finally:
        hang.set()


@pytest.mark.parametrize("error", [MeterError("gone"), OSError("i2c"), ValueError("nonsense")])
def test_a_meter_that_raises_is_read_again_and_its_error_is_kept(error: Exception) -> None:
    answers: list[Exception | None] = [error, error, None]

    def read(now_ns: int) -> PowerSample:
        if (failure := answers.pop(0)) is not None:
            raise failure
        return PowerSample(now_ns, 20.0, source="fake")

    running = monitor(FakeMeter(read), clock=lambda: SECOND)
    for _ in range(2):
        running.read()
        snapshot = running.step(SECOND)
        assert snapshot.sample is None and str(error) in (snapshot.meter_error or "")
    running.read()
    snapshot = running.step(SECOND)
    assert snapshot.sample is not None and snapshot.meter_error is None


def test_a_sample_that_is_old_counts_as_none() -> None:
    running = monitor(steady(), clock=lambda: SECOND)
    running.read()
    assert running.step(SECOND + SECOND // 4).sample is not None
    assert running.step(SECOND + SECOND).sample is None


def test_without_a_meter_the_result_names_none() -> None:
    running = monitor(None)
    running.step(SECOND)
    assert running.statistics() == {"mean": None, "p99": None, "source": "none", "tagged": "modelled"}


def test_figures_of_a_model_are_never_called_measured() -> None:
    now_ns = [0]
    running = monitor(ModelledMeter(4.6, lambda: 0.0), clock=lambda: now_ns[0])
    for second in range(1, 6):
        now_ns[0] = second * SECOND
        running.read()
        running.step(now_ns[0])
    statistics = running.statistics()
    assert (statistics["source"], statistics["tagged"]) == ("the plan's model", "modelled")
    assert statistics["mean"] == pytest.approx(4.6)


def fail(*_: object) -> None:
    raise RuntimeError("no room")


class BrokenGovernor(Governor):
    def step(self, inputs: GovernorInputs, now_ns: int) -> GovernorOutputs:
        raise RuntimeError("no room")


@pytest.mark.parametrize(
    "options",
    [{"on_sample": fail}, {"governor": BrokenGovernor(GovernorConfig(25.0, 48))}],
    ids=["callback", "governor"],
)
def test_a_failure_does_not_end_the_thread_but_reasoning_and_is_reported_once(options: dict[str, Any]) -> None:
    lines: list[str] = []
    running = monitor(steady(), say=lines.append, **options)
    running.start()
    try:
        assert until(lambda: not running.budget().allowed)
        first_ns = running.snapshot().stamp_ns
        assert until(lambda: running.snapshot().stamp_ns > first_ns)
    finally:
        running.close()
    assert sum("no room" in line for line in lines) == 1


@dataclass(frozen=True)
class Charge:
    """A battery report."""

    received_ns: int
    soc_percent: float | None = 5.0


def test_an_old_charge_report_is_ignored() -> None:
    running = monitor(None, battery=lambda: Charge(SECOND))
    assert running.step(12 * SECOND).outputs.findings == ()
    assert running.step(10 * SECOND).outputs.findings == ("battery-empty", "battery-low")


class Heat(ThermalReader):
    """Gives `state`, or fails while there is none."""

    def __init__(self, state: ThermalState) -> None:
        self.state: ThermalState | None = state

    def read(self, now_ns: int) -> ThermalState:
        if self.state is None:
            raise MeterError("gone")
        return self.state


class Heated:
    """A monitor without threads whose thermal source is read just before each step."""

    def __init__(self, state: ThermalState, say: Callable[[str], object] = lambda _line: None) -> None:
        self.heat, self._now_ns = Heat(state), 0
        governor = Governor(GovernorConfig(None, 48))
        self.monitor = PowerMonitor(
            None, governor, activity=Activity, thermal=self.heat, say=say, clock=lambda: self._now_ns
        )

    def step(self, second: int) -> GovernorOutputs:
        self._now_ns = second * SECOND
        self.monitor.read()
        return self.monitor.step(self._now_ns).outputs


HOT = ThermalState(0, {"tj": 102.0}, 102.0, -3.0, 2.5, ("gpu-throttle-alert",))


def test_heat_becomes_a_finding_with_its_numbers_in_the_queue() -> None:
    queue = FindingQueue()
    running = monitor(steady(), thermal=Heat(HOT), on_findings=queue.put)
    running.start()
    try:
        assert until(lambda: len(queue) > 1)
    finally:
        running.close()
    found = {finding.name: finding.detail for finding in queue.take()}
    assert found["thermal-trip"] == "102 °C (gpu-throttle-alert)"
    assert "thermal-throttle" in found


def test_a_stalled_thermal_source_clears_neither_throttling_nor_trip_and_is_reported_once() -> None:
    lines: list[str] = []
    heated = Heated(HOT, lines.append)
    for second in (1, 5, 60, 120):
        outputs = heated.step(second)
        assert outputs.findings == ("thermal-trip", "thermal-throttle")
        assert not outputs.budget.allowed
        heated.heat.state = None
    assert heated.monitor.snapshot().thermal is None
    assert sum("temperatures are not read" in line for line in lines) == 1


def test_a_zone_that_gives_no_value_any_more_keeps_its_last_distance() -> None:
    heated = Heated(HOT)
    heated.step(1)
    heated.heat.state = ThermalState(0)
    for second in range(2, 60):
        assert heated.step(second).findings == ("thermal-trip", "thermal-throttle")
    heated.heat.state = ThermalState(0, {}, 60.0, 39.0, 44.5)
    assert heated.step(60).findings == ("thermal-throttle",)
    assert heated.step(71).findings == ()
