"""Building an artifact directory: graphs, gate, manifest, report; written aside, then renamed into place."""

from __future__ import annotations

import hashlib
import html
import importlib.metadata
import json
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edge.graph import Graph
from edge.manifest import MANIFEST_NAME, SCHEMA_VERSION, ArtifactError, load_artifacts, read_manifest
from export.graphs import GraphSpec, export_graph, graph_contract, graph_parameters, graph_specs
from export.model.config import TicVlaConfig
from export.model.network import TicVla
from export.model.tokenizer import NANO_TOKENIZER
from export.model.weights import WeightsInfo, weights_sha256
from export.parity import ParityResult, check_graph
from export.target import Target

PACKAGES = ("torch", "onnx", "onnxscript", "onnxruntime", "tokenizers")
Progress = Callable[[str], None]


class GateError(Exception):
    """A graph that is not the same model; its text says which and by how much."""


@dataclass(frozen=True)
class Export:
    """What an export was made of."""

    target: Target
    model: TicVla
    info: WeightsInfo


def manifest_runtime(target: Target, config: TicVlaConfig) -> dict[str, Any]:
    """The manifest's `runtime` section."""
    language = config.language
    return {
        "image_px": config.vision.image_px,
        "frame_tokens": config.frame_tokens,
        "kv_dim": config.kv_dim,
        "max_context": language.max_context,
        "max_new_tokens": target.runtime.max_new_tokens,
        "frame_offsets_s": list(target.runtime.frame_offsets_s),
        "tick_period_ms": target.runtime.tick_period_ms,
        "step_s": config.action.step_s,
        "im_start_id": language.im_start_id,
        "im_end_id": language.im_end_id,
        "img_start_id": language.img_start_id,
        "img_end_id": language.img_end_id,
        "img_context_id": language.img_context_id,
    }


def _file_entry(path: Path) -> dict[str, Any]:
    return {"sha256": hashlib.sha256(path.read_bytes()).hexdigest(), "bytes": path.stat().st_size}


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def build_artifacts(export: Export, out: Path, progress: Progress) -> dict[str, Any]:
    """Write `out`, return its manifest; raises GateError, ArtifactError or OSError and then leaves nothing behind."""
    partial = out.with_name(out.name + ".partial")
    _check_replaceable(out)
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        manifest = _write_directory(export, partial, progress)
        _sync(partial)
        _check_replaceable(out)  # once more: building took its time
        retired = out.with_name(out.name + ".old.partial")
        shutil.rmtree(retired, ignore_errors=True)
        if out.exists():
            out.rename(retired)
        try:
            partial.rename(out)
        except BaseException:
            if retired.exists():
                retired.rename(out)
            raise
        _sync_one(out.parent)
        shutil.rmtree(retired, ignore_errors=True)
        return manifest
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _check_replaceable(out: Path) -> None:
    """An existing directory is replaced only if it is an artifact directory with nothing of the user's beside it."""
    if not out.exists():
        return
    listed = {MANIFEST_NAME, *read_manifest(out)["files"]}
    others = sorted(path.name for path in out.iterdir() if path.name not in listed)
    if others:
        raise ArtifactError(f"{out / others[0]}: not ours, so {out} is not replaced; name another directory")


def _write_directory(export: Export, directory: Path, progress: Progress) -> dict[str, Any]:
    config = export.model.config
    specs = graph_specs(export.model)
    for spec in specs:
        progress(f"exporting {spec.name}")
        export_graph(spec, directory / f"{spec.name}.onnx")
    shutil.copyfile(NANO_TOKENIZER, directory / "tokenizer.json")
    manifest: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION,
        "target": export.target.name,
        "model": {"name": config.name, "trained": export.info.trained, "config": config.to_dict()},
        "runtime": manifest_runtime(export.target, config),
        "graphs": {},
        "provenance": {
            "weights_sha256": weights_sha256(export.model),
            "weights_origin": export.info.origin,
            "calibration": None,
            "packages": {name: importlib.metadata.version(name) for name in PACKAGES},
        },
    }
    for spec in specs:
        path = directory / f"{spec.name}.onnx"
        manifest["graphs"][spec.name] = {
            "file": path.name,
            **graph_contract(path),
            "params": graph_parameters(path),
            "precision": export.target.precision[spec.name],
            "precision_reason": f"target {export.target.name} asks for it",
        }
    _write_manifest(directory, manifest)
    results = check_directory(export, directory, specs, progress)
    for name, result in results.items():
        manifest["graphs"][name]["parity"] = result.to_dict()
    _write_json(directory / "report.json", {key: manifest[key] for key in ("target", "model", "graphs", "provenance")})
    (directory / "report.html").write_text(report_html(manifest), encoding="utf-8")
    _write_manifest(directory, manifest)
    return manifest


