"""A safetensors file read tensor by tensor, so that no more than one of its tensors is in memory at a time.

The header is checked here and not by the `safetensors` package, because that one maps the whole file (which counts as
this process's memory) and takes the last of two tensors with one name.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from export.checkpoint.coverage import CheckpointError

MAX_HEADER_BYTES = 100_000_000
"""The limit of the format's own library."""
FLOATS = {"F32": torch.float32, "F16": torch.float16, "BF16": torch.bfloat16}
ITEM_BYTES = {"BOOL": 1, "U8": 1, "I8": 1, "I16": 2, "U16": 2, "I32": 4, "U32": 4, "I64": 8, "U64": 8, "F64": 8}
ITEM_BYTES |= {"F32": 4, "F16": 2, "BF16": 2, "F8_E4M3": 1, "F8_E5M2": 1}


@dataclass(frozen=True)
class Entry:
    """One tensor of the header; `begin` and `end` are offsets in the file, in bytes."""

    dtype: str
    shape: tuple[int, ...]
    begin: int
    end: int


class SafetensorsFile:
    """The checked header of a file, and its tensors on request; raises CheckpointError."""

    def __init__(self, path: Path, label: str) -> None:
        self.path, self.label = path, label
        try:
            self.metadata, self.entries = _parse(path)
        except OSError as error:
            raise CheckpointError(f"{label}: cannot be read ({error.strerror})") from error
        except (ValueError, RecursionError, KeyError, TypeError) as error:
            reason = str(error) if isinstance(error, _FormatError) else "its header is not one"
            raise CheckpointError(f"{label}: not a readable safetensors file ({reason})") from error

    def read(self, name: str) -> Tensor:
        """One tensor in the file's own type; raises CheckpointError unless it is float32, bfloat16 or float16."""
        entry = self.entries[name]
        if entry.dtype not in FLOATS:
            raise CheckpointError(f"{self.label}: {name} is {entry.dtype}, expected {', '.join(FLOATS)}")
        tensor = torch.empty(entry.shape, dtype=FLOATS[entry.dtype])
        with self.path.open("rb") as file:
            file.seek(entry.begin)
            count = file.readinto(tensor.reshape(-1).view(torch.uint8).numpy().data)
        if count != entry.end - entry.begin:
            raise CheckpointError(f"{self.label}: {name} ends after {count} of {entry.end - entry.begin} bytes")
        return tensor


class _FormatError(ValueError):
    pass


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        names = [name for name, _ in pairs]
        raise _FormatError(f"{next(n for n in names if names.count(n) > 1)} is there twice")
    return found


def _parse(path: Path) -> tuple[dict[str, str], dict[str, Entry]]:
    with path.open("rb") as file:
        size = path.stat().st_size
        length = int.from_bytes(file.read(8), "little")
        if size < 8 or not 2 <= length <= min(MAX_HEADER_BYTES, size - 8):
            raise _FormatError(f"{size} bytes with a header of {length}")
        header = json.loads(file.read(length), object_pairs_hook=_unique)
    if not isinstance(header, dict):
        raise _FormatError("its header is not an object")
    metadata = header.pop("__metadata__", {})
    if not isinstance(metadata, dict) or not all(isinstance(value, str) for value in metadata.values()):
        raise _FormatError("its metadata is not text")
    entries = {name: _entry(name, fields, 8 + length) for name, fields in header.items()}
    end = 8 + length
    for name, entry in sorted(entries.items(), key=lambda item: (item[1].begin, item[1].end)):
        if entry.begin != end:
            raise _FormatError(f"{name} begins at byte {entry.begin}, expected {end}")
        end = entry.end
    if end != size:
        raise _FormatError(f"{size} bytes, its header says {end}")
    return metadata, entries


def _entry(name: str, fields: Any, start: int) -> Entry:
    dtype, shape, (begin, end) = fields["dtype"], fields["shape"], fields["data_offsets"]
    if not isinstance(shape, list) or not all(type(n) is int and n >= 0 for n in [*shape, begin, end]):
        raise _FormatError(f"{name} has no shape and offsets")
    if dtype not in ITEM_BYTES:
        raise _FormatError(f"{name} is of unknown type {str(dtype)[:20]!r}")
    if end - begin != prod(shape) * ITEM_BYTES[dtype]:
        raise _FormatError(f"{name} is {dtype}{shape} in {end - begin} bytes")
    return Entry(dtype, tuple(shape), start + begin, start + end)
