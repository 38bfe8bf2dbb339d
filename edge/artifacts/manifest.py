"""The artifact directory's manifest: verified before anything in the directory is opened."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edge.artifacts.external_data import ExternalDataError, external_data
from edge.artifacts.files import (
    MANIFEST_NAME,
    SEAL,
    SIGNATURE_NAME,
    ArtifactError,
    FileIdentity,
    check_files,
    hash_file,
    parse_manifest,
    read_file,
    read_manifest_bytes,
)
from edge.artifacts.known_answers import KnownAnswers, read_known_answers
from edge.artifacts.providers import wrong_option
from edge.artifacts.runtime import SPECIAL_TOKENS, RuntimeConfig, check_agreement, nested, read_runtime
from edge.artifacts.tokenizer_file import TokenizerFileError, check_tokenizer_file
from edge.artifacts.trust import Trust
from edge.state.reasoning_text import WAYPOINT_TIMES_S

LANGUAGE_WHOLE = ("language_model",)
LANGUAGE_PAIR = ("language_model.prefill", "language_model.decode")
MOST_ROWS = 16
"""Most positions of one call whose next token a language graph chooses."""
LEAST_ROWS = 2
"""Least rows of a call that chooses tokens: products of one row use other kernels, which sum in another order."""
MAX_ELEMENTS = 1 << 31
"""Elements of a tensor's fixed axes; a larger one would be allocated before the graph is proven."""
MAX_CACHE_BYTES = 16 << 30
"""KV buffers of the longest context, bytes."""
_ITEM_BYTES = {"float": 4, "float16": 2}
HORIZON_S = (1.0, 10.0)
"""The controller aims at 1 s; no policy plans further than 10 s."""


@dataclass(frozen=True)
class TensorContract:
    """Name, element type and shape of a graph's input or output; free axes are named."""

    name: str
    dtype: str
    shape: tuple[int | str, ...]


@dataclass(frozen=True)
class SessionConfig:
    """Session of a graph: ONNX Runtime's execution provider, its options, threads."""

    provider: str
    options: Mapping[str, str]
    threads: int | None
    """Intra-op threads; None leaves them to the runner."""
    engine: bool
    """Whether the provider compiles an engine, which must be built on the device before any run."""


@dataclass(frozen=True)
class GraphContract:
    """Inputs and outputs of one graph file."""

    file: str
    data_files: tuple[str, ...]
    """Files beside it that hold its large weights."""
    inputs: tuple[TensorContract, ...]
    outputs: tuple[TensorContract, ...]
    session: SessionConfig

    @property
    def caches(self) -> tuple[TensorContract, ...]:
        """The KV buffers among the inputs."""
        return tuple(tensor for tensor in self.inputs if tensor.name.startswith("past_key_values."))

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
    """Every file but the graphs' data files."""
    identities: Mapping[str, FileIdentity]
    """Identities of the data files at their hashing."""
    known_answers: KnownAnswers | None = None
    """Answers of the self-test; None in an export under way."""
    release: int | None = None
    """Release counter of the required signature; None: no signature was required."""

    @property
    def language_graphs(self) -> tuple[str, ...]:
        """The language model's graphs: one, or the pair of prefill and decode."""
        return LANGUAGE_WHOLE if LANGUAGE_WHOLE[0] in self.graphs else LANGUAGE_PAIR

    @property
    def guided_by_waypoints(self) -> bool:
        """Whether the action expert receives the text's waypoints instead of last-layer K‖V."""
        return any(tensor.name == "waypoints" for tensor in self.graphs["semantic_context"].inputs)

    @property
    def cache_bytes(self) -> int:
        """Size of the KV buffers for the longest context, bytes."""
        caches = self.graphs[self.language_graphs[-1]].caches
        return sum(_bytes(cache, self.runtime.max_context) for cache in caches)

    def check_unchanged(self, names: Iterable[str]) -> None:
        """Raise ArtifactError if a data file has changed since its hashing."""
        for name in names:
            path = self.directory / name
            try:
                same = FileIdentity.of(path) == self.identities[name]
            except OSError:
                same = False
            if not same:
                raise ArtifactError(f"{path}: changed while it was being opened; start again")


