"""The fast half of the model on buffers that are allocated once: the same numbers, and nothing shared by accident."""

from __future__ import annotations

import ctypes
import dataclasses
import gc
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from edge.artifacts.manifest import Artifacts
from edge.core.geometry import SE2
from edge.inference import scheduling
from edge.inference.graph import CancelledError, Graph, GraphError, Interrupt
from edge.inference.language import LanguageModel
from edge.inference.policy import Policy
from edge.inference.scheduling import Role, Schedule, TickActivity, schedule_for
from edge.state.semantic import Context, SemanticState

HERE = SE2(0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def policy(artifacts: Artifacts) -> Policy:
    return Policy(artifacts, threads=1)


def picture(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (1, 128, 128, 3)).astype(np.uint8)


def semantic(policy: Policy, artifacts: Artifacts, seed: int, tokens: int = 40) -> SemanticState:
    kv = np.random.default_rng(seed).standard_normal((1, tokens, artifacts.runtime.kv_dim)).astype(np.float32)
    return SemanticState(seed, 0, HERE, 0, kv, policy.semantic_context(kv), "", None)


def test_tokens_are_written_into_the_given_buffer(policy: Policy) -> None:
    own = policy.encode(picture(1))
    buffer = np.zeros(policy.tokens_shape, dtype=np.float32)
    assert policy.encode(picture(1), out=buffer) is buffer
    np.testing.assert_array_equal(buffer, own)


def test_the_next_frame_does_not_touch_the_tokens_of_the_last(policy: Policy) -> None:
    first = policy.encode(picture(1))
    kept = first.copy()
    policy.encode(picture(2))
    np.testing.assert_array_equal(first, kept)


class MallInfo(ctypes.Structure):
    """`struct mallinfo2` of glibc, bytes."""

    _fields_ = [
        (name, ctypes.c_size_t)
        for name in (
            "arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost",
        )
    ]  # fmt: skip


@pytest.mark.slow
def test_ticks_keep_no_memory_and_ask_the_system_for_none(policy: Policy, artifacts: Artifacts) -> None:
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "mallinfo2"):
        pytest.skip("mallinfo2 needs glibc 2.33")
    libc.mallinfo2.restype = MallInfo
    state, frame, tokens = semantic(policy, artifacts, 1), picture(1), np.zeros(policy.tokens_shape, np.float32)

    def memory_after(ticks: int) -> tuple[int, int]:
        for _ in range(ticks):
            policy.act(policy.encode(frame, tokens), (0.4, 0.0, 0.0), 1.0, HERE, state)
        gc.collect()
        info = libc.mallinfo2()
        return info.uordblks // 4096, info.arena + info.hblkhd

    (kept, asked), (kept_later, asked_later) = memory_after(30), memory_after(30)
    assert kept_later <= kept and asked_later <= asked


@pytest.mark.parametrize(
    "wrong",
    [
        lambda shape: np.zeros((1, 3, 3), dtype=np.float32),
        lambda shape: np.zeros(shape, dtype=np.float64),
        lambda shape: np.zeros((*shape[:-1], 2 * shape[-1]), dtype=np.float32)[..., ::2],
    ],
)
def test_a_buffer_that_tokens_do_not_fit_is_refused(
    policy: Policy, wrong: Callable[[tuple[int, ...]], np.ndarray]
) -> None:
    with pytest.raises(ValueError, match="contiguous float32"):
        policy.encode(picture(1), out=wrong(policy.tokens_shape))


def test_every_input_of_a_tick_counts_in_that_tick(policy: Policy, artifacts: Artifacts) -> None:
    """Bound buffers: a stale one would give the plan of the tick before."""
    tokens, other = policy.encode(picture(1)), policy.encode(picture(2))
    one, two = semantic(policy, artifacts, 1), semantic(policy, artifacts, 2, tokens=60)
    base = (tokens, (0.1, 0.0, 0.0), 1.0, HERE, one)
    changed = [
        (other, *base[1:]),
        (base[0], (0.9, 0.0, 0.3), *base[2:]),
        (*base[:2], 5.0, *base[3:]),
        (*base[:3], SE2(1.0, 0.5, 0.4), one),
        (*base[:4], two),
    ]
    before = policy.act(*base)
    for inputs in changed:
        assert not np.array_equal(policy.act(*inputs), before)
        np.testing.assert_array_equal(policy.act(*base), before)


def test_a_bound_tick_plans_what_a_graph_of_its_own_plans(policy: Policy, artifacts: Artifacts) -> None:
    tokens, state = policy.encode(picture(1)), semantic(policy, artifacts, 1)
    graph = Graph(artifacts, "action_expert", threads=1)
    feeds = {
        "visual_tokens": tokens,
        "state": np.array([[0.4, 0.0, 0.1]], dtype=np.float32),
        "latency": np.array([[2.0, 0.3, 0.1, 0.2]], dtype=np.float32),
        **state.context,
    }
    found = policy.act(tokens, (0.4, 0.0, 0.1), 2.0, SE2(0.3, 0.1, 0.2), state)
    np.testing.assert_array_equal(found, graph.run(feeds)[0][0])


