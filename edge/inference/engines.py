"""Engines of TensorRT and OpenVINO: built ahead of time on the device, checked before control starts.

Otherwise a compiling provider would compile at the first run, for minutes and without a message. Every graph that needs
an engine gets one in its own folder; `engines.json` lists the engine's inputs and the hash of each file.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from edge.artifacts.files import HASH_BLOCK_BYTES, FileIdentity, read_manifest
from edge.artifacts.manifest import Artifacts, TensorContract
from edge.core.cli import write_whole
from edge.core.device import OPENVINO, TENSORRT, DeviceFacts, available_providers, read_device
from edge.inference.graph import CONTEXT_AXIS, DTYPES, Array, Graph, GraphError
from firmware_bridge.system.input_file import read_json

ENGINES_NAME = "engines.json"
SCHEMA = 1
MAX_BYTES = 4_000_000
BUSY_LINE_S = 15.0
TIMING_SUFFIX = ".timing"
PROFILES = ("min", "opt", "max")
_CACHE_OPTIONS = {
    TENSORRT: ("trt_engine_cache_path", "trt_timing_cache_path"),
    OPENVINO: ("cache_dir",),
}

Progress = Callable[[str], None]


class EngineError(ValueError):
    """An engine is missing, was built for another device, or cannot be built; the message is one line."""


class Runnable(Protocol):
    """An opened graph."""

    def run(self, feeds: Mapping[str, Array], outputs: Sequence[str] | None = None) -> list[Array]:
        """Outputs for named inputs."""


@dataclass(frozen=True)
class Machine:
    """Access to the device and ONNX Runtime; tests replace it."""

    facts: Callable[[str], DeviceFacts] = read_device
    providers: Callable[[], list[str]] = available_providers
    open_graph: Callable[[Artifacts, str], Runnable] = Graph
    now_ns: Callable[[], int] = time.monotonic_ns


@dataclass(frozen=True)
class VerifiedEngines:
    """Identities of the engine files from before the comparison of their hashes; empty without engines."""

    identities: Mapping[Path, Mapping[str, FileIdentity]]
    """Files of each engine's folder."""

    def check_unchanged(self) -> None:
        """Raise EngineError if a file has changed since its verification; call it after the graphs are opened."""
        for folder, before in self.identities.items():
            after = _identities(folder)
            for file in sorted({*before, *after}):
                if before.get(file) != after.get(file):
                    raise EngineError(f"{folder / file}: changed while the engines were opened; start again")


def default_directory(artifacts: Path) -> Path:
    """Return the default folder of an artifact directory's engines: beside it, because it is sealed."""
    return artifacts.with_name(artifacts.name + ".engines")


def needed(artifacts: Artifacts) -> list[str]:
    """Return the names of the graphs that need an engine."""
    return [name for name, graph in artifacts.graphs.items() if graph.session.engine]


def with_engines(artifacts: Artifacts, directory: Path) -> Artifacts:
    """Return the artifacts with the sessions' engine folders set; raises EngineError."""
    graphs = dict(artifacts.graphs)
    for name in needed(artifacts):
        graphs[name] = _redirected(artifacts, name, directory / name)
    return dataclasses.replace(artifacts, graphs=graphs)


def with_built_engines(artifacts: Artifacts) -> Artifacts:
    """Return the artifacts with the engines built beside them, or as they are where none is needed.

    Raises EngineError where one is missing or was built for something else.
    """
    if not needed(artifacts):
        return artifacts
    folder = default_directory(artifacts.directory)
    check(artifacts, folder)
    return with_engines(artifacts, folder)


def _redirected(artifacts: Artifacts, name: str, folder: Path) -> Any:
    graph = artifacts.graphs[name]
    keys = _CACHE_OPTIONS.get(graph.session.provider)
    if keys is None:
        raise EngineError(
            f"{name}: {graph.session.provider} is not a provider whose engines can be kept; expected "
            f"{' or '.join(_CACHE_OPTIONS)}"
        )
    options = {**graph.session.options, **dict.fromkeys(keys, str(folder))}
    return dataclasses.replace(graph, session=dataclasses.replace(graph.session, options=options))


def engine_inputs(artifacts: Artifacts, name: str, machine: Machine) -> dict[str, Any]:
    """Return all inputs of an engine; their hash is the engine's key."""
    graph = artifacts.graphs[name]
    listed = read_manifest(artifacts.directory)["files"]
    return {
        "files": {file: str(listed[file]["sha256"]) for file in (graph.file, *graph.data_files)},
        "provider": graph.session.provider,
        "options": dict(sorted(graph.session.options.items())),
        **machine.facts(graph.session.provider).to_dict(),
    }


def key_of(inputs: Mapping[str, Any]) -> str:
    """Hash of an engine's inputs."""
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()


