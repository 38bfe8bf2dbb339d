"""The bridge's rules and its MAVLink session against the simulated rover: arming, driving and every way to lose it."""

from __future__ import annotations

import itertools
import random
from collections.abc import Iterable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect
from pymavlink.dialects.v20 import common

from firmware_bridge.core.link import Arm
from firmware_bridge.mavlink.session import ARM_DISARM, SET_MODE
from sim_hil.protocols.mavlink.autopilots import ARDUPILOT
from sim_hil.protocols.mavlink.vehicle import Mode
from tests.support.robot.rover_bench import MS, ROBOTS, RoverBench, command, lost, robot_file, whole

KEY, OTHER_KEY = bytes(range(32)), bytes(32)
AUTOPILOTS = {
    "px4": robot_file(),
    "ardupilot": robot_file(ROBOTS / "rover_ardupilot.toml", link="udp:127.0.0.1:14580"),
}
FOREIGN = {
    "mode": common.MAVLink_set_mode_message(1, 1, 4 << 16),
    "setpoint": common.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, 8, 1479, 0, 0, 0, 0.5, 0, 0, 0, 0, 0, 0, 0
    ),
    "sticks": common.MAVLink_manual_control_message(1, 500, 0, 0, 0, 0),
    "arming": common.MAVLink_command_long_message(1, 1, ARM_DISARM, 0, 1, 0, 0, 0, 0, 0, 0),
    "mission": common.MAVLink_command_int_message(1, 1, 0, 300, 0, 0, 0, 0, 0, 0, 0, 0, 0),
}  # fmt: skip


class Radio:
    """A radio that loses, repeats and reorders packets."""

    def __init__(self, seed: int, loss: float, again: float = 0.0, late: float = 0.0) -> None:
        self._random, self._loss, self._again, self._late = random.Random(seed), loss, again, late
        self._held: list[bytes] = []

    def __call__(self, packet: bytes) -> Iterable[bytes]:
        if self._random.random() < self._loss:
            return []
        if self._random.random() < self._late:
            self._held.append(packet)
            return []
        packets, self._held = [packet, *self._held], []
        return packets + packets[:1] * (self._random.random() < self._again)


def setpoints(bench: RoverBench, since_ns: int = 0) -> list[tuple[int, float]]:
    return [(at, m.vx) for at, m in bench.sent if at >= since_ns and m.get_type().startswith("SET_POSITION")]


def driving(autopilot: str = "px4") -> RoverBench:
    bench = RoverBench(AUTOPILOTS[autopilot])
    bench.drive()
    return bench


class TestArming:
    @pytest.mark.parametrize("autopilot", list(AUTOPILOTS))
    def test_it_arms_and_drives(self, autopilot: str) -> None:
        bench = driving(autopilot)
        assert bench.mode is Mode.OFFBOARD and bench.node.vehicle.armed

    def test_an_idle_bridge_sends_heartbeats_and_neither_setpoints_nor_motion_commands(self) -> None:
        bench = RoverBench()
        bench.asking = False
        bench.run(5.0)
        beats = [at for at, message in bench.sent if message.get_type() == "HEARTBEAT"]
        assert 9 <= len(beats) <= 11 and not setpoints(bench)
        assert not bench.commands(SET_MODE) and not bench.commands(ARM_DISARM)

    def test_px4_gets_a_second_of_setpoints_at_2_hz_or_more_before_the_mode(self) -> None:
        bench = driving()
        first = next(at for at, m in bench.sent if m.get_type() == "COMMAND_LONG" and m.command == SET_MODE)
        before = [at for at, _ in setpoints(bench) if at <= first]
        assert first - before[0] >= 1000 * MS
        assert max(b - a for a, b in itertools.pairwise(before)) <= 500 * MS

    @pytest.mark.slow
    @given(seed=st.integers(0, 2**32 - 1))
    @settings(max_examples=15)
    def test_it_arms_over_a_radio_that_loses_30_percent(self, seed: int) -> None:
        bench = RoverBench()
        bench.to_rover, bench.to_bridge = Radio(seed, 0.3), Radio(seed + 1, 0.3)
        bench.drive(timeout_s=30.0)
        assert bench.node.vehicle.armed

    @pytest.mark.slow
    @given(seed=st.integers(0, 2**32 - 1))
    @settings(max_examples=15)
    def test_repeated_and_reordered_packets_stop_no_drive(self, seed: int) -> None:
        bench = RoverBench()
        bench.to_rover, bench.to_bridge = Radio(seed, 0, 0.3, 0.3), Radio(seed + 1, 0, 0.3, 0.3)
        bench.drive(timeout_s=30.0)
        assert bench.run(3.0).state == "armed"

    def test_a_denied_command_reaches_the_operator_with_the_autopilots_reason(self) -> None:
        bench = RoverBench()
        bench.charge = 10.0  # enough for the bridge, too little for the rover
        bench.speed = (0.5, 0.0)
        bench.run(6.0)
        assert not bench.node.vehicle.armed
        expected = "the rover answered COMPONENT_ARM_DISARM: failed, reason: Arming denied: battery low (10 %)"
        assert expected in bench.lines

    def test_a_wrong_autopilot_is_refused_by_name(self) -> None:
        bench = RoverBench(AUTOPILOTS["px4"])
        bench.node.autopilot = ARDUPILOT
        bench.speed = (0.5, 0.0)
        bench.until(lambda: bench.status is not None and bench.status.cause == "wrong_robot", 20.0, "a refusal")
        assert bench.status is not None and "is ardupilot, the robot file expects px4" in bench.status.reason


