"""What the live view makes of a run's records: history, overlay, advice, metrics, and Foxglove's frames."""

from __future__ import annotations

import contextlib
import json
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.live.foxglove import Channels, ProtocolError, Subscriptions, server_info
from edge.live.metrics import Metrics
from edge.live.view import OVERLAY, LiveState
from edge.live.wire import DROPPED, RECORD, Datagram, ViewConfig, WireError, decode
from edge.safety.faults.table import FAULTS

MOUNT = {"hfov_deg": 90.0, "height_m": 0.3, "pitch_deg": 0.0, "forward_m": 0.0}
SIZE = b"\xff\xd8\xff\xc0\x00\x11\x08" + struct.pack(">HH", 180, 320)  # the head of a JPEG
JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=9), inner, max_size=4),
    max_leaves=9,
)


def tick(**changed: Any) -> dict[str, Any]:
    record = {
        "tick": 4, "late_ms": 1.0, "duration_ms": 11.0, "delay_s": 1.5, "frame_age_ms": 40.0, "pose": [1.0, 2.0, 0.0],
        "trajectory": [[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]], "command": [0.5, 0.0, 0.1], "state": [0.4, 0.0, 0.1],
        "active": ["camera-stale"],
    }  # fmt: skip
    return {**record, **changed}


def overlay(state: LiveState, record: dict[str, Any]) -> dict[str, Any]:
    (found,) = [message for message in state.record("/tick", 5, record) if message.topic == OVERLAY]
    result: dict[str, Any] = json.loads(found.data)["record"]
    return result


def ready() -> LiveState:
    state = LiveState()
    state.record("/run", 1, {"mount": MOUNT})
    state.picture("/camera", 2, SIZE)
    return state


@given(st.integers(0, 2**63 - 1), st.text(max_size=30), st.binary(max_size=50))
def test_a_datagram_is_read_as_it_was_written(stamp_ns: int, topic: str, payload: bytes) -> None:
    if len(topic.encode()) <= 255:
        sent = Datagram(RECORD, payload, topic, stamp_ns)
        assert decode(sent.encode()) == sent


@given(st.binary(max_size=60))
def test_any_bytes_are_a_datagram_or_refused(data: bytes) -> None:
    try:
        found = decode(data)
    except WireError:
        return
    assert RECORD <= found.kind <= DROPPED


def test_a_configuration_that_is_none_is_refused() -> None:
    for payload in (b"", b"[]", b'{"address": "::1"}', b"\xff"):
        with pytest.raises(WireError):
            ViewConfig.parse(payload)


def test_a_plan_straight_ahead_is_drawn_up_the_middle_of_the_picture() -> None:
    plan = overlay(ready(), tick())["plan"]
    assert all(abs(u - 0.5) < 0.01 for u, _ in plan)
    assert [v for _, v in plan] == sorted((v for _, v in plan), reverse=True)
    assert all(0.5 < v < 2.0 for _, v in plan)


def test_a_waypoint_to_the_left_is_drawn_on_the_left_and_moves_as_the_robot_does() -> None:
    state = ready()
    state.record("/semantic", 3, {"waypoints": [[3.0, 1.0]], "anchor_pose": [1.0, 2.0, 0.0]})
    ((u, v),) = overlay(state, tick())["waypoints"]
    ((nearer_u, nearer_v),) = overlay(state, tick(pose=[2.0, 2.0, 0.0]))["waypoints"]
    assert nearer_u < u < 0.5 and nearer_v > v


def test_a_waypoint_behind_the_robot_is_not_drawn() -> None:
    state = ready()
    state.record("/semantic", 3, {"waypoints": [[-3.0, 1.0]], "anchor_pose": [1.0, 2.0, 0.0]})
    assert overlay(state, tick())["waypoints"] == []


