"""The control loop: one tick from frame to command, with the semantic state's own anchor, waiting for nobody."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from edge.core.geometry import SE2
from edge.motion.recovery import BACKING_OFF, TURNING
from edge.motion.turn_on_the_spot import TOLD
from edge.run.control_loop import ControlConfig
from edge.safety.faults.findings import Finding
from edge.safety.faults.table import FAULT_OF_CAUSE
from edge.state.pose_history import StampedPose
from edge.state.semantic import ToldTurn
from tests.support.runner.control_bench import LIMITS, PERIOD_NS, Bench


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_without_a_semantic_state_zero_is_sent_and_the_action_expert_is_not_run(bench: Bench) -> None:
    bench.see()
    assert bench.tick() == (0.0, "no-semantic-state")
    assert bench.policy.calls == []
    assert bench.sink.commands == [(8, 0.0, 0.0)]


def test_the_delay_is_now_minus_the_anchor_and_the_offset_is_the_motion_since(bench: Bench) -> None:
    bench.see(x_m=1.0)
    bench.think(0, x_m=1.0)
    bench.tick()
    bench.now_ns += 2_000_000_000 - PERIOD_NS
    bench.see(x_m=1.8)
    bench.tick()
    delay_s, offset, _ = bench.policy.calls[-1]
    assert delay_s == pytest.approx(2.0)
    assert offset.x_m == pytest.approx(0.8)
    assert (bench.loop.statistics.delay_error_ms.newest or 0.0) < 1.0


def test_the_delay_is_taken_when_the_action_expert_is_called_not_when_the_tick_began(bench: Bench) -> None:
    bench.see()
    bench.think(0)
    bench.encode_ns = 40_000_000
    bench.tick()
    assert bench.policy.calls[-1][0] == pytest.approx(0.040)


@pytest.mark.parametrize(("pauses_ms", "error_ms"), [((3.0,), 0.0), ((3.0, 3.0), 0.0), ((3.0, 3.0, 3.0, 3.0), 3.0)])
def test_a_thread_that_loses_the_processor_takes_the_delay_again(
    bench: Bench, pauses_ms: tuple[float, ...], error_ms: float
) -> None:
    bench.see()
    bench.think(0)
    state = bench.slot.state
    assert state is not None
    pauses, now_ns = list(pauses_ms), bench.now_ns

    def clock() -> int:
        """Every second reading comes after a pause."""
        nonlocal now_ns, read
        read += 1
        now_ns += round((pauses.pop(0) if read % 2 == 0 and pauses else 0.0) * 1e6)
        return now_ns

    read = 0
    latency, then_ns, called_ns = state.latency_input_at_call(clock, SE2(0.0, 0.0, 0.0), 10.0)
    assert (called_ns - then_ns) / 1e6 == error_ms and latency.delay_s == state.delay_s(then_ns)


def test_a_frame_is_encoded_once_however_often_it_is_used(bench: Bench) -> None:
    bench.see()
    bench.tick()
    bench.tick()
    assert bench.policy.encoded == 1
    bench.see()
    bench.tick()
    assert bench.policy.encoded == 2


def test_every_encoded_frame_is_left_for_the_reasoning_thread_with_its_pose(bench: Bench) -> None:
    bench.see(x_m=3.0)
    bench.tick()
    assert bench.frame is not None
    newest = bench.ring.nearest(bench.frame.stamp_ns)
    assert newest is not None
    assert newest.stamp_ns == bench.frame.stamp_ns
    assert newest.T_odom_base == SE2(3.0, 0.0, 0.0)


def test_a_bridge_that_has_gone_silent_ends_the_loop(bench: Bench) -> None:
    bench.see()
    bench.sink.silent_ns = 700_000_000
    assert bench.loop.run(bench.now_ns, None) == "no status from it for 0.7 s"


def test_a_broken_action_expert_stops_the_robot_and_not_the_loop(bench: Bench) -> None:
    bench.see()
    bench.think(0)
    bench.tick()
    bench.policy.broken = True
    bench.see()
    assert bench.tick() == (0.0, "output-not-finite")


def test_a_late_tick_is_counted_and_the_deadlines_it_slept_over_are_skipped(bench: Bench) -> None:
    bench.see()
    send = bench.sink.send_velocity

    def slow_send(*args: float) -> bool:
        bench.now_ns += 250_000_000
        bench.stop.set()
        return send(*args)  # type: ignore[arg-type]

    bench.sink.send_velocity = slow_send  # type: ignore[method-assign]
    bench.loop.run(bench.now_ns, None)
    assert bench.loop.statistics.missed == 2
    assert bench.loop.statistics.tick_ms.newest == 250.0
    assert bench.on_time == [False]


def test_the_action_expert_never_receives_a_delay_beyond_its_training_range(bench: Bench) -> None:
    bench.see()
    bench.think(age_s=12.0)
    bench.tick()
    assert bench.policy.calls[-1][0] == 10.0
    assert bench.loop.statistics.delay_s.newest == pytest.approx(12.0)


def test_the_robot_stands_while_it_thinks_in_a_mode_that_takes_turns(bench: Bench) -> None:
    bench.drive()
    bench.slot.drive_until_ns = bench.now_ns
    bench.see()
    assert bench.tick() == (0.0, "reasoning")
    bench.slot.drive_until_ns = bench.now_ns + PERIOD_NS
    bench.see()
    assert bench.tick()[1] == "ok"


def test_a_supervisor_that_has_stopped_the_run_ends_the_loop_after_a_zero(bench: Bench) -> None:
    bench.drive()
    bench.attitude.roll_rad = 1.0
    bench.see()
    said = bench.loop.run(bench.now_ns, None)
    assert bench.loop.ended_by == "supervisor"
    assert said is not None and said.startswith("The robot leans by more than 30°")
    assert bench.sink.commands[-1][1:] == (0.0, 0.0)


@pytest.mark.parametrize(("cause", "fault"), sorted(FAULT_OF_CAUSE.items()))
def test_a_bridge_that_has_stopped_the_robot_ends_the_loop_with_the_fault(bench: Bench, cause: str, fault: str) -> None:
    bench.see()
    bench.sink.state, bench.sink.cause = "stopped", cause
    assert bench.loop.run(bench.now_ns, None) == "deadman"
    assert bench.loop.statistics.ticks == 1
    assert bench.loop.ended_by == "bridge"
    assert bench.loop.supervision.active[0] == fault


def test_a_stop_that_the_runner_requested_is_no_fault(bench: Bench) -> None:
    bench.see()
    bench.sink.state, bench.sink.cause = "stopped", "client_stop"
    bench.loop.run(bench.now_ns, None)
    assert not bench.loop.supervision.stop


def test_findings_from_before_arming_do_not_count(bench: Bench) -> None:
    bench.drive()
    bench.findings.put((Finding("odometry-jump"), Finding("odometry-jump")))
    bench.malformed = 3
    bench.see()
    bench.stop.wait = lambda _seconds: bool(bench.on_time)  # type: ignore[method-assign,assignment]
    assert bench.loop.run(bench.now_ns, None) is None
    assert bench.loop.supervision.active == ()


def test_a_stuck_robot_backs_off_and_speeds_up_from_standing(bench: Bench) -> None:
    said, x_m = [], 0.0
    for _ in range(80):
        bench.history.put(StampedPose(bench.now_ns, SE2(x_m, 0.0, 0.0), 0.0, 0.0, 0.0))
        bench.look()
        bench.think(0)
        said.append(bench.tick())
        x_m = min(x_m + 0.1 * said[-1][0], 1.0)  # there is a wall
    reasons = [reason for _, reason in said]
    first = reasons.index(BACKING_OFF)
    after = first + reasons[first:].index("ok")
    assert all(-0.2 <= speed <= 0.0 for speed, reason in said if reason == BACKING_OFF)
    assert bench.loop.statistics.reasons[BACKING_OFF] == reasons.count(BACKING_OFF) >= 10
    assert set(reasons[:first]) == {"ok"} and said[after][0] > 0


def stand_and_hear(bench: Bench, text: str, ticks: int) -> list[tuple[str, float]]:
    """A robot that has stood since it came to (1 m, 0), after words that were said at (0, 0): reasons and yaw rates."""
    bench.policy.step, theta_rad, said = (0.0, 0.0, 0.0), 0.0, []
    for k in range(ticks):
        bench.history.put(StampedPose(bench.now_ns, SE2(1.0, 0.0, theta_rad), 0.0, 0.0, 0.0))
        bench.look()
        bench.think(k // 20, x_m=0.0, text=text)
        _, reason = bench.tick()
        said.append((reason, bench.sink.commands[-1][2]))
        theta_rad += 0.1 * said[-1][1]
    return said


def test_a_robot_whose_plan_stands_turns_to_where_its_text_leads_and_speeds_up_from_standing() -> None:
    bench = Bench(limits=dataclasses.replace(LIMITS, accel_mps2=1.0))
    said = stand_and_hear(bench, "Plan: go on.\nwaypoints: (1.0, -1.0) (1.0, -2.0) (1.0, -4.0)", 100)
    reasons = [reason for reason, _ in said]
    assert reasons.index(TURNING) == pytest.approx(50, abs=1) and set(reasons) == {"ok", TURNING}
    assert sum(rate for _, rate in said) * 0.1 == pytest.approx(-np.pi / 2, abs=0.2)
    bench.policy.step = (0.05, 0.0, 0.0)
    bench.see(x_m=1.0)
    assert bench.tick() == (pytest.approx(0.1), "ok")


def test_a_robot_makes_the_turn_that_it_is_told_before_anything_drives_it(bench: Bench) -> None:
    turn, heading_rad = ToldTurn(math.pi), 0.0
    bench.see()
    bench.think(0)
    bench.tick()
    bench.slot.tell(turn)
    for _ in range(100):
        bench.history.put(StampedPose(bench.now_ns, SE2(0.04, 0.0, heading_rad), 0.0, 0.0, 0.0))
        bench.look()
        vx_mps, reason = bench.tick()
        if reason != TOLD:
            break
        assert vx_mps == 0.0
        heading_rad += bench.sink.commands[-1][2] * PERIOD_NS / 1e9
    assert (reason, bench.slot.turn, bench.slot.state) == ("no-semantic-state", None, None)
    assert heading_rad == pytest.approx(math.pi, abs=0.1)
    bench.think(1)
    bench.see()
    assert bench.tick()[1] == "ok"
    assert 0.0 < bench.sink.commands[-1][1] <= LIMITS.accel_mps2 * PERIOD_NS / 1e9, "from a standstill"


def test_a_text_that_is_published_during_a_turn_drives_neither_then_nor_after_it(bench: Bench) -> None:
    turn = ToldTurn(math.pi)
    bench.slot.tell(turn)
    bench.think(0)  # it was on its way when the turn was told
    bench.see()
    assert bench.tick() == (0.0, TOLD) and bench.policy.calls == []
    bench.slot.end(turn)
    bench.see()
    assert bench.tick() == (0.0, "no-semantic-state")


def test_another_instruction_ends_a_turn_that_is_under_way(bench: Bench) -> None:
    bench.see()
    bench.think(0)
    assert bench.tick()[1] == "ok"
    bench.slot.tell(ToldTurn(math.pi))
    bench.see()
    assert bench.tick()[1] == TOLD
    bench.slot.tell(None)
    bench.see()
    assert bench.tick() == (0.0, "no-semantic-state")


def test_a_text_that_waits_for_a_person_leaves_the_robot_standing() -> None:
    text = "Plan: wait, then turn right.\nwaypoints: (1.0, -1.0) (1.0, -2.0) (1.0, -4.0)"
    assert {reason for reason, _ in stand_and_hear(Bench(), text, 100)} == {"ok"}


@pytest.mark.parametrize(("age_s", "given_s"), [(-0.5, 0.0), (0.0, 0.0), (4.0, 4.0), (10.0, 10.0), (13.0, 10.0)])
def test_the_policys_delay_input_is_between_zero_and_what_it_was_trained_for(
    bench: Bench, age_s: float, given_s: float
) -> None:
    bench.see()
    bench.think(age_s=age_s)
    state = bench.slot.state
    assert state is not None
    assert state.latency_input(bench.now_ns, SE2(0.0, 0.0, 0.0), 10.0).delay_s == pytest.approx(given_s)


@pytest.mark.parametrize(
    ("period_ns", "step_s", "trained_s"), [(0, 0.1, 10.0), (1, 0.0, 10.0), (1, math.nan, 10.0), (1, 0.1, math.inf)]
)
def test_a_rate_or_limit_that_cannot_be_is_refused(period_ns: int, step_s: float, trained_s: float) -> None:
    with pytest.raises(ValueError, match="expected a period, step and trained delay above 0"):
        ControlConfig(period_ns, step_s, trained_s)
