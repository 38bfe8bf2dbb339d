"""What `edge-hil --faults` does to the robot's reports, without a bus: messages in, messages out."""

from __future__ import annotations

import json
import math
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.geometry import SE2
from sim_hil.protocols.unitree.fault_commands import KINDS, FaultCommand, FaultCommandError, parse
from sim_hil.protocols.unitree.fault_injector import FaultInjector
from sim_hil.protocols.unitree.odometry import DriftingOdometry, OdometryFrame
from sim_hil.protocols.unitree.state import LowStateMessage, Remote, sport_mode_state
from sim_hil.protocols.unitree.state_faults import StateFaults
from sim_hil.robots.battery import Battery, load_w
from sim_hil.robots.odometry_noise import LEVELS, NoiseLevel, OdometryNoise
from sim_hil.simulation.sensor_noise import SensorNoise
from tests.support.processes import REPOSITORY
from tests.support.robot.fake_go2 import standing

MS = 1_000_000
AT_ORIGIN = OdometryFrame((0.0, 0.0, 0.0))


def command(name: str, on: bool = True, **values: object) -> FaultCommand:
    return parse(json.dumps({"fault": name, "on": on, **values}).encode())


def state(x_m: float = 0.0, yaw_rad: float = 0.0, vx_mps: float = 0.0):
    truth = standing(
        position_m=np.array((x_m, 0.0, 0.3)),
        rpy_rad=np.array((0.0, 0.0, yaw_rad)),
        velocity_world_mps=np.array((vx_mps, 0.0, 0.0)),
    )
    return sport_mode_state(truth, AT_ORIGIN)


def faults_with(name: str, **values: object) -> StateFaults:
    faults = StateFaults()
    faults.set(command(name, **values), 0)
    return faults


@pytest.mark.parametrize("name", KINDS)
def test_every_fault_survives_its_request_line(name: str) -> None:
    assert parse(command(name).line()) == command(name)


@pytest.mark.parametrize(
    "line",
    [
        b"", b"[]", b"\xff", b"{" * 3000, b'{"fault": "rain"}', b'{"fault": "deaf", "on": 1}',
        b'{"fault": "deaf", "loud": 1}', b'{"fault": "state-loss", "percent": 101}',
        b'{"fault": "state-loss", "percent": NaN}', b'{"fault": "odometry-nan", "field": "soul"}',
        b'{"fault": ["deaf"]}', b'{"fault": "state-loss", "percent": 1' + b"0" * 400 + b"}",
    ],
)  # fmt: skip
def test_an_invalid_fault_line_is_refused(line: bytes) -> None:
    with pytest.raises(FaultCommandError):
        parse(line)


@given(st.binary(max_size=200))
def test_no_datagram_makes_the_parser_fail_otherwise(line: bytes) -> None:
    try:
        parse(line)
    except FaultCommandError:
        return


def test_a_jump_moves_the_pose_once_and_for_good() -> None:
    faults = faults_with("odometry-jump", dx_m=2.0, dtheta_rad=math.pi / 2)
    for _ in range(2):
        (out,) = faults.deliver(state(x_m=1.0), 0)
        assert out.position[0] == 3.0 and out.imu_state.rpy[2] == pytest.approx(math.pi / 2)
        assert out.imu_state.quaternion == pytest.approx([math.sqrt(0.5), 0, 0, math.sqrt(0.5)])


def test_a_frozen_odometry_repeats_the_first_state_of_the_fault() -> None:
    faults = faults_with("odometry-freeze")
    first, later = (faults.deliver(state(x_m=x, vx_mps=x), 0)[0] for x in (1.0, 2.0))
    assert later.position == first.position and later.velocity == first.velocity
    faults.set(command("odometry-freeze", on=False), 0)
    assert faults.deliver(state(x_m=3.0), 0)[0].position[0] == 3.0


def test_a_frozen_odometry_may_read_zero_velocity_and_an_old_stamp() -> None:
    faults = faults_with("odometry-freeze", velocity="zero", stamp="frozen")
    first, later = (faults.deliver(state(x_m=x, vx_mps=x), 0)[0] for x in (1.0, 2.0))
    assert later.velocity == [0.0, 0.0, 0.0] and later.stamp == first.stamp


