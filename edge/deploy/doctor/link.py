"""Checks of the link between this machine and the robot, by protocol; without a packet to the robot."""

from __future__ import annotations

import json
import stat
import subprocess
from collections.abc import Callable, Iterator, Sequence
from ipaddress import AddressValueError, IPv4Address
from pathlib import Path
from typing import Any, Final

from edge.deploy.doctor.check import Check, Level, skipped
from edge.deploy.doctor.rights import UserRights
from edge.deploy.firewall import TABLE
from edge.deploy.link_rights import SERIAL_GROUP, serial_device
from edge.deploy.unit_check import run_command
from edge.deploy.units import FIREWALL_FILE, FIREWALL_FOLDER, FIREWALL_UNIT
from firmware_bridge.backends import INSTALL
from firmware_bridge.core.config import ConfigError, RobotConfig

Runner = Callable[[Sequence[str]], tuple[int, str]]

_OWN_CABLE: Final = "a cable of its own, behind the firewall"
_CAN_TYPE: Final = "280"
"""ARPHRD_CAN of <linux/if_arp.h>, as /sys/class/net/NAME/type shows it."""
_IFF_UP: Final = 1


def robot_links(robot: RobotConfig, root: Path, user: UserRights, run: Runner = run_command) -> Iterator[Check]:
    """Yield the checks of the robot's link; `root`: root folder of Linux's files, `run`: runs `ip` and `systemctl`."""
    device = serial_device(robot)
    if robot.dds is not None:
        yield cable(robot.dds.interface, root, run)
    elif device is not None:
        yield serial_line(device, root, user)
    elif robot.can is not None and robot.can.interface == "socketcan":
        yield can_interface(robot.can.channel, robot.can.bitrate_bps, root, run)
    elif robot.can is not None:
        yield skipped("CAN interface", f"{robot.can.interface} is a simulated bus")
    if robot.can is not None:
        yield dbc_file(robot)
    if robot.mavlink is not None:
        host = "" if device is not None else robot.mavlink.link.split(":")[1]
        yield signing_key(robot.mavlink.signing_key, host, root)


def cable(interface: str, root: Path, run: Runner = run_command) -> Check:
    """Whether only this machine reaches the robot: its interface is no radio, not bridged, not routed, filtered."""
    name = "robot's cable"
    if interface == "lo":
        return skipped(name, "a simulated robot has none")
    device = root / "sys/class/net" / interface
    if not device.exists():
        return Check(name, Level.FAIL, f"no interface {interface}", _OWN_CABLE, "plug it in or correct dds.interface")
    if (device / "master").exists():
        found = f"{interface} is part of {(device / 'master').resolve().name}"
        return Check(
            name, Level.FAIL, found, _OWN_CABLE, f"ip link set {interface} nomaster: other networks reach the robot"
        )
    if (device / "wireless").exists() or (device / "phy80211").exists():
        advice = "use a cable: every program in that radio network can command the robot"
        return Check(name, Level.WARN, f"{interface} is a radio", _OWN_CABLE, advice)
    if interface in _default_routes(root):
        advice = f"remove the default route of {interface}: it leads other traffic to the robot's network"
        return Check(name, Level.WARN, f"the default route leads over {interface}", _OWN_CABLE, advice)
    rules = FIREWALL_FOLDER / FIREWALL_FILE
    if not (root / rules.relative_to("/")).exists():
        advice = "edge-install units writes it; its printed commands load it"
        return Check(name, Level.WARN, f"{interface}, without {rules}", _OWN_CABLE, advice)
    try:
        text = (root / rules.relative_to("/")).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        text = ""
    if f'"{interface}"' not in text:
        advice = f"repeat edge-install units with this robot file, then sudo systemctl restart {FIREWALL_UNIT}"
        return Check(name, Level.WARN, f"{interface}; {rules} does not name it", _OWN_CABLE, advice)
    loaded, state = _in_kernel(interface, run), _unit_state(FIREWALL_UNIT, run)
    if loaded is False or (loaded is None and state != "active"):
        found = f"{interface}; {rules} is there, its service is {state}"
        found += "" if loaded is None else f", and the kernel has no such rules for {interface}"
        advice = f"sudo systemctl restart {FIREWALL_UNIT}; journalctl -u {FIREWALL_UNIT} shows what it says"
        return Check(name, Level.WARN, found, _OWN_CABLE, advice)
    return Check(name, Level.OK, f"{interface}; {rules} is loaded", _OWN_CABLE)


