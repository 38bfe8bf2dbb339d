"""The bridge's rules at their edges: numbers, releases, presses and the end of an arming."""

from __future__ import annotations

from dataclasses import replace

import pytest

from firmware_bridge.core.link import Arm, Release, Stop, Velocity
from firmware_bridge.core.step_types import StopMotion
from firmware_bridge.unitree.messages import ids
from tests.support.robot.bridge_bench import MS, SAFETY, TABLE, ZERO, Bench

MOVING = {"vx_mps": 0.5}
LATCHED = "`edge-bridge arm` ends this while a runner waits"


def released() -> Bench:
    bench = Bench().arm()
    bench.step(Stop())
    bench.step(operator=(Release(),))
    return bench


class TestNumbers:
    @pytest.mark.parametrize("seq", [7, 6])
    def test_a_number_that_is_not_new_is_rejected_in_a_later_step_too(self, seq: int) -> None:
        bench = Bench().arm()
        bench.step(Velocity(7, bench.now_ns, 0.5, 0.0, 0.0))
        bench.now_ns += 20 * MS
        bench.step(Velocity(seq, bench.now_ns, 0.5, 0.0, 0.0))
        assert (bench.status.rejected, bench.status.last_seq) == (1, 7)

    def test_the_next_client_counts_from_zero(self) -> None:
        bench = Bench().arm()
        bench.step(Velocity(7, bench.now_ns, 0.5, 0.0, 0.0))
        bench.client = False
        bench.step()
        bench.client = True
        bench.step()
        bench.arm()
        bench.step(Velocity(0, bench.now_ns, 0.5, 0.0, 0.0))
        assert (bench.status.rejected, bench.status.state) == (0, "armed")

    @pytest.mark.parametrize(("age_ns", "rejected"), [(250 * MS, 0), (250 * MS + 1, 1), (-1, 1)])
    def test_a_command_is_good_up_to_the_age_of_the_deadman(self, age_ns: int, rejected: int) -> None:
        bench = Bench().arm()
        bench.step(Velocity(1, bench.now_ns - age_ns, 0.5, 0.0, 0.0))
        assert bench.status.rejected == rejected


class TestRelease:
    def test_it_says_that_nothing_is_sent_and_sends_nothing(self) -> None:
        bench = released()
        before = len(bench.written)
        bench.wait(1000)
        assert len(bench.written) == before
        assert bench.status.reason == "released by an operator: the bridge sends no command until the next arming"

    def test_a_robot_that_was_never_armed_is_released_too(self) -> None:
        bench = Bench()
        bench.step(operator=(Release(),))
        assert bench.status.reason.startswith("released by an operator")

    def test_it_takes_back_an_operators_permission(self) -> None:
        bench = Bench(safety=replace(SAFETY, operator_arm=True)).permit()
        bench.step(operator=(Release(),))
        bench.step(Arm())
        assert (bench.status.state, bench.status.cause) == ("disarmed", "operator")

    def test_it_ends_with_the_next_arming(self) -> None:
        bench = released().arm()
        bench.drive(300)
        bench.step(Stop())
        before = len(bench.moves())
        bench.wait(100)
        assert bench.moves()[before:] == [ZERO] * 5

    def test_a_button_that_is_still_pressed_does_not_end_it(self) -> None:
        bench = Bench().arm()
        bench.estop = True
        bench.step()
        bench.step(operator=(Release(),))
        bench.step()
        assert bench.status.reason.startswith("released by an operator")

    def test_a_new_press_ends_it(self) -> None:
        bench = released()
        bench.estop = True
        bench.step()
        assert bench.status.reason == "emergency stop pressed at the local input, or its file cannot be read"
        assert bench.status.zero_after_stop


