"""The Carter on CAN through `edge-hil`'s front end: the contract of all protocols, and what is CAN's own."""

from __future__ import annotations

import itertools
import json
import math
import socket
import stat
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from firmware_bridge.can.buses import BusAddress, open_bus
from firmware_bridge.can.frame import Frame
from sim_hil.protocols.can import frames
from sim_hil.protocols.can.buses import BusLink
from sim_hil.protocols.can.client import CanClient
from sim_hil.protocols.can.front_end import LinkOptions, open_front_end
from sim_hil.protocols.front_end import FrontEndError
from sim_hil.simulation.physics import Simulation
from tests.support.robot.front_end_contract import FrontEndContract, Report, Rig, options

_numbers = itertools.count()


class ContractClient:
    """The contract's client: commands as `CanClient` sends them, a heartbeat whenever it takes in what has arrived."""

    def __init__(self, address: BusAddress) -> None:
        self.link = BusLink(open_bus(address))
        self.can = CanClient(self.link)
        self.reports: list[Report] = []
        self._read_count = 0

    def poll(self) -> None:
        self.can.heartbeat()
        self.can.poll()
        self.reports += [
            Report(one.stamp_s, one.x_m, one.y_m, one.heading_rad, one.vx_mps)
            for one in self.can.odometry[self._read_count :]
        ]
        self._read_count = len(self.can.odometry)

    def get_ready(self) -> None:
        self.can.heartbeat()
        self.can.heartbeat()
        self.can.arm()

    def is_ready(self) -> bool:
        return self.can.state == frames.STATE_ARMED

    def drive(self, vx_mps: float, wz_radps: float) -> None:
        self.can.drive(vx_mps, wz_radps)
        self.can.drive(vx_mps, wz_radps)  # the first frame after a pause is not obeyed

    def stop(self) -> None:
        self.drive(0.0, 0.0)

    def emergency_stop(self) -> None:
        self.can.stop()

    def send_garbage(self) -> None:
        self.link.send(Frame(272, b"\x00\x01\x02\x03\x04\x05"))

    def close(self) -> None:
        self.can.close()


class PatientRig(Rig):
    """Lets the wire keep up: the robot's time passes many times faster here than a serial line carries frames.

    It waits in both directions: 100 ms of the robot's time without a command stop the base, 500 ms without a heartbeat
    disarm it.
    """

    def run(self, seconds: float, each_tenth: Callable[[], object] = lambda: None) -> None:
        steps, tenth = round(seconds * self.simulation.rate_hz), self.simulation.rate_hz // 10
        while steps > 0:
            chunk = min(steps, tenth - self.steps % tenth)
            super().run(chunk / self.simulation.rate_hz, each_tenth)
            steps -= chunk
            _wait_until(lambda: not self.front_end.pending)  # type: ignore[attr-defined]

    def let_arrive(self) -> None:
        client, base = self.client.link, self.front_end._link  # type: ignore[attr-defined]
        _wait_until(lambda: not client.pending and base.received >= client.sent)


def _wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < deadline, "the wire did not carry what was sent"
        time.sleep(0.001)


def open_rig(link: str, client: BusAddress, **changes: object) -> Rig:
    asked = options("carter", link=link, **changes)
    simulation = Simulation(asked.scene, people=0, seed=0, robot="carter")
    front_end = open_front_end(simulation, asked)
    return PatientRig(simulation, front_end, ContractClient(client))


@pytest.mark.slow
class TestContractOnASerialLine(FrontEndContract):
    @pytest.fixture
    def rig(self, tmp_path: Path) -> Iterator[Rig]:
        path = tmp_path / "can"
        rig = open_rig(f"serial:{path}", BusAddress("serial", str(path)))
        yield rig
        rig.close()

    def test_a_command_that_is_not_repeated_ends(self, rig: Rig) -> None:
        """After 100 ms, as the base's frames promise: it has hardly begun to move by then."""
        rig.make_ready()
        rig.tell(lambda: rig.client.drive(self.SPEED_MPS, 0.0))
        start = rig.place()
        rig.run(0.09)
        assert rig.simulation.commanded[0] == pytest.approx(self.SPEED_MPS)
        rig.run(0.02)
        assert rig.simulation.commanded == (0.0, 0.0, 0.0)
        rig.run(0.5)
        assert rig.speed_mps() < 0.01
        assert 0.003 < math.dist(start, rig.place()) < 0.03


@pytest.fixture
def virtual() -> Iterator[Rig]:
    name = f"contract-{next(_numbers)}"
    rig = open_rig(f"virtual:{name}", BusAddress("virtual", name))
    yield rig
    rig.close()


def _can(rig: Rig) -> CanClient:
    client = rig.client
    assert isinstance(client, ContractClient)
    return client.can


def _counts(rig: Rig) -> dict[str, int]:
    counts: dict[str, int] = rig.front_end.summary()["wire"]["can"]  # type: ignore[index, assignment]
    return counts


@pytest.mark.slow
def test_a_link_with_faults_counts_them_and_still_drives(tmp_path: Path) -> None:
    path = tmp_path / "can"
    link = f"serial:{path},drop=0.1,corrupt=0.05,duplicate=0.05,delay=0.05,delay_s=0.03"
    rig = open_rig(link, BusAddress("serial", str(path)))
    try:

        def ready() -> bool:
            rig.client.get_ready()
            return rig.client.is_ready()

        rig.until(ready, 5.0, "armed in spite of the faults")
        start = rig.place()

        def keep_driving() -> None:
            for _ in range(5):
                rig.client.drive(0.4, 0.0)

        rig.run(3.0, keep_driving)
        assert math.dist(start, rig.place()) > 0.2
        counts = _counts(rig)
        assert counts["wrong_crc"] > 0 and counts["wrong_counter"] > 0 and counts["lost"] > 0
    finally:
        rig.close()


