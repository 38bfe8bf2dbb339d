"""Everything that a contender opens, made once and stamped: `python -m tools.bench.peers.models.prepare` in the peers'
venv.

A stamp is written last and names the recipe and the versions it was made with; what has its stamp is not made again.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.metadata
import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

RECIPE = 1
"""Raised whenever what a converter writes changes."""


@dataclass(frozen=True)
class Asset:
    """A folder below the model's cache folder, the function that fills it, and the packages it depends on."""

    folder: str
    module: str
    function: str
    kind: str
    packages: tuple[str, ...]


def _asset(folder: str, module: str, function: str, *packages: str) -> Asset:
    kind = folder.rpartition("/")[2].partition("-")[2]
    return Asset(folder, "tools.bench.peers.models.convert_" + module, function, kind, packages)


_OV = ("openvino", "nncf")
ASSETS = {
    asset.folder: asset
    for asset in (
        _asset("openvino/encoder-fp32", "openvino", "write_encoder", *_OV),
        _asset("openvino/encoder-int8", "openvino", "write_encoder", *_OV),
        _asset("openvino/action-fp32", "openvino", "write_action", *_OV),
        _asset("openvino/action-int8", "openvino", "write_action", *_OV),
        _asset("openvino/language-int8", "openvino", "write_language", *_OV),
        _asset("openvino/language-int4", "openvino", "write_language", *_OV),
        _asset("onnxruntime/action-fp32", "onnx", "write_action", "onnxruntime", "onnx"),
        _asset("onnxruntime/action-int8", "onnx", "write_action", "onnxruntime", "onnx"),
        _asset("llama/language-q4_0", "gguf", "write_gguf", "gguf"),
        _asset("llama/language-q8_0", "gguf", "write_gguf", "gguf"),
        _asset("genai/language-int4", "onnx", "write_genai", "onnxruntime-genai"),
    )
}


def _fill(write: Callable[..., None], workload: object, reference: Path, kind: str, folder: Path) -> None:
    write(workload, reference, folder, kind)


def stamp(packages: tuple[str, ...]) -> dict[str, Any]:
    """What a finished folder was made with."""
    return {"recipe": RECIPE, "versions": {name: importlib.metadata.version(name) for name in packages}}


def make(folder: Path, content: dict[str, Any], fill: Callable[[Path], None]) -> bool:
    """Fill a folder unless its stamp says that it is as wanted; returns whether there was work to do."""
    seal = folder / "stamp.json"
    if seal.is_file() and json.loads(seal.read_text(encoding="utf-8")) == content:
        return False
    partial = folder.with_name(folder.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    fill(partial)
    (partial / seal.name).write_text(json.dumps(content), encoding="utf-8")
    shutil.rmtree(folder, ignore_errors=True)
    partial.rename(folder)
    return True


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--model", required=True)
    p.add_argument("--cache", type=Path, required=True, metavar="DIR")
    p.add_argument("assets", nargs="+", metavar="ASSET", choices=["reference", *ASSETS])
    args = p.parse_args(argv)
    from tools.bench.peers.models.reference import write_reference
    from tools.bench.peers.workload import Workload

    workload, root = Workload(args.model), args.cache / args.model
    reference = root / "reference"
    make(reference, stamp(("torch", "safetensors")), lambda folder: write_reference(workload, folder))
    for name in args.assets:
        if name == "reference":
            continue
        asset = ASSETS[name]
        sys.stderr.write(f"preparing {name}\n")
        write = getattr(importlib.import_module(asset.module), asset.function)
        make(root / name, stamp(asset.packages), partial(_fill, write, workload, reference, asset.kind))
    return 0


if __name__ == "__main__":
    sys.exit(main())
