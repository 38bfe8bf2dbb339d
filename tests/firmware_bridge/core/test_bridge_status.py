"""What the bridge's status says: counts, the cause of a stop, and the instant of a deadman's stop."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from firmware_bridge.core.link import Stop
from firmware_bridge.unitree.messages import ids
from tests.support.robot.bridge_bench import MS, Bench


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
