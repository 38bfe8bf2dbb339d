"""Checks of this user's rights: priority, memory, devices, the socket's folder, power and temperature."""

from __future__ import annotations

import os
import pwd
import resource
import stat
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from edge.artifacts.providers import device_nodes
from edge.deploy.doctor.check import Check, Level, skipped
from edge.deploy.unit_text import RUNNER_USER
from edge.deploy.units import NEED_DEVICES
from edge.inference.scheduling import priority_refusal
from edge.power.governor.limits import LimitsConfig
from edge.power.meters.meter import MeterError, PowerMeter, PowerSample
from edge.power.meters.rapl import ZONES
from edge.power.meters.thermal import ThermalReader
from firmware_bridge.core.config import OPERATOR_SUFFIX, ConfigError

FROM_UNIT = "the service gets it from its unit (edge-install units)"
SHARED_FOLDER_MODE = 0o711
"""Mode of the installed service's folder: the modes of its sockets decide."""
_SYSTEM_FOLDERS = frozenset(map(Path, ("/", "/run", "/tmp", "/var/run", "/var/tmp", "/dev/shm")))
"""Folders of all programs, whose mode must stay."""
_SETTLE_S = 0.2
"""Time between opening a meter and reading it: an energy counter needs some."""


@dataclass(frozen=True)
class UserRights:
    """A user of this machine. Own rights can be tried; another user's are read from file modes."""

    name: str
    uid: int
    groups: frozenset[int]
    other: bool
    """Whether this is another user than that of this process."""

    def may(self, path: Path, *, write: bool = False) -> bool:
        """Return whether the user may read (and write) a file; another user's access lists are ignored."""
        if not self.other:
            return os.access(path, os.R_OK | os.W_OK if write else os.R_OK)
        if self.uid == 0:
            return True
        try:
            found = path.stat()
        except OSError:
            return False
        wanted = stat.S_IROTH | (stat.S_IWOTH if write else 0)
        # The first matching class decides, as in the kernel.
        shift = 6 if found.st_uid == self.uid else 3 if found.st_gid in self.groups else 0
        return (stat.S_IMODE(found.st_mode) >> shift) & wanted == wanted

    def through_its_group(self, path: Path) -> bool:
        """Return whether the group of a file may read it, so that membership would be enough."""
        try:
            return path.stat().st_mode & stat.S_IRGRP != 0
        except OSError:
            return False


def current_user(euid: Callable[[], int] = os.geteuid) -> UserRights:
    """Return the user of this process."""
    uid = euid()
    try:
        name = pwd.getpwuid(uid).pw_name
    except KeyError:
        name = str(uid)
    return UserRights(name, uid, frozenset({os.getegid(), *os.getgroups()}), other=False)


def user_named(name: str | None) -> UserRights:
    """Return the named user, by default that of this process. Raises ConfigError for an unknown user."""
    if name is None:
        return current_user()
    try:
        entry = pwd.getpwnam(name)
    except KeyError:
        raise ConfigError(
            f"--user {name}: this machine has no such user; make it first (systemd-sysusers, see edge-install units)"
        ) from None
    if entry.pw_uid == os.geteuid():
        return current_user()
    return UserRights(name, entry.pw_uid, frozenset(os.getgrouplist(name, entry.pw_gid)), other=True)


def real_time(priority: int, user: UserRights, attempt: Callable[[int], str | None] = priority_refusal) -> Check:
    """Check whether the control thread can have the target's real-time priority."""
    name = "real-time priority"
    if priority == 0:
        return skipped(name, "the target asks for none")
    if user.other:
        return skipped(name, f"cannot be tried for {user.name}; {FROM_UNIT}")
    if attempt(priority):
        return Check(name, Level.WARN, f"refused to {user.name}", f"SCHED_FIFO {priority}", FROM_UNIT)
    return Check(name, Level.OK, f"SCHED_FIFO {priority} granted to {user.name}", f"SCHED_FIFO {priority}")


def locked_memory(limit_bytes: int, user: UserRights) -> Check:
    """Check whether the runner may lock its pages in memory."""
    name = "locked memory"
    if user.other and user.uid != 0:
        return skipped(name, f"cannot be tried for {user.name}; {FROM_UNIT}")
    if limit_bytes == resource.RLIM_INFINITY or user.uid == 0:
        return Check(name, Level.OK, f"no limit for {user.name}", "no limit")
    return Check(name, Level.WARN, f"at most {limit_bytes // 1024} KiB for {user.name}", "no limit", FROM_UNIT)


def device_access(providers: Sequence[str], root: Path, user: UserRights) -> Check:
    """Check whether the providers' device nodes exist and the user may open them."""
    name = "device nodes"
    if not set(providers) & set(NEED_DEVICES):
        return Check(name, Level.OK, "none needed", "those of " + ", ".join(providers))
    nodes = device_nodes(providers, root)
    if not nodes:
        return Check(name, Level.FAIL, "none", "those of " + ", ".join(providers), "install the device's driver")
    files = {node: root / node.path.relative_to("/") for node in nodes}
    closed = [node for node in nodes if not user.may(files[node], write=_is_for_writing(files[node]))]
    if closed:
        groups = sorted({node.group for node in closed if node.group}) or ["video", "render"]
        found = f"{closed[0].path} and {len(closed) - 1} more are closed to {user.name}"
        advice = f"sudo usermod -aG {','.join(groups)} {user.name}, then log in again"
        if user.other and all(node.group and user.through_its_group(files[node]) for node in closed):
            return Check(name, Level.WARN, found, "all open", f"{FROM_UNIT}; without it: {advice}")
        return Check(name, Level.FAIL, found, "all open", advice)
    return Check(name, Level.OK, f"{len(nodes)} found, all open to {user.name}", "all open")


