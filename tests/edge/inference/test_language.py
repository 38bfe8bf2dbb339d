"""Prefill in chunks of any length and greedy decoding give what one pass over the whole prompt gives."""

from __future__ import annotations

import dataclasses
from typing import cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.artifacts.manifest import Artifacts, load_artifacts
from edge.core.geometry import SE2
from edge.inference.calls import Call, Chunk, chunks, set_last_apart
from edge.inference.graph import CancelledError, GraphError, Interrupt
from edge.inference.language import ContextOverflowError, LanguageModel
from edge.reasoning.prompt import Segment
from edge.state.ring import EncodedFrame

IMAGE = 5
SENTENCE = "walk down the corridor and stop at the vending machine"
segment_ids = st.lists(st.sampled_from([IMAGE, 7, 8]), min_size=1, max_size=40)


@given(st.lists(segment_ids, min_size=1, max_size=4), st.integers(1, 50))
def test_chunks_are_the_prompt_in_order_and_know_where_they_are_in_a_frame(prompt: list[list[int]], size: int) -> None:
    tokens = np.zeros((1, 4, 2), np.float32)
    cut = chunks([Segment(tuple(ids), tokens) for ids in prompt], size=size, image_id=IMAGE)
    assert [i for chunk in cut for i in chunk.ids] == [i for ids in prompt for i in ids]
    assert all(0 < len(chunk.ids) <= size for chunk in cut)
    assert all((chunk.tokens is not None) == (IMAGE in chunk.ids) for chunk in cut)
    places = iter([n for ids in prompt for n in range(ids.count(IMAGE))])
    for chunk in cut:
        for offset in range(chunk.ids.count(IMAGE)):
            assert next(places) == chunk.image_offset + offset


@given(segment_ids.map(lambda ids: [*ids, 7]), st.integers(1, 50))
def test_the_last_token_can_be_set_apart(ids: list[int], size: int) -> None:
    cut = set_last_apart(chunks([Segment(tuple(ids), None)], size=size, image_id=IMAGE))
    assert cut[-1] == Chunk((7,), None, 0)
    assert [i for chunk in cut for i in chunk.ids] == ids


def frames(count: int, tokens: int, width: int, seed: int = 0) -> list[EncodedFrame]:
    rng = np.random.default_rng(seed)
    here = SE2(0.0, 0.0, 0.0)
    return [EncodedFrame(i, here, rng.standard_normal((1, tokens, width)).astype(np.float32)) for i in range(count)]


def model(artifacts: Artifacts, chunk_tokens: int) -> LanguageModel:
    runtime = dataclasses.replace(artifacts.runtime, prefill_chunk_tokens=chunk_tokens)
    return LanguageModel(dataclasses.replace(artifacts, runtime=runtime), threads=1)


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Artifacts:
    """`nano` with a prefill and a decode graph, both exact."""
    from export.model.config import PRESETS
    from export.model.network import build
    from tests.support.artifact_directory import write_artifacts

    return load_artifacts(write_artifacts(build(PRESETS["nano"], 0), tmp_path_factory.mktemp("pair"), pair=True))


@pytest.fixture(scope="module")
def expected(artifacts: Artifacts) -> tuple[np.ndarray, tuple[int, ...]]:
    language = model(artifacts, 8192)
    segments = language.prompt.build(frames(4, 64, 256), SENTENCE)
    generation = language.generate(segments, max_new_tokens=12, cancelled=lambda: False)
    return generation.last_layer_kv, generation.token_ids


@pytest.mark.parametrize(
    ("directory", "size"),
    [
        *(("artifacts", size) for size in (1, 7, 16, 33, 100)),
        *(pytest.param("pair", size, marks=pytest.mark.slow) for size in (16, 8192)),
    ],
)
def test_any_chunk_length_gives_the_same_answer(
    request: pytest.FixtureRequest, expected: tuple, directory: str, size: int
) -> None:
    language = model(request.getfixturevalue(directory), size)
    segments = language.prompt.build(frames(4, 64, 256), SENTENCE)
    generation = language.generate(segments, max_new_tokens=12, cancelled=lambda: False)
    np.testing.assert_allclose(generation.last_layer_kv, expected[0], atol=2e-4)
    assert generation.token_ids == expected[1]


@pytest.mark.parametrize("directory", ["artifacts", pytest.param("pair", marks=pytest.mark.slow)])
@pytest.mark.parametrize("before", [SENTENCE, "go to the door", SENTENCE * 3], ids=["same", "other", "longer"])
def test_rows_kept_from_the_previous_generation_have_the_bits_of_computed_ones(
    request: pytest.FixtureRequest, directory: str, before: str
) -> None:
    fresh, used = (model(request.getfixturevalue(directory), 16) for _ in range(2))
    used.generate(used.prompt.build(frames(2, 64, 256, 5), before), max_new_tokens=9, cancelled=lambda: False)
    found, expected = (
        each.generate(each.prompt.build(frames(4, 64, 256), SENTENCE), max_new_tokens=12, cancelled=lambda: False)
        for each in (used, fresh)
    )
    np.testing.assert_array_equal(found.last_layer_kv, expected.last_layer_kv)
    assert found.token_ids == expected.token_ids


def test_rows_of_an_interrupted_call_are_not_kept(artifacts: Artifacts) -> None:
    language = model(artifacts, 16)
    interrupt = Interrupt()
    run = language.begin(lambda: False, interrupt=interrupt, before_call=lambda _: interrupt.set())
    with pytest.raises(CancelledError):
        run.feed(language.prompt.build(frames(1, 64, 256), SENTENCE)[:1])
    assert language.kept_ids == ()


