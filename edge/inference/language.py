"""The slow half of the model: prefill in chunks, then greedy decoding; it can stop between and within calls."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import onnxruntime as ort
from tokenizers import Tokenizer

from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import Artifacts
from edge.artifacts.tokenizer_file import MAX_TOKENS
from edge.core.geometry import SE2
from edge.inference.graph import DTYPES, CancelledError, Graph, GraphError, Interrupt, zeros
from edge.inference.scheduling import Schedule, run_as
from edge.reasoning.decoding_rules import DecodingContext, TextConstraint
from edge.reasoning.prompt import LONGEST_BEFORE, LONGEST_PAST_PATH, InstructionError, PromptBuilder, PromptIds, Segment
from edge.state.reasoning_text import MAX_TEXT_CHARS
from edge.state.ring import EncodedFrame

Floats = npt.NDArray[np.float32]


class ContextOverflowError(ValueError):
    """A prompt longer than the model's context."""


@dataclass(frozen=True)
class Generation:
    """Text and semantic state of one VLM run."""

    text: str
    last_layer_kv: Floats
    """K‖V of the last layer for every input token, [1, T, kv_dim]."""
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


def set_last_apart(prompt: Sequence[Chunk]) -> list[Chunk]:
    """Return the same prompt with its last token, which is text, in a separate chunk."""
    *head, tail = prompt
    last = Chunk(tail.ids[-1:], None, 0)
    return [*head, *([Chunk(tail.ids[:-1], tail.tokens, tail.image_offset)] if tail.ids[:-1] else []), last]


class Call:
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

    def __call__(self, chunk: Chunk, past: int, kv: Floats, interrupt: Interrupt | None) -> int:
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
        self._graph.run_bound(self._binding, interrupt)
        return int(self._next_token[0, 0])


def _open_tokenizer(content: bytes) -> Tokenizer:
    """Open a checked tokenizer.json; raises ArtifactError."""
    try:
        return Tokenizer.from_buffer(content)
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # a panic of the library is no Exception
        reason = (str(error).splitlines() or [""])[0][:160]
        raise ArtifactError(f"tokenizer.json: not a tokenizer ({reason}); export again") from error


class LanguageModel:
    """Prefill and greedy decoding over KV buffers that are allocated once."""

    def __init__(
        self,
        artifacts: Artifacts,
        *,
        threads: int | None = None,
        provider: str | None = None,
        schedule: Schedule | None = None,
        interrupt: Interrupt | None = None,
    ) -> None:
        """`schedule`: where the graphs' own threads run and how urgently.

        `interrupt` ends every call that is given none of its own.
        """
        runtime = artifacts.runtime
        role = schedule.reasoning if schedule else None
        cores = role.cores if role else ()
        graphs = run_as(
            role,
            lambda: [
                Graph(artifacts, name, threads=threads, provider=provider, cores=cores, interrupt=interrupt)
                for name in artifacts.language_graphs
            ],
        )
        self._tokenizer = _open_tokenizer(artifacts.contents["tokenizer.json"])
        self.runtime = runtime
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
        calls = [Call(graph, buffers) for graph in graphs]
        self.prefill_call, self.decode_call = calls[0], calls[-1]
        self._no_frame = zeros(graphs[0].contract.input("visual_tokens"), F=1).astype(np.float32)
        self._kv = np.zeros((1, runtime.max_context, runtime.kv_dim), dtype=np.float32)
        self._took_ns: dict[int, int] = {}

    def check_instruction(self, instruction: str) -> None:
        """Raise InstructionError unless a prompt with all frames and a full answer fit the model's context.

        The check uses the longest prompt: all points of a far path, and a long progress.
        """
        frames = range(len(self.runtime.frame_offsets_s))
        filler = [EncodedFrame(i, SE2(0.0, 0.0, 0.0), self._no_frame) for i in frames]
        prompt = self.prompt.build(filler, instruction, LONGEST_PAST_PATH, LONGEST_BEFORE)
        needed = sum(len(segment.ids) for segment in prompt)
        room = self.runtime.max_context - self.runtime.max_new_tokens
        if needed > room:
            raise InstructionError(
                f"instruction makes a prompt of {needed} tokens, the model has room for {room}: shorten it"
            )

    def constraint(self, context: DecodingContext) -> TextConstraint:
        """Return the constraint of one generation's text by a context."""
        return TextConstraint(context, lambda text: self._tokenizer.encode(text, add_special_tokens=False).ids)

    def generate(
        self,
        segments: Sequence[Segment],
        *,
        max_new_tokens: int,
        cancelled: Callable[[], bool],
        constraint: TextConstraint | None = None,
    ) -> Generation:
        """Run one generation; raises CancelledError between calls, ContextOverflowError for too long a prompt."""
        return self.begin(cancelled).finish(segments, max_new_tokens=max_new_tokens, constraint=constraint)

    def begin(
        self,
        cancelled: Callable[[], bool],
        *,
        interrupt: Interrupt | None = None,
        before_call: Callable[[int], None] | None = None,
    ) -> GenerationRun:
        """Begin a generation whose prompt is fed in parts; the previous one must be over: they share buffers.

        `cancelled` is called before every call of a graph, `interrupt` can end one under way, and `before_call` takes
        the expected duration of the next call, ns.
        """
        return GenerationRun(self, cancelled, interrupt, before_call)

    def run(self, call: Call, chunk: Chunk, past: int, interrupt: Interrupt | None) -> int:
        """Feed a chunk after `past` tokens; return the next id (0 from a graph without one). Raises GraphError."""
        started_ns = time.monotonic_ns()
        next_id = call(chunk, past, self._kv, interrupt)
        if not 0 <= next_id < MAX_TOKENS:
            raise GraphError(f"the language model's next token is {next_id}, expected an id of its vocabulary")
        self._took_ns[len(chunk.ids)] = time.monotonic_ns() - started_ns
        return next_id

    def expected_ns(self, tokens: int) -> int:
        """Return the duration of the last call with that many tokens, ns; 0 before the first."""
        return self._took_ns.get(tokens, 0)

    def last_layer_kv(self, tokens: int) -> Floats:
        """Return a copy of K‖V of the first tokens, [1, tokens, kv_dim]."""
        return self._kv[:, :tokens].copy()

    def text_of(self, ids: Sequence[int]) -> str:
        """Return the text of new tokens, cut at the grammar's longest text."""
        return str(self._tokenizer.decode(list(ids), skip_special_tokens=True))[:MAX_TEXT_CHARS]


