"""Power of an NVIDIA graphics card through NVML; needs the package `nvidia-ml-py`, which brings the module `pynvml`."""

from __future__ import annotations

import importlib
from typing import Any

from edge.power.meters.meter import MeterError, PowerSample

_MILLIWATT_PER_W = 1e3


class NvmlMeter:
    """Board power of one card: without the machine around it."""

    caveat: str | None = "graphics card only: no processor, board or screen"

    def __init__(self, module: Any, index: int = 0) -> None:
        """`module` has pynvml's functions. Raises MeterError."""
        self._nvml = module
        try:
            module.nvmlInit()
            self._handle = module.nvmlDeviceGetHandleByIndex(index)
            name = module.nvmlDeviceGetName(self._handle)
        except module.NVMLError as error:
            raise MeterError(f"nvml: no graphics card {index} ({error}); is NVIDIA's driver loaded?") from error
        self.source = f"nvml {name.decode() if isinstance(name, bytes) else name}"

    @classmethod
    def open(cls, module: Any = None, index: int = 0) -> NvmlMeter:
        """The card's meter; raises MeterError that names what is missing."""
        if module is None:
            try:
                module = importlib.import_module("pynvml")
            except ImportError as error:
                raise MeterError(
                    "nvml: looked for the module pynvml, not installed: pip install nvidia-ml-py"
                ) from error
        meter = cls(module, index)
        meter.read(0)
        return meter

    def read(self, now_ns: int) -> PowerSample:
        """Power as the driver last averaged it; raises MeterError."""
        try:
            power_w = self._nvml.nvmlDeviceGetPowerUsage(self._handle) / _MILLIWATT_PER_W
        except self._nvml.NVMLError as error:
            raise MeterError(f"{self.source}: gives no power ({error}); on a Jetson the meter is ina3221") from error
        return PowerSample(now_ns, power_w, {"gpu": power_w}, source=self.source)
