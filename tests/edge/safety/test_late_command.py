"""A late command: zeros in its place until it comes, for a second at most, and never beside commands on time."""

from __future__ import annotations

import itertools
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.run.robot_inputs import CommandTap
from edge.safety.late_command import HOLD_NS, LATE_NS, REPEAT_NS, LateCommand, hold_while_late
from firmware_bridge.core.config import BridgeConfig

MS = 1_000_000
PERIOD_NS = 100 * MS


class FakeBridge:
    """Takes numbered commands as the bridge does: each number must be above all earlier ones."""

    def __init__(self) -> None:
        self.numbers: list[int] = []
        self.velocities: list[tuple[float, float, float]] = []
        self.refused = 0

    def send_velocity(self, seq: int, _stamp_ns: int, vx_mps: float, vy_mps: float, wz_radps: float) -> bool:
        if self.numbers and seq <= self.numbers[-1]:
            self.refused += 1
        else:
            self.numbers.append(seq)
            self.velocities.append((vx_mps, vy_mps, wz_radps))
        return True


def zeros_ms(sent_ns: int | None, until_ns: int, ask_ns: int = MS) -> list[int]:
    """The instants, ms, at which a zero is due when no command follows the one of `sent_ns`."""
    late, due = LateCommand(), []
    for now_ns in range(0, until_ns, ask_ns):
        if late.step(sent_ns, now_ns)[0]:
            due.append(now_ns // MS)
    return due


def test_nothing_is_sent_before_the_first_command() -> None:
    assert zeros_ms(None, 2 * HOLD_NS) == []


def test_the_first_zero_comes_before_the_bridges_deadman() -> None:
    assert zeros_ms(0, 2 * HOLD_NS)[0] == LATE_NS // MS
    assert BridgeConfig(socket=Path("/run/bridge.sock")).deadman_ms - LATE_NS // MS >= 50


def test_zeros_follow_each_other_faster_than_the_deadman_and_end_after_a_second() -> None:
    due = zeros_ms(0, 3 * HOLD_NS)
    assert {b - a for a, b in itertools.pairwise(due)} == {REPEAT_NS // MS}
    assert due[-1] < HOLD_NS // MS


@given(st.lists(st.integers(0, LATE_NS - 1), min_size=1, max_size=50), st.integers(MS, 30 * MS))
def test_commands_on_time_are_never_accompanied_by_a_zero(gaps_ns: list[int], ask_ns: int) -> None:
    late, sent_ns = LateCommand(), 10**9
    for gap_ns in gaps_ns:
        for now_ns in range(sent_ns, sent_ns + gap_ns, ask_ns):
            assert not late.step(sent_ns, now_ns)[0]
        sent_ns += gap_ns


@given(st.integers(1, 3 * HOLD_NS), st.integers(1, 2 * REPEAT_NS))
def test_it_asks_again_no_later_than_a_zero_is_due(age_ns: int, wait_ns: int) -> None:
    late = LateCommand()
    now_ns = 10**9 + age_ns
    due, again_ns = late.step(10**9, now_ns)
    assert now_ns < again_ns <= max(now_ns + REPEAT_NS, 10**9 + LATE_NS)
    if not due and now_ns + wait_ns < again_ns:
        assert not late.step(10**9, now_ns + wait_ns)[0]


@given(st.lists(st.integers(0, 25), min_size=1, max_size=30))
def test_the_bridge_takes_every_command_whatever_zeros_came_between(holds: list[int]) -> None:
    bridge = FakeBridge()
    tap = CommandTap(bridge)  # type: ignore[arg-type]
    for seq, number in enumerate(holds, 1):
        tap.send_velocity(seq, seq * PERIOD_NS, 0.5, 0.0, 0.0)
        for k in range(number):
            tap.hold(seq * PERIOD_NS + k)
    assert bridge.refused == 0
    assert bridge.velocities.count((0.5, 0.0, 0.0)) == len(holds)


def test_a_zero_that_a_command_overtakes_is_refused_by_the_bridge() -> None:
    bridge = FakeBridge()
    tap = CommandTap(bridge)  # type: ignore[arg-type]
    tap.send_velocity(1, PERIOD_NS, 0.5, 0.0, 0.0)
    tap.send_velocity(2, 2 * PERIOD_NS, 0.6, 0.0, 0.0)
    bridge.send_velocity(tap.SPACING + 1, 2 * PERIOD_NS, 0.0, 0.0, 0.0)  # numbered before, sent after
    assert bridge.refused == 1
    assert bridge.velocities[-1] == (0.6, 0.0, 0.0)


def test_the_velocity_in_force_is_zero_while_it_holds() -> None:
    tap = CommandTap(FakeBridge())  # type: ignore[arg-type]
    tap.send_velocity(1, PERIOD_NS, 0.5, 0.0, 0.1)
    tap.hold(PERIOD_NS + LATE_NS)
    assert tap.commanded == (0.0, 0.0, 0.0)


@pytest.mark.timeout(30)
def test_the_thread_holds_a_late_robot_and_ends_with_the_run() -> None:
    ended, now = threading.Event(), [0]

    class Commands:
        sent_ns = 1
        held: list[int] = []  # noqa: RUF012

        def hold(self, stamp_ns: int) -> bool:
            self.held.append(stamp_ns)
            if len(self.held) == 3:
                ended.set()
            return True

    def clock() -> int:
        now[0] += 10 * MS
        return now[0]

    commands = Commands()
    hold_while_late(commands, ended, clock)
    assert len(commands.held) == 3
    assert commands.held[0] - commands.sent_ns >= LATE_NS
