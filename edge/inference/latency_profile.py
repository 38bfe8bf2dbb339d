"""A device's latency profile: a file of generation times that calibration writes and simulations draw from.

A profile file (JSON or TOML) has `schema = 1`, `name`, `source` (the measured device) and `generation_s`, a list of
times, s. Optional are `anchor_after_s`, of the same length: time from a generation's start to the capture of its newest
frame; `tagged`: measured or modelled; and, together, `call_s` and `rest_s`. `call_s` has the duration of a decoding
call by its number of rows, such as {"2": 0.021, "8": 0.024}, and `rest_s` each generation's time without the calls
after its first token. Virtual time then adds up the calls that a text takes. A flight log or the result of an
`edge-run` is read directly.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edge.artifacts.manifest import LEAST_ROWS, MOST_ROWS
from edge.flightlog.reader import RecordingError, read_messages
from edge.inference.release import MAX_DELAY_S
from edge.power.meters.meter import MEASURED, MODELLED
from firmware_bridge.system.input_file import read_json, read_toml

SCHEMA = 1
MAX_SAMPLES = 100_000
MAX_BYTES = 16_000_000
QUANTILE_STEPS = 200
"""Number of times drawn from a distribution that is given by percentiles only."""
_POINTS = ("p50", "p99", "max")
_KEYS = ("schema", "name", "source", "generation_s", "anchor_after_s", "tagged", "call_s", "rest_s")


class LatencyError(ValueError):
    """An unusable latency; the message is one line: what, expected, found."""


@dataclass(frozen=True)
class LatencyProfile:
    """Times to draw from with equal chances; a single one is a constant."""

    name: str
    source: str
    """The measured device; "setting" for a constant."""
    generation_s: tuple[float, ...]
    anchor_after_s: tuple[float, ...] = ()
    """Time from a generation's start to its newest frame, s; empty: 0 for all."""
    tagged: str = MODELLED
    """MEASURED for times of a device, MODELLED for set or scaled numbers."""
    call_s: tuple[tuple[int, float], ...] = ()
    """Ascending numbers of rows of a decoding call with its duration, s; 1 row only: the device guesses nothing."""
    rest_s: tuple[float, ...] = ()
    """Each generation's time without the decoding calls after its first token, s; empty without `call_s`."""

    def __post_init__(self) -> None:
        times, anchors = self.generation_s, self.anchor_after_s
        if not 1 <= len(times) <= MAX_SAMPLES:
            raise LatencyError(f"latency: expected 1 to {MAX_SAMPLES} generation times, found {len(times)}")
        if not all(math.isfinite(time_s) and 0 <= time_s <= MAX_DELAY_S for time_s in times):
            raise LatencyError(f"latency: expected generation times of 0 to {MAX_DELAY_S:g} s, found one outside")
        if anchors and len(anchors) != len(times):
            raise LatencyError(f"latency: expected as many anchor_after_s as generation_s, found {len(anchors)}")
        if not all(0 <= anchor_s <= time_s for anchor_s, time_s in zip(anchors, times, strict=False)):
            raise LatencyError("latency: expected every anchor_after_s from 0 to its generation's time")
        if self.tagged not in (MEASURED, MODELLED):
            raise LatencyError(f"latency: expected tagged to be {MEASURED} or {MODELLED}, found {self.tagged!r}")
        if self.call_s or self.rest_s:
            self._check_calls()

    def _check_calls(self) -> None:
        rows, times = [rows for rows, _ in self.call_s], [time_s for _, time_s in self.call_s]
        if rows != [1] and (rows != sorted(set(rows)) or rows[:1] != [LEAST_ROWS] or rows[-1] > MOST_ROWS):
            raise LatencyError(
                f"latency: expected call_s to have calls of 1 row, or of {LEAST_ROWS} and more up to {MOST_ROWS} rows, "
                f"found {rows}"
            )
        if not all(0 < time_s <= MAX_DELAY_S for time_s in times):
            raise LatencyError(f"latency: expected call_s above 0 and up to {MAX_DELAY_S:g} s, found one outside")
        if len(self.rest_s) != len(self.generation_s):
            raise LatencyError(f"latency: expected as many rest_s as generation_s, found {len(self.rest_s)}")
        anchors = self.anchor_after_s or (0.0,) * len(self.rest_s)
        if not all(a <= rest_s <= MAX_DELAY_S for a, rest_s in zip(anchors, self.rest_s, strict=True)):
            raise LatencyError(f"latency: expected rest_s from its anchor_after_s to {MAX_DELAY_S:g} s")

    @staticmethod
    def constant(seconds: float) -> LatencyProfile:
        """Return a profile in which every generation takes this long."""
        return LatencyProfile(f"{seconds:g} s", "setting", (float(seconds),))

    @property
    def mean_s(self) -> float:
        """Mean generation time."""
        return sum(self.generation_s) / len(self.generation_s)

    def decode_s(self, call_tokens: Sequence[int]) -> float:
        """Return the duration of decoding calls that feed so many tokens each, s; longer ones are split."""
        most, longest_s = self.call_s[-1]
        total_s = 0.0
        for tokens in call_tokens:
            whole, left = divmod(tokens, most)
            total_s += whole * longest_s + (next(s for rows, s in self.call_s if rows >= left) if left else 0.0)
        return total_s

    def scaled_to_mean(self, mean_s: float) -> LatencyProfile:
        """Return a modelled profile of the same shape with another mean; raises LatencyError."""
        if not (math.isfinite(mean_s) and mean_s > 0 and self.mean_s > 0):
            raise LatencyError(f"latency: expected means above 0 s, found {self.mean_s:g} s scaled to {mean_s:g} s")
        factor = mean_s / self.mean_s
        scaled = tuple(min(time_s * factor, MAX_DELAY_S) for time_s in self.generation_s)
        anchors = tuple(min(a * factor, t) for a, t in zip(self.anchor_after_s, scaled, strict=False))
        source = f"{self.source}; scaled by {factor:.4g} to a mean of {mean_s:g} s"
        call_s = tuple((rows, time_s * factor) for rows, time_s in self.call_s)
        rest_s = tuple(time_s * factor for time_s in self.rest_s)
        return LatencyProfile(f"{self.name}, {mean_s:g} s", source, scaled, anchors, MODELLED, call_s, rest_s)

    def as_json(self) -> dict[str, Any]:
        """What `of_json` reads."""
        content = {"schema": SCHEMA, **asdict(self), "call_s": {str(rows): time_s for rows, time_s in self.call_s}}
        # Without calls the content is that of earlier releases, whose runs can so be continued.
        return content if self.call_s else {k: v for k, v in content.items() if k not in ("call_s", "rest_s")}

    @staticmethod
    def of_json(content: object) -> LatencyProfile:
        """Read a profile file's content; raises LatencyError."""
        if not isinstance(content, Mapping) or content.get("schema") != SCHEMA:
            raise LatencyError(f"expected a table with schema = {SCHEMA}")
        if unknown := sorted(set(content) - set(_KEYS)):
            raise LatencyError(f"unknown key {unknown[0]!r}; expected {', '.join(_KEYS)}")
        texts = [content.get(key) for key in ("name", "source")]
        if not all(isinstance(text, str) and text for text in texts):
            raise LatencyError("expected name and source, both texts that are not empty")
        return LatencyProfile(
            str(texts[0]),
            str(texts[1]),
            _times(content.get("generation_s"), "generation_s"),
            _times(content.get("anchor_after_s", []), "anchor_after_s"),
            str(content.get("tagged", MODELLED)),
            _calls(content.get("call_s", {})),
            _times(content.get("rest_s", []), "rest_s"),
        )


