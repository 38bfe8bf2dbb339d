"""Who decides on a rover's mode: a pilot over the bridge, and an emergency stop at this computer over a mission."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import pytest
from pymavlink.dialects.v20 import common

from firmware_bridge.core.link import Arm, Stop
from firmware_bridge.mavlink.session import ARM_DISARM, SET_MODE
from sim_hil.protocols.mavlink.vehicle import Mode
from tests.support.robot.rover_bench import MS, ROBOTS, RoverBench, robot_file

AUTOPILOTS = {
    "px4": robot_file(),
    "ardupilot": robot_file(ROBOTS / "rover_ardupilot.toml", link="udp:127.0.0.1:14580"),
}
HEARTBEAT, ACKNOWLEDGEMENT = bytes(3), b"\x4d\0\0"
MANUAL, GUIDED, AUTO, RTL = 0, 15, 10, 11  # custom modes of ArduPilot
ACTIVE, CRITICAL = 4, 5


def kind_of(packet: bytes) -> bytes:
    return packet[7:10]


def once_a_second(bench: RoverBench, *, without: bytes = b"") -> Callable[[bytes], Iterable[bytes]]:
    """What an ArduPilot sends: one heartbeat a second, none at a change of mode; `without`: packets that are lost."""
    last_ns = [0]

    def arriving(packet: bytes) -> Iterable[bytes]:
        if kind_of(packet) == without or (kind_of(packet) == HEARTBEAT and bench.now_ns - last_ns[0] < 990 * MS):
            return ()
        last_ns[0] = bench.now_ns if kind_of(packet) == HEARTBEAT else last_ns[0]
        return (packet,)

    return arriving


def drive_requests(bench: RoverBench, since_ns: int = 0) -> int:
    drives = {GUIDED, Mode.OFFBOARD.value[0]}
    return sum(message.param2 in drives for message in bench.commands(SET_MODE, since_ns))


@pytest.mark.parametrize("autopilot", list(AUTOPILOTS))
@pytest.mark.parametrize("lost", [ACKNOWLEDGEMENT, b""], ids=["acknowledgements lost", "all arrive"])
@pytest.mark.parametrize("after_s", [0.1, 0.3, 0.6])
def test_a_pilot_who_switches_back_before_the_next_heartbeat_keeps_the_rover(
    autopilot: str, lost: bytes, after_s: float
) -> None:
    bench = RoverBench(AUTOPILOTS[autopilot])
    bench.speed = (0.5, 0.0)
    bench.to_bridge = once_a_second(bench, without=lost)
    bench.until(lambda: bench.mode is Mode.OFFBOARD, 20.0, "the setpoint mode")
    bench.run(after_s)
    bench.asking, bench.node.vehicle.pilot, since_ns = False, True, bench.now_ns
    bench.run(5.0)
    assert drive_requests(bench, since_ns) == 0 and bench.mode is Mode.MANUAL


def test_a_stop_before_the_first_heartbeat_of_the_setpoint_mode_is_no_takeover() -> None:
    bench = RoverBench(AUTOPILOTS["ardupilot"])
    bench.speed, bench.to_bridge = (0.5, 0.0), once_a_second(bench)
    bench.until(lambda: bench.mode is Mode.OFFBOARD, 20.0, "the setpoint mode")
    bench.run(0.1)
    bench.asking, bench.operator = False, [Stop()]
    bench.run(3.0)
    assert bench.mode is Mode.HOLD
    assert not any("changed without the bridge" in line for line in bench.lines)


@pytest.mark.parametrize("number", [SET_MODE, ARM_DISARM])
def test_a_command_that_is_lost_is_sent_again_once_a_heartbeat_shows_no_effect(number: int) -> None:
    bench, lost = RoverBench(AUTOPILOTS["ardupilot"]), []

    def first_is_lost(packet: bytes) -> Iterable[bytes]:
        found = [each for each in bench.commands(number) if each not in lost]
        if found and not lost and kind_of(packet) == b"\x4c\0\0":
            lost.extend(found)
            return ()
        return (packet,)

    bench.to_bridge, bench.to_rover = once_a_second(bench), first_is_lost
    bench.drive(timeout_s=10.0)
    assert len(lost) == 1


class Heartbeats:
    """A rover whose heartbeats are those of the test."""

    def __init__(self) -> None:
        self.bench = RoverBench(AUTOPILOTS["ardupilot"])
        self.bench.drive()
        self.bench.to_bridge = lambda packet: () if kind_of(packet) == HEARTBEAT else (packet,)

    def beat(self, mode: int, status: int = ACTIVE, seconds: float = 1.0) -> None:
        self.bench.arrive(self.bench.pack(common.MAVLink_heartbeat_message(10, 3, 128 | 1, mode, status, 3)))
        self.bench.run(seconds)

    def press(self, mode: int, status: int = ACTIVE) -> list[float]:
        """Press the emergency stop; the modes that the bridge requests in the three seconds after it."""
        since_ns = self.bench.now_ns
        self.bench.operator = [Stop()]
        for _ in range(3):
            self.beat(mode, status)
        return [message.param2 for message in self.bench.commands(SET_MODE, since_ns)]


HOLD = 4


@pytest.mark.parametrize(("mode", "status"), [(AUTO, ACTIVE), (RTL, CRITICAL)], ids=["mission", "failsafe"])
def test_an_operators_stop_ends_a_mode_in_which_the_autopilot_drives(mode: int, status: int) -> None:
    rover = Heartbeats()
    rover.beat(GUIDED)
    rover.beat(mode, status)
    assert set(rover.press(mode, status)) == {HOLD}


@pytest.mark.parametrize(("mode", "status"), [(AUTO, ACTIVE), (RTL, CRITICAL)], ids=["mission", "failsafe"])
def test_a_mode_in_which_the_autopilot_drives_is_ended_as_long_as_the_local_input_is_held(
    mode: int, status: int
) -> None:
    rover = Heartbeats()
    rover.beat(GUIDED)
    rover.bench.speed, rover.bench.estop = None, True
    rover.beat(HOLD)
    rover.beat(HOLD, seconds=0.1)
    for _ in range(6):
        since_ns = rover.bench.now_ns
        rover.beat(mode, status, seconds=1.1)
        assert {message.param2 for message in rover.bench.commands(SET_MODE, since_ns)} == {HOLD}


def test_a_pilot_keeps_the_sticks_while_the_local_input_is_held() -> None:
    rover = Heartbeats()
    rover.beat(GUIDED)
    rover.bench.speed, rover.bench.estop = None, True
    rover.beat(HOLD)
    since_ns = rover.bench.now_ns
    for _ in range(3):
        rover.beat(MANUAL)
    assert rover.bench.commands(SET_MODE, since_ns) == []


def test_an_operators_stop_leaves_a_pilot_the_sticks() -> None:
    rover = Heartbeats()
    rover.beat(GUIDED)
    rover.beat(MANUAL)
    assert rover.press(MANUAL) == []


def armed_again_without_a_step() -> Heartbeats:
    """A pilot has taken over, brought the rover back to the setpoint mode, and an operator has armed."""
    rover = Heartbeats()
    rover.beat(GUIDED)
    rover.beat(MANUAL)
    rover.bench.base.command(0.0, 0.0, 0.0)
    rover.bench.speed = None
    for _ in range(4):
        rover.beat(GUIDED)
    rover.bench.asking = True
    rover.beat(GUIDED, seconds=1.1)
    rover.bench.operator, rover.bench.speed = [Arm()], (0.5, 0.0)
    rover.beat(GUIDED)
    rover.bench.asking = False
    rover.beat(GUIDED)
    assert rover.bench.status is not None and rover.bench.status.state == "armed"
    return rover


def test_a_stop_of_a_rover_that_was_ready_when_it_was_armed_holds_it() -> None:
    assert set(armed_again_without_a_step().press(GUIDED)) == {HOLD}


def test_the_last_packets_hold_a_rover_that_was_ready_when_it_was_armed() -> None:
    bench = armed_again_without_a_step().bench
    bench.session.outgoing()
    bench.session.farewell(bench.now_ns)
    assert bench.session.outgoing()


@pytest.mark.parametrize("autopilot", list(AUTOPILOTS))
@pytest.mark.parametrize("after_s", [0.0, 0.3])
def test_the_last_packets_disarm_a_rover_that_was_armed_since_its_last_heartbeat(
    autopilot: str, after_s: float
) -> None:
    bench = RoverBench(AUTOPILOTS[autopilot])
    bench.speed, bench.to_bridge = (0.5, 0.0), once_a_second(bench)
    bench.until(lambda: bool(bench.commands(ARM_DISARM)), 25.0, "an arm command")
    if after_s:
        bench.run(after_s)
    bench.session.farewell(bench.now_ns)
    bench.flush()
    assert bench.mode is Mode.HOLD and not bench.node.vehicle.armed


@pytest.mark.parametrize("autopilot", list(AUTOPILOTS))
def test_the_last_packets_leave_a_pilot_a_rover_that_was_armed_since_its_last_heartbeat(autopilot: str) -> None:
    bench = RoverBench(AUTOPILOTS[autopilot])
    bench.speed, bench.to_bridge = (0.5, 0.0), once_a_second(bench)
    bench.until(lambda: bool(bench.commands(ARM_DISARM)), 25.0, "an arm command")
    bench.speed, bench.client = None, False
    bench.run(0.1)
    bench.base.command(0.8, 0.0, 0.0)
    bench.run(0.2)
    before = len(bench.sent)
    bench.session.farewell(bench.now_ns)
    bench.flush()
    assert bench.sent[before:] == []
