"""The Carter as a ROS 2 base through `edge-hil`'s front end: the contract of all protocols, and what is ROS 2's own."""

from __future__ import annotations

import json
import math
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from firmware_bridge.dds.bus import Bus, take_each
from firmware_bridge.ros2.messages.common import Twist_, Vector3_
from firmware_bridge.ros2.messages.navigation import Odometry_, TFMessage_
from firmware_bridge.ros2.messages.sensors import BatteryState_, Imu_
from firmware_bridge.ros2.report import attitude, battery_state, robot_state
from sim_hil.protocols.front_end import FrontEndError
from sim_hil.protocols.ros2.front_end import Ros2FrontEnd, open_front_end
from sim_hil.protocols.ros2.topics import camera_info
from sim_hil.simulation.physics import Simulation
from tests.support.robot.front_end_contract import FrontEndContract, Report, Rig, options

pytestmark = pytest.mark.process


class TwistClient:
    """A node that shares the front end's participant: DDS allows one domain a process."""

    def __init__(self, bus: Bus) -> None:
        self.reports: list[Report] = []
        self._commands = bus.writer("rt/cmd_vel", Twist_, depth=16)
        self._odometry = bus.reader("rt/odom", Odometry_, depth=500)

    def poll(self) -> None:
        for sample in take_each(self._odometry, limit=1000):
            state = robot_state(sample, time.monotonic_ns(), "body")
            assert state is not None
            self.reports.append(Report(state.robot_stamp_ns / 1e9, *state.T_odom_base, state.vx_mps))

    def get_ready(self) -> None:
        self.drive(0.0, 0.0)

    def is_ready(self) -> bool:
        """Such a base has no modes: it is ready once it reports."""
        return bool(self.reports)

    def drive(self, vx_mps: float, wz_radps: float) -> None:
        self._commands.write(Twist_(Vector3_(vx_mps, 0.0, 0.0), Vector3_(0.0, 0.0, wz_radps)))

    def stop(self) -> None:
        self.drive(0.0, 0.0)

    def emergency_stop(self) -> None:
        raise NotImplementedError("ROS 2 has no message for it")

    def send_garbage(self) -> None:
        self.drive(math.nan, 0.0)

    def close(self) -> None:
        pass


def open_rig(domain: int, **changes: object) -> Rig:
    asked = options("carter", domain=domain, **changes)
    simulation = Simulation(asked.scene, people=0, seed=0, robot="carter")
    front_end = open_front_end(simulation, asked)
    assert isinstance(front_end, Ros2FrontEnd)
    return Rig(simulation, front_end, TwistClient(front_end.bus))


class TestContract(FrontEndContract):
    @pytest.fixture
    def rig(self, dds_domain: int) -> Iterator[Rig]:
        rig = open_rig(dds_domain)
        yield rig
        rig.close()

    def test_an_emergency_stop_stops_it_and_lasts(self, dds_domain: int, tmp_path: Path) -> None:  # type: ignore[override]
        """By the button on the base: the topics have no emergency stop."""
        rig = open_rig(dds_domain, faults=tmp_path / "faults")
        try:
            rig.make_ready()
            rig.run(1.0, lambda: rig.tell(lambda: rig.client.drive(self.SPEED_MPS, 0.0)))
            switch(rig, tmp_path, "button", on=True)
            rig.run(1.5)
            where = rig.place()
            rig.run(1.5, lambda: rig.tell(lambda: rig.client.drive(self.SPEED_MPS, 0.0)))
            assert math.dist(where, rig.place()) < 0.05
            switch(rig, tmp_path, "button", on=False)
            rig.run(1.5, lambda: rig.tell(lambda: rig.client.drive(self.SPEED_MPS, 0.0)))
            assert math.dist(where, rig.place()) > 0.2
        finally:
            rig.close()
        assert not (tmp_path / "faults").exists()


