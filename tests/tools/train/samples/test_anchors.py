"""An anchor asks what the runner would ask at that instant, and answers what is true there."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
from tokenizers import Tokenizer

from edge.inference.generation_task import GenerationModels
from edge.inference.language import Generation
from edge.reasoning.decoding_rules import DecodingContext, TextConstraint
from edge.reasoning.generation_cycle import ReasoningConfig
from edge.reasoning.prompt import PromptBuilder, PromptIds, Segment
from edge.state.reasoning_text import Plan, Progress, Stop, TurnBack, format_text, parse_progress, parse_waypoints
from edge.state.ring import EncodedFrame, TokenRing
from edge.state.semantic import SemanticSlot, SharedState
from export.model.config import PRESETS
from export.model.tokenizers.nano import NANO_TOKENIZER
from sim_hil.benchmark.conditions.latency import Timing
from sim_hil.benchmark.policies.virtual_time_reasoner import VirtualTimeReasoner
from tests.support.train.train_drives import WORDINGS, made_up_drive, progress_at, trace_at
from tools.train.config.sft import DrawConfig
from tools.train.drives.trace_sentences import aspects_of_json
from tools.train.samples.anchors import (
    OFF_ROUTE_M,
    WAYPOINTS_START,
    Anchor,
    Drawn,
    Prompts,
    anchors_of,
    believed_off_route,
    confused,
    draw,
    frames_at,
    too_far,
    waiting,
)

NANO = PRESETS["nano"]
PERIOD_NS = 100_000_000
START_NS = 1_000_000_000


def tokenizer() -> Tokenizer:
    return Tokenizer.from_file(str(NANO_TOKENIZER))


@pytest.fixture(scope="module")
def prompts() -> Prompts:
    return Prompts(tokenizer(), NANO)


@pytest.fixture(scope="module")
def anchors() -> dict[int, Anchor]:
    return {anchor.k: anchor for anchor in anchors_of(made_up_drive("a"))}


class Listener:
    """In the language model's place: keeps every prompt and says what is true at its newest frame."""

    def __init__(self) -> None:
        c = NANO.language
        ids = PromptIds(c.im_start_id, c.im_end_id, c.img_start_id, c.img_end_id, c.img_context_id)
        self.prompt = PromptBuilder(tokenizer(), ids, NANO.frame_tokens)
        self.heard: list[tuple[int, ...]] = []
        self.says: list[str] = []

    def constraint(self, context: DecodingContext) -> TextConstraint:
        """It holds nothing: what is said is true."""
        return TextConstraint(DecodingContext(), lambda text: ())

    def begin(self, cancelled: object) -> Listener:
        self.heard.append(())
        return self

    def feed(self, segments: Sequence[Segment]) -> None:
        self.heard[-1] += tuple(i for segment in segments for i in segment.ids)

    def finish(self, segments: Sequence[Segment], *, max_new_tokens: int, constraint: TextConstraint) -> Generation:
        self.feed(segments)
        text = self.says[len(self.heard) - 1]
        return Generation(text, np.zeros((1, 1, 4), np.float32), (), len(self.heard[-1]), 0.0, 0.0, (), 0, 0)


class NoPolicy:
    guided_by_waypoints = False

    def semantic_context(self, last_layer_kv: np.ndarray, interrupt: object = None) -> dict[str, np.ndarray]:
        return {}


@pytest.mark.parametrize("seconds", [1, 2, 3])
def test_prompts_are_those_that_the_runner_builds_along_the_drive(
    prompts: Prompts, anchors: dict[int, Anchor], seconds: int
) -> None:
    drive, language, ring = made_up_drive("a"), Listener(), TokenRing(160)
    asked = list(range(0, 130, 10 * seconds))
    language.says = [format_text(anchors[k].reasoning) for k in asked]
    reasoner = VirtualTimeReasoner(
        GenerationModels(language, NoPolicy()),  # type: ignore[arg-type]
        SharedState(ring, SemanticSlot()),
        ReasoningConfig((0.0, 3.0, 6.0, 9.0), 8),
        WORDINGS[0],
        lambda: Timing(seconds * 10 * PERIOD_NS, 0),
    )
    for k in range(130):
        now_ns = START_NS + k * PERIOD_NS
        reasoner.release(now_ns)
        ring.put(EncodedFrame(now_ns, drive.T_odom_base(k), np.zeros((1, 1, 1), np.float32)))
        reasoner.start(now_ns)
    assert reasoner.cycle.failed == 0 and len(language.heard) >= 4
    for k, heard in zip(asked, language.heard, strict=False):
        drawn = Drawn(WORDINGS[0], anchors[k].before(float(seconds)))
        assert prompts.prompt(anchors[k], drawn) == heard


