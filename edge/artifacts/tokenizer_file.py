"""Checks a tokenizer.json, then opens it with the `tokenizers` library: no part may expand a text, loop or panic.

The library runs what the file describes: a normalizer that replaces one letter by a million, padding to 10⁹ tokens, a
regular expression that backtracks for hours. So only parts with a bounded result are accepted, and only known patterns.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Final

from tokenizers import Tokenizer

from edge.artifacts.files import ArtifactError

MAX_TOKENS: Final = 1 << 20
MAX_TOKEN_CHARS: Final = 512
MAX_ADDED: Final = 4096
MAX_PARTS: Final = 8
"""Parts of a sequence; sequences within sequences are refused."""
PARTS: Final[Mapping[str, frozenset[str]]] = {
    "normalizer": frozenset({"NFC", "NFD", "NFKC", "NFKD", "Lowercase", "Strip", "StripAccents"}),
    "pre_tokenizer": frozenset({"ByteLevel", "Digits", "Punctuation", "Split", "Whitespace", "WhitespaceSplit"}),
    "post_processor": frozenset({"ByteLevel"}),
    "decoder": frozenset({"ByteFallback", "ByteLevel", "Fuse"}),
}
"""Section → kinds of parts whose result is at most a small multiple of the text."""
_LISTS: Final = {
    "normalizer": "normalizers",
    "pre_tokenizer": "pretokenizers",
    "post_processor": "processors",
    "decoder": "decoders",
}
PATTERNS: Final = frozenset({
    # nano
    r" ?\(?-?\d+\.(?=\d)|(?<=\.)\d+[,)]?| ?\d+:?| ?\p{L}+:?|\.?\n| ?[^\s\p{L}\p{N}]+|\s+(?!\S)|\s+",
    # Qwen2 (InternVL3-1B)
    r"(?i:'s|'t|'re|'ve|'m|'ll|'d)|[^\r\n\p{L}\p{N}]?\p{L}+|\p{N}| ?[^\s\p{L}\p{N}]+[\r\n]*|\s*[\r\n]+|\s+(?!\S)|\s+",
    # GPT-2
    r"'s|'t|'re|'ve|'m|'ll|'d| ?\p{L}+| ?\p{N}+| ?[^\s\p{L}\p{N}]+|\s+(?!\S)|\s+",
})  # fmt: skip
"""Known regular expressions of `Split`: none backtracks over more than a word."""
MODELS: Final = frozenset({"BPE", "WordLevel"})


class TokenizerFileError(ValueError):
    """A tokenizer.json that must not be opened; one line without the file's name."""


def check_tokenizer_file(content: bytes, special: Mapping[str, int]) -> int:
    """Return the size of the vocabulary, highest id + 1; raises TokenizerFileError.

    `special`: token → id of the tokens that only the prompt builder writes.
    """
    try:
        found: Any = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise TokenizerFileError(f"not a tokenizer: not JSON ({type(error).__name__})") from error
    model = found.get("model") if isinstance(found, dict) else None
    kind = model.get("type") if isinstance(model, dict) else None
    known = isinstance(kind, str) and kind in MODELS
    if not isinstance(model, dict) or not isinstance(model.get("vocab"), dict) or not known:
        raise TokenizerFileError(f"not a tokenizer: expected a model of {', '.join(sorted(MODELS))} with a vocabulary")
    for key in ("truncation", "padding"):
        _require(found.get(key) is None, f"{key} must be null: it changes the length of a prompt")
    _require(not model.get("dropout"), "model.dropout must be null: it makes tokens random")
    prefix = model.get("continuing_subword_prefix")
    _require(not prefix, "model.continuing_subword_prefix must be empty: the library ends its merges with a panic")
    for section, kinds in PARTS.items():
        _check_section(section, kinds, found.get(section))
    ids = _vocabulary(model["vocab"])
    added = _added(found.get("added_tokens"))
    for token, wanted in special.items():
        found_id = added.get(token, model["vocab"].get(token))
        _require(found_id == wanted, f"{token} is id {found_id}, the network was built for {wanted}")
    return max((*ids, *added.values())) + 1


def open_tokenizer(content: bytes) -> Tokenizer:
    """Open a checked tokenizer.json; raises ArtifactError."""
    try:
        return Tokenizer.from_buffer(content)
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # a panic of the library is no Exception
        reason = (str(error).splitlines() or [""])[0][:160]
        raise ArtifactError(f"tokenizer.json: not a tokenizer ({reason}); export again") from error


def _check_section(section: str, kinds: frozenset[str], entry: Any) -> None:
    parts: Any = [] if entry is None else [entry]
    if isinstance(entry, dict) and entry.get("type") == "Sequence":
        parts = entry.get(_LISTS[section])
        _require(isinstance(parts, list) and len(parts) <= MAX_PARTS, f"{section} must have at most {MAX_PARTS} parts")
    for part in parts:
        kind = part.get("type") if isinstance(part, dict) else None
        _require(
            isinstance(kind, str) and kind in kinds,
            f"{section} {str(kind)[:40]!r} is not one whose result is bounded; expected {', '.join(sorted(kinds))}",
        )
        if kind == "Split":
            _check_pattern(section, part.get("pattern"))


def _check_pattern(section: str, pattern: Any) -> None:
    text = pattern.get("Regex", pattern.get("String")) if isinstance(pattern, dict) and len(pattern) == 1 else None
    plain = isinstance(pattern, dict) and "String" in pattern and isinstance(text, str) and 0 < len(text) <= 64
    _require(
        plain or (isinstance(text, str) and text in PATTERNS),
        f"{section} splits at {str(text)[:40]!r}, expected a plain text or the pattern of GPT-2, Qwen2 or nano: others "
        f"can take for ever",
    )


def _vocabulary(vocabulary: Mapping[str, Any]) -> set[int]:
    _require(0 < len(vocabulary) <= MAX_TOKENS, f"{len(vocabulary)} tokens, expected 1 to {MAX_TOKENS}")
    ids = list(vocabulary.values())
    _require(all(type(number) is int and 0 <= number < MAX_TOKENS for number in ids), "a token's id is out of range")
    _require(len(set(ids)) == len(ids), "two tokens have the same id")
    _require(max(map(len, vocabulary)) <= MAX_TOKEN_CHARS, f"a token is longer than {MAX_TOKEN_CHARS} characters")
    return set(ids)


def _added(entries: Any) -> dict[str, int]:
    _require(isinstance(entries, list) and len(entries) <= MAX_ADDED, f"added_tokens must be at most {MAX_ADDED}")
    found: dict[str, int] = {}
    for entry in entries:
        content, number = (entry.get("content"), entry.get("id")) if isinstance(entry, dict) else (None, None)
        if not isinstance(content, str) or not 0 < len(content) <= MAX_TOKEN_CHARS or content in found:
            raise TokenizerFileError("an added token has no text of its own")
        if type(number) is not int or not 0 <= number < MAX_TOKENS:
            raise TokenizerFileError("an added token's id is out of range")
        found[content] = number
    _require(len(set(found.values())) == len(found), "two added tokens have the same id")
    return found


def _require(sound: bool, message: str) -> None:
    if not sound:
        raise TokenizerFileError(message)