def test_no_rows_are_kept_after_a_failed_call(artifacts: Artifacts) -> None:
    language = model(artifacts, 64)
    segments = language.prompt.build(frames(1, 64, 256), "stop")
    language.generate(segments, max_new_tokens=2, cancelled=lambda: False)
    assert language.kept_ids

    def fail(*_: object) -> list[int]:
        raise GraphError("the device is lost")

    language.decode_call = cast("Call", fail)
    with pytest.raises(GraphError):
        language.generate(segments, max_new_tokens=2, cancelled=lambda: False)
    assert language.kept_ids == ()


def test_a_generations_keys_and_values_survive_the_next_generation(artifacts: Artifacts) -> None:
    language = model(artifacts, 64)
    first = language.generate(
        language.prompt.build(frames(1, 64, 256), "stop"), max_new_tokens=2, cancelled=lambda: False
    )
    kept = first.last_layer_kv.copy()
    language.generate(language.prompt.build(frames(1, 64, 256, 3), "go"), max_new_tokens=2, cancelled=lambda: False)
    np.testing.assert_array_equal(first.last_layer_kv, kept)


def test_a_generation_stops_between_two_chunks(artifacts: Artifacts) -> None:
    language = model(artifacts, 8)
    segments = language.prompt.build(frames(4, 64, 256), SENTENCE)
    calls = iter(range(1000))
    with pytest.raises(CancelledError):
        language.generate(segments, max_new_tokens=5, cancelled=lambda: next(calls) >= 3)
    assert next(calls) == 4


def test_a_prompt_fed_in_parts_gives_the_same_bits(artifacts: Artifacts, pair: Artifacts) -> None:
    """Late anchor: older frames first, then the newest with the tail; against an ordinary prefill."""
    for directory in (artifacts, pair):
        language = model(directory, 16)
        segments = language.prompt.build(frames(4, 64, 256), SENTENCE)
        whole = language.generate(segments, max_new_tokens=12, cancelled=lambda: False)
        run = language.begin(lambda: False)
        for segment in segments[:3]:
            run.feed([segment])
        parts = run.finish(segments[3:], max_new_tokens=12)
        np.testing.assert_array_equal(parts.last_layer_kv, whole.last_layer_kv)
        assert (parts.token_ids, parts.text) == (whole.token_ids, whole.text)
        assert parts.prompt_tokens == whole.prompt_tokens


def test_a_part_that_does_not_fit_is_refused_before_it_is_fed(artifacts: Artifacts) -> None:
    language = model(artifacts, 64)
    segments = language.prompt.build(frames(4, 64, 256), SENTENCE)
    run = language.begin(lambda: False)
    with pytest.raises(ContextOverflowError):
        run.feed(segments * 8)
    assert run.finish(segments, max_new_tokens=2).prompt_tokens == sum(len(s.ids) for s in segments)


def test_every_call_is_announced_with_its_last_duration(artifacts: Artifacts) -> None:
    language = model(artifacts, 64)
    segments = language.prompt.build(frames(1, 64, 256), "stop")
    announced: list[list[int]] = []
    for _ in range(2):
        announced.append([])
        language.begin(lambda: False, before_call=announced[-1].append).finish(segments, max_new_tokens=2)
    assert announced[0][0] == 0
    assert len(announced[1]) == len(announced[0]) - 1 > 2, "the second one keeps the text before the first frame"
    assert min(announced[1]) > 0


def test_an_interrupt_from_another_thread_ends_a_call_that_is_under_way(artifacts: Artifacts) -> None:
    """ONNX Runtime looks at it between two nodes: here it is set after the last question whether to go on."""
    language = model(artifacts, 64)
    segments = language.prompt.build(frames(4, 64, 256), SENTENCE)
    interrupt = Interrupt()

    def cancelled() -> bool:
        interrupt.set()
        return False

    with pytest.raises(CancelledError):
        language.begin(cancelled, interrupt=interrupt).finish(segments, max_new_tokens=5)


@pytest.mark.slow
def test_leftovers_of_an_earlier_or_interrupted_generation_are_not_read(artifacts: Artifacts, expected: tuple) -> None:
    language = model(artifacts, 64)
    interrupt = Interrupt()
    other = language.prompt.build(frames(4, 64, 256, seed=9), SENTENCE * 3)
    language.generate(other, max_new_tokens=30, cancelled=lambda: False)
    run = language.begin(lambda: False, interrupt=interrupt)
    run.feed(other[:2])
    interrupt.set()
    with pytest.raises(CancelledError):
        run.finish(other[2:], max_new_tokens=5)
    segments = language.prompt.build(frames(4, 64, 256), SENTENCE)
    generation = language.generate(segments, max_new_tokens=12, cancelled=lambda: False)
    np.testing.assert_allclose(generation.last_layer_kv, expected[0], atol=2e-4)
    assert generation.token_ids == expected[1]


@pytest.mark.slow
@settings(max_examples=10)
@given(st.integers(1, 30))
def test_no_more_tokens_than_allowed(artifacts: Artifacts, allowed: int) -> None:
    language = model(artifacts, 64)
    segments = language.prompt.build(frames(1, 64, 256), "stop")
    generation = language.generate(segments, max_new_tokens=allowed, cancelled=lambda: False)
    assert generation.new_tokens <= allowed
