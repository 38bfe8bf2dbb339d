"""The slow half of the model: prefill in chunks, then greedy decoding; it can stop between and within calls.

A decoding call verifies tokens that were guessed from the previous text (`edge.inference.speculation`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import onnxruntime as ort

from edge.artifacts.manifest import LEAST_ROWS, MOST_ROWS, Artifacts
from edge.artifacts.tokenizer_file import MAX_TOKENS, open_tokenizer
from edge.core.geometry import SE2
from edge.inference.calls import Call, Chunk, Floats, chunks, set_first_apart, set_last_apart
from edge.inference.graph import DTYPES, CancelledError, Graph, GraphError, Interrupt, zeros
from edge.inference.scheduling import Schedule, run_as
from edge.inference.speculation import FIRST_TEXT, Speculator, TextUnderWay, exact_calls_ns, most_rows, next_rows
from edge.reasoning.decoding_rules import DecodingContext, TextConstraint
from edge.reasoning.line_constraint import TextForms
from edge.reasoning.prompt import (
    EXAMPLE_BEFORE,
    EXAMPLE_PAST_PATH,
    LONGEST_BEFORE,
    LONGEST_PAST_PATH,
    InstructionError,
    PromptBuilder,
    PromptIds,
    Segment,
)
from edge.state.reasoning_text import MAX_TEXT_CHARS
from edge.state.ring import EncodedFrame

KNOWN_TOKENS = 4096
"""Number of tokens of which it is known whether they end a line or are a number; a text has some hundred."""


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
    call_tokens: tuple[int, ...]
    """Tokens fed by each call of the decode graph; without speculation one, and one call for the token after them."""
    guessed: int
    """Guesses that were compared with the model's choice."""
    accepted: int
    """Guesses that the model chose."""

    @property
    def new_tokens(self) -> int:
        """Number of new tokens."""
        return len(self.token_ids)


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
        role = schedule.workers if schedule else None
        cores = role.cores if role else ()
        graphs = run_as(
            role,
            lambda: [
                Graph(artifacts, name, threads=threads, provider=provider, cores=cores, interrupt=interrupt)
                for name in artifacts.language_graphs
            ],
        )
        self.tokenizer = open_tokenizer(artifacts.contents["tokenizer.json"])
        self.runtime = runtime
        ids = PromptIds(
            runtime.im_start_id, runtime.im_end_id, runtime.img_start_id, runtime.img_end_id, runtime.img_context_id
        )
        self.prompt = PromptBuilder(self.tokenizer, ids, runtime.frame_tokens)
        self._forms = TextForms(self.encode)
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
        self.no_frame = zeros(graphs[0].contract.input("visual_tokens"), F=1).astype(np.float32)
        self._kv = np.zeros((1, runtime.max_context, runtime.kv_dim), dtype=np.float32)
        self._took_ns: dict[int, int] = {}
        self._graphs, self._buffers = graphs, buffers
        self.rows: tuple[int, ...] = (LEAST_ROWS,)
        """Permitted numbers of rows of a call that chooses tokens, ascending."""
        self.kept_ids: tuple[int, ...] = ()
        """Prompt tokens before the first frame whose rows the buffers hold, from position 0."""
        self.speculator: Speculator | None = None
        """Guesses the next tokens; None: one new token a call."""
        self.ends_line = lru_cache(KNOWN_TOKENS)(lambda token: self.text_of([token]).endswith("\n"))
        """Return whether a token's text ends a line."""

    def check_instruction(self, instruction: str) -> None:
        """Raise InstructionError unless its longest prompt and a full answer fit the model's context."""
        frames = range(len(self.runtime.frame_offsets_s))
        filler = [EncodedFrame(i, SE2(0.0, 0.0, 0.0), self.no_frame) for i in frames]
        prompt = self.prompt.build(filler, instruction, LONGEST_PAST_PATH, LONGEST_BEFORE)
        needed = sum(len(segment.ids) for segment in prompt)
        room = self.runtime.max_context - self.runtime.max_new_tokens
        if needed > room:
            raise InstructionError(
                f"instruction makes a prompt of {needed} tokens, the model has room for {room}: shorten it"
            )

    def constraint(self, context: DecodingContext) -> TextConstraint:
        """Return the constraint of one generation's text by a context."""
        return TextConstraint(context, self.encode, self._forms)

    def encode(self, text: str) -> list[int]:
        """Return the tokens of a text."""
        return self.tokenizer.encode(text, add_special_tokens=False).ids

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
        longest_guess_ns: Callable[[], float] = lambda: math.inf,
    ) -> GenerationRun:
        """Begin a generation whose prompt is fed in parts; the previous one must be over: they share buffers.

        `cancelled` is called before every call of a graph, `interrupt` can end one under way, `before_call` takes
        the expected duration of the next call, ns, and `longest_guess_ns` limits the duration of a call with guesses.
        """
        return GenerationRun(self, cancelled, interrupt, before_call, longest_guess_ns)

    def speculate(self) -> str | None:
        """Guess tokens from now on if calls of any length give equal bits here; else return a line for the operator.

        Runs an example's prompt and calls of every number of rows, whose durations it measures. Raises GraphError.
        """
        frames = range(len(self.runtime.frame_offsets_s))
        rng = np.random.default_rng(0)
        noise = [rng.standard_normal(self.no_frame.shape, dtype=np.float32) for _ in frames]
        here = SE2(0.0, 0.0, 0.0)
        prompt = self.prompt.build(
            [EncodedFrame(i, here, tokens) for i, tokens in zip(frames, noise, strict=True)],
            "stop", EXAMPLE_PAST_PATH, EXAMPLE_BEFORE,
        )  # fmt: skip
        first = self.encode(FIRST_TEXT)
        written = self.generate(prompt, max_new_tokens=MOST_ROWS, cancelled=lambda: False)
        call = Call(self._graphs[-1], self._buffers, with_logits=True)
        usual = exact_calls_ns(call, self._kv, written.prompt_tokens, first[:MOST_ROWS])
        # Attention sums over the context: check it at its full length as well, on rows that were computed.
        end, most = self.runtime.max_context - MOST_ROWS, self.runtime.prefill_chunk_tokens
        for start in range(written.prompt_tokens, end, most):
            filler = (first * most)[: min(most, end - start)]
            self.prefill_call(Chunk(tuple(filler), None, 0), start, self._kv, None)
        full = exact_calls_ns(call, self._kv, end, first[:MOST_ROWS])
        call_ns = {rows: min(took_ns, full[rows]) for rows, took_ns in usual.items() if rows in full}
        if LEAST_ROWS not in call_ns:
            return (
                "speculation is off: on this device a token's keys and values depend on the other tokens of its call, "
                "so guesses could change the text"
            )
        self._took_ns |= call_ns
        self.rows = tuple(sorted(call_ns))
        self.guess_for(call_ns)
        return None

    def guess_for(self, call_ns: Mapping[int, float]) -> None:
        """Forget earlier texts, and guess for a device with these durations of a call by its number of rows, ns."""
        first = self.encode(FIRST_TEXT)
        is_number = lru_cache(KNOWN_TOKENS)(lambda token: any(map(str.isdigit, self.text_of([token]))))
        self.speculator = Speculator(first, call_ns, self.ends_line, is_number)

    def run(self, call: Call, chunk: Chunk, past: int, interrupt: Interrupt | None) -> list[int]:
        """Feed a chunk after `past` tokens; return what `Call` does. Raises GraphError; then no rows are kept."""
        # A failed call may have been given damaged rows, which every retry would reuse.
        kept, self.kept_ids = self.kept_ids[:past], ()
        started_ns = time.monotonic_ns()
        next_ids = call(chunk, past, self._kv, interrupt)
        if not all(0 <= token < MAX_TOKENS for token in next_ids):
            raise GraphError(f"the language model's next tokens are {next_ids}, expected ids of its vocabulary")
        self.kept_ids = kept
        self._took_ns[len(chunk.ids)] = time.monotonic_ns() - started_ns
        return next_ids

    def logits(self, chunk: Chunk, past: int) -> Floats:
        """Feed a chunk after `past` tokens; return the logits after its last MOST_ROWS tokens. Raises GraphError."""
        call = Call(self._graphs[-1], self._buffers, with_logits=True)
        rows = len(self.run(call, chunk, past, None))
        assert call.logits is not None
        return call.logits[:rows]

    def expected_ns(self, tokens: int) -> int:
        """Return the duration of the last call with that many tokens, ns; 0 before the first."""
        return self._took_ns.get(tokens, 0)

    def last_layer_kv(self, tokens: int) -> Floats:
        """Return a copy of K‖V of the first tokens, [1, tokens, kv_dim]."""
        return self._kv[:, :tokens].copy()

    def text_of(self, ids: Sequence[int]) -> str:
        """Return the text of new tokens, cut at the grammar's longest text."""
        return str(self.tokenizer.decode(list(ids), skip_special_tokens=True))[:MAX_TEXT_CHARS]


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
        longest_guess_ns: Callable[[], float],
    ) -> None:
        self._longest_guess_ns = longest_guess_ns
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
            self._prefill(chunk)
        self._prefill_ns += time.monotonic_ns() - started_ns

    def finish(
        self, segments: Sequence[Segment], *, max_new_tokens: int, constraint: TextConstraint | None = None
    ) -> Generation:
        """Prefill the rest of the prompt, then decode greedily within `constraint`. The last token must be text."""
        model, runtime = self._model, self._model.runtime
        started_ns = time.monotonic_ns()
        *head, last = set_last_apart(self._cut(segments))
        for chunk in head:
            self._prefill(chunk)
        prompt_tokens = self._fed + 1
        # One position is left for the padding of the last call.
        limit = min(max_new_tokens, runtime.max_context - prompt_tokens - 1)
        speculator = model.speculator
        text = TextUnderWay(limit, constraint, None if speculator is None else speculator.begin())
        pending, prefilled_ns = list(last.ids), 0
        while pending:
            pending = self._verify(text, pending)
            prefilled_ns = prefilled_ns or time.monotonic_ns()
        if speculator is not None:
            speculator.end(text.ids)
        return Generation(
            text=model.text_of(text.ids),
            last_layer_kv=model.last_layer_kv(self._fed),
            token_ids=tuple(text.ids),
            prompt_tokens=prompt_tokens,
            prefill_ms=(self._prefill_ns + prefilled_ns - started_ns) / 1e6,
            decode_ms=(time.monotonic_ns() - prefilled_ns) / 1e6,
            call_tokens=tuple(text.call_tokens),
            guessed=text.guessed,
            accepted=text.accepted,
        )

    def _verify(self, text: TextUnderWay, pending: list[int]) -> list[int]:
        """Feed the pending tokens and guesses, and take the choices up to the first that was not guessed.

        Returns the tokens to feed next; [] at the end of the text.
        """
        model, speculator = self._model, self._model.speculator
        longest = (model.rows if speculator is None else speculator.rows)[-1]
        while len(pending) > (most := min(longest, most_rows(model.rows, model.runtime.max_context - self._fed))):
            self._run_rows(pending[:most])
            text.call_tokens.append(most)
            self._fed += most
            pending = pending[most:]
        guesses = [] if speculator is None else speculator.guess(text, len(pending), self._longest_guess_ns())
        guesses = guesses[: most - len(pending)]
        choices = self._run_rows([*pending, *guesses])[len(pending) - 1 :]
        self._fed += len(pending)
        text.call_tokens.append(len(pending) + len(guesses))
        for choice, guess in zip(choices, [*guesses, None], strict=False):
            if len(text.ids) >= text.limit:
                return []
            token = choice if text.constraint is None else text.constraint.choose(choice)
            if guess is not None and speculator is not None:
                text.guessed += 1
                text.accepted += guess == token
                speculator.record(guess, accepted=guess == token)
            if token == model.runtime.im_end_id:
                return []
            text.append(token)
            if model.ends_line(token):
                replaced = self._constrain_line(text)
                text.line_at = len(text.ids)
                if replaced:
                    return replaced
            if token != guess:
                return [token]
            self._fed += 1
        raise AssertionError("the last choice has no guess")

    def _constrain_line(self, text: TextUnderWay) -> list[int]:
        """Replace a complete line that the constraint does not allow; return the tokens to feed in its place, or []."""
        ids = text.ids[text.line_at :]
        line = self._model.text_of(ids).rstrip("\n")
        others = None if text.constraint is None else text.constraint.replace_line(line)
        if others is None:
            return []
        differ = (i for i, (token, other) in enumerate(zip(ids, others, strict=False)) if token != other)
        same = next(differ, min(len(ids), len(others)) - 1)
        text.ids[text.line_at :] = others
        self._fed -= len(ids) - 1 - same
        return list(others[same:])

    def _run_rows(self, ids: Sequence[int]) -> list[int]:
        """Run the decode graph on tokens, padded to a permitted number of rows; return the id after each of them.

        The caller advances `_fed`: the next call overwrites the other rows.
        """
        rows = next_rows(self._model.rows, len(ids))
        padding = max(0, min(rows, self._model.runtime.max_context - self._fed) - len(ids))
        chunk = Chunk((*ids, *[ids[-1]] * padding), None, 0)
        return self._call(self._model.decode_call, chunk)[: len(ids)]

    def _cut(self, segments: Sequence[Segment]) -> list[Chunk]:
        runtime = self._model.runtime
        tokens = self._fed + sum(len(segment.ids) for segment in segments)
        if tokens > runtime.max_context:
            raise ContextOverflowError(f"prompt of {tokens} tokens, the model reads {runtime.max_context}")
        cut = chunks(segments, size=runtime.prefill_chunk_tokens, image_id=runtime.img_context_id)
        if self._fed == 0:
            # Instruction and system text get calls of their own, so that the next generation can keep their rows.
            cut = [*set_first_apart(cut[0], runtime.img_context_id), *cut[1:]]
        return cut

    def _prefill(self, chunk: Chunk) -> None:
        """Feed a chunk of the prompt, unless the previous generation has left the same rows at the same positions.

        Equal calls after equal rows give equal bits, so that a kept row equals a computed one.
        """
        model, start, end = self._model, self._fed, self._fed + len(chunk.ids)
        if model.kept_ids[start:end] != chunk.ids:
            self._call(model.prefill_call, chunk)
            if chunk.tokens is None and len(model.kept_ids) == start:
                model.kept_ids += chunk.ids
        self._fed = end

    def _call(self, call: Call, chunk: Chunk) -> list[int]:
        if self._before_call is not None:
            self._before_call(self._model.expected_ns(len(chunk.ids)))
        if self._cancelled():
            raise CancelledError
        return self._model.run(call, chunk, self._fed, self._interrupt)
