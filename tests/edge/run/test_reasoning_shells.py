"""What the reasoning thread and the virtual-time reasoner promise alike, as one test class that runs against both.

The world of both: a frame every 0.1 s, the robot 0.05 m further in each tick in which it may drive.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import pytest

from edge.core.geometry import SE2
from edge.inference.generation_task import GenerationModels
from edge.reasoning.decoding_rules import FREE, DecodingContext
from edge.reasoning.generation_cycle import FAILURES, GenerationCycle, Mode, ReasoningConfig
from edge.state.ring import EncodedFrame, TokenRing
from edge.state.semantic import SemanticSlot, SemanticState, SharedState
from edge.state.switches import Decoding
from sim_hil.benchmark.conditions.latency import Timing
from sim_hil.benchmark.policies.virtual_time_reasoner import VirtualTimeReasoner
from tests.support.runner.reasoning_bench import KV, TEXT, Bench, Clock, FakeLanguage, FakePolicy

TICK_S = 0.1
BEGIN_S = 100.0


class Shell(Protocol):
    """A reasoner in its world."""

    language: FakeLanguage
    policy: FakePolicy
    slot: SemanticSlot
    world: World

    @property
    def cycle(self) -> GenerationCycle: ...

    def run(self, until_s: float) -> None:
        """Let the world go on until this time after its begin."""


def since(stamp_ns: int) -> float:
    """Time after the begin, s."""
    return round(stamp_ns / 1e9 - BEGIN_S, 6)


class World:
    """Time, the robot's position and the frames."""

    def __init__(self, ring: TokenRing, slot: SemanticSlot) -> None:
        self.ring, self.slot, self.ticks, self.x_m = ring, slot, 0, 0.0
        self.states: list[SemanticState] = []
        self.published: list[tuple[float, float, int]] = []
        """(time, anchor's time, generation) of each semantic state, s after the begin."""
        self.drive_until_s: list[float | None] = []
        """End of the permission to drive that came with each of them, s after the begin."""

    @property
    def now_s(self) -> float:
        return round(BEGIN_S + self.ticks * TICK_S, 6)

    @property
    def now_ns(self) -> int:
        return round(self.now_s * 1e9)

    def advance(self) -> None:
        until_ns = self.slot.drive_until_ns
        self.x_m += 0.05 if until_ns is None or self.now_ns < until_ns else 0.0
        self.ticks += 1

    def look(self) -> None:
        self.ring.put(EncodedFrame(self.now_ns, SE2(self.x_m, 0.0, 0.0), KV))

    def note(self) -> None:
        state, until_ns = self.slot.state, self.slot.drive_until_ns
        if state is None or (self.states and self.states[-1] is state):
            return
        self.states.append(state)
        self.published.append((since(self.now_ns), since(state.anchor_ns), state.generation))
        self.drive_until_s.append(None if until_ns is None else since(until_ns))


class ThreadShell:
    """The robot's reasoning loop; while it computes, the world goes on for the latency."""

    def __init__(self, mode: Mode, latency_s: float, decoding: Decoding = Decoding.CONSTRAINED) -> None:
        self.clock = Clock()
        self.bench = Bench(clock=self.clock, mode=mode, decoding=decoding, late_anchor=False)
        self.language, self.policy, self.slot = self.bench.language, self.bench.policy, self.bench.slot
        self.world = World(self.bench.ring, self.slot)
        self.language.during_finish = lambda _run: self._tick(round(latency_s / TICK_S))

    @property
    def cycle(self) -> GenerationCycle:
        return self.bench.cycle

    def _tick(self, count: int) -> None:
        for _ in range(count):
            self.world.advance()
            self.clock.s = self.world.now_s
            self.world.look()

    def run(self, until_s: float) -> None:
        self.world.look()
        while self.world.now_s < BEGIN_S + until_s:
            while self.world.now_s < BEGIN_S + until_s and self.bench.loop.step():
                self.world.note()
            self._tick(1)


class VirtualTimeShell:
    """The benchmark's reasoner."""

    def __init__(self, mode: Mode, latency_s: float, decoding: Decoding = Decoding.CONSTRAINED) -> None:
        self.language, self.policy, self.slot = FakeLanguage(), FakePolicy(), SemanticSlot()
        ring = TokenRing(256)
        self.world = World(ring, self.slot)
        self.reasoner = VirtualTimeReasoner(
            GenerationModels(self.language, self.policy),  # type: ignore[arg-type]
            SharedState(ring, self.slot),
            ReasoningConfig((0.0, 3.0), 4, mode, decoding),
            "go",
            lambda: Timing(round(latency_s * 1e9), 0),
        )

    @property
    def cycle(self) -> GenerationCycle:
        return self.reasoner.cycle

    def run(self, until_s: float) -> None:
        while self.world.now_s < BEGIN_S + until_s:
            self.reasoner.release(self.world.now_ns)
            self.world.note()
            self.world.look()
            self.reasoner.start(self.world.now_ns)
            self.world.advance()


