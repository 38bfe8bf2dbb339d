"""Command latency: which commands can be matched with their arrival at the robot."""

from __future__ import annotations

import pytest

from tools.report.command_latency import command_latencies_ms

MS = 1_000_000
PERIOD_NS = 100 * MS


def ticks(*commands: tuple[float, float, float]) -> list[dict[str, object]]:
    """Ticks of 30 ms each, whose commands are sent at 30, 130, 230 … ms."""
    return [
        {"start_ns": index * PERIOD_NS, "duration_ms": 30.0, "command": command}
        for index, command in enumerate(commands)
    ]


def arrivals(*moves: tuple[float, tuple[float, float, float] | None]) -> list[dict[str, object]]:
    return [{"t_ns": round(ms * MS), "velocity": velocity} for ms, velocity in moves]


FAST, SLOW = (0.5, 0.0, 0.3), (0.4, 0.0, 0.2)


def test_the_latency_runs_from_the_end_of_the_tick_to_the_first_matching_arrival() -> None:
    wire = arrivals((120.0, SLOW), (140.0, FAST), (147.0, SLOW), (167.0, SLOW))
    assert command_latencies_ms(ticks(FAST, SLOW, SLOW), wire) == [17.0]


def test_a_command_that_the_bus_rounds_is_matched() -> None:
    assert command_latencies_ms(ticks(FAST, SLOW, SLOW), arrivals((140.0, (0.405, 0.0, 0.195)))) == [10.0]


@pytest.mark.parametrize(
    "second",
    [(0.6, 0.0, 0.2), (0.4, 0.0, -0.2), (0.495, 0.0, 0.3)],
    ids=["a component grows", "a sign changes", "too small a change"],
)
def test_commands_that_the_bridge_delays_or_that_look_like_the_last_are_left_out(
    second: tuple[float, float, float],
) -> None:
    assert command_latencies_ms(ticks(FAST, second, second), arrivals((140.0, second))) == []


def test_a_command_that_grows_within_one_period_of_the_bridge_is_matched() -> None:
    grown = (0.54, 0.0, 0.3)
    wire = arrivals((140.0, grown))
    assert command_latencies_ms(ticks(FAST, grown, grown), wire, (0.04, 0.04, 0.08)) == [10.0]
    assert command_latencies_ms(ticks(FAST, grown, grown), wire, (0.03, 0.03, 0.08)) == []


def test_a_command_that_has_not_arrived_before_the_next_one_is_left_out() -> None:
    assert command_latencies_ms(ticks(FAST, SLOW, SLOW), arrivals((140.0, FAST), (240.0, SLOW), (250.0, None))) == []
