"""Power monitors of a Jetson module: Texas Instruments INA3221, three rails a chip, through the kernel's hwmon files.

The kernel gives bus voltage `inN_input` in mV and current `currN_input` in mA (Documentation/hwmon/ina3221.rst); it has
no power file. `in7` and `curr4` are sums over the shunts, not a rail. Rails are found by label: chips and hwmon indices
differ between boards and releases.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from edge.core.sysfs import SYSFS, hwmon_named, read_int, read_text
from edge.power.meters.meter import MeterError, PowerSample

CHIPS: Final = "bus/i2c/drivers/ina3221/*/hwmon/hwmon*"
CHANNELS: Final = (1, 2, 3)
WHOLE_MODULE: Final = ("VDD_IN", "POM_5V_IN")
"""Rails that feed all others: Orin NX and Nano, Xavier NX; and the first Nano."""
FED_BY: Final = {"VDDQ_VDD2_1V8AO": "VIN_SYS_5V0"}
"""AGX Orin: NVIDIA's developer guide (r36.4.3, software-based power monitoring) has the one included in the other."""
_NOT_CONNECTED = re.compile(r"(^|[^A-Z])NC([^A-Z]|$)")
_MV_MA_PER_W = 1e6


@dataclass(frozen=True)
class Rail:
    """One channel of a chip."""

    label: str
    voltage: Path
    current: Path

    def read_w(self) -> float | None:
        """Power in W, None if the chip does not answer."""
        millivolt, milliampere = read_int(self.voltage), read_int(self.current)
        return None if millivolt is None or milliampere is None else millivolt * milliampere / _MV_MA_PER_W


class Ina3221Meter:
    """All labelled rails; the total is the rail that feeds the module, or without one a sum with a caveat."""

    def __init__(self, rails: tuple[Rail, ...], rail: str | None = None) -> None:
        """`rail` names the total's rail; one that the board lacks is replaced as above. Raises MeterError."""
        if not rails:
            raise MeterError("INA3221: no labelled rail")
        labels = [each.label for each in rails]
        whole = next((name for name in (rail, *WHOLE_MODULE) if name in labels), None)
        if whole is not None:
            self._total: tuple[str, ...] = (whole,)
            self.source = f"ina3221 {whole}"
            self.caveat: str | None = f"{whole} is the module's input: the carrier board draws more than that"
        else:
            self._total = tuple(label for label in labels if FED_BY.get(label) not in labels)
            self.source = f"ina3221 sum of {', '.join(self._total)}"
            self.caveat = (
                f"this board has no {rail or WHOLE_MODULE[0]}: the sum of {len(self._total)} rails is less than it "
                f"draws"
            )
        self._rails = rails

    @classmethod
    def open(cls, sysfs_root: Path = SYSFS, rail: str | None = None) -> Ina3221Meter:
        """The board's meter; raises MeterError that names what was looked for."""
        chips = sorted(sysfs_root.glob(CHIPS)) or hwmon_named(sysfs_root, "ina3221")
        rails = find_rails(chips)
        if not rails:
            found = f"{len(chips)} chips without a labelled rail" if chips else "none"
            raise MeterError(
                f"ina3221: looked for {sysfs_root / CHIPS}/in1_label, found {found}; is this a Jetson whose device "
                f"tree enables the power monitor?"
            )
        meter = cls(rails, rail)
        meter.read(0)
        return meter

    def read(self, now_ns: int) -> PowerSample:
        """One sample of every rail; raises MeterError if one of the total's does not answer."""
        rails: dict[str, float] = {}
        for each in self._rails:
            power_w = each.read_w()
            if power_w is not None:
                rails[each.label] = power_w
            elif each.label in self._total:
                raise MeterError(f"{each.voltage.parent}: {each.label} cannot be read (its volts or its amperes)")
        # A current that flows back by a bit of the converter is noise around nothing.
        total_w = max(0.0, sum(rails[label] for label in self._total))
        return PowerSample(now_ns, total_w, rails, source=self.source)


def find_rails(chips: list[Path]) -> tuple[Rail, ...]:
    """Connected and enabled channels by label; a label that two chips use gets the second one's address."""
    rails: dict[str, Rail] = {}
    for chip in chips:
        for number in CHANNELS:
            label = read_text(chip / f"in{number}_label")
            off = read_int(chip / f"in{number}_enable") == 0
            if label is None or off or _NOT_CONNECTED.search(label.upper()):
                continue
            name = label if label not in rails else f"{label}@{chip.parent.parent.name}"
            rails[name] = Rail(name, chip / f"in{number}_input", chip / f"curr{number}_input")
    return tuple(rails.values())
