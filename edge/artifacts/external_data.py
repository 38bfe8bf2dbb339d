"""Reads the references of an ONNX file to external weights from its bytes, before any library opens it.

ONNX and ONNX Runtime have each been patched several times for external data that leaves the model's folder (`..`,
symlinks, hard links, unknown keys: faults page, "Model artifacts"). This module therefore does not use their parsers.
It walks the protobuf wire format down to every tensor, and the caller compares the references with the manifest. The
walk keeps one iterator per open message: a list of parts would take a hundred times the file's size for empty ones.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
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
MAX_FIELDS = 1_000_000
"""Most fields of a model outside its tensors' values; an export has up to some thousand."""
MAX_DEPTH = 100
"""Deepest nesting of messages: that of protobuf's own parsers."""
MAX_ENTRY_BYTES = 1024
"""Largest key and value of external data together, bytes: a file's name or a number."""
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
    return _walk("ModelProto", memoryview(model), iter(range(MAX_FIELDS)), 1)


def _walk(kind: str, body: memoryview, left: Iterator[int], depth: int) -> Iterator[ExternalData]:
    """Yield the references inside a message; every field takes one of `left`."""
    if depth > MAX_DEPTH:
        raise ExternalDataError(f"messages nested deeper than {MAX_DEPTH} levels")
    if kind == TENSOR:
        reference = _reference((entry for number, entry in _fields(body, left) if number == _EXTERNAL_DATA), left)
        if reference is not None:
            yield reference
        return
    inside = FIELDS[kind]
    for number, part in _fields(body, left):
        if number in inside:
            yield from _walk(inside[number], part, left, depth + 1)


def _reference(entries: Iterable[memoryview], left: Iterator[int]) -> ExternalData | None:
    """Return the reference of a tensor's entries; None without any."""
    found: dict[str, str] = {}
    for entry in entries:
        if len(entry) > MAX_ENTRY_BYTES:
            raise ExternalDataError(f"external data of {len(entry)} bytes, expected at most {MAX_ENTRY_BYTES}")
        pair = dict(_fields(entry, left))
        try:
            key, value = (bytes(pair.get(number, b"")).decode("utf-8") for number in (1, 2))
        except UnicodeDecodeError as error:
            raise ExternalDataError("external data that is not text") from error
        if key not in _KEYS or key in found:
            raise ExternalDataError(f"external data with the key {key!r}, expected {sorted(_KEYS)} once each")
        found[key] = value
    if not found:
        return None
    numbers = {key: _number(key, found[key]) for key in ("offset", "length") if key in found}
    return ExternalData(found.get("location", ""), numbers.get("offset", 0), numbers.get("length"))


def _number(key: str, text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) <= 18):
        raise ExternalDataError(f"external data with {key} {text!r}, expected a number of bytes")
    return int(text)


def _fields(body: memoryview, left: Iterator[int]) -> Iterator[tuple[int, memoryview]]:
    """Yield (number, content) of a message's length-delimited fields; skip the others. Each takes one of `left`."""
    at, end = 0, len(body)
    while at < end:
        if next(left, None) is None:
            raise ExternalDataError(f"more than {MAX_FIELDS} fields")
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
