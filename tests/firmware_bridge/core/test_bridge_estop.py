"""Emergency stops that hold until an operator takes them back, on a fake clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from firmware_bridge.core.link import Arm, Release, Stop, Velocity
from firmware_bridge.core.step_types import StopMotion
from firmware_bridge.unitree.messages import ids
from tests.support.robot.bridge_bench import MS, SAFETY, ZERO, Bench


def _operator(bench: Bench) -> None:
    bench.step(operator=(Stop(),))


def _remote_estop(bench: Bench) -> None:
    bench.step(remote_in_use=True, remote_estop=True)


def _local_estop(bench: Bench) -> None:
    bench.estop = True
    bench.step()


class TestOperator:
    def test_a_stop_holds_until_the_operator_takes_it_back(self) -> None:
        bench = Bench().arm()
        _operator(bench)
        bench.wait(60_000)
        bench.ask_to_arm()
        assert (bench.status.state, bench.status.blocked_by) == ("stopped", "estop")
        bench.permit().arm()

    def test_a_stop_beside_an_arm_in_one_step_stops_and_holds(self) -> None:
        for message in ((Stop(), Arm()), (Arm(), Stop()), (Stop(), Arm(), Arm())):
            bench = Bench().arm()
            bench.drive(500)
            bench.step(operator=message)
            assert (bench.status.state, bench.status.blocked_by) == ("stopped", "estop")
            assert bench.moves()[-1] == ZERO

    @pytest.mark.parametrize("press", [_remote_estop, _local_estop])
    def test_an_emergency_stop_that_ended_a_run_needs_an_operator_too(self, press: Callable[[Bench], None]) -> None:
        bench = Bench().arm()
        bench.drive(500)
        press(bench)
        bench.estop = False
        bench.wait(60_000)
        bench.ask_to_arm()
        assert (bench.status.state, bench.status.blocked_by) == ("stopped", "estop")
        bench.permit().arm()

    def test_taking_it_back_does_not_arm(self) -> None:
        bench = Bench()
        _operator(bench)
        bench.written.clear()
        bench.permit()
        bench.wait(1000)
        assert bench.status.state == "disarmed" and bench.written == []

    def test_only_the_runners_socket_commands(self) -> None:
        bench = Bench().arm()
        bench.step(operator=(Velocity(1, bench.now_ns, 0.5, 0.0, 0.0),))
        bench.wait(100)
        assert set(bench.moves()) == {ZERO}
        assert bench.status.rejected == 1


@pytest.mark.parametrize("held", [True, False])
def test_a_robot_that_drives_itself_is_stopped_each_second_while_the_local_input_is_held(held: bool) -> None:
    bench = Bench()
    _local_estop(bench)
    bench.estop = held
    bench.wait(2_000)
    bench.written.clear()
    for _ in range(160):
        bench.step(drives_itself=True)
        bench.now_ns += 20 * MS
    stops = [request for _, request in bench.written if isinstance(request, StopMotion)]
    assert stops == [StopMotion(pressed=True)] * 4 * held


def _disarmed() -> Bench:
    return Bench()


def _arming() -> Bench:
    bench = Bench(mode=ids.MODE_LIE_DOWN)
    bench.ask_to_arm()
    assert bench.status.state == "arming"
    return bench


def _driven() -> Bench:
    bench = Bench().arm()
    bench.drive(500)
    return bench


def _deadman() -> Bench:
    bench = _driven()
    bench.wait(1000)
    return bench


def _stopped_by_the_runner() -> Bench:
    bench = _driven()
    bench.step(Stop())
    return bench


def _stick_first() -> Bench:
    """L2 is pressed before B: the first key alone is a remote takeover."""
    bench = _driven()
    bench.step(remote_in_use=True)
    bench.wait(100)
    assert bench.status.cause == "remote_takeover"
    return bench


def _released() -> Bench:
    bench = _stopped_by_the_runner()
    bench.step(operator=(Release(),))
    return bench


STATES = [_disarmed, _arming, _driven, _deadman, _stopped_by_the_runner, _stick_first, _released]


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("press", [_operator, _remote_estop, _local_estop])
class TestLatch:
    """An emergency stop holds from every state of the bridge and needs a person."""

    def test_no_runner_arms_after_the_press_has_ended(self, state: Callable[[], Bench], press) -> None:
        bench = state()
        press(bench)
        bench.estop = False
        bench.mode = ids.MODE_BALANCE_STAND
        bench.wait(60_000)
        bench.written.clear()
        bench.ask_to_arm()
        bench.drive(1000)
        assert bench.status.blocked_by == "estop"
        assert set(bench.moves()) <= {ZERO}

    def test_an_operators_arm_for_a_waiting_runner_ends_it(self, state: Callable[[], Bench], press) -> None:
        bench = state()
        press(bench)
        bench.estop = False
        bench.mode = ids.MODE_BALANCE_STAND
        bench.wait(2_000)
        bench.permit().arm()
        assert bench.status.permit == "not needed"

    def test_it_is_handed_out_for_the_next_bridge_process(self, state: Callable[[], Bench], press) -> None:
        bench = state()
        press(bench)
        successor = Bench(latch=bench.step().latch)
        successor.ask_to_arm()
        assert successor.status.blocked_by == "estop"
        assert successor.status.reason.startswith("arm refused: waiting for an operator")


class TestPermission:
    """An operator's arm after an emergency stop."""

    def held(self) -> Bench:
        bench = Bench().arm()
        _operator(bench)
        bench.wait(2_000)
        return bench

    @pytest.mark.parametrize(("after_ms", "permit"), [(20, "needed"), (1_900, "needed"), (2_000, "given")])
    @pytest.mark.parametrize("press", [_operator, _remote_estop, _local_estop])
    def test_one_that_was_entered_before_the_stop_and_comes_after_it_is_refused(
        self, press: Callable[[Bench], None], after_ms: int, permit: str
    ) -> None:
        bench = Bench().arm()
        press(bench)
        bench.estop = False
        bench.step(Arm())
        bench.wait(after_ms)
        bench.step(operator=(Arm(),))
        assert bench.status.permit == permit
        assert ("less than 2 s before" in bench.status.reason) == (permit == "needed")

    def test_the_operator_reads_why_although_the_runner_asks_on(self) -> None:
        bench = Bench().arm()
        _operator(bench)
        bench.step(operator=(Arm(),))
        for _ in range(10):
            bench.wait(100)
            bench.step(Arm())
        assert "less than 2 s before" in bench.status.reason
        bench.wait(1_000)
        bench.step(Arm())
        assert bench.status.reason.startswith("arm refused: waiting for an operator")

    def test_it_is_refused_without_a_runner_that_requests_arming(self) -> None:
        bench = self.held()
        bench.step(operator=(Arm(),))
        assert bench.status.permit == "needed"
        assert "no runner asks to arm" in bench.status.reason

    def test_it_is_refused_three_seconds_after_the_runners_last_request(self) -> None:
        bench = self.held()
        bench.step(Arm())
        bench.wait(3100)
        bench.step(operator=(Arm(),))
        assert bench.status.permit == "needed"

    def test_it_expires_after_ten_seconds(self) -> None:
        bench = self.held().permit()
        bench.wait(9_900)
        assert bench.status.permit == "given"
        bench.wait(200)
        assert (bench.status.permit, bench.status.blocked_by) == ("needed", "estop")

    def test_it_is_void_for_the_next_connection(self) -> None:
        bench = self.held().permit()
        bench.client = False
        bench.step()
        bench.client = True
        bench.step()
        assert bench.status.permit == "needed"

    def test_a_runner_that_requests_and_disconnects_in_one_step_does_not_wait_for_the_next_one(self) -> None:
        bench = self.held()
        bench.client = False
        bench.step(Arm())
        bench.client = True
        bench.step()
        bench.step(operator=(Arm(),))
        assert bench.status.permit == "needed"

    @pytest.mark.parametrize(
        "danger", [{"foreign": "sport 1008"}, {"remote_in_use": True}, {"denied": "Move"}, {"publishers": "2 of x"}]
    )
    def test_a_danger_voids_it(self, danger: dict[str, object]) -> None:
        bench = self.held().permit()
        bench.step(**danger)
        bench.wait(5000)
        assert bench.status.permit == "needed"

    def test_one_that_is_given_while_the_local_input_is_still_pressed_is_void(self) -> None:
        bench = self.held()
        bench.estop = True
        bench.step(Arm())
        bench.step(operator=(Arm(),))
        assert bench.status.permit == "needed" and bench.status.reason.startswith("arm refused")
        bench.estop = False
        bench.ask_to_arm()
        assert bench.status.blocked_by == "estop"

    def test_one_that_is_given_within_two_seconds_after_the_remotes_keys_is_void(self) -> None:
        bench = self.held()
        _remote_estop(bench)
        bench.step(Arm())
        bench.step(operator=(Arm(),))
        assert bench.status.permit == "needed"
        bench.wait(2_000)
        bench.permit().arm()

    def test_the_operator_reads_what_it_waits_for(self) -> None:
        assert self.held().permit().status.reason == "permitted by an operator, waiting for the runner to arm"

    def test_it_lasts_as_long_as_its_arming_needs_once_that_has_sent_a_request(self) -> None:
        bench = self.held().permit()
        bench.wait(9_000)
        bench.mode = ids.MODE_LIE_DOWN
        bench.ask_to_arm()
        bench.wait(5_000)
        assert (bench.status.state, bench.status.permit) == ("arming", "given")
        bench.mode = ids.MODE_BALANCE_STAND
        bench.step()
        assert bench.status.state == "armed"

    def test_the_runners_stop_voids_it(self) -> None:
        bench = self.held().permit()
        bench.step(Stop())
        assert bench.status.permit == "needed"

    def test_it_serves_one_arming(self) -> None:
        bench = Bench(safety=replace(SAFETY, operator_arm=True)).permit().arm()
        bench.step(Stop())
        assert bench.status.permit == "needed"

    def test_an_arming_that_fails_leaves_the_latch(self) -> None:
        bench = self.held().permit()
        bench.mode = ids.MODE_LIE_DOWN
        bench.ask_to_arm()
        bench.wait(11_000)
        assert (bench.status.cause, bench.status.blocked_by) == ("not_standing", "estop")

    def test_a_press_during_the_permitted_arming_ends_it(self) -> None:
        bench = self.held().permit()
        bench.mode = ids.MODE_LIE_DOWN
        bench.ask_to_arm()
        _remote_estop(bench)
        assert (bench.status.state, bench.status.permit) == ("stopped", "needed")


