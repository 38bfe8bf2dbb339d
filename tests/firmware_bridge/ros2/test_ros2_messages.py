"""The ROS 2 types against an independent serialiser: equal bytes in both directions."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any, get_args, get_origin, get_type_hints

import cyclonedds.idl.types as t
import numpy as np
import pytest
from cyclonedds.idl import IdlStruct
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from firmware_bridge.ros2.messages import common, navigation, sensors
from firmware_bridge.ros2.messages.picture_heads import CompressedImageHead_, ImageHead_, split_picture

TYPES = [
    kind
    for kind in {**vars(common), **vars(sensors), **vars(navigation)}.values()
    if isinstance(kind, type) and issubclass(kind, IdlStruct) and kind is not IdlStruct
]
NUMBERS = {
    "int32": st.integers(-(2**31), 2**31 - 1),
    "uint32": st.integers(0, 2**32 - 1),
    "byte": st.integers(0, 255),
    "uint8": st.integers(0, 255),
    "float32": st.floats(width=32, allow_nan=False),
    "float64": st.floats(allow_nan=False),
}
NUMPY = {"byte": np.uint8, "uint8": np.uint8, "float32": np.float32, "float64": np.float64}


@cache
def store() -> Any:
    return get_typestore(Stores.ROS2_JAZZY)


def ros_name(kind: type) -> str:
    """`nav_msgs/msg/Odometry` of the class `Odometry_`."""
    package, _, _, name = kind.__idl_typename__.split(".")
    return f"{package}/msg/{name.removesuffix('_')}"


def fields(kind: type) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def values(hint: Any) -> st.SearchStrategy[Any]:
    """Any value of a field."""
    if hint is str:
        return st.text(st.characters(exclude_characters="\0", exclude_categories=("Cs",)), max_size=12)
    if hint is bool:
        return st.booleans()
    if isinstance(hint, type) and issubclass(hint, IdlStruct):
        return messages(hint)
    about = get_args(hint)[1]
    if isinstance(about, str):
        return NUMBERS[about]
    each, length = about.subtype, getattr(about, "length", None)
    bounds = {"max_size": 3} if length is None else {"min_size": length, "max_size": length}
    return st.lists(values(each), **bounds)


def messages(kind: type) -> st.SearchStrategy[Any]:
    return st.builds(kind, **{name: values(hint) for name, hint in fields(kind).items()})


def as_ros(message: Any, hint: Any) -> Any:
    """The same value as an object of the other serialiser."""
    if isinstance(hint, type) and issubclass(hint, IdlStruct):
        content = {name: as_ros(getattr(message, name), each) for name, each in fields(hint).items()}
        if "level" in content:  # the other serialiser takes ROS's `byte` as signed
            content["level"] = (content["level"] + 128) % 256 - 128
        return store().types[ros_name(hint)](**content)
    if get_origin(hint) is not None or hasattr(hint, "__metadata__"):
        about = get_args(hint)[1]
        if not isinstance(about, str):
            number = get_args(about.subtype)[1] if hasattr(about.subtype, "__metadata__") else None
            if number in NUMPY:
                return np.array(message, dtype=NUMPY[number])
            return [as_ros(each, about.subtype) for each in message]
    return message


def test_every_type_of_the_list_is_there() -> None:
    assert {ros_name(kind) for kind in TYPES} >= {
        *("builtin_interfaces/msg/Time", "std_msgs/msg/Header", "std_msgs/msg/String"),
        *("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/TransformStamped"),
        *("nav_msgs/msg/Odometry", "nav_msgs/msg/Path", "tf2_msgs/msg/TFMessage"),
        *("sensor_msgs/msg/Imu", "sensor_msgs/msg/BatteryState", "sensor_msgs/msg/CompressedImage"),
        *("sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo", "diagnostic_msgs/msg/DiagnosticArray"),
    }


@pytest.mark.slow
@pytest.mark.parametrize("kind", TYPES, ids=ros_name)
def test_the_bytes_are_those_of_another_serialiser_in_both_directions(kind: type) -> None:
    @settings(max_examples=15)
    @given(messages(kind))
    def holds(message: Any) -> None:
        data = message.serialize()
        assert data == bytes(store().serialize_cdr(as_ros(message, kind), ros_name(kind)))
        assert kind.deserialize(data).serialize() == data

    holds()


@pytest.mark.parametrize("kind", TYPES, ids=ros_name)
def test_big_endian_bytes_of_another_machine_are_read(kind: type) -> None:
    @settings(max_examples=3)
    @given(messages(kind))
    def holds(message: Any) -> None:
        data = bytes(store().serialize_cdr(as_ros(message, kind), ros_name(kind), little_endian=False))
        assert kind.deserialize(data).serialize() == message.serialize()

    holds()


@pytest.mark.parametrize("kind", TYPES, ids=ros_name)
def test_no_type_declares_an_octet_that_a_0_10_2_robot_dies_of(kind: type) -> None:
    with_uint8 = not hasattr(t, "byte")  # 0.10 has no other octet, and announces it as TK_BYTE
    for field in dataclasses.fields(kind):
        assert ("uint8" in str(field.type)) <= with_uint8, f"{kind.__name__}.{field.name}"


@pytest.mark.parametrize("kind", TYPES, ids=ros_name)
def test_another_serialiser_reads_our_bytes_as_the_same_message(kind: type) -> None:
    @settings(max_examples=5)
    @given(messages(kind))
    def holds(message: Any) -> None:
        read = store().deserialize_cdr(message.serialize(), ros_name(kind))
        assert bytes(store().serialize_cdr(read, ros_name(kind))) == message.serialize()

    holds()


@pytest.mark.parametrize(
    ("head", "kind"),
    [(CompressedImageHead_, sensors.CompressedImage_), (ImageHead_, sensors.Image_)],
    ids=lambda kind: kind.__name__,
)
@pytest.mark.parametrize("little_endian", [True, False])
def test_a_picture_is_split_as_the_other_serialiser_wrote_it(head: Any, kind: Any, little_endian: bool) -> None:
    @settings(max_examples=15)
    @given(messages(kind))
    def holds(message: Any) -> None:
        data = bytes(store().serialize_cdr(as_ros(message, kind), ros_name(kind), little_endian=little_endian))
        found, octets = split_picture(head, data)
        assert octets == bytes(message.data) and found.size == len(message.data)
        assert all(getattr(found, name) == getattr(message, name) for name in fields(kind) if name != "data")

    holds()
