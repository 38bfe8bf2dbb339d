"""The limits of a manifest to the last byte: tensors, caches, plans, threads, and what each refusal names."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import onnx
import pytest

from edge.artifacts import manifest as module
from edge.artifacts.files import ArtifactError, FileIdentity
from edge.artifacts.manifest import (
    LANGUAGE_PAIR,
    LEAST_ROWS,
    MOST_ROWS,
    Artifacts,
    GraphContract,
    TensorContract,
    check_contract,
    load_artifacts,
)
from edge.state.reasoning_text import WAYPOINT_TIMES_S
from tests.support.artifact_directory import edit_manifest, replace_file

Edit = Callable[[dict[str, Any]], object]
GIB = 1 << 30


@pytest.fixture(scope="module")
def artifacts(artifacts_dir: Path) -> Artifacts:
    return load_artifacts(artifacts_dir)


@pytest.fixture
def copy(artifacts_dir: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(artifacts_dir, tmp_path / "nano"))


def with_graph(artifacts: Artifacts, name: str, change: Callable[[GraphContract], GraphContract]) -> Artifacts:
    return replace(artifacts, graphs={**artifacts.graphs, name: change(artifacts.graphs[name])})


def reshaped(shape: tuple[int | str, ...], dtype: str | None = None, *, of: str) -> Callable[[Any], Any]:
    """A change of one tensor of a graph."""

    def one(tensor: TensorContract) -> TensorContract:
        return replace(tensor, shape=shape, dtype=dtype or tensor.dtype) if tensor.name == of else tensor

    return lambda graph: replace(graph, inputs=tuple(map(one, graph.inputs)), outputs=tuple(map(one, graph.outputs)))


def with_heads(artifacts: Artifacts, heads: int, dtype: str) -> Artifacts:
    """Every KV buffer with this many heads of this type, as input and as output."""
    changed = artifacts
    for name in artifacts.language_graphs:
        graph = artifacts.graphs[name]
        for cache in graph.caches:
            shape = (cache.shape[0], heads, *cache.shape[2:])
            for tensor in (cache.name, cache.name.replace("past_key_values", "present")):
                changed = with_graph(changed, name, reshaped(shape, dtype, of=tensor))
    return changed


def bytes_a_head(artifacts: Artifacts, item_bytes: int) -> int:
    """Bytes that one more head costs in all buffers at the longest context."""
    caches = artifacts.graphs[artifacts.language_graphs[-1]].caches
    lengths = [cache.shape[3] for cache in caches]
    return sum(int(length) for length in lengths) * artifacts.runtime.max_context * item_bytes


class TestCaches:
    @pytest.mark.parametrize(("dtype", "item_bytes"), [("float", 4), ("float16", 2), ("double", 8)])
    def test_their_size_is_that_of_the_longest_context(self, artifacts: Artifacts, dtype: str, item_bytes: int) -> None:
        assert with_heads(artifacts, 5, dtype).cache_bytes == 5 * bytes_a_head(artifacts, item_bytes)

    def test_up_to_16_gib_are_taken(self, artifacts: Artifacts) -> None:
        heads = 16 * GIB // bytes_a_head(artifacts, 4)
        check_contract(with_heads(artifacts, heads, "float"))
        with pytest.raises(ArtifactError, match=f"KV buffers of [0-9]+ bytes, expected at most {16 * GIB}"):
            check_contract(with_heads(artifacts, heads + 1, "float"))

    def test_the_limit_itself_is_taken(self, artifacts: Artifacts, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(module, "MAX_CACHE_BYTES", artifacts.cache_bytes)
        check_contract(artifacts)
        monkeypatch.setattr(module, "MAX_CACHE_BYTES", artifacts.cache_bytes - 1)
        with pytest.raises(ArtifactError, match="KV buffers"):
            check_contract(artifacts)

    def test_a_language_model_without_any_is_refused(self, artifacts: Artifacts) -> None:
        def without(graph: GraphContract) -> GraphContract:
            return replace(graph, inputs=tuple(one for one in graph.inputs if one not in graph.caches))

        for name in artifacts.language_graphs:
            artifacts = with_graph(artifacts, name, without)
        with pytest.raises(ArtifactError, match="0 KV buffers"):
            check_contract(artifacts)


class TestTensors:
    @staticmethod
    def with_output(shape: object) -> Edit:
        extra = {"name": "extra", "dtype": "float", "shape": shape}
        return lambda m: m["graphs"]["action_expert"]["outputs"].append(extra)

    @pytest.mark.slow
    @pytest.mark.parametrize("shape", [[1 << 31], ["N", 1 << 16, 1 << 15], [1], []])
    def test_one_of_2_to_the_31_elements_is_taken(self, copy: Path, shape: object) -> None:
        edit_manifest(copy, self.with_output(shape))
        output = load_artifacts(copy).graphs["action_expert"].output("extra")
        assert output == TensorContract("extra", "float", tuple(shape))  # type: ignore[arg-type]

    @pytest.mark.slow
    @pytest.mark.parametrize("shape", [[(1 << 31) + 1], [1 << 16, 1 << 16], [0], [-1], [True], [1.5], [None]], ids=str)
    def test_a_larger_or_senseless_one_is_refused_by_its_shape(self, copy: Path, shape: list[object]) -> None:
        edit_manifest(copy, self.with_output(shape))
        with pytest.raises(ArtifactError, match="graph action_expert: outputs has a tensor of shape"):
            load_artifacts(copy)

    @pytest.mark.slow
    @pytest.mark.parametrize(
        "entry",
        [5, {"name": "x", "dtype": "float"}, {"name": "x", "dtype": "float", "shape": "3"},
         {"name": "x", "dtype": "float", "shape": [], "more": 1}],
        ids=str,
    )  # fmt: skip
    def test_an_entry_of_another_form_is_refused(self, copy: Path, entry: object) -> None:
        edit_manifest(copy, lambda m: m["graphs"]["action_expert"]["outputs"].append(entry))
        with pytest.raises(ArtifactError, match="graph action_expert: outputs must be name, dtype and shape"):
            load_artifacts(copy)

    @pytest.mark.slow
    @pytest.mark.parametrize("key", ["inputs", "outputs"])
    @pytest.mark.parametrize("value", [None, {}, "x"])
    def test_a_graph_without_them_is_refused(self, copy: Path, key: str, value: object) -> None:
        edit_manifest(copy, lambda m: m["graphs"]["action_expert"].update({key: value}))
        with pytest.raises(ArtifactError, match=f"graph action_expert has no {key}"):
            load_artifacts(copy)

    @pytest.mark.slow
    def test_a_long_shape_is_cut_in_the_message(self, copy: Path) -> None:
        edit_manifest(copy, self.with_output([0] * 100))
        with pytest.raises(ArtifactError) as refusal:
            load_artifacts(copy)
        assert str(refusal.value).endswith(str([0] * 100)[:80])

    def test_one_that_a_graph_lacks_is_named_with_the_graphs_file(self, artifacts: Artifacts) -> None:
        graph = artifacts.graphs["action_expert"]
        for find in (graph.input, graph.output):
            with pytest.raises(ArtifactError, match=rf"{graph.file}: no tensor 'nope' in the manifest's I/O contract"):
                find("nope")

    def test_they_are_found_by_name(self, artifacts: Artifacts) -> None:
        graph = artifacts.graphs["action_expert"]
        assert graph.input("state").shape == (1, 3) and graph.output("trajectory").shape[2] == 3


class TestContract:
    @pytest.mark.parametrize(("step_s", "steps"), [(0.1, 10), (0.1, 100), (0.02, 50), (0.5, 20)])
    def test_a_plan_of_1_to_10_s_is_taken(self, artifacts: Artifacts, step_s: float, steps: int) -> None:
        runtime = replace(artifacts.runtime, step_s=step_s)
        changed = with_graph(artifacts, "action_expert", reshaped((1, steps, 3), of="trajectory"))
        assert check_contract(replace(changed, runtime=runtime)) == steps

    @pytest.mark.parametrize("steps", [9, 101, "N"])
    def test_a_shorter_a_longer_and_an_open_one_are_refused(self, artifacts: Artifacts, steps: int | str) -> None:
        runtime = replace(artifacts.runtime, step_s=0.1)
        changed = with_graph(artifacts, "action_expert", reshaped((1, steps, 3), of="trajectory"))
        message = f"trajectory of {steps} steps of 0.1 s, expected 1 to 10 s in all: the controller aims 1 s ahead"
        with pytest.raises(ArtifactError, match=message):
            check_contract(replace(changed, runtime=runtime))

    @pytest.mark.parametrize(("shape", "dtype"), [((1, 30, 4), None), ((1, 30), None), ((1, 30, 3), "float16")])
    def test_a_trajectory_of_another_form_is_refused(
        self, artifacts: Artifacts, shape: tuple[int, ...], dtype: str | None
    ) -> None:
        changed = with_graph(artifacts, "action_expert", reshaped(shape, dtype, of="trajectory"))
        with pytest.raises(ArtifactError, match=r"trajectory is .*, the runner expects \[1, steps, 3\]"):
            check_contract(changed)

    @pytest.mark.parametrize(
        ("graph", "tensor"),
        [
            ("vision_encoder", "frame"), ("vision_encoder", "visual_tokens"), ("semantic_context", "waypoints"),
            ("action_expert", "visual_tokens"), ("action_expert", "state"), ("action_expert", "latency"),
            *(("language", name) for name in (
                "visual_tokens", "image_offset", "next_token", "input_ids", "seqlens_k", "total_sequence_length",
                "last_layer_kv", "past_key_values.0.key", "present.0.key",
            )),
        ],
    )  # fmt: skip
    @pytest.mark.parametrize("what", ["type", "shape"])
    def test_each_tensor_between_graphs_and_runner_has_its_type_and_shape(
        self, artifacts: Artifacts, graph: str, tensor: str, what: str
    ) -> None:
        for name in artifacts.language_graphs if graph == "language" else (graph,):
            found = artifacts.graphs[name].inputs + artifacts.graphs[name].outputs
            shapes = [one.shape for one in found if one.name == tensor]
            if not shapes:
                continue
            shape = (7, *shapes[0]) if what == "shape" else shapes[0]
            changed = with_graph(artifacts, name, reshaped(shape, "int8" if what == "type" else None, of=tensor))
            with pytest.raises(ArtifactError, match="the runner expects"):
                check_contract(changed)
            return
        assert tensor == "waypoints", f"{graph} has no {tensor}"

    def test_what_the_context_gives_is_what_the_action_expert_takes(self, artifacts: Artifacts) -> None:
        output = artifacts.graphs["semantic_context"].outputs[0]
        changed = with_graph(artifacts, "action_expert", reshaped((1, 1, 1), of=output.name))
        with pytest.raises(ArtifactError, match=output.name):
            check_contract(changed)


class TestGuidance:
    WAYPOINTS = TensorContract("waypoints", "float", (1, len(WAYPOINT_TIMES_S), 2))

    @staticmethod
    def guided(artifacts: Artifacts, waypoints: TensorContract) -> Artifacts:
        def change(graph: GraphContract) -> GraphContract:
            others = tuple(tensor for tensor in graph.inputs if tensor.name != "last_layer_kv")
            return replace(graph, inputs=(waypoints, TensorContract("spare", "float", (1,)), *others))

        return with_graph(artifacts, "semantic_context", change)

    def test_one_by_waypoints_is_known_by_its_context_graph(self, artifacts: Artifacts) -> None:
        assert artifacts.guided_by_waypoints is False
        guided = self.guided(artifacts, self.WAYPOINTS)
        assert guided.guided_by_waypoints is True
        check_contract(guided)

    @pytest.mark.parametrize(
        "changed", [{"dtype": "float16"}, {"shape": (2, 3, 2)}, {"shape": (1, 3, 3)}, {"shape": (1, 4, 2)}], ids=str
    )
    def test_waypoints_of_another_form_are_refused(self, artifacts: Artifacts, changed: dict[str, Any]) -> None:
        with pytest.raises(ArtifactError, match=r"waypoints is .*, the runner expects float\[1, 3, 2\]"):
            check_contract(self.guided(artifacts, replace(self.WAYPOINTS, **changed)))


class TestSession:
    @staticmethod
    def session(**changes: object) -> Edit:
        return lambda m: m["graphs"]["action_expert"]["session"].update(changes)

    @pytest.mark.slow
    @pytest.mark.parametrize("threads", [None, 1, 256])
    def test_up_to_256_threads_are_taken(self, copy: Path, threads: int | None) -> None:
        edit_manifest(copy, self.session(threads=threads))
        assert load_artifacts(copy).graphs["action_expert"].session.threads == threads

    @pytest.mark.slow
    @pytest.mark.parametrize("threads", [0, -1, 257])
    def test_none_and_more_are_refused(self, copy: Path, threads: int) -> None:
        edit_manifest(copy, self.session(threads=threads))
        with pytest.raises(ArtifactError, match=f"session threads {threads}, expected 1 to 256"):
            load_artifacts(copy)

    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("key", "value"), [("provider", 1), ("options", []), ("threads", "2"), ("engine", 1), ("options", {"a": 1})]
    )
    def test_a_value_of_another_type_is_named(self, copy: Path, key: str, value: object) -> None:
        edit_manifest(copy, self.session(**{key: value}))
        with pytest.raises(ArtifactError, match=f"graph action_expert: session {key} is of the wrong type"):
            load_artifacts(copy)

    @pytest.mark.slow
    def test_an_unknown_key_is_refused_with_those_that_there_are(self, copy: Path) -> None:
        edit_manifest(copy, self.session(more=1))
        with pytest.raises(ArtifactError, match="session must give provider, options, threads, engine"):
            load_artifacts(copy)


class TestFilesAndGraphs:
    @pytest.mark.slow
    def test_a_file_that_is_not_listed_is_named(self, copy: Path) -> None:
        (copy / "b.txt").touch()
        (copy / "a.txt").touch()
        with pytest.raises(ArtifactError, match=r"a\.txt: not listed in the manifest; export again"):
            load_artifacts(copy)

    @pytest.mark.slow
    def test_an_unknown_graph_is_named(self, copy: Path) -> None:
        edit_manifest(copy, lambda m: m["graphs"].update(another=m["graphs"]["action_expert"]))
        with pytest.raises(ArtifactError, match="graph 'another' is unknown to the runner"):
            load_artifacts(copy)

    @pytest.mark.slow
    @pytest.mark.parametrize("name", LANGUAGE_PAIR)
    def test_half_a_pair_of_language_graphs_is_unknown(self, copy: Path, name: str) -> None:
        edit_manifest(copy, lambda m: m["graphs"].update({name: m["graphs"]["language_model"]}))
        with pytest.raises(ArtifactError, match=f"graph '{name}' is unknown to the runner"):
            load_artifacts(copy)

    @pytest.mark.slow
    @pytest.mark.parametrize(("offset", "taken"), [(4, True), (5, False)])
    def test_weights_without_a_length_begin_at_the_latest_where_their_file_ends(
        self, copy: Path, offset: int, taken: bool
    ) -> None:
        weights = onnx.TensorProto(name="w", data_type=1, dims=[0], data_location=onnx.TensorProto.EXTERNAL)
        for key, value in (("location", "action_expert.onnx.data"), ("offset", str(offset))):
            weights.external_data.add(key=key, value=value)
        graph = onnx.helper.make_graph([], "g", [], [], initializer=[weights])
        replace_file(copy, "action_expert.onnx", onnx.helper.make_model(graph).SerializeToString())
        replace_file(copy, "action_expert.onnx.data", b"1234")
        edit_manifest(copy, lambda m: m["graphs"]["action_expert"].update(data_files=["action_expert.onnx.data"]))
        with nullcontext() if taken else pytest.raises(ArtifactError, match="weights beyond the 4 bytes"):
            load_artifacts(copy)

    def test_a_data_file_that_is_gone_has_changed(self, artifacts: Artifacts, copy: Path) -> None:
        hashed = {"weights.data": FileIdentity.of(copy / "manifest.json")}
        with pytest.raises(ArtifactError, match=r"weights\.data: changed while it was being opened"):
            replace(artifacts, directory=copy, identities=hashed).check_unchanged(["weights.data"])

    @pytest.mark.slow
    @pytest.mark.parametrize("graph", ["vision_encoder", "semantic_context", "action_expert"])
    def test_a_missing_graph_is_named(self, copy: Path, graph: str) -> None:
        edit_manifest(copy, lambda m: m["graphs"].pop(graph))
        with pytest.raises(ArtifactError, match=f"graph {graph} is missing"):
            load_artifacts(copy)

    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("changes", "named"),
        [
            ({"file": "nope.onnx"}, "nope.onnx"),
            ({"data_files": ["nope.data"]}, "nope.data"),
            ({"file": None}, "None"),
        ],
        ids=str,
    )
    def test_a_graphs_file_that_is_not_listed_is_named(self, copy: Path, changes: dict[str, Any], named: str) -> None:
        edit_manifest(copy, lambda m: m["graphs"]["action_expert"].update(changes))
        with pytest.raises(ArtifactError, match=f"graph action_expert: file '{named}' is not among the files"):
            load_artifacts(copy)

    @pytest.mark.parametrize("value", [None, "x", [1]])
    def test_a_graph_must_list_its_data_files(self, copy: Path, value: object) -> None:
        edit_manifest(copy, lambda m: m["graphs"]["action_expert"].update(data_files=value))
        with pytest.raises(ArtifactError, match="every graph must list its data_files"):
            load_artifacts(copy)

    @pytest.mark.parametrize("section", ["files", "graphs", "runtime", "model"])
    def test_a_section_that_is_no_object_is_named(self, copy: Path, section: str) -> None:
        edit_manifest(copy, lambda m: m.update({section: []}))
        with pytest.raises(ArtifactError, match=f"{section} must be an object"):
            load_artifacts(copy)

    @pytest.mark.slow
    def test_a_directory_without_a_tokenizer_is_refused(self, copy: Path) -> None:
        (copy / "tokenizer.json").unlink()
        edit_manifest(copy, lambda m: m["files"].pop("tokenizer.json"))
        with pytest.raises(ArtifactError, match=r"tokenizer\.json is missing from the files"):
            load_artifacts(copy)

    @pytest.mark.slow
    def test_a_tokenizer_with_more_words_than_the_network_is_refused(self, copy: Path) -> None:
        edit_manifest(copy, lambda m: m["model"]["config"]["language"].update(vocab=100))
        with pytest.raises(ArtifactError, match="the network's vocabulary ends at 99"):
            load_artifacts(copy)

    def test_what_is_loaded_has_its_target_and_answers_and_without_trust_no_release(self, artifacts: Artifacts) -> None:
        assert artifacts.target == "cpu" and artifacts.release is None and artifacts.known_answers is not None

    @pytest.mark.slow
    @pytest.mark.parametrize(("value", "trained"), [(True, True), (False, False), (1, False), ("yes", False)])
    def test_only_true_means_trained(self, copy: Path, value: object, trained: bool) -> None:
        edit_manifest(copy, lambda m: m["model"].update(trained=value))
        assert load_artifacts(copy).trained is trained


def test_a_call_chooses_2_to_16_tokens() -> None:
    """As the graphs that `edge-export` writes; latency profiles are checked against the same."""
    assert (LEAST_ROWS, MOST_ROWS) == (2, 16)


def test_a_directory_that_cannot_be_listed_is_refused(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As one of mode 0311: its files can be opened by name. The tests may run as root, which may list everything."""

    def closed(self: Path) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(self))

    monkeypatch.setattr(Path, "iterdir", closed)
    with pytest.raises(ArtifactError, match=r"nano: cannot be listed \(Permission denied\)"):
        load_artifacts(copy)
