"""The `nano` tokenizer: byte-level BPE trained on the sentences a navigating robot hears and says.

`python -m export.model.tokenizer` writes `nano_tokenizer.json` anew; the file is in the repository so that an export
does not depend on the trainer's version.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterator
from pathlib import Path

from tokenizers import Tokenizer, decoders, models, pre_tokenizers, trainers

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

NANO_TOKENIZER = Path(__file__).with_name("nano_tokenizer.json")
NANO_WORDS = Path(__file__).with_name("nano_words.toml")
SPECIAL_TOKENS = ("<|endoftext|>", "<|im_start|>", "<|im_end|>", "<img>", "</img>", "<IMG_CONTEXT>")


def corpus() -> Iterator[str]:
    """Instructions, five-aspect reasoning (paper appendix B) and waypoint lines."""
    lists = tomllib.loads(NANO_WORDS.read_text(encoding="utf-8"))
    words = {key: [word.strip() for word in text.split(",")] for key, text in lists.items()}
    numbers = [f"{sign}{whole}.{tenth}" for sign in ("", "-") for whole in range(12) for tenth in range(10)]
    yield "You drive a robot through people. Describe the situation, then give waypoints."
    yield "Frame 1: Frame 2: Frame 3: Frame 4: Instruction: Past motion: none"
    for verb, place, landmark in itertools.product(words["verbs"], words["places"], words["landmarks"]):
        yield f"{verb} down the {place} and stop at the {landmark}"
        yield f"{verb} along the {place}, pass the {landmark} and turn"
    for ordinal, landmark, side in itertools.product(words["ordinals"], words["landmarks"], words["sides"]):
        yield f"take the {ordinal} {landmark} on the {side} side, then go straight towards it and wait in front of it"
    for colour, landmark, place in itertools.product(words["colours"], words["landmarks"], words["places"]):
        yield f"Situation: the robot is in a {place}. Objects: a {colour} {landmark} ahead, about three meters away."
    for person, motion, side in itertools.product(words["people"], words["motions"], words["sides"]):
        yield f"Motion: a {person} is {motion} on the {side}, nobody blocks the path."
        yield f"Plan: turn {side}, slow down, keep a safe distance, yield, avoid the {person}."
        yield "Progress: the goal is not yet visible; follow the instruction."
    for word in words["words"]:
        yield from (f"please {word} {word}", f"{word} the {word}") * 20
    for a, b in itertools.product(numbers[::2], numbers[::7]):
        yield f"waypoints: ({a}, {b}) ({b}, {a})"


def train(vocab: int) -> Tokenizer:
    """Train byte-level BPE; the special tokens take ids 0…5 and any text survives a round trip."""
    tokenizer = Tokenizer(models.BPE())
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(
        vocab_size=vocab,
        special_tokens=list(SPECIAL_TOKENS),
        initial_alphabet=sorted(pre_tokenizers.ByteLevel.alphabet()),
        show_progress=False,
    )
    tokenizer.train_from_iterator(corpus(), trainer)
    return tokenizer


def main() -> None:
    """Write the tokenizer file of preset `nano`."""
    from export.model.config import PRESETS

    train(PRESETS["nano"].language.vocab).save(str(NANO_TOKENIZER), pretty=False)


if __name__ == "__main__":
    main()