def _in_kernel(interface: str, run: Runner) -> bool | None:
    """Return whether the kernel has the firewall's table for this interface; None where it cannot be asked (not root).

    The service stays active when another program has flushed its rules.
    """
    try:
        code, text = run(("nft", "list", "table", "inet", TABLE))
    except (OSError, subprocess.TimeoutExpired):
        return None
    if code != 0:
        return False if "No such file or directory" in text else None
    return f'"{interface}"' in text


def _unit_state(unit: str, run: Runner) -> str:
    """Return what systemd says of a unit, for any user: active, inactive, failed, …; unknown without systemd."""
    try:
        _, text = run(("systemctl", "is-active", unit))
    except (OSError, subprocess.TimeoutExpired):
        return "unknown"
    state = text.strip()
    return state if state.isalpha() else "unknown"  # a sentence: there is no systemd to ask


def _default_routes(root: Path) -> list[str]:
    """Interfaces with a default route, as /proc/net/route lists them (proc(5))."""
    try:
        lines = (root / "proc/net/route").read_text(encoding="ascii").splitlines()[1:]
    except OSError:
        return []
    fields = [line.split() for line in lines]
    return [row[0] for row in fields if len(row) > 7 and row[1] == row[7] == "00000000"]


def can_interface(channel: str, bitrate_bps: int, root: Path, run: Runner = run_command) -> Check:
    """Whether the CAN interface is up at the robot file's bitrate, and starts again by itself after a bus-off."""
    name, device = "CAN interface", root / "sys/class/net" / channel
    expected = f"{channel} up, with {bitrate_bps} bit/s and restart-ms"
    bring_up = f"sudo ip link set {channel} up type can bitrate {bitrate_bps} restart-ms 100"
    try:
        kind, flags = (device / "type").read_text().strip(), int((device / "flags").read_text(), 16)
    except (OSError, ValueError):
        return Check(name, Level.FAIL, f"no interface {channel}", expected, f"plug in the adapter, then {bring_up}")
    if kind != _CAN_TYPE:
        return Check(name, Level.FAIL, f"{channel} is no CAN interface", expected, "correct can.channel")
    if not flags & _IFF_UP:
        return Check(name, Level.FAIL, f"{channel} is down", expected, bring_up)
    details = _can_details(channel, run)
    if details is None:
        advice = f"install iproute2, or look at: ip -details link show {channel}"
        return Check(name, Level.WARN, f"{channel} is up; its bitrate is unknown", expected, advice)
    link, data = details.get("info_kind"), details.get("info_data") or {}
    silent = sorted({"LISTEN-ONLY", "LOOPBACK"} & set(data.get("ctrlmode") or ()))
    if silent:
        advice = f"it sends nothing to the base, a stop neither: sudo ip link set {channel} down, then {bring_up} " + (
            " ".join(f"{mode.lower()} off" for mode in silent)
        )
        return Check(name, Level.FAIL, f"{channel} is up, {', '.join(silent)}", expected, advice)
    if link != "can":
        return Check(name, Level.OK, f"{channel} is up, of kind {link}: a simulated bus")
    # An adapter with fixed bitrates reports bittiming_bitrate instead.
    bitrate = (data.get("bittiming") or {}).get("bitrate", data.get("bittiming_bitrate"))
    state = data.get("state", "unknown")
    found = f"{channel} is up, {bitrate} bit/s, {state}, restart-ms {data.get('restart_ms', 0)}"
    again = bring_up.replace(" up ", f" down; sudo ip link set {channel} up ", 1)
    if bitrate != bitrate_bps:
        advice = f"the base, this interface and can.bitrate_bps need one bitrate: correct the robot file, or {again}"
        return Check(name, Level.FAIL, found, expected, advice)
    if state == "BUS-OFF":
        advice = f"check the base's bitrate, wiring and termination, then: {again}"
        return Check(name, Level.FAIL, found, expected, advice)
    if state == "ERROR-PASSIVE":
        advice = "is the base on? check its bitrate, wiring and termination (60 ohm between CAN_H and CAN_L)"
        return Check(name, Level.WARN, found, expected, advice)
    if not data.get("restart_ms"):
        advice = f"after a bus-off it stays off: {again}"
        return Check(name, Level.WARN, found, expected, advice)
    return Check(name, Level.OK, found, expected)


