"""Reads tensors from a safetensors file, a Hugging Face directory or a torch/Lightning file; never runs its code."""

from __future__ import annotations

import json
import os
import re
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from math import prod
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from export.model.weights import CheckpointError
from firmware_bridge.system.input_file import parse_json, read_bytes

SAFETENSORS = "model.safetensors"
INDEX = "model.safetensors.index.json"
MAX_INDEX_BYTES = 16 << 20
TORCH_SUFFIXES = (".ckpt", ".pt", ".pth", ".bin")
NESTED = ("state_dict", "model_state_dict")
"""Keys of the weights in a training checkpoint: Lightning's and the usual one of PyTorch."""
MAX_HEADER_BYTES = 100_000_000
"""Largest header of the `safetensors` library, bytes."""
SAFETENSORS_FLOATS = {"F32": torch.float32, "F16": torch.float16, "BF16": torch.bfloat16}
ITEM_BYTES = {"BOOL": 1, "U8": 1, "I8": 1, "I16": 2, "U16": 2, "I32": 4, "U32": 4, "I64": 8, "U64": 8, "F64": 8}
ITEM_BYTES |= {"F32": 4, "F16": 2, "BF16": 2, "F8_E4M3": 1, "F8_E5M2": 1}
FLOATS = tuple(SAFETENSORS_FLOATS.values())


@dataclass(frozen=True)
class SourceTensor:
    """Tensor that `read` loads."""

    shape: tuple[int, ...]
    read: Callable[[], Tensor]


@dataclass(frozen=True)
class Source:
    """One `--checkpoint`: its tensors by name, and the files behind them."""

    label: str
    tensors: Mapping[str, SourceTensor]
    files: Mapping[str, Path]
    """Weight files by the name recorded as the artifacts' origin (never a path of this machine)."""
    metadata: Mapping[str, str] = field(default_factory=dict)
    outside: tuple[str, ...] = ()
    directory: Path | None = None
    """Hugging Face directory with config.json and tokenizer.json; None for a file."""


def open_source(path: Path) -> Source:
    """Open a checkpoint without reading its tensors; raises CheckpointError."""
    if path.is_dir():
        return _open_directory(path)
    if not path.is_file():
        raise CheckpointError(f"{path}: no such file or directory; expected a checkpoint")
    if path.suffix == ".safetensors":
        return _from_files(path.name, {path.name: path}, {}, None)
    if path.suffix in TORCH_SUFFIXES:
        return _open_torch(path)
    suffixes = ", ".join((".safetensors", *TORCH_SUFFIXES))
    raise CheckpointError(f"{path}: not a checkpoint; expected a directory or a file ending in {suffixes}")


def _from_files(label: str, paths: dict[str, Path], weight_map: dict[str, str], directory: Path | None) -> Source:
    tensors: dict[str, SourceTensor] = {}
    metadata: dict[str, str] = {}
    for file_label, path in paths.items():
        file = SafetensorsFile(path, file_label)
        metadata = file.metadata
        for name, entry in file.entries.items():
            if name in tensors:
                raise CheckpointError(f"{file_label}: {name} is in another file of {label} too")
            if weight_map and weight_map.get(name) != path.name:
                raise CheckpointError(
                    f"{file_label}: {name} is not in the file that {INDEX} names ({weight_map.get(name)})"
                )
            tensors[name] = SourceTensor(entry.shape, partial(file.read, name))
    absent = sorted(set(weight_map) - set(tensors))
    if absent:
        raise CheckpointError(f"{label}: {INDEX} names {absent[0]}, which {weight_map[absent[0]]} does not have")
    return Source(label, tensors, paths, metadata if len(paths) == 1 else {}, directory=directory)


def _open_directory(directory: Path) -> Source:
    label = directory.resolve().name
    index = directory / INDEX
    if index.exists():
        weight_map = _weight_map(directory)
        names = sorted(set(weight_map.values()))
    elif (directory / SAFETENSORS).exists():
        weight_map, names = {}, [SAFETENSORS]
    else:
        found = ", ".join(sorted(p.name for p in directory.iterdir())[:6]) or "nothing"
        raise CheckpointError(f"{directory}: has neither {SAFETENSORS} nor {INDEX}; found {found}")
    paths = {f"{label}/{name}": inside(directory, name) for name in names}
    return _from_files(label, paths, weight_map, directory)


def inside(directory: Path, name: str) -> Path:
    """Return the path of a file in a downloaded directory.

    Raises CheckpointError for a name or a link that leads out of it. Links of the Hugging Face cache from
    `snapshots/REVISION/` into its `blobs/` are followed.
    """
    path = directory / name
    if Path(name).name != name or name in ("", ".", "..") or not name.isprintable():
        raise CheckpointError(f"{directory}: {name!r} is not a file name of this directory")
    # Path.resolve raises RuntimeError for a loop of links before Python 3.13.
    root, target = Path(os.path.realpath(directory)), Path(os.path.realpath(path))
    blobs = root.parent.parent / "blobs"
    cached = root.parent.name == "snapshots" and target.parent == blobs
    if target.parent != root and not cached:
        raise CheckpointError(f"{path}: a link that leads out of the directory; copy the file itself there")
    if not target.is_file():
        raise CheckpointError(f"{path}: no such file; the checkpoint is not complete")
    return path


