"""The bridge's rules on a fake clock: one rule a test."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.core.link import Arm, Stop, Velocity
from firmware_bridge.core.step_types import Move, Stand, StopMotion
from firmware_bridge.unitree.messages import ids
from tests.support.robot.bridge_bench import BRIDGE, LIMITS, MS, ZERO, Bench


class TestDisarmed:
    def test_nothing_is_sent(self) -> None:
        bench = Bench()
        bench.drive(2000)
        bench.step(Stop())
        bench.client = False
        bench.wait(1000)
        bench.step(shutdown=True)
        assert bench.written == []
        assert bench.status.state == "disarmed"

    def test_commands_are_counted_as_rejected(self) -> None:
        bench = Bench()
        bench.command()
        assert bench.status.rejected == 1


class TestArming:
    def test_a_lying_robot_is_stood_up_call_by_call_and_each_is_confirmed(self) -> None:
        bench = Bench(mode=ids.MODE_LIE_DOWN)
        bench.ask_to_arm()
        bench.wait(1500)
        assert bench.calls() == [ids.STAND_UP]
        bench.mode = ids.MODE_JOINT_LOCK
        bench.wait(100)
        assert bench.calls() == [ids.STAND_UP, ids.BALANCE_STAND]
        assert bench.status.state == "arming"
        bench.mode = ids.MODE_BALANCE_STAND
        bench.wait(40)
        assert bench.status.state == "armed"

    def test_a_damped_robot_gets_recovery_stand(self) -> None:
        bench = Bench(mode=ids.MODE_DAMPING)
        bench.ask_to_arm()
        assert bench.calls() == [ids.RECOVERY_STAND]

    def test_a_robot_that_another_client_drives_is_stopped_first(self) -> None:
        bench = Bench(mode=ids.MODE_LOCOMOTION)
        bench.ask_to_arm()
        assert set(bench.calls()) == {ids.STOP_MOVE}

    def test_a_call_without_effect_is_repeated(self) -> None:
        bench = Bench(mode=ids.MODE_LIE_DOWN)
        bench.ask_to_arm()
        bench.wait(7000)
        assert bench.calls() == [ids.STAND_UP] * 3

    def test_it_gives_up_with_a_reason(self) -> None:
        bench = Bench(mode=ids.MODE_LIE_DOWN)
        bench.ask_to_arm()
        bench.wait(10_100)
        assert bench.status.state == "disarmed"
        assert bench.status.reason == "arm refused: the robot is in mode 5, not ready after 10 s"

    def test_a_new_attempt_starts_from_the_beginning(self) -> None:
        bench = Bench(mode=ids.MODE_LIE_DOWN)
        bench.ask_to_arm()
        bench.wait(10_100)
        bench.written.clear()
        bench.ask_to_arm()
        assert bench.calls() == [ids.STAND_UP]

    def test_without_the_robots_state_nothing_is_sent_and_it_gives_up(self) -> None:
        bench = Bench(mode=None)
        bench.ask_to_arm()
        bench.wait(10_100)
        assert bench.written == []
        assert bench.status.reason == "arm refused: the robot reports no state after 10 s"

    def test_an_old_state_does_not_arm(self) -> None:
        bench = Bench()
        bench.step()
        bench.mode = None
        bench.now_ns += 1001 * MS
        bench.ask_to_arm()
        assert bench.status.state == "arming"

    def test_commands_while_arming_do_not_move_the_robot_afterwards(self) -> None:
        bench = Bench(mode=ids.MODE_JOINT_LOCK)
        bench.ask_to_arm()
        bench.drive(300)
        bench.mode = ids.MODE_BALANCE_STAND
        bench.wait(90)
        assert bench.status.state == "armed"
        assert set(bench.moves()) == {ZERO}

    def test_stopping_while_arming_sends_a_stop_move(self) -> None:
        bench = Bench(mode=ids.MODE_LIE_DOWN)
        bench.ask_to_arm()
        bench.step(Stop())
        assert bench.calls() == [ids.STAND_UP, ids.STOP_MOVE]
        assert bench.status.state == "stopped"

    def test_stopping_before_anything_was_sent_stays_silent(self) -> None:
        bench = Bench(mode=None)
        bench.step(Arm())
        bench.step(Stop())
        bench.wait(500)
        assert bench.written == []


class TestArmed:
    def test_zero_goes_out_until_the_first_command(self) -> None:
        bench = Bench().arm()
        bench.wait(100)
        assert set(bench.moves()) == {ZERO}

    def test_commands_go_out_at_the_bridges_own_rate(self) -> None:
        bench = Bench().arm()
        bench.drive(1000)
        assert len(bench.moves()) == pytest.approx(50, abs=2)

    def test_a_stall_of_the_bridge_is_not_made_up_for_by_a_burst(self) -> None:
        bench = Bench().arm()
        bench.command()
        bench.now_ns += 190 * MS
        before = len(bench.moves())
        bench.wait(25)
        assert len(bench.moves()) - before == 2

    def test_arming_again_changes_nothing(self) -> None:
        bench = Bench().arm()
        bench.drive(1000)
        bench.step(Arm())
        bench.wait(20)
        assert bench.status.state == "armed"
        assert bench.moves()[-1].vx_mps == 0.5

    def test_zero_after_stop_is_not_claimed(self) -> None:
        assert not Bench().arm().status.zero_after_stop

    def test_speeding_up_is_limited(self) -> None:
        bench = Bench().arm()
        bench.drive(1000, vx=0.8)
        speeds = [move.vx_mps for move in bench.moves()]
        steps = [b - a for a, b in pairwise(speeds)]
        assert max(steps) == pytest.approx(LIMITS.accel_mps2 / BRIDGE.rate_hz)
        assert speeds[-1] == 0.8

    def test_slowing_down_is_not_limited(self) -> None:
        bench = Bench().arm()
        bench.drive(1000, vx=0.8)
        bench.command(0.0)
        bench.wait(20)
        assert bench.moves()[-1] == ZERO

    def test_reversing_passes_through_no_jump(self) -> None:
        bench = Bench().arm()
        bench.drive(1000, vx=0.8)
        bench.command(-0.4)
        bench.wait(20)
        assert bench.moves()[-1].vx_mps == pytest.approx(-LIMITS.accel_mps2 / BRIDGE.rate_hz)

    @given(st.lists(st.tuples(*[st.floats(allow_nan=True, allow_infinity=True)] * 3, st.integers(0, 120)), max_size=30))
    def test_every_command_stays_within_limits_and_slew(self, commands: list) -> None:
        bench = Bench().arm()
        for vx, vy, wz, ms in commands:
            bench.command(vx, vy, wz)
            bench.wait(ms)
        previous = ZERO
        for move in bench.moves():
            assert LIMITS.vx_min_mps <= move.vx_mps <= LIMITS.vx_max_mps
            assert abs(move.vy_mps) <= LIMITS.vy_max_mps
            assert abs(move.wz_radps) <= LIMITS.wz_max_radps
            assert abs(move.vx_mps) <= abs(previous.vx_mps) + LIMITS.accel_mps2 / BRIDGE.rate_hz + 1e-12
            assert abs(move.wz_radps) <= abs(previous.wz_radps) + LIMITS.alpha_radps2 / BRIDGE.rate_hz + 1e-12
            previous = move


class TestGate:
    @pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
    @pytest.mark.parametrize("axis", [0, 1, 2])
    def test_a_command_that_is_not_finite_is_absent(self, bad: float, axis: int) -> None:
        bench = Bench().arm()
        velocity = [0.1, 0.1, 0.1]
        velocity[axis] = bad
        for _ in range(4):
            bench.command(*velocity)
            bench.wait(100)
        assert bench.status.state == "stopped"
        assert set(bench.moves()) == {ZERO}

    def test_a_command_older_than_the_deadman_is_rejected(self) -> None:
        bench = Bench().arm()
        bench.step(Velocity(1, bench.now_ns - 251 * MS, 0.5, 0.0, 0.0))
        assert bench.status.rejected == 1

    def test_a_command_from_the_future_is_rejected(self) -> None:
        bench = Bench().arm()
        bench.step(Velocity(1, bench.now_ns + 1, 0.5, 0.0, 0.0))
        assert bench.status.rejected == 1

    @pytest.mark.parametrize("second", [7, 6, 0])
    def test_a_sequence_number_that_does_not_increase_is_rejected(self, second: int) -> None:
        bench = Bench().arm()
        bench.step(Velocity(7, bench.now_ns, 0.5, 0.0, 0.0), Velocity(second, bench.now_ns, 0.1, 0.0, 0.0))
        assert (bench.status.rejected, bench.status.last_seq) == (1, 7)

    def test_numbering_starts_again_with_a_new_connection(self) -> None:
        bench = Bench().arm()
        bench.step(Velocity(1000, bench.now_ns, 0.5, 0.0, 0.0))
        bench.client = False
        bench.step()
        bench.client = True
        bench.step(Arm())
        bench.step(Velocity(1, bench.now_ns, 0.5, 0.0, 0.0))
        assert bench.status.last_seq == 1

    def test_repeating_one_command_does_not_feed_the_deadman(self) -> None:
        bench = Bench().arm()
        stale = Velocity(1, bench.now_ns, 0.5, 0.0, 0.0)
        for _ in range(30):
            bench.step(stale)
            bench.wait(10)
        assert bench.status.state == "stopped"

    def test_a_status_from_the_client_is_rejected(self) -> None:
        bench = Bench().arm()
        bench.step(bench.status)
        assert bench.status.rejected == 1


def _deadman(bench: Bench) -> None:
    bench.wait(251)


def _client_lost(bench: Bench) -> None:
    bench.client = False
    bench.step()


def _stop_message(bench: Bench) -> None:
    bench.step(Stop())


def _shutdown(bench: Bench) -> None:
    bench.step(shutdown=True)


def _robot_damped(bench: Bench) -> None:
    bench.mode = ids.MODE_DAMPING
    bench.step()


def _robot_silent(bench: Bench) -> None:
    bench.mode = None
    bench.drive(1200)


@pytest.mark.parametrize("cause", [_deadman, _client_lost, _stop_message, _shutdown, _robot_damped, _robot_silent])
class TestEveryStop:
    """Whatever the cause: the same stop."""

    def test_a_zero_move_and_then_a_stop_move_go_out_first(self, cause) -> None:
        bench = Bench().arm()
        bench.drive(500)
        cause(bench)
        where = [request for _, request in bench.written].index(StopMotion())
        assert bench.written[where - 1][1] == ZERO
        assert bench.status.zero_after_stop

    def test_zeros_go_on_for_ever_and_nothing_else(self, cause) -> None:
        bench = Bench().arm()
        bench.drive(500)
        cause(bench)
        bench.written.clear()
        bench.drive(10_000)  # a client that goes on commanding
        assert set(bench.moves()) == {ZERO}
        assert len(bench.moves()) == pytest.approx(500, abs=5)
        assert bench.calls() == []

    def test_it_latches_until_an_explicit_arm(self, cause) -> None:
        bench = Bench().arm()
        bench.drive(500)
        cause(bench)
        bench.mode, bench.client = ids.MODE_BALANCE_STAND, True
        bench.drive(1000)
        assert bench.status.state == "stopped"
        bench.step(Arm())
        bench.drive(200)
        assert bench.status.state == "armed"
        assert bench.moves()[-1].vx_mps > 0


class TestDeadman:
    def test_the_wire_is_zero_when_the_last_good_command_is_250_ms_old(self) -> None:
        bench = Bench().arm()
        bench.drive(500)
        bench.command()
        last_ns = bench.now_ns
        bench.wait(400)
        first_zero_ns = next(t for t, request in bench.written if request == ZERO and t > last_ns)
        assert 250 * MS <= first_zero_ns - last_ns <= 251 * MS

    def test_it_counts_from_when_the_command_was_computed(self) -> None:
        bench = Bench().arm()
        stamp_ns = bench.now_ns
        bench.now_ns += 200 * MS
        bench.step(Velocity(1, stamp_ns, 0.5, 0.0, 0.0))
        bench.now_ns = stamp_ns + 251 * MS
        bench.step()
        assert bench.status.state == "stopped"

    def test_an_armed_bridge_that_never_gets_a_command_stops(self) -> None:
        bench = Bench().arm()
        bench.wait(260)
        assert bench.status.state == "stopped"

    def test_a_queue_of_old_commands_after_a_suspended_runner_is_refused(self) -> None:
        bench = Bench().arm()
        bench.drive(300)
        queued = [Velocity(1000 + i, bench.now_ns + i * 100 * MS, 0.5, 0.0, 0.0) for i in range(5)]
        bench.wait(2000)
        bench.written.clear()
        bench.step(*queued)
        bench.wait(200)
        assert set(bench.moves()) == {ZERO}


class TestRearming:
    def test_it_needs_a_fresh_state(self) -> None:
        bench = Bench().arm()
        bench.step(Stop())
        bench.mode = None
        bench.wait(1100)
        bench.step(Arm())
        assert bench.status.state == "arming"
        bench.wait(10_100)
        assert bench.status.state == "stopped"
        assert bench.status.reason.startswith("arm refused")

    def test_zeros_go_on_while_it_waits(self) -> None:
        bench = Bench().arm()
        bench.step(Stop())
        bench.mode = ids.MODE_LIE_DOWN
        bench.step(Arm())
        bench.written.clear()
        bench.wait(1000)
        assert len(bench.moves()) == pytest.approx(50, abs=2)


@given(
    st.lists(
        st.one_of(
            st.just("arm"), st.just("stop"), st.just("lost"), st.just("back"), st.just("shutdown"),
            st.tuples(st.just("mode"), st.integers(0, 13)),
            st.tuples(st.just("go"), st.floats(-2, 2)),
            st.tuples(st.just("wait"), st.integers(1, 400)),
        ),
        max_size=40,
    )
)  # fmt: skip
def test_no_order_of_events_moves_the_robot_300_ms_after_the_last_good_command(events: list) -> None:
    bench = Bench()
    good_ns = -(10**18)
    for event in events:
        if event == "arm":
            bench.step(Arm())
        elif event == "stop":
            bench.step(Stop())
        elif event in ("lost", "back"):
            bench.client = event == "back"
            bench.step()
        elif event == "shutdown":
            bench.step(shutdown=True)
        elif event[0] == "mode":
            bench.mode = event[1]
        elif event[0] == "go":
            bench.command(event[1])
            good_ns = bench.now_ns
        else:
            bench.wait(event[1])
        for t, request in bench.written:
            assert request == ZERO or not isinstance(request, Move) or t - good_ns <= 300 * MS
            assert not isinstance(request, Stand) or request.step in ids.BRIDGE_ALLOWED
        bench.written.clear()
