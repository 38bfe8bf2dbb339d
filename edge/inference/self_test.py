"""Known-answer self-test: every graph and the whole chain answer inputs from a seed as they did at the export.

It runs on the sessions that drive the robot, before the bridge may arm. It finds what hashes cannot: weights that are
NaN, zero or scaled, exchanged tokens or graphs under a sealed manifest, a provider or driver that computes wrongly.
Inputs and signs come from SHAKE-256, so they are the same with every NumPy.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from edge.artifacts.files import ArtifactError
from edge.artifacts.known_answers import CHAIN, LATER, LOGITS, SUMS, VOCABULARY, Answer, KnownAnswers
from edge.artifacts.manifest import LANGUAGE_PAIR, MOST_ROWS, Artifacts
from edge.core.geometry import SE2
from edge.inference.calls import Chunk
from edge.inference.graph import Array, GraphError
from edge.inference.language import ContextOverflowError, LanguageModel
from edge.inference.policy import Policy
from edge.reasoning.prompt import EXAMPLE_BEFORE, EXAMPLE_PAST_PATH
from edge.state.reasoning_text import WAYPOINT_TIMES_S
from edge.state.ring import EncodedFrame
from edge.state.semantic import STRAIGHT_AHEAD, Context, SemanticState

Floats = npt.NDArray[np.float32]

INSTRUCTION: Final = "walk to the vending machine behind the second opening on the left"
PLACEHOLDERS: Final = 8
"""Tokens of a frame in the language model's own test."""
TEXT_TOKENS: Final = 8
DECODED: Final = 8
"""Tokens that are decoded one by one."""
MOST_VOCABULARY: Final = 1024
"""Tokens in the test of the vocabulary: all of nano's; of a larger one a sample, which misses 1 % of damaged rows once
in 30,000."""
CONTEXT_TOKENS: Final = 16
STATE: Final = (0.4, 0.0, 0.1)
DELAY_S: Final = 0.8
OFFSET: Final = SE2(0.3, 0.05, 0.1)
HERE: Final = SE2(0.0, 0.0, 0.0)
SAME_SHARE: Final = 1e-6
"""Outputs for two inputs that differ by less, relative to their size, do not depend on the input."""
DIGITS: Final = 7


class SelfTestError(ArtifactError):
    """An answer that is not the exporter's; one line."""


@dataclass(frozen=True)
class Output:
    """What a graph or the chain answered."""

    values: Floats
    """All elements, flat."""
    tokens: tuple[int, ...] = ()
    other: Floats | None = None
    """Its answer to another input; None: compared nowhere."""


@dataclass(frozen=True)
class SelfTestResult:
    """A passed self-test."""

    took_ms: float
    worst: str
    """Name of the answer that used most of its tolerance."""
    worst_share: float
    """The share of it, 0 to 1."""

    def __str__(self) -> str:
        return f"all answers as exported in {self.took_ms:.0f} ms, at most {self.worst_share:.1%} of the tolerance"