def read_json(directory: Path, name: str) -> dict[str, Any]:
    """Read a JSON object of a downloaded directory. Raises CheckpointError."""
    path = inside(directory, name)
    try:
        content = parse_json(read_bytes(path, MAX_INDEX_BYTES))
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path}: not readable JSON ({error})") from error
    if not isinstance(content, dict):
        raise CheckpointError(f"{path}: a JSON {type(content).__name__}, expected an object")
    return content


def _weight_map(directory: Path) -> dict[str, str]:
    weight_map = read_json(directory, INDEX).get("weight_map")
    if not isinstance(weight_map, dict) or not weight_map or not all(isinstance(v, str) for v in weight_map.values()):
        raise CheckpointError(f"{directory / INDEX}: has no weight_map of tensor names to file names")
    return weight_map


def _open_torch(path: Path) -> Source:
    try:
        content = torch.load(path, map_location="cpu", mmap=True, weights_only=True)
    except Exception as error:  # a damaged or hostile file may raise any exception in the unpickler
        raise CheckpointError(
            f"{path.name}: not a file of plain tensors, and code in a checkpoint is never run "
            f"({_reason(path, error)}); save its state_dict as safetensors where it was trained"
        ) from error
    outside: tuple[str, ...] = ()
    nested = next((key for key in NESTED if isinstance(content, dict) and isinstance(content.get(key), dict)), None)
    if nested is not None:
        outside = tuple(sorted(str(key) for key in content if key != nested))
        content = content[nested]
    if not isinstance(content, dict) or not content:
        raise CheckpointError(f"{path.name}: holds {type(content).__name__}, expected a state_dict of tensors")
    strange = next((k for k, v in content.items() if not isinstance(k, str) or not isinstance(v, Tensor)), None)
    if strange is not None:
        kind = type(content[strange]).__name__
        raise CheckpointError(f"{path.name}: {strange!r} is {kind}, expected a state_dict of tensors")
    tensors = {name: SourceTensor(tuple(t.shape), _reader(path.name, name, t)) for name, t in content.items()}
    return Source(path.name, tensors, {path.name: path}, outside=outside)


def _reason(path: Path, error: Exception) -> str:
    """Return the reason, without torch's advice to load the file unsafely."""
    code = re.search(r"GLOBAL ([\w.]+)", str(error))
    if code:
        return f"it would call {code[1]}"
    if not zipfile.is_zipfile(path):
        return "not a complete file of torch.save since 1.6"
    return " ".join(str(error).split())[:120]


def _reader(label: str, name: str, tensor: Tensor) -> Callable[[], Tensor]:
    def read() -> Tensor:
        if tensor.dtype not in FLOATS or tensor.layout != torch.strided or tensor.device.type != "cpu":
            kind = f"{str(tensor.dtype).removeprefix('torch.')} ({tensor.layout}, {tensor.device.type})"
            raise CheckpointError(f"{label}: {name} is {kind}, expected float32, bfloat16 or float16")
        return tensor.detach()

    return read


@dataclass(frozen=True)
class Entry:
    """One tensor of a safetensors header; `begin` and `end` are offsets in the file, in bytes."""

    dtype: str
    shape: tuple[int, ...]
    begin: int
    end: int


class SafetensorsFile:
    """Checked header of a safetensors file; tensors are read one at a time. Raises CheckpointError.

    The `safetensors` package would map the whole file into memory and accept two tensors of one name.
    """

    def __init__(self, path: Path, label: str) -> None:
        self.path, self.label = path, label
        try:
            self.metadata, self.entries = _parse(path)
        except OSError as error:
            raise CheckpointError(f"{label}: cannot be read ({error.strerror})") from error
        except (ValueError, RecursionError, KeyError, TypeError) as error:
            reason = str(error) if isinstance(error, _FormatError) else "its header is not JSON"
            raise CheckpointError(f"{label}: not a readable safetensors file ({reason})") from error

    def read(self, name: str) -> Tensor:
        """Read one tensor in the file's type. Raises CheckpointError unless it is float32, bfloat16 or float16."""
        entry = self.entries[name]
        if entry.dtype not in SAFETENSORS_FLOATS:
            raise CheckpointError(f"{self.label}: {name} is {entry.dtype}, expected {', '.join(SAFETENSORS_FLOATS)}")
        tensor = torch.empty(entry.shape, dtype=SAFETENSORS_FLOATS[entry.dtype])
        with self.path.open("rb") as file:
            file.seek(entry.begin)
            count = file.readinto(tensor.reshape(-1).view(torch.uint8).numpy().data)
        if count != entry.end - entry.begin:
            raise CheckpointError(f"{self.label}: {name} ends after {count} of {entry.end - entry.begin} bytes")
        return tensor


class _FormatError(ValueError):
    pass


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in pairs:
        if name in found:
            raise _FormatError(f"{name} occurs twice")
        found[name] = value
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
        raise _FormatError(f"{size} bytes, expected {end} from its header")
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