def load_artifacts(directory: Path, trust: Trust | None = None) -> Artifacts:
    """Verify every file's size and SHA-256, the schema version and the I/O contract; raises ArtifactError.

    With `trust`, the signature comes first, before the manifest is even parsed, and the release is remembered last.
    """
    raw = read_manifest_bytes(directory)
    release = None if trust is None else trust.check(directory, raw)
    manifest = parse_manifest(directory, raw)
    files = _section(manifest, "files")
    data = {name for graph in _section(manifest, "graphs").values() for name in _data_files(graph)}
    check_files(files, data)
    contents = {name: read_file(directory, name, entry) for name, entry in files.items() if name not in data}
    identities = {name: hash_file(directory, name, entry) for name, entry in files.items() if name in data}
    known = {*files, MANIFEST_NAME, SIGNATURE_NAME}
    try:
        unlisted = sorted(path.name for path in directory.iterdir() if path.name not in known)
    except OSError as error:  # a directory without the right to read may still be entered
        raise ArtifactError(f"{directory}: cannot be listed ({error.strerror}); give this user read access") from error
    if unlisted:
        raise ArtifactError(f"{directory / unlisted[0]}: not listed in the manifest; export again into a new directory")
    pair = all(name in _section(manifest, "graphs") for name in LANGUAGE_PAIR)
    graphs = {
        name: _graph(manifest, name, contents, identities)
        for name in (
            "vision_encoder",
            *(LANGUAGE_PAIR if pair else LANGUAGE_WHOLE),
            "semantic_context",
            "action_expert",
        )
    }
    surplus = sorted(set(_section(manifest, "graphs")) - set(graphs))
    if surplus:
        raise ArtifactError(f"{MANIFEST_NAME}: graph {surplus[0]!r} is unknown to the runner")
    runtime = read_runtime(_section(manifest, "runtime"))
    model = _section(manifest, "model")
    _check_tokenizer(contents, runtime, nested(model, "config", "language", "vocab"))
    artifacts = Artifacts(
        directory=directory,
        manifest_sha256=str(manifest[SEAL]),
        target=str(manifest["target"]),
        model_name=str(model.get("name")),
        trained=model.get("trained") is True,
        runtime=runtime,
        graphs=graphs,
        contents=contents,
        identities=identities,
        known_answers=read_known_answers(manifest["self_test"], graphs),
        release=release,
    )
    check_agreement(manifest, runtime, check_contract(artifacts))
    for graph in graphs.values():
        _check_external_data(graph, contents[graph.file], identities)
    if trust is not None and release is not None:
        trust.accept(release)
    return artifacts


def _check_tokenizer(contents: Mapping[str, bytes], runtime: RuntimeConfig, vocabulary: Any) -> None:
    """Check the tokenizer, its special tokens' ids and the size of its vocabulary; raises ArtifactError.

    `vocabulary`: number of tokens of the network; None if the manifest does not record it.
    """
    if "tokenizer.json" not in contents:
        raise ArtifactError(f"{MANIFEST_NAME}: tokenizer.json is missing from the files")
    special = {token: int(getattr(runtime, name)) for name, token in SPECIAL_TOKENS.items()}
    try:
        size = check_tokenizer_file(contents["tokenizer.json"], special)
        if isinstance(vocabulary, int) and size > vocabulary:
            raise TokenizerFileError(f"has the token id {size - 1}, the network's vocabulary ends at {vocabulary - 1}")
    except TokenizerFileError as error:
        raise ArtifactError(f"tokenizer.json: {error}; export again") from error


def _check_external_data(graph: GraphContract, content: bytes, identities: Mapping[str, FileIdentity]) -> None:
    """Check that a graph's external weights are within the data files that the manifest lists for it."""
    try:
        for data in external_data(content):
            if data.location not in graph.data_files:
                raise ExternalDataError(f"weights in {data.location!r}, which the manifest does not list for it")
            size = identities[data.location].size
            if data.offset + (data.length or 0) > size:
                raise ExternalDataError(f"weights beyond the {size} bytes of {data.location}")
    except ExternalDataError as error:
        raise ArtifactError(f"{graph.file}: {error}; export again") from error