def check(artifacts: Artifacts, directory: Path, machine: Machine | None = None) -> VerifiedEngines:
    """Verify every required engine; return a detector of files that change afterwards.

    Raises EngineError with the command to run, unless every engine is present and was built for this device.
    """
    machine = machine or Machine()
    names = needed(artifacts)
    if not names:
        return VerifiedEngines({})
    identities = {directory / name: _identities(directory / name) for name in names}
    _check_profiles(artifacts, names)
    entries = _read(directory)
    for name in names:
        wrong = _wrong(artifacts, name, directory, entries.get(name), machine)
        if wrong is not None:
            raise EngineError(
                f"{name}: {wrong}; build it first: edge-install engines --artifacts {artifacts.directory} "
                f"--engines {directory}"
            )
    return VerifiedEngines(identities)


def _wrong(artifacts: Artifacts, name: str, directory: Path, entry: Any, machine: Machine) -> str | None:
    """Return an engine's defect, for a message; None for a valid engine."""
    if not isinstance(entry, dict):
        return f"has no engine in {directory}"
    inputs = engine_inputs(artifacts, name, machine)
    if entry.get("key") != key_of(inputs):
        before = entry.get("inputs")
        known = before if isinstance(before, dict) else {}
        changed = [f"{k} {known.get(k)} → {inputs[k]}" for k in inputs if known.get(k) != inputs[k] and k != "files"]
        return f"its engine was built for something else ({', '.join(changed) or 'another model'})"
    files = entry.get("files")
    if not isinstance(files, dict) or not files:
        return f"{ENGINES_NAME} lists no files of its engine"
    try:
        found = _hashes(directory / name)
    except OSError as error:
        return f"its engine cannot be read ({error.strerror})"
    for file in sorted({*files, *found}):
        if files.get(file) != found.get(file):
            return f"{directory / name / file} is not the file that was built"
    return None


def _read(directory: Path) -> dict[str, Any]:
    """Return the entries of engines.json; empty for a missing or damaged file."""
    path = directory / ENGINES_NAME
    try:
        if path.stat().st_size > MAX_BYTES:
            return {}
        content: Any = read_json(path)
    except (OSError, ValueError):
        return {}
    if not isinstance(content, dict) or content.get("schema") != SCHEMA or not isinstance(content.get("graphs"), dict):
        return {}
    graphs: dict[str, Any] = content["graphs"]
    return graphs


def _hashes(folder: Path) -> dict[str, str]:
    """Hash every file of an engine's folder except timing caches, which later builds may extend; raises OSError."""
    hashes: dict[str, str] = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file() and p.suffix != TIMING_SUFFIX):
        digest = hashlib.sha256()
        with path.open("rb") as file:
            while block := file.read(HASH_BLOCK_BYTES):
                digest.update(block)
        hashes[path.relative_to(folder).as_posix()] = digest.hexdigest()
    return hashes


def _identities(folder: Path) -> dict[str, FileIdentity]:
    """Return the identities of compiled files, which change on every write; empty without the folder."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.suffix not in (TIMING_SUFFIX, ".profile"))
    return {path.relative_to(folder).as_posix(): FileIdentity.from_stat(path.stat()) for path in files}


def build(artifacts: Artifacts, directory: Path, say: Progress, machine: Machine | None = None) -> dict[str, Any]:
    """Build every missing or foreign engine; return per graph whether it was built and the time, s.

    Each engine is built in a temporary folder and renamed, then `engines.json` is written: an interrupted build resumes
    where it stopped. Raises EngineError, ArtifactError or OSError.
    """
    machine = machine or Machine()
    names = needed(artifacts)
    lacking = {artifacts.graphs[name].session.provider for name in names} - set(machine.providers())
    if lacking:
        raise EngineError(
            f"this ONNX Runtime has no {', '.join(sorted(lacking))}, only {', '.join(machine.providers())}: "
            f"run this on the device itself, with the package that brings it"
        )
    _check_profiles(artifacts, names)
    directory.mkdir(parents=True, exist_ok=True)
    entries = {name: entry for name, entry in _read(directory).items() if name in names}
    results: dict[str, Any] = {}
    for number, name in enumerate(names, 1):
        provider = artifacts.graphs[name].session.provider
        if _wrong(artifacts, name, directory, entries.get(name), machine) is None:
            say(f"[{number}/{len(names)}] {name}: its engine is up to date")
            results[name] = {"built": False, "build_s": entries[name].get("build_s"), "key": entries[name]["key"]}
            continue
        say(f"[{number}/{len(names)}] {name}: {provider} builds its engine, which can take ten minutes")
        started_ns = machine.now_ns()
        with _busy(say, f"[{number}/{len(names)}] {name}: still building"):
            files = _build_one(artifacts, name, directory, machine)
        build_s = round((machine.now_ns() - started_ns) / 1e9, 3)
        inputs = engine_inputs(artifacts, name, machine)
        entries[name] = {"key": key_of(inputs), "inputs": inputs, "files": files, "build_s": build_s}
        _write(directory, entries)
        say(f"[{number}/{len(names)}] {name}: built in {build_s:.0f} s, {len(files)} files")
        results[name] = {"built": True, "build_s": build_s, "key": entries[name]["key"]}
    if names:
        _write(directory, entries)
    return results


def _write(directory: Path, entries: Mapping[str, Any]) -> None:
    content = {"schema": SCHEMA, "graphs": dict(entries)}
    write_whole(directory / ENGINES_NAME, json.dumps(content, indent=1, sort_keys=True) + "\n")


def _build_one(artifacts: Artifacts, name: str, directory: Path, machine: Machine) -> dict[str, str]:
    """Build one engine, then reopen it from the runner's path; the second opening must not compile."""
    partial, final = directory / f"{name}.partial", directory / name
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    try:
        _open_and_run(artifacts, name, partial, machine)
        built = _hashes(partial)
        if not built:
            raise EngineError(
                f"{name}: {artifacts.graphs[name].session.provider} built no engine: it takes no part of this graph; "
                f"export it for another provider"
            )
        shutil.rmtree(final, ignore_errors=True)
        partial.rename(final)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    identities = _identities(final)
    _open_and_run(artifacts, name, final, machine)
    after = _hashes(final)
    # A second compilation may give the same bytes, but the file's identity changes.
    rewritten = {file for file, found in _identities(final).items() if identities.get(file) != found}
    changed = sorted(rewritten | {file for file in {*built, *after} if built.get(file) != after.get(file)})
    if changed:
        raise EngineError(
            f"{name}: {changed[0]} was built anew when the engine was opened again: it would be at run time too, so "
            f"{artifacts.graphs[name].session.provider} cannot be used for this graph here"
        )
    return after


