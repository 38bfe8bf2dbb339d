"""How much the reasoning loop may think, in which mode, and what becomes of a generation that fails."""

from __future__ import annotations

import pytest

from edge.reasoning.generation_cycle import FAILURES, Mode
from edge.state.reasoning_budget import ReasoningBudget
from tests.support.runner.reasoning_bench import Bench, Clock, FakeRun


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def bench(clock: Clock) -> Bench:
    return Bench(clock=clock)


# Budget


def test_no_generation_begins_while_the_budget_forbids_it(bench: Bench) -> None:
    bench.frame(2.0)
    bench.budget = ReasoningBudget(allowed=False)
    assert not bench.loop.step()
    bench.budget = ReasoningBudget()
    assert bench.loop.step()


def test_a_generation_under_way_ends_when_the_budget_is_withdrawn(bench: Bench) -> None:
    def withdraw(_run: FakeRun) -> None:
        bench.budget = ReasoningBudget(allowed=False)

    bench.language.during_finish = withdraw
    bench.frame(2.0)
    assert not bench.loop.step()
    assert (bench.slot.state, bench.cycle.cancelled) == (None, 1)


def test_the_budgets_pause_lies_between_two_generations(bench: Bench, clock: Clock) -> None:
    bench.budget = ReasoningBudget(pause_s=2.0)
    bench.frame(2.0)
    assert bench.loop.step()
    bench.frame(3.0)
    clock.s += 1.9
    assert not bench.loop.step()
    clock.s += 0.1
    assert bench.loop.step()


@pytest.mark.parametrize(("cap", "expected"), [(None, 4), (9, 4), (2, 2), (0, 0)])
def test_the_budget_caps_the_new_tokens(bench: Bench, cap: int | None, expected: int) -> None:
    bench.budget = ReasoningBudget(max_new_tokens=cap)
    bench.frame(2.0)
    assert bench.loop.step()
    assert bench.language.caps == [expected]


def test_a_text_that_the_budget_cut_short_is_not_held_against_the_model(bench: Bench) -> None:
    bench.language.text = "Cle"
    bench.budget = ReasoningBudget(max_new_tokens=2)
    bench.frame(2.0)
    bench.loop.step()
    assert bench.cycle.invalid_texts == 0
    assert bench.slot.state is not None and not bench.slot.state.text_complete
    bench.budget = ReasoningBudget()
    bench.frame(3.0)
    bench.loop.step()
    assert (bench.cycle.invalid_texts, bench.cycle.invalid_in_a_row) == (1, 1)


# Sync mode


def test_in_sync_mode_the_next_generation_sees_only_what_was_captured_after_the_halt(clock: Clock) -> None:
    bench = Bench(clock=clock, mode=Mode.SYNC)
    bench.frame(100.0)
    assert bench.loop.step()
    bench.frame(100.4, x_m=1.0)
    assert not bench.loop.step()
    bench.frame(100.5, x_m=1.0)
    assert bench.loop.step()
    assert bench.language.prompts[1][-1] == 100.5


def test_in_sync_mode_the_next_generation_sees_only_what_was_captured_by_a_standing_robot(clock: Clock) -> None:
    bench = Bench(clock=clock, mode=Mode.SYNC)
    bench.frame(100.0)
    assert bench.loop.step()
    for second, x_m in ((100.4, 0.28), (100.5, 0.36), (100.6, 0.40), (100.7, 0.415)):
        bench.frame(second, x_m=x_m)
        assert not bench.loop.step()
    bench.frame(100.8, x_m=0.42)
    assert bench.loop.step()
    assert bench.language.prompts[1][-1] == 100.8


# Failures


def test_a_failed_generation_is_counted_and_a_later_frame_is_tried(bench: Bench, clock: Clock) -> None:
    bench.language.broken = 1
    bench.frame(2.0)
    assert not bench.loop.step()
    assert (bench.cycle.failed, bench.cycle.published) == (1, 0)
    clock.s += 1.0
    assert not bench.loop.step()
    bench.frame(3.0)
    assert bench.loop.step()


def test_failures_in_quick_succession_end_reasoning_for_good(bench: Bench, clock: Clock) -> None:
    bench.language.broken = FAILURES
    for second in range(FAILURES):
        assert bench.cycle.failure is None
        clock.s += 10.0
        bench.frame(float(second))
        bench.loop.step()
    assert bench.cycle.failure is not None and "language_model: broken" in bench.cycle.failure
    assert len(bench.said) == 1
    clock.s += 1000.0
    bench.frame(99.0)
    assert not bench.loop.step()