class GenerationRun:
    """One generation under way: `feed` the available parts of the prompt, then `finish` with the rest.

    The prompt is split into the same calls however it is fed, so keys, values and text are equal bit for bit. Every
    method raises CancelledError, ContextOverflowError or GraphError; afterwards this object must not be used.
    """

    def __init__(
        self,
        model: LanguageModel,
        cancelled: Callable[[], bool],
        interrupt: Interrupt | None,
        before_call: Callable[[int], None] | None,
    ) -> None:
        self._model = model
        self._cancelled = cancelled
        self._interrupt = interrupt
        self._before_call = before_call
        self._fed = 0
        self._prefill_ns = 0

    def feed(self, segments: Sequence[Segment]) -> None:
        """Prefill the next part of the prompt; leave at least one segment for `finish`."""
        started_ns = time.monotonic_ns()
        for chunk in self._cut(segments):
            self._run(self._model.prefill_call, chunk)
        self._prefill_ns += time.monotonic_ns() - started_ns

    def finish(
        self, segments: Sequence[Segment], *, max_new_tokens: int, constraint: TextConstraint | None = None
    ) -> Generation:
        """Prefill the rest of the prompt, then decode greedily within `constraint`. The last token must be text."""
        model, runtime = self._model, self._model.runtime
        started_ns = time.monotonic_ns()
        *head, last = self._cut(segments)
        if model.prefill_call is not model.decode_call:
            # The prefill graph of a pair has no vocabulary projection, so the decode graph takes the last token.
            *head, last = set_last_apart([*head, last])
        for chunk in head:
            self._run(model.prefill_call, chunk)
        next_id = self._run(model.decode_call, last)
        prompt_tokens = self._fed
        prefilled_ns = time.monotonic_ns()
        new_ids: list[int] = []
        line_at = 0
        room = runtime.max_context - prompt_tokens
        while len(new_ids) < min(max_new_tokens, room):
            next_id = next_id if constraint is None else constraint.choose(next_id)
            if next_id == runtime.im_end_id:
                break
            new_ids.append(next_id)
            if constraint is not None and model.text_of([next_id]).endswith("\n"):
                self._constrain_line(constraint, new_ids, line_at)
                line_at = len(new_ids)
            next_id = self._run(model.decode_call, Chunk((new_ids[-1],), None, 0))
        return Generation(
            text=model.text_of(new_ids),
            last_layer_kv=model.last_layer_kv(self._fed),
            token_ids=tuple(new_ids),
            prompt_tokens=prompt_tokens,
            prefill_ms=(self._prefill_ns + prefilled_ns - started_ns) / 1e6,
            decode_ms=(time.monotonic_ns() - prefilled_ns) / 1e6,
        )

    def _constrain_line(self, constraint: TextConstraint, new_ids: list[int], line_at: int) -> None:
        """Replace a complete line that the constraint does not allow, and feed the other one up to its last token."""
        ids = new_ids[line_at:]
        others = constraint.replace_line(self._model.text_of(ids).rstrip("\n"))
        if others is None:
            return
        differ = (i for i, (token, other) in enumerate(zip(ids, others, strict=False)) if token != other)
        same = next(differ, min(len(ids), len(others)) - 1)
        new_ids[line_at:] = others
        self._fed -= len(ids) - 1 - same
        for token in others[same:-1]:
            self._run(self._model.decode_call, Chunk((token,), None, 0))

    def _cut(self, segments: Sequence[Segment]) -> list[Chunk]:
        runtime = self._model.runtime
        tokens = self._fed + sum(len(segment.ids) for segment in segments)
        if tokens > runtime.max_context:
            raise ContextOverflowError(f"prompt of {tokens} tokens, the model reads {runtime.max_context}")
        return chunks(segments, size=runtime.prefill_chunk_tokens, image_id=runtime.img_context_id)

    def _run(self, call: Call, chunk: Chunk) -> int:
        if self._before_call is not None:
            self._before_call(self._model.expected_ns(len(chunk.ids)))
        if self._cancelled():
            raise CancelledError
        next_id = self._model.run(call, chunk, self._fed, self._interrupt)
        self._fed += len(chunk.ids)
        return next_id