def test_a_biased_velocity_grows_along_the_heading() -> None:
    faults = faults_with("odometry-bias", dv_mps=1.0)
    (out,) = faults.deliver(state(yaw_rad=math.pi / 2), 0)
    assert out.velocity == pytest.approx([0.0, 1.0, 0.0])


@pytest.mark.parametrize("field", ["position", "velocity", "rpy"])
def test_a_nan_is_in_the_requested_field(field: str) -> None:
    (out,) = faults_with("odometry-nan", field=field).deliver(state(), 0)
    poisoned = {"position": out.position, "velocity": out.velocity, "rpy": out.imu_state.rpy}
    assert [name for name, values in poisoned.items() if not all(map(math.isfinite, values))] == [field]


def test_a_late_state_is_sent_after_its_delay_or_when_the_fault_ends() -> None:
    faults = faults_with("odometry-lag", delay_s=0.3)
    first, second = state(1.0), state(2.0)
    assert faults.deliver(first, 0) == faults.deliver(second, 20 * MS) == []
    assert faults.due(299 * MS) == [] and faults.due(300 * MS) == [first]
    faults.set(command("odometry-lag", on=False), 301 * MS)
    assert faults.due(301 * MS) == [second]


def test_a_silent_robot_sends_neither_state() -> None:
    faults = faults_with("state-silent")
    assert faults.deliver(state(), 0) == [] and not faults.alter_low(LowStateMessage().message)


def test_half_the_states_are_lost() -> None:
    faults = faults_with("state-loss", percent=50)
    kept = sum(len(faults.deliver(state(), 0)) for _ in range(400))
    assert 150 < kept < 250


def test_states_are_swapped_or_sent_twice() -> None:
    faults = faults_with("state-reorder")
    first, second = state(1.0), state(2.0)
    assert faults.deliver(first, 0) == [] and faults.deliver(second, 0) == [second, first]
    assert faults_with("state-duplicate").deliver(first, 0) == [first, first]


def test_a_tipped_robot_reports_it_in_both_states() -> None:
    faults = faults_with("tip-over", pitch_rad=0.8)
    (out,) = faults.deliver(state(), 0)
    low = LowStateMessage().update(standing(), AT_ORIGIN)
    assert faults.alter_low(low)
    assert out.imu_state.rpy[1] == low.imu_state.rpy[1] == 0.8
    assert out.imu_state.quaternion == pytest.approx([math.cos(0.4), 0.0, math.sin(0.4), 0.0])


def test_a_fault_takes_effect_with_the_first_state_that_shows_it() -> None:
    faults = faults_with("odometry-bias")
    assert faults.effects() == []
    faults.deliver(state(), 7 * MS)
    assert faults.effects() == [("odometry-bias", 7 * MS)] and faults.effects() == []


def test_the_battery_empties_and_its_voltage_falls() -> None:
    battery = Battery(soc=0.5)
    first = battery.step(100.0, 1.0)
    later = battery.step(100.0, 3600.0)
    assert later.soc_percent < first.soc_percent < 50.0
    assert battery.step(100.0, 1.0).voltage_v < first.voltage_v
    assert battery.step(100.0, 1e9).soc_percent == 0.0


def test_a_braking_motor_does_not_charge_the_battery() -> None:
    still, braking, driving = (load_w(np.full(12, 5.0), np.full(12, speed)) for speed in (0.0, -2.0, 2.0))
    assert still == braking < driving


def test_a_low_battery_reads_the_same_in_every_message() -> None:
    faults, message = faults_with("low-battery", soc_percent=4.0), LowStateMessage().message
    assert faults.alter_low(message)
    once = message.power_v
    assert faults.alter_low(message) and message.power_v == once < 28.0 and message.bms_state.soc == 4


def drive(odometry: DriftingOdometry, metres: float):
    """A truth that has gone straight ahead, and the report of it."""
    for x_m in np.linspace(0.0, metres, round(metres / 0.02) + 1):
        truth = standing(position_m=np.array((x_m, 0.0, 0.3)), velocity_world_mps=np.array((1.0, 0.0, 0.0)),
                         time_s=1.0 + x_m)  # fmt: skip
        odometry.update(truth)
    return sport_mode_state(truth, odometry)


