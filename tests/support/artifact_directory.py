"""Artifact directories written without the exporter's gate, for tests of what reads them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx

from edge.artifacts.files import MANIFEST_NAME, SCHEMA_VERSION, seal
from export.graphs.build import graph_contract, write_graph
from export.model.network import TicVla
from export.model.tokenizers.nano import NANO_TOKENIZER
from export.quantize.precision import Precision
from export.targets.file import graph_names

Floats = npt.NDArray[np.float32]


def write_artifacts(
    model: TicVla,
    directory: Path,
    *,
    pair: bool = False,
    precision: Precision | None = None,
    precisions: Mapping[str, Precision] | None = None,
) -> Path:
    """The graphs of a model with nano's tokenizer, in one precision but for `precisions`, and their manifest."""
    config, graphs, chosen = model.config, {}, precisions or {}
    for name in graph_names(pair=pair):
        files = write_graph(model, name, chosen.get(name, precision or Precision("fp32")), "fused", directory)
        session = {"provider": "CPUExecutionProvider", "options": {}, "threads": None, "engine": False}
        graphs[name] = {
            "file": files[0],
            "data_files": files[1:],
            **graph_contract(directory / files[0]),
            "session": session,
        }
    (directory / "tokenizer.json").write_bytes(NANO_TOKENIZER.read_bytes())
    files_section: dict[str, Any] = {
        path.name: {"bytes": path.stat().st_size, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
        for path in sorted(directory.iterdir())
    }
    language = config.language
    manifest = {
        "schema_version": SCHEMA_VERSION,
        "target": "cpu",
        "model": {"name": config.name, "trained": False},
        "runtime": {
            "image_px": config.vision.image_px,
            "frame_tokens": config.frame_tokens,
            "kv_dim": config.kv_dim,
            "max_context": language.max_context,
            "max_new_tokens": 48,
            "prefill_chunk_tokens": 256,
            "frame_offsets_s": [0.0, 3.0, 6.0, 9.0],
            "tick_period_ms": 100,
            "control_cores": [],
            "reasoning_cores": [],
            "control_priority": 0,
            "step_s": config.action.step_s,
            **{f"{n}_id": getattr(language, f"{n}_id") for n in ("im_start", "im_end", "img_start", "img_end")},
            "img_context_id": language.img_context_id,
        },
        "graphs": graphs,
        "files": files_section,
        "plan": {},
        "self_test": {},
        "provenance": {},
    }
    (directory / MANIFEST_NAME).write_text(json.dumps(seal(manifest)))
    return directory


def edit_manifest(directory: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change a manifest and seal it again."""
    path = directory / MANIFEST_NAME
    manifest = json.loads(path.read_text())
    change(manifest)
    path.write_text(json.dumps(seal(manifest)))


def replace_file(directory: Path, name: str, data: bytes) -> None:
    """Replace a file and update its hash in the manifest."""
    (directory / name).write_bytes(data)
    entry = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    edit_manifest(directory, lambda m: m["files"].update({name: entry}))


def edit_graph(directory: Path, name: str, change: Callable[[onnx.ModelProto], object]) -> None:
    """Change a graph and list its new hash, as somebody who damages both would."""
    model = onnx.load(str(directory / f"{name}.onnx"))
    change(model)
    replace_file(directory, f"{name}.onnx", model.SerializeToString())


def change_weight(model: onnx.ModelProto, change: Callable[[Floats], object]) -> None:
    """Change the largest weight matrix of a graph in place."""
    floats = [t for t in model.graph.initializer if t.data_type == onnx.TensorProto.FLOAT and len(t.dims) == 2]
    tensor = max(floats, key=lambda tensor: len(tensor.raw_data))
    values = onnx.numpy_helper.to_array(tensor).copy()
    change(values)
    tensor.raw_data = values.tobytes()


def flip_bit(directory: Path, name: str) -> None:
    """Change one bit in the middle of a file."""
    data = bytearray((directory / name).read_bytes())
    data[len(data) // 2] ^= 1
    (directory / name).write_bytes(data)
