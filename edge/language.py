"""The slow half of the model: prefill in chunks, then greedy decoding, stoppable between any two calls."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import onnxruntime as ort
from tokenizers import Tokenizer

from edge.artifact_files import ArtifactError
from edge.geometry import SE2
from edge.graph import DTYPES, Graph, zeros
from edge.manifest import Artifacts
from edge.prompt import InstructionError, PromptBuilder, PromptIds, Segment
from edge.reasoning_text import MAX_TEXT_CHARS
from edge.ring import EncodedFrame

Floats = npt.NDArray[np.float32]


class CancelledError(Exception):
    """The generation was told to stop."""


class ContextOverflowError(ValueError):
    """A prompt longer than the model's context."""


@dataclass(frozen=True)
class Generation:
    """Text and semantic state of one VLM run."""

    text: str
    last_layer_kv: Floats
    """K‖V of the last layer for every token that was fed, [1, T, kv_dim]."""
    token_ids: tuple[int, ...]
    """The new tokens."""
    prompt_tokens: int
    prefill_ms: float
    decode_ms: float

    @property
    def new_tokens(self) -> int:
        """Number of new tokens."""
        return len(self.token_ids)


@dataclass(frozen=True)
class Chunk:
    """Consecutive prompt tokens that go through one call."""

    ids: tuple[int, ...]
    tokens: Floats | None
    """Visual tokens of the frame whose places are among the ids, if there is one."""
    image_offset: int
    """How many of that frame's places earlier chunks have filled."""


def chunks(segments: Sequence[Segment], *, size: int, image_id: int) -> list[Chunk]:
    """Cut segments into calls of at most `size` tokens; a frame may be cut anywhere."""
    result: list[Chunk] = []
    for segment in segments:
        filled = 0
        for start in range(0, len(segment.ids), size):
            ids = segment.ids[start : start + size]
            places = ids.count(image_id)
            result.append(Chunk(ids, segment.tokens if places else None, filled))
            filled += places
    return result


def set_last_apart(prompt: Sequence[Chunk]) -> list[Chunk]:
    """The same prompt with its last token, which is text, in a chunk of its own."""
    *head, tail = prompt
    last = Chunk(tail.ids[-1:], None, 0)
    return [*head, *([Chunk(tail.ids[:-1], tail.tokens, tail.image_offset)] if tail.ids[:-1] else []), last]


class _Call:
    """One language graph bound once to KV buffers that every call extends in place."""

    def __init__(self, graph: Graph, buffers: dict[str, ort.OrtValue]) -> None:
        self._graph = graph
        self._binding = graph.binding()
        for name, buffer in buffers.items():
            self._binding.bind_ortvalue_input(name, buffer)
            self._binding.bind_ortvalue_output(name.replace("past_key_values", "present"), buffer)
        self._next_token = np.zeros((1, 1), dtype=np.int64)
        if any(tensor.name == "next_token" for tensor in graph.contract.outputs):
            self._binding.bind_ortvalue_output("next_token", ort.OrtValue.ortvalue_from_numpy(self._next_token))
        visual = next((tensor for tensor in graph.contract.inputs if tensor.name == "visual_tokens"), None)
        self._no_frame = None if visual is None else zeros(visual, F=1)

    def __call__(self, chunk: Chunk, past: int, kv: Floats) -> int:
        """Feed a chunk after `past` tokens, fill its rows of `kv` [1, T, kv_dim], return the id after it (0: none)."""
        total = past + len(chunk.ids)
        feeds: dict[str, npt.NDArray[np.generic]] = {
            "input_ids": np.array([chunk.ids], dtype=np.int64),
            "seqlens_k": np.array([total - 1], dtype=np.int32),
            "total_sequence_length": np.array(total, dtype=np.int32),
        }
        if self._no_frame is not None:
            feeds["visual_tokens"] = self._no_frame if chunk.tokens is None else chunk.tokens
            feeds["image_offset"] = np.array([chunk.image_offset], dtype=np.int64)
        for name, value in feeds.items():
            self._binding.bind_ortvalue_input(name, ort.OrtValue.ortvalue_from_numpy(value))
        rows = ort.OrtValue.ortvalue_from_numpy(kv[:, past:total])
        self._binding.bind_ortvalue_output("last_layer_kv", rows)
        self._graph.run_bound(self._binding)
        return int(self._next_token[0, 0])