def switch(rig: Rig, folder: Path, fault: str, *, on: bool) -> None:
    """Switch a fault of the front end and wait for its effect."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as asker:
        asker.bind(str(folder / f"asker-{on}"))
        asker.settimeout(10)
        asker.sendto(json.dumps({"fault": fault, "on": on}).encode(), str(folder / "faults"))
        rig.run(0.02)
        assert "effect_ns" in json.loads(asker.recv(2000))


@pytest.fixture
def rig(dds_domain: int) -> Iterator[Rig]:
    rig = open_rig(dds_domain)
    yield rig
    rig.close()


def bus_of(rig: Rig) -> Bus:
    assert isinstance(rig.front_end, Ros2FrontEnd)
    return rig.front_end.bus


def test_the_base_stops_by_itself_half_a_second_after_the_last_command(rig: Rig) -> None:
    rig.make_ready()
    rig.tell(lambda: rig.client.drive(0.4, 0.0))
    rig.run(0.49)
    assert rig.simulation.commanded[0] == pytest.approx(0.4)
    rig.run(0.02)
    assert rig.simulation.commanded == (0.0, 0.0, 0.0)


def test_every_topic_comes_at_its_rate_and_with_usable_content(rig: Rig) -> None:
    kinds = {"rt/odom": Odometry_, "rt/imu": Imu_, "rt/battery_state": BatteryState_, "rt/tf": TFMessage_}
    readers = {topic: bus_of(rig).reader(topic, kind, depth=500, reliable=True) for topic, kind in kinds.items()}
    got: dict[str, list[object]] = {topic: [] for topic in kinds}

    def take() -> None:
        for topic, reader in readers.items():
            got[topic] += list(take_each(reader, limit=1000))

    rig.run(2.0, take)
    time.sleep(0.2)
    take()
    assert {topic: len(samples) for topic, samples in got.items()} == {
        "rt/odom": 100, "rt/imu": 200, "rt/battery_state": 2, "rt/tf": 100,
    }  # fmt: skip
    assert attitude(got["rt/imu"][-1], 1) is not None  # type: ignore[arg-type]
    assert battery_state(got["rt/battery_state"][-1], 1) is not None  # type: ignore[arg-type]
    newest = got["rt/tf"][-1]
    assert isinstance(newest, TFMessage_)
    chain = [(one.header.frame_id, one.child_frame_id) for one in newest.transforms]
    assert chain == [("odom", "base_link"), ("base_link", "camera")]
    q = newest.transforms[1].transform.rotation
    assert (q.x, q.y, q.z, q.w) == pytest.approx((-0.5, 0.5, -0.5, 0.5))


def test_a_fault_silences_the_odometry_alone(dds_domain: int, tmp_path: Path) -> None:
    rig = open_rig(dds_domain, faults=tmp_path / "faults")
    imu = bus_of(rig).reader("rt/imu", Imu_, depth=500)
    try:
        rig.make_ready()
        switch(rig, tmp_path, "odometry_off", on=True)
        rig.client.poll()
        rig.client.reports.clear()
        list(take_each(imu, limit=1000))
        rig.run(1.0)
        rig.client.poll()
        assert rig.client.reports == [] and len(list(take_each(imu, limit=1000))) > 10
    finally:
        rig.close()


def test_the_intrinsics_are_those_of_the_simulated_lens() -> None:
    info = camera_info(320, 180, 1.5)
    assert 2 * math.atan(160 / info.k[0]) == pytest.approx(math.radians(100))
    assert (info.k[2], info.k[5], info.header.frame_id) == (160, 90, "camera")


def test_a_go2_is_refused(dds_domain: int) -> None:
    asked = options("go2", domain=dds_domain)
    simulation = Simulation(asked.scene, people=0, seed=0)
    with pytest.raises(FrontEndError, match="expected the Carter, found a Go2"):
        open_front_end(simulation, asked)
    simulation.close()
