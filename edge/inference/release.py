"""Release delays: they hold a finished generation back to emulate slower hardware (paper §3.3, appendix D)."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from firmware_bridge.system.input_file import read_json

MAX_DELAY_S = 60.0


class ReleaseDelayError(ValueError):
    """A release delay that cannot be read."""


@dataclass(frozen=True)
class ReleaseDelay:
    """A constant (`sd_s` 0) or a gamma distribution of that mean and deviation cut to [low_s, high_s], seeded."""

    mean_s: float
    sd_s: float = 0.0
    low_s: float = 0.0
    high_s: float = MAX_DELAY_S
    seed: int = 0

    def __post_init__(self) -> None:
        values = (self.mean_s, self.sd_s, self.low_s, self.high_s)
        if not all(math.isfinite(v) and v >= 0 for v in values):
            raise ReleaseDelayError(f"release delay values must be finite and not negative, found {values}")
        if self.sd_s != 0 and not 1e-3 <= self.sd_s <= MAX_DELAY_S:
            raise ReleaseDelayError(f"expected sd_s 0 or between 0.001 and {MAX_DELAY_S} s, found {self.sd_s}")
        if not self.low_s <= self.mean_s <= self.high_s <= MAX_DELAY_S:
            raise ReleaseDelayError(f"expected low ≤ mean ≤ high ≤ {MAX_DELAY_S} s, found {values}")

    def sampler(self) -> Callable[[], float]:
        """Return a function that draws delays (s). The same seed gives the same sequence."""
        generator = random.Random(self.seed)
        if self.sd_s == 0 or self.mean_s == 0:
            return lambda: self.mean_s
        shape = (self.mean_s / self.sd_s) ** 2
        return lambda: min(self.high_s, max(self.low_s, generator.gammavariate(shape, self.mean_s / shape)))


_KEYS = {"schema", "mean_s", "sd_s", "low_s", "high_s", "seed"}


def parse_release_delay(argument: str) -> ReleaseDelay:
    """Read `--release-delay S|PROFILE.json`; raises ReleaseDelayError with one clear line."""
    try:
        return ReleaseDelay(mean_s=float(argument))
    except ReleaseDelayError as error:
        raise ReleaseDelayError(f"release delay {argument}: {error}") from error
    except ValueError:
        pass
    path = Path(argument)
    try:
        content: Any = read_json(path)
    except OSError as error:
        raise ReleaseDelayError(
            f"release delay {argument!r}: neither a number of seconds nor a file ({error.strerror})"
        ) from error
    except ValueError as error:
        raise ReleaseDelayError(f"release delay profile {path}: not JSON ({error})") from error
    if not isinstance(content, dict) or content.get("schema") != 1:
        raise ReleaseDelayError(f'release delay profile {path}: expected an object with "schema": 1')
    unknown = sorted(set(content) - _KEYS)
    if unknown:
        raise ReleaseDelayError(f"release delay profile {path}: unknown keys {unknown}, known are {sorted(_KEYS)}")
    values = {key: value for key, value in content.items() if key != "schema"}
    if "mean_s" not in values or not all(
        isinstance(v, int if key == "seed" else int | float) and not isinstance(v, bool) for key, v in values.items()
    ):
        raise ReleaseDelayError(f"release delay profile {path}: mean_s is required and every value must be a number")
    return ReleaseDelay(**values)
