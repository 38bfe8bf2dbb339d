"""Beside the runner's records, a flight log has messages in published schemas that say the same."""

from __future__ import annotations

import json
import math
from datetime import datetime, timezone
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from calib.odometry import read_drive
from edge.core.geometry import SE2
from edge.flightlog.part import encode
from edge.flightlog.reader import read_messages
from edge.flightlog.recorder import Recorder, RecorderLimits
from edge.flightlog.replay.records import RecordedFrame, RecordedGeneration, RecordedTick, read_events, read_run
from edge.flightlog.standard_messages import DrivenPath, Mount, StandardMessages, jpeg_size
from edge.flightlog.standard_schemas import COMPRESSED_IMAGE, STANDARD_SCHEMAS
from edge.odometry.camera_geometry import Attitude, CameraGeometry, FloorProjector
from tests.edge.flightlog.test_log_schemas import SAMPLES, complaints
from tests.support.runner import synthetic_run

OLD_LOG = Path(__file__).parents[2] / "data" / "flightlog" / "before_standard_schemas.mcap"
"""Written by the release before the standard messages: 50 ticks, 5 pictures, a generation, 125 odometry reports."""
MOUNT = {"hfov_deg": 100.0, "height_m": 0.35, "pitch_deg": 20.0, "forward_m": 0.3}
RUN = {**SAMPLES["/run"], "mount": MOUNT}
TICK = {**SAMPLES["/tick"], "offset": [0.5, 0.1, 0.2], "offset_sd": [0.02, 0.03, 0.01]}
SEMANTIC = {**SAMPLES["/semantic"], "text": "Plan: go on.", "waypoints": [[1.0, 0.0], [2.0, 0.5]]}
RECORDS: list[tuple[str, Any]] = [
    ("/run", RUN),
    ("/camera", synthetic_run.jpeg(1.0)),
    ("/tick", TICK),
    ("/semantic", SEMANTIC),
    ("/fault", SAMPLES["/fault"]),
    ("/result", SAMPLES["/result"]),
]


