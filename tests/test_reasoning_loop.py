"""The reasoning loop: one generation at a time, held back as told, published whole with its own anchor."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np

from edge.geometry import SE2
from edge.graph import GraphError
from edge.language import CancelledError, Generation
from edge.reasoning_loop import ReasoningLoop, SemanticSlot
from edge.ring import EncodedFrame, TokenRing

KV = np.zeros((1, 5, 8), dtype=np.float32)
TEXT = "Clear.\nwaypoints: (1.0, 0.0) (2.0, 0.0) (3.0, 0.0)"


class FakePrompt:
    def build(self, frames: list[EncodedFrame], instruction: str) -> list[EncodedFrame]:
        return list(frames)


class FakeLanguage:
    """Answers at once, except while `broken` says otherwise."""

    def __init__(self) -> None:
        self.prompt = FakePrompt()
        self.prompts: list[list[int]] = []
        self.broken = 0

    def generate(
        self, segments: list[EncodedFrame], *, max_new_tokens: int, cancelled: Callable[[], bool]
    ) -> Generation:
        if cancelled():
            raise CancelledError
        if self.broken:
            self.broken -= 1
            raise GraphError("language_model: broken")
        self.prompts.append([frame.stamp_ns for frame in segments])
        return Generation(TEXT, KV, (7,), 4, 1.0, 1.0)


class FakePolicy:
    def semantic_context(self, last_layer_kv: np.ndarray) -> dict[str, np.ndarray]:
        return {"context.0.key": last_layer_kv + 1, "context.0.value": last_layer_kv + 2}


class Bench:
    """A reasoning loop in a thread of its own, with frames that the test provides."""

    def __init__(self, delay_s: float = 0.0) -> None:
        self.language = FakeLanguage()
        self.ring = TokenRing(64)
        self.slot = SemanticSlot()
        self.stop = threading.Event()
        self.loop = ReasoningLoop(
            language=self.language,  # type: ignore[arg-type]
            policy=FakePolicy(),  # type: ignore[arg-type]
            ring=self.ring,
            slot=self.slot,
            instruction="go",
            frame_offsets_s=(0.0, 3.0),
            max_new_tokens=4,
            release_delay_s=lambda: delay_s,
            recorder=None,
            stop=self.stop,
        )
        self.thread = threading.Thread(target=self.loop.run)

    def __enter__(self) -> Bench:
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop.set()
        self.thread.join(5)
        assert not self.thread.is_alive()

    def frame(self, second: float) -> None:
        self.ring.put(EncodedFrame(round(second * 1e9), SE2(second, 0, 0), KV))

    def wait_for(self, generations: int) -> None:
        deadline = time.monotonic() + 5
        while self.loop.generations < generations and time.monotonic() < deadline:
            time.sleep(0.005)
        assert self.loop.generations >= generations


def test_a_state_carries_the_stamp_and_pose_of_its_newest_frame() -> None:
    with Bench() as bench:
        bench.frame(2.0)
        bench.wait_for(1)
        state = bench.slot.state
    assert state is not None
    assert state.anchor_ns == 2_000_000_000
    assert state.T_odom_anchor == SE2(2.0, 0.0, 0.0)
    assert state.waypoints == ((1.0, 0.0), (2.0, 0.0), (3.0, 0.0))
    assert [part[0, 0, 0] for part in state.context.values()] == [1.0, 2.0]


def test_the_same_frame_is_not_thought_about_twice() -> None:
    with Bench() as bench:
        bench.frame(2.0)
        bench.wait_for(1)
        time.sleep(0.1)
        assert bench.loop.generations == 1
        bench.frame(5.0)
        bench.wait_for(2)
    assert bench.language.prompts == [[2_000_000_000], [2_000_000_000, 5_000_000_000]]


def test_a_finished_generation_is_held_back_by_the_release_delay() -> None:
    with Bench(delay_s=0.3) as bench:
        started = time.monotonic()
        bench.frame(2.0)
        bench.wait_for(1)
        held = time.monotonic() - started
    assert held >= 0.3


def test_until_the_new_state_is_released_the_old_one_stays() -> None:
    with Bench(delay_s=0.3) as bench:
        bench.frame(2.0)
        bench.wait_for(1)
        first = bench.slot.state
        bench.frame(3.0)
        time.sleep(0.1)
        assert bench.slot.state is first
        bench.wait_for(2)
        assert bench.slot.state is not first


def test_a_failed_generation_is_counted_and_the_next_frame_is_tried() -> None:
    with Bench() as bench:
        bench.language.broken = 1
        bench.frame(2.0)
        time.sleep(0.1)
        assert (bench.loop.failed, bench.loop.generations) == (1, 0)
        bench.frame(3.0)
        bench.wait_for(1)


def test_a_stop_ends_a_generation_that_is_held_back() -> None:
    with Bench(delay_s=30.0) as bench:
        bench.frame(2.0)
        time.sleep(0.1)
    assert bench.slot.state is None
