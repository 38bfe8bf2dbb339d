"""Checks of what this user may do and read: urgency, memory, devices, the socket's folder, power and temperature."""

from __future__ import annotations

import os
import resource
import stat
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from edge.device_nodes import device_nodes
from edge.doctor_check import Check, Level, skipped
from edge.power.meter import MeterError, PowerMeter, PowerSample
from edge.power.thermal import ThermalReader
from edge.scheduling import Role, enter
from edge.units import NEED_DEVICES

FROM_UNIT = "the service gets it from its unit (edge-install units)"
_SETTLE_S = 0.2
"""Between opening a meter and reading it: one that counts energy needs some."""


def try_priority(priority: int) -> list[str]:
    """Ask for real time in a thread that then ends; lines that say what was refused."""
    lines: list[str] = []
    thread = threading.Thread(target=lambda: lines.extend(enter(Role("control", (), priority))))
    thread.start()
    thread.join()
    return lines


def real_time(priority: int, attempt: Callable[[int], list[str]] = try_priority) -> Check:
    """Whether the control thread would get the real-time priority that the target gives it."""
    name = "real-time priority"
    if priority == 0:
        return skipped(name, "the target asks for none")
    if attempt(priority):
        return Check(name, Level.WARN, "refused to this user", f"SCHED_FIFO {priority}", FROM_UNIT)
    return Check(name, Level.OK, f"SCHED_FIFO {priority} granted", f"SCHED_FIFO {priority}")


def locked_memory(limit_bytes: int, euid: int) -> Check:
    """Whether the runner may keep its pages in memory."""
    name = "locked memory"
    if limit_bytes == resource.RLIM_INFINITY or euid == 0:
        return Check(name, Level.OK, "no limit", "no limit")
    return Check(name, Level.WARN, f"at most {limit_bytes // 1024} KiB", "no limit", FROM_UNIT)


def device_access(providers: Sequence[str], root: Path, access: Callable[[Path], bool] | None = None) -> Check:
    """Whether the providers' device nodes are there and this user may open them."""
    name = "device nodes"
    if not set(providers) & set(NEED_DEVICES):
        return Check(name, Level.OK, "none needed", "those of " + ", ".join(providers))
    nodes = device_nodes(providers, root)
    if not nodes:
        return Check(name, Level.FAIL, "none", "those of " + ", ".join(providers), "install the device's driver")
    allowed = access or (lambda path: os.access(path, os.R_OK | os.W_OK))
    closed = [node for node in nodes if not allowed(root / node.path.relative_to("/"))]
    if closed:
        groups = sorted({node.group for node in closed if node.group}) or ["video", "render"]
        found = f"{closed[0].path} and {len(closed) - 1} more are closed to this user"
        return Check(
            name, Level.FAIL, found, "all open", f"sudo usermod -aG {','.join(groups)} $USER, then log in again"
        )
    return Check(name, Level.OK, f"{len(nodes)} found, all open", "all open")


def socket_folder(socket: Path, euid: int) -> Check:
    """That only the robot's user can reach the bridge's socket."""
    name = "socket folder"
    folder = socket.parent
    try:
        found = folder.stat()
    except OSError as error:
        return skipped(name, f"{folder}: {error.strerror}; edge-bridge makes it")
    mode = stat.S_IMODE(found.st_mode)
    said = f"{folder}, mode {mode:04o}, user {found.st_uid}"
    if mode & 0o077:
        return Check(name, Level.FAIL, said, "mode 0700", f"chmod 0700 {folder}: anybody could command the robot")
    if found.st_uid != euid and euid != 0:
        return Check(name, Level.FAIL, said, f"user {euid}", "run bridge and runner as one user")
    return Check(name, Level.OK, said, "mode 0700")


def power_meter(
    kind: str,
    open_it: Callable[[], PowerMeter],
    *,
    clock: Callable[[], int] = time.monotonic_ns,
    sleep: Callable[[float], None] = time.sleep,
) -> Check:
    """Whether the meter that the target names can be read, and what it says."""
    name = "power meter"
    if kind in ("none", "modelled"):
        return skipped(name, f"the target's meter is {kind!r}")
    try:
        meter = open_it()
        sleep(_SETTLE_S)
        sample: PowerSample = meter.read(clock())
    except MeterError as error:
        advice = "the governor has nothing to hold the budget by; see the message"
        return Check(name, Level.WARN, str(error), kind, advice)
    found = f"{sample.total_w:.1f} W, {meter.source}, {sample.tagged}"
    return Check(name, Level.OK, found + (f" ({meter.caveat})" if meter.caveat else ""), kind)


def temperatures(sysfs_root: Path, now_ns: int) -> Check:
    """Temperatures, and whether clocks are held back because of them now."""
    name = "temperatures"
    state = ThermalReader(sysfs_root).read(now_ns)
    if state.hottest_c is None:
        return skipped(name, "this machine shows no thermal zone")
    found = f"hottest {state.hottest_c:.0f} °C of {len(state.zones_c)} zones"
    if state.throttled:
        found += f", held back by {', '.join(state.throttling)}"
        return Check(name, Level.WARN, found, "no throttling", "let it cool down, look at fan and heat sink")
    return Check(name, Level.OK, found, "no throttling")
