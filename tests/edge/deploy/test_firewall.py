"""The generated nftables file: what it lets pass, as text, to nft itself, and in a real network namespace."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from ipaddress import IPv4Network
from pathlib import Path

import pytest

from edge.deploy.firewall import ruleset
from edge.deploy.unit_text import BRIDGE_USER, RUNNER_USER, UnitError
from tests.support.processes import REPOSITORY

ROBOT = IPv4Network("192.168.123.161/32")
NFT = shutil.which("nft", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin")
needs_nft = pytest.mark.skipif(NFT is None, reason="no nft here")
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can become other users")


def rules(**changes: object) -> str:
    defaults = {"interface": "eth0", "networks": (ROBOT,), "domain": 0, "users": ("bridge", "runner")}
    return ruleset(**(defaults | changes))  # type: ignore[arg-type]


def chain(text: str, name: str) -> list[str]:
    """Lines of one chain, without its head."""
    match = re.search(rf"chain {name} \{{\n(.*?)\n    \}}", text, re.DOTALL)
    assert match is not None
    return [line.strip() for line in match[1].splitlines()][1:]


def test_only_the_services_users_and_root_may_send_and_only_to_the_robot_and_the_discovery_group() -> None:
    lines = chain(rules(), "output")
    sending = [line for line in lines if "udp" in line]
    assert all(line.startswith('meta skuid { "bridge", "runner", "root" }') for line in sending)
    assert [re.search(r"ip daddr (\S+)", line)[1] for line in sending] == ["@robot", "239.255.0.1"]  # type: ignore[index]
    assert lines[-1] == "counter drop"


def test_the_robot_is_the_only_peer() -> None:
    text = rules()
    assert "elements = { 192.168.123.161 }" in text
    assert chain(text, "input")[-1] == "counter drop"


def test_nothing_is_forwarded_to_or_from_the_cable() -> None:
    assert chain(rules(), "forward") == ['iifname "eth0" counter drop', 'oifname "eth0" counter drop']


def test_other_interfaces_are_left_alone() -> None:
    text = rules(interface="enP8p1s0")
    assert chain(text, "output")[0] == 'oifname != "enP8p1s0" accept'
    assert chain(text, "input")[0] == 'iifname != "enP8p1s0" accept'


def test_networks_that_overlap_are_merged() -> None:
    assert "elements = { 192.168.123.0/24 }" in rules(networks=(ROBOT, IPv4Network("192.168.123.0/24")))


@pytest.mark.parametrize(("domain", "expected"), [(0, (7400, 7649)), (1, (7650, 7899)), (232, (65400, 65535))])
def test_ports_are_those_of_the_dds_domain(domain: int, expected: tuple[int, int]) -> None:
    assert f"udp dport {expected[0]}-{expected[1]} accept" in rules(domain=domain)


@pytest.mark.parametrize("changes", [{"interface": "192.168.123.99"}, {"networks": ()}, {"users": ()}])
def test_facts_that_make_no_firewall_are_refused(changes: dict[str, object]) -> None:
    with pytest.raises(UnitError, match="firewall"):
        rules(**changes)


@needs_nft
def test_nft_accepts_the_file(tmp_path: Path) -> None:
    path = tmp_path / "robot.nft"
    path.write_text(rules(users=("daemon", "nobody")))
    command = [str(NFT), "-c", "-f", str(path)]
    if os.geteuid() != 0:
        command = ["unshare", "--map-root-user", "--net", *command]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert (done.returncode, done.stderr) == (0, "")


SEND = """
import os, socket, sys
uid, address, port = int(sys.argv[1]), sys.argv[2], int(sys.argv[3])
os.setuid(uid)
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
    try:
        sender.sendto(b"x", (address, port))
        print("sent")
    except PermissionError:
        print("refused")
"""
ATTEMPTS = {
    ("1", "192.168.123.161", "7400"): "sent",
    ("0", "192.168.123.161", "7400"): "sent",
    ("1", "239.255.0.1", "7400"): "sent",
    ("65534", "192.168.123.161", "7400"): "refused",
    ("65534", "239.255.0.1", "7400"): "refused",
    ("1", "192.168.123.162", "7400"): "refused",
    ("1", "192.168.123.161", "41626"): "sent",  # where a DDS without a fixed participant index may listen
    ("1", "192.168.123.161", "22"): "refused",
    ("65534", "10.0.0.2", "7400"): "sent",
}
"""User number (1 is daemon), address and port; 10.0.0.2 lies behind another interface."""


LOOP = """
import os, socket, struct
os.setuid(1)
group = struct.pack("4s4s", socket.inet_aton("239.255.0.1"), socket.inet_aton("192.168.123.99"))
udp = (socket.AF_INET, socket.SOCK_DGRAM)
with socket.socket(*udp) as receiver, socket.socket(*udp) as sender:
    receiver.bind(("", 7400))
    receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
    receiver.settimeout(2)
    sender.bind(("192.168.123.99", 0))
    sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("192.168.123.99"))
    sender.sendto(b"x", ("239.255.0.1", 7400))
    print(receiver.recv(1).decode())
"""


def in_a_network_of_its_own(tmp_path: Path, *lines: str) -> str:
    """Run shell lines between two interfaces, one of them with the rules; what they print."""
    path = tmp_path / "robot.nft"
    path.write_text(rules(interface="cable0", users=("daemon",)))
    script = ["set -e"]
    for name, far, address in (("cable0", "far0", "192.168.123.99/24"), ("other0", "far1", "10.0.0.1/24")):
        script += [f"ip link add {name} type veth peer name {far}", f"ip addr add {address} dev {name}"]
        script += [f"ip link set {far} up", f"ip link set {name} up"]
    script += ["ip route add 239.255.0.1/32 dev cable0"]
    script += [f"{NFT} -f {path}", f"{NFT} -f {path}"]  # the second time replaces the first
    command = ["unshare", "--net", "sh", "-c", "\n".join([*script, *lines])]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@needs_nft
@needs_root
def test_programs_of_this_machine_still_find_each_other_by_multicast(tmp_path: Path) -> None:
    (tmp_path / "loop.py").write_text(LOOP)
    assert in_a_network_of_its_own(tmp_path, f"{sys.executable} {tmp_path / 'loop.py'}").strip() == "x"


@needs_nft
@needs_root
def test_the_kernel_lets_only_the_services_users_send_and_only_to_the_robot(tmp_path: Path) -> None:
    script = tmp_path / "send.py"
    script.write_text(SEND)
    attempts = [f"{sys.executable} {script} {' '.join(attempt)}" for attempt in ATTEMPTS]
    answers = in_a_network_of_its_own(tmp_path, *attempts).split()
    assert dict(zip(ATTEMPTS, answers, strict=True)) == ATTEMPTS


def test_the_lines_on_the_page_are_the_generated_ones() -> None:
    page = (REPOSITORY / "docs" / "robot_network.md").read_text(encoding="utf-8")
    shown = page.split("```")[1].strip().splitlines()
    assert shown == chain(rules(users=(BRIDGE_USER, RUNNER_USER)), "output")[: len(shown)]