class TestTakeover:
    @pytest.mark.parametrize("autopilot", list(AUTOPILOTS))
    def test_the_pilots_switch_ends_the_drive_in_the_step_that_sees_it(self, autopilot: str) -> None:
        bench = driving(autopilot)
        since_ns = bench.now_ns
        bench.node.vehicle.pilot = True
        bench.run(1.0)
        moving = [at for at, vx in setpoints(bench, since_ns) if vx]
        assert bench.status is not None and bench.status.cause == "estop"
        assert all(at - since_ns <= 20 * MS for at in moving)

    @pytest.mark.slow
    @pytest.mark.parametrize("autopilot", list(AUTOPILOTS))
    def test_after_the_pilots_switch_only_an_operators_arm_drives_the_rover_again(self, autopilot: str) -> None:
        bench = driving(autopilot)
        bench.node.vehicle.pilot = True
        bench.run(2.0)
        bench.node.vehicle.pilot = False
        bench.ground(command(SET_MODE, 1, *map(float, Mode.HOLD.value)))
        bench.asking = True
        assert bench.run(10.0).state != "armed"
        bench.operator = [Arm()]
        bench.until(lambda: bench.status is not None and bench.status.state == "armed", 10.0, "armed by the operator")

    @pytest.mark.slow
    @pytest.mark.parametrize("autopilot", list(AUTOPILOTS))
    def test_after_the_pilots_switch_no_mode_is_requested(self, autopilot: str) -> None:
        bench = driving(autopilot)
        since_ns = bench.now_ns
        bench.node.vehicle.pilot = True
        bench.run(10.0)
        assert bench.mode is Mode.MANUAL and not bench.commands(SET_MODE, since_ns)

    def test_the_bridge_does_not_arm_while_a_pilot_drives(self) -> None:
        bench = driving()
        bench.node.vehicle.pilot = True
        bench.asking = True
        bench.run(5.0)
        assert bench.mode is Mode.MANUAL and bench.status is not None and bench.status.state != "armed"

    def test_after_a_failsafe_of_the_rover_no_operator_is_needed(self) -> None:
        bench = driving("px4")
        bench.to_rover = lost
        bench.until(lambda: bench.mode is Mode.HOLD, 5.0, "the rover's failsafe")
        bench.to_rover = whole
        bench.asking = True
        bench.until(lambda: bench.mode is Mode.OFFBOARD, 10.0, "an arming")
        bench.drive()

    @pytest.mark.slow
    def test_a_new_run_ends_no_mission_without_an_operators_arm(self) -> None:
        bench = RoverBench()
        bench.asking = False
        bench.run(2.0)
        bench.to_bridge = lambda packet: () if packet[7:10] == b"\0\0\0" else (packet,)  # no heartbeat of its own

        def drive_the_mission(seconds: int) -> None:
            for _ in range(seconds):
                bench.arrive(bench.pack(common.MAVLink_heartbeat_message(10, 12, 128, 4 << 16 | 4 << 24, 4, 3)))
                bench.run(1.0)

        drive_the_mission(2)
        bench.asking = True
        drive_the_mission(5)
        assert bench.status is not None and bench.status.permit == "needed"
        assert not bench.commands(SET_MODE) and not bench.commands(ARM_DISARM)
        bench.operator = [Arm()]
        drive_the_mission(10)
        assert bench.commands(SET_MODE)

    @pytest.mark.parametrize("mode", [Mode.MANUAL, Mode.HOLD])
    def test_a_mode_of_a_ground_station_ends_the_drive_and_stays(self, mode: Mode) -> None:
        bench = driving()
        since_ns = bench.now_ns
        bench.ground(command(SET_MODE, 1, *map(float, mode.value)))
        bench.run(3.0)
        assert not any(vx for at, vx in setpoints(bench, since_ns + 20 * MS))
        assert bench.mode is mode and bench.status is not None and bench.status.state == "stopped"

    def test_the_bridge_leaves_a_ground_stations_mode_alone_also_when_the_acknowledgement_comes_first(self) -> None:
        bench = driving()
        since_ns = bench.now_ns
        bench.to_bridge = lambda packet: () if packet[7:10] == b"\0\0\0" else (packet,)  # no heartbeat
        bench.ground(command(SET_MODE, 1, 1, 0))
        bench.run(1.0)
        bench.to_bridge = whole
        bench.run(1.0)
        assert bench.mode is Mode.MANUAL and not bench.commands(SET_MODE, since_ns)

    @pytest.mark.parametrize("name", ["mode", "arming", "mission"])
    def test_the_bridge_requests_no_mode_after_another_stations_command(self, name: str) -> None:
        bench = driving()
        since_ns = bench.now_ns
        bench.arrive(bench.pack(FOREIGN[name], system=255, component=190))
        bench.run(3.0)
        assert not bench.commands(SET_MODE, since_ns)

    def test_a_denied_command_of_another_station_leaves_the_rover_in_hold(self) -> None:
        bench = driving()
        bench.ground(command(ARM_DISARM, 0))
        bench.run(1.0)
        assert bench.mode is Mode.HOLD

    def test_after_a_ground_stations_hold_an_operators_arm_drives_again(self) -> None:
        bench = driving()
        bench.ground(command(SET_MODE, 1, 4, 3))
        bench.asking = True
        bench.run(5.0)
        assert bench.status is not None and bench.status.permit == "needed"
        bench.operator = [Arm()]
        bench.drive()

    @pytest.mark.parametrize("name", list(FOREIGN))
    def test_a_second_commanders_own_packet_ends_the_drive(self, name: str) -> None:
        bench = driving()
        bench.arrive(bench.pack(FOREIGN[name], system=255, component=190))
        status = bench.step()
        assert (status.state, status.cause) == ("stopped", "second_commander") and "255/190" in status.reason

    def test_a_second_commander_is_seen_by_the_acknowledgement_that_it_gets(self) -> None:
        bench = driving()
        bench.ground(command(ARM_DISARM, 0))  # denied, and acknowledged on every link
        status = bench.run(0.04)
        assert status.cause == "second_commander" and "COMPONENT_ARM_DISARM of station 255/" in status.reason

    def test_ground_stations_may_watch(self) -> None:
        bench = driving()
        watching = (
            common.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3),
            common.MAVLink_param_request_list_message(1, 1),
            command(511, 30, 100_000),
            command(512, 148),
        )
        for _ in range(20):
            bench.ground(*watching)
            for message in watching:
                bench.arrive(bench.pack(message, system=255, component=190))
            bench.run(0.1)
        assert bench.status is not None and bench.status.state == "armed"

    def test_a_second_sender_with_the_bridges_number_is_a_second_publisher(self) -> None:
        bench = driving()
        bench.arrive(bench.pack(common.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3), system=1, component=191))
        assert bench.step().cause == "second_publisher"


