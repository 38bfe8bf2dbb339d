"""The emergency-stop keys L2 and B of the robot's remote, pressed the way people press two keys."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from firmware_bridge.unitree.remote import StopKeys
from tests.firmware_bridge.core.test_bridge_estop import STATES
from tests.support.robot.bridge_bench import MS, ZERO, Bench

L2, B, A, START = 1 << 5, 1 << 9, 1 << 8, 1 << 2
ORDERS = pytest.mark.parametrize(("first", "second"), [(L2, B), (B, L2)], ids=["L2 first", "B first"])
NOW_NS = 10**12


def pressed(*samples: tuple[int, int]) -> list[bool]:
    """Answer to each sample (ms, keys)."""
    keys = StopKeys(("L2", "B"))
    return [keys.press(bits, NOW_NS + ms * MS) for ms, bits in samples]


class TestKeys:
    @ORDERS
    def test_the_second_key_completes_them_up_to_500_ms_after_the_first(self, first: int, second: int) -> None:
        for spacing_ms in range(501):
            held = pressed((0, first), (spacing_ms, first | second))
            released = pressed((0, first), (spacing_ms // 2, 0), (spacing_ms, second))
            both_sample_lost = pressed((0, first), (spacing_ms, second), (spacing_ms + 20, 0))
            assert (held[-1], released[-1], both_sample_lost[1]) == (True, True, True), f"{spacing_ms} ms"
            assert not any(held[:-1]) and not any(released[:-1])

    @ORDERS
    @pytest.mark.parametrize("spacing_ms", [501, 502, 520, 600, 1000, 60_000])
    def test_keys_more_than_500_ms_apart_are_two_single_keys(self, first: int, second: int, spacing_ms: int) -> None:
        assert not any(pressed((0, first), (20, 0), (spacing_ms, second), (spacing_ms + 20, 0)))

    def test_a_key_held_for_long_completes_when_the_other_is_added(self) -> None:
        held = [(ms, L2) for ms in range(0, 5_000, 20)]
        assert pressed(*held, (5_000, L2 | B))[-1]

    def test_the_time_runs_from_the_last_sample_of_the_first_key(self) -> None:
        held = [(ms, L2) for ms in range(0, 5_020, 20)]
        assert pressed(*held, (5_500, B))[-1]
        assert not pressed(*held, (5_501, B))[-1]

    @pytest.mark.parametrize("keys", [0, L2, B, A, START, L2 | A, B | START])
    def test_no_other_combination_completes_them(self, keys: int) -> None:
        assert not any(pressed((0, keys), (20, keys), (400, keys)))

    def test_other_keys_beside_them_change_nothing(self) -> None:
        assert pressed((0, L2 | A), (200, B | START))[-1]

    def test_a_sample_without_keys_never_completes_them(self) -> None:
        assert pressed((0, L2), (20, B), (40, 0)) == [False, True, False]


@ORDERS
@pytest.mark.parametrize("overlapping", [True, False], ids=["overlapping", "released before"])
@pytest.mark.parametrize("state", STATES)
def test_the_bridge_latches_in_every_state_at_every_spacing(
    state: Callable[[], Bench], first: int, second: int, overlapping: bool
) -> None:
    for spacing_ms in range(0, 501, 20):
        bench, keys = state(), StopKeys(("L2", "B"))
        bench.client = True
        for ms in range(0, spacing_ms + 60, 20):
            bits = first if ms < 40 or (overlapping and ms < spacing_ms + 40) else 0
            bits |= second if spacing_ms <= ms < spacing_ms + 40 else 0
            bench.step(remote_in_use=bits != 0, remote_estop=keys.press(bits, bench.now_ns))
            bench.now_ns += 20 * MS
        bench.mode = 1  # it stands again
        bench.wait(2_000)
        bench.written.clear()
        bench.ask_to_arm()
        bench.drive(300)
        assert bench.status.blocked_by == "estop", f"{spacing_ms} ms"
        assert bench.status.state in ("disarmed", "stopped") and set(bench.moves()) <= {ZERO}
