"""Reasoning in virtual time (paper appendix D): what was started at t is there at t + L, and not before."""

from __future__ import annotations

import pytest

from edge.core.geometry import SE2
from edge.inference.generation_task import GenerationModels
from edge.reasoning.generation_cycle import Mode, ReasoningConfig
from edge.state.ring import EncodedFrame, TokenRing
from edge.state.semantic import SemanticSlot, SharedState
from sim_hil.benchmark.conditions.latency import Timing
from sim_hil.benchmark.policies.virtual_time_reasoner import VirtualTimeReasoner
from tests.support.runner.reasoning_bench import KV, FakeLanguage, FakePolicy

TICK_NS = 100_000_000


class Bench:
    """Ticks of 0.1 s from 1 s on: a frame each, the robot 0.05 m further in every one in which it may drive.

    `coasting`: by how much further in each of the ticks after a halt, m. `call_s`: duration of each decoding call
    after the first token, s.
    """

    def __init__(
        self,
        latency_s: float = 2.0,
        *,
        mode: Mode = Mode.ASYNC,
        anchor_after_s: float = 0.0,
        coasting: tuple[float, ...] = (),
        call_s: float | None = None,
        instruction: str = "go",
    ) -> None:
        self.x_m, self.coasting, self.left = 0.0, coasting, ()
        self.language, self.policy = FakeLanguage(), FakePolicy()
        self.ring, self.slot, self.tick = TokenRing(160), SemanticSlot(), 0
        decode_ns = None if call_s is None else lambda call_tokens: round(call_s * 1e9) * len(call_tokens)
        timing = Timing(round(latency_s * 1e9), round(anchor_after_s * 1e9), decode_ns)
        self.reasoner = VirtualTimeReasoner(
            GenerationModels(self.language, self.policy),  # type: ignore[arg-type]
            SharedState(self.ring, self.slot),
            ReasoningConfig((0.0, 3.0), 4, mode),
            instruction,
            lambda: timing,
        )
        self.seen: list[tuple[float, int | None, float | None]] = []

    def run(self, until_s: float) -> None:
        """Tick up to a time; `seen` has (time, generation, delay) as each tick sees them."""
        while (now_ns := 1_000_000_000 + self.tick * TICK_NS) <= round((1 + until_s) * 1e9):
            self.reasoner.release(now_ns)
            self.ring.put(EncodedFrame(now_ns, SE2(self.x_m, 0.0, 0.0), KV))
            state = self.slot.state
            delay = None if state is None else round(state.delay_s(now_ns), 3)
            self.seen.append((round(self.tick / 10, 3), None if state is None else state.generation, delay))
            self.reasoner.start(now_ns)
            self.tick += 1
            self.x_m += self._moves(now_ns)

    def _moves(self, now_ns: int) -> float:
        if self.slot.drive_until_ns is None or now_ns < self.slot.drive_until_ns:
            self.left = self.coasting
            return 0.05
        now_m, *self.left = self.left or (0.0,)
        return now_m


def test_the_next_starts_on_release_so_the_delay_grows_to_nearly_twice_the_latency() -> None:
    bench = Bench(2.0)
    bench.run(8.0)
    delays = [delay for _, _, delay in bench.seen if delay is not None]
    assert (min(delays), max(delays)) == (2.0, 3.9)
    assert [record["started_s"] - 1 for record in bench.reasoner.released] == pytest.approx([0.0, 2.0, 4.0, 6.0])


@pytest.mark.parametrize(("latency_s", "there_s"), [(0.0, 0.1), (0.25, 0.3), (1.0, 1.0), (4.99, 5.0)])
def test_availability_is_at_the_first_tick_that_is_not_before_it(latency_s: float, there_s: float) -> None:
    bench = Bench(latency_s)
    bench.run(6.0)
    assert next(time_s for time_s, generation, _ in bench.seen if generation == 0) == there_s


def test_a_late_newest_frame_shortens_the_delay_and_not_the_generation() -> None:
    bench = Bench(3.0, anchor_after_s=1.0)
    bench.run(6.0)
    assert next(row for row in bench.seen if row[1] == 0) == (3.0, 0, 2.0)
    assert next(row for row in bench.seen if row[1] == 1) == (6.0, 1, 2.0)


@pytest.mark.parametrize(("new_tokens", "there_s"), [(0, 1.0), (1, 1.3), (3, 1.9)])
def test_the_calls_after_the_first_token_add_to_the_latency(new_tokens: int, there_s: float) -> None:
    bench = Bench(1.0, call_s=0.3)
    bench.language.new_tokens = new_tokens
    bench.run(2.5)
    assert next(time_s for time_s, generation, _ in bench.seen if generation == 0) == there_s


def test_counting_calls_changes_when_a_generation_is_released_and_not_what_it_reads() -> None:
    counted, drawn = Bench(1.0, anchor_after_s=0.4, call_s=0.3), Bench(1.9, anchor_after_s=0.4)
    for bench in (counted, drawn):
        bench.run(8.0)
    assert counted.reasoner.released == drawn.reasoner.released and counted.seen == drawn.seen
    assert counted.language.prompts[: len(drawn.language.prompts)] == drawn.language.prompts


def test_a_failure_of_a_generation_whose_calls_are_counted_does_not_end_reasoning() -> None:
    bench = Bench(1.0, call_s=0.1)
    bench.language.broken = 1
    bench.run(4.0)
    assert bench.reasoner.cycle.failed == 1 and bench.reasoner.released


def test_sync_anchors_where_the_robot_has_come_to_stand() -> None:
    bench = Bench(2.0, mode=Mode.SYNC, coasting=(0.06, 0.04, 0.02, 0.005))
    bench.run(4.8)
    stands_m = bench.x_m
    bench.run(4.9)
    assert bench.reasoner.released[1]["anchor_s"] - 1 == pytest.approx(2.5 + 0.4)
    state = bench.slot.state
    assert state is not None and state.T_odom_anchor.x_m == pytest.approx(stands_m)


def test_sync_does_not_wait_for_ever_for_odometry_to_rest() -> None:
    bench = Bench(2.0, mode=Mode.SYNC, coasting=(0.02,) * 100)
    bench.run(6.0)
    assert bench.reasoner.released[1]["anchor_s"] - 1 == pytest.approx(2.5 + 1.0)


def test_reasoning_begins_when_control_has_made_the_turn_that_the_instruction_begins_with() -> None:
    bench = Bench(1.0, instruction="Turn around. Go to the bench.")
    bench.run(4.0)
    assert bench.language.prompts == [] and bench.slot.turn is not None
    bench.slot.end(bench.slot.turn)
    bench.run(8.0)
    assert set(bench.language.instructions) == {"Go to the bench."}
    assert min(stamp for prompt in bench.language.prompts for stamp in prompt) > 5.0, "1 s is the beginning"
