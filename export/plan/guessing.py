"""Time of a generation whose decoding calls verify guesses (`edge.inference.speculation`)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from export.model.config import TicVlaConfig
from export.plan.timing import Estimate, StageTime, Work, modelled_stage, total
from export.quantize.precision import Precision
from export.targets.file import Target
from export.targets.sections import MODELLED

TOKENS_PER_CALL = {2: 1.79, 4: 3.04, 8: 4.59, 16: 6.16}
"""New tokens of a decoding call by its rows, all but one of them guesses: counted on 478 texts of four benchmark
episodes with the shipped weights."""
ACCEPTANCE = 0.89
"""Share of those guesses that the model chose."""


@dataclass(frozen=True)
class GuessingTime:
    """Generation with guesses while control does not run, on a device whose longer calls give equal bits."""

    rows: int
    """Rows of a decoding call."""
    decode: Estimate
    generation: Estimate
    share: float
    """Its time as a share of a generation that guesses nothing; the largest Δt shrinks by the same share."""

    @property
    def tokens_per_call(self) -> float:
        """New tokens of a decoding call, on average."""
        return TOKENS_PER_CALL[self.rows]

    def to_dict(self, delay_s: float | None) -> dict[str, Any]:
        """Return the manifest's `plan.speculation`; `delay_s`: the largest Δt without guesses, s."""
        return {
            "rows": self.rows,
            "tokens_per_call": self.tokens_per_call,
            "acceptance": ACCEPTANCE,
            "decode_ms": round(self.decode.ms, 3),
            "generation_alone_ms": round(self.generation.ms, 3),
            "delay_s": None if delay_s is None else round(delay_s * self.share, 3),
            "tagged": MODELLED,
        }


def guessing_time(
    target: Target,
    config: TicVlaConfig,
    precision: Precision,
    work: Work,
    single: StageTime,
    others: Sequence[Estimate],
) -> GuessingTime:
    """Estimate a generation with the number of rows that is fastest.

    `single`: decoding one token a call, which the model's ratio of a longer call to a short one scales; `others`: the
    other stages of the generation.
    """
    one = modelled_stage(target, config, "decode", precision, work)
    ways: list[GuessingTime] = []
    for rows, tokens_per_call in TOKENS_PER_CALL.items():
        calls = math.ceil(work.new_tokens / tokens_per_call)
        longer = modelled_stage(target, config, "decode", precision, work, decode_calls=(rows, calls))
        factor = longer.whole.ms / one.whole.ms if one.whole.ms else 1.0
        decode = replace(single.whole.times(factor), tag=MODELLED)
        generation = total([*others, decode])
        share = generation.ms / total([*others, single.whole]).ms
        ways.append(GuessingTime(rows, decode, generation, share))
    return min(ways, key=lambda way: way.decode.ms)
