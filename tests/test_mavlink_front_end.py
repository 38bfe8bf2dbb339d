"""The Carter on MAVLink through `edge-hil`'s front end: the contract of all protocols, over a UDP socket."""

from __future__ import annotations

from collections.abc import Iterator
from math import atan2

import pytest

from sim_hil.mavlink.client import MavlinkClient
from sim_hil.mavlink.front_end import MavlinkFrontEnd, open_front_end
from sim_hil.mavlink.modes import Mode
from sim_hil.simulation import Simulation
from tests.front_end_contract import FrontEndContract, Report, Rig, options


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