class TestConfirmation:
    """Only the robot's own report confirms a stop."""

    def test_a_report_from_before_the_stop_confirms_nothing(self) -> None:
        bench = Bench().arm()
        bench.mode = None
        _operator(bench)
        assert bench.status.motion == "unknown"

    def test_a_still_robot_is_reported_still(self) -> None:
        bench = Bench().arm()
        _operator(bench)
        bench.wait(40)
        assert (bench.status.motion, bench.status.speed_mps) == ("still", 0.0)

    def test_a_still_report_proves_nothing_where_another_publisher_may_have_made_it(self) -> None:
        bench = Bench().arm()
        _operator(bench)
        bench.wait(40)
        bench.step(publishers="2 publishers of rt/sportmodestate, expected 1")
        assert bench.status.motion == "unknown"

    def test_a_robot_that_drives_on_is_named_within_half_a_second(self) -> None:
        bench = Bench().arm()
        bench.robot = {"vx_mps": 0.8}
        _operator(bench)
        bench.wait(520)
        assert (bench.status.motion, bench.status.speed_mps) == ("moving", 0.8)
        assert "STILL MOVES" in bench.status.reason

    def test_an_operators_stop_stops_a_moving_robot_that_this_bridge_never_drove(self) -> None:
        bench = Bench()
        bench.wait(2000)
        bench.robot = {"vx_mps": 0.5}
        _operator(bench)
        assert [request for _, request in bench.written] == [ZERO, StopMotion(pressed=True)]