def _section(manifest: Mapping[str, Any], name: str) -> dict[str, Any]:
    section = manifest[name]
    if not isinstance(section, dict):
        raise ArtifactError(f"{MANIFEST_NAME}: {name} must be an object")
    return section


def _data_files(graph: Any) -> list[str]:
    """Return the data files of a graph's entry; raises ArtifactError."""
    names = graph.get("data_files") if isinstance(graph, dict) else None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ArtifactError(f"{MANIFEST_NAME}: every graph must list its data_files")
    return names


def _tensors(graph: str, entry: Mapping[str, Any], key: str) -> tuple[TensorContract, ...]:
    tensors: list[TensorContract] = []
    declared = entry.get(key)
    if not isinstance(declared, list):
        raise ArtifactError(f"{MANIFEST_NAME}: graph {graph} has no {key}")
    for item in declared:
        if not isinstance(item, dict) or set(item) != {"name", "dtype", "shape"} or not isinstance(item["shape"], list):
            raise ArtifactError(f"{MANIFEST_NAME}: graph {graph}: {key} must be name, dtype and shape")
        axes = [axis for axis in item["shape"] if not isinstance(axis, str)]
        if not all(type(axis) is int and axis > 0 for axis in axes) or math.prod(axes) > MAX_ELEMENTS:
            raise ArtifactError(
                f"{MANIFEST_NAME}: graph {graph}: {key} has a tensor of shape {str(item['shape'])[:80]}"
            )
        tensors.append(TensorContract(str(item["name"]), str(item["dtype"]), tuple(item["shape"])))
    return tuple(tensors)


def _graph(
    manifest: Mapping[str, Any], name: str, contents: Mapping[str, bytes], identities: Mapping[str, FileIdentity]
) -> GraphContract:
    entry = _section(manifest, "graphs").get(name)
    if not isinstance(entry, dict):
        raise ArtifactError(f"{MANIFEST_NAME}: graph {name} is missing")
    file = str(entry.get("file"))
    missing = [n for n in (file, *_data_files(entry)) if n not in contents and n not in identities]
    if missing or file not in contents:
        raise ArtifactError(f"{MANIFEST_NAME}: graph {name}: file {[*missing, file][0]!r} is not among the files")
    inputs, outputs = _tensors(name, entry, "inputs"), _tensors(name, entry, "outputs")
    return GraphContract(file, tuple(_data_files(entry)), inputs, outputs, _session(name, entry.get("session")))


def _session(graph: str, entry: Any) -> SessionConfig:
    known = {"provider": str, "options": dict, "threads": int | None, "engine": bool}
    if not isinstance(entry, dict) or set(entry) != set(known):
        raise ArtifactError(f"{MANIFEST_NAME}: graph {graph}: session must give {', '.join(known)}")
    wrong = [key for key, kind in known.items() if not isinstance(entry[key], kind)]
    options = entry["options"]
    if wrong or not all(isinstance(value, str) for value in options.values()):
        raise ArtifactError(f"{MANIFEST_NAME}: graph {graph}: session {[*wrong, 'options'][0]} is of the wrong type")
    refused = wrong_option(entry["provider"], options)
    if refused is not None:
        raise ArtifactError(f"{MANIFEST_NAME}: graph {graph}: session {refused}")
    threads = entry["threads"]
    if threads is not None and not 1 <= threads <= 256:
        raise ArtifactError(f"{MANIFEST_NAME}: graph {graph}: session threads {threads}, expected 1 to 256")
    return SessionConfig(entry["provider"], options, threads, entry["engine"])


