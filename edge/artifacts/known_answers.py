"""The manifest's known answers: what the exporter's graphs answered to inputs that are made from a seed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from edge.artifacts.files import MANIFEST_NAME, ArtifactError

CHAIN: Final = "chain"
"""Name of the answer of the whole chain: picture and instruction in, trajectory out."""
VOCABULARY: Final = "vocabulary"
"""Name of the language model's answer to every token of its vocabulary."""
LOGITS: Final = "logits"
"""Name of what the language model thinks of every token as the next one."""
LATER: Final = frozenset({VOCABULARY, LOGITS})
"""Answers that manifests of earlier exports do not have."""
SUMS: Final = 16
"""Numbers in a digest."""
MAX_TOLERANCE: Final = 0.2
LIMITS_S: Final = (5.0, 600.0)
MAX_TOKENS: Final = 64


@dataclass(frozen=True)
class Answer:
    """Answer of a graph or of the chain; raises ArtifactError."""

    digest: tuple[float, ...]
    """Signed sums of the output's elements; the signs are made from the seed (`edge.inference.self_test`)."""
    tolerance: float
    """Largest relative deviation of the digest, by the precision of the weights."""
    tokens: tuple[int, ...] = ()
    """Next tokens of the language model after given ones."""

    def __post_init__(self) -> None:
        if len(self.digest) != SUMS or not all(map(math.isfinite, self.digest)) or not any(self.digest):
            raise ArtifactError(f"a digest must be {SUMS} finite numbers, not all 0")
        if not 0 < self.tolerance <= MAX_TOLERANCE:
            raise ArtifactError(f"tolerance {self.tolerance:g}, expected above 0 to {MAX_TOLERANCE:g}")
        if len(self.tokens) > MAX_TOKENS or not all(0 <= token < 1 << 31 for token in self.tokens):
            raise ArtifactError(f"tokens must be at most {MAX_TOKENS} ids")

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON form."""
        return {"digest": list(self.digest), "tolerance": self.tolerance, "tokens": list(self.tokens)}


@dataclass(frozen=True)
class KnownAnswers:
    """The `self_test` section of a manifest."""

    seed: int
    limit_s: float
    """Time limit of the self-test on the robot's computer, s."""
    prompt: str
    """SHA-256 of the tokenizer and of the token ids of the chain's prompt."""
    same_tokens: float
    """Smallest share of the next tokens that must be the same."""
    answers: Mapping[str, Answer]
    """By graph, in the order in which they are computed, CHAIN and those of LATER."""

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON form."""
        return {**vars(self), "answers": {name: answer.to_dict() for name, answer in self.answers.items()}}


def read_known_answers(section: Any, graphs: Iterable[str]) -> KnownAnswers | None:
    """Read a manifest's `self_test`; None for an empty one, of an export under way. Raises ArtifactError."""
    if section == {}:
        return None
    try:
        if not isinstance(section, dict) or set(section) != set(KnownAnswers.__dataclass_fields__):
            raise ArtifactError(f"expected {', '.join(KnownAnswers.__dataclass_fields__)}")
        answers = {str(name): _answer(str(name), entry) for name, entry in section["answers"].items()}
        if {*answers, *LATER} != {*graphs, CHAIN, *LATER}:
            raise ArtifactError(f"answers of {sorted(answers)}, expected one of every graph and of the {CHAIN}")
        known = KnownAnswers(
            seed=int(section["seed"]),
            limit_s=_number(section["limit_s"]),
            prompt=str(section["prompt"]),
            same_tokens=_number(section["same_tokens"]),
            answers=answers,
        )
        least_s, most_s = LIMITS_S
        if not (least_s <= known.limit_s <= most_s and 0 < known.same_tokens <= 1 and 0 <= known.seed < 1 << 32):
            raise ArtifactError(f"expected limit_s {least_s:g} to {most_s:g}, same_tokens 0 to 1, a seed of 32 bits")
    except (ArtifactError, AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        text = str(error) if isinstance(error, ArtifactError) else f"{type(error).__name__}: {error}"
        raise ArtifactError(f"{MANIFEST_NAME}: self_test: {text}; export again") from error
    return known


def _answer(name: str, entry: Mapping[str, Any]) -> Answer:
    try:
        digest, tokens = tuple(map(_number, entry["digest"])), entry["tokens"]
        if not isinstance(tokens, list) or not all(type(token) is int for token in tokens):
            raise ArtifactError("tokens must be a list of ids")
        return Answer(digest, _number(entry["tolerance"]), tuple(tokens))
    except ArtifactError as error:
        raise ArtifactError(f"{name}: {error}") from error


def _number(value: Any) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise ArtifactError(f"expected a number, found {str(value)[:40]!r}")
    return float(value)
