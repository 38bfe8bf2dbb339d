"""What a press of the emergency stop sends to a robot that this bridge does not drive, and to a base that holds on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from firmware_bridge.core.link import Release, Stop
from firmware_bridge.core.rules import BridgeCore
from firmware_bridge.core.step_types import Move, StopMotion
from firmware_bridge.unitree.messages import ids
from tests.support.robot.bridge_bench import BRIDGE, LIMITS, MS, SAFETY, TABLE, ZERO, Bench

PRESSED = [ZERO, StopMotion(pressed=True)]


def _operator(bench: Bench) -> None:
    bench.step(operator=(Stop(),))


def _local(bench: Bench) -> None:
    bench.estop = True
    bench.step()


def _remote(bench: Bench) -> None:
    bench.step(remote_in_use=True, remote_estop=True)


def _pilot(bench: Bench) -> None:
    bench.step(remote_in_use=True, taken_over=True)


def requests(bench: Bench) -> list[object]:
    return [request for _, request in bench.written]


@pytest.mark.parametrize("press", [_operator, _local])
class TestHere:
    """A press at this computer reaches the robot, whatever the robot reports."""

    def test_a_robot_that_reports_standstill_gets_zero_and_a_stop(self, press: Callable[[Bench], None]) -> None:
        bench = Bench()
        press(bench)
        assert requests(bench) == PRESSED

    def test_so_does_one_that_reports_nothing(self, press: Callable[[Bench], None]) -> None:
        bench = Bench(mode=None)
        press(bench)
        assert requests(bench) == PRESSED

    def test_so_does_one_that_the_bridge_makes_ready(self, press: Callable[[Bench], None]) -> None:
        bench = Bench(mode=ids.MODE_LIE_DOWN)
        bench.ask_to_arm()
        bench.written.clear()
        press(bench)
        assert requests(bench)[:2] == PRESSED

    def test_a_driven_robot_is_stopped_once(self, press: Callable[[Bench], None]) -> None:
        bench = Bench().arm()
        bench.drive(200)
        bench.written.clear()
        press(bench)
        assert requests(bench) == PRESSED

    def test_a_stopped_robot_gets_it_again_on_top_of_the_zeros(self, press: Callable[[Bench], None]) -> None:
        bench = Bench().arm()
        bench.step(Stop())
        bench.wait(2000)
        bench.written.clear()
        press(bench)
        assert requests(bench)[:2] == PRESSED


@pytest.mark.parametrize("press", [_remote, _pilot])
def test_a_press_at_the_robot_sends_a_standing_robot_nothing(press: Callable[[Bench], None]) -> None:
    bench = Bench()
    press(bench)
    assert requests(bench) == []


@pytest.mark.parametrize("press", [_remote, _pilot])
def test_a_press_at_the_robot_takes_no_mode_from_the_person_there(press: Callable[[Bench], None]) -> None:
    bench = Bench().arm()
    bench.drive(200)
    bench.written.clear()
    press(bench)
    assert StopMotion() in requests(bench) and StopMotion(pressed=True) not in requests(bench)


def test_repeats_of_one_command_are_one_press() -> None:
    bench = Bench()
    for _ in range(25):
        _operator(bench)
        bench.wait(40)
    assert requests(bench) == PRESSED
    bench.wait(1001)
    _operator(bench)
    assert requests(bench) == PRESSED * 2


@pytest.mark.parametrize(("after_ns", "times"), [(1000 * MS, 1), (1000 * MS + 1, 2)])
def test_a_press_is_another_one_more_than_a_second_after_the_last(after_ns: int, times: int) -> None:
    bench = Bench()
    _operator(bench)
    bench.now_ns += after_ns
    bench.step()
    _operator(bench)
    assert requests(bench) == PRESSED * times


def test_a_press_at_the_robot_does_not_hide_one_at_this_computer() -> None:
    bench = Bench()
    _pilot(bench)
    bench.wait(500)
    _operator(bench)
    assert requests(bench) == PRESSED


def holding() -> Bench:
    """A base that may hold the command of a bridge that was killed."""
    bench = Bench()
    table = replace(TABLE, holds_command=True)
    bench.core = BridgeCore(BRIDGE, LIMITS, SAFETY, table, bench.now_ns)
    return bench


def test_a_base_that_holds_its_last_command_gets_zeros_for_a_second_when_the_bridge_starts() -> None:
    bench = holding()
    bench.wait(3000)
    times_ms = [(at_ns - bench.now_ns) / 1e6 + 3000 for at_ns, _ in bench.written]
    assert {request for _, request in bench.written} == {ZERO} and len(times_ms) >= 50
    assert 980 <= max(times_ms) <= 1000
    assert bench.status.state == "disarmed"


@pytest.mark.parametrize(("after_ns", "sent"), [(1000 * MS, [ZERO]), (1000 * MS + 1, [])])
def test_the_second_ends_a_second_after_its_first_report(after_ns: int, sent: list[Move]) -> None:
    bench = holding()
    bench.step()
    bench.written.clear()
    bench.now_ns += after_ns
    bench.step()
    assert requests(bench) == sent


def test_before_its_first_report_it_gets_none() -> None:
    bench = holding()
    bench.mode = None
    bench.wait(3000)
    assert bench.written == []


def test_an_operators_release_ends_them() -> None:
    bench = holding()
    bench.wait(100)
    bench.step(operator=(Release(),))
    bench.written.clear()
    bench.wait(500)
    assert bench.written == []


def test_a_base_that_stops_by_itself_gets_none() -> None:
    bench = Bench()
    bench.wait(3000)
    assert not [request for request in requests(bench) if isinstance(request, Move)]
