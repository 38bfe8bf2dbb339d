"""The parts of picture messages before their pixels, so that megabytes need not be decoded into numbers.

Each has the members of its message up to the octets, whose count becomes the last member. They are never announced.
"""

# ruff: noqa: N801 - as the messages that they begin
# cyclonedds reads these annotations at run time, so `from __future__ import annotations` must stay away from here.
from dataclasses import dataclass
from typing import Any

import cyclonedds.idl.types as t
from cyclonedds.idl import IdlStruct

from firmware_bridge.dds.binding import Octet
from firmware_bridge.ros2.messages.common import Header_


@dataclass
class CompressedImageHead_(IdlStruct, typename="heads.CompressedImage_"):
    header: Header_
    format: str
    size: t.uint32


@dataclass
class ImageHead_(IdlStruct, typename="heads.Image_"):
    header: Header_
    height: t.uint32
    width: t.uint32
    encoding: str
    is_bigendian: Octet
    step: t.uint32
    size: t.uint32


def split_picture(kind: Any, data: bytes) -> tuple[Any, bytes]:
    """Return the head of class `kind` and the octets after it; `data`: the message's CDR bytes with their header.

    Raises ValueError for bytes that are no such message.
    """
    try:
        head = kind.deserialize(data)
        start = len(head.serialize())
    except Exception as error:
        raise ValueError(f"{len(data)} bytes are no {kind.__name__.removesuffix('Head_')}") from error
    octets = data[start : start + head.size]
    if len(octets) != head.size:
        raise ValueError(f"expected {head.size} octets of a picture, found {len(octets)}")
    return head, octets
