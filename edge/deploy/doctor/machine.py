"""Checks of the machine from the files of Linux and Jetson; the root can be another folder."""

from __future__ import annotations

import datetime
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from edge.artifacts.target_facts import GIB, PlanFacts, TargetFacts
from edge.core.device import DeviceError, check_power_mode, l4t_release
from edge.core.sysfs import read_int
from edge.deploy import boot
from edge.deploy.doctor.check import Check, Level, skipped
from edge.flightlog.recorder import arming_free_bytes

MIB: Final = 1 << 20
SPARE_MEMORY: Final = 1.2
"""Multiple of the plan's memory below which the free memory gives a warning."""
BUSY_CORES: Final = 0.5
"""Cores in use by other programs above which there is a warning."""
STEADY_GOVERNORS: Final = ("performance",)
_COARSE_CLOCKS: Final = ("jiffies", "acpi_pm", "hpet", "refined-jiffies")
_GPU_NAMES: Final = ("ga10b", "gpu")
MODULES: Final[Mapping[str, tuple[str, int]]] = {
    "nvidia,p3701-0000": ("AGX Orin 32 GB, developer kit", 32),
    "nvidia,p3701-0004": ("AGX Orin 32 GB", 32),
    "nvidia,p3701-0005": ("AGX Orin 64 GB", 64),
    "nvidia,p3767-0000": ("Orin NX 16 GB", 16),
    "nvidia,p3767-0001": ("Orin NX 8 GB", 8),
    "nvidia,p3767-0003": ("Orin Nano 8 GB", 8),
    "nvidia,p3767-0004": ("Orin Nano 4 GB", 4),
    "nvidia,p3767-0005": ("Orin Nano 8 GB, developer kit", 8),
}
"""Jetson modules and their GiB, by the names that NVIDIA's device trees and flash configurations use."""
MEMORY_SHARE: Final = 0.85
"""Share of the data sheet's memory that firmware and kernel leave: of 16 GiB an Orin NX shows about 15.3."""

Query = Callable[[], str | None]
"""Runs `nvpmodel -q` and returns its output; None if the program is missing or fails."""


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip("\0\n ")
    except OSError:
        return ""


def power_mode(wanted: str, root: Path, query: Query) -> Check:
    """Check the board's power mode by name and by its online cores: `nvpmodel -q` may name a mode before its reboot."""
    name = "power mode"
    conf = _text(root / "etc/nvpmodel.conf")
    if not conf:
        return skipped(name, "no /etc/nvpmodel.conf, so this is no Jetson")
    answer = query()
    if answer is None:
        return Check(name, Level.FAIL, "nvpmodel -q does not answer", wanted, "run it by hand: nvpmodel -q")
    try:
        check_power_mode(wanted, conf=conf, query=answer)
    except DeviceError as error:
        problem, _, advice = str(error).partition(": ")
        return Check(name, Level.FAIL, problem, wanted, advice)
    required, online = mode_cores(conf, wanted), core_numbers(_text(root / "sys/devices/system/cpu/online"))
    if required and online and required != online:
        found = f"nvpmodel reports {wanted}, but cores {_listed(online)} are online"
        return Check(name, Level.FAIL, found, f"cores {_listed(required)}", "reboot: a mode applies at start-up only")
    return Check(name, Level.OK, wanted, wanted)


def boot_power_mode(wanted: str, root: Path) -> Check:
    """Check the power mode in which the board will start the next time."""
    name, found = "power mode at start-up", boot.stored_mode(root)
    if found is None:
        return skipped(name, "no stored mode of nvpmodel, so this is no Jetson")
    if found == wanted:
        return Check(name, Level.OK, found, wanted)
    return Check(name, Level.WARN, found, wanted, f"sudo edge-install boot --power-mode {wanted}")


