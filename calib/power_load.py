"""Runs the artifacts' stages in phases while a meter is read, and integrates its power over each phase."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from calib.power_fit import Phase
from edge.artifacts.manifest import Artifacts
from edge.core.geometry import SE2
from edge.inference.start_guard import WARM_UP_S
from edge.inference.warm_up import open_proven
from edge.power.governor.plan import STAGES
from edge.power.meters.meter import MeterError, PowerMeter, PowerSample
from edge.reasoning.prompt import EXAMPLE_BEFORE, EXAMPLE_PAST_PATH
from edge.state.ring import EncodedFrame
from edge.state.semantic import STRAIGHT_AHEAD, SemanticState, waypoints_now

INSTRUCTION: Final = "walk down the corridor and stop at the vending machine"
READ_S: Final = 0.05
AWAIT_S: Final = 2.0
LEAST_COVERED: Final = 0.9
REST_S: Final = 0.5
"""Pause between phases, so that raised clocks do not last into the next."""


@dataclass
class Counts:
    """Counts of the units that each stage has run, in all threads."""

    done: dict[str, float] = field(default_factory=lambda: dict.fromkeys(STAGES, 0.0))
    lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, stage: str, units: float = 1.0) -> None:
        """Count units of a stage."""
        with self.lock:
            self.done[stage] += units

    def copy(self) -> dict[str, float]:
        """Return the counts so far."""
        with self.lock:
            return dict(self.done)


class EnergyLog:
    """Reads a meter all the time and integrates its power between two instants."""

    def __init__(self, meter: PowerMeter, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._meter = meter
        self._clock = clock
        self._samples: list[PowerSample] = []
        self.error: str | None = None

    @contextmanager
    def running(self) -> Iterator[EnergyLog]:
        """Read in a separate thread during the block."""
        stop = threading.Event()

        def read() -> None:
            while not stop.wait(READ_S):
                self.read_once()

        thread = threading.Thread(target=read, name="power-meter", daemon=True)
        thread.start()
        try:
            yield self
        finally:
            stop.set()
            thread.join(1.0)

    def read_once(self) -> None:
        """One reading; an error is kept and the reading left out."""
        try:
            self._samples.append(self._meter.read(self._clock()))
        except MeterError as error:
            self.error = str(error)

    def await_reading(self, after_ns: int) -> None:
        """Wait for a reading from after that instant, at most 2 s: the last part of a phase is in it."""
        for _ in range(round(AWAIT_S / READ_S)):
            if self._samples and self._samples[-1].stamp_ns >= after_ns:
                return
            time.sleep(READ_S)

    def energy_j(self, begin_ns: int, end_ns: int) -> float:
        """Return the energy, J; each sample covers the time since the previous one. Raises MeterError for too few."""
        samples = list(self._samples)
        energy, covered = 0.0, 0
        for before, sample in itertools.pairwise(samples):
            length = min(sample.stamp_ns, end_ns) - max(before.stamp_ns, begin_ns)
            if length > 0 and sample.stamp_ns - before.stamp_ns < 1_000_000_000:
                energy += sample.total_w * length / 1e9
                covered += length
        length_ns = end_ns - begin_ns
        if covered < LEAST_COVERED * length_ns:
            why = f" ({self.error})" if self.error else ""
            raise MeterError(
                f"{self._meter.source}: readings cover {100 * covered / max(length_ns, 1):.0f} % of a phase, expected "
                f"{100 * LEAST_COVERED:.0f} % or more{why}"
            )
        return energy * length_ns / covered


class Load:
    """The stages of one artifact directory, ready for repeated runs."""

    def __init__(self, artifacts: Artifacts, counts: Counts) -> None:
        """Open and prove the graphs and run each once. Raises ArtifactError or GraphError."""
        self._runtime, self._counts = artifacts.runtime, counts
        opened = open_proven(artifacts)
        self._policy, self._language = opened.policy, opened.language
        with opened.guard.stage("warming up", WARM_UP_S):
            self._run_once()

    def _run_once(self) -> None:
        """Run each graph and keep its outputs as inputs of the phases."""
        runtime, here = self._runtime, SE2(0.0, 0.0, 0.0)
        rng = np.random.default_rng(0)
        self._image = rng.integers(0, 256, (1, runtime.image_px, runtime.image_px, 3)).astype(np.uint8)
        tokens = self._policy.encode(self._image).copy()
        frames = [EncodedFrame(i, here, tokens) for i in range(len(runtime.frame_offsets_s))]
        self._tokens, self._here = tokens, here
        self._segments = self._language.prompt.build(frames, INSTRUCTION, EXAMPLE_PAST_PATH, EXAMPLE_BEFORE)
        generation = self._language.generate(
            self._segments, max_new_tokens=runtime.max_new_tokens, cancelled=lambda: False
        )
        self._kv = generation.last_layer_kv
        context = self._policy.semantic_context(self._kv)
        self._semantic = SemanticState(0, 0, here, 0, self._kv, context, generation.text, STRAIGHT_AHEAD)
        self.prompt_tokens, self.new_tokens = generation.prompt_tokens, generation.new_tokens
        self._act()

    def phases(self) -> Mapping[str, tuple[Callable[[float], None], bool]]:
        """Return the phases by name: a function that runs until a monotonic time, s, and whether it is only a check."""
        return {
            "idle": (_sleep_until, False),
            "vision_encoder": (self._repeat(self._encode), False),
            "semantic_context": (self._repeat(self._context), False),  # before the phase that may contain it
            "action_expert": (self._repeat(self._act), False),
            "prefill": (self._repeat(lambda: self._generate(0)), False),
            "decode": (self._repeat(lambda: self._generate(self._runtime.max_new_tokens)), False),
            "control": (self._control, True),
            "control and reasoning": (self._both, True),
        }

    def _encode(self) -> None:
        self._policy.encode(self._image)
        self._counts.add("vision_encoder")

    def _act(self) -> None:
        self._policy.act(self._tokens, (0.0, 0.0, 0.0), 1.0, self._here, self._semantic)
        self._counts.add("action_expert")
        if self._policy.guided_by_waypoints:  # its context is a part of every tick
            self._counts.add("semantic_context")

    def _context(self) -> None:
        if self._policy.guided_by_waypoints:
            self._policy.make_context({"waypoints": waypoints_now(STRAIGHT_AHEAD, self._here)})
        else:
            self._policy.semantic_context(self._kv)
        self._counts.add("semantic_context")

    def _generate(self, tokens: int) -> None:
        generation = self._language.generate(self._segments, max_new_tokens=tokens, cancelled=lambda: False)
        self._counts.add("prefill")
        self._counts.add("decode", generation.new_tokens)

    @staticmethod
    def _repeat(call: Callable[[], None]) -> Callable[[float], None]:
        def until(end_s: float) -> None:
            call()  # a phase that is shorter than its call still has one
            while time.monotonic() < end_s:
                call()

        return until

    def _control(self, end_s: float) -> None:
        period_s = self._runtime.tick_period_ms / 1e3
        next_s = time.monotonic()
        while next_s < end_s:
            self._encode()
            self._act()
            next_s = max(next_s + period_s, time.monotonic())
            time.sleep(max(0.0, min(next_s, end_s) - time.monotonic()))

    def _both(self, end_s: float) -> None:
        def reason() -> None:
            # To the end of a generation: the energy of a part would not be counted.
            while time.monotonic() < end_s:
                self._generate(self._runtime.max_new_tokens)
                if not self._policy.guided_by_waypoints:
                    self._context()

        thread = threading.Thread(target=reason, name="reasoning")
        thread.start()
        try:
            self._control(end_s)
        finally:
            thread.join()


def _sleep_until(end_s: float) -> None:
    time.sleep(max(0.0, end_s - time.monotonic()))


def run_phases(
    load: Load, counts: Counts, log: EnergyLog, *, seconds: float, rounds: int, say: Callable[[str], None]
) -> list[Phase]:
    """Run every phase for that long, once a round; raises MeterError when the meter loses too many samples."""
    found: list[Phase] = []
    with log.running():
        for number in range(rounds):
            for name, (run, check) in load.phases().items():
                time.sleep(min(REST_S, seconds / 5))
                before, begin_ns = counts.copy(), time.monotonic_ns()
                run(begin_ns / 1e9 + seconds)
                end_ns, after = time.monotonic_ns(), counts.copy()
                log.await_reading(end_ns)
                ran = {stage: after[stage] - before[stage] for stage in STAGES if after[stage] > before[stage]}
                phase = Phase(name, (end_ns - begin_ns) / 1e9, log.energy_j(begin_ns, end_ns), ran, check)
                say(f"round {number + 1}/{rounds}: {name} {phase.power_w:.2f} W")
                found.append(phase)
    return found
