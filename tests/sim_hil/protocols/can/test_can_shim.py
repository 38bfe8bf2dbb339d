"""The faulty bus: repeatable, each fault as often as asked, and what the base makes of them."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_bridge.can.frame import ERROR_BUS_OFF, ERROR_RESTARTED, Frame
from sim_hil.protocols.can.frames import Decoder, Encoder
from sim_hil.protocols.can.shim import BABBLER_ID, FRAME_S, FaultPlan, FaultShim
from sim_hil.protocols.fault_socket import parse_plan

COUNT = 2000
TICK_S = 0.002


def passed(plan: FaultPlan, seed: int = 0, direction: int = 0, tick_s: float = TICK_S) -> list[Frame]:
    """What arrives of COUNT numbered frames, one a tick."""
    shim, arrived = FaultShim(plan, seed, direction), []
    for number in range(COUNT):
        shim.put(Frame(0x100, number.to_bytes(4, "little")), number * tick_s)
        arrived += shim.take(number * tick_s)
    return arrived + shim.take(COUNT * tick_s + 10.5)


def numbers(frames: list[Frame]) -> list[int]:
    return [int.from_bytes(frame.data, "little") for frame in frames]


@pytest.mark.slow
@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_same_seed_gives_the_same_fate(seed: int) -> None:
    plan = FaultPlan(drop=0.1, corrupt=0.1, duplicate=0.1, delay=0.1)
    assert passed(plan, seed) == passed(plan, seed)


@pytest.mark.slow
def test_seeds_and_directions_differ() -> None:
    plan = FaultPlan(drop=0.5)
    assert len({tuple(numbers(passed(plan, seed, way))) for seed in (0, 1) for way in (0, 1)}) == 4


def test_the_fate_of_a_frame_does_not_depend_on_the_clock() -> None:
    plan = FaultPlan(drop=0.3, corrupt=0.2)
    assert passed(plan, tick_s=0.002) == passed(plan, tick_s=0.005)


def test_another_fault_does_not_move_the_dice_of_the_first() -> None:
    alone = set(numbers(passed(FaultPlan(drop=0.2))))
    assert set(numbers(passed(FaultPlan(drop=0.2, duplicate=0.5)))) == alone


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_frames_are_dropped_at_the_given_share(share: float) -> None:
    assert len(passed(FaultPlan(drop=share))) == pytest.approx(COUNT * (1 - share), rel=0.1)


def test_a_duplicate_follows_its_original() -> None:
    assert numbers(passed(FaultPlan(duplicate=1.0))) == [n for number in range(COUNT) for n in (number, number)]


def test_a_delayed_frame_is_overtaken() -> None:
    arrived = numbers(passed(FaultPlan(delay=0.2, delay_s=0.01)))
    assert sorted(arrived) == list(range(COUNT)) and arrived != sorted(arrived)


@pytest.mark.slow
def test_a_corrupted_frame_is_never_taken_for_a_good_one() -> None:
    shim, encoder, decoder = FaultShim(FaultPlan(corrupt=1.0), 3, 0), Encoder(), Decoder("Controller")
    for number in range(COUNT):
        shim.put(encoder.encode("VelocityCommand", Vx=0.5, Wz=0.0), number * TICK_S)
        for frame in shim.take(number * TICK_S):
            received = decoder.decode(frame)
            assert received is not None and not received.good


def test_no_frame_passes_a_bus_that_is_off_and_error_frames_mark_both_ends() -> None:
    plan = FaultPlan(bus_off_every_s=1.0, bus_off_s=0.25)
    arrived = passed(plan)
    errors = [frame.identifier for frame in arrived if frame.error]
    assert errors == [ERROR_BUS_OFF, ERROR_RESTARTED] * 3
    inside = {n for n in range(COUNT) if n * TICK_S >= 1.0 and n * TICK_S % 1.0 < 0.25}
    assert not inside & set(numbers([frame for frame in arrived if not frame.error]))


def test_a_babbling_idiot_fills_the_bus_and_starves_the_others() -> None:
    arrived = passed(FaultPlan(babble_hz=10_000.0, babble_from_s=2.0))
    babble = [frame for frame in arrived if frame.identifier == BABBLER_ID]
    others = numbers([frame for frame in arrived if frame.identifier != BABBLER_ID])
    assert others == [number for number in range(COUNT) if number * TICK_S < 2.0]
    assert len(babble) == pytest.approx((COUNT * TICK_S + 10.5 - 2.0) / FRAME_S, rel=0.01)


def test_a_babbler_sends_no_frames_for_the_time_before_it_was_switched_on() -> None:
    shim = FaultShim(FaultPlan(), 0, 0)
    shim.take(600.0)
    shim.plan = FaultPlan(babble_hz=1000.0)
    assert len(shim.take(600.01)) == 10


def test_a_babbler_that_leaves_gaps_delays_the_others() -> None:
    shim = FaultShim(FaultPlan(babble_hz=0.75 / FRAME_S), 0, 0)
    for number in range(10):
        shim.put(Frame(0x100, bytes((number,))), 0.0)
    legit = [frame for frame in shim.take(5 * 4 * FRAME_S + 1e-9) if frame.identifier == 0x100]
    assert len(legit) == 5


@pytest.mark.parametrize(
    "text", ["drop", "drop=", "drop=x", "drop=-0.1", "drop=1.5", "drop=nan", "drip=0.1", "bus_off_every_s=0.1"]
)
def test_an_invalid_plan_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="expected"):
        parse_plan(FaultPlan, [text])


def test_a_plan_is_read_from_a_line() -> None:
    assert parse_plan(FaultPlan, ["drop=0.1", "delay=0.2", "delay_s=0.03"]) == FaultPlan(
        drop=0.1, delay=0.2, delay_s=0.03
    )
