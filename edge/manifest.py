"""The artifact directory's manifest: verified before anything in the directory is opened (design §5)."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SCHEMA_VERSION = 1
MANIFEST_NAME = "manifest.json"
MAX_MANIFEST_BYTES = 4_000_000
GRAPH_NAMES = ("vision_encoder", "language_model", "semantic_context", "action_expert")
_PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*", re.ASCII)
_SECTIONS = ("schema_version", "target", "model", "runtime", "graphs", "files", "provenance")


class ArtifactError(ValueError):
    """An artifact directory that must not be run; its text is the one line to show."""


@dataclass(frozen=True)
class TensorContract:
    """Name, element type and shape of a graph's input or output; free axes are named."""

    name: str
    dtype: str
    shape: tuple[int | str, ...]


@dataclass(frozen=True)
class GraphContract:
    """What one graph file takes and gives."""

    file: str
    inputs: tuple[TensorContract, ...]
    outputs: tuple[TensorContract, ...]

    def input(self, name: str) -> TensorContract:
        """The input of that name; raises ArtifactError."""
        return self._find(self.inputs, name)

    def output(self, name: str) -> TensorContract:
        """The output of that name; raises ArtifactError."""
        return self._find(self.outputs, name)

    def _find(self, tensors: tuple[TensorContract, ...], name: str) -> TensorContract:
        for tensor in tensors:
            if tensor.name == name:
                return tensor
        raise ArtifactError(f"{self.file}: no tensor {name!r} in the manifest's I/O contract")


@dataclass(frozen=True)
class RuntimeConfig:
    """What the runner needs to know of the model beyond its graphs."""

    image_px: int
    frame_tokens: int
    kv_dim: int
    max_context: int
    max_new_tokens: int
    frame_offsets_s: tuple[float, ...]
    tick_period_ms: int
    step_s: float
    im_start_id: int
    im_end_id: int
    img_start_id: int
    img_end_id: int
    img_context_id: int

    def __post_init__(self) -> None:
        for name in ("image_px", "frame_tokens", "kv_dim", "max_context", "max_new_tokens", "tick_period_ms", "step_s"):
            if getattr(self, name) <= 0:
                raise ArtifactError(f"{MANIFEST_NAME}: runtime.{name} must be positive, found {getattr(self, name)}")
        if not self.frame_offsets_s or len(self.frame_offsets_s) > 16 or max(self.frame_offsets_s) > 60:
            raise ArtifactError(f"{MANIFEST_NAME}: runtime.frame_offsets_s must be 1 to 16 offsets of at most 60 s")


@dataclass(frozen=True)
class Artifacts:
    """A verified directory: the bytes that were hashed are the bytes that will be run."""

    directory: Path
    manifest_sha256: str
    target: str
    model_name: str
    trained: bool
    runtime: RuntimeConfig
    graphs: Mapping[str, GraphContract]
    contents: Mapping[str, bytes]


def load_artifacts(directory: Path) -> Artifacts:
    """Verify every file's size and SHA-256, the schema version and the I/O contract; raises ArtifactError."""
    raw, manifest = _read_manifest(directory)
    contents = {name: _read_file(directory, name, entry) for name, entry in _section(manifest, "files").items()}
    unlisted = sorted(p.name for p in directory.iterdir() if p.name not in contents and p.name != MANIFEST_NAME)
    if unlisted:
        raise ArtifactError(f"{directory / unlisted[0]}: not listed in the manifest; export again into a new directory")
    graphs = {name: _graph(manifest, name, contents) for name in GRAPH_NAMES}
    if "tokenizer.json" not in contents:
        raise ArtifactError(f"{directory}: tokenizer.json is missing from the manifest")
    model = _section(manifest, "model")
    artifacts = Artifacts(
        directory=directory,
        manifest_sha256=hashlib.sha256(raw).hexdigest(),
        target=str(manifest["target"]),
        model_name=str(model.get("name")),
        trained=model.get("trained") is True,
        runtime=_runtime(_section(manifest, "runtime")),
        graphs=graphs,
        contents=contents,
    )
    check_contract(artifacts)
    return artifacts


def read_manifest(directory: Path) -> dict[str, Any]:
    """The manifest as JSON, checked for version and sections only; raises ArtifactError."""
    return _read_manifest(directory)[1]


def _read_manifest(directory: Path) -> tuple[bytes, dict[str, Any]]:
    path = directory / MANIFEST_NAME
    if not directory.is_dir():
        raise ArtifactError(f"{directory}: not a directory; make one with edge-export --out {directory}")
    try:
        if path.stat().st_size > MAX_MANIFEST_BYTES:
            raise ArtifactError(f"{path}: larger than {MAX_MANIFEST_BYTES} bytes, refused")
        raw = path.read_bytes()
        manifest: Any = json.loads(raw)
    except OSError as error:
        raise ArtifactError(
            f"{path}: cannot be read ({error.strerror}); is this a directory of edge-export?"
        ) from error
    except (ValueError, RecursionError) as error:
        raise ArtifactError(f"{path}: not JSON ({error})") from error
    if not isinstance(manifest, dict):
        raise ArtifactError(f"{path}: expected a JSON object")
    if manifest.get("schema_version") != SCHEMA_VERSION:
        raise ArtifactError(
            f"{path}: schema version {manifest.get('schema_version')!r}, expected {SCHEMA_VERSION}; export again"
        )
    missing = [section for section in _SECTIONS if section not in manifest]
    if missing:
        raise ArtifactError(f"{path}: sections {missing} are missing")
    return raw, manifest


