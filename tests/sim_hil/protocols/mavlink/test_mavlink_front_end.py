"""The Carter on MAVLink through `edge-hil`'s front end: the contract of all protocols, over a UDP socket."""

from __future__ import annotations

import json
import math
import socket
from collections.abc import Iterator
from math import atan2
from pathlib import Path

import pytest

from sim_hil.protocols.front_end import FrontEndError
from sim_hil.protocols.mavlink.front_end import LinkOptions, MavlinkFrontEnd, open_front_end
from sim_hil.protocols.mavlink.udp import MAX_LEARNED
from sim_hil.protocols.mavlink.vehicle import Mode
from sim_hil.protocols.mavlink.wire import now_ticks
from sim_hil.simulation.physics import Simulation
from tests.support.robot.front_end_contract import FrontEndContract, Report, Rig, options
from tests.support.robot.mavlink_client import MavlinkClient


class ContractClient:
    """The contract's client; asks for offboard mode with every command, as the rover leaves it without setpoints."""

    def __init__(self, port: int) -> None:
        self.mavlink = MavlinkClient(("127.0.0.1", port))
        self.reports: list[Report] = []

    def poll(self) -> None:
        self.mavlink.heartbeat()
        for message in self.mavlink.poll():
            if message.get_type() == "ODOMETRY":
                w, _, _, z = message.q
                self.reports.append(
                    Report(message.time_usec / 1e6, message.x, -message.y, -2 * atan2(z, w), message.vx)
                )

    def get_ready(self) -> None:
        self.mavlink.heartbeat()
        self.mavlink.drive(0.0, 0.0)
        self.mavlink.arm()
        self.mavlink.set_mode(Mode.OFFBOARD)

    def is_ready(self) -> bool:
        return self.mavlink.armed

    def drive(self, vx_mps: float, wz_radps: float) -> None:
        self.mavlink.drive(vx_mps, wz_radps)
        if self.mavlink.mode is not Mode.OFFBOARD:
            self.mavlink.set_mode(Mode.OFFBOARD)

    def stop(self) -> None:
        self.drive(0.0, 0.0)

    def emergency_stop(self) -> None:
        self.mavlink.emergency_stop()

    def send_garbage(self) -> None:
        self.mavlink.send_bytes(b"\xfd\x09\x00\x00\x01\xff\xbe\x00\x00\x00 no such packet")

    def close(self) -> None:
        self.mavlink.close()


def open_rig(link: str = "udp:127.0.0.1:0", **changes: object) -> Rig:
    asked = options("carter", link=link, **changes)
    simulation = Simulation(asked.scene, people=0, seed=0, robot="carter")
    front_end = open_front_end(simulation, asked)
    assert isinstance(front_end, MavlinkFrontEnd)
    return Rig(simulation, front_end, ContractClient(front_end.port))


class TestContract(FrontEndContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig]:
        rig = open_rig()
        yield rig
        rig.close()


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = open_rig()
    yield rig
    rig.close()


def _client(rig: Rig) -> MavlinkClient:
    client = rig.client
    assert isinstance(client, ContractClient)
    return client.mavlink


def _port(rig: Rig) -> int:
    front_end = rig.front_end
    assert isinstance(front_end, MavlinkFrontEnd)
    return front_end.port


def _wire(rig: Rig) -> dict[str, int]:
    found: dict[str, int] = rig.front_end.summary()["wire"]["mavlink"]  # type: ignore[index, assignment]
    return found


def test_a_second_station_watches_and_does_not_drive(rig: Rig) -> None:
    rig.make_ready()
    other = MavlinkClient(("127.0.0.1", _port(rig)), system=250)
    try:
        before = rig.place()
        rig.run(1.0, lambda: (other.heartbeat(), other.drive(0.5, 0.0), rig.client.drive(0.0, 0.0)))
        other.poll()
        assert "ODOMETRY" in other.latest and _wire(rig)["not_in_control"] > 0
        assert math.dist(before, rig.place()) < 0.02
        rig.tell(other.emergency_stop)
        rig.until(lambda: not _client(rig).armed, 1.0, "the stop that every station may request")
    finally:
        other.close()


