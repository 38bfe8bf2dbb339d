"""Messages in published schemas for the runner's records, so that any viewer shows them without knowing ours.

| record | messages |
|---|---|
| `/camera` (itself a CompressedImage) | `/camera/calibration` once a file or view, with its first picture |
| `/tick` | `/tf` odom → base → camera, `/plan`, `/velocity`; driven path and odometry's uncertainty in `/scene` |
| `/semantic` | anchor and waypoints in `/scene`, the reasoning text in `/log` |
| `/fault`, `/run`, `/result` | `/log` |

They are for viewing: lengths are rounded to 0.1 mm. Replay and calibration read the records, whose numbers are exact.
Frames: `odom`; `base`, on the floor below the robot, x forward, y left; `camera`, optical, z forward, x right.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

from edge.core.geometry import SE2
from edge.odometry.camera_geometry import CameraGeometry
from edge.state.reasoning_text import PLAN_HEAD

Json = dict[str, Any]

ODOM, BASE, CAMERA = "odom", "base", "camera"
INFO, WARNING, ERROR, FATAL = 2, 3, 4, 5
"""Levels of `foxglove.Log`."""
_LEVEL_OF_ACTION: Final = {"LIMIT": WARNING, "ZERO": ERROR, "STOP": FATAL}
_MAX_LOG_CHARS: Final = 4096
_PLAN_COLOUR, _ANCHOR_COLOUR, _WAYPOINT_COLOUR = (0.12, 0.44, 0.55), (0.54, 0.37, 0.75), (0.90, 0.55, 0.08)
_ODOMETRY_COLOUR: Final = (0.82, 0.38, 0.24)
_SHOWN_SDS: Final = 2.0
"""Half-axes of the uncertainty's ellipse, standard deviations."""
_PATH_COLOUR: Final = (0.25, 0.25, 0.25)
_PATH_STEP_M: Final = 0.5
_PATH_STEPS: Final = 10  # of one entity: few enough to be written again at every step
_PATH_ENTITIES: Final = 32
"""Pieces of the driven path that are shown, 5 m each; the newest replaces the oldest."""
_UPRIGHT: Final = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
_MALFORMED: Final = (LookupError, TypeError, ValueError, AttributeError, OverflowError, struct.error)


class StandardMessage(NamedTuple):
    """One message: a topic of STANDARD_SCHEMAS, its stamp and its JSON content."""

    topic: str
    stamp_ns: int
    payload: Json


class StandardMessages:
    """Builder of the messages of one recording or view; for one thread.

    It learns the camera's mount from `/run` and the picture's size from the first picture.
    """

    def __init__(self) -> None:
        self._mount: Mount | None = None
        self._size: tuple[int, int] | None = None
        self._path = DrivenPath()
        self._of: Mapping[str, Callable[[int, Any], list[StandardMessage]]] = {
            "/run": self._run,
            "/camera": self._camera,
            "/tick": self._tick,
            "/semantic": semantic_messages,
            "/fault": lambda stamp_ns, record: [fault_log(stamp_ns, record)],
            "/result": lambda stamp_ns, record: [log(stamp_ns, INFO, "run", _end(record))],
        }

    def of(self, topic: str, stamp_ns: int, record: Mapping[str, Any] | bytes) -> list[StandardMessage]:
        """Return the messages of one record as it was put into the recorder; none for a malformed or other record."""
        build = self._of.get(topic)
        if build is None:
            return []
        try:
            return build(stamp_ns, record)
        except _MALFORMED:
            return []  # the record itself shows what is wrong with it

    def _run(self, stamp_ns: int, record: Mapping[str, Any]) -> list[StandardMessage]:
        self._mount = None if record.get("mount") is None else Mount.of_record(record["mount"])
        return [log(stamp_ns, INFO, "run", f"instruction: {record['instruction']}")]

    def _camera(self, stamp_ns: int, jpeg: bytes) -> list[StandardMessage]:
        if self._mount is None or self._size is not None:
            return []
        self._size = jpeg_size(jpeg)
        return [StandardMessage("/camera/calibration", stamp_ns, self._mount.calibration(stamp_ns, *self._size))]

    def _tick(self, stamp_ns: int, record: Mapping[str, Any]) -> list[StandardMessage]:
        messages = [StandardMessage("/velocity", stamp_ns, velocity(record["command"], record["state"]))]
        pose = _pose_or_none(record["pose"])
        if pose is None:
            return messages
        now_ns = int(record["now_ns"])
        messages.append(StandardMessage("/tf", stamp_ns, transforms(now_ns, pose, self._mount)))
        rows = record["trajectory"]
        steps = [] if rows is None else [SE2(*(float(value) for value in row)) for row in rows]
        if all(_is_finite(step.as_tuple()) for step in steps):
            poses = [pose @ step for step in (SE2(0.0, 0.0, 0.0), *steps)] if steps else []
            messages.append(StandardMessage("/plan", stamp_ns, poses_in_frame(now_ns, poses)))
        if (piece := self._path.put(now_ns, pose)) is not None:
            messages.append(StandardMessage("/scene", stamp_ns, scene(piece)))
        sds, offset = record.get("offset_sd"), _pose_or_none(record["offset"])
        if sds is not None and offset is not None and _is_finite(sds):
            entity = uncertainty_entity(now_ns, pose, pose.theta_rad - offset.theta_rad, sds)
            messages.append(StandardMessage("/scene", stamp_ns, scene(entity)))
        return messages


