"""What both loops remember for as long as an instruction is followed: its way, and the progress that was said last."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import pytest

from edge.core.geometry import SE2
from edge.inference.generation_task import GenerationModels
from edge.reasoning.decoding_rules import BACK, DONE, EITHER_WAY, FREE, MAX_REFUSALS, ONWARD, TurnObservation
from edge.reasoning.generation_cycle import ReasoningBudget, ReasoningConfig
from edge.reasoning.instruction_state import InstructionMemory
from edge.reasoning.path_memory import PastPath, PathMemory, past_path_of
from edge.state.reasoning_text import LEFT, RIGHT, Progress
from edge.state.ring import EncodedFrame, TokenRing
from edge.state.semantic import SemanticSlot, SharedState
from sim_hil.benchmark.conditions.latency import Timing
from sim_hil.benchmark.policies.virtual_time_reasoner import VirtualTimeReasoner
from tests.support.runner.reasoning_bench import KV, Bench, Clock, FakeLanguage, FakePolicy

TICK_NS = 100_000_000
LINE = "\nwaypoints: (1.0, 0.0) (2.0, 0.0) (3.0, 0.0)"
FIRST = "Progress: turn 1 of 3, passed 2." + LINE


def pose_at(tick: int) -> SE2:
    """Round a square of 8 m at 0.8 m/s."""
    side, along = divmod(0.08 * tick, 8.0)
    T_odom_corner = SE2(0.0, 0.0, 0.0)
    for _ in range(int(side) % 4):
        T_odom_corner = T_odom_corner @ SE2(8.0, 0.0, math.pi / 2)
    return T_odom_corner @ SE2(along, 0.0, 0.0)


def frame_at(tick: int) -> EncodedFrame:
    return EncodedFrame(1_000_000_000 + tick * TICK_NS, pose_at(tick), KV)


def counting(language: FakeLanguage) -> FakeLanguage:
    """A model that says one turn more each time, and means to say another number of them every third time."""

    def think(_run: object) -> None:
        language.overruled = len(language.prompts) % 3 == 2
        language.refused = BACK if language.overruled else None
        language.turn = TurnObservation("left", 9.0)
        language.text = f"Progress: turn {len(language.prompts) + 1} of 99, passed 0.{LINE}"

    language.during_finish = think
    return language


@pytest.fixture
def bench() -> Bench:
    return Bench(clock=Clock())


def think_at(bench: Bench, second: float) -> tuple[PastPath, Progress | None]:
    """What a generation with a newest frame of that second is told; the robot drives at 1 m/s."""
    bench.frame(second)
    assert bench.loop.step()
    return bench.language.prompt.told[-1]


# Both loops


def claiming(side: str, language: FakeLanguage) -> FakeLanguage:
    """A model that has seen a turn to that side, says nothing else of it, and each time would have it done."""
    language.text = FIRST

    def think(_run: object) -> None:
        language.turn = None if language.prompts else TurnObservation(side, 9.0)
        language.overruled = bool(language.prompts)
        language.refused = DONE if language.overruled else None

    language.during_finish = think
    return language


def lockstep(
    ticks: int,
    latency_s: float,
    of: Callable[[FakeLanguage], FakeLanguage] = counting,
    slot: SemanticSlot | None = None,
    instruction: str = "go",
) -> FakeLanguage:
    """Ticks of the benchmark's reasoner."""
    language, ring, slot = of(FakeLanguage()), TokenRing(160), slot or SemanticSlot()
    reasoner = VirtualTimeReasoner(
        GenerationModels(language, FakePolicy()),  # type: ignore[arg-type]
        SharedState(ring, slot),
        ReasoningConfig((0.0, 3.0), 4),
        instruction,
        lambda: Timing(round(latency_s * 1e9), 0),
    )
    for tick in range(ticks):
        now_ns = frame_at(tick).stamp_ns
        reasoner.release(now_ns)
        ring.put(frame_at(tick))
        reasoner.start(now_ns)
    return language


def threaded(ticks: int, every: int, of: Callable[[FakeLanguage], FakeLanguage] = counting) -> FakeLanguage:
    """The runner's loop, a generation after every so many ticks."""
    bench = Bench(clock=Clock(), late_anchor=False)
    of(bench.language)
    for tick in range(ticks):
        bench.ring.put(frame_at(tick))
        if tick % every == 0:
            assert bench.loop.step()
    return bench.language


