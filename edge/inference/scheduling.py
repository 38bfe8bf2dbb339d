"""Sets cores and priority of each thread, locks memory, and makes reasoning wait for ticks."""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import resource
import threading
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from typing import TypeVar

from edge.artifacts.manifest import Artifacts
from edge.core.deadline import run_in_thread
from edge.core.device import shares_device
from edge.core.heap import freeze_garbage

Result = TypeVar("Result")

CONTROL_GRAPHS = ("vision_encoder", "action_expert")
CONTROL_NICENESS = -10
"""Niceness that the control thread requests where real-time priority is refused."""
REASONING_NICENESS = 10
SPARE_CORES = 1
"""Cores left to camera, odometry and recorder before reasoning's threads are pinned; with fewer, the operating system
distributes the cores better."""
PRIORITY_STEPS = 10
"""Distance in real-time priority from the late-command thread to the inputs' threads, and from them to reasoning."""
ROUND_NS = 1_000_000
"""Period at which a waiting reasoning thread checks again, ns."""
GAP_NS = 2_000_000
"""Time after a call for which its tick still counts as under way: between its two calls, and after them."""

_FIFO = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK  # processes that such a thread starts are ordinary ones
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4  # linux/mman.h


@dataclass(frozen=True)
class Role:
    """Scheduling of a thread; the defaults change nothing."""

    name: str
    cores: tuple[int, ...] = ()
    """Permitted cores; empty: all of the process."""
    priority: int | None = None
    """Priority of SCHED_FIFO, 1 to 99; None: ordinary scheduling."""
    niceness: int = 0
    """Niceness for ordinary scheduling, also where real-time priority is refused."""

    def __post_init__(self) -> None:
        if self.priority is not None and not 1 <= self.priority <= 99:
            raise ValueError(f"priority must be 1 to 99, found {self.priority}")
        if not -20 <= self.niceness <= 19:
            raise ValueError(f"niceness must be -20 to 19, found {self.niceness}")


@dataclass(frozen=True)
class Schedule:
    """The threads' roles, and whether control and reasoning compete for what computes.

    Every thread that takes the interpreter's lock needs a real-time priority: an ordinary thread that the kernel has
    set aside keeps the lock, or its turn to take it, and the control thread waits. Beside two busy programs on 2
    cores an ordinary reasoning thread waited up to 0.6 s, at niceness 10 and at -10.
    """

    control: Role
    late_command: Role
    """Thread that sends zero in place of a late command: above control and on any core, so that no tick delays it."""
    inputs: Role
    """Threads that read the robot, record or print."""
    reasoning: Role
    workers: Role
    """Further threads of the language model's graphs; on the same cores above reasoning, which spins until they end."""
    shared: bool
    """Whether reasoning can occupy a tick's core or accelerator, so that it has to wait for ticks."""
    notes: tuple[str, ...] = ()
    """Lines for the operator."""


def schedule_for(artifacts: Artifacts, allowed: Collection[int] | None = None) -> Schedule:
    """Return the schedule of a target's artifacts on this process's cores.

    Without permission for the target's real-time priority no thread gets one: the order of the others would be wrong.
    """
    runtime = artifacts.runtime
    reasoning_graphs = (*artifacts.language_graphs, "semantic_context")
    sessions = {name: graph.session for name, graph in artifacts.graphs.items()}
    priority = runtime.control_priority or None
    refusal = None if priority is None else priority_refusal(priority)
    schedule = make_schedule(
        control_cores=runtime.control_cores,
        reasoning_cores=runtime.reasoning_cores,
        control_priority=priority if refusal is None else None,
        allowed=os.sched_getaffinity(0) if allowed is None else allowed,
        control_threads=max(sessions[name].threads or 1 for name in CONTROL_GRAPHS),
        reasoning_threads=max(sessions[name].threads or 1 for name in reasoning_graphs),
        one_device=shares_device(
            [sessions[name].provider for name in CONTROL_GRAPHS], [sessions[name].provider for name in reasoning_graphs]
        ),
    )
    return schedule if refusal is None else replace(schedule, notes=(*schedule.notes, refusal))


