"""A reasoning loop with a fake language model, frames and a clock that the test provides."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import cast

import numpy as np

from edge.core.geometry import SE2
from edge.inference.generation_task import GenerationModels
from edge.inference.graph import CancelledError, GraphError, Interrupt
from edge.inference.language import Generation
from edge.inference.scheduling import Role
from edge.reasoning.decoding_rules import DecodingContext, TurnObservation
from edge.reasoning.generation_cycle import Mode, ReasoningBudget, ReasoningConfig
from edge.reasoning.path_memory import PastPath
from edge.run.reasoning_loop import ReasoningLoop, ReasoningOutputs, ReasoningSchedule
from edge.state.reasoning_text import Progress
from edge.state.ring import EncodedFrame, TokenRing
from edge.state.semantic import SemanticSlot, SharedState
from edge.state.switches import Decoding

KV = np.zeros((1, 5, 8), dtype=np.float32)
TEXT = "Clear.\nwaypoints: (1.0, 0.0) (2.0, 0.0) (3.0, 0.0)"


class FakePrompt:
    """Parts of a prompt are what they are made of: (frame stamp in s, instruction), or "tail"."""

    def frame(self, number: int, frame: EncodedFrame, instruction: str) -> tuple[float, str]:
        return (frame.stamp_ns / 1e9, instruction)

    def __init__(self) -> None:
        self.told: list[tuple[PastPath, Progress | None]] = []

    def tail(self, way: PastPath, before: Progress | None) -> str:
        self.told.append((way, before))
        return "tail"


class FakeRun:
    def __init__(self, language: FakeLanguage, cancelled: Callable[[], bool], interrupt: Interrupt | None) -> None:
        self.language, self.cancelled, self.interrupt = language, cancelled, interrupt
        self.parts: list[object] = []

    def feed(self, segments: list[object]) -> None:
        self.parts += segments
        self.language.during_feed()
        if self.cancelled():
            raise CancelledError

    def finish(self, segments: list[object], *, max_new_tokens: int, constraint: object = None) -> Generation:
        if self.cancelled():
            raise CancelledError
        if self.language.broken:
            self.language.broken -= 1
            raise GraphError("language_model: broken")
        self.language.during_finish(self)
        if self.cancelled():
            raise CancelledError
        stamps = [part[0] for part in (*self.parts, *segments) if isinstance(part, tuple)]
        self.language.prompts.append(stamps)
        self.language.instructions.append(segments[0][1])
        self.language.caps.append(max_new_tokens)
        new = min(max_new_tokens, self.language.new_tokens)
        return Generation(self.language.text, self.language.kv, (7,) * new, 4, 1.0, 1.0, (1,) * (new + 1), 0, 0)


class FakeConstraint:
    """Finds in a text what its language says that is in it."""

    def __init__(self, language: FakeLanguage) -> None:
        self._language = language

    @property
    def overruled(self) -> bool:
        return self._language.overruled

    @property
    def turn(self) -> TurnObservation | None:
        return self._language.turn

    @property
    def refused(self) -> str | None:
        return self._language.refused

    planned = ""

    @property
    def has_plan(self) -> bool:
        return self._language.has_plan


class FakeLanguage:
    """Answers at once; what else a test wants of it happens during its calls."""

    def __init__(self) -> None:
        self.prompt = FakePrompt()
        self.prompts: list[list[float]] = []
        self.instructions: list[str] = []
        self.caps: list[int] = []
        self.contexts: list[DecodingContext] = []
        self.overruled, self.turn = False, cast("TurnObservation | None", None)
        self.refused, self.has_plan = cast("str | None", None), True
        self.text, self.kv, self.new_tokens, self.broken = TEXT, KV, 3, 0
        self.during_feed: Callable[[], None] = lambda: None
        self.during_finish: Callable[[FakeRun], None] = lambda run: None

    def constraint(self, context: DecodingContext) -> FakeConstraint:
        self.contexts.append(context)
        return FakeConstraint(self)

    def begin(
        self,
        cancelled: Callable[[], bool],
        *,
        interrupt: Interrupt | None = None,
        before_call: Callable[[int], None] | None = None,
        longest_guess_ns: Callable[[], float] | None = None,
    ) -> FakeRun:
        return FakeRun(self, cancelled, interrupt)


class FakePolicy:
    guided_by_waypoints = False

    def semantic_context(self, last_layer_kv: np.ndarray, interrupt: Interrupt | None = None) -> dict[str, np.ndarray]:
        return {"context.0.key": last_layer_kv + 1, "context.0.value": last_layer_kv + 2}


class Bench:
    """A reasoning loop with frames and a clock that the test provides; a thread only inside `with`."""

    def __init__(
        self,
        delay_s: float = 0.0,
        *,
        mode: Mode = Mode.ASYNC,
        decoding: Decoding = Decoding.CONSTRAINED,
        late_anchor: bool = True,
        priority: int | None = None,
        give_way: object = None,
        stop: threading.Event | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
        instruction: str = "go",
    ) -> None:
        self.language = FakeLanguage()
        self.policy = FakePolicy()
        self.ring = TokenRing(256)
        self.slot = SemanticSlot()
        self.stop = stop or threading.Event()
        self.budget = ReasoningBudget()
        self.said: list[str] = []
        self.records: list[dict[str, object]] = []
        recorder = SimpleNamespace(put=lambda topic, stamp, record: self.records.append(record))
        self.loop = ReasoningLoop(
            GenerationModels(self.language, self.policy),  # type: ignore[arg-type]
            SharedState(self.ring, self.slot),
            ReasoningConfig((0.0, 3.0), 4, mode, decoding),
            instruction,
            stop=self.stop,
            schedule=ReasoningSchedule(
                release_delay_s=lambda: delay_s,
                budget=lambda: self.budget,
                give_way=give_way,  # type: ignore[arg-type]
                role=Role("reasoning", priority=priority),
                late_anchor=late_anchor,
            ),
            outputs=ReasoningOutputs(recorder, self.said.append),  # type: ignore[arg-type]
            clock=clock,
        )
        self.cycle = self.loop.cycle
        self.thread = threading.Thread(target=self.loop.run)

    def __enter__(self) -> Bench:
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop.set()
        self.thread.join(5)
        assert not self.thread.is_alive()

    def frame(self, second: float, x_m: float | None = None) -> None:
        """A frame, captured at `x_m`; without one the robot is driving at 1 m/s."""
        self.ring.put(EncodedFrame(round(second * 1e9), SE2(second if x_m is None else x_m, 0, 0), KV))

    def wait_for(self, what: Callable[[], bool]) -> None:
        deadline = time.monotonic() + 5
        while not what() and time.monotonic() < deadline:
            time.sleep(0.005)
        assert what()


class Clock:
    """Seconds that pass when the test says so."""

    def __init__(self) -> None:
        self.s = 100.0

    def __call__(self) -> int:
        return round(self.s * 1e9)
