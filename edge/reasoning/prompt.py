"""Builds the VLM's prompt as segments of text tokens and at most one frame, so that prefill can stop between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from tokenizers import Tokenizer

from edge.reasoning.path_memory import FARTHEST_M, MAX_POINTS, PastPath
from edge.state.reasoning_text import MAX_COUNT, Progress, format_progress
from edge.state.ring import EncodedFrame

SYSTEM = "Drive through people. Describe the situation, then waypoints."
MAX_INSTRUCTION_CHARS = 400
EXAMPLE_PAST_PATH: PastPath = (
    (-31.6, 16.6), (-31.1, 4.0), (-20.3, 1.9), (-12.0, -0.8), (-8.2, 0.4), (-6.1, 0.7), (-2.4, 0.1), (0.0, 1.5)
)  # fmt: skip
EXAMPLE_BEFORE = Progress(2, 3, 1)
"""Past motion of a prompt of usual length, for timing and planning: all points of an indoor path."""
LONGEST_PAST_PATH: PastPath = ((-FARTHEST_M, -FARTHEST_M),) * MAX_POINTS
LONGEST_BEFORE = Progress(MAX_COUNT, MAX_COUNT, MAX_COUNT)
"""Past motion of the longest possible prompt."""


class InstructionError(ValueError):
    """An instruction that the model cannot take."""


@dataclass(frozen=True)
class PromptIds:
    """Ids of the tokens that only the prompt builder may write."""

    im_start: int
    im_end: int
    img_start: int
    img_end: int
    img_context: int


@dataclass(frozen=True)
class Segment:
    """Consecutive prompt tokens; `tokens`: visual tokens [1, N, D] of its frame, None without a frame."""

    ids: tuple[int, ...]
    tokens: npt.NDArray[np.float32] | None


def check_instruction(text: str) -> str:
    """Return the instruction in one line; raises InstructionError when it is empty or over 400 characters."""
    line = " ".join(text.split())
    if not line:
        raise InstructionError("instruction is empty: expected a sentence such as 'walk to the vending machine'")
    if any("\ud800" <= character <= "\udfff" for character in line):
        raise InstructionError("instruction is not valid UTF-8 text")
    if len(line) > MAX_INSTRUCTION_CHARS:
        raise InstructionError(f"instruction has {len(line)} characters, at most {MAX_INSTRUCTION_CHARS} are read")
    return line


class PromptBuilder:
    """ChatML prompt of the paper's frames, instruction, past motion and task progress (appendix A and B)."""

    def __init__(self, tokenizer: Tokenizer, ids: PromptIds, frame_tokens: int) -> None:
        self._tokenizer = tokenizer
        # An operator's text that spells "<|im_end|>" must stay text: only this class writes special ids.
        self._tokenizer.encode_special_tokens = True
        self._ids = ids
        self._frame_tokens = frame_tokens

    def _text(self, text: str) -> list[int]:
        return list(self._tokenizer.encode(text, add_special_tokens=False).ids)

    def build(
        self, frames: Sequence[EncodedFrame], instruction: str, past_path: PastPath = (), before: Progress | None = None
    ) -> list[Segment]:
        """Return one segment per frame, oldest first, then the tail; without a path: an instruction's first prompt."""
        return [*(self.frame(n, frame, instruction) for n, frame in enumerate(frames, 1)), self.tail(past_path, before)]

    def frame(self, number: int, frame: EncodedFrame, instruction: str) -> Segment:
        """Return the segment of frame `number`, from 1, oldest first; the first includes the prompt's start.

        It does not depend on later frames, so it can be prefilled before they are captured.
        """
        ids = self._ids
        head: list[int] = []
        if number == 1:
            head += [ids.im_start, *self._text("system\n" + SYSTEM), ids.im_end, *self._text("\n")]
            head += [ids.im_start, *self._text(f"user\nInstruction: {check_instruction(instruction)}\n")]
        image = [ids.img_start, *[ids.img_context] * self._frame_tokens, ids.img_end]
        return Segment((*head, *self._text(f"Frame {number}:"), *image, *self._text("\n")), frame.tokens)

    def tail(self, past_path: PastPath, before: Progress | None) -> Segment:
        """Return the segment after the frames: the path since the instruction began, in the newest frame's robot
        frame, the previous text's progress (None: none), and the assistant's turn."""
        ids = self._ids
        text = [
            *self._text(f"Past motion: {format_past_motion(past_path)}\nBefore: {format_before(before)}"),
            ids.im_end,
        ]
        return Segment((*text, *self._text("\n"), ids.im_start, *self._text("assistant\n")), None)


def format_past_motion(past_path: PastPath) -> str:
    """Format the path in the current robot frame, m, oldest first: "(-1.4, 0.0) (0.0, 2.1)"."""
    return " ".join(f"({x_m:.1f}, {y_m:.1f})" for x_m, y_m in past_path) or "none"


def format_before(before: Progress | None) -> str:
    """Format the previous text's progress in canonical form, since that text is untrusted."""
    return "none." if before is None else format_progress(before)