class TestPress:
    def test_while_the_robot_is_driven_the_reason_says_what_ends_it(self) -> None:
        bench = Bench().arm()
        bench.robot = dict(MOVING)
        bench.drive(300)
        bench.step(operator=(Stop(),))
        assert (bench.status.state, bench.status.cause) == ("stopped", "estop")
        assert bench.status.reason == f"emergency stop by an operator; {LATCHED}"

    def test_a_robot_that_this_bridge_has_driven_and_stopped_is_not_stopped_anew(self) -> None:
        bench = Bench().arm()
        bench.step(Stop())
        bench.robot, bench.mode = dict(MOVING), ids.MODE_LOCOMOTION
        bench.step(operator=(Stop(),))
        assert (bench.status.cause, bench.status.blocked_by) == ("client_stop", "estop")

    def test_a_robot_that_somebody_else_drives_gets_zeros_from_then_on(self) -> None:
        bench = Bench()
        bench.wait(2000)
        bench.robot, bench.mode = dict(MOVING), ids.MODE_LOCOMOTION
        bench.step(operator=(Stop(),))
        assert (bench.status.state, bench.status.cause) == ("stopped", "estop")
        assert bench.status.reason.startswith("emergency stop by an operator") and LATCHED not in bench.status.reason
        bench.wait(100)
        assert bench.moves() == [ZERO] * 6

    def test_an_arm_is_refused_with_what_was_pressed(self) -> None:
        bench = Bench()
        bench.step(operator=(Stop(),))
        bench.step(Arm())
        waiting = "arm refused: waiting for an operator's `edge-bridge arm`"
        assert bench.status.reason == f"{waiting} (emergency stop by an operator)"


class TestOperatorsArm:
    @pytest.mark.parametrize("mode", [ids.MODE_LIE_DOWN, ids.MODE_BALANCE_STAND])
    def test_one_that_comes_while_the_runner_arms_or_drives_changes_nothing(self, mode: int) -> None:
        bench = Bench(safety=replace(SAFETY, operator_arm=True), mode=mode).permit()
        bench.ask_to_arm()
        before = bench.status
        bench.step(operator=(Arm(),))
        assert bench.status == before and before.state == ("armed" if mode == ids.MODE_BALANCE_STAND else "arming")

    def test_without_a_runner_it_is_refused_with_what_to_do(self) -> None:
        bench = Bench(safety=replace(SAFETY, operator_arm=True))
        bench.step(operator=(Arm(),))
        assert bench.status.cause == "operator"
        assert bench.status.reason.startswith("operator's arm refused: no runner asks to arm")

    def test_one_that_is_taken_leaves_no_cause(self) -> None:
        bench = Bench(safety=replace(SAFETY, operator_arm=True)).permit()
        assert (bench.status.cause, bench.status.blocked_by) == ("none", "none")
        assert bench.status.reason == "permitted by an operator, waiting for the runner to arm"

    def test_a_robot_that_needs_none_takes_no_notice(self) -> None:
        bench = Bench()
        bench.step(operator=(Arm(),))
        assert (bench.status.cause, bench.status.reason) == ("none", "waiting for a client to arm")


class TestEndOfAnArming:
    @pytest.mark.parametrize(
        ("changes", "cause", "reason"),
        [
            ({"mode": ids.MODE_LIE_DOWN}, "not_standing", "not ready after 10 s"),
            ({"version": None}, "wrong_robot", "does not answer after 10 s"),
            ({"battery": None}, "battery_low", "after 10 s"),
            ({"mode": None}, "state_silent", "after 10 s"),
        ],
        ids=["lying", "no answer", "no battery", "silent"],
    )
    def test_it_comes_in_the_tenth_second_and_names_what_is_missing(
        self, changes: dict[str, object], cause: str, reason: str
    ) -> None:
        bench = Bench(**changes)  # type: ignore[arg-type]
        bench.step(Arm())
        asked_ns = bench.now_ns
        bench.wait(9999)
        bench.now_ns = asked_ns + 10_000 * MS - 1
        bench.step()
        assert bench.status.state == "arming"
        bench.now_ns += 1
        bench.step()
        assert (bench.status.state, bench.status.cause) == ("disarmed", cause)
        assert bench.status.reason.startswith("arm refused: ") and bench.status.reason.endswith(reason)

    def test_one_that_has_sent_nothing_ends_in_silence(self) -> None:
        bench = Bench(version=None)
        bench.ask_to_arm()
        bench.step(Stop())
        assert bench.written == []

    def test_one_that_has_sent_something_ends_with_a_stop(self) -> None:
        bench = Bench(mode=ids.MODE_LIE_DOWN)
        bench.ask_to_arm()
        bench.step(Stop())
        assert isinstance(bench.written[-1][1], StopMotion)
        assert bench.status.state == "stopped"

    @pytest.mark.parametrize("end", ["client", "shutdown"])
    def test_one_that_the_runner_breaks_off_is_no_refusal(self, end: str) -> None:
        bench = Bench(mode=ids.MODE_LIE_DOWN)
        bench.ask_to_arm()
        bench.client = end != "client"
        bench.step(shutdown=end == "shutdown")
        assert bench.status.state == "stopped" and not bench.status.reason.startswith("arm refused")


