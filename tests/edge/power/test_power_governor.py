"""The governor: the budget on every window of 10 s, by shedding reasoning in steps, on a fake clock."""

from __future__ import annotations

import itertools
import math
import tracemalloc
from dataclasses import dataclass, field

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.artifacts.files import ArtifactError
from edge.power.governor.average import PowerHistory, PowerStatistics
from edge.power.governor.governor import LEVELS, Governor, GovernorConfig, GovernorInputs, GovernorOutputs
from edge.power.governor.levels import GenerationTimes, pause_for, worst_share
from edge.power.governor.plan import PowerModel, power_plan
from edge.reasoning.generation_cycle import UNLIMITED
from edge.safety.faults.table import FAULTS
from tools.bench.governor import LOADS, judge, orin, simulate

SECOND = 1_000_000_000
STEP_S = 0.1
MODEL = PowerModel(
    idle_w=5.0,
    period_s=0.1,
    encode_j=0.9,
    act_j=0.1,
    prefill_j=4.0,
    token_j=0.2,
    context_j=0.0,
    before_text_s=0.8,
    token_s=0.04,
)
"""Control 10 W, so 15 W without reasoning; 48 tokens take 2.72 s."""


@dataclass
class Bench:
    """A governor on a fake clock, and a reasoning loop that obeys it."""

    governor: Governor
    base_w: float = 15.0
    rise_w: float = 10.0
    now_ns: int = SECOND
    began_s: float | None = None
    finished_s: float = -1e9
    length_s: float = 0.0
    busy_s: float = 0.0
    generations: int = 0
    true_w: list[float] = field(default_factory=list)
    levels: list[str] = field(default_factory=list)
    says: list[str] = field(default_factory=list)
    outputs: GovernorOutputs = field(default_factory=GovernorOutputs)

    def step(self, seconds: float = STEP_S, power_w: float | str | None = "true", **more: object) -> GovernorOutputs:
        for _ in range(round(seconds / STEP_S)):
            now_s, budget = self.now_ns / 1e9, self.outputs.budget
            if self.began_s is not None and (not budget.allowed or now_s - self.began_s >= self.length_s - 1e-9):
                self.generations += budget.allowed
                self.began_s, self.finished_s = None, now_s
            if self.began_s is None and budget.allowed and now_s - self.finished_s >= budget.pause_s:
                tokens = 48 if budget.max_new_tokens is None else budget.max_new_tokens
                self.began_s, self.length_s = now_s, MODEL.generation_s(tokens)
            running = self.began_s is not None
            self.busy_s += STEP_S * running
            self.now_ns += round(STEP_S * SECOND)
            watts = self.base_w + self.rise_w * running
            self.true_w.append(watts)
            reading = watts if power_w == "true" else power_w
            assert reading is None or isinstance(reading, float)
            inputs = GovernorInputs(reading, running, self.busy_s, self.generations, **more)  # type: ignore[arg-type]
            self.outputs = self.governor.step(inputs, self.now_ns)
            self.levels.append(self.outputs.level)
            if self.outputs.message:
                self.says.append(self.outputs.message)
        return self.outputs

    def worst_window_w(self, after_s: float) -> float:
        width = 100
        windows = [sum(self.true_w[i : i + width]) / width for i in range(len(self.true_w) - width + 1)]
        return max(windows[max(0, round(after_s / STEP_S) - width) :])


def bench(budget_w: float | None, *, model: PowerModel | None = MODEL, max_delay_s: float = 10.0) -> Bench:
    return Bench(Governor(GovernorConfig(budget_w, 48, max_delay_s, model)))


@pytest.mark.slow
@pytest.mark.parametrize("load", LOADS)
def test_each_load_keeps_the_budget_after_half_a_minute_and_every_tick(load: str) -> None:
    row = judge(load, simulate(load, seconds=180), orin()[1].budget_w or math.nan)
    assert row["ok"], row


@pytest.mark.slow
def test_the_same_device_without_a_governor_does_not_keep_the_budget() -> None:
    row = judge("plan", simulate("plan", seconds=60, governed=False), orin()[1].budget_w or math.nan)
    assert not row["ok"]
    assert row["worst_over_percent"] > 5