def make_schedule(
    *,
    control_cores: tuple[int, ...],
    reasoning_cores: tuple[int, ...],
    control_priority: int | None,
    allowed: Collection[int],
    control_threads: int,
    reasoning_threads: int,
    one_device: bool,
) -> Schedule:
    """Return the roles from the target's settings and the available cores; pure.

    Without cores in the target, reasoning avoids the control thread's cores if enough others are available. A thread
    for whose real-time priority there is no number above 0 has an ordinary one. `control_priority` is the highest
    number that the runner's service permits (LimitRTPRIO): the late-command thread has it, control one less.
    """
    available = set(allowed)
    notes = [
        f"the target gives {name} cores {_list(cores)}, this process may use {_list(available)}: it runs on any of them"
        for name, cores in (("control", control_cores), ("reasoning", reasoning_cores))
        if not available.issuperset(cores)
    ]
    control = set(control_cores) if available.issuperset(control_cores) else set()
    reasoning = set(reasoning_cores) if available.issuperset(reasoning_cores) else set()
    if not reasoning and control:
        reasoning = available - control
    if not reasoning and len(available) >= control_threads + reasoning_threads + SPARE_CORES:
        reasoning = set(sorted(available)[:-control_threads])
    free = (control or available) - (reasoning or available)
    cores = tuple(sorted(reasoning))
    fifo = control_priority or 0
    inputs_priority = fifo - PRIORITY_STEPS if fifo > PRIORITY_STEPS else None
    lowest = fifo - 2 * PRIORITY_STEPS if fifo > 2 * PRIORITY_STEPS else None
    return Schedule(
        control=Role("control", tuple(sorted(control)), fifo - 1 if fifo > 1 else control_priority, CONTROL_NICENESS),
        late_command=Role("late-command", (), control_priority, CONTROL_NICENESS),
        inputs=Role("inputs", priority=inputs_priority),
        reasoning=Role("reasoning", cores, lowest, REASONING_NICENESS),
        # Without cores of their own they stay ordinary: an operator's stop must not wait for a core.
        workers=Role("reasoning's graphs", cores, lowest + 1 if lowest and cores else None, REASONING_NICENESS),
        shared=one_device or len(free) < control_threads,
        notes=tuple(notes),
    )


def _list(cores: Collection[int]) -> str:
    return ", ".join(str(core) for core in sorted(cores))


class ThreadCalls:
    """System calls for the calling thread's scheduling; each raises OSError when it is refused."""

    def set_cores(self, cores: Collection[int]) -> None:
        os.sched_setaffinity(0, cores)

    def set_fifo(self, priority: int) -> None:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))

    def set_niceness(self, niceness: int) -> None:
        # Linux niceness is per thread.
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), niceness)


def enter(role: Role, calls: ThreadCalls | None = None) -> list[str]:
    """Apply a role to the calling thread; return one line for the operator per refused setting, never an error."""
    calls = calls or ThreadCalls()
    lines: list[str] = []
    if role.cores:
        try:
            calls.set_cores(role.cores)
        except OSError as error:
            lines.append(f"{role.name} thread: cores {_list(role.cores)} refused ({error.strerror}): it runs on any")
    if role.priority is not None:
        try:
            calls.set_fifo(role.priority)
            return lines
        except OSError as error:
            lines.append(
                f"{role.name} thread: no real-time priority {role.priority} ({error.strerror}): other programs can "
                f"delay it; allow it with LimitRTPRIO={role.priority} in its service"
            )
    if role.niceness:
        # A negative value is refused to most users; the line about the priority covers it.
        with contextlib.suppress(OSError):
            calls.set_niceness(role.niceness)
    return lines


def priority_refusal(priority: int) -> str | None:
    """Request a real-time priority in a short-lived thread; return a line for the operator where it is refused."""
    lines: list[str] = []
    run_in_thread("priority", lambda: lines.extend(enter(Role("control", priority=priority))))
    return lines[0] if lines else None


def prepare_process(inputs: Role) -> list[str]:
    """Prepare for driving, once everything that lives as long as the process exists; return lines for the operator.

    It gives all Python threads that live now the inputs' real-time priority.
    """
    refused = lock_memory()
    freeze_garbage()
    for thread in threading.enumerate():
        if inputs.priority is not None and thread.native_id is not None:
            with contextlib.suppress(OSError):
                os.sched_setscheduler(thread.native_id, _FIFO, os.sched_param(inputs.priority))
    return [] if refused is None else [refused]


