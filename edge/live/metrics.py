"""Metrics of a run in the OpenMetrics text format; docs/watch.md has the table of names.

Histograms count the records that reached the view: a tick that was replaced by a newer one is not in them. A gauge is
NaN where the newest record has no value: its last value would look measured.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from prometheus_client.openmetrics.exposition import CONTENT_TYPE_LATEST, generate_latest

CONTENT_TYPE: Final = CONTENT_TYPE_LATEST
_TICK_S: Final = (0.005, 0.01, 0.015, 0.02, 0.03, 0.05, 0.1, 0.2)
_GENERATION_S: Final = (0.1, 0.2, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0)


class Metrics:
    """Metrics of one run; `take` every record, `text` when asked."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()

        def gauge(name: str, text: str, *labels: str, begin: float = math.nan) -> Gauge:
            made = Gauge(f"tic_vla_{name}", text, labels, registry=self._registry)
            if not labels:
                made.set(begin)
            return made

        self._tick = Histogram(
            "tic_vla_tick_seconds",
            "From a tick's deadline to its command.",
            buckets=_TICK_S,
            registry=self._registry,
        )
        self._generation = Histogram(
            "tic_vla_generation_seconds",
            "From a generation's start to its end.",
            buckets=_GENERATION_S,
            registry=self._registry,
        )
        self._tokens = Counter("tic_vla_generated_tokens", "Tokens of the reasoning text.", registry=self._registry)
        self._faults = Counter("tic_vla_faults", "Faults raised.", ("name", "action"), registry=self._registry)
        lost = "Records that the view did not receive or could not read."
        self._dropped = gauge("view_dropped_records", lost, begin=0)
        self._unsaved = gauge("log_dropped_records", "Records that may be missing in the flight log.", begin=0)
        self._ticks = gauge("ticks", "Number of ticks of the control thread.", begin=0)
        self._missed = gauge("missed_ticks", "Number of ticks left out because an earlier one was late.", begin=0)
        self._delay = gauge("delay_seconds", "Delay from the anchor's frame to now.")
        self._frame_age = gauge("frame_age_seconds", "Age of the frame that the policy saw.")
        self._speed = gauge("speed_mps", "Forward speed.", "kind")
        self._yaw = gauge("yaw_rate_radps", "Yaw rate, left positive.", "kind")
        self._active = gauge("faults_active", "Number of faults present.", begin=0)
        self._power = gauge("power_watts", "Power now.", "tagged")
        self._budget = gauge("power_budget_watts", "Power budget of the target.")
        self._temperature = gauge("temperature_celsius", "Hottest sensor of the board.")
        self._battery = gauge("battery_percent", "Charge of the robot's battery.")

    def take(self, topic: str, record: Mapping[str, Any]) -> None:
        """Take one record; one without a needed value changes nothing."""
        try:
            if topic == "/tick":
                self._take_tick(record)
            elif topic == "/semantic":
                self._generation.observe((record["finished_ns"] - record["started_ns"]) / 1e9)
                self._tokens.inc(max(0, record["new_tokens"]))
            elif topic == "/fault" and record["change"] == "raised":
                self._faults.labels(record["name"], record["action"]).inc()
            elif topic == "/power":
                self._power.clear()  # without a meter the tag is another: the earlier tag's power is not now's
                _set(self._power.labels(str(record["tagged"])), record["total_w"])
                _set(self._budget, record["budget_w"])
                _set(self._temperature, record["temperature_c"])
            elif topic == "/velocity":
                for kind in ("commanded", "measured"):
                    _set(self._speed.labels(kind), record[f"{kind}_vx_mps"])
                    _set(self._yaw.labels(kind), record[f"{kind}_wz_radps"])
            elif topic == "/battery":
                _set(self._battery, record["soc_percent"])
            elif topic == "/recorder":
                self._unsaved.set(record["dropped"])
        except (KeyError, TypeError, ValueError, IndexError):
            return

    def _take_tick(self, record: Mapping[str, Any]) -> None:
        self._tick.observe((record["late_ms"] + record["duration_ms"]) / 1e3)
        self._ticks.set(record["tick"] + 1)
        self._missed.set(record.get("missed", math.nan))
        self._active.set(len(record.get("active", ())))
        _set(self._delay, record["delay_s"])
        age_ms = record["frame_age_ms"]
        _set(self._frame_age, None if age_ms is None else age_ms / 1e3)
        for kind, values in (("commanded", record["command"]), ("measured", record["state"])):
            vx_mps, _, wz_radps = (None, None, None) if values is None else values
            _set(self._speed.labels(kind), vx_mps)
            _set(self._yaw.labels(kind), wz_radps)

    def text(self, dropped: int) -> bytes:
        """Return the metrics as text; `dropped`: records that the view did not receive or could not read."""
        self._dropped.set(dropped)
        return bytes(generate_latest(self._registry))  # type: ignore[no-untyped-call]


def _set(gauge: Gauge, value: float | None) -> None:
    gauge.set(math.nan if value is None else value)