@pytest.mark.parametrize("budget_w", [26.0, None])
def test_below_the_budget_and_without_one_reasoning_is_not_limited(budget_w: float | None) -> None:
    run = bench(budget_w)
    assert run.step(60).budget == UNLIMITED
    assert set(run.levels) == {"full"}


@pytest.mark.slow
def test_a_budget_that_a_pause_can_keep_costs_no_token() -> None:
    run = bench(20.0, max_delay_s=20.0)
    run.step(120)
    assert set(run.levels) == {"full"}
    assert run.worst_window_w(30) <= 20.0 * 1.02
    assert run.generations >= 14


@pytest.mark.slow
@pytest.mark.parametrize("rise_w", [5.0, 20.0])
def test_a_plan_that_is_wrong_by_a_factor_of_two_settles_all_the_same(rise_w: float) -> None:
    run = bench(20.0)
    run.rise_w = rise_w
    run.step(120)
    assert run.worst_window_w(30) <= 20.0 * 1.02


@pytest.mark.slow
def test_without_a_plan_it_learns_what_it_needs() -> None:
    run = bench(20.0, model=None)
    run.step(120)
    assert run.worst_window_w(30) <= 20.0 * 1.02
    assert run.generations > 10


@pytest.mark.slow
def test_the_pause_settles_and_does_not_swing() -> None:
    run = bench(20.0, max_delay_s=20.0)
    run.step(60)
    starts = run.generations
    run.step(120)
    cycles_s = 120 / (run.generations - starts)
    assert cycles_s == pytest.approx(2.72 + pause_for(0.5, 2.72, 10.0), rel=0.15)


@pytest.mark.slow
def test_steps_are_taken_in_order_and_off_is_the_last() -> None:
    run = bench(20.0)
    for base_w in (15.0, 17.0, 18.5, 19.3, 19.9, 20.5):
        run.base_w = base_w
        run.step(60)
    order = [LEVELS.index(level) for level in run.levels]
    assert all(b - a <= 1 for a, b in itertools.pairwise(order))
    assert order[-1] == len(LEVELS) - 1
    assert order == sorted(order)


def test_power_drawn_without_reasoning_cannot_be_shed_and_is_reported() -> None:
    run = bench(20.0)
    run.base_w = 22.0
    outputs = run.step(60)
    assert outputs.over_budget
    assert not outputs.budget.allowed
    assert any("above the budget without any reasoning" in line for line in run.says)


@pytest.mark.slow
def test_reasoning_comes_back_when_there_is_room_again() -> None:
    run = bench(20.0)
    run.base_w = 22.0
    run.step(60)
    run.base_w = 12.0
    run.step(120)
    assert run.outputs.budget.allowed
    assert run.outputs.level == "full"


@pytest.mark.slow
def test_a_load_at_the_edge_of_two_steps_does_not_make_it_change_for_ever() -> None:
    run = bench(20.0)
    run.base_w = 17.0
    run.step(150)
    assert sum(a != b for a, b in itertools.pairwise(run.levels[600:])) <= 1


@pytest.mark.slow
@pytest.mark.parametrize("power_w", [None, math.nan, math.inf, -3.0, 1e9])
def test_a_meter_without_valid_readings_is_replaced_by_the_model_and_reported(power_w: float | None) -> None:
    run = bench(20.0)
    run.step(60)
    outputs = run.step(60, power_w=power_w)
    assert not outputs.metered
    assert sum("no power reading" in line for line in run.says) == 1
    assert outputs.average_w is not None and outputs.average_w == pytest.approx(20.0, abs=1.5)
    assert run.worst_window_w(30) <= 20.0 * 1.02


def test_single_lost_samples_change_nothing() -> None:
    run = bench(20.0)
    for index in range(600):
        run.step(STEP_S, power_w=math.nan if index % 7 == 0 else "true")
    assert not any("no power reading" in line for line in run.says)
    assert run.worst_window_w(30) <= 20.0 * 1.02


@pytest.mark.slow
def test_a_long_gap_between_steps_neither_raises_nor_opens_the_budget() -> None:
    run = bench(20.0)
    run.step(60)
    run.now_ns += 90 * SECOND
    assert math.isfinite(run.step(STEP_S).budget.pause_s)
    run.true_w.clear()
    run.step(60)
    assert run.worst_window_w(0) <= 20.0 * 1.02


