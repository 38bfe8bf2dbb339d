"""nftables rules for the robot's cable: text from facts, no file is touched.

The robot's body takes requests from any DDS participant that reaches it. These rules let only the services' users send
on the cable, and only to the robot. DDS gives a service no port of its own, so they cannot separate the bridge's
requests from the runner's reading: what remains is written down in docs/robot_network.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from ipaddress import IPv4Network, collapse_addresses
from typing import Final

from edge.deploy.unit_text import UnitError

TABLE: Final = "tic_vla_edge"
MULTICAST: Final = IPv4Network("239.255.0.1/32")
"""Group by which DDS participants find each other (RTPS 2.5, section 9.6.1.4.1)."""
_PORT_BASE: Final = 7400
_PORTS_A_DOMAIN: Final = 250
_MAX_PORT: Final = 65535


@dataclass(frozen=True)
class CableRules:
    """All that the rules depend on."""

    interface: str
    """Name of the interface that the robot's cable is plugged into."""
    networks: tuple[IPv4Network, ...]
    """Where the robot is: at best its one address."""
    domain: int
    """DDS domain."""
    users: tuple[str, ...]
    """Users that may send to the robot; root besides."""

    def __post_init__(self) -> None:
        if self.interface[:1].isdigit():
            raise UnitError(
                f"dds.interface: expected an interface's name for the firewall, such as eth0, found {self.interface}"
            )
        if not self.networks or not self.users:
            raise UnitError("the firewall needs the robot's network and the users that may send to it")


def ports(domain: int) -> tuple[int, int]:
    """First and last UDP port of a DDS domain (RTPS 2.5, section 9.6.2.3: base 7400, domain gain 250)."""
    first = _PORT_BASE + _PORTS_A_DOMAIN * domain
    return first, min(first + _PORTS_A_DOMAIN - 1, _MAX_PORT)


def ruleset(rules: CableRules) -> str:
    """Text of the nftables file; loading it again replaces the table."""
    cable, (first, last) = f'"{rules.interface}"', ports(rules.domain)
    dds = f"udp dport {first}-{last}"
    users = ", ".join([*(f'"{user}"' for user in rules.users), '"root"'])
    return f"""\
# Made by edge-install units: what may pass the robot's cable. Write it anew instead of editing it.
# Check it with `nft -c -f FILE`; show the counters with `nft list table inet {TABLE}`.
table inet {TABLE}
delete table inet {TABLE}
table inet {TABLE} {{
    set robot {{
        type ipv4_addr
        flags interval
        elements = {{ {_elements(rules.networks)} }}
    }}

    # Only the services' users send, and only to the robot. Root is let through: it could remove this table.
    chain output {{
        type filter hook output priority filter; policy accept;
        oifname != {cable} accept
        meta skuid {{ {users} }} ip daddr @robot {dds} accept
        meta skuid {{ {users} }} ip daddr {MULTICAST.network_address} {dds} accept
        meta l4proto igmp accept
        ip daddr @robot icmp type {{ echo-request, echo-reply, destination-unreachable }} accept
        counter drop
    }}

    # The second line is this machine's own multicast, which comes back on the cable.
    chain input {{
        type filter hook input priority filter; policy accept;
        iifname != {cable} accept
        fib saddr type local {dds} accept
        ip saddr @robot {dds} accept
        ip saddr @robot icmp type {{ echo-request, echo-reply, destination-unreachable }} accept
        meta l4proto igmp accept
        counter drop
    }}

    # Nothing is routed between the cable and Wi-Fi or any other network.
    chain forward {{
        type filter hook forward priority filter; policy accept;
        iifname {cable} counter drop
        oifname {cable} counter drop
    }}
}}
"""


def _elements(networks: Sequence[IPv4Network]) -> str:
    """Addresses and networks of an interval set, which must not overlap."""
    merged = collapse_addresses(networks)
    return ", ".join(str(network.network_address if network.prefixlen == 32 else network) for network in merged)
