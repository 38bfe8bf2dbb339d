"""Power by the plan's figures instead of a meter."""

from __future__ import annotations

from collections.abc import Callable

from edge.power.meters.meter import MODELLED, MeterError, PowerSample


class ModelledMeter:
    """Idle power and the energy of what has run since the last reading."""

    source = "the plan's model"
    caveat: str | None = "not a measurement"

    def __init__(self, idle_w: float, energy_j: Callable[[], float]) -> None:
        """`energy_j()` is the modelled energy above idle of everything that has run so far."""
        self._idle_w = idle_w
        self._energy_j = energy_j
        self._last: tuple[int, float] | None = None
        self._power_w = idle_w

    def read(self, now_ns: int) -> PowerSample:
        """Mean power since the previous reading; raises MeterError when the model gives no power."""
        energy_j = self._energy_j()
        if self._last is not None and now_ns > self._last[0]:
            self._power_w = self._idle_w + (energy_j - self._last[1]) * 1e9 / (now_ns - self._last[0])
        self._last = (now_ns, energy_j)
        try:
            return PowerSample(now_ns, self._power_w, {}, MODELLED, self.source)
        except ValueError as error:
            raise MeterError(f"modelled: {error}") from error
