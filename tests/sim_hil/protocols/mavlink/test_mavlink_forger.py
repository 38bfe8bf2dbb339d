"""The simulated attacker: each attack produces its packets, and a believed one would end the drive."""

from __future__ import annotations

import pytest

from firmware_bridge.mavlink.session import SET_MODE
from firmware_bridge.mavlink.signing import Signatures
from firmware_bridge.mavlink.wire import Reader
from sim_hil.protocols.mavlink.forger import KINDS, OTHER_SYSTEM, REPLAYED, Forger
from sim_hil.protocols.mavlink.vehicle import Mode
from sim_hil.protocols.mavlink.wire import now_ticks
from tests.support.robot.rover_bench import RoverBench

KEY = bytes(range(32))


def attacked(kind: str, key: bytes | None) -> RoverBench:
    """A driven rover, three seconds after the beginning of an attack."""
    bench = RoverBench(key=key)
    forger = Forger(1, key, now_ticks())
    active: list[str] = []
    bench.to_bridge = lambda packet: (packet, *forger.packets(packet, active))
    bench.drive()
    active.append(kind)
    bench.run(3.0)
    return bench


@pytest.mark.parametrize("kind", KINDS)
def test_on_a_signed_link_each_attack_changes_nothing(kind: str) -> None:
    bench = attacked(kind, KEY)
    assert bench.status is not None and bench.status.state == "armed" and bench.session.reader.counts.malformed > 20


@pytest.mark.slow
def test_on_an_unsigned_link_another_system_changes_nothing() -> None:
    status = attacked(OTHER_SYSTEM, None).status
    assert status is not None and status.state == "armed"


def test_on_an_unsigned_link_a_forged_heartbeat_stops_the_rover() -> None:
    status = attacked("unsigned", None).status
    assert status is not None and status.cause == "estop"


@pytest.mark.slow
def test_on_an_unsigned_link_recorded_packets_never_take_the_rover_from_a_pilot() -> None:
    bench, forger, active = RoverBench(), Forger(1, None, 0), list[str]()
    bench.to_bridge = lambda packet: (packet, *forger.packets(packet, active))
    bench.drive()
    bench.run(2.0)
    bench.node.vehicle.pilot, since_ns = True, bench.now_ns
    active.append(REPLAYED)
    bench.run(1.5)
    assert bench.mode is Mode.MANUAL and not bench.commands(SET_MODE, since_ns)
    assert bench.status is not None and bench.status.last_command == (0.0, 0.0, 0.0)


def test_no_attack_adds_no_packet() -> None:
    forger = Forger(1, None, 0)
    assert not any(forger.packets(b"genuine", ()) for _ in range(200))


def test_packets_of_another_system_have_the_links_key() -> None:
    ticks = now_ticks()
    forger = Forger(1, KEY, ticks)
    packets = [packet for _ in range(5) for packet in forger.packets(b"genuine", (OTHER_SYSTEM,))]
    assert len(Reader((0,), Signatures(KEY, ticks, 0)).read(packets[0], 0)) == 1