def test_a_context_that_does_not_fit_the_graph_is_a_failure_of_that_tick_only(
    policy: Policy, artifacts: Artifacts
) -> None:
    """The control thread takes a GraphError for no plan at all; anything else would end it."""
    tokens, state = policy.encode(picture(1)), semantic(policy, artifacts, 1)
    good = policy.act(tokens, (0.0, 0.0, 0.0), 0.0, HERE, state)
    foreign = {**state.context, "context.0.key": np.zeros((1, 1, 1, 1), dtype=np.float32)}
    with pytest.raises(GraphError, match="action_expert"):
        policy.act(tokens, (0.0, 0.0, 0.0), 0.0, HERE, dataclasses.replace(state, context=foreign))
    np.testing.assert_array_equal(policy.act(tokens, (0.0, 0.0, 0.0), 0.0, HERE, state), good)


def test_a_semantic_context_can_be_interrupted(policy: Policy, artifacts: Artifacts) -> None:
    interrupt = Interrupt()
    interrupt.set()
    with pytest.raises(CancelledError):
        policy.semantic_context(np.zeros((1, 8, artifacts.runtime.kv_dim), dtype=np.float32), interrupt)


class Spy(TickActivity):
    """Records the calls of a tick."""

    def __init__(self) -> None:
        super().__init__(100_000_000)
        self.seen: list[str] = []

    def begin(self, now_ns: int) -> None:
        self.seen.append("begin")

    def end(self, now_ns: int) -> None:
        self.seen.append("end")


def test_a_computing_tick_is_visible_to_other_threads(artifacts: Artifacts) -> None:
    spy = Spy()
    policy = Policy(artifacts, threads=1, activity=spy)
    policy.semantic_context(np.zeros((1, 8, artifacts.runtime.kv_dim), dtype=np.float32))
    assert spy.seen == []
    policy.encode(picture(1))
    assert spy.seen == ["begin", "end"]


def test_a_context_from_waypoints_is_a_call_of_the_tick(artifacts: Artifacts) -> None:
    """Else reasoning would take the accelerator between the two calls of a tick."""
    spy = Spy()
    policy = Policy(artifacts, threads=1, activity=spy)
    state = dataclasses.replace(semantic(policy, artifacts, 1), waypoints=((1.0, 0.0), (2.0, 0.0)))

    def make_context(feeds: Context, interrupt: Interrupt | None = None) -> Context:
        spy.seen.extend(feeds)
        return state.context

    policy.guided_by_waypoints = True
    policy.make_context = make_context  # type: ignore[method-assign]
    policy.act(np.zeros(policy.tokens_shape, dtype=np.float32), (0.0, 0.0, 0.0), 0.0, HERE, state)
    assert spy.seen == ["begin", "waypoints", "end", "begin", "end"]


def test_a_graphs_own_workers_run_on_the_roles_cores(artifacts: Artifacts) -> None:
    """`/proc` knows where a thread may run."""
    core = max(os.sched_getaffinity(0))
    tasks = Path("/proc/self/task")
    before = {path.name for path in tasks.iterdir()}
    graph = Graph(artifacts, "action_expert", threads=2, cores=(core,))
    workers = [int(path.name) for path in tasks.iterdir() if path.name not in before]
    assert graph.name == "action_expert"
    assert [os.sched_getaffinity(worker) for worker in workers] == [{core}]


def test_artifacts_with_cores_of_their_own_make_a_schedule(
    artifacts: Artifacts, monkeypatch: pytest.MonkeyPatch
) -> None:
    runtime = dataclasses.replace(artifacts.runtime, control_cores=(7,), reasoning_cores=(5, 6), control_priority=40)
    monkeypatch.setattr(scheduling, "priority_refusal", lambda _priority: None)
    made = schedule_for(dataclasses.replace(artifacts, runtime=runtime), allowed=range(8))
    assert (made.control.cores, made.control.priority) == ((7,), 39)
    assert (made.reasoning.cores, made.reasoning.priority, made.shared) == ((5, 6), 20, False)
    assert schedule_for(artifacts, allowed={0}).shared


def test_the_language_models_workers_have_a_role_of_their_own(artifacts: Artifacts) -> None:
    """Else they would be as urgent as the control thread, whatever the thread that calls them is."""
    core = min(os.sched_getaffinity(0))
    workers_role = Role("workers", cores=(core,), niceness=17)
    control, late_command, inputs, reasoning = map(Role, ("control", "late-command", "inputs", "reasoning"))
    schedule = Schedule(control, late_command, inputs, reasoning, workers_role, shared=False)
    tasks = Path("/proc/self/task")
    before = {path.name for path in tasks.iterdir()}
    language = LanguageModel(artifacts, threads=2, schedule=schedule)
    workers = [int(path.name) for path in tasks.iterdir() if path.name not in before]
    assert language.runtime is artifacts.runtime
    assert workers
    assert {os.getpriority(os.PRIO_PROCESS, worker) for worker in workers} == {17}
    assert {frozenset(os.sched_getaffinity(worker)) for worker in workers} == {frozenset({core})}