class Noise:
    """Bytes and numbers of a seed by name, the same on every machine."""

    def __init__(self, seed: int) -> None:
        self._seed = seed

    def bytes(self, name: str, count: int) -> npt.NDArray[np.uint8]:
        """Return `count` bytes."""
        data = hashlib.shake_256(f"tic-vla-edge self-test {self._seed} {name}".encode()).digest(count)
        return np.frombuffer(data, dtype=np.uint8)

    def numbers(self, name: str, shape: Sequence[int]) -> Floats:
        """Return numbers between −1 and 1."""
        raw = self.bytes(name, 2 * int(np.prod(shape))).view("<i2").astype(np.float32)
        return (raw / np.float32(32768)).reshape(shape)

    def digest(self, name: str, values: Floats) -> npt.NDArray[np.float64]:
        """Return signed sums of the elements: any change of an output changes them by about as much."""
        bits = np.unpackbits(self.bytes(f"signs {name}", -(-values.size // 8)), count=values.size)
        signed = values.astype(np.float64) * (1.0 - 2.0 * bits)
        sums: npt.NDArray[np.float64] = np.pad(signed, (0, -values.size % SUMS)).reshape(-1, SUMS).sum(axis=0)
        return sums


def check_answers(policy: Policy, language: LanguageModel, known: KnownAnswers | None) -> SelfTestResult:
    """Compute every answer and compare it with the manifest's; raises SelfTestError, or CancelledError."""
    where = policy.artifacts.directory
    if known is None:
        raise SelfTestError(f"{where}: the manifest has no known answers for the self-test; export again")
    noise, started_ns = Noise(known.seed), time.monotonic_ns()
    worst, worst_share = "", 0.0
    try:
        if prompt_digest(policy.artifacts, language) != known.prompt:
            raise SelfTestError(
                f"{where}: self-test: the prompt's token ids are not the exporter's: tokenizer, special tokens or "
                f"this release's prompt differ; export again"
            )
        for name, output in outputs(policy, language, noise, later=LATER & known.answers.keys()):
            share = _compare(noise, name, output, known)
            if share >= worst_share:
                worst, worst_share = name, share
            _check_time(known, started_ns)
    except (GraphError, ContextOverflowError) as error:
        raise SelfTestError(f"{where}: self-test: the graphs do not run ({error}); export again") from error
    except SelfTestError as error:
        if str(error).startswith(str(where)):
            raise
        raise SelfTestError(f"{where}: self-test: {error}") from error
    return SelfTestResult((time.monotonic_ns() - started_ns) / 1e6, worst, worst_share)


def compute_answers(
    policy: Policy, language: LanguageModel, seed: int, tolerances: Mapping[str, float]
) -> tuple[str, dict[str, Answer]]:
    """Return the digest of the prompt and the answers by name, at the export.

    `tolerances`: by name. Raises SelfTestError for an answer that is no sound one, GraphError.
    """
    noise = Noise(seed)
    answers: dict[str, Answer] = {}
    for name, output in outputs(policy, language, noise):
        _check_sound(name, output)
        digest = tuple(float(f"{number:.{DIGITS}g}") for number in noise.digest(name, output.values))
        answers[name] = Answer(digest, tolerances[name], output.tokens)
    return prompt_digest(policy.artifacts, language), answers


def outputs(
    policy: Policy, language: LanguageModel, noise: Noise, *, later: Collection[str] = LATER
) -> Iterator[tuple[str, Output]]:
    """Run every graph on inputs of its own, then the chain; yield each answer when it is there. Raises GraphError.

    `later`: which answers of LATER too.
    """
    runtime = language.runtime
    size = (1, runtime.image_px, runtime.image_px, 3)
    first, second = (
        policy.encode(noise.bytes(f"frame {which}", int(np.prod(size))).reshape(size)) for which in ("A", "B")
    )
    yield "vision_encoder", Output(first.ravel(), other=second.ravel())
    visual = noise.numbers("visual tokens", policy.tokens_shape)
    yield from _language(policy.artifacts, language, visual, logits=LOGITS in later)
    if VOCABULARY in later:
        yield VOCABULARY, _vocabulary(language, noise)
    # Its answer is already proven where it reaches the action expert.
    guidance, context = _context(policy, language, noise)
    yield "semantic_context", Output(_flat(context.values()))
    semantic = SemanticState(0, 0, HERE, 0, guidance, context, "", STRAIGHT_AHEAD)
    planned = policy.act(visual, STATE, DELAY_S, OFFSET, semantic).ravel()
    yield "action_expert", Output(planned)
    frame = EncodedFrame(0, HERE, second)
    segments = language.prompt.build([frame], INSTRUCTION, EXAMPLE_PAST_PATH, EXAMPLE_BEFORE)
    # No new token: rounding may change one, and everything after it.
    generation = language.generate(segments, max_new_tokens=0, cancelled=lambda: False)
    semantic = SemanticState(
        0, 0, HERE, 0, generation.last_layer_kv, policy.semantic_context(generation.last_layer_kv), "", STRAIGHT_AHEAD
    )
    yield CHAIN, Output(policy.act(second, STATE, DELAY_S, OFFSET, semantic).ravel(), other=planned)


def _language(
    artifacts: Artifacts, language: LanguageModel, visual: Floats, *, logits: bool
) -> Iterator[tuple[str, Output]]:
    """Prefill some of a frame's tokens and text, decode given tokens one by one, then read the logits after others."""
    image_id = language.runtime.img_context_id
    text = _text_ids(language)
    places = min(PLACEHOLDERS, language.runtime.frame_tokens)
    language.run(language.prefill_call, Chunk((image_id,) * places, visual, 0), 0, None)
    filled = places
    start = language.run(language.prefill_call, Chunk(text[:TEXT_TOKENS], None, 0), filled, None)
    filled += TEXT_TOKENS
    tokens = start[-1:] if language.prefill_call is language.decode_call else []
    for token in text[TEXT_TOKENS : TEXT_TOKENS + DECODED]:
        tokens += language.run(language.decode_call, Chunk((token,), None, 0), filled, None)
        filled += 1
    rows = language.last_layer_kv(filled)[0]
    before, after = rows[: places + TEXT_TOKENS], rows[places + TEXT_TOKENS :]
    if artifacts.language_graphs == LANGUAGE_PAIR:
        yield LANGUAGE_PAIR[0], Output(before.ravel(), other=np.tile(before[0], len(before)))
        yield LANGUAGE_PAIR[1], Output(after.ravel(), tuple(tokens), other=np.tile(after[0], len(after)))
    else:
        yield artifacts.language_graphs[0], Output(rows.ravel(), tuple(tokens), other=np.tile(rows[0], len(rows)))
    if logits:
        # The K‖V of the last layer do not depend on the layers behind it: a damaged row of `lm_head` shows only here.
        scores = language.logits(Chunk(text[:MOST_ROWS], None, 0), filled)
        yield LOGITS, Output(scores.ravel(), other=np.tile(scores[0], len(scores)))


def _vocabulary(language: LanguageModel, noise: Noise) -> Output:
    """Prefill tokens of the whole vocabulary, in calls that each begin a context: a damaged row shows in its K‖V."""
    # The graph replaces a placeholder's row by a visual token.
    ids = np.array(sorted({*language.tokenizer.get_vocab().values()} - {language.runtime.img_context_id}))
    if len(ids) > MOST_VOCABULARY:
        order = noise.bytes("vocabulary", 8 * len(ids)).view("<u8").argsort(kind="stable")
        ids = np.sort(ids[order[:MOST_VOCABULARY]])
    size = min(language.runtime.prefill_chunk_tokens, language.runtime.max_context)
    rows: list[Floats] = []
    for start in range(0, len(ids), size):
        part = tuple(int(number) for number in ids[start : start + size])
        language.run(language.prefill_call, Chunk(part, None, 0), 0, None)
        rows.append(language.last_layer_kv(len(part))[0])
    values = np.concatenate(rows)
    return Output(values.ravel(), other=np.tile(values[0], len(values)))


def _context(policy: Policy, language: LanguageModel, noise: Noise) -> tuple[Floats, Context]:
    """Return K‖V of the seed and the semantic context of it (of waypoints for a policy that is guided by them)."""
    kv = noise.numbers("kv", (1, CONTEXT_TOKENS, language.runtime.kv_dim))
    if not policy.guided_by_waypoints:
        return kv, policy.semantic_context(kv)
    return kv, policy.make_context({"waypoints": noise.numbers("waypoints", (1, len(WAYPOINT_TIMES_S), 2))})


def _text_ids(language: LanguageModel) -> tuple[int, ...]:
    """Return the ids of the instruction's prompt that are plain text, at least TEXT_TOKENS + DECODED."""
    runtime = language.runtime
    special = {runtime.im_start_id, runtime.im_end_id, runtime.img_start_id, runtime.img_end_id, runtime.img_context_id}
    return tuple(number for number in _prompt_ids(language) if number not in special)


def _prompt_ids(language: LanguageModel) -> list[int]:
    nothing = EncodedFrame(0, HERE, np.zeros((1, 1, 1), dtype=np.float32))
    segments = language.prompt.build([nothing], INSTRUCTION, EXAMPLE_PAST_PATH, EXAMPLE_BEFORE)
    return [number for segment in segments for number in segment.ids]


def prompt_digest(artifacts: Artifacts, language: LanguageModel) -> str:
    """SHA-256 of the tokenizer, and of the token ids of the chain's prompt."""
    tokenizer = hashlib.sha256(artifacts.contents["tokenizer.json"]).hexdigest()
    return hashlib.sha256(f"{tokenizer} {_prompt_ids(language)}".encode()).hexdigest()


def _compare(noise: Noise, name: str, output: Output, known: KnownAnswers) -> float:
    """Return the used share of an answer's tolerance; raises SelfTestError."""
    answer = known.answers[name]
    _check_sound(name, output)
    # `hypot` does not overflow where NumPy's norm would warn: the manifest may contain any number.
    differences = noise.digest(name, output.values) - np.array(answer.digest)
    deviation = math.hypot(*differences.tolist()) / math.hypot(*answer.digest)
    if not deviation <= answer.tolerance:
        raise SelfTestError(
            f"{name} answers otherwise than at the export: deviation {deviation:.2g}, tolerance "
            f"{answer.tolerance:g}; {_advice(name)}"
        )
    same = sum(a == b for a, b in zip(output.tokens, answer.tokens, strict=False))
    if len(output.tokens) != len(answer.tokens) or same < known.same_tokens * len(answer.tokens):
        raise SelfTestError(
            f"{name} chooses other tokens than at the export: {same} of {len(answer.tokens)} are the same, expected "
            f"{known.same_tokens:.0%}; {_advice(name)}"
        )
    return deviation / answer.tolerance


def _check_sound(name: str, output: Output) -> None:
    """Raise SelfTestError for an answer that is not finite or does not depend on its input."""
    values = output.values
    if not np.isfinite(values).all():
        raise SelfTestError(
            f"{name} gives {int((~np.isfinite(values)).sum())} numbers that are not finite; export again"
        )
    size = float(np.abs(values).max())
    moved = 1.0 if output.other is None else float(np.abs(values - output.other).max()) / max(size, 1e-30)
    if float(np.ptp(values)) <= SAME_SHARE * size or moved <= SAME_SHARE:
        raise SelfTestError(f"{name} gives the same answer to everything; export again")


def _check_time(known: KnownAnswers, started_ns: int) -> None:
    took_s = (time.monotonic_ns() - started_ns) / 1e9
    if took_s > known.limit_s:
        raise SelfTestError(f"takes longer than its limit of {known.limit_s:g} s; check power mode and clocks")


def _advice(name: str) -> str:
    if name == CHAIN:
        return "graphs, settings or this release's chain differ; export again"
    return "weights, provider or driver differ; edge-doctor names the provider, else export again"


def _flat(arrays: Iterable[Array]) -> Floats:
    return np.concatenate([np.asarray(array).astype(np.float32).ravel() for array in arrays])
