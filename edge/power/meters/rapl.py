"""Intel's and AMD's energy counters (RAPL) through the kernel's powercap files.

Only whole packages count: core, uncore and DRAM domains are parts of them, `psys` contains them, and `intel-rapl-mmio`
is the same package read another way. Counters are in µJ and start again at `max_energy_range_uj`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from edge.core.sysfs import read_int, read_text
from edge.power.meters.meter import MeterError, PowerSample

ZONES: Final = "class/powercap/intel-rapl:*"
_TOP_ZONE = re.compile(r"intel-rapl:\d+")
SHORTEST_NS: Final = 10_000_000
"""Counters advance about every millisecond: over less than ten of them the quotient is noise."""


@dataclass(frozen=True)
class Domain:
    """One counter."""

    name: str
    energy: Path
    range_uj: int

    def read_uj(self) -> int:
        """Energy since the counter last started; raises MeterError with the way to make it readable."""
        try:
            return int(self.energy.read_text(encoding="ascii"))
        except PermissionError as error:
            raise MeterError(
                f"rapl: {self.energy} is readable by root only (a side channel, CVE-2020-8694); "
                f"for this boot: sudo chmod a+r {self.energy}"
            ) from error
        except (OSError, ValueError) as error:
            raise MeterError(f"rapl: {self.energy} cannot be read ({error})") from error


class RaplMeter:
    """Average power of the processor packages since the previous reading."""

    caveat: str | None = "processor packages only: no board, disk, screen or graphics card"

    def __init__(self, packages: tuple[Domain, ...], others: tuple[Domain, ...], now_ns: int) -> None:
        """`packages` make the total, `others` are only shown. Raises MeterError if a package cannot be read."""
        self._packages = packages
        self._domains = (*packages, *others)
        self._last_ns = now_ns
        self._last_uj = {domain.name: domain.read_uj() for domain in self._domains}
        self._sample: PowerSample | None = None
        self.source = f"rapl {', '.join(domain.name for domain in packages)}"

    @classmethod
    def open(cls, sysfs_root: Path, now_ns: int) -> RaplMeter:
        """The machine's meter; raises MeterError that names what was looked for or how to get leave to read it."""
        packages: list[Domain] = []
        others: list[Domain] = []
        for zone in sorted(sysfs_root.glob(ZONES)):
            name, range_uj = read_text(zone / "name"), read_int(zone / "max_energy_range_uj")
            if name is None or range_uj is None or range_uj <= 0 or not _TOP_ZONE.fullmatch(zone.name):
                continue
            (packages if name.startswith("package") else others).append(Domain(name, zone / "energy_uj", range_uj))
        if not packages:
            raise MeterError(
                f"rapl: looked for {sysfs_root / ZONES}/name of a package, found none; a virtual machine has no "
                f"energy counters, a real one needs the kernel module intel_rapl_msr"
            )
        return cls(tuple(packages), tuple(others), now_ns)

    def read(self, now_ns: int) -> PowerSample:
        """Mean power since the previous reading; readings too close together give the previous sample again."""
        elapsed_ns = now_ns - self._last_ns
        if elapsed_ns < SHORTEST_NS:
            if self._sample is None:
                raise MeterError("rapl: the first reading needs 10 ms between two counts")
            return self._sample
        counts = {domain.name: domain.read_uj() for domain in self._domains}
        rails = {
            domain.name: ((counts[domain.name] - self._last_uj[domain.name]) % domain.range_uj) * 1e3 / elapsed_ns
            for domain in self._domains
        }
        self._last_ns, self._last_uj = now_ns, counts
        total_w = sum(rails[domain.name] for domain in self._packages)
        self._sample = PowerSample(now_ns, total_w, rails, source=self.source)
        return self._sample