class TestOtherSystems:
    @pytest.mark.slow
    @given(system=st.integers(2, 255))
    @settings(max_examples=15)
    def test_values_of_another_system_change_nothing(self, system: int) -> None:
        bench = driving()
        before = bench.session.odometry.dropped, bench.session.watch.mode
        for message in (
            common.MAVLink_heartbeat_message(10, 12, 0, 1 << 16, 3, 3),
            common.MAVLink_command_ack_message(ARM_DISARM, 0, 0, 0, 1, 191),
            common.MAVLink_sys_status_message(0, 0, 0, 0, 24000, 0, 1, 0, 0, 0, 0, 0, 0),
            common.MAVLink_attitude_message(0, 1.5, 1.5, 0, 0, 0, 0),
        ):
            bench.arrive(bench.pack(message, system=system))
        assert bench.step().state == "armed" and (bench.session.odometry.dropped, bench.session.watch.mode) == before


class TestFailures:
    def test_an_estimator_without_position_stops_the_rover(self) -> None:
        bench = driving()
        bench.arrive(bench.pack(common.MAVLink_estimator_status_message(0, 1 | 2, 0, 0, 0, 0, 0, 0, 0, 0)))
        assert bench.run(0.1).cause == "robot_error"

    def test_a_gps_glitch_stops_the_rover(self) -> None:
        bench = driving()
        flags = 1 | 2 | 16 | 1024
        bench.arrive(bench.pack(common.MAVLink_estimator_status_message(0, flags, 0, 0, 0, 0, 0, 0, 0, 0)))
        assert bench.run(0.1).cause == "robot_error"

    def test_a_silent_rover_gets_zero_after_the_deadmans_time_and_a_stop_after_a_second(self) -> None:
        bench = driving()
        since_ns = bench.now_ns
        bench.to_bridge = lost
        bench.run(1.5)
        assert not any(vx for at, vx in setpoints(bench, since_ns + 300 * MS))
        assert bench.status is not None and bench.status.cause == "state_silent"

    @pytest.mark.slow
    def test_missing_heartbeats_stop_the_rover_although_odometry_arrives(self) -> None:
        bench = driving()
        bench.to_bridge = lambda packet: () if packet[7:10] == b"\0\0\0" else (packet,)
        assert bench.run(3.0).state == "armed"
        assert bench.run(1.0).cause == "robot_error"

    def test_a_rover_that_disarms_by_itself_ends_the_drive(self) -> None:
        bench = driving()
        bench.node.vehicle._disarm("test")
        assert bench.run(0.1).state == "stopped"

    @pytest.mark.parametrize("autopilot", list(AUTOPILOTS))
    def test_an_end_of_the_runner_stops_the_rover_and_leaves_it_in_hold(self, autopilot: str) -> None:
        bench = driving(autopilot)
        bench.client = False
        bench.run(1.0)
        assert bench.base.velocity == (0.0, 0.0, 0.0) and bench.mode is Mode.HOLD

    def test_the_bridges_last_packets_disarm_a_standing_rover(self) -> None:
        bench = driving()
        bench.client = False
        bench.run(1.0)
        bench.session.farewell(bench.now_ns)
        bench.flush()
        assert not bench.node.vehicle.armed

    def test_the_rover_itself_stops_when_the_bridge_is_dead(self) -> None:
        bench = driving()
        bench.to_rover = lost
        bench.run(0.7)
        assert bench.base.velocity == (0.0, 0.0, 0.0) and bench.mode is Mode.HOLD