class DrivenPath:
    """Path of the robot on the floor as entities of a scene, each a piece of the line."""

    def __init__(self) -> None:
        self._points: list[SE2] = []
        self._piece = 0

    def put(self, stamp_ns: int, T_odom_base: SE2) -> Json | None:
        """Return the path's newest piece where the robot is a step further; else None."""
        x_m, y_m, _ = T_odom_base.as_tuple()
        if self._points and math.hypot(self._points[-1].x_m - x_m, self._points[-1].y_m - y_m) < _PATH_STEP_M:
            return None
        self._points.append(T_odom_base)
        if len(self._points) < 2:
            return None
        line = _line(self._points, _PATH_COLOUR)
        entity = _entity(stamp_ns, f"driven path {self._piece}", lines=[line])
        if len(self._points) > _PATH_STEPS:
            self._points, self._piece = self._points[-1:], (self._piece + 1) % _PATH_ENTITIES
        return entity


class Mount(NamedTuple):
    """Camera's mount and field of view, from the `/run` record; `aspect`: width by height of the field of view."""

    geometry: CameraGeometry
    aspect: float | None = None
    """None: square pixels."""

    @staticmethod
    def of_record(record: Mapping[str, Any]) -> Mount:
        """Read the record's `mount`; raises KeyError, TypeError or ValueError."""
        return Mount(
            CameraGeometry(
                math.radians(record["hfov_deg"]),
                float(record["height_m"]),
                math.radians(record["pitch_deg"]),
                float(record["forward_m"]),
            ),
            None if record.get("aspect") is None else float(record["aspect"]),
        )

    def focal_px(self, width: int, height: int) -> tuple[float, float]:
        """Return the focal lengths along x and y, px; they differ where a picture was squeezed."""
        half = math.tan(self.geometry.hfov_rad / 2)
        across = width / 2 / half
        return across, across if self.aspect is None else height / 2 / (half / self.aspect)

    def calibration(self, stamp_ns: int, width: int, height: int) -> Json:
        """Return the `CameraCalibration` of pictures of this size: a pinhole without distortion."""
        fx, fy = (round(focal, 3) for focal in self.focal_px(width, height))
        cx, cy = (width - 1) / 2, (height - 1) / 2
        return {
            "timestamp": stamp(stamp_ns),
            "frame_id": CAMERA,
            "width": width,
            "height": height,
            "distortion_model": "",
            "D": [],
            "K": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
            "R": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            "P": [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        }


def transforms(stamp_ns: int, T_odom_base: SE2, mount: Mount | None) -> Json:
    """Return `FrameTransforms` odom → base, and base → camera where the mount is known."""
    found = [_transform(stamp_ns, (ODOM, BASE), (T_odom_base.x_m, T_odom_base.y_m, 0.0), _yaw(T_odom_base.theta_rad))]
    if mount is not None:
        half, (forward_m, height_m) = mount.geometry.pitch_rad / 2, (mount.geometry.forward_m, mount.geometry.height_m)
        # Downward pitch about y, then the optical axes (x right, y down, z forward): (-0.5, 0.5, -0.5, 0.5).
        down, level = 0.5 * math.sin(half), 0.5 * math.cos(half)
        turned = _quaternion(-level - down, level + down, -level + down, level - down)
        found.append(_transform(stamp_ns, (BASE, CAMERA), (forward_m, 0.0, height_m), turned))
    return {"transforms": found}


def poses_in_frame(stamp_ns: int, poses: Sequence[SE2]) -> Json:
    """Return `PosesInFrame` of poses on the floor, in the odometry's frame."""
    return {"timestamp": stamp(stamp_ns), "frame_id": ODOM, "poses": [_pose(pose) for pose in poses]}


def velocity(command: Sequence[float], state: Sequence[float] | None) -> Json:
    """Return the commanded and the measured velocity as named numbers; without a measurement those are null."""
    names = ("vx_mps", "vy_mps", "wz_radps")
    measured = [None] * 3 if state is None else [round(float(value), 4) for value in state]
    commanded = [round(float(value), 4) for value in command]
    return {
        **{f"commanded_{name}": value for name, value in zip(names, commanded, strict=True)},
        **{f"measured_{name}": value for name, value in zip(names, measured, strict=True)},
    }


def fault_log(stamp_ns: int, record: Mapping[str, Any]) -> StandardMessage:
    """Return the `Log` of a `/fault` record; its level follows the fault's action."""
    raised = record["change"] == "raised"
    level = _LEVEL_OF_ACTION.get(record["action"], ERROR) if raised else INFO
    detail = f": {record['detail']}" if record["detail"] else ""
    return log(stamp_ns, level, "fault", f"{record['name']} {record['change']}{detail}")


def semantic_messages(stamp_ns: int, record: Mapping[str, Any]) -> list[StandardMessage]:
    """Return the reasoning text as `Log`, and anchor and waypoints as a `SceneUpdate`."""
    text = str(record["text"])
    messages = [log(stamp_ns, INFO, "reasoning", text)]
    anchor = _pose_or_none(record["anchor_pose"])
    if anchor is None:
        return messages
    points = record["waypoints"]
    if points is None or not all(_is_finite(point) for point in points):
        points = ()
    places = [anchor @ SE2(float(x_m), float(y_m), 0.0) for x_m, y_m in points]
    plan = next((line for line in text.splitlines() if line.startswith(PLAN_HEAD)), "")
    messages.append(StandardMessage("/scene", stamp_ns, scene(semantic_entity(stamp_ns, anchor, places, plan))))
    return messages


def log(stamp_ns: int, level: int, name: str, message: str) -> StandardMessage:
    """Return a `Log` message; a text beyond 4096 characters is cut."""
    content = {"level": level, "message": message[:_MAX_LOG_CHARS], "name": name, "file": "", "line": 0}
    return StandardMessage("/log", stamp_ns, {"timestamp": stamp(stamp_ns), **content})


def scene(*entities: Json) -> Json:
    """Return a `SceneUpdate`; an entity replaces the earlier one of its id."""
    return {"deletions": [], "entities": list(entities)}


def semantic_entity(stamp_ns: int, anchor: SE2, waypoints: Sequence[SE2], label: str) -> Json:
    """Return the semantic state as an entity: arrow at the anchor, waypoints, the line through them, a label."""
    arrow = {
        "pose": _pose(anchor), "shaft_length": 0.3, "shaft_diameter": 0.05, "head_length": 0.15, "head_diameter": 0.12,
        "color": _colour(_ANCHOR_COLOUR),
    }  # fmt: skip
    spheres = [
        {"pose": _pose(place), "size": _vector(0.15, 0.15, 0.15), "color": _colour(_WAYPOINT_COLOUR)}
        for place in waypoints
    ]
    line = _line((anchor, *waypoints), _WAYPOINT_COLOUR)
    text = {
        "pose": _pose(waypoints[-1] if waypoints else anchor, 0.4), "billboard": True, "font_size": 0.15,
        "scale_invariant": False, "color": _colour(_WAYPOINT_COLOUR), "text": label[:120],
    }  # fmt: skip
    lines, texts = [line] if waypoints else [], [text] if label else []
    return _entity(stamp_ns, "semantic state", arrows=[arrow], spheres=spheres, lines=lines, texts=texts)


def uncertainty_entity(stamp_ns: int, pose: SE2, axis_rad: float, sds: Sequence[float]) -> Json:
    """Return the 2 σ ellipse of the motion since the anchor, m, around the robot; `axis_rad`: the anchor's heading."""
    width_m, depth_m = (2 * _SHOWN_SDS * max(float(sd), 1e-3) for sd in sds[:2])
    flat = {
        "pose": _pose(SE2(pose.x_m, pose.y_m, axis_rad)),
        "size": _vector(width_m, depth_m, 0.01),
        "bottom_scale": 1.0, "top_scale": 1.0, "color": _colour(_ODOMETRY_COLOUR, 0.35),
    }  # fmt: skip
    return _entity(stamp_ns, "odometry 2 sd", cylinders=[flat])


def stamp(stamp_ns: int) -> Json:
    """Return monotonic ns as a message's time."""
    return {"sec": stamp_ns // 1_000_000_000, "nsec": stamp_ns % 1_000_000_000}


def jpeg_size(jpeg: bytes) -> tuple[int, int]:
    """Return width and height of a JPEG, px, from its header. Raises ValueError or struct.error."""
    at = 2
    while jpeg[:2] == b"\xff\xd8" and at + 4 <= len(jpeg) and jpeg[at] == 0xFF:
        kind, length = struct.unpack_from(">BH", jpeg, at + 1)
        if 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):  # a start of frame
            height, width = struct.unpack_from(">HH", jpeg, at + 5)
            return width, height
        at += 2 + length
    raise ValueError("no JPEG, or one without a frame header")


def _end(record: Mapping[str, Any]) -> str:
    faults = record.get("faults") or []
    return "the run ended" + "".join(f"; {fault}" for fault in faults)


def _entity(stamp_ns: int, name: str, **parts: list[Json]) -> Json:
    kinds = ("arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")
    return {
        "timestamp": stamp(stamp_ns), "frame_id": ODOM, "id": name, "lifetime": stamp(0), "frame_locked": False,
        "metadata": [], **{kind: parts.get(kind, []) for kind in kinds},
    }  # fmt: skip


def _line(places: Sequence[SE2], colour: tuple[float, float, float]) -> Json:
    return {
        "type": 0, "pose": _pose(SE2(0.0, 0.0, 0.0)), "thickness": 0.03, "scale_invariant": False,
        "points": [_vector(place.x_m, place.y_m, 0.0) for place in places],
        "color": _colour(colour), "colors": [], "indices": [],
    }  # fmt: skip


def _transform(stamp_ns: int, frames: tuple[str, str], at: tuple[float, float, float], rotation: Json) -> Json:
    parent, child = frames
    return {
        "timestamp": stamp(stamp_ns), "parent_frame_id": parent, "child_frame_id": child,
        "translation": _vector(*at), "rotation": rotation,
    }  # fmt: skip


def _pose(pose: SE2, z_m: float = 0.0) -> Json:
    return {"position": _vector(pose.x_m, pose.y_m, z_m), "orientation": _yaw(pose.theta_rad)}


def _vector(x: float, y: float, z: float) -> Json:
    return {"x": round(x, 4), "y": round(y, 4), "z": round(z, 4)}


def _yaw(theta_rad: float) -> Json:
    return _UPRIGHT if theta_rad == 0 else _quaternion(0.0, 0.0, math.sin(theta_rad / 2), math.cos(theta_rad / 2))


def _quaternion(x: float, y: float, z: float, w: float) -> Json:
    return {"x": round(x, 6), "y": round(y, 6), "z": round(z, 6), "w": round(w, 6)}


def _colour(rgb: tuple[float, float, float], alpha: float = 1.0) -> Json:
    return {"r": rgb[0], "g": rgb[1], "b": rgb[2], "a": alpha}


def _is_finite(values: Sequence[float]) -> bool:
    return all(math.isfinite(value) for value in values)


def _pose_or_none(values: Sequence[float] | None) -> SE2 | None:
    """Return a pose; None for none and for one that is not finite."""
    return None if values is None or not _is_finite(values) else SE2(*(float(value) for value in values))
