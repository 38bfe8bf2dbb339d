"""The `nano` tokenizer: byte-level BPE trained on the words of instructions and reasoning texts.

A word is about one token; a coordinate is two, one for sign and whole metres, one for the tenths. In so small a model
every token costs time twice: it is prefilled or decoded, and the action expert reads its keys. `python -m
export.model.tokenizers.nano` writes `nano_tokenizer.json` again; the file is in the repository so that an export does
not depend on the trainer's version.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from tokenizers import AddedToken, Regex, Tokenizer, decoders, models, pre_tokenizers, trainers

from export.model.config import PRESETS
from firmware_bridge.system.input_file import read_toml

NANO_TOKENIZER = Path(__file__).with_name("nano_tokenizer.json")
NANO_WORDS = Path(__file__).with_name("nano_words.toml")
SPECIAL_TOKENS = ("<|endoftext|>", "<|im_start|>", "<|im_end|>", "<img>", "</img>", "<IMG_CONTEXT>")
PIECES = (
    r" ?\(?-?\d+\.(?=\d)"  # " (-12." of " (-12.3, 4.5)"
    r"|(?<=\.)\d+[,)]?"  # its "3,"
    r"| ?\d+:?"  # " 6", "Frame 1:"
    r"| ?\p{L}+:?"  # " door", "Plan:"
    r"|\.?\n"  # the ends of sentence and line are one piece
    r"| ?[^\s\p{L}\p{N}]+"
    r"|\s+(?!\S)|\s+"
)
"""Largest piece of a token (Oniguruma syntax); every character belongs to one piece."""
FARTHEST_M = 30
"""Largest coordinate, m, whose whole metres are one token; larger ones take two or three."""

_SPLIT = pre_tokenizers.Sequence(
    [
        pre_tokenizers.Split(Regex(PIECES), behavior="isolated"),
        pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False),
    ]
)


def word_lists() -> dict[str, list[str]]:
    """Read the words of `nano_words.toml` by list, each once, in the file's order."""
    data = read_toml(NANO_WORDS)
    return {key: list(dict.fromkeys(text.replace(",", " ").split())) for key, text in data.items()}


def _numbers() -> Iterator[str]:
    """Yield texts with every common piece of paths, waypoints, distances and counts."""
    for whole in range(FARTHEST_M + 1):
        yield from (f" ({whole}.5, {whole}.5)", f" (-{whole}.5, -{whole}.5)", f" {whole}", f" {whole}.")
    for tenth in range(10):
        yield f" (0.{tenth}, 0.{tenth})"
    for frame in range(1, 5):
        yield f" {frame}:"


def train(vocab: int) -> Tokenizer:
    """Train the tokenizer: special tokens have ids 0…5; decoding an encoded text returns the text.

    Words of the reasoning text's sentences are whole tokens. The rest of the vocabulary are merges of byte-level BPE,
    trained on all lists, which encode every other text.
    """
    lists = word_lists()
    everyday = [f" {word}" for word in lists.pop("everyday")]
    # A word follows a space; names of aspects and roles begin a line.
    starts = lists.pop("line_starts")
    ours = [f" {word}" for words in lists.values() for word in words] + [*starts, *_numbers(), ".\n"]
    wholes = list(dict.fromkeys(piece for text in ours for piece in _pieces(text)))
    base = _tokenizer(models.BPE())
    trainer = trainers.BpeTrainer(
        vocab_size=vocab - len(wholes),
        special_tokens=list(SPECIAL_TOKENS),
        initial_alphabet=sorted(pre_tokenizers.ByteLevel.alphabet()),
        show_progress=False,
    )
    base.train_from_iterator([*ours, *everyday], trainer)
    tokens = [token for token, _ in sorted(base.get_vocab().items(), key=lambda item: item[1])]
    spare = [piece for text in everyday for piece in _pieces(text)]
    tokens = list(dict.fromkeys([*tokens, *wholes, *spare]))[:vocab]
    merges = [(first, second) for first, second in json.loads(base.to_str())["model"]["merges"]]
    ids = {token: index for index, token in enumerate(tokens)}
    # A piece that equals a token needs no merges.
    tokenizer = _tokenizer(models.BPE(vocab=ids, merges=merges, ignore_merges=True))
    tokenizer.add_special_tokens([AddedToken(token, special=True) for token in SPECIAL_TOKENS])
    return tokenizer


def _tokenizer(model: models.BPE) -> Tokenizer:
    tokenizer = Tokenizer(model)
    tokenizer.pre_tokenizer = _SPLIT
    tokenizer.decoder = decoders.ByteLevel()
    return tokenizer


def _pieces(text: str) -> list[str]:
    """Return the byte-level pieces of a text before merging."""
    return [piece for piece, _ in _SPLIT.pre_tokenize_str(text)]


def main() -> None:
    """Write the tokenizer file of preset `nano`."""
    train(PRESETS["nano"].language.vocab).save(str(NANO_TOKENIZER), pretty=False)


if __name__ == "__main__":
    main()
