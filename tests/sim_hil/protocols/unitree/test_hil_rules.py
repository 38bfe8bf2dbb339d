"""`edge-hil`'s pure parts: the sport service's rules, the log of commands, the odometry frame, the shared pose."""

from __future__ import annotations

import math
import mmap
import threading
from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.unitree.messages import ids
from firmware_bridge.unitree.messages.crc import low_state_crc
from firmware_bridge.unitree.messages.idl_low import LowState_
from firmware_bridge.unitree.rpc import move_parameter
from sim_hil.protocols.snapshot import SnapshotReader, SnapshotWriter, TornSnapshotError
from sim_hil.protocols.unitree.odometry import OdometryFrame
from sim_hil.protocols.unitree.services.service import Received
from sim_hil.protocols.unitree.services.sport import RequestLog, handle_sport, parse_move
from sim_hil.protocols.unitree.state import LowStateMessage
from sim_hil.robots.battery import BatteryReading
from tests.support.robot.fake_go2 import standing


class TestSportRules:
    @pytest.mark.parametrize(
        "text",
        ["", "nonsense", "[]", "3", "null", '{"x":1,"y":2}', '{"x":1,"y":2,"z":"3"}', '{"x":1,"y":2,"z":NaN}',
         '{"x":1,"y":2,"z":1e999}', '{"x":true,"y":0,"z":0}', '{"x":1,"y":2,"z":null}', "[" * 4000],
    )  # fmt: skip
    def test_an_invalid_move_is_a_parameter_error_and_moves_nothing(self, text: str) -> None:
        robot = SimpleNamespace(move=lambda *_: pytest.fail("moved"))
        assert handle_sport(robot, 1008, text) == (3204, "")

    @given(st.text(max_size=200))
    def test_no_text_breaks_the_parser(self, text: str) -> None:
        assert parse_move(text) is None or len(parse_move(text) or ()) == 3

    @given(*[st.floats(-100, 100)] * 3)
    def test_the_bridges_parameter_is_parsed(self, vx: float, vy: float, wz: float) -> None:
        assert parse_move(move_parameter(vx, vy, wz)) == (vx, vy, wz)


MOVE, ZERO_MOVE, OTHER = (1008, '{"x":0.5,"y":0,"z":0}'), (1008, '{"x":0,"y":0,"z":0}'), (1016, "")


@pytest.mark.parametrize(
    ("requests", "at_zero"),
    [
        ([], True),
        ([(1004, "")], True),
        ([MOVE], False),
        ([(1008, "?")], False),
        ([MOVE, ZERO_MOVE], True),
        *[([MOVE, (api_id, ""), OTHER], True) for api_id in (1001, 1003, 1005)],
        *[([MOVE, (api_id, "")], False) for api_id in (1002, 1004, 1006, 1016, 9999)],
    ],
)
def test_a_move_counts_until_a_zero_move_or_a_request_that_ends_motion(
    requests: list[tuple[int, str]], at_zero: bool
) -> None:
    log = RequestLog()
    for api_id, parameter in requests:
        log.note(Received(0, ids.SPORT_SERVICE, api_id, parameter, 0, noreply=True))
    assert log.summary()["last_command_zero"] is at_zero
    assert log.summary()["commands"] == sum(api_id == 1008 for api_id, _ in requests)


class TestOdometryFrame:
    starts = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-math.pi, math.pi))

    @given(starts)
    def test_it_starts_at_zero(self, start: tuple[float, float, float]) -> None:
        frame = OdometryFrame(start)
        assert frame.position((start[0], start[1], 0.3)) == pytest.approx([0, 0, 0.3], abs=1e-9)
        assert frame.rpy((0.1, 0.2, start[2]))[2] == pytest.approx(0, abs=1e-9)
        half = start[2] / 2
        quaternion = frame.quaternion((math.cos(half), 0.0, 0.0, math.sin(half)))
        assert quaternion == pytest.approx([1, 0, 0, 0], abs=1e-9)

    @given(starts, st.floats(-5, 5))
    def test_walking_straight_ahead_is_along_x(self, start: tuple[float, float, float], distance: float) -> None:
        x, y, theta = start
        ahead = (x + distance * math.cos(theta), y + distance * math.sin(theta), 0.3)
        assert OdometryFrame(start).position(ahead) == pytest.approx([distance, 0, 0.3], abs=1e-9)


@given(st.integers(0, 2**32 - 1))
def test_the_low_state_is_encoded_as_the_binding_would_and_reads_back(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = standing(
        time_s=float(rng.uniform(0, 1e5)),
        joint_q_rad=rng.normal(size=12),
        joint_dq_radps=rng.normal(size=12),
        joint_tau_nm=rng.normal(size=12) * 20,
        gyro_radps=rng.normal(size=3),
        foot_force_n=rng.uniform(0, 200, 4),
    )
    low = LowStateMessage()
    low.charge(BatteryReading(float(rng.uniform(0, 100)), 29.5, float(rng.uniform(0, 20))))
    message = low.update(truth, OdometryFrame((1.0, 2.0, 0.5)))
    message.wireless_remote = rng.bytes(40)
    message.bit_flag, message.reserve = int(rng.integers(256)), int(rng.integers(2**32))
    data = low.encode()
    assert data == message.serialize()
    read = LowState_.deserialize(data)
    assert read.crc == message.crc == low_state_crc(read)
    assert read.tick == message.tick


class TestSnapshot:
    @pytest.fixture
    def pair(self) -> Iterator[tuple[SnapshotWriter, SnapshotReader]]:
        writer = SnapshotWriter(2)
        reader = SnapshotReader(writer.fd, 2)
        yield writer, reader
        reader.close()
        writer.close()

    @staticmethod
    def half_written(writer: SnapshotWriter) -> None:
        with mmap.mmap(writer.fd, 0) as memory:
            memory[-8:] = np.array(3.0).tobytes()

    def test_the_newest_value_is_read(self, pair: tuple[SnapshotWriter, SnapshotReader]) -> None:
        writer, reader = pair
        assert reader.read() is None
        for value in range(3):
            writer.write(np.full(2, float(value)))
        assert reader.read().tolist() == [2.0] * 2

    def test_a_torn_value_is_never_returned(self, pair: tuple[SnapshotWriter, SnapshotReader]) -> None:
        writer, reader = pair
        writer.write(np.array((1.0, 2.0)))
        self.half_written(writer)
        with pytest.raises(TornSnapshotError, match="no consistent snapshot"):
            reader.read()

    def test_the_reader_waits_for_a_writer_interrupted_for_milliseconds(
        self, pair: tuple[SnapshotWriter, SnapshotReader]
    ) -> None:
        writer, reader = pair
        writer.write(np.array((1.0, 2.0)))
        self.half_written(writer)
        timer = threading.Timer(0.02, writer.write, (np.array((1.0, 3.0)),))
        timer.start()
        assert reader.read().tolist() == [1.0, 3.0]
        timer.join()

    def test_another_length_is_refused(self, pair: tuple[SnapshotWriter, SnapshotReader]) -> None:
        with pytest.raises(ValueError, match="shape"):
            pair[0].write(np.zeros(4))
        with pytest.raises(ValueError, match="bytes"):
            SnapshotReader(pair[0].fd, 4)
