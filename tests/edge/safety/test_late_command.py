"""A late command: zeros in its place until it comes, for a second at most, and never beside commands on time."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.robot.inputs import CommandTap
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


@pytest.mark.parametrize("sent_ms", [0, 500])
def test_zeros_are_due_every_50_ms_from_200_ms_after_the_command_for_a_second(sent_ms: int) -> None:
    assert zeros_ms(sent_ms * MS, 3000 * MS) == list(range(sent_ms + 200, sent_ms + 1000, 50))


def test_the_first_zero_leaves_the_thread_50_ms_before_the_bridges_deadman() -> None:
    assert BridgeConfig(socket=Path("/run/bridge.sock")).deadman_ms - LATE_NS // MS >= 50


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


class FakeTime:
    """A clock that moves only while somebody waits, and the event that ends the waiting."""

    def __init__(self, end_ns: int) -> None:
        self.now_ns, self.end_ns = 0, end_ns
        self.waits_ms: list[float] = []

    def wait(self, seconds: float) -> bool:
        assert seconds >= 0
        self.waits_ms.append(1e3 * seconds)
        self.now_ns += round(seconds * 1e9)
        return self.now_ns >= self.end_ns


class FakeCommands:
    """A control thread that has sent one command and hangs since."""

    def __init__(self, time: FakeTime, sent_ns: int | None) -> None:
        self._time, self.sent_ns = time, sent_ns
        self.held_ms: list[float] = []

    def hold(self, stamp_ns: int) -> bool:
        assert stamp_ns == self._time.now_ns
        self.held_ms.append(stamp_ns / MS)
        return True


def hold(sent_ns: int | None, end_ms: int) -> tuple[FakeCommands, FakeTime]:
    time = FakeTime(end_ms * MS)
    commands = FakeCommands(time, sent_ns)
    hold_while_late(commands, time, lambda: time.now_ns)  # type: ignore[arg-type]
    return commands, time


def test_the_thread_sleeps_until_a_zero_is_due_and_sends_it_at_that_instant() -> None:
    commands, time = hold(0, 480)
    assert commands.held_ms == [200.0, 250.0, 300.0, 350.0, 400.0, 450.0]
    assert time.waits_ms == [0.0, 200.0, 50.0, 50.0, 50.0, 50.0, 50.0, 50.0]


def test_before_the_first_command_the_thread_looks_every_50_ms() -> None:
    commands, time = hold(None, 200)
    assert commands.held_ms == [] and time.waits_ms == [0.0, 50.0, 50.0, 50.0, 50.0]


def test_a_thread_that_woke_up_late_does_not_wait_for_a_time_that_has_passed() -> None:
    class Late(FakeTime):
        def wait(self, seconds: float) -> bool:
            late = super().wait(seconds)
            self.now_ns += 70 * MS
            return late

    time = Late(600 * MS)
    hold_while_late(FakeCommands(time, 0), time, lambda: time.now_ns)  # type: ignore[arg-type]
    assert min(time.waits_ms) == 0.0
