"""What the bridge's status says: counts, the cause of a stop, and the instant of a deadman's stop."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from firmware_bridge.core.link import Release, Stop
from firmware_bridge.unitree.messages import ids
from tests.support.robot.bridge_bench import MS, ZERO, Bench


def _leave(bench: Bench) -> None:
    bench.client = False
    bench.step()


def _lie_down(bench: Bench) -> None:
    bench.mode = ids.MODE_LIE_DOWN
    bench.step()


def _fall_silent(bench: Bench) -> None:
    bench.mode = None
    bench.drive(1200)


def test_a_new_bridge_has_neither_a_cause_nor_a_count() -> None:
    status = Bench(client=False).status
    assert (status.cause, status.last_seq, status.commands, status.rejected) == ("none", 0, 0, 0)
    assert status.robot == 0, "no robot file's"


@pytest.mark.parametrize(
    ("stop", "cause"),
    [
        (lambda bench: bench.wait(251), "deadman"),
        (lambda bench: bench.step(Stop()), "client_stop"),
        (lambda bench: bench.step(shutdown=True), "shutdown"),
        (_leave, "client_lost"),
        (_lie_down, "wrong_mode"),
        (_fall_silent, "state_silent"),
    ],
)
def test_it_names_the_cause_of_the_stop(stop: Callable[[Bench], object], cause: str) -> None:
    bench = Bench().arm()
    bench.drive(500)
    assert bench.status.cause == "none"
    stop(bench)
    assert bench.status.cause == cause


def test_a_command_counts_up_to_and_including_its_250th_millisecond() -> None:
    bench = Bench().arm()
    bench.drive(300)
    bench.command()
    bench.now_ns += 250 * MS
    bench.step()
    assert bench.status.state == "armed"
    bench.now_ns += 1
    bench.step()
    assert bench.status.state == "stopped"


MOVING = {"vx_mps": 0.5}
WARNING = "THE ROBOT STILL MOVES"


class TestARobotThatDoesNotObey:
    """It is reported from half a second after the stop."""

    def test_it_is_reported_500_ms_after_the_stop(self) -> None:
        bench = Bench().arm()
        bench.drive(500)
        bench.robot = dict(MOVING)
        bench.step(Stop())
        bench.wait(499)
        bench.step()
        assert WARNING not in bench.status.reason
        bench.wait(1)
        bench.step()
        assert WARNING in bench.status.reason

    def test_after_a_release_a_person_moves_it(self) -> None:
        bench = Bench().arm()
        bench.step(Stop())
        bench.step(operator=(Release(),))
        bench.robot = dict(MOVING)
        bench.wait(1000)
        assert (bench.status.state, bench.status.motion) == ("stopped", "moving")
        assert WARNING not in bench.status.reason

    def test_a_robot_that_this_bridge_has_never_driven_is_not_accused(self) -> None:
        bench = Bench()
        bench.wait(2000)
        bench.robot = dict(MOVING)
        bench.wait(1000)
        assert (bench.status.state, bench.status.motion) == ("disarmed", "moving")
        assert WARNING not in bench.status.reason

    def test_a_robot_that_is_driven_is_not_accused(self) -> None:
        bench = Bench().arm()
        bench.robot = dict(MOVING)
        bench.drive(1000)
        assert (bench.status.state, bench.status.motion) == ("armed", "moving")
        assert WARNING not in bench.status.reason


@pytest.mark.parametrize(("slept_ns", "cause"), [(100 * MS, "none"), (100 * MS + 1, "suspended")])
def test_a_machine_that_slept_for_more_than_100_ms_stops_the_robot(slept_ns: int, cause: str) -> None:
    bench = Bench().arm()
    bench.drive(300)
    bench.asleep_ns = slept_ns
    bench.command()
    assert bench.status.cause == cause


@pytest.mark.parametrize(("again_ms", "motion"), [(900, "still"), (1000, "still"), (1001, "unknown")])
def test_a_stop_that_is_repeated_within_a_second_needs_no_new_confirmation(again_ms: int, motion: str) -> None:
    bench = Bench()
    bench.wait(500)
    bench.step(operator=(Stop(),))
    assert bench.status.motion == "unknown"
    bench.wait(again_ms)
    assert bench.status.motion == "still"
    bench.step(operator=(Stop(),))
    assert bench.status.motion == motion


@pytest.mark.parametrize("press", ["operator", "local input", "remote keys", "mode change"])
def test_an_emergency_stop_in_the_first_step_of_all_stops_a_robot_that_moves(press: str) -> None:
    bench = Bench(robot=dict(MOVING), mode=ids.MODE_LOCOMOTION)
    bench.estop = press == "local input"
    bench.step(
        operator=(Stop(),) if press == "operator" else (),
        remote_estop=press == "remote keys",
        taken_over=press == "mode change",
    )
    assert bench.status.cause == "estop"
    assert bench.moves() == [ZERO]


def test_it_asks_to_be_woken_in_the_nanosecond_in_which_the_deadman_is_due() -> None:
    bench = Bench().arm()
    bench.drive(300)
    bench.command()
    given_ns = bench.now_ns
    bench.wait(245)
    assert bench.step().wake_ns == given_ns + 250 * MS + 1