def dbc_file(robot: RobotConfig) -> Check:
    """Whether the robot file and the DBC file of a CAN base fit each other, and the load that they plan."""
    name, expected = "DBC file", "what the tables of [can] name"
    try:
        from firmware_bridge.can.database import load_database  # needs the extra of its protocol

        database = load_database(robot)
    except ModuleNotFoundError as error:
        return skipped(name, f"{error.name} is missing: {INSTALL['can']}")
    except ConfigError as error:
        return Check(name, Level.FAIL, str(error), expected, "correct the key that the message names, or the DBC file")
    path = robot.can.dbc_path if robot.can is not None else ""
    counts = f"{len(database.received)} messages received, {len(database.sent)} sent"
    return Check(name, Level.OK, f"{path}: {counts}, {database.load:.0%} of the bus", expected)


def _can_details(channel: str, run: Runner) -> dict[str, Any] | None:
    """Return `linkinfo` of `ip -details -json link show`; None where it cannot be had."""
    try:
        code, text = run(("ip", "-details", "-json", "link", "show", "dev", channel))
        found = json.loads(text) if code == 0 else None
    except (OSError, subprocess.TimeoutExpired, ValueError):
        return None
    entry = found[0] if isinstance(found, list) and found else None
    info = entry.get("linkinfo") if isinstance(entry, dict) else None
    return info if isinstance(info, dict) else None


def serial_line(device: Path, root: Path, user: UserRights) -> Check:
    """Whether the serial device is there and the user may read and write it."""
    name, expected = "serial line", f"{device}, open to the bridge's user"
    file = root / device.relative_to("/")
    if not file.exists():
        advice = "plug in the cable; `ls /dev/serial/by-id` shows stable names for the robot file"
        return Check(name, Level.FAIL, f"no device {device}", expected, advice)
    if not stat.S_ISCHR(file.stat().st_mode):
        return Check(name, Level.FAIL, f"{device} is no device", expected, "correct the device in the robot file")
    if not user.may(file, write=True):
        advice = f"sudo usermod -aG {SERIAL_GROUP} {user.name}, then log in again; the service gets it from its unit"
        level = Level.WARN if user.other and user.through_its_group(file) else Level.FAIL
        return Check(name, level, f"{device} is closed to {user.name}", expected, advice)
    return Check(name, Level.OK, f"{device} is open to {user.name}", expected)


def signing_key(key: Path | None, host: str, root: Path) -> Check:
    """Whether MAVLink packets are signed with a key that nobody else can read. `host`: of a UDP link, else empty."""
    name, expected = "MAVLink signing", "packets signed with a secret key"
    if key is None:
        if host == "" or _is_loopback(host):
            return Check(name, Level.OK, "not signed, on a line that no other machine reaches")
        advice = "every program in that network can command the robot: set mavlink.signing_key, or use a serial line"
        return Check(name, Level.WARN, f"not signed, over UDP to {host}", expected, advice)
    file = root / key.relative_to("/")
    try:
        found = file.stat()
    except OSError as error:
        advice = "create it as docs/your_robot.md shows, or run this as root"
        return Check(name, Level.FAIL, f"{key}: {error.strerror}", expected, advice)
    if found.st_mode & 0o077:
        advice = f"sudo chmod 0600 {key}, and make a new key: others may have read this one"
        mode = stat.filemode(found.st_mode)
        return Check(name, Level.FAIL, f"{key} has mode {mode}", "a file that only the bridge may read", advice)
    return Check(name, Level.OK, f"{key}, mode {stat.filemode(found.st_mode)}", expected)


def _is_loopback(host: str) -> bool:
    try:
        return IPv4Address(host).is_loopback
    except AddressValueError:
        return host == "localhost"
