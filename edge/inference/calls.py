"""One call of a language graph: consecutive prompt tokens, or tokens to choose the next ones after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import onnxruntime as ort

from edge.artifacts.manifest import MOST_ROWS
from edge.inference.graph import Graph, Interrupt, zeros
from edge.reasoning.prompt import Segment

Floats = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Chunk:
    """Consecutive prompt tokens that go through one call."""

    ids: tuple[int, ...]
    tokens: Floats | None
    """Visual tokens of the frame whose placeholders are among the ids; None without a frame."""
    image_offset: int
    """Number of that frame's placeholders that earlier chunks have filled."""


def chunks(segments: Sequence[Segment], *, size: int, image_id: int) -> list[Chunk]:
    """Split segments into calls of at most `size` tokens; a frame may be split anywhere."""
    result: list[Chunk] = []
    for segment in segments:
        filled = 0
        for start in range(0, len(segment.ids), size):
            ids = segment.ids[start : start + size]
            places = ids.count(image_id)
            result.append(Chunk(ids, segment.tokens if places else None, filled))
            filled += places
    return result


def set_first_apart(chunk: Chunk, image_id: int) -> list[Chunk]:
    """Return the same chunk with its text before the first placeholder of a frame in a separate one."""
    count = chunk.ids.index(image_id) if image_id in chunk.ids else 0
    rest = Chunk(chunk.ids[count:], chunk.tokens, chunk.image_offset)
    return [Chunk(chunk.ids[:count], None, 0), rest] if count else [rest]


def set_last_apart(prompt: Sequence[Chunk]) -> list[Chunk]:
    """Return the same prompt with its last token, which is text, in a separate chunk."""
    *head, tail = prompt
    last = Chunk(tail.ids[-1:], None, 0)
    return [*head, *([Chunk(tail.ids[:-1], tail.tokens, tail.image_offset)] if tail.ids[:-1] else []), last]


class Call:
    """One language graph bound once to KV buffers that every call extends in place."""

    def __init__(self, graph: Graph, buffers: Mapping[str, ort.OrtValue], *, with_logits: bool = False) -> None:
        """`with_logits`: copy the logits of every call too, for a comparison."""
        self._graph = graph
        self._binding = graph.binding()
        for name, buffer in buffers.items():
            self._binding.bind_ortvalue_input(name, buffer)
            self._binding.bind_ortvalue_output(name.replace("past_key_values", "present"), buffer)
        self._next_tokens = np.zeros((1, MOST_ROWS), dtype=np.int64)
        self._chooses = any(tensor.name == "next_token" for tensor in graph.contract.outputs)
        self.logits: Floats | None = None
        """Logits after each of the last call's tokens, [MOST_ROWS, vocab], the first rows; None: not copied."""
        if with_logits:
            self.logits = zeros(graph.contract.output("logits"), L=MOST_ROWS).astype(np.float32)
        visual = next((tensor for tensor in graph.contract.inputs if tensor.name == "visual_tokens"), None)
        self._no_frame = None if visual is None else zeros(visual, F=1)

    def __call__(self, chunk: Chunk, past: int, kv: Floats, interrupt: Interrupt | None) -> list[int]:
        """Feed a chunk after `past` tokens and fill its rows of `kv` [1, T, kv_dim].

        Returns the id after each of its last MOST_ROWS tokens; [] from a graph that chooses none.
        """
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
        found = self._next_tokens[:, : min(len(chunk.ids), MOST_ROWS) if self._chooses else 0]
        if self._chooses:
            self._binding.bind_ortvalue_output("next_token", ort.OrtValue.ortvalue_from_numpy(found))
        if self.logits is not None:
            scored = ort.OrtValue.ortvalue_from_numpy(self.logits[: found.shape[1]])
            self._binding.bind_ortvalue_output("logits", scored)
        self._graph.run_bound(self._binding, interrupt)
        return [int(token) for token in found[0]]
