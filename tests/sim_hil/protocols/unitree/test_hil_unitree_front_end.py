"""The Unitree front end keeps the contract of all front ends."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from firmware_bridge.dds.bus import Bus, take_each
from firmware_bridge.unitree.messages import ids
from firmware_bridge.unitree.messages.idl import SportModeState_
from firmware_bridge.unitree.report import robot_state
from firmware_bridge.unitree.rpc import RpcClient, move_parameter
from sim_hil.protocols.unitree import front_end
from sim_hil.protocols.unitree.front_end import UnitreeFrontEnd, open_front_end
from sim_hil.simulation.physics import Simulation
from tests.support.processes import wait_for
from tests.support.robot.front_end_contract import FrontEndContract, Report, Rig, options

pytestmark = pytest.mark.process


class UnitreeClient:
    """A client of the sport service that shares the front end's participant: DDS allows one a process."""

    def __init__(self, bus: Bus) -> None:
        self.reports: list[Report] = []
        self._mode = -1
        self._sport = RpcClient(bus, ids.SPORT_SERVICE)
        self._states = bus.reader(ids.SPORT_STATE_TOPIC, SportModeState_, depth=500)
        wait_for(self._sport.connected, 10, "the sport service")

    def poll(self) -> None:
        for sample in take_each(self._states, limit=1000):
            state = robot_state(sample, time.monotonic_ns(), "odom")
            assert state is not None
            self._mode = state.mode
            self.reports.append(Report(state.robot_stamp_ns / 1e9, *state.T_odom_base, state.vx_mps))

    def get_ready(self) -> None:
        self._sport.send(ids.RECOVERY_STAND)

    def is_ready(self) -> bool:
        return self._mode in (ids.MODE_BALANCE_STAND, ids.MODE_LOCOMOTION)

    def drive(self, vx_mps: float, wz_radps: float) -> None:
        self._sport.send(ids.MOVE, move_parameter(vx_mps, 0.0, wz_radps), noreply=True)

    def stop(self) -> None:
        self._sport.send(ids.STOP_MOVE)

    def emergency_stop(self) -> None:
        self._sport.send(ids.DAMP)

    def send_garbage(self) -> None:
        self._sport.send(ids.MOVE, "x" * 5000)

    def close(self) -> None:
        pass


class TestUnitree(FrontEndContract):
    @pytest.fixture
    def rig(self, dds_domain: int) -> Iterator[Rig]:
        asked = options("go2", domain=dds_domain)
        simulation = Simulation(asked.scene, people=0, seed=0)
        front_end = open_front_end(simulation, asked)
        assert isinstance(front_end, UnitreeFrontEnd)
        rig = Rig(simulation, front_end, UnitreeClient(front_end.bus))
        yield rig
        rig.close()


def test_opened_resources_are_closed_in_reverse_if_a_later_step_fails(
    dds_domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed: list[str] = []

    class Camera:
        def __init__(self, *_args: object, **_more: object) -> None: ...

        def close(self) -> None:
            closed.append("camera")

    def fails(*_args: object, **_more: object) -> None:
        raise ValueError("no publishers")

    close_bus = front_end.Bus.close
    monkeypatch.setattr(front_end.Bus, "close", lambda bus: (closed.append("bus"), close_bus(bus)))
    monkeypatch.setattr(front_end, "RenderProcess", Camera)
    monkeypatch.setattr(front_end, "StatePublishers", fails)
    asked = options("go2", domain=dds_domain, camera_size=(64, 48), faults=tmp_path / "faults")
    simulation = Simulation(asked.scene, people=0, seed=0)
    with pytest.raises(ValueError, match="no publishers"):
        open_front_end(simulation, asked)
    simulation.close()
    assert closed == ["camera", "bus"] and not (tmp_path / "faults").exists()