class ShellContract:
    """The promises."""

    @staticmethod
    def make(mode: Mode = Mode.ASYNC, latency_s: float = 1.0, decoding: Decoding = Decoding.CONSTRAINED) -> Shell:
        raise NotImplementedError

    def test_a_state_carries_the_stamp_and_pose_of_the_newest_frame_at_its_start(self) -> None:
        shell = self.make()
        shell.run(1.5)
        state = shell.world.states[0]
        assert (state.anchor_ns, state.T_odom_anchor) == (round(BEGIN_S * 1e9), SE2(0.0, 0.0, 0.0))
        assert [part[0, 0, 0] for part in state.context.values()] == [1.0, 2.0]
        assert (state.text, state.waypoints) == (TEXT, ((1.0, 0.0), (2.0, 0.0), (3.0, 0.0)))

    def test_the_next_generation_starts_when_the_one_before_is_released(self) -> None:
        shell = self.make(latency_s=1.0)
        shell.run(4.5)
        assert shell.world.published[:4] == [(1.0, 0.0, 0), (2.0, 1.0, 1), (3.0, 2.0, 2), (4.0, 3.0, 3)]

    def test_the_frames_are_those_at_the_configured_ages(self) -> None:
        shell = self.make(latency_s=2.0)
        shell.run(8.5)
        expected = [[0.0], [2.0], [1.0, 4.0], [3.0, 6.0]]
        assert [[stamp - BEGIN_S for stamp in stamps] for stamps in shell.language.prompts[:4]] == [
            pytest.approx(stamps) for stamps in expected
        ]

    def test_failures_in_quick_succession_end_reasoning(self) -> None:
        shell = self.make(latency_s=0.1)
        shell.language.broken = 100
        shell.run(30.0)
        assert shell.cycle.failed == FAILURES
        assert shell.cycle.failure is not None and "language_model: broken" in shell.cycle.failure
        assert shell.slot.state is None

    @pytest.mark.parametrize("poison", [np.nan, np.inf])
    def test_keys_and_values_that_are_not_finite_count_as_a_failure(self, poison: float) -> None:
        shell = self.make()
        shell.run(1.5)
        first = shell.slot.state
        shell.language.kv = KV.copy()
        shell.language.kv[0, 4, 7] = poison
        shell.run(2.5)
        assert first is not None and shell.slot.state is first
        assert shell.cycle.failed >= 1

    def test_a_policy_guided_by_waypoints_keeps_its_state_when_a_text_has_none(self) -> None:
        shell = self.make()
        shell.policy.guided_by_waypoints = True
        shell.run(1.5)
        first = shell.slot.state
        shell.language.text = "no waypoints here"
        shell.run(4.5)
        assert first is not None and shell.slot.state is first
        assert shell.cycle.invalid_in_a_row >= 2 and shell.cycle.failed == 0

    def test_without_reasoning_nothing_is_decoded_and_no_text_is_expected(self) -> None:
        shell = self.make(Mode.NO_REASONING, 0.2)
        shell.language.text = ""
        shell.run(2.0)
        assert set(shell.language.caps) == {0}
        assert shell.slot.state is not None and not shell.slot.state.text_complete
        assert shell.cycle.invalid_texts == 0

    def test_free_decoding_constrains_no_text(self) -> None:
        free, constrained = (self.make(decoding=decoding) for decoding in (Decoding.FREE, Decoding.CONSTRAINED))
        for shell in (free, constrained):
            shell.language.text = "Progress: turn 2 of 3, passed 0.\n" + TEXT
            shell.run(2.5)
        context = free.language.contexts[-1]
        assert context.before is not None and context == DecodingContext(context.before)
        assert constrained.language.contexts[-1].follow != FREE

    def test_in_sync_mode_the_robot_stands_until_there_is_a_state(self) -> None:
        assert self.make(Mode.SYNC).slot.drive_until_ns == 0

    def test_in_sync_mode_each_generation_is_driven_by_for_half_a_second_and_the_next_starts_at_rest(self) -> None:
        shell = self.make(Mode.SYNC, 2.0)
        shell.run(5.5)
        # The halt takes effect in the tick at 2.5 s, whose frame still shows motion.
        assert shell.world.published[:2] == [(2.0, 0.0, 0), (4.6, 2.6, 1)]
        assert shell.world.drive_until_s[:2] == [2.5, 5.1]


class TestReasoningThread(ShellContract):
    @staticmethod
    def make(mode: Mode = Mode.ASYNC, latency_s: float = 1.0, decoding: Decoding = Decoding.CONSTRAINED) -> Shell:
        return ThreadShell(mode, latency_s, decoding)


class TestVirtualTime(ShellContract):
    @staticmethod
    def make(mode: Mode = Mode.ASYNC, latency_s: float = 1.0, decoding: Decoding = Decoding.CONSTRAINED) -> Shell:
        return VirtualTimeShell(mode, latency_s, decoding)


@pytest.mark.parametrize("mode", list(Mode), ids=lambda mode: mode.value)
@pytest.mark.parametrize("latency_s", [0.1, 0.7, 2.0, 3.3])
def test_both_shells_publish_the_same_states_at_the_same_times(mode: Mode, latency_s: float) -> None:
    thread, virtual = ThreadShell(mode, latency_s), VirtualTimeShell(mode, latency_s)
    for shell in (thread, virtual):
        shell.run(20.0)
    count = min(len(thread.world.published), len(virtual.world.published))
    assert count >= 4
    assert thread.world.published[:count] == virtual.world.published[:count]
    assert thread.language.prompts[:count] == virtual.language.prompts[:count]