def test_the_time_of_an_abandoned_generation_is_not_the_next_ones() -> None:
    times = GenerationTimes(1)
    times.update(1, 2.0, 0)
    times.update(1, 3.5, 0)  # under way
    times.update(1, 3.5, 0, abandoned=1)
    times.update(1, 4.5, 0, abandoned=1)
    times.update(2, 5.5, 0, abandoned=1)
    assert times.longest_s(0) == 2.0


def test_a_generation_that_ends_as_another_is_abandoned_still_counts() -> None:
    times = GenerationTimes(1)
    times.update(1, 2.0, 0, abandoned=1)
    assert times.longest_s(0) == 2.0


def test_heat_takes_tokens_first_and_all_reasoning_when_it_lasts() -> None:
    run = bench(None)
    outputs = run.step(1, throttled=True)
    assert (outputs.findings, outputs.level) == (("thermal-throttle",), "quarter")
    assert outputs.budget.max_new_tokens == 12
    assert run.step(45, throttled=True).level == "off"


def test_heat_is_over_when_it_has_been_cool_for_a_while() -> None:
    run = bench(None)
    run.step(5, throttle_margin_c=-1.0)
    assert run.step(5, throttle_margin_c=1.0).findings == ("thermal-throttle",)
    assert run.step(9.5, throttle_margin_c=20.0).findings == ("thermal-throttle",)
    assert run.step(1.0, throttle_margin_c=20.0).findings == ()


def test_a_board_about_to_switch_itself_off_gets_no_reasoning_until_it_is_well_below() -> None:
    run = bench(None)
    outputs = run.step(STEP_S, trip_margin_c=2.0)
    assert "thermal-trip" in outputs.findings and not outputs.budget.allowed
    assert not run.step(1, trip_margin_c=6.0).budget.allowed
    assert not run.step(1).budget.allowed
    assert run.step(1, trip_margin_c=9.0).budget.allowed


def test_a_low_battery_lowers_the_budget_and_an_empty_one_ends_reasoning() -> None:
    run = bench(25.0)
    low = run.step(1, battery_percent=20)
    assert (low.findings, low.budget_w) == (("battery-low",), 20.0)
    empty = run.step(1, battery_percent=10)
    assert empty.findings == ("battery-empty", "battery-low") and not empty.budget.allowed


@pytest.mark.slow
def test_a_low_battery_stays_low_without_reports_and_clears_with_hysteresis() -> None:
    run = bench(25.0)
    run.step(1, battery_percent=15)
    assert run.step(60).findings == ("battery-low",)
    assert run.step(1, battery_percent=21).findings == ("battery-low",)
    assert run.step(1, battery_percent=23).findings == ()


def test_every_finding_is_a_fault_of_the_table() -> None:
    run = bench(25.0)
    found = run.step(1, throttled=True, trip_margin_c=0.0, battery_percent=5).findings
    assert len(found) == 4
    assert set(found) <= set(FAULTS)


@given(st.floats(0.01, 0.99), st.floats(0.05, 12.0))
def test_the_pause_is_the_shortest_that_keeps_every_window(share: float, generation_s: float) -> None:
    pause_s = pause_for(share, generation_s, 10.0)
    if math.isinf(pause_s):
        assert generation_s > share * 10.0
        return
    assert worst_share(generation_s, pause_s, 10.0) <= share + 1e-9
    assert pause_s < 0.02 or worst_share(generation_s, pause_s - 0.02, 10.0) >= share - 1e-9


@given(st.floats(0.05, 9.0), st.floats(0.0, 20.0))
def test_no_window_of_a_cycle_holds_more_than_its_worst_share(generation_s: float, pause_s: float) -> None:
    cycle_s, worst = generation_s + pause_s, 0.0
    for k in range(50):
        begin = cycle_s * k / 50
        spans = [(n * cycle_s, n * cycle_s + generation_s) for n in range(-1, math.ceil(12 / cycle_s) + 2)]
        worst = max(worst, sum(max(0.0, min(b, begin + 10) - max(a, begin)) for a, b in spans) / 10)
    assert worst <= worst_share(generation_s, pause_s, 10.0) + 1e-9


