"""ROS 2 picture messages as JPEG: compressed ones are checked, raw ones are encoded."""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from edge.core.jpeg import MAX_PX
from firmware_bridge.core.robot_state import CameraError
from firmware_bridge.ros2.messages.picture_heads import CompressedImageHead_, ImageHead_, split_picture

QUALITY: Final = 92
_JPEG_START: Final = b"\xff\xd8"
_MAX_SHOWN: Final = 40
# sensor_msgs/image_encodings.hpp: bytes a pixel, and the conversion to OpenCV's BGR or grey.
_ENCODINGS: Final[dict[str, tuple[int, int | None]]] = {
    "rgb8": (3, cv2.COLOR_RGB2BGR),
    "bgr8": (3, None),
    "8UC3": (3, None),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2BGR),
    "mono8": (1, None),
    "8UC1": (1, None),
    "yuv422": (2, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2BGR_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2BGR_YUY2),
}


def compressed_picture(data: bytes) -> tuple[bytes, int | None]:
    """Return the JPEG and the header's stamp, ns (None: not filled in), of a CompressedImage's CDR bytes.

    Raises CameraError.
    """
    head, jpeg = _split(CompressedImageHead_, data)
    if not jpeg.startswith(_JPEG_START):
        raise CameraError(f"expected a JPEG, found format {head.format[:_MAX_SHOWN]!r} with bytes {jpeg[:4]!r}")
    return jpeg, _stamp_ns(head)


def raw_picture(data: bytes) -> tuple[bytes, int | None]:
    """Encode an Image's CDR bytes; return as `compressed_picture`. Raises CameraError."""
    head, octets = _split(ImageHead_, data)
    pixels = _pixels(head, octets)
    try:
        done, jpeg = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    except cv2.error as error:
        raise CameraError(f"OpenCV: {error.err or error.code}") from error
    if not done:
        raise CameraError("a picture cannot be encoded")
    return jpeg.tobytes(), _stamp_ns(head)


def _pixels(head: ImageHead_, octets: bytes) -> npt.NDArray[np.uint8]:
    """Return BGR or grey pixels."""
    width, height, step, name = head.width, head.height, head.step, head.encoding
    if name not in _ENCODINGS:
        raise CameraError(f"expected an encoding of {', '.join(_ENCODINGS)}, found {name[:_MAX_SHOWN]!r}")
    size, conversion = _ENCODINGS[name]
    if not 0 < min(width, height) <= max(width, height) <= MAX_PX or (size == 2 and width % 2):
        raise CameraError(f"a picture of {width}x{height} pixels in {name}, expected 1 to {MAX_PX} each way")
    if step < width * size or step * height > len(octets):
        raise CameraError(f"a picture of {width}x{height} in {name}: step {step} and {len(octets)} bytes do not fit")
    rows = np.frombuffer(octets, dtype=np.uint8, count=step * height).reshape(height, step)
    pixels = rows[:, : width * size].reshape(height, width, size)
    if conversion is None:
        return np.ascontiguousarray(pixels)
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), conversion), dtype=np.uint8)


def _split(kind: type[CompressedImageHead_] | type[ImageHead_], data: bytes) -> tuple[Any, bytes]:
    try:
        return split_picture(kind, data)
    except ValueError as error:
        raise CameraError(str(error)) from error


def _stamp_ns(head: CompressedImageHead_ | ImageHead_) -> int | None:
    stamp = head.header.stamp
    return stamp.sec * 1_000_000_000 + stamp.nanosec if (stamp.sec, stamp.nanosec) != (0, 0) else None