def hardware_watchdog(root: Path) -> Check:
    """Check that a kernel that hangs is reset: systemd feeds the processor's watchdog."""
    name, wanted = "hardware watchdog", "active: a kernel that hangs is reset"
    state = _text(root / "sys/class/watchdog/watchdog0/state")
    if state == "active":
        return Check(name, Level.OK, f"active, {_text(root / 'sys/class/watchdog/watchdog0/timeout')} s", wanted)
    if not state and not (root / "dev/watchdog0").exists():
        return Check(
            name, Level.WARN, "none, or its driver is not loaded", wanted, "load the driver of the board's watchdog"
        )
    return Check(name, Level.WARN, "not active", wanted, "sudo edge-install boot --watchdog 30, then restart")


def mode_cores(conf: str, mode: str) -> set[int]:
    """Return the online cores of a mode in an nvpmodel configuration; empty if it names none."""
    block = re.search(rf"<\s*POWER_MODEL\s+ID=\d+\s+NAME={re.escape(mode)}\s*>([^<]*)", conf)
    entries = re.findall(r"^\s*CPU_ONLINE\s+CORE_(\d+)\s+([01])\s*$", block[1] if block else "", re.MULTILINE)
    return {int(core) for core, on in entries if on == "1"}


def core_numbers(text: str) -> set[int]:
    """Parse a list such as `0-3,6`; empty for any other text."""
    cores: set[int] = set()
    for part in text.split(","):
        found = re.fullmatch(r"(\d{1,4})(?:-(\d{1,4}))?", part.strip())
        if found is None:
            return set()
        cores.update(range(int(found[1]), int(found[2] or found[1]) + 1))
    return cores


def _listed(cores: set[int]) -> str:
    return ", ".join(str(core) for core in sorted(cores))


def cpu_governor(root: Path) -> Check:
    """Check the processor's frequency governor: one that follows the load slows the first milliseconds of a tick."""
    name = "CPU governor"
    files = sorted((root / "sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor"))
    found = sorted({_text(path) for path in files} - {""})
    if not found:
        return skipped(name, "this machine shows no cpufreq")
    if all(governor in STEADY_GOVERNORS for governor in found):
        return Check(name, Level.OK, ", ".join(found), "performance")
    advice = "echo performance | sudo tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor"
    return Check(name, Level.WARN, ", ".join(found), "performance", advice)


def clocks(root: Path) -> Check:
    """Check that processor and graphics clocks reach the silicon's maximum and do not fall when idle."""
    name = "clocks"
    parts: list[str] = []
    capped = falling = False
    policies = sorted((root / "sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq"))
    most = [(read_int(path / "scaling_max_freq"), read_int(path / "cpuinfo_max_freq")) for path in policies]
    known = [(now, can) for now, can in most if now is not None and can is not None]
    if known:
        now, can = min(now for now, _ in known), max(can for _, can in known)
        capped = now < can
        parts.append(f"CPU at most {now / 1000:.0f} of {can / 1000:.0f} MHz")
    for path in sorted((root / "sys/class/devfreq").glob("*")):
        label = _text(path / "device/of_node/name") or path.name.partition(".")[2]
        low, high, cur = (read_int(path / f"{key}_freq") for key in ("min", "max", "cur"))
        if label not in _GPU_NAMES or low is None or high is None:
            continue
        falling = low < high
        steps = [int(step) for step in _text(path / "available_frequencies").split() if step.isdigit()]
        limit = f" of {max(steps) / 1e6:.0f}" if steps else ""
        parts.append(f"GPU {(cur or 0) / 1e6:.0f} MHz, {low / 1e6:.0f} to {high / 1e6:.0f}{limit}")
    if not parts:
        return skipped(name, "this machine shows neither cpufreq nor devfreq")
    if falling:
        advice = "sudo jetson_clocks, else the first tick after a pause runs at the lowest clock"
        return Check(name, Level.WARN, "; ".join(parts), "a GPU clock that does not fall", advice)
    # A power mode is such a limit: another check covers its name, so only show the figures.
    return Check(name, Level.OK, "; ".join(parts), "no cap" if not capped else "the power mode's cap")