@pytest.mark.slow
def test_both_loops_give_the_model_the_same_prompts_and_rules() -> None:
    """Here the runner's text is there at once, the benchmark's after 2 s: both before the next generation begins."""
    virtual, thread = lockstep(801, 2.0), threaded(800, 20)
    assert len(thread.prompt.told) == 40
    assert virtual.prompt.told[:40] == thread.prompt.told and virtual.contexts[:40] == thread.contexts
    assert [before for _, before in thread.prompt.told[:3]] == [None, Progress(1, 99, 0), Progress(2, 99, 0)]
    assert [(context.before, context.follow) for context in thread.contexts[:4]] == [
        (None, FREE), (Progress(1, 99, 0), ONWARD), (Progress(2, 99, 0), ONWARD), (Progress(3, 99, 0), EITHER_WAY),
    ]  # fmt: skip


@pytest.mark.parametrize(("side", "refusals"), [(RIGHT, MAX_REFUSALS), (LEFT, 4)])
def test_both_loops_refuse_a_turn_until_the_robot_has_made_it(side: str, refusals: int) -> None:
    """The robot drives round to the left: a turn to the right is refused as often as a turn may be."""
    model = partial(claiming, side)
    virtual, thread = lockstep(401, 2.0, model).contexts, threaded(400, 20, model).contexts
    assert virtual[:20] == thread
    may_be_done = [context.turn_may_be_done for context in thread]
    assert may_be_done == [True, *[False] * refusals, *[True] * (19 - refusals)]


def test_a_truncated_text_does_not_change_the_turn() -> None:
    bench = Bench(clock=Clock(), late_anchor=False)
    claiming(LEFT, bench.language)
    think_at(bench, 2.0)
    bench.language.during_finish = lambda _run: None
    bench.language.turn, bench.language.has_plan = None, False
    for second, text in ((5.0, FIRST), (8.0, "Situation: in a corri"), (11.0, FIRST)):
        bench.language.text = text
        think_at(bench, second)
    assert bench.language.contexts[-1].turn is not None


def test_a_turn_comes_nearer_by_what_the_robot_has_driven_between_the_newest_frames() -> None:
    """2 s at 0.8 m/s; a generation's own picture is the newest of its frames."""
    known = threaded(800, 20).contexts[1]
    assert known.turn is not None and known.turn.side == "left"
    assert known.turn.distances_m == pytest.approx([9.0 - 1.6])


def test_the_way_is_that_of_all_poses_since_the_beginning() -> None:
    for number, (way, _) in enumerate(threaded(400, 20).prompt.told):
        poses = [(frame_at(tick).stamp_ns, pose_at(tick)) for tick in range(20 * number + 1)]
        assert way == past_path_of(poses)


def test_the_way_goes_on_while_reasoning_is_paused_for_longer_than_the_ring_is_long() -> None:
    bench = Bench(clock=Clock(), late_anchor=False)
    bench.budget = ReasoningBudget(allowed=False)
    for tick in range(700):
        bench.ring.put(frame_at(tick))
        assert not bench.loop.step()
    bench.budget = ReasoningBudget()
    bench.ring.put(frame_at(700))
    assert bench.loop.step()
    assert bench.language.prompt.told == [(past_path_of((frame_at(t).stamp_ns, pose_at(t)) for t in range(701)), None)]


# An instruction's memory


def test_the_first_prompt_has_the_start_of_the_instruction_and_no_progress(bench: Bench) -> None:
    assert think_at(bench, 2.0) == (((0.0, 0.0),), None)
    assert think_at(bench, 5.0) == (((-3.0, 0.0),), None)


def test_stated_progress_is_in_the_next_prompt(bench: Bench) -> None:
    bench.language.text = FIRST
    assert [think_at(bench, second)[1] for second in (2.0, 3.0)] == [None, Progress(1, 3, 2)]


def test_a_text_without_valid_progress_keeps_the_last(bench: Bench) -> None:
    bench.language.text = FIRST
    think_at(bench, 2.0)
    for number, text in enumerate(("Clear." + LINE, "Progress: turn 9 of 3, passed 2." + LINE, "")):
        bench.language.text = text
        assert think_at(bench, 3.0 + number)[1] == Progress(1, 3, 2)
    assert think_at(bench, 9.0)[1] == Progress(1, 3, 2)


def test_a_new_instruction_begins_where_the_robot_is_with_no_progress(bench: Bench) -> None:
    bench.language.text = FIRST
    think_at(bench, 2.0)
    think_at(bench, 4.0)
    bench.loop.submit("left")
    assert think_at(bench, 5.0) == (((-1.0, 0.0),), None)
    assert think_at(bench, 6.0) == (((-2.0, 0.0),), Progress(1, 3, 2))


