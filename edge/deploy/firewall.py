"""Formats nftables rules for the robot's cable; touches no file.

The robot's body takes requests from any DDS participant that reaches it. These rules let only the services' users send
on the cable, and only to the robot. DDS gives a service no separate port, so they cannot separate the bridge's requests
from the runner's reading: docs/robot_network.md lists the remaining risk.
"""

from __future__ import annotations

from collections.abc import Sequence
from ipaddress import IPv4Network, collapse_addresses
from typing import Final

from edge.deploy.unit_text import UnitError

TABLE: Final = "tic_vla_edge"
MULTICAST: Final = IPv4Network("239.255.0.1/32")
"""Multicast group of DDS discovery (RTPS 2.5, section 9.6.1.4.1)."""
_PORT_BASE: Final = 7400
_PORTS_A_DOMAIN: Final = 250
_MAX_PORT: Final = 65535


def ports(domain: int) -> tuple[int, int]:
    """Return the first and last UDP port of a DDS domain (RTPS 2.5, section 9.6.2.3: base 7400, domain gain 250)."""
    first = _PORT_BASE + _PORTS_A_DOMAIN * domain
    return first, min(first + _PORTS_A_DOMAIN - 1, _MAX_PORT)


def ruleset(interface: str, networks: Sequence[IPv4Network], domain: int, users: Sequence[str]) -> str:
    """Return the nftables file; loading it again replaces the table. Raises UnitError.

    `interface`: name of the robot's cable; `networks`: the robot, at best its single address; `domain`: DDS domain;
    `users`: users that may send to the robot, besides root.
    """
    if interface[:1].isdigit():
        raise UnitError(f"dds.interface: expected a name for the firewall, such as eth0, found {interface}")
    if not networks or not users:
        raise UnitError("the firewall needs the robot's network and the users that may send to it")
    cable, (first, last) = f'"{interface}"', ports(domain)
    dds = f"udp dport {first}-{last}"
    senders = ", ".join([*(f'"{user}"' for user in users), '"root"'])
    merged = collapse_addresses(networks)  # an interval set must not overlap
    robot = ", ".join(str(network.network_address if network.prefixlen == 32 else network) for network in merged)
    return f"""\
# Made by edge-install units: the traffic that may pass the robot's cable. Generate it again, do not edit it.
# Check it with `nft -c -f FILE`; show the counters with `nft list table inet {TABLE}`.
table inet {TABLE}
delete table inet {TABLE}
table inet {TABLE} {{
    set robot {{
        type ipv4_addr
        flags interval
        elements = {{ {robot} }}
    }}

    # Only the services' users send, and only to the robot. Root is let through: it could remove this table. The robot's
    # DDS may take any port above 1023: Cyclone's default leaves the choice to the kernel.
    chain output {{
        type filter hook output priority filter; policy accept;
        oifname != {cable} accept
        meta skuid {{ {senders} }} ip daddr @robot udp dport 1024-65535 accept
        meta skuid {{ {senders} }} ip daddr {MULTICAST.network_address} {dds} accept
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