@pytest.mark.parametrize(
    ("samples", "at_s", "window_s", "average_w"),
    [
        (((0.0, 10.0), (0.5, 30.0), (0.6, 10.0), (1.0, 10.0)), 1, 1.0, 12.0),
        (((0.0, 10.0), (8.0, 30.0)), 9, 9.0, 20.0),
        (((1.0, 10.0), (0.5, 500.0)), 2, 1.0, 10.0),
    ],
    ids=["weighted by time", "a gap belongs to no sample", "older samples are dropped"],
)
def test_the_average_of_a_window(
    samples: tuple[tuple[float, float], ...], at_s: int, window_s: float, average_w: float
) -> None:
    history = PowerHistory(10.0, hold_s=1.0)
    for stamp_s, power_w in samples:
        history.add(round(stamp_s * SECOND), power_w)
    assert history.average_w(at_s * SECOND, window_s) == pytest.approx(average_w)


@pytest.mark.slow
@given(
    st.lists(st.tuples(st.integers(1, 3 * SECOND), st.floats(0.0, 100.0)), min_size=1, max_size=40),
    st.integers(0, 12 * SECOND),
)
def test_energy_since_an_instant_is_the_energy_of_that_interval(steps: list[tuple[int, float]], back_ns: int) -> None:
    history, now_ns = PowerHistory(10.0), 0
    for step_ns, power_w in steps:
        now_ns += step_ns
        history.add(now_ns, power_w)
    now_ns += SECOND // 3
    expected, _ = history.energy_j(now_ns - back_ns, now_ns)
    assert history.energy_since(now_ns)(now_ns - back_ns) == pytest.approx(expected, rel=1e-6, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("keeper", "bound_bytes"),
    [
        (PowerHistory(10.0), 4096 * 250),  # 250 bytes hold two time stamps, a power and their tuple
        (PowerStatistics(), 50_000),  # the samples alone would be over a million
    ],
    ids=["history", "statistics"],
)
def test_memory_is_bounded(keeper: PowerHistory | PowerStatistics, bound_bytes: int) -> None:
    tracemalloc.start()
    try:
        for index in range(20_000):
            keeper.add(index * 1000, float(index % 2000))
        kept_bytes, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert kept_bytes < bound_bytes


def test_statistics_weigh_by_time_and_a_gap_counts_as_one_second() -> None:
    statistics = PowerStatistics()
    for stamp_s, power_w in ((0, 10.0), (1, 30.0), (100, 10.0)):
        statistics.add(stamp_s * SECOND, power_w)
    assert statistics.mean_w == pytest.approx(20.0)


def test_the_percentile_is_not_exceeded_for_that_share_of_the_time() -> None:
    statistics = PowerStatistics()
    for index in range(1001):
        statistics.add(index * SECOND // 10, 30.0 if index % 50 == 0 else 10.0)
    assert statistics.percentile_w(0.9) == pytest.approx(10.0, abs=0.051)
    assert statistics.percentile_w(0.99) == pytest.approx(30.0, abs=0.051)


@pytest.mark.slow
def test_the_plan_of_the_orin_gives_its_meter_its_rail_and_its_budget() -> None:
    power = orin()[1]
    assert (power.meter, power.rail, power.budget_w) == ("ina3221", "VDD_IN", 25.0)
    assert power.model is not None and power.model.tagged == "modelled"
    # export/plan/plan.py: idle 4.6 W and a rise of 23 W times the share of a period that a tick takes.
    assert power.model.idle_w + power.model.control_w == pytest.approx(22.48, abs=0.02)


def test_a_plan_without_energies_gives_no_model() -> None:
    power = power_plan({"plan": {}, "provenance": {}}, 48)
    assert (power.meter, power.model, power.budget_w) == ("none", None, None)


def test_a_plan_that_is_damaged_is_refused_in_one_line() -> None:
    with pytest.raises(ArtifactError, match="lacks what the power budget needs"):
        power_plan({"plan": [], "provenance": {}}, 48)


def test_a_budget_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="budget_w must be positive"):
        GovernorConfig(0.0, 48)
