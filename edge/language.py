"""The slow half of the model: prefill in segments, then greedy decoding, stoppable between any two calls."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt
from tokenizers import Tokenizer

from edge.geometry import SE2
from edge.graph import Array, Graph
from edge.manifest import ArtifactError, Artifacts
from edge.prompt import InstructionError, PromptBuilder, PromptIds, Segment
from edge.reasoning_text import MAX_TEXT_CHARS
from edge.ring import EncodedFrame


class CancelledError(Exception):
    """The generation was told to stop."""


class ContextOverflowError(ValueError):
    """A prompt longer than the model's context."""


@dataclass(frozen=True)
class Generation:
    """Text and semantic state of one VLM run."""

    text: str
    last_layer_kv: npt.NDArray[np.float32]
    """K‖V of the last layer for every token that was fed, [1, T, kv_dim]."""
    prompt_tokens: int
    new_tokens: int
    prefill_ms: float
    decode_ms: float


class LanguageModel:
    """Prefill and greedy decoding over one growing KV cache."""

    def __init__(self, artifacts: Artifacts, *, threads: int = 1) -> None:
        runtime = artifacts.runtime
        self._graph = Graph(artifacts, "language_model", threads=threads)
        try:
            self._tokenizer = Tokenizer.from_buffer(artifacts.contents["tokenizer.json"])
        except Exception as error:
            raise ArtifactError(f"tokenizer.json: not a tokenizer ({error})") from error
        self._runtime = runtime
        ids = PromptIds(
            runtime.im_start_id, runtime.im_end_id, runtime.img_start_id, runtime.img_end_id, runtime.img_context_id
        )
        self.prompt = PromptBuilder(self._tokenizer, ids, runtime.frame_tokens)
        contract = artifacts.graphs["language_model"]
        self._caches = [t for t in contract.inputs if t.name.startswith("past_key_values.")]
        visual = contract.input("visual_tokens").shape
        self._no_frame = np.zeros((1, *cast(tuple[int, int], visual[1:])), dtype=np.float32)

    def check_instruction(self, instruction: str, frames: int) -> None:
        """Raise InstructionError unless a prompt with `frames` frames and a full answer fit the model's context."""
        past = SE2(-99.9, -99.9, 0.0)  # the longest numbers that past motion is told in
        filler = [
            EncodedFrame(i, past if i + 1 < frames else SE2(0.0, 0.0, 0.0), self._no_frame) for i in range(frames)
        ]
        needed = sum(len(segment.ids) for segment in self.prompt.build(filler, instruction))
        room = self._runtime.max_context - self._runtime.max_new_tokens
        if needed > room:
            raise InstructionError(
                f"instruction makes a prompt of {needed} tokens, the model has room for {room}: shorten it"
            )

    def generate(
        self, segments: Sequence[Segment], *, max_new_tokens: int, cancelled: Callable[[], bool]
    ) -> Generation:
        """Run one generation; raises CancelledError between calls, ContextOverflowError for too long a prompt."""
        prompt_tokens = sum(len(segment.ids) for segment in segments)
        room = self._runtime.max_context - prompt_tokens
        if room < 0:
            raise ContextOverflowError(f"prompt of {prompt_tokens} tokens, the model reads {self._runtime.max_context}")
        past = [self._empty(t.shape) for t in self._caches]
        kv: list[npt.NDArray[np.float32]] = []
        next_id = self._runtime.im_end_id
        started_ns = time.monotonic_ns()
        for segment in segments:
            next_id, past = self._call(list(segment.ids), segment.tokens, past, kv, cancelled)
        prefilled_ns = time.monotonic_ns()
        new_ids: list[int] = []
        while len(new_ids) < min(max_new_tokens, room) and next_id != self._runtime.im_end_id:
            new_ids.append(next_id)
            next_id, past = self._call([next_id], None, past, kv, cancelled)
        text = self._tokenizer.decode(new_ids, skip_special_tokens=True)[:MAX_TEXT_CHARS]
        return Generation(
            text=text,
            last_layer_kv=np.concatenate(kv, axis=1),
            prompt_tokens=prompt_tokens,
            new_tokens=len(new_ids),
            prefill_ms=(prefilled_ns - started_ns) / 1e6,
            decode_ms=(time.monotonic_ns() - prefilled_ns) / 1e6,
        )

    @staticmethod
    def _empty(shape: tuple[int | str, ...]) -> Array:
        return np.zeros([axis if isinstance(axis, int) else 0 for axis in shape], dtype=np.float32)

    def _call(
        self,
        ids: list[int],
        frames: npt.NDArray[np.float32] | None,
        past: list[Array],
        kv: list[npt.NDArray[np.float32]],
        cancelled: Callable[[], bool],
    ) -> tuple[int, list[Array]]:
        if cancelled():
            raise CancelledError
        feeds: dict[str, Array] = {
            "input_ids": np.array([ids], dtype=np.int64),
            "visual_tokens": self._no_frame if frames is None else frames,
        }
        feeds.update(zip((t.name for t in self._caches), past, strict=True))
        presents = [t.name.replace("past_key_values", "present") for t in self._caches]
        next_token, last_layer_kv, *present = self._graph.run(feeds, ["next_token", "last_layer_kv", *presents])
        kv.append(cast(npt.NDArray[np.float32], last_layer_kv))
        return int(next_token[0, 0]), present
