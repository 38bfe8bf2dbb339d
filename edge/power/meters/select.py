"""Selects a device's meter by its target's name for it, or by search."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from edge.core.sysfs import SYSFS
from edge.power.meters.ina3221 import Ina3221Meter
from edge.power.meters.meter import MeterError, ModelledMeter, PowerMeter
from edge.power.meters.nvml import NvmlMeter
from edge.power.meters.rapl import RaplMeter

AUTO: Final = ("ina3221", "nvml", "rapl")
METERS: Final = ("auto", *AUTO, "modelled", "none")


def open_meter(
    kind: str,
    *,
    sysfs_root: Path = SYSFS,
    rail: str | None = None,
    idle_w: float | None = None,
    energy_j: Callable[[], float] | None = None,
    nvml: Any = None,
    now_ns: int | None = None,
) -> PowerMeter:
    """Open the meter of that kind; `auto` opens the first that this device has.

    `rail` is the INA3221's total; `idle_w` and `energy_j` are the model's (for `modelled`, and the last resort of
    `auto`); `nvml` replaces the module pynvml. Raises MeterError that names the missing files.
    """
    if kind == "ina3221":
        return Ina3221Meter.open(sysfs_root, rail)
    if kind == "nvml":
        return NvmlMeter.open(nvml)
    if kind == "rapl":
        return RaplMeter.open(sysfs_root, time.monotonic_ns() if now_ns is None else now_ns)
    if kind == "none":
        raise MeterError(f"this target names no power meter: expected one of auto, {', '.join(AUTO)}")
    if kind not in METERS:
        raise MeterError(f"meter {kind!r} is not known; expected one of: {', '.join(METERS)}")
    refused: list[str] = []
    for name in AUTO if kind == "auto" else ():
        try:
            return open_meter(name, sysfs_root=sysfs_root, rail=rail, nvml=nvml, now_ns=now_ns)
        except MeterError as error:
            refused.append(str(error))
    if idle_w is not None and energy_j is not None:
        return ModelledMeter(idle_w, energy_j)
    if kind == "auto":
        raise MeterError(f"no power meter on this device: {'; '.join(refused)}")
    raise MeterError("modelled: the plan has no energies, its target lacks power.idle_w or busy_w")