def run_as(role: Role | None, body: Callable[[], Result]) -> Result:
    """Run `body` in a thread of that role and wait for it: its child threads inherit cores and priority.

    The threads of libraries are such threads: ONNX Runtime's workers, and those that receive for DDS. Raises what
    `body` raises.
    """
    if role is None:
        return body()
    results: list[Result] = []

    def target() -> None:
        enter(role)
        results.append(body())

    run_in_thread(f"open {role.name}", target)
    return results[0]


def _mlockall(flags: int) -> int:
    """Return 0 or the error number."""
    library = ctypes.CDLL(None, use_errno=True)
    return 0 if library.mlockall(flags) == 0 else ctypes.get_errno()


def lock_memory(
    limit_bytes: int | None = None, mlockall: Callable[[int], int] = _mlockall, euid: int | None = None
) -> str | None:
    """Lock used pages in memory, so that no tick waits for a disk; return one line where it is not permitted.

    Call it after warm-up. Under a finite limit it locks nothing: later allocations beyond the limit would fail.
    """
    if limit_bytes is None:
        limit_bytes = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    privileged = (os.geteuid() if euid is None else euid) == 0
    if limit_bytes != resource.RLIM_INFINITY and not privileged:
        return f"memory is not locked: the limit is {limit_bytes} bytes; set LimitMEMLOCK=infinity in its service"
    number = mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT)
    if number:
        return f"memory is not locked ({os.strerror(number)}): a tick may wait for a page from disk"
    return None


class TickActivity:
    """Activity of the control thread, which writes instants and never waits; any thread may read them."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._started_ns: int | None = None
        self._ended_ns = 0
        self._busy = False

    def begin(self, now_ns: int) -> None:
        """Note the start of a tick's call (control thread)."""
        started_ns = self._started_ns
        # The second call of a tick does not start a new tick.
        if started_ns is None or now_ns - started_ns > self._period_ns // 2:
            self._started_ns = now_ns
        self._busy = True

    def end(self, now_ns: int) -> None:
        """Note the end of that call (control thread)."""
        self._ended_ns = now_ns
        self._busy = False

    def hold_ns(self, now_ns: int, needs_ns: int) -> int:
        """Return the time until the next check for a call that takes `needs_ns`, ns; 0: it may start.

        It waits for the tick under way, and for the next one if the call would overlap with it. A call that is longer
        than the whole gap starts at the beginning of a gap. It does not wait for ticks that have stopped.
        """
        started_ns, ended_ns = self._started_ns, self._ended_ns
        if started_ns is None or now_ns - started_ns > 2 * self._period_ns:
            return 0
        if self._busy:
            return ROUND_NS
        if now_ns - ended_ns < GAP_NS:
            return GAP_NS - max(0, now_ns - ended_ns)
        next_ns = started_ns + self._period_ns
        if now_ns >= next_ns:
            return ROUND_NS
        gap_ns = next_ns - ended_ns - GAP_NS
        if needs_ns <= next_ns - now_ns or (needs_ns > gap_ns and next_ns - now_ns > gap_ns // 2):
            return 0
        return next_ns - now_ns

    def gap_ns(self, now_ns: int) -> float:
        """Return the time between two ticks in which a call fits without a delay of the next, ns; inf without ticks."""
        started_ns, ended_ns = self._started_ns, self._ended_ns
        if started_ns is None or now_ns - started_ns > 2 * self._period_ns:
            return math.inf
        return max(0, self._period_ns - max(0, ended_ns - started_ns) - 2 * GAP_NS)


class GiveWay:
    """Makes reasoning wait for ticks; called before every call of a graph."""

    def __init__(
        self,
        activity: TickActivity,
        *,
        clock: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._activity = activity
        self._clock = clock
        self._sleep = sleep
        self.waited_ns = 0
        """Time waited so far."""

    def gap_ns(self) -> float:
        """Return the time between two ticks, ns: a call with guesses must fit into it."""
        return self._activity.gap_ns(self._clock())

    def wait(self, needs_ns: int, cancelled: Callable[[], bool]) -> None:
        """Block until a call of `needs_ns` may start or is cancelled."""
        started_ns = self._clock()
        while not cancelled():
            hold_ns = self._activity.hold_ns(self._clock(), needs_ns)
            if hold_ns == 0:
                break
            self._sleep(hold_ns / 1e9)
        self.waited_ns += self._clock() - started_ns
