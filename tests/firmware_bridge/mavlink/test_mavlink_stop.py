"""A stop while the bridge arms a rover: a drive mode requested before neither comes after the stop nor stays."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from firmware_bridge.core.link import Arm, Stop
from firmware_bridge.mavlink.session import SET_MODE
from sim_hil.protocols.mavlink.vehicle import Mode
from sim_hil.protocols.mavlink.wire import Message, Reader
from tests.support.robot.rover_bench import BRIDGE, ROBOTS, RoverBench, robot_file, whole

AUTOPILOTS = {
    "px4": robot_file(),
    "ardupilot": robot_file(ROBOTS / "rover_ardupilot.toml", link="udp:127.0.0.1:14580"),
}
DRIVE = {"px4": Mode.OFFBOARD.value[0], "ardupilot": 15}  # param2 of DO_SET_MODE


def waiting(autopilot: str) -> RoverBench:
    """A rover that drove and was stopped by an operator; a runner waits to be armed again."""
    bench = RoverBench(AUTOPILOTS[autopilot])
    bench.drive()
    bench.operator = [Stop()]
    bench.run(2.0)
    bench.asking = True
    bench.run(2.0)
    assert bench.mode is Mode.HOLD and bench.node.vehicle.armed
    return bench


def without_heartbeats(packet: bytes) -> Iterable[bytes]:
    """The rover's packets, but for its heartbeats, which tell its mode."""
    return () if packet[7:10] == bytes(3) else (packet,)


def begin_arming(bench: RoverBench) -> None:
    """An operator arms; the bridge has begun."""
    bench.operator = [Arm()]
    bench.until(lambda: bench.status is not None and bench.status.state == "arming", 3.0, "arming")


@pytest.mark.parametrize("autopilot", list(AUTOPILOTS))
@pytest.mark.parametrize(
    "armed_for_steps", [0, 2, 5, *(pytest.param(steps, marks=pytest.mark.slow) for steps in (1, 3, 4, 6, 7))]
)
@pytest.mark.parametrize("heartbeat", ["at once", "late"])
def test_no_drive_mode_is_requested_after_a_stop_and_the_rover_ends_in_hold(
    autopilot: str, armed_for_steps: int, heartbeat: str
) -> None:
    bench = waiting(autopilot)
    begin_arming(bench)
    bench.to_bridge = without_heartbeats if heartbeat == "late" else whole
    for _ in range(armed_for_steps):
        bench.step()
    bench.operator, bench.asking = [Stop()], False
    bench.step()
    since_ns = bench.now_ns + 1
    bench.run(0.5)
    bench.to_bridge = whole
    bench.run(3.5)
    assert DRIVE[autopilot] not in {message.param2 for message in bench.commands(SET_MODE, since_ns)}
    assert bench.mode is Mode.HOLD


def test_a_drive_mode_that_reaches_the_rover_after_the_hold_is_undone() -> None:
    late: list[Message] = []

    def delayed(packet: bytes) -> Iterable[bytes]:
        found = [each for each in Reader(None).read(packet) if getattr(each, "param2", None) == DRIVE["px4"]]
        late.extend(found)
        return () if found else (packet,)

    bench = waiting("px4")
    bench.to_rover = delayed
    begin_arming(bench)
    bench.until(lambda: len(late) > 0, 5.0, "a request of the drive mode")
    bench.operator, bench.asking, bench.to_rover = [Stop()], False, whole
    bench.run(0.2)
    bench.node.receive(late[0], BRIDGE, bench.now_s)
    assert bench.mode is Mode.OFFBOARD
    bench.run(4.0)
    assert bench.mode is Mode.HOLD