def test_without_noise_a_drifting_odometry_reports_the_truth() -> None:
    report = drive(DriftingOdometry((0.0, 0.0, 0.0), OdometryNoise(LEVELS["none"], 0)), 2.0)
    assert report.position[0] == pytest.approx(2.0) and report.velocity == pytest.approx([1.0, 0.0, 0.0])


def test_the_reported_velocity_is_that_of_the_reported_pose() -> None:
    noise = OdometryNoise(NoiseLevel(0.1, 0.2, correlation_m=100.0), 3)
    odometry = DriftingOdometry((0.0, 0.0, 0.0), noise)
    before = drive(odometry, 2.0)
    truth = standing(position_m=np.array((2.001, 0.0, 0.3)), velocity_world_mps=np.array((1.0, 0, 0)), time_s=3.001)
    odometry.update(truth)
    after = sport_mode_state(truth, odometry)
    moved = [(b - a) / 0.001 for a, b in zip(before.position, after.position, strict=True)]
    assert after.velocity == pytest.approx(moved, abs=2e-3)
    assert (after.imu_state.rpy[2] - before.imu_state.rpy[2]) / 0.001 == pytest.approx(after.yaw_speed, abs=1e-3)
    assert SE2(*before.position[:2], before.imu_state.rpy[2]) != SE2(2.0, 0.0, 0.0)


@pytest.fixture
def injector(tmp_path: Path):
    sent: list[bytes] = []
    remote = Remote()
    injector = FaultInjector(tmp_path / "faults", remote=remote, camera=sent.append)
    injector.sent, injector.remote = sent, remote
    client = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    client.bind(str(tmp_path / "client"))
    client.connect(str(tmp_path / "faults"))
    client.settimeout(1.0)
    yield injector, client
    client.close()
    injector.close()


def test_a_request_is_answered_when_the_fault_takes_effect(injector) -> None:
    server, client = injector
    client.send(command("odometry-bias").line())
    server.poll(1)
    server.states.deliver(state(), 5 * MS)
    server.poll(6 * MS)
    assert json.loads(client.recv(500)) == {"fault": "odometry-bias", "on": True, "effect_ns": 5 * MS}


def test_an_invalid_request_is_answered_with_an_error(injector) -> None:
    server, client = injector
    client.send(b"nonsense")
    server.poll(1)
    assert "expected a JSON object" in json.loads(client.recv(500))["error"]


def test_a_camera_fault_goes_to_the_camera_and_is_answered_by_its_effect(injector) -> None:
    server, client = injector
    client.send(command("camera-black").line())
    server.poll(1)
    assert server.sent == [command("camera-black").line()]
    server.took_effect("camera-black", 9 * MS)
    assert json.loads(client.recv(500))["effect_ns"] == 9 * MS


def test_a_path_that_is_taken_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "taken").touch()
    with pytest.raises(OSError, match="expected a free path") as refused:
        FaultInjector(tmp_path / "taken", remote=Remote(), camera=lambda line: None)
    assert "\n" not in str(refused.value)


def test_keys_held_on_the_remote_are_in_both_messages_and_let_go_by_clear(injector) -> None:
    server, client = injector
    client.send(command("remote-keys", keys=0x220).line())
    server.poll(1)
    assert server.remote.keys == 0x220 and server.remote.as_bytes()[2:4] == b"\x20\x02"
    client.send(b'{"fault": "clear"}')
    server.poll(2)
    assert server.remote.as_bytes() == bytes(40)


def test_no_two_pictures_of_the_same_scene_are_alike() -> None:
    picture, noise = np.full((18, 32, 3), 128, np.uint8), SensorNoise(32, 18, seed=0)
    first, second = noise.add(picture), noise.add(picture)
    assert (first != second).any() and abs(float(first.mean()) - 128.0) < 0.2
    assert noise.add(np.zeros((18, 32, 3), np.uint8)).max() < 10


@pytest.mark.slow
def test_without_the_flag_the_code_that_injects_is_not_even_loaded() -> None:
    loaded = "any('_fault' in m or '.fault_injector' in m for m in sys.modules)"
    code = f"import sim_hil.hil.command, sim_hil.protocols.unitree.videohub, sys; print({loaded})"
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert done.stdout.strip().endswith("False")


def test_slower_topics_carry_the_same_faults_between_two_states_of_the_main_one() -> None:
    assert faults_with("error-code", code=7).beside(state())[0].error_code == 7
    assert faults_with("state-silent").beside(state()) == []
