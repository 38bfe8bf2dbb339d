"""JSON form of the published schemas that viewers of robot data share (github.com/foxglove/foxglove-sdk, MIT).

A viewer recognises each by its title. Only the messages of `edge.flightlog.standard_messages` are here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

Schema = dict[str, Any]

_NUMBER: Final[Schema] = {"type": "number"}
_NUMBER_OR_NULL: Final[Schema] = {"type": ["number", "null"]}
_INT: Final[Schema] = {"type": "integer"}
_TEXT: Final[Schema] = {"type": "string"}
_BOOL: Final[Schema] = {"type": "boolean"}


def _object(title: str, **properties: Schema) -> Schema:
    """An object whose properties are all required."""
    return {"title": title, "type": "object", "properties": properties, "required": list(properties)}


def _list(items: Schema) -> Schema:
    return {"type": "array", "items": items}


_TIME: Final = _object("time", sec=_INT, nsec=_INT)
_DURATION: Final = _object("duration", sec=_INT, nsec=_INT)
_VECTOR3: Final = _object("foxglove.Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_POINT3: Final = _object("foxglove.Point3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION: Final = _object("foxglove.Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE: Final = _object("foxglove.Pose", position=_VECTOR3, orientation=_QUATERNION)
_COLOUR: Final = _object("foxglove.Color", r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)

COMPRESSED_IMAGE: Final = _object(
    "foxglove.CompressedImage",
    timestamp=_TIME,
    frame_id=_TEXT,
    data={"type": "string", "contentEncoding": "base64"},
    format=_TEXT,
)
CAMERA_CALIBRATION: Final = _object(
    "foxglove.CameraCalibration",
    timestamp=_TIME,
    frame_id=_TEXT,
    width=_INT,
    height=_INT,
    distortion_model=_TEXT,
    D=_list(_NUMBER),
    K=_list(_NUMBER),
    R=_list(_NUMBER),
    P=_list(_NUMBER),
)
FRAME_TRANSFORMS: Final = _object(
    "foxglove.FrameTransforms",
    transforms=_list(
        _object(
            "foxglove.FrameTransform",
            timestamp=_TIME,
            parent_frame_id=_TEXT,
            child_frame_id=_TEXT,
            translation=_VECTOR3,
            rotation=_QUATERNION,
        )
    ),
)
POSES_IN_FRAME: Final = _object("foxglove.PosesInFrame", timestamp=_TIME, frame_id=_TEXT, poses=_list(_POSE))
LOG: Final = _object("foxglove.Log", timestamp=_TIME, level=_INT, message=_TEXT, name=_TEXT, file=_TEXT, line=_INT)
_ARROW: Final = _object(
    "foxglove.ArrowPrimitive",
    pose=_POSE,
    shaft_length=_NUMBER,
    shaft_diameter=_NUMBER,
    head_length=_NUMBER,
    head_diameter=_NUMBER,
    color=_COLOUR,
)
_SPHERE: Final = _object("foxglove.SpherePrimitive", pose=_POSE, size=_VECTOR3, color=_COLOUR)
_CYLINDER: Final = _object(
    "foxglove.CylinderPrimitive", pose=_POSE, size=_VECTOR3, bottom_scale=_NUMBER, top_scale=_NUMBER, color=_COLOUR
)
_LINE: Final = _object(
    "foxglove.LinePrimitive",
    type=_INT,
    pose=_POSE,
    thickness=_NUMBER,
    scale_invariant=_BOOL,
    points=_list(_POINT3),
    color=_COLOUR,
    colors=_list(_COLOUR),
    indices=_list(_INT),
)
_LABEL: Final = _object(
    "foxglove.TextPrimitive",
    pose=_POSE,
    billboard=_BOOL,
    font_size=_NUMBER,
    scale_invariant=_BOOL,
    color=_COLOUR,
    text=_TEXT,
)
_EMPTY_LIST: Final[Schema] = {"type": "array"}
SCENE_UPDATE: Final = _object(
    "foxglove.SceneUpdate",
    deletions=_list(_object("foxglove.SceneEntityDeletion", timestamp=_TIME, type=_INT, id=_TEXT)),
    entities=_list(
        _object(
            "foxglove.SceneEntity",
            timestamp=_TIME,
            frame_id=_TEXT,
            id=_TEXT,
            lifetime=_DURATION,
            frame_locked=_BOOL,
            metadata=_list(_object("foxglove.KeyValuePair", key=_TEXT, value=_TEXT)),
            arrows=_list(_ARROW),
            cubes=_EMPTY_LIST,
            spheres=_list(_SPHERE),
            cylinders=_list(_CYLINDER),
            lines=_list(_LINE),
            triangles=_EMPTY_LIST,
            texts=_list(_LABEL),
            models=_EMPTY_LIST,
        )
    ),
)

VELOCITY: Final = _object(
    "tic_vla.Velocity",
    commanded_vx_mps=_NUMBER,
    commanded_vy_mps=_NUMBER,
    commanded_wz_radps=_NUMBER,
    measured_vx_mps=_NUMBER_OR_NULL,
    measured_vy_mps=_NUMBER_OR_NULL,
    measured_wz_radps=_NUMBER_OR_NULL,
)
"""Ours, because there is no published schema: named numbers that a viewer can plot."""

STANDARD_SCHEMAS: Final[Mapping[str, Schema]] = {
    "/camera/calibration": CAMERA_CALIBRATION,
    "/tf": FRAME_TRANSFORMS,
    "/plan": POSES_IN_FRAME,
    "/scene": SCENE_UPDATE,
    "/log": LOG,
    "/velocity": VELOCITY,
}
"""Topics beside the runner's own records."""