def load_profile(path: Path) -> LatencyProfile:
    """Read a profile (.json, .toml), an edge-run result (.json) or a flight log (.mcap); raises LatencyError."""
    try:
        if path.suffix == ".mcap":
            return _of_flight_log(path)
        content: Any = (read_toml if path.suffix == ".toml" else read_json)(path, MAX_BYTES)
        if isinstance(content, Mapping) and isinstance(content.get("reasoning"), Mapping):
            return _of_run(path, content["reasoning"])
        return LatencyProfile.of_json(content)
    except OSError as error:
        raise LatencyError(f"latency profile {path}: cannot be read ({error.strerror})") from error
    except ValueError as error:  # of the parsers, and LatencyError
        raise LatencyError(f"latency profile {path}: {error}") from error


def times_of(record: Mapping[str, Any]) -> tuple[float, float]:
    """Return (generation time, time from its start to its newest frame's capture), s, of a `/semantic` record."""
    ready_ns, anchor_ns = int(record["ready_ns"]), int(record["anchor_ns"])
    # A frame captured before the start counts as captured at the start.
    total_s = max(ready_ns - int(record["started_ns"]), ready_ns - anchor_ns) / 1e9
    return total_s, total_s - (ready_ns - anchor_ns) / 1e9


def _of_flight_log(path: Path) -> LatencyProfile:
    times: list[float] = []
    anchors: list[float] = []
    try:
        for topic, _, record in read_messages(path):
            if topic == "/semantic":
                total_s, anchor_s = times_of(record)
                times.append(total_s)
                anchors.append(anchor_s)
    except RecordingError as error:
        raise LatencyError(str(error)) from error
    except (KeyError, OverflowError, TypeError, ValueError) as error:
        raise LatencyError(f"a /semantic record lacks or misshapes a field: {error!r}") from error
    if not times:
        raise LatencyError("expected generations in the flight log, found none")
    return LatencyProfile(path.name, "flight log of edge-run", tuple(times), tuple(anchors), MEASURED)


