"""Client and server side of Unitree's services, and the runner's reader, over a real bus on loopback."""

from __future__ import annotations

import math
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.core.config import DdsConfig, load_robot_config
from firmware_bridge.core.robot_state import CameraError, DdsError, RobotState
from firmware_bridge.dds.bus import Bus, domain_xml
from firmware_bridge.unitree.client import Go2Reader
from firmware_bridge.unitree.messages import ids
from firmware_bridge.unitree.messages.idl import (
    RequestIdentity_,
    Response_,
    ResponseHeader_,
    ResponseStatus_,
    SportModeState_,
)
from firmware_bridge.unitree.messages.idl_low import LowState_
from firmware_bridge.unitree.report import robot_state
from firmware_bridge.unitree.rpc import MAX_BINARY_BYTES, Response, RpcClient, RpcError
from sim_hil.protocols.unitree.odometry import OdometryFrame
from sim_hil.protocols.unitree.services.service import ServiceServer
from sim_hil.protocols.unitree.state import LowStateMessage, sport_mode_state
from tests.support.processes import GO2_SIM, wait_for
from tests.support.robot.fake_go2 import standing

JPEG = b"\xff\xd8 not much of a picture"


class Peer:
    """A robot whose video service answers what `answer` says: (code, binary), or None for silence."""

    def __init__(self, bus: Bus) -> None:
        self.answer: tuple[int, bytes] | None = (ids.OK, JPEG)
        self.served = 0
        self._server = ServiceServer(bus, ids.VIDEO_SERVICE)
        self._sport = ServiceServer(bus, ids.SPORT_SERVICE)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._thread.join()

    def _serve(self) -> None:
        while not self._closing.wait(0.002):
            for request in self._server.requests():
                self.served += 1
                if self.answer is not None:
                    self._server.reply(request, self.answer[0], "", self.answer[1])
            self._sport.serve(lambda api_id, text: (ids.OK if api_id == ids.STAND_UP else 4202, text))


@pytest.fixture(scope="module")
def bus(dds_domain: int) -> Iterator[Bus]:
    bus = Bus(DdsConfig(dds_domain, "lo", ("127.0.0.1",)))
    yield bus
    bus.close()


@pytest.fixture
def peer(bus: Bus) -> Iterator[Peer]:
    peer = Peer(bus)
    yield peer
    peer.close()


@pytest.fixture
def reader(bus: Bus) -> Iterator[Go2Reader]:
    reader = Go2Reader(load_robot_config(GO2_SIM), bus=bus)
    yield reader
    reader.close()


def test_a_call_returns_the_services_answer_or_raises_with_its_error_code(bus: Bus, peer: Peer) -> None:
    client = RpcClient(bus, ids.SPORT_SERVICE)
    response = client.call(ids.STAND_UP, '{"a":1}', timeout_s=3)
    assert (response.code, response.data, response.api_id) == (0, '{"a":1}', ids.STAND_UP)
    assert client.call(ids.API_VERSION, timeout_s=3).data == "1.0.0.1", "bare text"
    with pytest.raises(RpcError) as error:
        client.call(ids.DAMP, "text", timeout_s=3)
    assert error.value.code == 4202


def test_a_request_whose_answer_was_lost_is_sent_again(reader: Go2Reader, peer: Peer) -> None:
    peer.answer = None
    timer = threading.Timer(1.0, lambda: setattr(peer, "answer", (ids.OK, JPEG)))
    timer.start()
    assert reader.request_frame(5.0) == JPEG
    assert peer.served == 2


def test_a_missing_service_is_reported_in_time(bus: Bus) -> None:
    with pytest.raises(RpcError, match=r"no such service on the bus within 0\.1 s") as error:
        RpcClient(bus, "telepathy").call(1001, timeout_s=0.1)
    assert error.value.code is None


def test_a_noreply_request_is_never_answered(bus: Bus, peer: Peer) -> None:
    client = RpcClient(bus, ids.SPORT_SERVICE)
    client.call(ids.API_VERSION, timeout_s=3)
    client.send(ids.STAND_UP, noreply=True)
    client.send(ids.DAMP, noreply=True)
    time.sleep(0.1)
    assert client.responses() == []