def match(facts: TargetFacts, providers: Sequence[str], machine: str, available: Sequence[str], root: Path) -> Check:
    """Compare processor, execution providers and Jetson Linux with the artifacts' target."""
    name = "target"
    release = l4t_release(_text(root / "etc/nv_tegra_release"))
    found = f"{machine}, {f'L4T {release}' if release else 'no Jetson Linux'}"
    expected = f"{facts.name}: {' or '.join(facts.architectures)}"
    if machine not in facts.architectures:
        return Check(name, Level.FAIL, found, expected, f"export for this machine instead of {facts.name}")
    if facts.min_l4t is not None:
        expected += f", L4T {facts.min_l4t} or later"
        if release is None or _version(release) < _version(facts.min_l4t):
            return Check(name, Level.FAIL, found, expected, "install the JetPack that brings it")
    size = _size(facts, root)
    found, expected = ", ".join((found, *size.found)), f"{expected}, {size.expected}"
    if size.less:
        return Check(name, Level.FAIL, found, expected, f"export for this machine instead of {facts.name}")
    lacking = [provider for provider in providers if provider not in available]
    if lacking:
        advice = "install the ONNX Runtime package that brings it, or export for another target"
        return Check(name, Level.FAIL, f"ONNX Runtime has {', '.join(available)}", ", ".join(providers), advice)
    if size.other:
        advice = f"the plan was made for {facts.name}: export for this module, with its own figures"
        return Check(name, Level.WARN, found, expected, advice)
    return Check(name, Level.OK, found, expected)


@dataclass(frozen=True)
class _Size:
    """Cores and memory of the machine and of the target."""

    found: tuple[str, ...]
    expected: str
    less: bool
    other: bool
    """Whether this is another Jetson module with more cores or memory."""


def _size(facts: TargetFacts, root: Path) -> _Size:
    """Read both sizes. Unreadable values and a card's own memory are not compared."""
    # Cores of the silicon: another check covers those that a power mode switches off.
    cores = len(core_numbers(_text(root / "sys/devices/system/cpu/present")))
    total = re.search(r"^MemTotal:\s+(\d+) kB$", _text(root / "proc/meminfo"), re.MULTILINE)
    compatible = _text(root / "proc/device-tree/compatible").split("\0")
    module = next((MODULES[known] for known in compatible if known in MODULES), None)
    found = ((module[0],) if module else ()) + ((f"{cores} cores",) if cores else ())
    memory_bytes = 0 if total is None else int(total[1]) * 1024
    expected = f"{facts.cores} cores"
    less, other = 0 < cores < facts.cores, module is not None and cores > facts.cores
    if not facts.own_memory:
        expected += f", {facts.memory_bytes / GIB:g} GiB"
        found += (f"{memory_bytes / GIB:.1f} GiB",) if memory_bytes else ()
        less = less or 0 < memory_bytes < MEMORY_SHARE * facts.memory_bytes
        other = other or (module is not None and module[1] * GIB != facts.memory_bytes)
    return _Size(found, expected, less, other)