def _of_run(path: Path, reasoning: Mapping[str, Any]) -> LatencyProfile:
    """Interpolate percentiles above the median; the half below is unknown and takes the median."""

    def points_s(key: str) -> list[float]:
        values = reasoning.get(key)
        points: list[Any] = [values.get(point) for point in _POINTS] if isinstance(values, Mapping) else []
        if len(points) != 3 or not all(_is_number(point) for point in points):
            raise LatencyError(f"expected reasoning.{key} with p50, p99 and max, as an edge-run with generations has")
        return [float(point) / 1e3 for point in points]

    generation, late_anchor = points_s("generation_ms"), points_s("late_anchor_ms")
    shares = (np.arange(QUANTILE_STEPS) + 0.5) / QUANTILE_STEPS
    times = [float(value) for value in np.interp(shares, (0.5, 0.99, 1.0), generation)]
    anchors = tuple(min(late_anchor[0], time_s) for time_s in times)
    return LatencyProfile(path.name, "percentiles of an edge-run", tuple(times), anchors, MEASURED)


def _times(value: object, key: str) -> tuple[float, ...]:
    if not isinstance(value, Sequence) or isinstance(value, str) or not all(_is_number(item) for item in value):
        raise LatencyError(f"expected {key} to be a list of seconds")
    return tuple(float(item) for item in value)


def _calls(value: object) -> tuple[tuple[int, float], ...]:
    if not isinstance(value, Mapping) or not all(
        str(rows).isdecimal() and _is_number(time_s) for rows, time_s in value.items()
    ):
        raise LatencyError('expected call_s to have seconds by number of rows, such as {"2": 0.021, "8": 0.024}')
    return tuple(sorted((int(rows), float(time_s)) for rows, time_s in value.items()))


def _is_number(value: object) -> bool:
    # An integer of TOML has any length; `float` raises an OverflowError for a long one.
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 2**53