@pytest.mark.parametrize("api_id", [ids.DAMP, ids.STAND_DOWN, 1030, 2043, 0, -1])
def test_an_id_off_the_allow_list_never_leaves(bus: Bus, api_id: int) -> None:
    client = RpcClient(bus, ids.SPORT_SERVICE, allowed=ids.BRIDGE_ALLOWED)
    with pytest.raises(ValueError, match="allow-list"):
        client.send(api_id)


def test_an_answer_that_is_not_utf_8_is_counted_and_the_next_one_is_read(bus: Bus, peer: Peer) -> None:
    # Lengths beyond the end and truncated samples do not come this far: Cyclone's C code refuses them.
    client = RpcClient(bus, ids.SPORT_SERVICE)
    client.call(ids.API_VERSION, timeout_s=3)
    writer = bus.writer(ids.response_topic(ids.SPORT_SERVICE), Response_)
    hostile = Response_(ResponseHeader_(RequestIdentity_(1, 1), ResponseStatus_(0)), "", b"")
    data = b"\xff\xfe\xfd\0"
    body = bytes(20) + len(data).to_bytes(4, "little") + data + bytes(4)
    hostile.serialize = lambda **_: b"\0\1\0\0" + body  # type: ignore[method-assign]
    writer.write(hostile)
    wait_for(lambda: client.responses() == [] and client.malformed == 1, 2, "the answer to be counted")
    assert client.call(ids.API_VERSION, timeout_s=3).data == "1.0.0.1"


def test_an_absurdly_large_answer_is_dropped() -> None:
    assert Response.checked(None) is None
    huge = type("Sample", (), {"data": "", "binary": range(MAX_BINARY_BYTES + 1)})
    assert Response.checked(huge) is None  # type: ignore[arg-type]


def test_a_frame_is_fetched(reader: Go2Reader, peer: Peer) -> None:
    assert reader.request_frame(3.0) == JPEG


def test_a_frame_that_does_not_come_is_an_error_in_time(reader: Go2Reader, peer: Peer) -> None:
    reader.request_frame(3.0)
    peer.answer = None
    start = time.monotonic()
    with pytest.raises(CameraError, match=r"within 0\.2 s"):
        reader.request_frame(0.2)
    assert time.monotonic() - start < 2


def test_a_late_answer_is_not_taken_for_the_next_frame(reader: Go2Reader, peer: Peer) -> None:
    reader.request_frame(3.0)
    peer.answer = None
    with pytest.raises(CameraError):
        reader.request_frame(0.05)
    peer.answer = (ids.OK, JPEG + b"new")
    assert reader.request_frame(3.0) == JPEG + b"new"


@pytest.mark.parametrize("answer", [(100, b""), (0, b""), (0, b"GIF89a")])
def test_an_answer_without_a_jpeg_is_an_error(reader: Go2Reader, peer: Peer, answer: tuple[int, bytes]) -> None:
    peer.answer = answer
    with pytest.raises(CameraError):
        reader.request_frame(3.0)


def test_states_arrive_with_a_monotonic_stamp_and_reach_the_listener(bus: Bus, reader: Go2Reader) -> None:
    assert reader.state() is None
    received: list[RobotState] = []
    reader.set_state_listener(received.append)
    writer = bus.writer(ids.SPORT_STATE_TOPIC, SportModeState_)
    before_ns = time.monotonic_ns()
    writer.write(sport_mode_state(standing(mode=3), OdometryFrame((0.0, 0.0, 0.0))))
    wait_for(lambda: received, 3, "a state")
    assert reader.state() is received[-1]
    assert received[-1].mode == 3 and before_ns <= received[-1].received_ns <= time.monotonic_ns()


def test_a_state_with_a_number_that_is_not_finite_is_dropped(bus: Bus, reader: Go2Reader) -> None:
    writer = bus.writer(ids.SPORT_STATE_TOPIC, SportModeState_)
    state = sport_mode_state(standing(), OdometryFrame((0.0, 0.0, 0.0)))
    state.position = [math.nan, 0.0, 0.0]
    writer.write(state)
    wait_for(lambda: reader.malformed == 1, 3, "the state to be counted")
    assert reader.state() is None


