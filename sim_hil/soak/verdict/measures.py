"""Measures of a soak, computed from the analyses and samples of its legs; a budget limits them by name. Pure."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from edge.core.stats import percentiles
from sim_hil.soak.verdict.budget import Measure
from sim_hil.soak.verdict.slopes import SHORTEST_S, WARM_UP_S, slope

PROCESSES: Final = ("edge-run", "edge-bridge", "edge-hil")
BRIDGE_PERIOD_MS: Final = 20.0  # rate_hz = 50 in the simulated robot's file
MOVED_M: Final = 0.1
"""Least motion during a fault, m, for it to count among the faults that the runner must detect."""
MIB: Final = 2.0**20

Analysis = Mapping[str, Any]
Samples = Sequence[Mapping[str, Any]]


def slopes(samples: Sequence[Samples], name: str, key: str, unit: float) -> list[tuple[float, float, float, float]]:
    """Return (slope per hour, low, high, seconds) of each sufficiently long life of a process.

    `samples`: one list per leg.
    """
    found = []
    for leg in samples:
        lives: dict[int, list[tuple[float, float]]] = {}
        for sample in leg:
            row = sample["processes"].get(name)
            if row is not None:
                lives.setdefault(row["pid"], []).append((sample["elapsed_s"], row[key] / unit))
        for life in lives.values():
            one = slope([t - life[0][0] for t, _ in life], [value for _, value in life])
            if one is not None:
                found.append((one.per_h, one.low, one.high, one.seconds))
    return found


def measures(legs: Sequence[Analysis], samples: Sequence[Samples]) -> dict[str, Measure]:
    """Return every measure by name."""
    found: dict[str, Measure] = {}
    for name in PROCESSES:
        found[f"memory_slope_mib_per_h.{name}"] = _slope(samples, name, "rss_bytes", MIB, "MiB/h")
        found[f"descriptor_slope_per_h.{name}"] = _slope(samples, name, "fds", 1.0, "per h")
        found[f"memory_mib.{name}.max"] = _most(samples, name, "rss_bytes", MIB, "MiB")
        found[f"cpu_percent.{name}.mean"] = _mean(samples, name, "cpu_percent", "% of a core")
    lives = [life for leg in legs for life in leg["lives"]]
    _points(found, "tick_ms", [v for life in lives for v in life["tick_ms"]], "ms", "p50", "p99", "p999", "max")
    _points(found, "delay_s", [v for life in lives for v in life["delay_s"] if v is not None], "s", "p50", "p99", "max")
    ages = [v for life in lives for v in life["frame_age_ms"] if v is not None]
    _points(found, "frame_age_ms", ages, "ms", "p50", "p99", "max")
    _points(found, "generation_ms", [v for life in lives for v in life["generation_ms"]], "ms", "p50", "p99", "max")
    jitter = [abs(gap - BRIDGE_PERIOD_MS) for leg in legs for gap in leg["command_gap_ms"]]
    _points(found, "bridge_jitter_ms", jitter, "ms", "p50", "p99", "p999", "max")
    ticks, missed = sum(life["ticks"] for life in lives), sum(life["missed"] for life in lives)
    found["missed_percent"] = Measure(100 * missed / (ticks + missed) if ticks else None, "%", ticks + missed)
    errors = [life["delay_error_ms_max"] for life in lives if life["delay_error_ms_max"] is not None]
    found["delay_error_ms.max"] = Measure(max(errors, default=None), "ms", len(errors))
    found["log_records_dropped"] = Measure(sum(life["dropped"] for life in lives), "", len(lives))
    _tasks(found, [task for leg in legs for task in leg["tasks"] if task["end"] != "cut"])
    _stops(found, legs)
    factors = [leg["real_time_factor"] for leg in legs if leg["real_time_factor"]]
    found["real_time_factor.min"] = Measure(min(factors, default=None), "", len(factors))
    _drift(found, [segment for leg in legs for segment in leg["drift"]])
    _power(found, lives)
    gaps = [leg["nearest_person"][1] for leg in legs if leg["nearest_person"] is not None]
    found["nearest_person_m.min"] = Measure(min(gaps, default=None), "m", len(gaps))
    return found


def names() -> list[str]:
    """Return the names of all measures."""
    return list(measures([], []))


def _slope(samples: Sequence[Samples], name: str, key: str, unit: float, of: str) -> Measure:
    """Return the fastest growth of all sufficiently long lives."""
    found = slopes(samples, name, key, unit)
    if not found:
        least_s = WARM_UP_S + SHORTEST_S
        return Measure(None, of, 0, note=f"no process ran for {least_s:.0f} s, including {WARM_UP_S:.0f} s of warm-up")
    per_h, low, high, _ = max(found, key=lambda one: one[1])
    return Measure(round(per_h, 3), of, len(found), round(low, 3), round(high, 3), note="the worst life")


def _values(samples: Sequence[Samples], name: str, key: str) -> list[float]:
    return [sample["processes"][name][key] for leg in samples for sample in leg if name in sample["processes"]]


def _most(samples: Sequence[Samples], name: str, key: str, unit: float, of: str) -> Measure:
    values = _values(samples, name, key)
    return Measure(round(max(values) / unit, 2) if values else None, of, len(values))


def _mean(samples: Sequence[Samples], name: str, key: str, of: str) -> Measure:
    values = _values(samples, name, key)
    return Measure(round(float(np.mean(values)), 2) if values else None, of, len(values))


def _points(found: dict[str, Measure], name: str, values: Sequence[float], unit: str, *points: str) -> None:
    for point, value in percentiles(values, *points).items():
        found[f"{name}.{point}"] = Measure(value, unit, len(values))


def _tasks(found: dict[str, Measure], tasks: Sequence[Mapping[str, Any]]) -> None:
    count = len(tasks)
    shares = {
        "success_percent": [100.0 * task["success"] for task in tasks],
        "collision_percent": [100.0 * bool(task["collisions"]) for task in tasks],
        "spl_percent": [task["spl"] for task in tasks],
    }
    for name, values in shares.items():
        found[name] = Measure(round(float(np.mean(values)), 2) if values else None, "%", count)
    found["navigation_error_m.mean"] = Measure(
        round(float(np.mean([task["ne_m"] for task in tasks])), 3) if tasks else None, "m", count
    )


def _stops(found: dict[str, Measure], legs: Sequence[Analysis]) -> None:
    ends = [end for leg in legs for end in leg["life_ends"] if end["cause"] != "leg"]
    found["stops"] = Measure(len(ends), "", len(ends))
    ran = bool(ends) or any(leg["lives"] for leg in legs)
    unexplained = sum(not end["explained"] for end in ends) if ran else None
    found["stops_unexplained"] = Measure(unexplained, "", len(ends), note="" if ran else "no runner has driven")
    # For a standing robot, an unchanged image is normal.
    faults = [
        fault
        for leg in legs
        for fault in leg["faults"]
        if fault["fault"] and fault["end_ns"] is not None and fault["moved_m"] >= MOVED_M
    ]
    found["faults_injected"] = Measure(sum(len(leg["faults"]) for leg in legs), "", len(legs))
    silent = sum(fault["raised_ns"] is None and fault["other_ns"] is None for fault in faults)
    found["faults_unanswered"] = Measure(silent if faults else None, "", len(faults), note="" if faults else "no fault")


def _drift(found: dict[str, Measure], segments: Sequence[Sequence[float]]) -> None:
    shares = [100 * error / path for error, path in segments]
    for point in ("p50", "p99", "max"):
        found[f"drift_percent.{point}"] = Measure(percentiles(shares, point)[point], "% of the path", len(shares))


def _power(found: dict[str, Measure], lives: Sequence[Mapping[str, Any]]) -> None:
    """Add mean power and energy, by the trapezoidal rule between samples of one life; gaps of 10 s are left out."""
    energy_j, seconds, tags = 0.0, 0.0, set()
    for life in lives:
        rows = life["power"]
        for (a_ns, a_w, tag), (b_ns, b_w, _) in itertools.pairwise(rows):
            dt_s = (b_ns - a_ns) / 1e9
            if dt_s < 10.0:
                energy_j += dt_s * (a_w + b_w) / 2
                seconds += dt_s
                tags.add(tag)
    tagged = " and ".join(sorted(tags)) or "measured"
    found["power_w.mean"] = Measure(round(energy_j / seconds, 3) if seconds else None, "W", len(lives), tagged=tagged)
    found["energy_wh"] = Measure(round(energy_j / 3600, 4) if seconds else None, "Wh", len(lives), tagged=tagged)
