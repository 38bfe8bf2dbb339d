"""The reasoning thread: runs the generation cycle in real time, from the newest frames to a new semantic state.

Algorithm 4 of the paper. `edge.reasoning.generation_cycle` decides; this shell waits, computes and publishes.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from edge.core.stats import Samples
from edge.flightlog.recorder import RecordSink
from edge.inference.generation_task import GENERATION_ERRORS, GenerationModels, GenerationResult, GenerationTask
from edge.inference.graph import CancelledError, Interrupt
from edge.inference.scheduling import REASONING_NICENESS, GiveWay, Role, enter
from edge.reasoning.anchor import Anchor, older_frames
from edge.reasoning.generation_cycle import (
    UNLIMITED,
    Action,
    Anchored,
    Cancelled,
    CycleInputs,
    CycleOutputs,
    Event,
    Failed,
    Finished,
    FrameMissed,
    GenerationCycle,
    Mode,
    ReasoningBudget,
    ReasoningConfig,
)
from edge.reasoning.instruction_state import Instructions, Job
from edge.state.ring import EncodedFrame
from edge.state.semantic import SemanticState, SharedState

IDLE_S = 0.02
"""Pause between two checks for work or for the release of a held result, s."""
FRAME_POLL_S = 0.002
"""Polling period for the newest frame after the older ones are prefilled, s."""
ANCHOR_MARGIN_NS = 1_000_000_000
"""Time that a generation waits for its newest frame beyond the latest usable capture, ns."""
PREFIXES = 3
"""Number of recent prefill durations kept."""
SAMPLES = 8192
"""Number of generations whose durations are kept exactly: hours of driving."""

REASONING_ROLE = Role("reasoning", niceness=REASONING_NICENESS)
"""Role of a reasoning thread without cores of its own."""


@dataclass(frozen=True)
class ReasoningSchedule:
    """How the reasoning thread shares the machine, and when its results are released."""

    release_delay_s: Callable[[], float] = lambda: 0.0
    """Returns the release delay of the next result, s."""
    budget: Callable[[], ReasoningBudget] = lambda: UNLIMITED
    """Returns the power governor's budget; called before every graph call, so it must not wait."""
    give_way: GiveWay | None = None
    """Set where reasoning competes with control ticks for a core or the accelerator."""
    role: Role = REASONING_ROLE
    late_anchor: bool = True
    """Capture the newest frame after the older ones were prefilled. Sync mode ignores this: the robot stands."""


@dataclass(frozen=True)
class ReasoningOutputs:
    """Sinks of the reasoning thread's log records and messages."""

    recorder: RecordSink | None = None
    say: Callable[[str], None] = lambda _line: None
    """Takes one line for the operator."""


class _MissedFrameError(RuntimeError):
    """No frame was captured at the planned instant, so the prefilled frames are useless."""

    def __init__(self, newest_ns: int | None = None) -> None:
        super().__init__("no frame at the planned instant")
        self.newest_ns = newest_ns


@dataclass
class _ComputeTime:
    """Time that generations spent computing, without their waits, ns; one thread writes, any thread reads."""

    clock: Callable[[], int]
    done_ns: int = 0
    since_ns: int | None = None

    def begin(self) -> int:
        """Note that computing begins; return the current time, ns."""
        now_ns = self.since_ns = self.clock()
        return now_ns

    def end(self) -> None:
        """Note that computing ends; a second call changes nothing."""
        since_ns, self.since_ns = self.since_ns, None
        if since_ns is not None:
            self.done_ns += self.clock() - since_ns

    def total_ns(self) -> int:
        """Time so far."""
        since_ns, done_ns = self.since_ns, self.done_ns
        return done_ns if since_ns is None else done_ns + max(0, self.clock() - since_ns)


@dataclass
class ReasoningTimes:
    """Durations of the generations that became a semantic state, ms."""

    generation_ms: Samples = field(default_factory=lambda: Samples(SAMPLES))
    anchor_to_ready_ms: Samples = field(default_factory=lambda: Samples(SAMPLES))
    """Δt at release: from the newest frame's capture until the semantic state is published."""
    late_anchor_ms: Samples = field(default_factory=lambda: Samples(SAMPLES))
    """Reduction of Δt against an anchor at the newest frame when the generation began."""