class TestRelease:
    def test_it_ends_the_zeros_until_the_next_arming(self) -> None:
        bench = Bench().arm()
        bench.step(Stop())
        bench.step(operator=(Release(),))
        bench.written.clear()
        bench.wait(1000)
        assert bench.written == []
        bench.arm()
        bench.wait(40)
        assert set(bench.moves()) == {ZERO}

    def test_a_driven_robot_is_not_released(self) -> None:
        bench = _driven()
        bench.step(operator=(Release(),))
        bench.command()
        bench.wait(100)
        assert bench.status.state == "armed" and bench.moves()[-1] != ZERO

    def test_an_emergency_stop_brings_the_zeros_back(self) -> None:
        bench = _released()
        bench.written.clear()
        _operator(bench)
        bench.wait(100)
        assert ZERO in bench.moves()

    def test_a_runner_cannot_release(self) -> None:
        bench = Bench().arm()
        bench.step(Stop())
        bench.step(Release())
        bench.written.clear()
        bench.wait(100)
        assert bench.status.rejected == 1 and len(bench.moves()) >= 4


class TestPressOutsideADrive:
    """A press stops a robot that moves although this bridge does not drive it."""

    @pytest.mark.parametrize("press", [_operator, _remote_estop, _local_estop])
    def test_after_an_arming_that_was_broken_off(self, press: Callable[[Bench], None]) -> None:
        bench = _arming()
        bench.step(Stop())
        bench.mode, bench.robot = ids.MODE_BALANCE_STAND, {"vx_mps": 0.5}
        bench.step()
        bench.written.clear()
        press(bench)
        assert [request for _, request in bench.written] == [ZERO, StopMotion(pressed=press is not _remote_estop)]

    @pytest.mark.parametrize("press", [_operator, _remote_estop, _local_estop])
    @pytest.mark.parametrize("state", [_disarmed, _released])
    def test_while_disarmed_or_released(self, state: Callable[[], Bench], press: Callable[[Bench], None]) -> None:
        bench = state()
        bench.wait(1500)
        bench.robot = {"vx_mps": 0.5}
        bench.step()
        bench.written.clear()
        press(bench)
        bench.wait(100)
        assert ZERO in bench.moves() and ids.STOP_MOVE in bench.calls()


class TestStandstill:
    """What counts as the robot's own confirmation."""

    def test_one_slow_report_of_a_moving_robot_confirms_nothing(self) -> None:
        bench = Bench().arm()
        bench.robot = {"vx_mps": 0.8}
        _operator(bench)
        bench.wait(300)
        bench.robot = {"vx_mps": 0.04}
        bench.step()
        assert bench.status.motion == "moving"
        bench.wait(220)
        assert bench.status.motion == "still"

    def test_a_report_from_before_a_later_press_confirms_nothing(self) -> None:
        bench = Bench().arm()
        bench.step(Stop())
        bench.wait(2000)
        bench.mode = None
        bench.now_ns += 50_000_000
        _operator(bench)
        assert bench.status.motion == "unknown"


def test_a_permission_expires_before_the_first_request_of_its_arming() -> None:
    bench = Bench(safety=replace(SAFETY, operator_arm=True)).permit()
    bench.wait(9_900)
    bench.mode = ids.MODE_LIE_DOWN
    bench.battery = None
    bench.wait(200)
    bench.ask_to_arm()
    bench.wait(3000)
    bench.battery = 80
    bench.wait(3000)
    assert ids.STAND_UP not in bench.calls()
