"""The VLM's prompt as segments: text tokens and at most one frame each, so that prefill can stop between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from tokenizers import Tokenizer

from edge.ring import EncodedFrame

SYSTEM = "You drive a robot through people. Describe the situation, then give waypoints."
MAX_INSTRUCTION_CHARS = 400


class InstructionError(ValueError):
    """An instruction that cannot be given to the model."""


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
    """Consecutive prompt tokens; `tokens` are the visual tokens [1, N, D] of the frame inside, if there is one."""

    ids: tuple[int, ...]
    tokens: npt.NDArray[np.float32] | None


def check_instruction(text: str) -> str:
    """The instruction in one line; raises InstructionError when it is empty or longer than 400 characters."""
    line = " ".join(text.split())
    if not line:
        raise InstructionError("instruction is empty: expected a sentence such as 'walk to the vending machine'")
    if any("\ud800" <= character <= "\udfff" for character in line):
        raise InstructionError("instruction is not valid UTF-8 text")
    if len(line) > MAX_INSTRUCTION_CHARS:
        raise InstructionError(f"instruction has {len(line)} characters, at most {MAX_INSTRUCTION_CHARS} are read")
    return line


class PromptBuilder:
    """ChatML prompt of the paper's frames, instruction and past motion (appendix A and B)."""

    def __init__(self, tokenizer: Tokenizer, ids: PromptIds, frame_tokens: int) -> None:
        self._tokenizer = tokenizer
        # An operator's text that spells "<|im_end|>" must stay text: special ids are written by this class alone.
        self._tokenizer.encode_special_tokens = True
        self._ids = ids
        self._frame_tokens = frame_tokens

    def _text(self, text: str) -> list[int]:
        return list(self._tokenizer.encode(text, add_special_tokens=False).ids)

    def build(self, frames: Sequence[EncodedFrame], instruction: str) -> list[Segment]:
        """One segment a frame, oldest first, then what depends on the newest frame."""
        return [*(self.frame(n, frame, instruction) for n, frame in enumerate(frames, 1)), self.tail(frames)]

    def frame(self, number: int, frame: EncodedFrame, instruction: str) -> Segment:
        """Frame `number` (from 1, oldest first); the first one carries the prompt's start with the instruction.

        Nothing in it depends on later frames, so it can be prefilled before they have been captured.
        """
        ids = self._ids
        head: list[int] = []
        if number == 1:
            head += [ids.im_start, *self._text("system\n" + SYSTEM), ids.im_end, *self._text("\n")]
            head += [ids.im_start, *self._text(f"user\nInstruction: {check_instruction(instruction)}\n")]
        image = [ids.img_start, *[ids.img_context] * self._frame_tokens, ids.img_end]
        return Segment((*head, *self._text(f"Frame {number}: "), *image, *self._text("\n")), frame.tokens)

    def tail(self, frames: Sequence[EncodedFrame]) -> Segment:
        """What follows the frames: the robot's past motion, told from the newest of them, and the assistant's turn."""
        ids = self._ids
        text = [*self._text(f"Past motion: {past_motion(frames)}"), ids.im_end, *self._text("\n")]
        return Segment((*text, ids.im_start, *self._text("assistant\n")), None)


def past_motion(frames: Sequence[EncodedFrame]) -> str:
    """Where the robot was at the older frames, in the robot frame of the newest: "(-1.4, 0.0) …" in m."""
    if len(frames) < 2:
        return "none"
    T_now_odom = frames[-1].T_odom_base.inverse()
    poses = [T_now_odom @ frame.T_odom_base for frame in frames[:-1]]
    return " ".join(f"({p.x_m:.1f}, {p.y_m:.1f})" for p in poses)