def check_contract(artifacts: Artifacts) -> int:
    """Check that the graphs fit one another and the runner; return the steps of a trajectory. Raises ArtifactError."""
    vision, context, action = (artifacts.graphs[n] for n in ("vision_encoder", "semantic_context", "action_expert"))
    first, last = (artifacts.graphs[name] for name in (artifacts.language_graphs[0], artifacts.language_graphs[-1]))
    runtime = artifacts.runtime
    tokens = vision.output("visual_tokens")
    expected: list[tuple[GraphContract, TensorContract, str, tuple[int | str, ...]]] = [
        (vision, vision.input("frame"), "uint8", (1, runtime.image_px, runtime.image_px, 3)),
        (vision, tokens, "float", (1, *tokens.shape[1:])),
        (first, first.input("visual_tokens"), "float", ("F", *tokens.shape[1:])),
        (first, first.input("image_offset"), "int64", (1,)),
        (last, last.output("next_token"), "int64", (1, "L")),
        (context, *_guidance(artifacts)),
        (action, action.input("visual_tokens"), "float", tokens.shape),
        (action, action.input("state"), "float", (1, 3)),
        (action, action.input("latency"), "float", (1, 4)),
        *((action, action.input(tensor.name), *_form(tensor)) for tensor in context.outputs),
    ]
    for graph in (first, last):
        expected += [
            (graph, graph.input("input_ids"), "int64", (1, "S")),
            (graph, graph.input("seqlens_k"), "int32", (1,)),
            (graph, graph.input("total_sequence_length"), "int32", ()),
            (graph, graph.output("last_layer_kv"), "float", (1, "S", runtime.kv_dim)),
        ]
        for cache in graph.caches:
            present = graph.output(cache.name.replace("past_key_values", "present"))
            # Every buffer is bound as input and output at once, and the two graphs of a pair fill the same ones.
            expected += [(graph, present, cache.dtype, cache.shape), (first, first.input(cache.name), *_form(cache))]
    for graph, tensor, dtype, shape in expected:
        if tensor.dtype != dtype or tensor.shape != shape:
            raise ArtifactError(
                f"{graph.file}: {tensor.name} is {tensor.dtype}{list(tensor.shape)}, "
                f"the runner expects {dtype}{list(shape)}"
            )
    if not last.caches or len(first.caches) != len(last.caches):
        raise ArtifactError(f"{last.file}: {len(last.caches)} KV buffers, {first.file} has {len(first.caches)}")
    if artifacts.cache_bytes > MAX_CACHE_BYTES:
        raise ArtifactError(
            f"{last.file}: KV buffers of {artifacts.cache_bytes} bytes, expected at most {MAX_CACHE_BYTES}"
        )
    trajectory = action.output("trajectory")
    if trajectory.dtype != "float" or len(trajectory.shape) != 3 or trajectory.shape[2] != 3:
        raise ArtifactError(f"{action.file}: trajectory is {list(trajectory.shape)}, the runner expects [1, steps, 3]")
    steps = trajectory.shape[1]
    least_s, most_s = HORIZON_S
    if not isinstance(steps, int) or not least_s <= steps * runtime.step_s <= most_s:
        raise ArtifactError(
            f"{action.file}: trajectory of {steps} steps of {runtime.step_s:g} s, expected {least_s:g} to {most_s:g} s "
            f"in all: the controller aims 1 s ahead"
        )
    return steps


def _bytes(tensor: TensorContract, free: int) -> int:
    """Size of a tensor whose free axes have a length."""
    axes = (axis if isinstance(axis, int) else free for axis in tensor.shape)
    return math.prod(axes) * _ITEM_BYTES.get(tensor.dtype, 8)


def _guidance(artifacts: Artifacts) -> tuple[TensorContract, str, tuple[int | str, ...]]:
    """Return the semantic context's input, with the runner's type and shape."""
    context = artifacts.graphs["semantic_context"]
    if artifacts.guided_by_waypoints:
        return context.input("waypoints"), "float", (1, len(WAYPOINT_TIMES_S), 2)
    return context.input("last_layer_kv"), "float", (1, "T", artifacts.runtime.kv_dim)


def _form(tensor: TensorContract) -> tuple[str, tuple[int | str, ...]]:
    return tensor.dtype, tensor.shape
