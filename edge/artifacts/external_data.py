"""Reads the references of an ONNX file to external weights from its bytes, before any library opens it.

ONNX and ONNX Runtime have each been patched several times for external data that leaves the model's folder (`..`,
symlinks, hard links, unknown keys: faults page, "Model artifacts"). This module therefore does not use their parsers.
It walks the protobuf wire format down to every tensor, and the caller compares the references with the manifest.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

TENSOR = "TensorProto"
FIELDS: Mapping[str, Mapping[int, str]] = {
    "ModelProto": {7: "GraphProto", 20: "TrainingInfoProto", 25: "FunctionProto"},
    "GraphProto": {1: "NodeProto", 5: TENSOR, 15: "SparseTensorProto"},
    "TrainingInfoProto": {1: "GraphProto", 2: "GraphProto"},
    "FunctionProto": {7: "NodeProto", 11: "AttributeProto"},
    "NodeProto": {5: "AttributeProto"},
    "AttributeProto": {
        5: TENSOR, 6: "GraphProto", 10: TENSOR, 11: "GraphProto", 22: "SparseTensorProto", 23: "SparseTensorProto",
    },
    "SparseTensorProto": {1: TENSOR, 2: TENSOR},
}  # fmt: skip
"""Field numbers of onnx.proto that lead to a tensor, by message; a test compares them with onnx's own description."""

_EXTERNAL_DATA = 13  # of TensorProto: repeated {1: key, 2: value}
_KEYS = frozenset({"location", "offset", "length", "checksum"})
_VARINT, _I64, _BYTES, _I32 = 0, 1, 2, 5


class ExternalDataError(ValueError):
    """The bytes are not an ONNX model, or refer to forbidden external data; one line."""


@dataclass(frozen=True)
class ExternalData:
    """Location of a tensor in a file beside the model."""

    location: str
    offset: int
    length: int | None
    """None: to the end of the file."""


def external_data(model: bytes) -> Iterator[ExternalData]:
    """Return every reference of an ONNX model to external data; raises ExternalDataError."""
    waiting: list[tuple[str, memoryview]] = [("ModelProto", memoryview(model))]
    while waiting:
        kind, body = waiting.pop()
        if kind == TENSOR:
            entries = [entry for number, entry in _fields(body) if number == _EXTERNAL_DATA]
            if entries:
                yield _reference(entries)
            continue
        inside = FIELDS[kind]
        waiting += [(inside[number], part) for number, part in _fields(body) if number in inside]


def _reference(entries: list[memoryview]) -> ExternalData:
    found: dict[str, str] = {}
    for entry in entries:
        pair = dict(_fields(entry))
        try:
            key, value = (bytes(pair.get(number, b"")).decode("utf-8") for number in (1, 2))
        except UnicodeDecodeError as error:
            raise ExternalDataError("external data that is not text") from error
        if key not in _KEYS or key in found:
            raise ExternalDataError(f"external data with the key {key!r}, expected {sorted(_KEYS)} once each")
        found[key] = value
    numbers = {key: _number(key, found[key]) for key in ("offset", "length") if key in found}
    return ExternalData(found.get("location", ""), numbers.get("offset", 0), numbers.get("length"))


def _number(key: str, text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) <= 18):
        raise ExternalDataError(f"external data with {key} {text!r}, expected a number of bytes")
    return int(text)


def _fields(body: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Yield (number, content) of a message's length-delimited fields; skip the others."""
    at, end = 0, len(body)
    while at < end:
        tag, at = _varint(body, at)
        number, wire = tag >> 3, tag & 7
        if wire == _VARINT:
            _, at = _varint(body, at)
        elif wire in (_I64, _I32):
            at += 8 if wire == _I64 else 4
        elif wire == _BYTES:
            size, at = _varint(body, at)
            if size > end - at:
                raise ExternalDataError("not an ONNX model: a field is longer than the file")
            yield number, body[at : at + size]
            at += size
        else:
            raise ExternalDataError(f"not an ONNX model: field {number} has wire type {wire}")
        if number == 0 or at > end:
            raise ExternalDataError("not an ONNX model: a field is cut")


def _varint(body: memoryview, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(body):
            raise ExternalDataError("not an ONNX model: a field is cut")
        byte = body[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise ExternalDataError("not an ONNX model: a number is longer than 64 bits")