def by_topic(records: list[tuple[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """The messages of some records as a reader of the log gets them, by topic."""
    builder, found = StandardMessages(), {}
    for topic, record in records:
        for message in builder.of(topic, 7_250_000_000, record):
            found.setdefault(message.topic, []).append(json.loads(encode(message.payload, message.stamp_ns)))
    return found


def rotated(q: dict[str, float], v: tuple[float, float, float]) -> np.ndarray[Any, Any]:
    """A vector rotated by a quaternion."""
    axis = np.array([q["x"], q["y"], q["z"]])
    return np.array(v) + 2 * np.cross(axis, np.cross(axis, v) + q["w"] * np.array(v))


def test_every_topic_is_written_and_conforms_to_its_schema() -> None:
    found = by_topic(RECORDS)
    assert set(found) == set(STANDARD_SCHEMAS)
    for topic, messages in found.items():
        for message in messages:
            assert complaints(message, STANDARD_SCHEMAS[topic]) == []


@pytest.mark.parametrize("topic", sorted({*STANDARD_SCHEMAS, "/camera"} - {"/velocity"}))
def test_the_publisher_of_the_schemas_decodes_the_messages_and_every_field_of_them(topic: str) -> None:
    messages = pytest.importorskip("foxglove.messages", reason="install the extra `dev`")
    pool = pytest.importorskip("google.protobuf.descriptor_pool")
    from google.protobuf import json_format
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.message_factory import GetMessages

    schema = COMPRESSED_IMAGE if topic == "/camera" else STANDARD_SCHEMAS[topic]
    published = getattr(messages, schema["title"].removeprefix("foxglove.")).get_schema()
    files = FileDescriptorSet.FromString(published.data)
    kinds = GetMessages(list(files.file), pool.DescriptorPool())
    content = [json.loads(encode(RECORDS[1][1], 7))] if topic == "/camera" else by_topic(RECORDS)[topic]
    assert published.name == schema["title"]
    for message in content:
        decoded = kinds[schema["title"]]()
        json_format.ParseDict(_protobuf_json(message), decoded)  # refuses a field or type that it does not know
        known = {field.json_name for field in decoded.DESCRIPTOR.fields}
        assert set(message) == {{"frameId": "frame_id", "distortionModel": "distortion_model"}.get(n, n) for n in known}


def _protobuf_json(value: Any) -> Any:
    """The same message as protobuf writes it in JSON: a time is a text."""
    if isinstance(value, dict) and set(value) == {"sec", "nsec"}:
        seconds, ns = value["sec"], value["nsec"]
        date = datetime.fromtimestamp(seconds, timezone.utc)
        return "0s" if seconds == ns == 0 else f"{date:%Y-%m-%dT%H:%M:%S}.{ns:09d}Z"
    if isinstance(value, dict):
        return {key: _protobuf_json(item) for key, item in value.items()}
    return [_protobuf_json(item) for item in value] if isinstance(value, list) else value


def test_calibration_and_transform_project_a_floor_point_where_the_runner_does() -> None:
    found = by_topic(RECORDS)
    geometry = CameraGeometry(math.radians(100), 0.35, math.radians(20), 0.3)
    K = np.array(found["/camera/calibration"][0]["K"]).reshape(3, 3)
    _, camera = found["/tf"][0]["transforms"]
    at, turned = camera["translation"], camera["rotation"]
    back = {**{axis: -turned[axis] for axis in "xyz"}, "w": turned["w"]}
    seen = rotated(back, (2.0 - at["x"], -0.4 - at["y"], 0.0 - at["z"]))
    pixel = K @ (seen / seen[2])
    expected = FloorProjector(geometry, 320, 240).pixels(np.array([2.0, -0.4]), Attitude())
    assert pixel[:2] == pytest.approx(expected, abs=0.05)


def test_a_squeezed_picture_has_two_focal_lengths() -> None:
    square = Mount.of_record({**MOUNT, "aspect": 16 / 9}).focal_px(128, 128)
    assert square[1] / square[0] == pytest.approx(16 / 9)


def test_the_plan_starts_at_the_robot_and_is_in_the_odometry_frame() -> None:
    plan = by_topic(RECORDS)["/plan"][0]["poses"]
    pose = SE2(*TICK["pose"])
    ahead = pose @ SE2(*TICK["trajectory"][0])
    assert [plan[0]["position"]["x"], plan[0]["position"]["y"]] == pytest.approx([pose.x_m, pose.y_m], abs=1e-4)
    assert [plan[1]["position"]["x"], plan[1]["position"]["y"]] == pytest.approx([ahead.x_m, ahead.y_m], abs=1e-4)


def test_waypoints_are_drawn_from_the_anchor_not_from_the_robot() -> None:
    entity = by_topic([("/semantic", {**SEMANTIC, "anchor_pose": [5.0, 1.0, math.pi / 2]})])["/scene"][0]["entities"][0]
    places = [(sphere["pose"]["position"]["x"], sphere["pose"]["position"]["y"]) for sphere in entity["spheres"]]
    assert places == [pytest.approx((5.0, 2.0)), pytest.approx((4.5, 3.0))]


def test_the_driven_path_is_a_line_of_pieces_that_join() -> None:
    path = DrivenPath()
    pieces: dict[str, list[float]] = {}
    for tick in range(400):  # 20 m at 0.5 m/s
        entity = path.put(tick, SE2(0.05 * tick, 0.0, 0.0))
        if entity is not None:
            pieces[entity["id"]] = [point["x"] for point in entity["lines"][0]["points"]]
    lines = list(pieces.values())
    assert len(lines) == 4 and all(len(line) == 11 for line in lines[:-1])
    assert all(before[-1] == after[0] for before, after in pairwise(lines))
    assert lines[0][0] == 0.0 and lines[-1][-1] == pytest.approx(19.95, abs=0.5)


def test_a_robot_that_stands_adds_nothing_to_its_path() -> None:
    path = DrivenPath()
    assert [path.put(tick, SE2(1.0, 2.0, 0.1 * tick)) for tick in range(50)] == [None] * 50


def test_the_newest_piece_of_a_long_path_replaces_the_oldest() -> None:
    path = DrivenPath()
    entities = [path.put(step, SE2(0.6 * step, 0.0, 0.0)) for step in range(1000)]
    assert len({entity["id"] for entity in entities if entity is not None}) == 32


@pytest.mark.parametrize(
    ("topic", "record"),
    [
        ("/tick", {"tick": 1}),
        ("/tick", {**TICK, "pose": [math.nan, 0.0, 0.0]}),
        ("/tick", {**TICK, "trajectory": [[math.inf, 0.0, 0.0]]}),
        ("/semantic", {**SEMANTIC, "waypoints": [[math.nan, 1.0]]}),
        ("/semantic", {**SEMANTIC, "anchor_pose": "here"}),
        ("/camera", b"\xff\xd8\xff"),
        ("/fault", {}),
        ("/run", {**RUN, "mount": {"hfov_deg": 1e9}}),
    ],
)
def test_a_malformed_record_is_still_recorded(topic: str, record: Any, tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "flight.mcap")
    recorder.put("/run", 1, RUN)
    recorder.put(topic, 2, record)
    assert recorder.close() and recorder.dropped == {}
    assert (topic, 2) in {(found, at_ns) for found, at_ns, _ in read_messages(tmp_path / "flight.mcap")}


def test_every_part_names_the_camera_again(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "flight.mcap", RecorderLimits(part_bytes=300_000, total_bytes=10**7))
    recorder.put("/run", 1, RUN)
    incompressible = np.random.default_rng(0).bytes(60_000)
    for number in range(24):
        recorder.put("/camera", 2 + number, synthetic_run.jpeg(0.0) + incompressible)
    assert recorder.close()
    files = sorted(tmp_path.iterdir())
    assert len(files) > 1
    for file in files:
        with file.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        assert summary is not None
        assert "/camera/calibration" in {channel.topic for channel in summary.channels.values()}


def test_a_log_of_the_release_before_is_still_read_by_replay_and_calibration() -> None:
    events = list(read_events(OLD_LOG))
    kinds = {kind: sum(isinstance(event, kind) for event in events) for kind in (RecordedTick, RecordedFrame)}
    assert read_run(OLD_LOG).instruction == "walk down the corridor"
    assert kinds == {RecordedTick: 50, RecordedFrame: 5}
    assert sum(isinstance(event, RecordedGeneration) for event in events) == 1
    assert len(read_drive(OLD_LOG).reports) == 125


def test_the_size_of_a_picture_is_read_from_its_header() -> None:
    assert jpeg_size(synthetic_run.jpeg(0.0)) == (320, 240)
    with pytest.raises(ValueError, match="JPEG"):
        jpeg_size(b"GIF89a")
