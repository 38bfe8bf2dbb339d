"""A recorded series of samples played again."""

from __future__ import annotations

import bisect
import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from edge.power.meters.meter import MODELLED, MeterError, PowerSample


class ReplayMeter:
    """The sample that was in force as long after the first as now is after the first reading.

    What was measured then is not a measurement of now: its samples are tagged modelled.
    """

    caveat: str | None = "a recording, not this device now"

    def __init__(self, samples: Sequence[PowerSample], name: str = "recording") -> None:
        """Raises MeterError unless there is a sample and stamps grow."""
        stamps = [sample.stamp_ns for sample in samples]
        if not samples or any(b <= a for a, b in itertools.pairwise(stamps)):
            raise MeterError(f"replay: {name}: expected samples with growing stamps, found {len(samples)}")
        self._samples, self._stamps = samples, stamps
        self._begin_ns: int | None = None
        self.source = f"replay of {name}"

    @classmethod
    def from_records(cls, records: Iterable[Mapping[str, Any]], name: str) -> ReplayMeter:
        """From `/power` records of a flight log or dictionaries with `stamp_ns` and `total_w`; raises MeterError."""
        try:
            samples = [
                PowerSample(int(r["stamp_ns"]), float(r["total_w"]), {k: float(v) for k, v in r["rails"].items()})
                if r.get("rails")
                else PowerSample(int(r["stamp_ns"]), float(r["total_w"]))
                for r in records
                if r.get("total_w") is not None
            ]
        except (KeyError, TypeError, ValueError) as error:
            raise MeterError(f"replay: {name}: expected records with stamp_ns and total_w ({error!r})") from error
        return cls(samples, name)

    def read(self, now_ns: int) -> PowerSample:
        """The recorded sample; raises MeterError after the last."""
        if self._begin_ns is None:
            self._begin_ns = now_ns
        then_ns = self._stamps[0] + now_ns - self._begin_ns
        if then_ns > self._stamps[-1]:
            raise MeterError(f"{self.source}: it ended after {(self._stamps[-1] - self._stamps[0]) / 1e9:.1f} s")
        recorded = self._samples[bisect.bisect_right(self._stamps, then_ns) - 1]
        return PowerSample(now_ns, recorded.total_w, recorded.rails, MODELLED, self.source)
