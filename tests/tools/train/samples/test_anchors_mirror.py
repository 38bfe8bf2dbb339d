"""In the mirror left and right change places, in pictures, words and numbers, and nothing else does."""

from __future__ import annotations

import dataclasses
import itertools

import cv2
import numpy as np
import pytest

from edge.state.reasoning_text import format_text, parse_text
from tests.support.train.train_drives import MadeUpTokens, made_up_drive
from tools.train.drives import trace_sentences as trace_words
from tools.train.drives.drive import Drive
from tools.train.samples.anchors import anchors_of
from tools.train.samples.mirror import Views, mirrored, mirrored_reasoning, mirrored_text


@pytest.mark.parametrize(
    ("text", "other"),
    [
        ("Take the second left, then turn right.", "Take the second right, then turn left."),
        ("All right, keep to the left side", "All right, keep to the right side"),
        ("all right, turn right", "all right, turn left"),
        ("Left at the desk", "Right at the desk"),
        ("Motion: person ahead 2 m crossing left.", "Motion: person ahead 2 m crossing right."),
        ("the handrail and the copyright sign", "the handrail and the copyright sign"),
    ],
)
def test_sides_are_exchanged_and_no_other_word(text: str, other: str) -> None:
    assert mirrored_text(text) == other
    assert mirrored_text(other) == text


def test_every_reasoning_text_has_a_mirror_image_with_the_same_words_but_for_the_sides() -> None:
    for text in itertools.islice(trace_words.corpus(), 0, None, 7):
        aspects = dataclasses.replace(parse_text(text), waypoints=None)
        other = mirrored_reasoning(aspects)
        assert format_text(other) == mirrored_text(format_text(aspects))
        assert mirrored_reasoning(other) == aspects


def test_an_anchor_in_the_mirror_tells_the_same_story_on_the_other_side() -> None:
    for anchor in anchors_of(made_up_drive("a")):
        other = mirrored(anchor)
        assert mirrored(other) == anchor
        assert [x for x, _ in other.way] == [x for x, _ in anchor.way]
        assert [y for _, y in other.way] == [-y for _, y in anchor.way]
        assert other.reasoning.waypoints == pytest.approx(np.array(anchor.points) * (1, -1))
        assert other.reasoning.progress == anchor.progress
        assert (other.earlier, other.frames) == (anchor.earlier, anchor.frames)
        texts = format_text(anchor.reasoning), format_text(other.reasoning)
        assert ("turn right into the room" in texts[1]) == ("turn left into the room" in texts[0])
        assert "-0.0" not in texts[1]


def half_white(drive_id: str, frames: int) -> Drive:
    """White on the left, the right getting lighter from frame to frame."""
    pieces = []
    for k in range(frames):
        picture = np.full((128, 128, 3), 255, np.uint8)
        picture[:, 64:] = 4 * k
        pieces.append(cv2.imencode(".jpg", picture)[1].reshape(-1))
    plain = made_up_drive(drive_id, frames)
    return dataclasses.replace(
        plain, jpeg=np.concatenate(pieces), jpeg_end=np.cumsum([len(piece) for piece in pieces], dtype=np.int64)
    )


def test_an_anchors_view_is_of_its_own_frames_on_either_side() -> None:
    views = Views(MadeUpTokens(), MadeUpTokens(10))
    anchor = anchors_of(made_up_drive("a"))[-1]
    for plain, other in zip(views.of(anchor), views.of(anchor, in_mirror=True), strict=True):
        np.testing.assert_array_equal(plain, other)
    with pytest.raises(ValueError, match="mirror image"):
        Views(MadeUpTokens()).of(anchor, in_mirror=True)
    with pytest.raises(ValueError, match="mirror image"):
        views.of(dataclasses.replace(anchor, frames=(25, 55)), in_mirror=True)
