"""The pure generation cycle on a clock of its own: each property over arbitrary sequences of inputs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.geometry import SE2
from edge.reasoning.generation_cycle import (
    FAILURE_WINDOW_S,
    FAILURES,
    RETRY_S,
    SYNC_DRIVE_S,
    Action,
    Anchored,
    Cancelled,
    CycleInputs,
    CycleOutputs,
    Event,
    Failed,
    Finished,
    FrameMissed,
    GenerationCycle,
    Mode,
    ReasoningBudget,
    ReasoningConfig,
    seen_standing,
)

TOKENS = 8
ENDS = ("anchored", "missed", "cancelled", "failed", "finished", "nothing")


@dataclass(frozen=True)
class Draw:
    """What happens between two steps of the cycle."""

    wait_ms: int
    new_frame: bool
    moved_m: float
    budget: ReasoningBudget
    new_request: bool
    stopping: bool
    event: str
    delay_ms: int
    new_tokens: int
    has_waypoints: bool


@dataclass(frozen=True)
class Step:
    """One step of the cycle: when, what it was given, what it answered."""

    now_ns: int
    inputs: CycleInputs
    outputs: CycleOutputs
    failure: str | None


BUDGETS = st.builds(
    ReasoningBudget,
    allowed=st.sampled_from([True, True, True, False]),
    pause_s=st.sampled_from([0.0, 0.0, 3.0]),
    max_new_tokens=st.sampled_from([None, None, 0, 3, TOKENS, 50]),
)
CHOICES: dict[str, st.SearchStrategy[object]] = {
    "wait_ms": st.sampled_from([0, 10, 100, 400, 600, 20_000]),
    "new_frame": st.sampled_from([True, True, False]),
    "moved_m": st.sampled_from([0.0, 0.0, 0.5]),
    "budget": BUDGETS,
    "new_request": st.sampled_from([False] * 5 + [True]),
    "stopping": st.sampled_from([False] * 9 + [True]),
    "event": st.sampled_from(ENDS),
    "delay_ms": st.sampled_from([0, 50, 900]),
    "new_tokens": st.integers(0, TOKENS),
    "has_waypoints": st.booleans(),
}
DRAWS = st.builds(Draw, **CHOICES)
HEALTHY: dict[str, object] = {"new_frame": True, "moved_m": 0.0, "budget": ReasoningBudget(), "new_request": False}
FAILING = st.builds(
    lambda wait_ms: Draw(wait_ms, **HEALTHY, stopping=False, event="failed", delay_ms=0, new_tokens=0,
                         has_waypoints=False),  # type: ignore[arg-type]
    st.integers(300, 20_000),
)  # fmt: skip
MODES = st.sampled_from(list(Mode))


def run(mode: Mode, draws: list[Draw], *, needs_waypoints: bool = False) -> tuple[GenerationCycle, list[Step]]:
    """Step a cycle through the draws; a running generation reports events in an order that a shell could."""
    cycle = GenerationCycle(ReasoningConfig((0.0, 3.0), TOKENS, mode))
    now_ns, x_m, request = 10**12, 0.0, 0
    frames: list[tuple[int, SE2]] = []
    running, steps = False, []
    for draw in draws:
        now_ns += draw.wait_ms * 1_000_000
        if draw.new_frame and (not frames or frames[-1][0] < now_ns):
            x_m += draw.moved_m
            frames = [*frames[-1:], (now_ns, SE2(x_m, 0.0, 0.0))]
        request += draw.new_request
        event = event_of(draw, frames, now_ns, needs_waypoints) if running else None
        inputs = CycleInputs(tuple(frames), request, draw.budget, draw.stopping, event)
        outputs = cycle.step(inputs, now_ns)
        running = outputs.action in (Action.START, Action.CONTINUE, Action.INTERRUPT)
        steps.append(Step(now_ns, inputs, outputs, cycle.failure))
    return cycle, steps


def event_of(draw: Draw, frames: list[tuple[int, SE2]], now_ns: int, needs_waypoints: bool) -> Event | None:
    match draw.event:
        case "anchored":
            return Anchored(frames[-1][0])
        case "missed":
            return FrameMissed(frames[-1][0])
        case "cancelled":
            return Cancelled()
        case "failed":
            return Failed("broken")
        case "finished":
            release_ns = now_ns + draw.delay_ms * 1_000_000
            return Finished(release_ns, draw.new_tokens, draw.has_waypoints, needs_waypoints)
    return None


def starts(steps: list[Step]) -> list[Step]:
    return [step for step in steps if step.outputs.action is Action.START]


def stamps(steps: list[Step], kind: type[Event]) -> list[int]:  # type: ignore[valid-type]
    """When events of a kind were reported, ns."""
    return [step.now_ns for step in steps if isinstance(step.inputs.event, kind)]


@pytest.mark.slow
@given(MODES, st.lists(DRAWS, max_size=60))
def test_nothing_starts_while_the_budget_forbids_it_or_the_run_ends(mode: Mode, draws: list[Draw]) -> None:
    for step in starts(run(mode, draws)[1]):
        assert step.inputs.budget.allowed and not step.inputs.stopping


@pytest.mark.slow
@given(MODES, st.lists(DRAWS, max_size=60))
def test_no_frame_is_the_newest_of_two_generations(mode: Mode, draws: list[Draw]) -> None:
    used_ns = -1
    for step in run(mode, draws)[1]:
        if step.outputs.action is Action.START:
            assert step.inputs.frames[-1][0] > used_ns
        if isinstance(step.inputs.event, Anchored):
            used_ns = step.inputs.event.stamp_ns
        elif isinstance(step.inputs.event, FrameMissed) and step.inputs.event.newest_ns is not None:
            used_ns = step.inputs.event.newest_ns


@pytest.mark.slow
@given(MODES, st.lists(DRAWS, max_size=60))
def test_a_failed_generation_is_followed_by_a_pause(mode: Mode, draws: list[Draw]) -> None:
    failed_ns = -math.inf
    for step in run(mode, draws)[1]:
        if isinstance(step.inputs.event, Failed):
            failed_ns = step.now_ns
        if step.outputs.action is Action.START:
            assert step.now_ns - failed_ns >= RETRY_S * 1e9


@pytest.mark.slow
@given(MODES, st.lists(DRAWS, max_size=60))
def test_the_budgets_pause_follows_a_finished_generation(mode: Mode, draws: list[Draw]) -> None:
    finished_ns = -math.inf
    for step in run(mode, draws)[1]:
        if isinstance(step.inputs.event, Finished):
            finished_ns = step.now_ns
        if step.outputs.action is Action.START:
            assert step.now_ns - finished_ns >= step.inputs.budget.pause_s * 1e9


@given(st.lists(FAILING, max_size=40))
def test_reasoning_ends_exactly_when_so_many_generations_fail_within_the_window(draws: list[Draw]) -> None:
    steps = run(Mode.ASYNC, draws)[1]
    failed_ns = stamps(steps, Failed)
    crowded = any(
        last - first <= FAILURE_WINDOW_S * 1e9
        for first, last in zip(failed_ns, failed_ns[FAILURES - 1 :], strict=False)
    )
    assert (bool(steps) and steps[-1].failure is not None) == crowded


@pytest.mark.slow
@given(MODES, st.lists(st.one_of(FAILING, DRAWS), max_size=60))
def test_nothing_starts_after_reasoning_has_ended(mode: Mode, draws: list[Draw]) -> None:
    ended = False
    for step in run(mode, draws)[1]:
        assert not (ended and step.outputs.action is Action.START)
        ended = ended or step.failure is not None
        assert ended == (step.failure is not None), "the latch is never released"


@pytest.mark.slow
@given(MODES, st.lists(DRAWS, max_size=60), st.booleans())
def test_a_result_is_published_at_its_release_time_and_never_for_an_older_request(
    mode: Mode, draws: list[Draw], needs_waypoints: bool
) -> None:
    started = finished = None
    for step in run(mode, draws, needs_waypoints=needs_waypoints)[1]:
        if isinstance(step.inputs.event, Finished):
            finished = step.inputs.event
        if step.outputs.action is Action.PUBLISH:
            assert started is not None and finished is not None
            assert step.now_ns >= finished.release_ns
            assert step.inputs.request == started.inputs.request and not step.inputs.stopping
            assert finished.has_waypoints or not needs_waypoints
        elif step.outputs.action is Action.HOLD:
            assert finished is not None and step.now_ns < finished.release_ns
        elif step.outputs.action is Action.START:
            started, finished = step, None


@pytest.mark.slow
@given(MODES, st.lists(DRAWS, max_size=60))
def test_a_running_generation_is_interrupted_exactly_when_something_replaces_or_forbids_it(
    mode: Mode, draws: list[Draw]
) -> None:
    request = -1
    for step in run(mode, draws)[1]:
        if step.outputs.action is Action.START:
            request = step.inputs.request
        if step.outputs.action in (Action.CONTINUE, Action.INTERRUPT):
            inputs = step.inputs
            replaced = inputs.request != request or inputs.stopping or not inputs.budget.allowed
            assert (step.outputs.action is Action.INTERRUPT) == replaced


@pytest.mark.slow
@given(MODES, st.lists(DRAWS, max_size=60))
def test_the_text_is_limited_by_the_mode_and_the_budget_at_its_start(mode: Mode, draws: list[Draw]) -> None:
    for step in starts(run(mode, draws)[1]):
        cap = step.inputs.budget.max_new_tokens
        expected = 0 if mode is Mode.NO_REASONING else min(TOKENS, math.inf if cap is None else cap)
        assert step.outputs.max_new_tokens == expected


@pytest.mark.slow
@given(MODES, st.lists(DRAWS, max_size=60), st.booleans())
def test_every_generation_has_one_outcome(mode: Mode, draws: list[Draw], needs_waypoints: bool) -> None:
    draws = [Draw(**{**vars(draw), "stopping": False}) for draw in draws]
    cycle, steps = run(mode, draws, needs_waypoints=needs_waypoints)
    useless = cancelled_held = 0
    request = -1
    for step in steps:
        if step.outputs.action is Action.START:
            request = step.inputs.request
        if step.outputs.action is Action.DISCARD:
            cancelled_held += step.inputs.request != request
            useless += step.inputs.request == request
    under_way = bool(steps) and steps[-1].outputs.action in (
        Action.START, Action.CONTINUE, Action.INTERRUPT, Action.HOLD,
    )  # fmt: skip
    ended = cycle.published + cycle.failed + cycle.missed_frames + cycle.cancelled + useless
    assert len(starts(steps)) == ended + under_way
    assert cycle.cancelled == len(stamps(steps, Cancelled)) + cancelled_held


@pytest.mark.slow
@given(MODES, st.lists(DRAWS, max_size=60))
def test_only_sync_mode_limits_driving_and_each_result_extends_it_by_half_a_second(
    mode: Mode, draws: list[Draw]
) -> None:
    until_ns = 0 if mode is Mode.SYNC else None
    for step in run(mode, draws)[1]:
        if mode is Mode.SYNC and step.outputs.action is Action.PUBLISH:
            until_ns = step.now_ns + round(SYNC_DRIVE_S * 1e9)
        assert step.outputs.drive_until_ns == until_ns


@given(st.lists(DRAWS, max_size=60))
def test_in_sync_mode_a_generation_starts_only_after_the_halt(draws: list[Draw]) -> None:
    for step in starts(run(Mode.SYNC, draws)[1]):
        assert step.outputs.drive_until_ns is not None
        assert step.inputs.frames[-1][0] >= step.outputs.drive_until_ns


@pytest.mark.slow
@given(MODES, st.lists(DRAWS, max_size=60))
def test_a_text_that_was_cut_short_is_not_counted_as_invalid(mode: Mode, draws: list[Draw]) -> None:
    cycle, steps = run(mode, draws)
    invalid, cap, finished = 0, TOKENS, None
    for step in steps:
        if isinstance(step.inputs.event, Finished):
            finished = step.inputs.event
        if step.outputs.action is Action.START:
            cap = TOKENS if step.inputs.budget.max_new_tokens is None else step.inputs.budget.max_new_tokens
        if step.outputs.action is Action.PUBLISH:
            assert finished is not None
            complete = mode is not Mode.NO_REASONING and (cap >= TOKENS or finished.new_tokens < cap)
            assert step.outputs.text_complete == complete
            invalid += complete and not finished.has_waypoints
    assert cycle.invalid_texts == invalid


@pytest.mark.parametrize("offsets", [(-1.0,), (math.nan,), (math.inf,)])
def test_an_age_of_a_frame_that_cannot_be_is_refused(offsets: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="frame_offsets_s"):
        ReasoningConfig(offsets, TOKENS)


def test_a_negative_text_length_is_refused() -> None:
    with pytest.raises(ValueError, match="max_new_tokens"):
        ReasoningConfig((0.0,), -1)


# Sync mode: which frame may be the newest of a generation

HALT_NS = 5_000_000_000
TICK_NS = 100_000_000


def frames(after_ns: int, moved: SE2) -> list[tuple[int, SE2]]:
    """Two of them, 0.1 s apart, the newest so long after the halt."""
    there = SE2(3.0, -2.0, 2.5)
    return [(HALT_NS + after_ns - TICK_NS, there), (HALT_NS + after_ns, there @ moved)]


STILL = SE2(0.0, 0.0, 0.0)
COASTS = SE2(0.05, 0.0, 0.0)


@pytest.mark.parametrize(
    ("seen", "halted_ns", "stands"),
    [
        (frames(3 * TICK_NS, STILL), HALT_NS, True),
        (frames(3 * TICK_NS, SE2(0.009, 0.0, 0.0)), HALT_NS, True),  # 0.1 m/s
        (frames(3 * TICK_NS, SE2(0.011, 0.0, 0.0)), HALT_NS, False),
        (frames(3 * TICK_NS, SE2(0.0, -0.011, 0.0)), HALT_NS, False),
        (frames(3 * TICK_NS, SE2(0.0, 0.0, -0.019)), HALT_NS, True),  # 0.2 rad/s
        (frames(3 * TICK_NS, SE2(0.0, 0.0, 0.021)), HALT_NS, False),
        (frames(-1, STILL), HALT_NS, False),  # from before the halt
        (frames(10 * TICK_NS - 1, COASTS), HALT_NS, False),
        (frames(10 * TICK_NS, COASTS), HALT_NS, True),  # 1 s after the halt, whatever odometry reports
        (frames(TICK_NS, STILL)[1:], HALT_NS, False),  # one frame gives no speed
        (frames(0, COASTS), None, True),  # no halt
        ([], None, False),
    ],
)
def test_a_frame_is_of_a_standing_robot(seen: list[tuple[int, SE2]], halted_ns: int | None, stands: bool) -> None:
    assert seen_standing(seen, halted_ns) is stands
