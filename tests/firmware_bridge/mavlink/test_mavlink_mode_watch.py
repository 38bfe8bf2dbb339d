"""Mode changes that the bridge did not request: a pilot's switch always wins, in every order of packets."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.mavlink import modes
from firmware_bridge.mavlink.mode_watch import LOST_NS, ModeWatch

S = 1_000_000_000
ARMED, DISARMED = 128, 0
ACTIVE, CRITICAL, EMERGENCY, TERMINATED = 4, 5, 6, 8
MANUAL, HOLD, OFFBOARD, MISSION = 1 << 16, 4 << 16 | 3 << 24, 6 << 16, 4 << 16 | 4 << 24
PX4_MODES = (MANUAL, HOLD, OFFBOARD, MISSION)


def beat(watch: ModeWatch, custom_mode: int, now_ns: int, armed: int = ARMED, status: int = ACTIVE) -> None:
    watch.heartbeat(12, custom_mode, armed, status, now_ns)


def driven() -> ModeWatch:
    """A rover that the bridge has brought into the setpoint mode at 1 s."""
    watch = ModeWatch(modes.PX4)
    beat(watch, HOLD, 0)
    watch.ask(modes.DRIVE, 0)
    beat(watch, OFFBOARD, S)
    assert not watch.take_switched() and watch.may_command()
    return watch


@pytest.mark.parametrize("mode", [MANUAL, HOLD, MISSION])
def test_a_change_that_was_not_requested_forbids_mode_commands(mode: int) -> None:
    watch = driven()
    beat(watch, mode, 2 * S)
    assert watch.take_switched() and watch.yielded and not watch.may_command()


@pytest.mark.parametrize("mode", [MANUAL, HOLD, MISSION])
def test_a_persons_change_of_a_driven_rovers_mode_is_a_takeover(mode: int) -> None:
    watch = driven()
    beat(watch, mode, 2 * S)
    assert watch.is_taken_over
    watch.take_switched()
    assert not watch.is_taken_over


@pytest.mark.parametrize("status", [CRITICAL, EMERGENCY, TERMINATED])
def test_a_failsafe_of_the_autopilot_is_no_takeover(status: int) -> None:
    watch = driven()
    beat(watch, HOLD, 2 * S, status=status)
    assert watch.take_switched() and not watch.is_taken_over


def test_a_pilots_mode_of_a_rover_that_the_bridge_does_not_drive_is_no_takeover() -> None:
    watch = driven()
    watch.ask(modes.HOLD, 2 * S)
    beat(watch, HOLD, 2 * S)
    beat(watch, MANUAL, 3 * S)
    assert watch.take_switched() and not watch.is_taken_over


def test_a_mission_that_a_person_begins_is_a_takeover_also_of_a_rover_that_the_bridge_does_not_drive() -> None:
    watch = ModeWatch(modes.PX4)
    beat(watch, HOLD, 0)
    beat(watch, MISSION, S)
    assert watch.is_taken_over
    watch.take_switched()
    beat(watch, MISSION, 2 * S)
    assert not watch.is_taken_over


def test_a_mission_that_was_begun_before_the_bridge_is_a_takeover() -> None:
    watch = ModeWatch(modes.PX4)
    beat(watch, MISSION, 0)
    assert watch.is_taken_over


def test_a_mission_counts_from_the_arming_of_the_rover_on() -> None:
    watch = ModeWatch(modes.PX4)
    beat(watch, MISSION, 0, DISARMED)
    assert not watch.is_taken_over
    beat(watch, MISSION, S)
    assert watch.is_taken_over


def test_an_automatic_mode_of_a_failsafe_is_no_takeover() -> None:
    watch = ModeWatch(modes.PX4)
    beat(watch, HOLD, 0)
    beat(watch, MISSION, S, status=CRITICAL)
    beat(watch, MISSION, 2 * S)
    assert not watch.is_taken_over


def test_a_change_is_reported_once() -> None:
    watch = driven()
    beat(watch, MANUAL, 2 * S)
    assert [watch.take_switched(), watch.take_switched()] == [True, False]


def test_a_requested_change_is_the_bridges_own() -> None:
    watch = driven()
    watch.ask(modes.HOLD, 2 * S)
    beat(watch, HOLD, 3 * S)
    assert not watch.take_switched() and watch.may_command()


def test_a_request_explains_no_change_that_comes_much_later() -> None:
    watch = driven()
    watch.ask(modes.HOLD, 2 * S)
    beat(watch, HOLD, 6 * S)
    assert watch.take_switched() and watch.yielded


def test_a_request_explains_one_change_only() -> None:
    watch = driven()
    watch.ask(modes.HOLD, 2 * S)
    beat(watch, HOLD, 2 * S)
    beat(watch, OFFBOARD, 2 * S)
    beat(watch, HOLD, 2 * S)
    assert watch.take_switched() and watch.yielded


@given(later=st.lists(st.sampled_from(PX4_MODES), max_size=8))
def test_after_a_pilots_switch_only_an_arming_permits_mode_commands(later: list[int]) -> None:
    watch = driven()
    beat(watch, MANUAL, 2 * S)
    for second, mode in enumerate(later):
        beat(watch, mode, (3 + second) * S)
        assert not watch.may_command()
    watch.take_command()
    assert watch.may_command() is (watch.kind != modes.PILOT)


@given(number=st.integers(0, 2**32 - 1), armed=st.booleans(), autopilot=st.sampled_from(tuple(modes.BY_NAME)))
def test_only_the_setpoint_mode_of_an_armed_rover_is_a_driving_mode(number: int, armed: bool, autopilot: str) -> None:
    watch = ModeWatch(modes.BY_NAME[autopilot])
    watch.heartbeat(12, number, ARMED if armed else DISARMED, ACTIVE, 0)
    drives = number == 15 if autopilot == "ardupilot" else number >> 16 & 0xFF == 6
    assert (watch.mode == modes.ARMED_DRIVE) is (armed and drives)


@pytest.mark.parametrize(("armed", "in_use"), [(ARMED, True), (DISARMED, False)])
def test_sticks_move_only_an_armed_rover(armed: int, in_use: bool) -> None:
    watch = ModeWatch(modes.PX4)
    beat(watch, MANUAL, 0, armed)
    assert watch.in_use() is in_use


@given(numbers=st.permutations(range(20)))
def test_only_a_packet_newer_than_every_earlier_one_counts(numbers: list[int]) -> None:
    watch, newest = ModeWatch(modes.PX4), -1
    for number in numbers:
        assert watch.note_sequence((250 + number) % 256) is (number > newest)
        newest = max(newest, number)


def test_a_restarted_autopilots_packets_count() -> None:
    watch = ModeWatch(modes.PX4)
    watch.note_sequence(200)
    assert watch.note_sequence(0)


@pytest.mark.parametrize(
    ("status", "mode", "emergency", "critical"),
    [(ACTIVE, OFFBOARD, False, False), (CRITICAL, OFFBOARD, False, True), (CRITICAL, HOLD, False, False),
     (EMERGENCY, OFFBOARD, True, False), (TERMINATED, HOLD, True, False)],
)  # fmt: skip
def test_the_autopilots_status_is_read(status: int, mode: int, emergency: bool, critical: bool) -> None:
    watch = ModeWatch(modes.PX4)
    beat(watch, mode, 0, status=status)
    assert (watch.is_emergency(), watch.is_critical()) == (emergency, critical)


def test_a_rover_is_lost_after_three_missing_heartbeats_and_never_before_the_first() -> None:
    watch = ModeWatch(modes.PX4)
    assert not watch.is_lost(100 * S)
    beat(watch, HOLD, 100 * S)
    assert [watch.is_lost(100 * S + LOST_NS), watch.is_lost(100 * S + LOST_NS + 1)] == [False, True]