def _open_and_run(artifacts: Artifacts, name: str, folder: Path, machine: Machine) -> None:
    """Open a graph on an engine folder and run it once at every profile's shapes."""
    graph = _redirected(artifacts, name, folder)
    moved = dataclasses.replace(artifacts, graphs={**artifacts.graphs, name: graph})
    session = machine.open_graph(moved, name)
    for shapes in profile_shapes(graph.inputs, graph.session.options, name):
        feeds = {t.name: np.zeros(shapes[t.name], dtype=DTYPES[t.dtype]) for t in graph.inputs}
        try:
            session.run(feeds)
        except GraphError as error:
            raise EngineError(f"{name}: its engine does not run ({error})") from error


def profile_shapes(
    inputs: Sequence[TensorContract], options: Mapping[str, str], name: str
) -> list[dict[str, tuple[int, ...]]]:
    """Return all input shapes at each profile of a session's options; one set without free axes. Raises EngineError."""
    free = {t.name: len(t.shape) for t in inputs if any(isinstance(axis, str) for axis in t.shape)}
    fixed = {t.name: tuple(axis for axis in t.shape if isinstance(axis, int)) for t in inputs if t.name not in free}
    if not free:
        return [fixed]
    sets: list[dict[str, tuple[int, ...]]] = []
    for kind in PROFILES:
        text = options.get(f"trt_profile_{kind}_shapes", "")
        pairs = [entry.rpartition(":") for entry in text.split(",") if entry]
        try:
            shapes = {tensor: tuple(int(axis) for axis in shape.split("x")) for tensor, _, shape in pairs}
        except ValueError:
            raise EngineError(f"{name}: profile {text!r} is not of the form input:1x2,… ; export again") from None
        missing = [tensor for tensor, axes in free.items() if len(shapes.get(tensor, ())) != axes]
        if missing:
            raise EngineError(f"{name}: no {kind} profile for input {missing[0]}, whose shape is free; export again")
        sets.append({**fixed, **{tensor: shapes[tensor] for tensor in free}})
    return sets


def _check_profiles(artifacts: Artifacts, names: Sequence[str]) -> None:
    """Raise EngineError if a generation could exceed the shapes that an engine is built for."""
    context = artifacts.runtime.max_context
    for name in names:
        graph = artifacts.graphs[name]
        largest = profile_shapes(graph.inputs, graph.session.options, name)[-1]
        for tensor in graph.inputs:
            for axis, length in zip(tensor.shape, largest[tensor.name], strict=True):
                if axis == CONTEXT_AXIS and length < context:
                    raise EngineError(
                        f"{name}: its profile takes {tensor.name} of at most {length} tokens, the model reads "
                        f"{context}; export again with graphs.{name}.profile.{axis}=1,{context},{context}"
                    )


@contextmanager
def _busy(say: Progress, line: str) -> Iterator[None]:
    """Report at intervals that a build continues: a compiler prints nothing for minutes."""
    done = threading.Event()
    started_ns = time.monotonic_ns()

    def repeat() -> None:
        while not done.wait(BUSY_LINE_S):
            say(f"{line}, {(time.monotonic_ns() - started_ns) / 1e9:.0f} s")

    thread = threading.Thread(target=repeat, name="busy-line", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