def _section(manifest: Mapping[str, Any], name: str) -> dict[str, Any]:
    section = manifest[name]
    if not isinstance(section, dict):
        raise ArtifactError(f"{MANIFEST_NAME}: {name} must be an object")
    return section


def _read_file(directory: Path, name: str, entry: Any) -> bytes:
    if not _PLAIN_NAME.fullmatch(name) or name == MANIFEST_NAME:
        raise ArtifactError(f"{MANIFEST_NAME}: file name {name!r} is not a plain name")
    path = directory / name
    if (
        not isinstance(entry, dict)
        or not isinstance(entry.get("bytes"), int)
        or not isinstance(entry.get("sha256"), str)
    ):
        raise ArtifactError(f"{MANIFEST_NAME}: entry of {name} must give bytes and sha256")
    if path.is_symlink() or not path.is_file():
        raise ArtifactError(f"{path}: missing or not a regular file")
    if path.stat().st_size != entry["bytes"]:
        raise ArtifactError(f"{path}: {path.stat().st_size} bytes, the manifest says {entry['bytes']}; export again")
    data = path.read_bytes()
    found = hashlib.sha256(data).hexdigest()
    if found != entry["sha256"]:
        raise ArtifactError(f"{path}: sha256 {found[:12]}…, the manifest says {entry['sha256'][:12]}…; export again")
    return data


def _tensors(graph: str, entry: Mapping[str, Any], key: str) -> tuple[TensorContract, ...]:
    tensors: list[TensorContract] = []
    declared = entry.get(key)
    if not isinstance(declared, list):
        raise ArtifactError(f"{MANIFEST_NAME}: graph {graph} has no {key}")
    for item in declared:
        if not isinstance(item, dict) or set(item) != {"name", "dtype", "shape"} or not isinstance(item["shape"], list):
            raise ArtifactError(f"{MANIFEST_NAME}: graph {graph}: {key} must be name, dtype and shape")
        tensors.append(TensorContract(str(item["name"]), str(item["dtype"]), tuple(item["shape"])))
    return tuple(tensors)


def _graph(manifest: Mapping[str, Any], name: str, contents: Mapping[str, bytes]) -> GraphContract:
    entry = _section(manifest, "graphs").get(name)
    if not isinstance(entry, dict):
        raise ArtifactError(f"{MANIFEST_NAME}: graph {name} is missing")
    file = str(entry.get("file"))
    if file not in contents:
        raise ArtifactError(f"{MANIFEST_NAME}: graph {name}: file {file!r} is not among the files")
    return GraphContract(file, _tensors(name, entry, "inputs"), _tensors(name, entry, "outputs"))


def _runtime(section: dict[str, Any]) -> RuntimeConfig:
    fields = RuntimeConfig.__dataclass_fields__
    if set(section) != set(fields):
        raise ArtifactError(f"{MANIFEST_NAME}: runtime has {sorted(section)}, expected {sorted(fields)}")
    offsets = section["frame_offsets_s"]
    numbers = [value for key, value in section.items() if key != "frame_offsets_s"]
    if not isinstance(offsets, list) or not all(
        isinstance(v, int | float) and not isinstance(v, bool) and 0 <= v < 1e6 for v in [*numbers, *offsets]
    ):
        raise ArtifactError(f"{MANIFEST_NAME}: runtime values must be numbers that are not negative")
    values = {
        key: value if key == "step_s" else int(value) for key, value in section.items() if key != "frame_offsets_s"
    }
    return RuntimeConfig(frame_offsets_s=tuple(float(v) for v in offsets), **values)


def check_contract(artifacts: Artifacts) -> None:
    """The graphs must fit one another and the runner: names, types and widths; raises ArtifactError."""
    vision, language, context, action = (artifacts.graphs[name] for name in GRAPH_NAMES)
    runtime = artifacts.runtime
    tokens = vision.output("visual_tokens")
    expected: list[tuple[GraphContract, TensorContract, str, tuple[int | str, ...]]] = [
        (vision, vision.input("frame"), "uint8", (1, runtime.image_px, runtime.image_px, 3)),
        (vision, tokens, "float", (1, *tokens.shape[1:])),
        (language, language.input("input_ids"), "int64", (1, "S")),
        (language, language.input("visual_tokens"), "float", ("F", *tokens.shape[1:])),
        (language, language.output("next_token"), "int64", (1, 1)),
        (language, language.output("last_layer_kv"), "float", (1, "S", runtime.kv_dim)),
        (context, context.input("last_layer_kv"), "float", (1, "T", runtime.kv_dim)),
        (action, action.input("visual_tokens"), "float", tokens.shape),
        (action, action.input("state"), "float", (1, 3)),
        (action, action.input("latency"), "float", (1, 4)),
        (action, action.input("context_keys"), "float", context.output("context_keys").shape),
        (action, action.input("context_values"), "float", context.output("context_values").shape),
    ]
    for graph, tensor, dtype, shape in expected:
        if tensor.dtype != dtype or tensor.shape != shape:
            raise ArtifactError(
                f"{graph.file}: {tensor.name} is {tensor.dtype}{list(tensor.shape)}, "
                f"the runner expects {dtype}{list(shape)}"
            )
    trajectory = action.output("trajectory")
    if trajectory.dtype != "float" or len(trajectory.shape) != 3 or trajectory.shape[2] != 3:
        raise ArtifactError(f"{action.file}: trajectory is {list(trajectory.shape)}, the runner expects [1, steps, 3]")
    steps = trajectory.shape[1]
    if not isinstance(steps, int) or steps * runtime.step_s < 1.0:
        raise ArtifactError(
            f"{action.file}: trajectory of {steps} steps does not reach the 1 s that the controller aims at"
        )