@pytest.mark.parametrize("forward_m", [-0.2, 0.0, 0.4])
def test_the_plan_is_drawn_from_the_floor_just_before_the_camera(forward_m: float) -> None:
    """The same floor as the flight log's video: 0.15 m before the lens, wherever it is mounted."""
    state = LiveState()
    state.record("/run", 1, {"mount": {**MOUNT, "forward_m": forward_m}})
    state.picture("/camera", 2, SIZE)
    plan = overlay(state, tick(trajectory=[[3.0, 0.0, 0.0]]))["plan"]
    from_lens_m = [0.3 / (v - 0.5) * 160 / 180 for _, v in plan]  # 0.3 m above the floor, 90° across 320 pixels
    assert 0.15 < from_lens_m[0] < 0.15 + max(0.11, -forward_m + 0.01)


@pytest.mark.parametrize("row", [[float("nan"), 0.0, 0.0], [float("inf"), 0.0, 0.0], [None, None, None]])
def test_a_plan_that_is_not_finite_erases_the_one_before(row: list[float | None]) -> None:
    state = ready()
    assert overlay(state, tick())["plan"]
    assert overlay(state, tick(trajectory=[[1.0, 0.0, 0.0], row])) == {"plan": [], "waypoints": []}


def test_a_fault_carries_its_message_and_what_to_do() -> None:
    (message,) = LiveState().record("/fault", 1, {"name": "camera-frozen", "change": "raised"})
    record = json.loads(message.data)["record"]
    assert record["advice"] == FAULTS["camera-frozen"].advice and record["message"]


def test_a_new_client_gets_the_events_and_the_newest_of_the_rest() -> None:
    state = ready()
    for number in range(40):
        state.record("/tick", number, tick(tick=number))
        state.record("/fault", number, {"name": f"fault {number}"})
    found = list(state.snapshot())
    assert sum(message.topic == "/tick" for message in found) == 1
    assert [json.loads(m.data)["record"]["name"] for m in found if m.topic == "/fault"][-1] == "fault 39"
    assert sum(message.topic == "/fault" for message in found) == 24


@pytest.mark.slow
@given(st.sampled_from(["/run", "/tick", "/semantic", "/fault", "/odometry", "/power", "/x"]), JSON_VALUES)
def test_no_record_ends_the_view(topic: str, content: Any) -> None:
    state, metrics = ready(), Metrics()
    record = content if isinstance(content, dict) else {"pose": content, "trajectory": content, "name": content}
    state.record(topic, 1, record)
    metrics.take(topic, record)
    state.record("/tick", 2, {**tick(), **record})


def test_the_metrics_are_those_of_the_newest_records() -> None:
    metrics = Metrics()
    for number in range(3):
        metrics.take("/tick", tick(tick=number))
    metrics.take("/fault", {"name": "camera-stale", "action": "LIMIT", "change": "raised"})
    metrics.take("/power", {"total_w": 14.0, "budget_w": 25.0, "temperature_c": None, "tagged": "modelled"})
    text = metrics.text(dropped=2).decode()
    for line in (
        'tic_vla_tick_seconds_bucket{le="0.015"} 3.0',
        "tic_vla_ticks 3.0",
        "tic_vla_delay_seconds 1.5",
        'tic_vla_speed_mps{kind="commanded"} 0.5',
        'tic_vla_faults_total{action="LIMIT",name="camera-stale"} 1.0',
        'tic_vla_power_watts{tagged="modelled"} 14.0',
        "tic_vla_view_dropped_records 2.0",
    ):
        assert line in text.splitlines()
    assert text.endswith("# EOF\n")


def test_what_has_not_been_reported_yet_is_no_number() -> None:
    metrics = Metrics()
    for name in ("battery_percent", "temperature_celsius", "power_budget_watts", "delay_seconds", "frame_age_seconds"):
        assert samples(metrics, name) == [f"tic_vla_{name} NaN"]
    assert samples(metrics, "ticks ") == ["tic_vla_ticks 0.0"] and samples(metrics, "faults_active") == [
        "tic_vla_faults_active 0.0"
    ]