def test_a_state_that_overtook_an_older_one_is_not_followed_by_it(bus: Bus, reader: Go2Reader) -> None:
    writer = bus.writer(ids.SPORT_STATE_TOPIC, SportModeState_)
    for time_s in (2.0, 1.0):
        writer.write(sport_mode_state(standing(time_s=time_s), OdometryFrame((0.0, 0.0, 0.0))))
        wait_for(lambda: reader.state() is not None, 3, "a state")
        time.sleep(0.05)
    wait_for(lambda: reader.reordered == 1, 3, "the old state to be counted")
    assert reader.state().robot_stamp_ns == 2_000_000_000  # type: ignore[union-attr]


def test_the_battery_is_read_twice_a_second(bus: Bus, reader: Go2Reader) -> None:
    assert reader.battery() is None
    writer, message = bus.writer(ids.LF_LOW_STATE_TOPIC, LowState_), LowStateMessage().message
    message.bms_state.soc, message.power_v, message.power_a = 42, 29.5, 3.5
    before_ns = time.monotonic_ns()
    writer.write(message)
    wait_for(lambda: reader.battery() is not None, 3, "the battery")
    battery = reader.battery()
    assert battery is not None and before_ns <= battery.received_ns <= time.monotonic_ns()
    assert (battery.soc_percent, battery.voltage_v, battery.current_a) == (42, 29.5, 3.5)


@given(st.floats(-math.pi, math.pi), st.floats(-3, 3), st.floats(-3, 3))
def test_velocity_in_the_odometry_frame_is_turned_into_the_body_frame(yaw: float, vx: float, vy: float) -> None:
    sample = sport_mode_state(standing(), OdometryFrame((0.0, 0.0, 0.0)))
    sample.imu_state.rpy = [0.0, 0.0, yaw]
    sample.velocity = [math.cos(yaw) * vx - math.sin(yaw) * vy, math.sin(yaw) * vx + math.cos(yaw) * vy, 0.0]
    state = robot_state(sample, 1, "odom")
    assert state is not None
    assert (state.vx_mps, state.vy_mps) == (pytest.approx(vx, abs=1e-9), pytest.approx(vy, abs=1e-9))
    assert state.T_odom_base[2] == yaw


def test_velocity_in_the_body_frame_is_left_alone() -> None:
    sample = sport_mode_state(standing(), OdometryFrame((0.0, 0.0, 0.0)))
    sample.imu_state.rpy, sample.velocity = [0.0, 0.0, 1.0], [0.5, 0.1, 0.0]
    state = robot_state(sample, 1, "body")
    assert state is not None and (state.vx_mps, state.vy_mps) == (0.5, 0.1)


def test_a_wrong_interface_is_one_clear_error() -> None:
    with pytest.raises(DdsError, match="interface 'nosuch0'"):
        Bus(DdsConfig(101, "nosuch0"))


def test_a_domain_is_opened_once_in_a_process_and_again_after_close(dds_domain: int) -> None:
    config = DdsConfig(91 + dds_domain % 10, "lo")
    first = Bus(config)
    with pytest.raises(DdsError, match="already opened"):
        Bus(config)
    first.close()
    Bus(config).close()


def test_no_trace_is_written_and_ten_participants_a_host_are_found() -> None:
    xml = domain_xml(replace(load_robot_config(GO2_SIM).dds))
    assert "Tracing" not in xml and '<Peer address="127.0.0.1"/>' in xml
    assert "<MaxAutoParticipantIndex>9</MaxAutoParticipantIndex>" in xml


@pytest.mark.slow
def test_a_client_that_leaves_is_not_a_malformed_request(bus: Bus, dds_domain: int) -> None:
    server = ServiceServer(bus, "leaving")
    code = (
        "from firmware_bridge.core.config import DdsConfig\n"
        "from firmware_bridge.dds.bus import Bus\n"
        "from firmware_bridge.unitree.rpc import RpcClient\n"
        f"bus = Bus(DdsConfig({dds_domain}, 'lo', ('127.0.0.1',)))\n"
        "RpcClient(bus, 'leaving').call(1001, timeout_s=20)\n"
        "bus.close()\n"
    )
    with subprocess.Popen([sys.executable, "-c", code]) as client:
        while client.poll() is None:
            for request in server.requests():
                server.reply(request, ids.OK)
            time.sleep(0.005)
    assert client.returncode == 0
    time.sleep(0.3)
    assert list(server.requests()) == []
    assert server.malformed == 0