def test_excess_addresses_are_refused(rig: Rig) -> None:
    clients = [MavlinkClient(("127.0.0.1", _port(rig)), system=200 + n) for n in range(MAX_LEARNED + 2)]
    try:
        for client in clients:
            client.heartbeat()
        rig.until(lambda: _wire(rig)["turned_away"] >= 2, 2.0, "those too many to be turned away")
    finally:
        for client in clients:
            client.close()


@pytest.mark.slow
def test_a_fixed_address_receives_only_heartbeats_until_it_answers() -> None:
    listener = MavlinkClient(("127.0.0.1", 9))
    rig = open_rig(f"udp:127.0.0.1:0,to=127.0.0.1:{listener.address[1]}")
    try:
        rig.run(2.0)
        assert {message.get_type() for message in listener.poll()} == {"HEARTBEAT"}
    finally:
        listener.close()
        rig.close()


def test_with_a_key_unsigned_commands_do_nothing(tmp_path: Path) -> None:
    (tmp_path / "key").write_text("ab" * 32)
    rig = open_rig(f"udp:127.0.0.1:0,key={tmp_path / 'key'}")
    signing = MavlinkClient(("127.0.0.1", _port(rig)), system=9, key=b"\xab" * 32, now_ticks=now_ticks())
    try:
        rig.client.get_ready()
        rig.until(lambda: _wire(rig)["unsigned"] >= 4, 2.0, "what is unsigned to be counted")
        assert not rig.simulation.robot.ready
        rig.tell(signing.arm)
        assert rig.simulation.robot.ready
    finally:
        signing.close()
        rig.close()


@pytest.mark.parametrize(
    "link",
    ["tcp:127.0.0.1:1", "udp:here", "udp:127.0.0.1:70000", "udp:127.0.0.1:1,to=x", "udp:127.0.0.1:1,system=255",
     "udp:127.0.0.1:1,camera=-1", "udp:127.0.0.1:1,speed=3", "udp:127.0.0.1:1,key=/no/such/file",
     "udp:127.0.0.1:1,loss_percent=x", "udp:127.0.0.1:1,loss_percent=101"],
)  # fmt: skip
def test_a_wrong_link_is_refused_in_one_line(link: str) -> None:
    with pytest.raises(FrontEndError, match=r"^--link [^\n]*$"):
        LinkOptions.parse(link)


def test_it_listens_on_the_loopback_by_default() -> None:
    assert LinkOptions.parse(None).bind[0] == "127.0.0.1"


def _switch(path: Path, **fault: object) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as asking:
        asking.sendto(json.dumps(fault).encode(), str(path))


@pytest.mark.slow
def test_a_rover_is_driven_over_a_lossy_late_reordering_link() -> None:
    rig = open_rig("udp:127.0.0.1:0,loss_percent=30,jitter_ms=50,reorder_percent=20,duplicate_percent=20")
    try:
        rig.run(1.0, rig.client.get_ready)
        assert rig.client.is_ready()
        before = rig.place()
        rig.run(3.0, lambda: rig.client.drive(0.3, 0.0))
        assert math.dist(before, rig.place()) > 0.5
    finally:
        rig.close()


def test_an_impairment_is_switched_while_it_runs(tmp_path: Path) -> None:
    rig = open_rig(faults=tmp_path / "faults")
    try:
        rig.make_ready()
        _switch(tmp_path / "faults", fault="loss_percent", value=100)
        rig.run(0.2)
        sent = _wire(rig)["sent"]
        rig.run(0.5)
        assert _wire(rig)["sent"] == sent
        _switch(tmp_path / "faults", fault="loss_percent", on=False)
        rig.run(0.3)
        assert _wire(rig)["sent"] > sent + 5
    finally:
        rig.close()


def test_a_button_and_a_dead_radio_are_switched_from_outside(tmp_path: Path) -> None:
    path = tmp_path / "faults"
    rig = open_rig(faults=path)
    try:
        rig.make_ready()
        sent = _wire(rig)["sent"]
        _switch(path, fault="mute")
        rig.run(0.5)
        assert _wire(rig)["sent"] - sent <= 1
        _switch(path, fault="clear")
        rig.run(0.2)
        assert _wire(rig)["sent"] - sent > 5
        _switch(path, fault="button")
        rig.run(0.2)
        assert not rig.simulation.robot.ready
        rig.until(lambda: not _client(rig).armed, 1.0, "the station sees that it is stopped")
    finally:
        rig.close()
    assert not path.exists()
