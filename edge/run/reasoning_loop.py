"""The slow thread: frames from the ring buffer → generation → one assignment of a new semantic state (Algorithm 4)."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from enum import Enum

import numpy as np

from edge.core.stats import Samples
from edge.flightlog.recorder import Recorder
from edge.inference.graph import CancelledError, GraphError, Interrupt
from edge.inference.language import ContextOverflowError, Generation, GenerationRun, LanguageModel
from edge.inference.policy import Policy
from edge.inference.scheduling import REASONING_NICENESS, GiveWay, Role, enter
from edge.reasoning.anchor import Anchor
from edge.reasoning.decoding_rules import TextConstraint
from edge.reasoning.instruction_state import InstructionMemory, Job
from edge.reasoning.prompt import told_before
from edge.reasoning.sync_halt import seen_standing
from edge.state.reasoning_budget import UNLIMITED, ReasoningBudget
from edge.state.reasoning_text import parse_waypoints
from edge.state.ring import EncodedFrame, TokenRing
from edge.state.semantic import Context, SemanticSlot, SemanticState
from edge.state.switches import Decoding

IDLE_S = 0.02
FRAME_POLL_S = 0.002
"""How often a generation whose older frames are prefilled looks for its newest."""
ANCHOR_MARGIN_NS = 1_000_000_000
"""How much longer than the latest frame that it could use a generation waits for it."""
SYNC_DRIVE_S = 0.5
"""Paper, appendix D, synchronous inference: how long one generation is driven by."""
PREFIXES = 3
"""How many generations it is remembered of how long their older frames took."""
RETRY_S = 0.5
"""Rest after a failed generation."""
FAILURES = 5
FAILURE_WINDOW_S = 60.0
"""Fault matrix row 18: so many failures within this time end reasoning until the next start."""
SAMPLES = 8192
"""Generations whose times are kept exactly: hours of them."""


class Mode(Enum):
    """How reasoning and driving take turns (paper, Algorithms 3 and 4, appendix D)."""

    ASYNC = "async"
    """Both at once."""
    SYNC = "sync"
    """The robot halts while the VLM thinks, then drives 0.5 s on the result."""
    NO_REASONING = "no-reasoning"
    """Prefill only: a semantic state without a text."""


class NotFiniteError(RuntimeError):
    """Keys and values of a generation that hold a NaN or an infinity."""


class NoGuidanceError(RuntimeError):
    """A text without waypoints, for a policy that is guided by nothing else."""


class MissedFrameError(RuntimeError):
    """There was no frame at the planned instant, so the older ones are of no use."""


class ReasoningLoop:
    """Generates without pause; each result is held back by `release_delay_s()` before the control thread sees it.

    The queue of jobs has room for one, and the newest wins: a generation always begins with the newest frames, and
    `submit` replaces the job that waits as well as the one under way.
    """

    def __init__(
        self,
        *,
        language: LanguageModel,
        policy: Policy,
        ring: TokenRing,
        slot: SemanticSlot,
        instruction: str,
        frame_offsets_s: tuple[float, ...],
        max_new_tokens: int,
        release_delay_s: Callable[[], float],
        recorder: Recorder | None,
        stop: threading.Event,
        mode: Mode = Mode.ASYNC,
        decoding: Decoding = Decoding.CONSTRAINED,
        budget: Callable[[], ReasoningBudget] = lambda: UNLIMITED,
        late_anchor: bool = True,
        give_way: GiveWay | None = None,
        role: Role | None = None,
        say: Callable[[str], None] | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`budget` is asked before every call and must not wait; `give_way` where reasoning competes with the tick."""
        self._language = language
        self._policy = policy
        self._ring = ring
        self._slot = slot
        self._offsets_s = sorted({offset_s for offset_s in frame_offsets_s if offset_s > 0}, reverse=True)
        self._max_new_tokens = 0 if mode is Mode.NO_REASONING else max_new_tokens
        self._release_delay_s = release_delay_s
        self._recorder = recorder
        self._stop = stop
        self._sync = mode is Mode.SYNC
        self._budget = budget
        # A robot that stands gains nothing from a later frame.
        self._late_anchor = late_anchor and not self._sync
        self._give_way = give_way
        self._role = role or Role("reasoning", niceness=REASONING_NICENESS)
        self._say = say or (lambda _line: None)
        self._clock = clock
        self._decoding = decoding
        self._job = Job(0, instruction, InstructionMemory(None, instruction, decoding))
        self._under_way: tuple[Job, Interrupt] | None = None
        self._last_anchor_ns = -1
        self._finished_ns: int | None = None
        self._retry_ns = 0
        self._prefixes_ns: deque[int] = deque(maxlen=PREFIXES)
        self._context_ns = 0
        self._failures: deque[int] = deque(maxlen=FAILURES)
        if self._sync:
            slot.drive_until_ns = 0
        self.last_progress_ns = clock()
        """When this thread was last between two calls; it stands still while a call hangs and after its death."""
        self.failure: str | None = None
        """Why reasoning has ended for good (latched); None while it goes on."""
        self.generations = 0
        self.failed = 0
        self.cancelled = 0
        self.missed_frames = 0
        """Generations given up because there was no frame at the planned instant."""
        self.invalid_texts = 0
        """Complete texts that were not of the grammar; one that the budget or the mode cuts short is not counted."""
        self.invalid_in_a_row = 0
        self._busy = False
        self._computed_ns = 0
        self._computing_since_ns: int | None = None
        self.generation_ms = Samples(SAMPLES)
        self.anchor_to_ready_ms = Samples(SAMPLES)
        """Δt at release: from the newest frame's capture until its semantic state may be driven by."""
        self.late_anchor_ms = Samples(SAMPLES)
        """How much longer that would have been with the frame that was newest when the generation began."""

    @property
    def busy(self) -> bool:
        """Whether a generation is under way; one that is finished and held back is not."""
        return self._busy

    @property
    def busy_ns(self) -> int:
        """Time for which generations have been computed so far, without what they waited for; any thread."""
        since_ns, done_ns = self._computing_since_ns, self._computed_ns
        return done_ns if since_ns is None else done_ns + max(0, self._clock() - since_ns)

    @property
    def gave_way_ns(self) -> int:
        """Time for which reasoning has waited for ticks so far."""
        return 0 if self._give_way is None else self._give_way.waited_ns

    def submit(self, instruction: str) -> None:
        """Follow this (checked) instruction, its way from here on; the generation under way is ended. Never waits."""
        memory = InstructionMemory(self._ring.newest_ns, instruction, self._decoding)
        self._take_up(Job(self._job.number + 1, instruction, memory))

    def cancel(self) -> None:
        """End the generation under way, also within a call; the next one begins with the newest frames."""
        self._take_up(Job(self._job.number + 1, self._job.instruction, self._job.memory))

    def _take_up(self, job: Job) -> None:
        self._job = job
        under_way = self._under_way
        if under_way is not None and under_way[0] is not job:
            under_way[1].set()

    def run(self) -> None:
        """Loop until `stop`; a failed generation is counted and another one tried."""
        for line in enter(self._role):
            self._say(line)
        while not self._stop.is_set():
            if not self.step():
                self._stop.wait(IDLE_S)

    def step(self) -> bool:
        """One generation, if there is something to think about; returns whether a semantic state was published."""
        now_ns = self.last_progress_ns = self._clock()
        self._job.memory.watch(self._ring)
        budget = self._budget()
        if self.failure is not None or not budget.allowed or not self._is_due(now_ns, budget):
            return False
        job, interrupt = self._job, Interrupt()
        self._under_way = job, interrupt
        try:
            self._generate(job, interrupt, budget)
            return True
        except CancelledError:
            self.cancelled += not self._stop.is_set()
        except MissedFrameError:
            self.missed_frames += 1
        except NoGuidanceError:
            # The state before goes on growing old; the control thread slows down by its age.
            pass
        except (GraphError, ContextOverflowError, NotFiniteError) as error:
            self._fail(str(error))
        finally:
            self._under_way = None
            self._rest()
        return False

    def _is_due(self, now_ns: int, budget: ReasoningBudget) -> bool:
        """Whether every pause is over and there is a frame that has not been thought about."""
        newest_ns = self._ring.newest_ns
        if newest_ns is None or newest_ns <= self._last_anchor_ns or now_ns < self._retry_ns:
            return False
        if self._sync and not seen_standing(self._ring.newest(2), self._slot.drive_until_ns):
            return False
        return self._finished_ns is None or now_ns - self._finished_ns >= budget.pause_s * 1e9

    def _fail(self, why: str) -> None:
        now_ns = self._clock()
        self.failed += 1
        self._retry_ns = now_ns + round(RETRY_S * 1e9)
        self._failures.append(now_ns)
        if len(self._failures) == FAILURES and now_ns - self._failures[0] <= FAILURE_WINDOW_S * 1e9:
            self.failure = f"{FAILURES} generations failed within {FAILURE_WINDOW_S:g} s, the last one: {why}"
            self._say(f"reasoning has ended: {self.failure}")

    def _is_cancelled(self, job: Job) -> bool:
        self.last_progress_ns = self._clock()
        return self._stop.is_set() or self._job is not job

    def _generate(self, job: Job, interrupt: Interrupt, budget: ReasoningBudget) -> None:
        def cancelled() -> bool:
            return self._is_cancelled(job) or not self._budget().allowed

        def before_call(needs_ns: int) -> None:
            if self._give_way is not None:
                self._pause()
                self._give_way.wait(needs_ns, cancelled)
                self._compute()

        self._busy = True
        started_ns = self._compute()
        run = self._language.begin(cancelled, interrupt=interrupt, before_call=before_call)
        frames = self._prefill_older(run, job, cancelled)
        anchor, prompt = frames[-1], self._language.prompt
        # Whatever comes of it, this frame has been thought about.
        self._last_anchor_ns = anchor.stamp_ns
        cap = self._max_new_tokens if budget.max_new_tokens is None else budget.max_new_tokens
        most = min(self._max_new_tokens, cap)
        way, context = job.memory.way(self._ring, anchor), job.memory.context(anchor)
        rest = [prompt.frame(len(frames), anchor, job.instruction), prompt.tail(way, context.before)]
        constraint = self._language.constraint(context)
        generation = run.finish(rest, max_new_tokens=most, constraint=constraint)
        if not np.isfinite(generation.last_layer_kv).all():
            raise NotFiniteError("keys and values of the last layer are not finite")
        before_call(self._context_ns)
        context_started_ns = self._clock()
        semantic_context = self._policy.semantic_context(generation.last_layer_kv, interrupt)
        finished_ns = self._finished_ns = self._clock()
        self._context_ns = finished_ns - context_started_ns
        self._rest()
        delay_s = self._release_delay_s()
        self._hold_back(finished_ns + round(delay_s * 1e9), job)
        complete = self._max_new_tokens > 0 and (cap >= self._max_new_tokens or generation.new_tokens < cap)
        state = self._publish(anchor, generation, semantic_context, complete, job, constraint)
        self.generation_ms.add((finished_ns - started_ns) / 1e6)
        self.anchor_to_ready_ms.add((state.ready_ns - anchor.stamp_ns) / 1e6)
        if self._recorder is not None:
            record = {
                "generation": state.generation,
                "anchor_ns": anchor.stamp_ns,
                "anchor_pose": anchor.T_odom_base.as_tuple(),
                "started_ns": started_ns,
                "finished_ns": finished_ns,
                "ready_ns": state.ready_ns,
                "release_delay_s": delay_s,
                "instruction": job.instruction,
                "frames_ns": [frame.stamp_ns for frame in frames],
                "frame_poses": [frame.T_odom_base.as_tuple() for frame in frames],
                "way": way,
                "before": told_before(context.before),
                **context.record(),
                "overruled": constraint.overruled,
                "planned": constraint.planned,
                "stop": None if state.T_odom_stop is None else state.T_odom_stop.as_tuple(),
                "max_new_tokens": most,
                "prompt_tokens": generation.prompt_tokens,
                "new_tokens": generation.new_tokens,
                "text": generation.text,
                "waypoints": state.waypoints,
                "prefill_ms": generation.prefill_ms,
                "decode_ms": generation.decode_ms,
                "context_ms": self._context_ns / 1e6,
            }
            self._recorder.put("/semantic", state.ready_ns, record)

    def _compute(self) -> int:
        """From now on something is being computed; now."""
        now_ns = self._computing_since_ns = self._clock()
        return now_ns

    def _rest(self) -> None:
        """The generation, if there was one, has ended."""
        self._pause()
        self._busy = False

    def _pause(self) -> None:
        """Nothing is being computed now."""
        since_ns, self._computing_since_ns = self._computing_since_ns, None
        if since_ns is not None:
            self._computed_ns += self._clock() - since_ns

    def _prefill_older(self, run: GenerationRun, job: Job, cancelled: Callable[[], bool]) -> list[EncodedFrame]:
        """Feed the frames before the newest, then wait for that one; returns all, oldest first."""
        begun_ns = self._ring.newest_ns
        if begun_ns is None:
            raise MissedFrameError
        # The shortest of late: expecting too little moves the frame by less than its tolerance, too much is waited for.
        plan = Anchor.after(begun_ns, min(self._prefixes_ns, default=0)) if self._late_anchor else Anchor.now(begun_ns)
        frames: list[EncodedFrame] = []
        started_ns = self._clock()
        for offset_s in self._offsets_s:
            # Looked up when its turn comes: with a slow model it may not have been captured earlier.
            frame = self._ring.nearest(plan.older_ns(offset_s))
            if frame is None or not plan.is_older(frame.stamp_ns):
                continue
            if frames and frame.stamp_ns <= frames[-1].stamp_ns:
                continue
            frames.append(frame)
            run.feed([self._language.prompt.frame(len(frames), frame, job.instruction)])
        self._prefixes_ns.append(self._clock() - started_ns)
        self._pause()
        stamp_ns = self._await_anchor(plan, cancelled)
        self._compute()
        anchor = self._ring.nearest(stamp_ns)
        if anchor is None or (frames and anchor.stamp_ns <= frames[-1].stamp_ns):
            raise MissedFrameError
        self.late_anchor_ms.add((anchor.stamp_ns - begun_ns) / 1e6)
        return [*frames, anchor]

    def _await_anchor(self, plan: Anchor, cancelled: Callable[[], bool]) -> int:
        """Stamp of the newest frame to use, waited for until there is one; not for ever, should the camera stop."""
        since_ns, limit_ns = self._clock(), 0
        while True:
            newest_ns = self._ring.newest_ns
            if newest_ns is not None:
                stamp_ns = plan.choose(newest_ns)
                if stamp_ns is not None:
                    return stamp_ns
                # Frames and this clock need not share their origin: by how much the newest is too early.
                limit_ns = limit_ns or plan.planned_ns - newest_ns + plan.late_ns + ANCHOR_MARGIN_NS
            if cancelled():
                raise CancelledError
            if self._clock() - since_ns > (limit_ns or ANCHOR_MARGIN_NS):
                # The next one begins with a frame that has not come yet.
                self._last_anchor_ns = plan.begun_ns if newest_ns is None else newest_ns
                raise MissedFrameError
            self._stop.wait(FRAME_POLL_S)

    def _hold_back(self, until_ns: int, job: Job) -> None:
        while (left_ns := until_ns - self._clock()) > 0:
            job.memory.watch(self._ring)
            if self._is_cancelled(job) or self._stop.wait(min(left_ns / 1e9, IDLE_S)):
                raise CancelledError

    def _publish(
        self, anchor: EncodedFrame, generation: Generation, context: Context, complete: bool, job: Job,
        constraint: TextConstraint,
    ) -> SemanticState:  # fmt: skip
        waypoints = parse_waypoints(generation.text)
        if complete:
            self.invalid_in_a_row = 0 if waypoints is not None else self.invalid_in_a_row + 1
            self.invalid_texts += waypoints is None
        if waypoints is None and self._policy.guided_by_waypoints:
            raise NoGuidanceError
        job.memory.update(generation.text, constraint, anchor)
        ready_ns = self._clock()
        state = SemanticState(
            generation=self.generations,
            anchor_ns=anchor.stamp_ns,
            T_odom_anchor=anchor.T_odom_base,
            ready_ns=ready_ns,
            last_layer_kv=generation.last_layer_kv,
            context=context,
            text=generation.text,
            waypoints=waypoints,
            text_complete=complete,
            T_odom_stop=job.memory.stop,
        )
        # First the state, then the leave to drive: between the two, the old one has run out.
        self._slot.state = state
        if self._sync:
            self._slot.drive_until_ns = ready_ns + round(SYNC_DRIVE_S * 1e9)
        self.generations += 1
        return state
