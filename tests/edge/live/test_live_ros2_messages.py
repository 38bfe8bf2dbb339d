"""A run's records as ROS 2 messages: frames, stamps, levels; every message survives serialisation."""

from __future__ import annotations

import math
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.live.ros2_messages import ERROR, KINDS, OK, STALE, WARN, Ros2Messages
from firmware_bridge.core.config_ros2 import PUBLISHED
from tests.edge.live.test_live_view import JSON_VALUES, MOUNT, SIZE

CLOCK_NS = 1_700_000_000_000_000_000
POSE = (1.0, 2.0, math.pi / 2)


def tick(**changed: Any) -> dict[str, Any]:
    record = {
        "tick": 4, "now_ns": 5_000_000_000, "late_ms": 1.0, "duration_ms": 11.0, "delay_s": 1.5, "frame_age_ms": 40.0,
        "pose": POSE, "trajectory": [[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]], "command": [0.5, 0.0, 0.1], "state": None,
        "active": [], "offset": None, "reason": "", "supervisor": "RUNNING",
    }  # fmt: skip
    return {**record, **changed}


def published(messages: Ros2Messages, topic: str, record: Any, stamp_ns: int = 5_000_000_000) -> dict[str, Any]:
    return {each.topic: each.message for each in messages.of(topic, stamp_ns, record, CLOCK_NS)}


@pytest.fixture
def messages() -> Ros2Messages:
    found = Ros2Messages("go2")
    found.of("/run", 1, {"instruction": "go", "mount": MOUNT}, CLOCK_NS)
    return found


def status(messages: Ros2Messages, name: str, now_ns: int = 5_500_000_000) -> Any:
    array = messages.diagnostics(now_ns, CLOCK_NS).message
    return next(each for each in array.status if each.name == f"tic_vla: {name}")


def test_every_published_topic_has_a_type() -> None:
    assert tuple(KINDS) == PUBLISHED


def test_odometry_is_the_fused_pose_and_the_velocity_of_the_base(messages: Ros2Messages) -> None:
    odom = published(messages, "/odometry", {"pose": POSE, "velocity": (0.4, 0.1, 0.2)})["odom"]
    assert (odom.header.frame_id, odom.child_frame_id) == ("odom", "base_link")
    assert (odom.pose.pose.position.x, odom.pose.pose.position.y) == (1.0, 2.0)
    assert odom.pose.pose.orientation.z == pytest.approx(math.sqrt(0.5))
    assert (odom.twist.twist.linear.x, odom.twist.twist.linear.y, odom.twist.twist.angular.z) == (0.4, 0.1, 0.2)


def test_a_stamp_is_of_the_wall_clock(messages: Ros2Messages) -> None:
    stamp = published(messages, "/odometry", {"pose": POSE, "velocity": (0, 0, 0)})["odom"].header.stamp
    assert (stamp.sec, stamp.nanosec) == (1_700_000_005, 0)


def test_a_tick_gives_transforms_plan_and_delay(messages: Ros2Messages) -> None:
    found = published(messages, "/tick", tick())
    assert found["delta_t"].data == 1.5
    frames = [(each.header.frame_id, each.child_frame_id) for each in found["tf"].transforms]
    assert frames == [("odom", "base_link"), ("base_link", "camera_optical")]
    at = [(round(each.pose.position.x, 3), round(each.pose.position.y, 3)) for each in found["plan"].poses]
    assert at == [(1.0, 2.0), (1.0, 3.0), (1.0, 4.0)], "the plan, turned and moved into odom"


def test_a_picture_comes_with_the_calibration_of_its_size(messages: Ros2Messages) -> None:
    found = published(messages, "/camera", SIZE)
    assert found["camera/image/compressed"].data == SIZE and found["camera/image/compressed"].format == "jpeg"
    info = found["camera/camera_info"]
    assert (info.width, info.height) == (320, 180) and info.k[0] == pytest.approx(160.0)
    assert info.header == found["camera/image/compressed"].header


def test_the_reasoning_text_is_a_string(messages: Ros2Messages) -> None:
    record = {"text": "Scene: a corridor.\0", "anchor_pose": None, "waypoints": None}
    assert published(messages, "/semantic", record)["reasoning"].data == "Scene: a corridor."


@pytest.mark.parametrize(
    ("active", "level"), [([], OK), (["camera-stale"], ERROR), (["semantic-old"], WARN), (["semantic-old", "?"], ERROR)]
)
def test_the_level_of_the_diagnostics_is_that_of_the_worst_fault(
    messages: Ros2Messages, active: list[str], level: int
) -> None:
    messages.of("/tick", 5_000_000_000, tick(active=active), CLOCK_NS)
    assert status(messages, "driving").level == level


def test_a_run_without_a_new_tick_is_stale(messages: Ros2Messages) -> None:
    assert status(messages, "driving").level == STALE
    messages.of("/tick", 5_000_000_000, tick(), CLOCK_NS)
    assert status(messages, "driving").level == OK
    assert status(messages, "driving", 8_000_000_000).level == STALE


@pytest.mark.parametrize("text", ["Scene:\0 a corridor", "a lone \ud800 surrogate"])
def test_a_text_that_the_wire_cannot_carry_is_mended(messages: Ros2Messages, text: str) -> None:
    record = {"text": text, "anchor_pose": None, "waypoints": None}
    assert published(messages, "/semantic", record)["reasoning"].serialize()


@pytest.mark.parametrize("active", [5, None, "x", {"a": 1}])
def test_faults_that_are_no_list_are_no_faults(messages: Ros2Messages, active: object) -> None:
    messages.of("/tick", 5_000_000_000, tick(active=active), CLOCK_NS)
    assert status(messages, "driving").level == OK


def test_power_and_battery_are_in_the_diagnostics(messages: Ros2Messages) -> None:
    messages.of("/power", 1, {"total_w": 14.5, "rails": {"cpu": 3.0}, "tagged": "modelled"}, CLOCK_NS)
    messages.of("/battery", 1, {"soc_percent": 80}, CLOCK_NS)
    power = {each.key: each.value for each in status(messages, "power").values}
    assert power == {"total_w": "14.5", "tagged": "modelled"}
    assert status(messages, "battery").values[0].value == "80"


@pytest.mark.slow
@given(
    st.sampled_from(["/run", "/tick", "/semantic", "/odometry", "/power", "/battery", "/fault", "/x"]),
    st.dictionaries(
        st.sampled_from(["pose", "trajectory", "velocity", "text", "delay_s", "active", "mount", "now_ns", "offset"]),
        JSON_VALUES,
    ),
)
def test_no_record_raises_and_every_message_can_be_serialised(topic: str, content: dict[str, Any]) -> None:
    messages = Ros2Messages("go2")
    for record in (content, {**tick(), **content}):
        for found in [*messages.of(topic, 5, record, CLOCK_NS), messages.diagnostics(6, CLOCK_NS)]:
            try:
                assert found.message.serialize()
            except struct.error as error:
                raise AssertionError(f"{found}: {error}") from error