class LanguageModel:
    """Prefill and greedy decoding over KV buffers that are allocated once."""

    def __init__(self, artifacts: Artifacts, *, threads: int | None = None, provider: str | None = None) -> None:
        runtime = artifacts.runtime
        graphs = [Graph(artifacts, name, threads=threads, provider=provider) for name in artifacts.language_graphs]
        try:
            self._tokenizer = Tokenizer.from_buffer(artifacts.contents["tokenizer.json"])
        except Exception as error:
            raise ArtifactError(f"tokenizer.json: not a tokenizer ({error})") from error
        self._runtime = runtime
        ids = PromptIds(
            runtime.im_start_id, runtime.im_end_id, runtime.img_start_id, runtime.img_end_id, runtime.img_context_id
        )
        self.prompt = PromptBuilder(self._tokenizer, ids, runtime.frame_tokens)
        buffers = {
            cache.name: ort.OrtValue.ortvalue_from_shape_and_type(
                [axis if isinstance(axis, int) else runtime.max_context for axis in cache.shape],
                DTYPES[cache.dtype],
                graphs[0].device,
                0,
            )
            for cache in graphs[0].contract.caches
        }
        calls = [_Call(graph, buffers) for graph in graphs]
        self._prefill, self._decode = calls[0], calls[-1]
        self._no_frame = zeros(graphs[0].contract.input("visual_tokens"), F=1).astype(np.float32)
        self._kv = np.zeros((1, runtime.max_context, runtime.kv_dim), dtype=np.float32)

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
        """Run one generation; raises CancelledError between calls, ContextOverflowError for too long a prompt.

        One caller at a time: the KV buffers are this object's.
        """
        runtime = self._runtime
        prompt_tokens = sum(len(segment.ids) for segment in segments)
        room = runtime.max_context - prompt_tokens
        if room < 0:
            raise ContextOverflowError(f"prompt of {prompt_tokens} tokens, the model reads {runtime.max_context}")
        prompt = chunks(segments, size=runtime.prefill_chunk_tokens, image_id=runtime.img_context_id)
        if self._prefill is not self._decode:
            # A prefill graph of a pair has no vocabulary projection: the last token goes through the decode graph.
            prompt = set_last_apart(prompt)
        started_ns = time.monotonic_ns()
        fed, next_id = 0, runtime.im_end_id
        for index, chunk in enumerate(prompt):
            call = self._decode if index + 1 == len(prompt) else self._prefill
            next_id = self._feed(call, chunk, fed, cancelled)
            fed += len(chunk.ids)
        prefilled_ns = time.monotonic_ns()
        new_ids: list[int] = []
        while len(new_ids) < min(max_new_tokens, room) and next_id != runtime.im_end_id:
            new_ids.append(next_id)
            next_id = self._feed(self._decode, Chunk((next_id,), None, 0), fed, cancelled)
            fed += 1
        return Generation(
            text=self._tokenizer.decode(new_ids, skip_special_tokens=True)[:MAX_TEXT_CHARS],
            last_layer_kv=self._kv[:, :fed].copy(),
            token_ids=tuple(new_ids),
            prompt_tokens=prompt_tokens,
            prefill_ms=(prefilled_ns - started_ns) / 1e6,
            decode_ms=(time.monotonic_ns() - prefilled_ns) / 1e6,
        )

    def _feed(self, call: _Call, chunk: Chunk, past: int, cancelled: Callable[[], bool]) -> int:
        if cancelled():
            raise CancelledError
        return call(chunk, past, self._kv)
