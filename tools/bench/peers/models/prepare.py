"""Builds the contenders' models once: run as a module by the Python of the peers' environment.

A stamp with recipe and versions is written last; a folder with a valid stamp is not built again.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.metadata
import json
import shutil
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

RECIPE = 1
"""Version of the converters' output; increase it with every change."""


_OPENVINO = ("openvino", "nncf")
_ONNXRUNTIME = ("onnxruntime", "onnx")
ASSETS = {
    "openvino/encoder-fp32": ("convert_openvino", "write_encoder", _OPENVINO),
    "openvino/encoder-int8": ("convert_openvino", "write_encoder", _OPENVINO),
    "openvino/action-fp32": ("convert_openvino", "write_action", _OPENVINO),
    "openvino/action-int8": ("convert_openvino", "write_action", _OPENVINO),
    "openvino/language-int8": ("convert_openvino", "write_language", _OPENVINO),
    "openvino/language-int4": ("convert_openvino", "write_language", _OPENVINO),
    "onnxruntime/action-fp32": ("convert_onnx", "write_action", _ONNXRUNTIME),
    "onnxruntime/action-int8": ("convert_onnx", "write_action", _ONNXRUNTIME),
    "llama/language-q4_0": ("convert_gguf", "write_gguf", ("gguf",)),
    "llama/language-q8_0": ("convert_gguf", "write_gguf", ("gguf",)),
    "genai/language-int4": ("convert_onnx", "write_genai", ("onnxruntime-genai",)),
}
"""Folder below the model's cache folder (RUNTIME/PART-KIND) → module and function that fill it, and its packages."""


def stamp(packages: tuple[str, ...]) -> dict[str, Any]:
    """Return the stamp of a finished folder."""
    return {"recipe": RECIPE, "versions": {name: importlib.metadata.version(name) for name in packages}}


def make(folder: Path, content: dict[str, Any], fill: Callable[[Path], None]) -> bool:
    """Fill a folder unless its stamp has this content; returns whether it was filled."""
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
    """Run the command; returns its exit code."""
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
        module, function, packages = ASSETS[name]
        sys.stderr.write(f"preparing {name}\n")
        write = getattr(importlib.import_module(f"tools.bench.peers.models.{module}"), function)
        kind = name.partition("-")[2]
        make(root / name, stamp(packages), partial(write, workload, reference, kind=kind))
    return 0


if __name__ == "__main__":
    sys.exit(main())
