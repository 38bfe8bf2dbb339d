"""Where tensors come from: a safetensors file, a Hugging Face directory or a torch/Lightning file; no code is run."""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from export.checkpoint.coverage import CheckpointError
from export.checkpoint.safetensors_file import SafetensorsFile

SAFETENSORS = "model.safetensors"
INDEX = "model.safetensors.index.json"
MAX_INDEX_BYTES = 16 << 20
TORCH_SUFFIXES = (".ckpt", ".pt", ".pth", ".bin")
NESTED = ("state_dict", "model_state_dict")
"""Where a training checkpoint keeps its weights: Lightning's name and PyTorch's customary one."""
FLOATS = (torch.float32, torch.float16, torch.bfloat16)


@dataclass(frozen=True)
class SourceTensor:
    """A tensor that is read when `read` is called."""

    shape: tuple[int, ...]
    read: Callable[[], Tensor]


@dataclass(frozen=True)
class Source:
    """One `--checkpoint`: its tensors by name, and the files behind them."""

    label: str
    tensors: Mapping[str, SourceTensor]
    files: Mapping[str, Path]
    """Weights files by the name that the artifacts' origin gives them (never a path of this machine)."""
    metadata: Mapping[str, str] = field(default_factory=dict)
    outside: tuple[str, ...] = ()
    directory: Path | None = None
    """The Hugging Face directory, which also has config.json and tokenizer.json."""


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
                raise CheckpointError(f"{file_label}: {name} is not where {INDEX} says ({weight_map.get(name)})")
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
    """A file of a downloaded directory; raises CheckpointError for a name or a link that leads out of it.

    The Hugging Face cache is made of links from `snapshots/REVISION/` into its own `blobs/`: those are followed.
    """
    path = directory / name
    if Path(name).name != name or name in ("", ".", ".."):
        raise CheckpointError(f"{directory}: {name!r} is not a file name of this directory")
    root, target = directory.resolve(), path.resolve()
    blobs = root.parent.parent / "blobs"
    cached = root.parent.name == "snapshots" and target.parent == blobs
    if target.parent != root and not cached:
        raise CheckpointError(f"{path}: a link that leads out of the directory; copy the file itself there")
    if not target.is_file():
        raise CheckpointError(f"{path}: no such file; the checkpoint is not complete")
    return path


def read_json(directory: Path, name: str) -> dict[str, Any]:
    """A JSON object of a downloaded directory; raises CheckpointError."""
    path = inside(directory, name)
    try:
        if path.stat().st_size > MAX_INDEX_BYTES:
            raise CheckpointError(f"{path}: {path.stat().st_size} bytes, expected at most {MAX_INDEX_BYTES}")
        content = json.loads(path.read_bytes())
    except CheckpointError:
        raise
    except (OSError, ValueError, RecursionError) as error:
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
    except Exception as error:  # a broken or hostile file fails in the unpickler in any way it likes
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
    """What stands in the way, without torch's advice to load the file unsafely."""
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