@pytest.fixture
def ask(tmp_path: Path) -> Iterator[tuple[Rig, Callable[..., dict[str, object]]]]:
    """A rig with --faults, and how to ask it for one."""
    name, path = f"contract-{next(_numbers)}", tmp_path / "faults"
    rig = open_rig(f"virtual:{name}", BusAddress("virtual", name), faults=path)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as asker:
        asker.bind(str(tmp_path / "asker"))
        asker.settimeout(10)

        def switch(**command: object) -> dict[str, object]:
            asker.sendto(json.dumps(command).encode(), str(path))
            rig.run(0.02)
            answer: dict[str, object] = json.loads(asker.recv(2000))
            return answer

        yield rig, switch
    rig.close()
    assert not path.exists()


def test_the_red_button_stops_it_and_a_reset_needs_it_released(ask: tuple[Rig, Callable[..., object]]) -> None:
    rig, switch = ask
    rig.make_ready()
    switch(fault="button", on=True)
    rig.until(lambda: _can(rig).state == frames.STATE_ESTOP, 2.0, "the emergency stop")
    rig.until(lambda: _can(rig).latest("EstopState")["Button"] == 1, 2.0, "the button")
    rig.tell(_can(rig).reset)
    rig.run(0.3)
    assert _can(rig).state == frames.STATE_ESTOP
    switch(fault="button", on=False)
    rig.tell(_can(rig).reset)
    rig.until(lambda: _can(rig).state == frames.STATE_IDLE, 2.0, "idle")


@pytest.mark.slow
def test_bus_off_stops_the_base_until_the_bus_is_on_again(ask: tuple[Rig, Callable[..., object]]) -> None:
    rig, switch = ask
    rig.make_ready()
    rig.run(0.5, lambda: rig.tell(lambda: rig.client.drive(0.4, 0.0)))
    switch(fault="bus_off", on=True)
    rig.run(0.5, lambda: rig.client.drive(0.4, 0.0))
    assert rig.simulation.commanded == (0.0, 0.0, 0.0) and rig.speed_mps() < 0.05
    switch(fault="bus_off", on=False)
    assert _counts(rig)["bus_offs"] == 1
    rig.run(0.2)
    rig.make_ready()


@pytest.mark.parametrize(
    "command",
    [{}, {"fault": "drip"}, {"fault": "drop"}, {"fault": "drop", "value": 2}, {"fault": "drop", "value": "x"},
     {"fault": "button", "on": 1}, {"fault": "drop", "value": 0.1, "colour": "red"}, {"fault": "button", "value": 1}],
)  # fmt: skip
def test_an_invalid_fault_request_is_answered_with_an_error(
    ask: tuple[Rig, Callable[..., dict[str, object]]], command: dict[str, object]
) -> None:
    assert "expected" in str(ask[1](**command)["error"])


@pytest.mark.slow
def test_a_fault_is_switched_on_and_off_and_all_are_cleared(ask: tuple[Rig, Callable[..., dict[str, object]]]) -> None:
    rig, switch = ask
    assert switch(fault="drop", value=1.0)["on"] is True
    rig.client.get_ready()
    rig.run(0.5)
    assert not rig.client.is_ready()
    switch(fault="clear")
    rig.make_ready()


@pytest.mark.parametrize(
    "link",
    [
        "",
        "can0",
        "slcan:x",
        "serial:",
        "serial:x,camera=99999",
        "serial:x,camera=a",
        "serial:x,drip=1",
        "virtual:x,drop=2",
    ],
)
def test_an_invalid_link_is_refused_in_one_line(link: str) -> None:
    with pytest.raises(FrontEndError) as caught:
        LinkOptions.parse(link)
    assert "\n" not in str(caught.value) and "expected" in str(caught.value)


def test_without_a_link_the_line_is_in_a_folder_of_this_user_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    folder = tmp_path / "tic-vla-edge"
    assert LinkOptions.parse(None).address == BusAddress("serial", str(folder / "carter-can"))
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


@pytest.mark.parametrize("kind", ["open", "link", "file"])
def test_a_folder_that_another_user_could_have_made_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    folder, elsewhere = tmp_path / "tic-vla-edge", tmp_path / "elsewhere"
    elsewhere.mkdir(mode=0o700)
    if kind == "open":
        folder.mkdir()
        folder.chmod(0o777)
    elif kind == "link":
        folder.symlink_to(elsewhere)
    else:
        folder.write_text("")
    with pytest.raises(FrontEndError, match=r"^[^\n]+; (remove it or )?give another --link$"):
        LinkOptions.parse(None)


def test_an_absent_bus_is_refused_in_one_line() -> None:
    asked = options("carter", link="socketcan:no-such-bus")
    simulation = Simulation(asked.scene, people=0, seed=0, robot="carter")
    try:
        with pytest.raises(FrontEndError, match=r"^CAN bus socketcan:no-such-bus: cannot be opened: .+$"):
            open_front_end(simulation, asked)
    finally:
        simulation.close()


def test_the_line_of_another_run_is_not_taken_and_a_dead_one_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "can"
    rig = open_rig(f"serial:{path}", BusAddress("serial", str(path)))
    try:
        assert stat.S_ISCHR(path.stat().st_mode)
        with pytest.raises(FrontEndError, match="another run"):
            open_rig(f"serial:{path}", BusAddress("serial", str(path)))
    finally:
        rig.close()
    assert not path.is_symlink()
    path.symlink_to("/dev/pts/no-such-terminal")
    rig = open_rig(f"serial:{path}", BusAddress("serial", str(path)))
    rig.close()