class TestSigning:
    def test_a_signed_link_drives(self) -> None:
        bench = RoverBench(key=KEY)
        bench.drive()
        assert bench.session.reader.counts.unsigned == bench.reader.counts.unsigned == 0

    def test_two_different_keys_arm_nothing(self) -> None:
        bench = RoverBench(key=KEY, rover_key=OTHER_KEY)
        bench.speed = (0.5, 0.0)
        bench.run(10.0)
        assert not bench.node.vehicle.armed and bench.session.watch.mode is None

    @pytest.mark.slow
    @given(seed=st.integers(0, 2**32 - 1), late=st.integers(1, 200))
    @settings(max_examples=10)
    def test_replayed_packets_change_nothing(self, seed: int, late: int) -> None:
        bench, heard = RoverBench(key=KEY), []

        def with_replays(packet: bytes) -> Iterable[bytes]:
            heard.append(packet)
            return [*heard[-late:][:1], packet]

        bench.to_bridge = with_replays
        bench.drive()
        bench.run(2.0)
        assert bench.status is not None and bench.status.state == "armed" and bench.session.reader.counts.unsigned > 50

    @pytest.mark.parametrize("key", [None, OTHER_KEY])
    def test_forged_packets_change_nothing(self, key: bytes | None) -> None:
        bench = RoverBench(key=KEY)
        bench.drive()
        forger = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
        if key is not None:
            forger.signing.secret_key, forger.signing.sign_outgoing = key, True
            forger.signing.timestamp = 2**47
        heartbeat = common.MAVLink_heartbeat_message(10, 12, 0, 4 << 16, 6, 3)  # disarmed, in an emergency
        for _ in range(50):
            bench.arrive(bytes(heartbeat.pack(forger)))
            bench.step()
        assert bench.status is not None and bench.status.state == "armed"
        assert bench.session.reader.counts.unsigned == 50


def test_the_operator_gets_the_autopilots_texts() -> None:
    bench = RoverBench()
    bench.arrive(bench.pack(common.MAVLink_statustext_message(4, b"wheel speed high")))
    assert bench.lines == ["STATUSTEXT of the rover: wheel speed high"]


def test_a_flood_of_texts_is_thinned_for_the_operator() -> None:
    bench = RoverBench()
    for number in range(200):
        bench.arrive(bench.pack(common.MAVLink_statustext_message(4, f"text {number}".encode())))
        bench.step()
    assert 10 <= sum("text" in line for line in bench.lines) <= 10 + 3 * 4 + 1
