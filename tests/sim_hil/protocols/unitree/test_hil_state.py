"""The simulated Go2's low state on the wire: encoded by hand, so held against the binding's own serializer."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.unitree.messages.crc import low_state_crc
from firmware_bridge.unitree.messages.idl_low import LowState_
from sim_hil.protocols.unitree.odometry import OdometryFrame
from sim_hil.protocols.unitree.state import LowStateMessage
from sim_hil.robots.battery import BatteryReading
from tests.support.robot.fake_go2 import standing


@given(st.integers(0, 2**32 - 1))
def test_it_is_encoded_as_the_binding_would_and_reads_back(seed: int) -> None:
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
