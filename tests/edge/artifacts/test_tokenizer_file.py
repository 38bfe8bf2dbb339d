"""A tokenizer.json is checked before the library that runs it opens it."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest

from edge.artifacts.tokenizer_file import MAX_TOKENS, TokenizerFileError, check_tokenizer_file
from export.model.tokenizers.nano import NANO_TOKENIZER

SPECIAL = {"<|im_start|>": 1, "<|im_end|>": 2, "<img>": 3, "</img>": 4, "<IMG_CONTEXT>": 5}
Edit = Callable[[dict[str, Any]], object]


def split_at(pattern: object) -> Edit:
    return lambda t: t["pre_tokenizer"]["pretokenizers"][0].update(pattern=pattern)


def normalizer(entry: object) -> Edit:
    return lambda t: t.update(normalizer=entry)


REPLACE = {"type": "Replace", "pattern": {"String": "e"}, "content": "e" * 1_000_000}
REFUSED: dict[str, tuple[Edit, str]] = {
    "a normalizer that expands": (normalizer(REPLACE), "normalizer 'Replace' is not one whose result is bounded"),
    "one in a sequence": (
        normalizer({"type": "Sequence", "normalizers": [{"type": "NFC"}, REPLACE]}),
        "normalizer 'Replace' is not one",
    ),
    "a sequence in a sequence": (
        normalizer({"type": "Sequence", "normalizers": [{"type": "Sequence", "normalizers": []}]}),
        "normalizer 'Sequence' is not one",
    ),
    "a long sequence": (
        normalizer({"type": "Sequence", "normalizers": [{"type": "NFKD"}] * 9}),
        "normalizer must have at most 8 parts",
    ),
    "a normalizer of text": (normalizer("NFC"), "normalizer 'None' is not one"),
    "a pattern that backtracks": (split_at({"Regex": "(a+)+$"}), "expected a plain text or the pattern of GPT-2"),
    "a pattern that panics": (split_at({"Regex": "("}), "expected a plain text or the pattern of GPT-2"),
    "a pattern of numbers": (split_at({"Regex": 3}), "expected a plain text or the pattern of GPT-2"),
    "a decoder that expands": (lambda t: t.update(decoder=REPLACE), "decoder 'Replace' is not one"),
    "padding": (lambda t: t.update(padding={"strategy": {"Fixed": 10**9}}), "padding must be null"),
    "truncation": (lambda t: t.update(truncation={"max_length": 3}), "truncation must be null"),
    "subword prefix": (
        lambda t: t["model"].update(continuing_subword_prefix="##"),
        "continuing_subword_prefix must be empty",
    ),
    "dropout": (lambda t: t["model"].update(dropout=0.5), "dropout must be null"),
    "two tokens of one id": (lambda t: t["model"]["vocab"].update({"!": 7, "@": 7}), "two tokens have the same id"),
    "a negative id": (lambda t: t["model"]["vocab"].update({"!": -7}), "a token's id is out of range"),
    "a huge id": (lambda t: t["model"]["vocab"].update({"!": MAX_TOKENS}), "a token's id is out of range"),
    "an id of text": (lambda t: t["model"]["vocab"].update({"!": "7"}), "a token's id is out of range"),
    "a huge token": (lambda t: t["model"]["vocab"].update({"!" * 1000: 5000}), "a token is longer than 512"),
    "an added token twice": (lambda t: t["added_tokens"].append(t["added_tokens"][0]), "no text of its own"),
    "an added token without text": (lambda t: t["added_tokens"].append({"id": 9}), "no text of its own"),
    "exchanged special tokens": (
        lambda t: [t["added_tokens"][n].update(id=7 - n) for n in (3, 4)],
        "<img> is id 4, the network was built for 3",
    ),
    "no model": (lambda t: t.pop("model"), "not a tokenizer: expected a model of BPE"),
    "a kind of model that is no text": (
        lambda t: t["model"].update(type=[]),
        "not a tokenizer: expected a model of BPE",
    ),
    "another kind of model": (lambda t: t["model"].update(type="Unigram"), "not a tokenizer: expected a model of BPE"),
}


@pytest.mark.parametrize(("edit", "message"), REFUSED.values(), ids=REFUSED)
def test_a_part_without_a_bound_is_refused(edit: Edit, message: str) -> None:
    content = json.loads(NANO_TOKENIZER.read_bytes())
    edit(content)
    with pytest.raises(TokenizerFileError, match=message):
        check_tokenizer_file(json.dumps(content).encode(), SPECIAL)


@pytest.mark.parametrize("content", [b"", b"{}", b"[]", b"\xff", b"[" * 100_000], ids=lambda content: repr(content[:9]))
def test_a_file_that_is_no_tokenizer_is_refused(content: bytes) -> None:
    with pytest.raises(TokenizerFileError, match="not a tokenizer"):
        check_tokenizer_file(content, SPECIAL)


def test_the_shipped_tokenizer_is_accepted() -> None:
    assert check_tokenizer_file(NANO_TOKENIZER.read_bytes(), SPECIAL) == 1024


@pytest.mark.slow
def test_the_tokenizer_of_the_paper_is_accepted() -> None:
    from export.model.config import PRESETS
    from export.model.tokenizers.internvl import build_tokenizer

    assert check_tokenizer_file(build_tokenizer(), {"<img>": PRESETS["1b"].language.img_start_id}) == 151_674
