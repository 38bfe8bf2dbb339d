"""Check of the robot's cable: that nothing but this machine reaches the robot over it."""

from __future__ import annotations

from pathlib import Path

from edge.deploy.doctor.check import Check, Level, skipped
from edge.deploy.units import FIREWALL_FILE, FIREWALL_FOLDER, FIREWALL_UNIT

NAME = "robot's cable"
EXPECTED = "a cable of its own, behind the firewall"


def cable(interface: str, root: Path) -> Check:
    """Whether the robot's interface is a cable of its own: not radio, not bridged, not routed, with the rules there."""
    if interface == "lo":
        return skipped(NAME, "a simulated robot has none")
    device = root / "sys/class/net" / interface
    if not device.exists():
        return Check(NAME, Level.FAIL, f"no interface {interface}", EXPECTED, "plug it in or correct dds.interface")
    if (device / "master").exists():
        found = f"{interface} is part of {(device / 'master').resolve().name}"
        return Check(
            NAME, Level.FAIL, found, EXPECTED, f"ip link set {interface} nomaster: other networks reach the robot"
        )
    if (device / "wireless").exists() or (device / "phy80211").exists():
        advice = "use a cable: everybody in that radio network can command the robot"
        return Check(NAME, Level.WARN, f"{interface} is a radio", EXPECTED, advice)
    if interface in _default_routes(root):
        advice = f"remove the default route of {interface}: it leads other traffic to the robot's network"
        return Check(NAME, Level.WARN, f"the default route leads over {interface}", EXPECTED, advice)
    rules = FIREWALL_FOLDER / FIREWALL_FILE
    if not (root / rules.relative_to("/")).exists():
        advice = f"edge-install units writes it; sudo systemctl enable --now {FIREWALL_UNIT} loads it"
        return Check(NAME, Level.WARN, f"{interface}, without {rules}", EXPECTED, advice)
    return Check(NAME, Level.OK, f"{interface}; {rules} is there", EXPECTED)


def _default_routes(root: Path) -> list[str]:
    """Interfaces with a default route, as /proc/net/route lists them (proc(5))."""
    try:
        lines = (root / "proc/net/route").read_text(encoding="ascii").splitlines()[1:]
    except OSError:
        return []
    fields = [line.split() for line in lines]
    return [row[0] for row in fields if len(row) > 7 and row[1] == row[7] == "00000000"]