class ReasoningLoop:
    """Generates without pause, one generation at a time.

    The queue of requests has room for one, and the newest wins: a generation always begins with the newest frames, and
    `submit` replaces the request that waits as well as the generation under way.
    """

    def __init__(
        self,
        models: GenerationModels,
        shared: SharedState,
        config: ReasoningConfig,
        instruction: str,
        *,
        stop: threading.Event,
        schedule: ReasoningSchedule | None = None,
        outputs: ReasoningOutputs | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._models = models
        self._ring, self._slot = shared.ring, shared.slot
        self._offsets_s = config.older_offsets_s
        self._schedule = schedule or ReasoningSchedule()
        # A robot that stands gains nothing from a later frame.
        self._late_anchor = self._schedule.late_anchor and config.mode is not Mode.SYNC
        self._outputs = outputs or ReasoningOutputs()
        self._stop = stop
        self._clock = clock
        self._instructions = Instructions(config, shared.slot, instruction)
        self._job = self._instructions.job
        self._under_way: tuple[Job, Interrupt] | None = None
        self._prefixes_ns: deque[int] = deque(maxlen=PREFIXES)
        self._context_ns = 0
        self._computing = _ComputeTime(clock)
        self.cycle = GenerationCycle(config)
        """Counts of generations and the reason why reasoning has ended; any thread may read them."""
        self._slot.drive_until_ns = self.cycle.drive_until_ns
        self.times = ReasoningTimes()
        self.last_progress_ns = clock()
        """Stamp of the last instant between two calls, ns; it stays constant while a call hangs."""
        self.busy = False
        """Whether a generation is computing; a finished result that is held back does not count."""

    @property
    def busy_ns(self) -> int:
        """Time that generations have spent computing so far, without their waits; any thread."""
        return self._computing.total_ns()

    @property
    def gave_way_ns(self) -> int:
        """Time for which reasoning has waited for ticks so far."""
        give_way = self._schedule.give_way
        return 0 if give_way is None else give_way.waited_ns

    def submit(self, instruction: str) -> None:
        """Follow this (checked) instruction from now on and end the generation under way. Never waits."""
        self._replace(self._instructions.next(instruction, self._ring.newest_ns))

    def cancel(self) -> None:
        """End the generation under way, also within a call; the next one begins with the newest frames."""
        self._replace(self._instructions.again())

    def _replace(self, job: Job) -> None:
        self._job = job
        under_way = self._under_way
        if under_way is not None and under_way[0] is not job:
            under_way[1].set()

    def run(self) -> None:
        """Run generations until `stop`; count failures and try again."""
        for line in enter(self._schedule.role):
            self._outputs.say(line)
        while not self._stop.is_set():
            if not self.step():
                self._stop.wait(IDLE_S)

    def step(self) -> bool:
        """Run one generation if one may start; returns whether a semantic state was published."""
        job, interrupt = self._job, Interrupt()
        if not self._instructions.ready(job, self._ring.newest_ns):
            self.cycle.pause()
            self.last_progress_ns = self._clock()  # this wait is no call that hangs
            return False
        job.memory.watch(self._ring)
        outputs = self._advance(starting=job)
        if outputs.action is not Action.START:
            return False
        self._under_way = job, interrupt
        try:
            return self._generate(GenerationTask(self._models, job, outputs.max_new_tokens), interrupt)
        except CancelledError:
            self._advance(Cancelled())
        except _MissedFrameError as error:
            self._advance(FrameMissed(error.newest_ns))
        except GENERATION_ERRORS as error:
            self._advance(Failed(str(error)))
            if self.cycle.failure is not None:
                self._outputs.say(f"reasoning has ended: {self.cycle.failure}")
        finally:
            self._under_way = None
            self._rest()
        return False

    def _advance(
        self, event: Event | None = None, *, starting: Job | None = None, now_ns: int | None = None
    ) -> CycleOutputs:
        """Step the cycle, by default now; `starting`: the job that a generation may start for."""
        if now_ns is None:
            now_ns = self.last_progress_ns = self._clock()
        frames = () if starting is None else self._ring.newest(2)
        # Not the newest job: a request that comes in between replaces the generation that starts here.
        request = (starting or self._job).number
        inputs = CycleInputs(frames, request, self._schedule.budget(), self._stop.is_set(), event)
        return self.cycle.step(inputs, now_ns)

    def _generate(self, task: GenerationTask, interrupt: Interrupt) -> bool:
        context_started_ns = 0

        def cancelled() -> bool:
            return self._advance().action is Action.INTERRUPT

        def before_call(needs_ns: int) -> None:
            if self._schedule.give_way is not None:
                self._computing.end()
                self._schedule.give_way.wait(needs_ns, cancelled)
                self._computing.begin()

        def before_context() -> None:
            nonlocal context_started_ns
            before_call(self._context_ns)
            context_started_ns = self._clock()

        self.busy = True
        started_ns = self._computing.begin()
        give_way = self._schedule.give_way
        run = self._models.language.begin(
            cancelled,
            interrupt=interrupt,
            before_call=before_call,
            longest_guess_ns=(lambda: math.inf) if give_way is None else give_way.gap_ns,
        )
        begun_ns = self._ring.newest_ns
        if begun_ns is None:
            raise _MissedFrameError
        # The shortest recent prefill: an estimate that is too short shifts the frame by less than its tolerance; with
        # one that is too long the generation waits.
        prefix_ns = min(self._prefixes_ns, default=0)
        plan = Anchor.after(begun_ns, prefix_ns) if self._late_anchor else Anchor.now(begun_ns)
        prefill_started_ns = self._clock()
        older = older_frames(self._ring, plan, self._offsets_s, task.job.memory.from_ns)
        for number, frame in enumerate(older, 1):
            task.older.append(frame)
            task.prefill(run, number, frame)
        self._prefixes_ns.append(self._clock() - prefill_started_ns)
        anchor = self._await_anchor(plan, task, cancelled)
        self.times.late_anchor_ms.add((anchor.stamp_ns - begun_ns) / 1e6)
        self._advance(Anchored(anchor.stamp_ns))
        task.set_anchor(anchor, self._ring)
        result = task.finish(run, interrupt, before_context)
        finished_ns = self._clock()
        self._context_ns = finished_ns - context_started_ns
        self._rest()
        delay_s = self._schedule.release_delay_s()
        outputs, ready_ns = self._hold_back(task, result, finished_ns, finished_ns + round(delay_s * 1e9))
        if outputs.action is not Action.PUBLISH:
            return False
        number = self.cycle.published - 1
        state = task.publish(result, number=number, ready_ns=ready_ns, text_complete=outputs.text_complete)
        # First the state, then the permission to drive: between the two, the earlier permission has run out.
        self._slot.state = state
        published_ns = self._clock()
        self._slot.drive_until_ns = outputs.drive_until_ns
        self.times.generation_ms.add((finished_ns - started_ns) / 1e6)
        self.times.anchor_to_ready_ms.add((ready_ns - anchor.stamp_ns) / 1e6)
        self._record(task, result, state, (started_ns, finished_ns, published_ns), delay_s)
        return True

    def _rest(self) -> None:
        """End the generation under way, if any."""
        self._computing.end()
        self.busy = False

    def _await_anchor(self, plan: Anchor, task: GenerationTask, cancelled: Callable[[], bool]) -> EncodedFrame:
        """Wait for the planned newest frame and return it; the wait does not count as computing."""
        self._computing.end()
        stamp_ns = self._await_stamp(plan, cancelled)
        self._computing.begin()
        anchor = self._ring.nearest(stamp_ns)
        if anchor is None or (task.older and anchor.stamp_ns <= task.older[-1].stamp_ns):
            raise _MissedFrameError
        return anchor

    def _await_stamp(self, plan: Anchor, cancelled: Callable[[], bool]) -> int:
        """Return the stamp of the newest frame to use, ns; give up after a limited time in case the camera stops."""
        since_ns, limit_ns = self._clock(), 0
        while True:
            newest_ns = self._ring.newest_ns
            if newest_ns is not None:
                stamp_ns = plan.choose(newest_ns)
                if stamp_ns is not None:
                    return stamp_ns
                # Measured between frame stamps, since this clock's origin may differ from theirs.
                limit_ns = limit_ns or plan.planned_ns - newest_ns + plan.late_ns + ANCHOR_MARGIN_NS
            if cancelled():
                raise CancelledError
            if self._clock() - since_ns > (limit_ns or ANCHOR_MARGIN_NS):
                raise _MissedFrameError(plan.begun_ns if newest_ns is None else newest_ns)
            self._stop.wait(FRAME_POLL_S)

    def _hold_back(
        self, task: GenerationTask, result: GenerationResult, finished_ns: int, release_ns: int
    ) -> tuple[CycleOutputs, int]:
        """Wait until the result is released or dropped; return the decision and its instant, ns."""
        needs_waypoints = self._models.policy.guided_by_waypoints
        new_tokens, has_waypoints = result.generation.new_tokens, result.waypoints is not None
        now_ns = finished_ns
        finished = Finished(release_ns, new_tokens, has_waypoints, needs_waypoints)
        outputs = self._advance(finished, now_ns=now_ns)
        while outputs.action is Action.HOLD:
            task.job.memory.watch(self._ring)
            self._stop.wait(min((release_ns - now_ns) / 1e9, IDLE_S))
            now_ns = self.last_progress_ns = self._clock()
            outputs = self._advance(now_ns=now_ns)
        return outputs, now_ns

    def _record(
        self,
        task: GenerationTask,
        result: GenerationResult,
        state: SemanticState,
        times_ns: tuple[int, int, int],
        delay_s: float,
    ) -> None:
        """Log a generation; `times_ns`: when it started and finished, and when the control thread could read it."""
        if self._outputs.recorder is None:
            return
        record = {
            "started_ns": times_ns[0],
            "finished_ns": times_ns[1],
            "published_ns": times_ns[2],
            "release_delay_s": delay_s,
            **task.state_record(result, state),
            "context_ms": self._context_ns / 1e6,
        }
        self._outputs.recorder.put("/semantic", state.ready_ns, record)