def _is_for_writing(node: Path) -> bool:
    """Return whether users other than root may write; /dev/nvmap of an Orin is read-only (NVIDIA/NemoClaw #4231)."""
    return stat.S_IMODE(node.stat().st_mode) & (stat.S_IWGRP | stat.S_IWOTH) != 0


def socket_folder(socket: Path, user: UserRights) -> Check:
    """Check that only one user, or the service's groups, can reach the bridge's sockets."""
    name = "socket folder"
    folder = socket.parent
    try:
        found = folder.stat()
    except OSError as error:
        return skipped(name, f"{folder}: {error.strerror}; edge-bridge makes it")
    mode = stat.S_IMODE(found.st_mode)
    text = f"{folder}, mode {mode:04o}, user {found.st_uid}"
    if mode == SHARED_FOLDER_MODE:
        return _service_sockets(socket, user, found.st_uid)
    if mode & 0o077:
        expected = "mode 0700, or 0711 of the service"
        advice = f"chmod 0700 {folder}: any user could command the robot"
        if mode & stat.S_ISVTX or found.st_uid != user.uid or folder in _SYSTEM_FOLDERS:
            advice = f"name a socket in a folder of its own with --socket: in {folder} any user could command the robot"
        return Check(name, Level.FAIL, text, expected, advice)
    if found.st_uid != user.uid and user.uid != 0:
        expected = f"user {user.uid} ({user.name})"
        return Check(name, Level.FAIL, text, expected, "run bridge and runner as one user, or name it with --user")
    return Check(name, Level.OK, f"{text} ({user.name})", "mode 0700")


def _service_sockets(socket: Path, user: UserRights, bridge_uid: int) -> Check:
    """Check modes and groups of the installed service's two sockets for the runner."""
    name = "bridge sockets"
    operator = Path(f"{socket}{OPERATOR_SUFFIX}")
    try:
        commands, stops = socket.stat(), operator.stat()
    except OSError as error:
        return skipped(name, f"{error.filename}: {error.strerror}; start the bridge, which makes it")
    text = f"{socket} of group {commands.st_gid}, {operator.name} of group {stops.st_gid}"
    for path, status in ((socket, commands), (operator, stops)):
        if stat.S_IMODE(status.st_mode) & 0o007:
            found = f"{path}, mode {stat.S_IMODE(status.st_mode):04o}"
            return Check(name, Level.FAIL, found, "mode 0660 or less", "restart the bridge, which sets the modes")
    if user.uid == 0:
        return Check(name, Level.OK, f"{text}; closed to other users", "mode 0660")
    if user.uid == bridge_uid or stops.st_gid in user.groups:
        advice = (
            "run the runner as a user of its own, outside the operators' group: it could take back an emergency stop"
        )
        return Check(name, Level.FAIL, f"{user.name} reaches {operator}", "a runner that cannot operate", advice)
    if commands.st_gid not in user.groups:
        advice = f"name the runner's user with --user (edge-install units: {RUNNER_USER})"
        return Check(name, Level.FAIL, f"{user.name} does not reach {socket}", "the runner's user", advice)
    return Check(name, Level.OK, f"{text}; {user.name} reaches the first only", "the command socket only")


def power_meter(
    kind: str,
    open_it: Callable[[], PowerMeter],
    sysfs_root: Path,
    user: UserRights,
    *,
    clock: Callable[[], int] = time.monotonic_ns,
    sleep: Callable[[float], None] = time.sleep,
) -> Check:
    """Check that the target's meter can be read, and report its reading."""
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
    # Of all files that meters read, usually only these are restricted to root.
    counters = sorted(sysfs_root.glob(f"{ZONES}/energy_uj")) if user.other and meter.source.startswith("rapl") else []
    if closed := [path for path in counters if not user.may(path)]:
        advice = f"for this boot: sudo chmod a+r {closed[0]}, and the others like it (a side channel, CVE-2020-8694)"
        return Check(name, Level.WARN, f"{closed[0]} is closed to {user.name}", kind, advice)
    return Check(name, Level.OK, found + (f" ({meter.caveat})" if meter.caveat else ""), kind)


def temperatures(sysfs_root: Path, now_ns: int) -> Check:
    """Check the temperatures' distance from throttling and from the board's switch-off."""
    name = "temperatures"
    state, limits = ThermalReader(sysfs_root).read(now_ns), LimitsConfig()
    if state.hottest_c is None:
        return skipped(name, "this machine shows no thermal zone")
    found = f"hottest {state.hottest_c:.0f} °C of {len(state.zones_c)} zones"
    advice = "let it cool down, check fan and heat sink"
    trip_c, passive_c = state.trip_margin_c, state.throttle_margin_c
    if trip_c is not None and trip_c <= limits.trip_margin_c:
        found += f", {trip_c:.1f} °C below where the board switches off"
        return Check(name, Level.FAIL, found, f"more than {limits.trip_margin_c:g} °C", advice)
    if state.throttled:
        found += f", held back by {', '.join(state.throttling)}"
        return Check(name, Level.WARN, found, "no throttling", advice)
    if passive_c is not None and passive_c < limits.throttle_clear_c:
        found += f", {abs(passive_c):.1f} °C {'below' if passive_c >= 0 else 'above'} where clocks are held back"
        return Check(name, Level.WARN, found, f"{limits.throttle_clear_c:g} °C or more below", advice)
    return Check(name, Level.OK, found, "no throttling")
