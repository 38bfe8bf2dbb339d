"""The `nano` tokenizer: byte-level BPE trained on the sentences a navigating robot hears and says.

`python -m export.model.tokenizer` writes `nano_tokenizer.json` anew; the file is in the repository so that an export
does not depend on the trainer's version.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path

from tokenizers import Tokenizer, decoders, models, pre_tokenizers, trainers

NANO_TOKENIZER = Path(__file__).with_name("nano_tokenizer.json")
SPECIAL_TOKENS = ("<|endoftext|>", "<|im_start|>", "<|im_end|>", "<img>", "</img>", "<IMG_CONTEXT>")

_PLACES = (
    "corridor hallway aisle room lobby office ward kitchen sidewalk plaza street entrance exit elevator stairs door "
    "doorway corner intersection crossing ramp kerb"
).split()
_LANDMARKS = (
    "vending machine|hospital bed|water dispenser|reception desk|nurse station|elevator|desk|chair|carpet|rack|forklift|"
    "traffic cone|fire extinguisher|fountain|umbrella|storefront|bench|potted plant|trash bin|notice board|wheelchair|"
    "shelf|pallet|printer|sofa|window|pillar|sign|mailbox|tree|bicycle|door"
).split("|")
_COLOURS = "red green blue yellow white black orange grey brown purple".split()
_ORDINALS = "first second third fourth last next nearest".split()
_VERBS = "walk go drive move head continue proceed run".split()
_SIDES = "left right front back middle end far near".split()
_PEOPLE = "person people pedestrian man woman child crowd group worker nurse patient visitor".split()
_MOTIONS = "walking standing crossing approaching leaving waiting turning stopping queueing moving talking".split()
_WORDS = """
about above across after again against almost alone already also although always among another any anyone anything around away
back backwards because become before begin behind below beneath beside besides best better between beyond both bring building bumping busy
button call can cannot care careful carefully carry centre chance change check choose circle clear close closer closest come coming continue
could cross cup cut daylight deliver desired different direction distance does down during each early easy edge either else empty enough
enter even every everyone everything exactly except far farther fast faster few final finally find finish follow following food forward free
from full further gate gently get give glass goal going gone good great green ground guide half hand hard have hear heading help here high
hold home hour house how hurry immediately important inside instead into just keep kind know large late later leave left-hand less let light
like line little long look lower main make many may maybe meet metal meter meters might minute minutes mind mine more morning most much must
narrow near nearby need never night noise none not nothing now number object obstacle off often once one only onto open opposite other
otherwise our out outside over parallel park parking part party pass passage passing past path pause perhaps pick piece place plastic please
point position possible prefer press probably public pull push quarter quick quickly quiet quietly rather reach reaching ready remain return
reverse right-hand road robot round same second seconds see seem seen send several shall sharp short should show side signal similar since
slow slower slowly small smoothly some someone something soon space speed stand start station stay steady step steps still straight suddenly
sure surroundings table take target tell than thank that their them there these they thing this those though three through time tiny together
too top touch toward towards town traffic travel try twice two under underneath unless until upstairs use usual very view visible wall want
warning was watch water way well what when where which while white whole wide will window wish with within without wooden work would wrong
yard yellow you your zone zebra
""".split()
_NUMBERS = [f"{sign}{whole}.{tenth}" for sign in ("", "-") for whole in range(12) for tenth in range(10)]


def corpus() -> Iterator[str]:
    """Instructions, five-aspect reasoning (paper appendix B) and waypoint lines."""
    yield "You drive a robot through people. Describe the situation, then give waypoints."
    yield "Frame 1: Frame 2: Frame 3: Frame 4: Instruction: Past motion: none"
    for verb, place, landmark in itertools.product(_VERBS, _PLACES, _LANDMARKS):
        yield f"{verb} down the {place} and stop at the {landmark}"
        yield f"{verb} along the {place}, pass the {landmark} and turn"
    for ordinal, landmark, side in itertools.product(_ORDINALS, _LANDMARKS, _SIDES):
        yield f"take the {ordinal} {landmark} on the {side} side, then go straight towards it and wait in front of it"
    for colour, landmark, place in itertools.product(_COLOURS, _LANDMARKS, _PLACES):
        yield f"Situation: the robot is in a {place}. Objects: a {colour} {landmark} ahead, about three meters away."
    for person, motion, side in itertools.product(_PEOPLE, _MOTIONS, _SIDES):
        yield f"Motion: a {person} is {motion} on the {side}, nobody blocks the path. Slow down, keep a safe distance, yield."
        yield f"Progress: the goal is not yet visible. Plan: turn {side}, avoid the {person}, then follow the instruction."
    for word in _WORDS:
        yield from (f"please {word} {word}", f"{word} the {word}") * 20
    for a, b in itertools.product(_NUMBERS[::2], _NUMBERS[::7]):
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
