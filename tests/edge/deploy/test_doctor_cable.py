"""`edge-doctor` on the robot's cable, on files as Linux shows them."""

from __future__ import annotations

from pathlib import Path

import pytest

from edge.deploy.doctor.cable import cable
from edge.deploy.doctor.check import Level
from tests.edge.deploy.test_doctor_machine import write

RULES = {"etc/tic-vla-edge/tic-vla-edge.nft": ""}
ADDRESS = {"sys/class/net/eth0/address": "02:00:00:00:00:01\n"}
ROUTE = (
    "Iface\tDestination\tGateway\tFlags\tRefCnt\tUse\tMetric\tMask\nNAME\t00000000\t017BA8C0\t3\t0\t0\t0\t00000000\n"
)


def test_a_cable_of_its_own_behind_the_firewall_is_good(tmp_path: Path) -> None:
    write(tmp_path, ADDRESS | RULES | {"proc/net/route": ROUTE.replace("NAME", "wlan0")})
    assert cable("eth0", tmp_path).level is Level.OK


@pytest.mark.parametrize(
    ("files", "level", "found"),
    [
        ({}, Level.FAIL, "no interface eth0"),
        (ADDRESS | RULES | {"sys/class/net/eth0/master": ""}, Level.FAIL, "part of"),
        (ADDRESS | RULES | {"sys/class/net/eth0/phy80211/index": "0"}, Level.WARN, "radio"),
        (ADDRESS | RULES | {"proc/net/route": ROUTE.replace("NAME", "eth0")}, Level.WARN, "default route"),
        (ADDRESS, Level.WARN, "without /etc/tic-vla-edge/tic-vla-edge.nft"),
    ],
    ids=["absent", "bridged", "radio", "routed", "no rules"],
)
def test_what_lets_others_reach_the_robot_is_said(
    tmp_path: Path, files: dict[str, str], level: Level, found: str
) -> None:
    write(tmp_path, files)
    check = cable("eth0", tmp_path)
    assert (check.level, found in check.found) == (level, True)


def test_a_simulated_robot_has_no_cable(tmp_path: Path) -> None:
    assert cable("lo", tmp_path).level is Level.SKIP