def _version(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", text))


def memory(plan: PlanFacts | None, root: Path, *, own_memory: bool = False) -> Check:
    """Check the free memory against the plan; `own_memory`: the plan's memory is a graphics card's own."""
    name = "memory"
    if plan is None:
        return skipped(name, "the artifacts have no plan")
    found = re.search(r"^MemAvailable:\s+(\d+) kB$", _text(root / "proc/meminfo"), re.MULTILINE)
    if found is None:
        return skipped(name, "/proc/meminfo has no MemAvailable")
    free, need = int(found[1]) * 1024, plan.memory_bytes
    if own_memory:
        return skipped(
            name,
            f"the plan's {need / GIB:.2f} GiB are the graphics card's own; {free / GIB:.2f} GiB are free beside it",
        )
    text, expected = f"{free / GIB:.2f} GiB available", f"{need / GIB:.2f} GiB by the plan"
    advice = "end other programs (see busy programs), or export with a smaller precision"
    if free < need:
        return Check(name, Level.FAIL, text, expected, advice)
    if free < SPARE_MEMORY * need:
        return Check(name, Level.WARN, text, f"{expected}, and a fifth to spare", advice)
    return Check(name, Level.OK, text, expected)


def disk(folder: Path, usage: Callable[[Path], tuple[int, int]]) -> Check:
    """Check the free space for flight logs; `usage` returns free and total bytes and raises OSError."""
    name = "disk"
    try:
        free, total = usage(folder)
    except OSError as error:
        return Check(name, Level.FAIL, f"{folder}: {error.strerror}", "a readable folder", "name it with --logs DIR")
    need = arming_free_bytes(total)
    found = f"{folder}: {free / MIB:.0f} MiB free of {total / MIB:.0f}"
    expected = f"{need / MIB:.0f} MiB or more"
    if free < need:
        return Check(name, Level.FAIL, found, expected, "delete old flight logs; a run is refused until then")
    return Check(name, Level.OK, found, expected)


def wall_clock(now: datetime.datetime, not_before: datetime.datetime, root: Path) -> Check:
    """Check the clocks: a wrong wall clock warns, since it dates logs only; control needs a fine monotonic clock."""
    name = "clock"
    source = _text(root / "sys/devices/system/clocksource/clocksource0/current_clocksource") or "unknown source"
    found = f"{now:%Y-%m-%d %H:%M} UTC, monotonic from {source}"
    if source in _COARSE_CLOCKS:
        advice = "find in the kernel log why the processor's own counter is not used"
        return Check(name, Level.WARN, found, "a monotonic clock of the processor", advice)
    if now < not_before:
        advice = "set it (timedatectl); flight logs would carry a wrong date, control is not affected"
        return Check(name, Level.WARN, found, f"not before the artifacts, {not_before:%Y-%m-%d %H:%M} UTC", advice)
    return Check(name, Level.OK, found)


def processor_ticks(proc: Path) -> dict[int, tuple[str, int]]:
    """Return name and processor time (clock ticks) of every process below a proc folder."""
    times: dict[int, tuple[str, int]] = {}
    for path in proc.glob("[0-9]*/stat"):
        # The name is in brackets and may itself contain brackets and spaces: fields count from the last one.
        head, _, tail = _text(path).rpartition(")")
        fields = tail.split()
        if len(fields) > 13 and fields[11].isdigit() and fields[12].isdigit():
            times[int(path.parent.name)] = (head.partition("(")[2], int(fields[11]) + int(fields[12]))
    return times


def busy_programs(
    before: Mapping[int, tuple[str, int]], after: Mapping[int, tuple[str, int]], elapsed_ticks: float, own: int
) -> Check:
    """Check other programs' processor use, from two readings of `processor_ticks`."""
    name = "busy programs"
    if elapsed_ticks <= 0:
        return skipped(name, "no time passed between two readings")
    cores = {
        (program, pid): (ticks - before[pid][1]) / elapsed_ticks
        for pid, (program, ticks) in after.items()
        if pid != own and pid in before and before[pid][0] == program
    }
    total = sum(cores.values())
    most = sorted(cores, key=lambda key: -cores[key])[:3]
    named = ", ".join(f"{key[0]} (pid {key[1]}) {cores[key]:.2f}" for key in most if cores[key] >= 0.05)
    found = f"{total:.2f} cores used by others" + (f": {named}" if named else "")
    if total > BUSY_CORES:
        return Check(
            name, Level.WARN, found, f"at most {BUSY_CORES:g} cores", "end them, or keep them off with taskset"
        )
    return Check(name, Level.OK, found, f"at most {BUSY_CORES:g} cores")