def _write_manifest(directory: Path, manifest: dict[str, Any]) -> None:
    names = sorted(path.name for path in directory.iterdir() if path.name != MANIFEST_NAME)
    manifest["files"] = {name: _file_entry(directory / name) for name in names}
    _write_json(directory / MANIFEST_NAME, manifest)


def check_directory(
    export: Export, directory: Path, specs: list[GraphSpec], progress: Progress
) -> dict[str, ParityResult]:
    """Run the gate through the runner's own loader, on the bytes on disk; raises GateError at the first failure."""
    artifacts = load_artifacts(directory)
    results: dict[str, ParityResult] = {}
    for spec in specs:
        progress(f"checking {spec.name} against PyTorch")
        graph = Graph(artifacts, spec.name, threads=1)
        result = check_graph(export.model, spec, graph.run, export.target.parity)
        if result.verdict != "PASS":
            gate = export.target.parity
            raise GateError(
                f"{spec.name}: cosine {result.cosine:.6f} (≥ {gate.min_cosine}), max-abs {result.max_abs:.2e} "
                f"(≤ {gate.max_abs}), difference between inputs {result.min_difference:.2e} (≥ {gate.min_difference}): "
                f"not the same model, nothing was written"
            )
        results[spec.name] = result
    return results


def _sync(directory: Path) -> None:
    for path in [*directory.iterdir(), directory]:
        _sync_one(path)


def _sync_one(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def report_html(manifest: Mapping[str, Any]) -> str:
    """One table a person can read."""
    rows = "".join(
        f"<tr><td>{html.escape(name)}</td><td>{graph['params']:,}</td><td>{graph['precision']}</td>"
        f"<td>{graph['parity']['cosine']:.7f}</td><td>{graph['parity']['max_abs']:.1e}</td>"
        f"<td>{graph['parity']['min_difference']:.1e}</td><td>{graph['parity']['verdict']}</td></tr>"
        for name, graph in manifest["graphs"].items()
    )
    model = manifest["model"]
    trained = "trained" if model["trained"] else "untrained: initial weights, they do not navigate"
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>edge-export</title>'
        "<style>body{font:16px system-ui,sans-serif;margin:2rem auto;max-width:60rem;padding:0 1rem}"
        "table{border-collapse:collapse}td,th{padding:.3rem .8rem;border-bottom:1px solid #ddd;text-align:right}"
        "td:first-child,th:first-child{text-align:left}</style>"
        f"<h1>{html.escape(model['name'])} for {html.escape(manifest['target'])}</h1>"
        f"<p>Weights: {html.escape(manifest['provenance']['weights_origin'])} ({trained}).</p>"
        "<table><tr><th>graph</th><th>parameters</th><th>precision</th><th>cosine</th><th>max-abs</th>"
        f"<th>between inputs</th><th>verdict</th></tr>{rows}</table>"
        "<p>Measured: every graph ran in ONNX Runtime from the bytes in this directory, compared with PyTorch.</p>"
        "</html>\n"
    )


def verify_directory(
    directory: Path, rebuild: Callable[[dict[str, Any]], Export], progress: Progress
) -> dict[str, Any]:
    """Hashes, contract and parity of an existing directory once more; raises ArtifactError or GateError."""
    load_artifacts(directory)
    manifest = read_manifest(directory)
    if not isinstance(manifest["provenance"], dict):
        raise ArtifactError(f"{directory / MANIFEST_NAME}: provenance must be an object")
    export = rebuild(manifest)
    if weights_sha256(export.model) != manifest["provenance"].get("weights_sha256"):
        raise ArtifactError(f"{directory}: was made from other weights than {export.info.origin}; pass --checkpoint")
    results = check_directory(export, directory, graph_specs(export.model), progress)
    return {**manifest, "graphs": {n: {**g, "parity": results[n].to_dict()} for n, g in manifest["graphs"].items()}}
