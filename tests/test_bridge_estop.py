"""Emergency stops that hold until an operator takes them back, on a fake clock."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from firmware_bridge.link import Arm, Stop, Velocity
from tests.bridge_bench import ZERO, Bench


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
        assert bench.status.cause == "estop"
        bench.step(operator=(Arm(),))
        bench.arm()

    def test_a_stop_beside_an_arm_in_one_step_stops_and_holds(self) -> None:
        for said in ((Stop(), Arm()), (Arm(), Stop()), (Stop(), Arm(), Arm())):
            bench = Bench().arm()
            bench.drive(500)
            bench.step(operator=said)
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
        assert (bench.status.state, bench.status.cause) == ("stopped", "estop")
        bench.step(operator=(Arm(),))
        bench.arm()

    @pytest.mark.parametrize("press", [_remote_estop, _local_estop])
    def test_one_that_was_pressed_while_nothing_moved_ends_when_it_is_released(
        self, press: Callable[[Bench], None]
    ) -> None:
        bench = Bench()
        press(bench)
        bench.ask_to_arm()
        assert bench.status.blocked_by == "estop"
        bench.estop = False
        bench.wait(1100)
        bench.arm()

    def test_taking_it_back_does_not_arm(self) -> None:
        bench = Bench()
        bench.step(operator=(Arm(),))
        bench.wait(1000)
        assert bench.status.state == "disarmed" and bench.written == []

    def test_only_the_runners_socket_commands(self) -> None:
        bench = Bench().arm()
        bench.step(operator=(Velocity(1, bench.now_ns, 0.5, 0.0, 0.0),))
        bench.wait(100)
        assert set(bench.moves()) == {ZERO}
        assert bench.status.rejected == 1