@pytest.mark.parametrize("k", [0, 4, 25, 30, 31, 58, 60, 85, 86, 90, 129])
def test_frames_are_those_that_the_runner_takes_from_its_ring(k: int) -> None:
    ring, drive = TokenRing(200), made_up_drive("a")
    for i in range(k + 1):
        ring.put(EncodedFrame(i * PERIOD_NS, drive.T_odom_base(i), np.zeros((1, 1, 1), np.float32)))
    chosen: list[int] = []
    for offset_s in (9.0, 6.0, 3.0):
        frame = ring.nearest(k * PERIOD_NS - round(offset_s * 1e9))
        if frame is not None and frame.stamp_ns < k * PERIOD_NS and frame.stamp_ns // PERIOD_NS not in chosen:
            chosen.append(frame.stamp_ns // PERIOD_NS)
    assert frames_at(k) == (*chosen, k)


def test_the_answer_reads_back_as_the_label(prompts: Prompts, anchors: dict[int, Anchor]) -> None:
    for k, anchor in anchors.items():
        _, answer = prompts.of(anchor, Drawn(WORDINGS[0], None))
        assert answer[-1] == NANO.language.im_end_id and answer.count(answer[-1]) == 1
        text = prompts.text(answer)
        assert text == format_text(anchor.reasoning)
        assert anchor.reasoning == dataclasses.replace(aspects_of_json(trace_at(k)), waypoints=anchor.points)
        assert parse_progress(text) == progress_at(k) == anchor.progress
        assert parse_waypoints(text) == pytest.approx(np.round(anchor.points, 1))


def test_waypoints_alone_are_asked_for_by_beginning_the_answer(prompts: Prompts, anchors: dict[int, Anchor]) -> None:
    anchor = anchors[60]
    whole, _ = prompts.of(anchor, Drawn(WORDINGS[0], None))
    begun, rest = prompts.of(anchor, Drawn(WORDINGS[0], None, waypoints_only=True))
    assert begun[: len(whole)] == whole
    assert prompts.text(begun[len(whole) :]) == WAYPOINTS_START
    assert parse_waypoints(WAYPOINTS_START + prompts.text(rest)) == pytest.approx(np.round(anchor.points, 1))
    last_line = tokenizer().encode(format_text(anchor.reasoning).rsplit("\n", 1)[-1], add_special_tokens=False).ids
    assert (*begun[len(whole) :], *rest[:-1]) == tuple(last_line)


def test_the_progress_before_is_that_of_the_last_generations_anchor(anchors: dict[int, Anchor]) -> None:
    assert anchors[0].before(0.3) is None
    assert anchors[100].before(0.5) == progress_at(90)
    assert anchors[100].before(1.5) == progress_at(80)
    assert anchors[100].before(10.0) == progress_at(0)
    assert anchors[100].before(10.1) is None


def test_wrong_progress_has_the_given_share_and_is_always_wrong(anchors: dict[int, Anchor]) -> None:
    config = DrawConfig(before_min_s=1.0, before_max_s=1.0, before_late=0.0, before_wrong=0.2, waypoints_only=0.3)
    rng = np.random.default_rng(0)
    drawn = [draw(anchors[60], config, rng) for _ in range(2000)]
    right = anchors[60].before(1.0)
    wrong = [each.before for each in drawn if each.before != right]
    assert right is not None and len(wrong) / 2000 == pytest.approx(0.2, abs=0.03)
    assert set(confused(right)) <= set(wrong) <= {*confused(right), *anchors[60].earlier}
    assert np.mean([each in too_far(right) for each in wrong]) > 0.5
    assert np.mean([each.waypoints_only for each in drawn]) == pytest.approx(0.3, abs=0.04)
    assert {each.wording for each in drawn} == set(WORDINGS)


@pytest.mark.parametrize(("action", "off_m"), [(TurnBack(), 0.0), (Stop(3), 2.5), (Stop(3), 2.0)])
def test_off_the_route_the_prompt_has_the_progress_of_a_robot_that_does_not_know_it_in_the_given_share(
    action: TurnBack | Stop, off_m: float, anchors: dict[int, Anchor]
) -> None:
    config = DrawConfig(before_min_s=1.0, before_max_s=1.0, before_late=0.0, before_wrong=0.0, before_unaware=0.4)
    reasoning = dataclasses.replace(anchors[60].reasoning, plan=Plan(action))
    anchor = dataclasses.replace(anchors[60], reasoning=reasoning, off_m=off_m)
    right, rng = anchor.before(1.0), np.random.default_rng(0)
    assert right == Progress(1, 1, 1)
    drawn = [draw(anchor, config, rng).before for _ in range(1000)]
    turned, not_counted = Progress(2, 1, 0), Progress(1, 1, 0)
    assert set(drawn) <= {right, turned, not_counted}
    off = isinstance(action, TurnBack) or off_m > OFF_ROUTE_M
    for believed in (turned, not_counted):
        assert np.mean([before == believed for before in drawn]) == pytest.approx(0.2 if off else 0.0, abs=0.05)


def test_in_a_wrong_opening_a_robot_may_have_counted_on() -> None:
    assert Progress(2, 3, 1) in believed_off_route(Progress(1, 3, 0))
    assert believed_off_route(Progress(4, 3, 0)) == []


def test_in_a_policys_drive_the_prompt_has_the_progress_of_its_own_text_in_the_given_share(
    anchors: dict[int, Anchor],
) -> None:
    own = Progress(2, 1, 0)
    anchor = dataclasses.replace(anchors[60], believed=own)
    config, rng = DrawConfig(before_wrong=0.0, before_own=0.7), np.random.default_rng(0)
    assert np.mean([draw(anchor, config, rng).before == own for _ in range(1000)]) == pytest.approx(0.7, abs=0.05)


def test_an_anchor_has_the_distance_to_the_route_and_the_policys_progress_of_its_trace() -> None:
    drive, own = made_up_drive("a"), {"step": 2, "steps": 1, "passed": 0}
    traces = tuple({**trace, "off_m": 0.1 * trace["k"], "believed": own} for trace in drive.traces)
    found = anchors_of(dataclasses.replace(drive, about=dataclasses.replace(drive.about, traces=traces)))
    assert [anchor.off_m for anchor in found] == pytest.approx([0.1 * anchor.k for anchor in found])
    assert {anchor.believed for anchor in found} == {Progress(2, 1, 0)}
    assert all(anchor.decides for anchor in found if anchor.off_m > OFF_ROUTE_M)


def test_on_the_last_leg_no_turn_can_be_missed(anchors: dict[int, Anchor]) -> None:
    config = DrawConfig(before_wrong=0.0, before_unaware=1.0)
    last = Progress(2, 1, 0)
    anchor = dataclasses.replace(
        anchors[60],
        reasoning=dataclasses.replace(anchors[60].reasoning, plan=Plan(TurnBack())),
        earlier=(last,) * 7,
        progress=last,
    )
    assert draw(anchor, config, np.random.default_rng(0)).before in (last, None)


def test_past_motion_matches_that_of_another_odometry_origin(anchors: dict[int, Anchor]) -> None:
    config, rng = DrawConfig(way_point_m=0.0), np.random.default_rng(0)
    recorded = np.array(anchors[100].way)
    paths = np.array([draw(anchors[100], config, rng).way for _ in range(400)])
    assert np.allclose(paths, np.round(paths, 1))
    assert np.hypot(*(paths - recorded).T).max() < 0.15 * np.hypot(*recorded.T).max() + 0.1
    assert np.allclose(paths.mean(0), recorded, atol=0.1) and paths.std(0).max() > 0.02
    exact = DrawConfig(way_turn_rad=0.0, way_scale=0.0, way_point_m=0.0)
    assert draw(anchors[100], exact, rng).way == anchors[100].way


def test_a_waiting_robot_has_repeated_progress_and_one_place(anchors: dict[int, Anchor]) -> None:
    waited = waiting(anchors[0], 2)
    assert waited.frames == (0, 0) and waited.before(2.0) == anchors[0].progress
    assert draw(waited, DrawConfig(), np.random.default_rng(0)).way == anchors[0].way
    with pytest.raises(ValueError, match="first anchor"):
        waiting(anchors[10], 1)


def test_anchors_decide_where_the_robot_has_to_turn_back() -> None:
    traces = tuple(
        {"k": k, **trace_at(k), "plan": "turn back" if k == 20 else trace_at(k)["plan"]} for k in (0, 10, 20)
    )
    found = {anchor.k: anchor for anchor in anchors_of(made_up_drive("a", 30, traces=traces))}
    assert {anchor.progress for anchor in found.values()} == {progress_at(0)}
    assert [k for k, anchor in found.items() if anchor.decides] == [20]


@pytest.mark.parametrize("progress", [Progress(1, 1, 0), Progress(2, 3, 2), Progress(4, 3, 0), Progress(1, 0, 0)])
def test_confused_progress_is_never_the_right_one(progress: Progress) -> None:
    assert progress not in confused(progress)


def test_an_answer_that_does_not_fit_the_context_is_refused(anchors: dict[int, Anchor]) -> None:
    language = dataclasses.replace(NANO.language, max_context=120)
    narrow = Prompts(tokenizer(), dataclasses.replace(NANO, language=language))
    with pytest.raises(ValueError, match="exceed the model's context of 120"):
        narrow.of(anchors[90], Drawn(WORDINGS[0], None))