def test_missed_ticks_and_records_lost_from_the_log_are_metrics() -> None:
    metrics = Metrics()
    metrics.take("/tick", tick(missed=2))
    metrics.take("/recorder", {"dropped": 5, "error": None})
    assert samples(metrics, "missed_ticks") == ["tic_vla_missed_ticks 2.0"]
    assert samples(metrics, "log_dropped") == ["tic_vla_log_dropped_records 5.0"]


def samples(metrics: Metrics, name: str) -> list[str]:
    """The lines of one metric."""
    return [line for line in metrics.text(0).decode().splitlines() if line.startswith(f"tic_vla_{name}")]


def test_a_meter_that_is_lost_leaves_no_power_behind() -> None:
    """Without a sample the record's power is null and its tag is another (`edge.power.monitor`)."""
    metrics = Metrics()
    metrics.take("/power", {"total_w": 14.0, "budget_w": 25.0, "temperature_c": 60.0, "tagged": "measured"})
    metrics.take("/power", {"total_w": None, "budget_w": None, "temperature_c": None, "tagged": "modelled"})
    assert samples(metrics, "power_watts") == ['tic_vla_power_watts{tagged="modelled"} NaN']
    assert samples(metrics, "temperature_celsius") == ["tic_vla_temperature_celsius NaN"]
    assert samples(metrics, "power_budget_watts") == ["tic_vla_power_budget_watts NaN"]


@pytest.mark.parametrize("state", [None, [None, 0.0, None]])
def test_a_tick_without_odometry_leaves_no_motion_and_no_delay_behind(state: list[float | None] | None) -> None:
    metrics = Metrics()
    metrics.take("/tick", tick())
    metrics.take("/tick", tick(state=state, delay_s=None, frame_age_ms=None))
    assert 'tic_vla_speed_mps{kind="measured"} NaN' in samples(metrics, "speed_mps")
    assert 'tic_vla_speed_mps{kind="commanded"} 0.5' in samples(metrics, "speed_mps")
    assert 'tic_vla_yaw_rate_radps{kind="measured"} NaN' in samples(metrics, "yaw_rate_radps")
    assert samples(metrics, "delay_seconds") == ["tic_vla_delay_seconds NaN"]
    assert samples(metrics, "frame_age_seconds") == ["tic_vla_frame_age_seconds NaN"]


class TestFoxgloveProtocol:
    def test_a_message_goes_out_under_the_number_that_the_client_chose(self) -> None:
        subscriptions = Subscriptions()
        request = {"op": "subscribe", "subscriptions": [{"id": 70, "channelId": 2}]}
        assert subscriptions.take(json.dumps(request)) == [2]
        assert subscriptions.frame(2, 9, b"{}") == b"\x01" + struct.pack("<IQ", 70, 9) + b"{}"
        assert subscriptions.frame(1, 9, b"{}") is None
        subscriptions.take('{"op": "unsubscribe", "subscriptionIds": [70]}')
        assert subscriptions.frame(2, 9, b"{}") is None

    def test_a_topic_is_advertised_with_its_schema(self) -> None:
        channels = Channels()
        added = json.loads(channels.add("/x", {"title": "tic_vla.X", "type": "object"}))
        assert added == json.loads(channels.advertisement())
        (channel,) = added["channels"]
        assert (channel["id"], channel["topic"], channel["encoding"]) == (channels.id_of("/x"), "/x", "json")
        assert json.loads(channel["schema"])["title"] == channel["schemaName"] == "tic_vla.X"

    @given(JSON_VALUES | st.fixed_dictionaries({"op": st.just("subscribe"), "subscriptions": JSON_VALUES}))
    def test_any_request_is_understood_or_refused(self, request: Any) -> None:
        with contextlib.suppress(ProtocolError):
            Subscriptions().take(json.dumps(request))

    def test_no_more_than_256_subscriptions_are_kept(self) -> None:
        many = [{"id": number, "channelId": number} for number in range(257)]
        with pytest.raises(ProtocolError, match="256"):
            Subscriptions().take(json.dumps({"op": "subscribe", "subscriptions": many}))

    def test_the_server_names_itself_first(self) -> None:
        assert json.loads(server_info("name", "s"))["op"] == "serverInfo"