class TestStandingUp:
    def test_the_version_is_asked_for_once_a_second(self) -> None:
        bench = Bench(version=None)
        begun_ns = bench.now_ns
        asked_ms = []
        bench.step(Arm())
        asked_ms += [0] if bench.asked else []
        while bench.now_ns < begun_ns + 2100 * MS:
            bench.now_ns += 10 * MS
            bench.step()
            asked_ms += [(bench.now_ns - begun_ns) // MS] if bench.asked else []
        assert asked_ms == [0, 1000, 2000]
        assert bench.status.reason == "requesting the robot's version"

    def test_a_step_is_repeated_after_the_tables_time_and_named(self) -> None:
        bench = Bench(mode=ids.MODE_LIE_DOWN)
        bench.ask_to_arm()
        step = TABLE.next_step.get(ids.MODE_LIE_DOWN, TABLE.recovery_step)
        begun_ns, repeat_ns = bench.now_ns, TABLE.repeat_ns
        assert bench.status.reason == f"{TABLE.step_names[step]} sent, robot in {TABLE.name_of(ids.MODE_LIE_DOWN)}"
        for now_ns in (begun_ns + repeat_ns - 1, begun_ns + repeat_ns, begun_ns + 2 * repeat_ns - 1):
            bench.now_ns = now_ns
            bench.step()
        assert [at_ns for at_ns, _ in bench.written] == [begun_ns, begun_ns + repeat_ns]

    def test_a_ready_robot_that_moves_is_stopped_first(self) -> None:
        bench = Bench(robot=dict(MOVING))
        bench.wait(1500)  # what moves in the first second was left moving by an earlier bridge
        bench.ask_to_arm()
        assert bench.status.reason.startswith("stop sent, robot in ")
        assert isinstance(bench.written[-1][1], StopMotion)

    def test_the_first_velocity_goes_out_in_the_step_in_which_the_robot_is_ready(self) -> None:
        bench = Bench()
        bench.wait(5)
        bench.step(Arm())
        bench.now_ns += 7 * MS
        bench.step()
        assert bench.status.reason == "driving"
        assert bench.written == [(bench.now_ns, ZERO)]


@pytest.mark.parametrize(("after_ns", "cause"), [(1000 * MS, "robot_moving"), (1000 * MS + 1, "none")])
def test_a_robot_counts_as_found_moving_for_a_second_after_its_first_report(after_ns: int, cause: str) -> None:
    bench = Bench()
    bench.step()
    bench.now_ns += after_ns
    bench.robot, bench.mode = dict(MOVING), ids.MODE_LOCOMOTION
    bench.step()
    assert bench.status.cause == cause


class TestRate:
    """50 velocities a second, on a grid that a late step does not move."""

    @staticmethod
    def driven() -> Bench:
        bench = Bench().arm()
        bench.command()
        return bench

    @pytest.mark.parametrize(("late_ms", "next_ms"), [(0, 20), (5, 15), (19, 1)])
    def test_a_late_step_does_not_move_the_grid(self, late_ms: int, next_ms: int) -> None:
        bench = self.driven()
        bench.now_ns = bench.step().wake_ns + late_ms * MS
        assert bench.step().wake_ns == bench.now_ns + next_ms * MS

    def test_every_velocity_is_counted(self) -> None:
        bench = self.driven()
        bench.drive(500)
        assert bench.status.commands == len(bench.moves()) >= 25

    @pytest.mark.parametrize("stall_ms", [20, 45])
    def test_after_a_stall_one_velocity_goes_out_and_the_next_after_a_period(self, stall_ms: int) -> None:
        bench = self.driven()
        bench.now_ns = bench.step().wake_ns + stall_ms * MS
        before = len(bench.moves())
        assert bench.step().wake_ns == bench.now_ns + 20 * MS
        bench.step()
        assert len(bench.moves()) == before + 1