def test_the_same_instruction_given_anew_begins_anew(bench: Bench) -> None:
    bench.language.text = FIRST
    think_at(bench, 2.0)
    bench.loop.submit("go")
    assert think_at(bench, 3.0) == (((-1.0, 0.0),), None)


def test_a_generation_that_is_ended_forgets_nothing(bench: Bench) -> None:
    bench.language.text = FIRST
    think_at(bench, 2.0)
    bench.loop.cancel()
    assert think_at(bench, 3.0) == (((-1.0, 0.0),), Progress(1, 3, 2))


def test_a_failed_generation_changes_nothing() -> None:
    clock = Clock()
    bench = Bench(clock=clock)
    bench.language.text = FIRST
    think_at(bench, 2.0)
    bench.language.text, bench.language.broken = "Progress: last leg of 3, passed 0." + LINE, 1
    bench.frame(3.0)
    assert not bench.loop.step() and bench.cycle.failed == 1
    clock.s += 1.0
    bench.language.text = FIRST
    assert think_at(bench, 4.0) == (((-2.0, 0.0),), Progress(1, 3, 2))


def test_an_unused_text_is_not_remembered(bench: Bench) -> None:
    bench.policy.guided_by_waypoints = True
    bench.language.text = "Progress: turn 1 of 3, passed 2.\nno waypoints"
    bench.frame(2.0)
    assert not bench.loop.step()
    bench.language.text = FIRST
    assert think_at(bench, 3.0)[1] is None


HERE = "Objects: vending machine left 2 m.\nProgress: last leg of 0, passed 0.\nPlan: stop in 2 m." + LINE


def test_where_to_stop_goes_with_the_answer_that_placed_it_and_ends_with_its_instruction(bench: Bench) -> None:
    bench.loop.submit("stop at the vending machine")
    bench.language.text = HERE
    for second, known in ((2.0, False), (3.0, True)):
        think_at(bench, second)
        assert bench.slot.state is not None
        assert (bench.slot.state.T_odom_stop is not None) is known
        assert (bench.records[-1]["stop"] is not None) is known
    bench.loop.submit("stop at the desk")
    think_at(bench, 4.0)
    assert bench.slot.state.T_odom_stop is None


@pytest.mark.parametrize(("overruled", "whole"), [(True, True), (False, False)], ids=["overruled", "cut short"])
def test_an_answer_that_is_not_the_models_own_or_not_whole_places_no_stop(
    bench: Bench, overruled: bool, whole: bool
) -> None:
    bench.loop.submit("stop at the vending machine")
    bench.language.text, bench.language.overruled, bench.language.has_plan = HERE, overruled, whole
    for second in (2.0, 3.0, 4.0):
        think_at(bench, second)
    assert bench.slot.state is not None
    assert bench.slot.state.T_odom_stop is None


def test_the_prompts_contents_are_recorded(bench: Bench) -> None:
    bench.language.text = FIRST
    think_at(bench, 2.0)
    think_at(bench, 4.0)
    assert [(record["way"], record["before"]) for record in bench.records] == [
        (((0.0, 0.0),), "none."),
        (((-2.0, 0.0),), "turn 1 of 3, passed 2."),
    ]


def test_frames_after_the_newest_of_a_generation_are_left_for_the_next() -> None:
    ring, memory = TokenRing(100), InstructionMemory(None, "")
    for tick in range(60):
        ring.put(frame_at(tick))
    assert memory.past_path(ring, frame_at(30)) == past_path_of((frame_at(t).stamp_ns, pose_at(t)) for t in range(31))
    assert memory.past_path(ring, frame_at(59)) == past_path_of((frame_at(t).stamp_ns, pose_at(t)) for t in range(60))


def test_watching_the_ring_reads_its_poses_once_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    ring, memory, puts = TokenRing(100), InstructionMemory(None, ""), [0]
    put = PathMemory.put

    def counted(path: PathMemory, stamp_ns: int, T_odom_base: SE2) -> None:
        puts[0] += 1
        put(path, stamp_ns, T_odom_base)

    monkeypatch.setattr(PathMemory, "put", counted)
    for tick in range(100):
        ring.put(frame_at(tick))
        for _ in range(5):  # the loop polls more often than frames come
            memory.watch(ring)
    assert puts[0] == sum(1 + 10 * second for second in range(10))
