"""Artifacts whose manifest is consistent but which do not compute what was exported are refused before a run."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from onnx import TensorProto, helper

from edge.artifacts.files import ArtifactError
from edge.artifacts.known_answers import LATER, LOGITS, SUMS, VOCABULARY
from edge.artifacts.manifest import Artifacts, load_artifacts
from edge.inference import self_test
from edge.inference.language import LanguageModel
from edge.inference.policy import Policy
from edge.inference.self_test import check_answers
from edge.inference.start_guard import Memory, StartGuard
from edge.inference.warm_up import open_proven
from tests.support.artifact_directory import Floats, change_weight, edit_graph, edit_manifest, replace_file

Damage = Callable[[Path], object]


@pytest.fixture
def copy(artifacts_dir: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(artifacts_dir, tmp_path / "nano"))


def opened(artifacts: Artifacts) -> tuple[Policy, LanguageModel]:
    return Policy(artifacts), LanguageModel(artifacts)


def damaged(graph: str, change: Callable[[Floats], object]) -> Damage:
    return lambda directory: edit_graph(directory, graph, lambda model: change_weight(model, change))


def set_one(value: float, values: Floats) -> None:
    values[3, 5] = value


def scale(factor: float, values: Floats) -> None:
    values *= np.float32(factor)


def flip_largest(values: Floats) -> None:
    at = np.unravel_index(np.abs(values).argmax(), values.shape)
    values[at] = -values[at]


def swap_rows(values: Floats) -> None:
    values[[10, 20]] = values[[20, 10]]


def damaged_token(change: Callable[[Floats], object]) -> Damage:
    """Change the embedding of a token that no prompt of the self-test contains."""
    return changed("embed.weight", lambda values: change(values[1000]))


def damaged_output(change: Callable[[Floats], object]) -> Damage:
    """Change the weights of the next token 1000, which the self-test's texts never choose."""
    return changed("lm_head.weight", lambda values: change(values[:, 1000]))


def changed(name: str, change: Callable[[Floats], object]) -> Damage:
    def change_values(model: onnx.ModelProto) -> None:
        (tensor,) = (each for each in model.graph.initializer if each.name == name)
        values = onnx.numpy_helper.to_array(tensor).copy()
        change(values)
        tensor.raw_data = values.tobytes()

    return lambda directory: edit_graph(directory, "language_model", change_values)


def zero_all(graph: str, directory: Path) -> None:
    def change(model: onnx.ModelProto) -> None:
        for tensor in model.graph.initializer:
            if tensor.data_type == TensorProto.FLOAT:
                tensor.raw_data = bytes(len(tensor.raw_data))

    edit_graph(directory, graph, change)


def exchange(directory: Path, left: str, right: str) -> None:
    """Exchange two tokens of the vocabulary."""
    content = json.loads((directory / "tokenizer.json").read_text())
    words = content["model"]["vocab"]
    words[left], words[right] = words[right], words[left]
    replace_file(directory, "tokenizer.json", json.dumps(content).encode())


def exchange_special(directory: Path) -> None:
    """Exchange the ids of two special tokens in the settings and in the tokenizer."""
    content = json.loads((directory / "tokenizer.json").read_text())
    by_id = {entry["id"]: entry for entry in content["added_tokens"]}
    by_id[3]["id"], by_id[4]["id"] = 4, 3
    replace_file(directory, "tokenizer.json", json.dumps(content).encode())
    edit_manifest(directory, lambda m: m["runtime"].update(img_start_id=4, img_end_id=3))
    edit_manifest(directory, lambda m: m["model"]["config"]["language"].update(img_start_id=4, img_end_id=3))


def replace_output(model: onnx.ModelProto, name: str, operator: str) -> None:
    """Send an output of a graph through one more operator."""
    for node in model.graph.node:
        for i, output in enumerate(node.output):
            if output == name:
                node.output[i] = "before"
    model.graph.node.append(helper.make_node(operator, ["before"], [name]))


def loop_for_ever(directory: Path) -> None:
    """Send the trajectory through 2⁶² turns of a loop."""

    def change(model: onnx.ModelProto) -> None:
        replace_output(model, "trajectory", "Identity")
        tensors = {name: helper.make_tensor_value_info(name, TensorProto.BOOL, []) for name in ("go", "go_on")}
        body = helper.make_graph(
            [helper.make_node("Identity", ["go"], ["go_on"]), helper.make_node("Abs", ["v"], ["w"])],
            "body",
            [helper.make_tensor_value_info("i", TensorProto.INT64, []), tensors["go"],
             helper.make_tensor_value_info("v", TensorProto.FLOAT, [1, 30, 3])],
            [tensors["go_on"], helper.make_tensor_value_info("w", TensorProto.FLOAT, [1, 30, 3])],
        )  # fmt: skip
        last = model.graph.node.pop()
        model.graph.initializer.append(helper.make_tensor("turns", TensorProto.INT64, [], [1 << 62]))
        model.graph.initializer.append(helper.make_tensor("true", TensorProto.BOOL, [], [True]))
        model.graph.node.append(helper.make_node("Loop", ["turns", "true", last.input[0]], last.output, body=body))

    edit_graph(directory, "action_expert", change)


def swap_graph(directory: Path) -> None:
    """Put the encoder of other weights in the place of this one."""

    def change(model: onnx.ModelProto) -> None:
        rng = np.random.default_rng(0)
        for tensor in model.graph.initializer:
            if tensor.data_type == TensorProto.FLOAT and len(tensor.dims) == 2:
                values = onnx.numpy_helper.to_array(tensor)
                tensor.raw_data = rng.permuted(values.ravel()).astype(np.float32).tobytes()

    edit_graph(directory, "vision_encoder", change)


DAMAGES: dict[str, tuple[Damage, str]] = {
    "one weight is NaN": (damaged("action_expert", partial(set_one, np.nan)), "action_expert gives 90 numbers"),
    "one weight is infinite": (damaged("vision_encoder", partial(set_one, np.inf)), "vision_encoder .* not finite"),
    "all weights are 0": (partial(zero_all, "vision_encoder"), "vision_encoder gives the same answer to everything"),
    "an expert of zeros": (partial(zero_all, "action_expert"), "action_expert gives the same answer to everything"),
    "a context of zeros": (partial(zero_all, "semantic_context"), "semantic_context gives the same answer"),
    "a matrix scaled by 1.02": (damaged("language_model", partial(scale, 1.02)), "language_model answers otherwise"),
    "a matrix scaled by 0.99": (damaged("vision_encoder", partial(scale, 0.99)), "vision_encoder answers otherwise"),
    "the sign of one weight": (damaged("semantic_context", flip_largest), "semantic_context answers otherwise"),
    "two rows exchanged": (damaged("semantic_context", swap_rows), "semantic_context answers otherwise"),
    "other weights": (swap_graph, "vision_encoder answers otherwise"),
    "a token's embedding is 0": (damaged_token(partial(scale, 0.0)), "vocabulary answers otherwise"),
    "a token's embedding is scaled": (damaged_token(partial(scale, 1e4)), "vocabulary answers otherwise"),
    "a token's embedding is NaN": (damaged_token(partial(scale, np.nan)), "vocabulary gives .* not finite"),
    "a next token is never chosen": (damaged_output(partial(scale, 0.0)), "logits answers otherwise"),
    "a next token is always chosen": (damaged_output(partial(scale, 1e4)), "language_model chooses other tokens"),
    "the weights of a next token are NaN": (damaged_output(partial(scale, np.nan)), "logits gives .* not finite"),
    "two next tokens exchanged": (
        changed("lm_head.weight", lambda values: swap_rows(values.T)), "logits answers otherwise"
    ),
    "two tokens exchanged": (lambda d: exchange(d, "Ġleft", "Ġright"), "the prompt's token ids are not the exporter's"),
    "special tokens exchanged": (exchange_special, "the prompt's token ids are not the exporter's"),
    "a negative next token": (
        lambda d: edit_graph(d, "language_model", lambda m: replace_output(m, "next_token", "Neg")),
        r"the graphs do not run \(the language model's next tokens are \[-\d+",
    ),
}  # fmt: skip
FAST = (
    "one weight is NaN", "a matrix scaled by 0.99", "a token's embedding is 0", "a next token is never chosen",
    "two tokens exchanged",
)  # fmt: skip


@pytest.mark.parametrize(
    ("damage", "message"),
    [pytest.param(*DAMAGES[name], id=name, marks=() if name in FAST else pytest.mark.slow) for name in DAMAGES],
)
def test_artifacts_that_compute_otherwise_are_refused(copy: Path, damage: Damage, message: str) -> None:
    damage(copy)
    artifacts = load_artifacts(copy)
    with pytest.raises(ArtifactError, match=message):
        open_proven(artifacts)


@pytest.mark.slow
@pytest.mark.parametrize("threads", [1, 2])
def test_the_exported_answers_are_found_again(artifacts: Artifacts, threads: int) -> None:
    policy, language = Policy(artifacts, threads=threads), LanguageModel(artifacts, threads=threads)
    assert check_answers(policy, language, artifacts.known_answers).worst_share < 0.1


@pytest.mark.slow
def test_other_kernels_give_the_exported_answers(artifacts: Artifacts, monkeypatch: pytest.MonkeyPatch) -> None:
    make = ort.SessionOptions

    def without_fusion() -> ort.SessionOptions:
        options = make()
        options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
        return options

    monkeypatch.setattr(ort, "SessionOptions", without_fusion)
    assert open_proven(artifacts).tested.worst_share < 0.1


def test_a_kv_buffer_of_an_unknown_type_is_refused(copy: Path) -> None:
    names = ("past_key_values.9.key", "present.9.key")
    axes: list[str | int | None] = [1, 2, "T9", 64]

    def add_tensors(model: onnx.ModelProto) -> None:
        before, after = (helper.make_tensor_value_info(name, TensorProto.DOUBLE, axes) for name in names)
        model.graph.input.append(before)
        model.graph.output.append(after)
        model.graph.node.append(helper.make_node("Identity", [before.name], [after.name]))

    def list_tensors(manifest: dict[str, Any]) -> None:
        for key, name in zip(("inputs", "outputs"), names, strict=True):
            tensor = {"name": name, "dtype": "tensor(double)", "shape": axes}
            manifest["graphs"]["language_model"][key].append(tensor)

    edit_graph(copy, "language_model", add_tensors)
    edit_manifest(copy, list_tensors)
    artifacts = load_artifacts(copy)
    with pytest.raises(ArtifactError, match=r"past_key_values\.9\.key is tensor\(double\), expected one of float, "):
        LanguageModel(artifacts)


@pytest.mark.parametrize("output", ["visual_tokens", "last_layer_kv", "trajectory"])
def test_a_provider_that_computes_wrongly_is_refused(
    artifacts: Artifacts, monkeypatch: pytest.MonkeyPatch, output: str
) -> None:
    real = ort.InferenceSession.run_with_iobinding

    def one_percent_off(session: ort.InferenceSession, binding: ort.IOBinding, options: object = None) -> None:
        real(session, binding, options)
        wanted = output in [tensor.name for tensor in session.get_outputs()]
        for value in binding.get_outputs():
            if wanted and len(value.shape()) == 3:  # the others are KV buffers and a token
                value.update_inplace(value.numpy() * np.float32(1.01))

    monkeypatch.setattr(ort.InferenceSession, "run_with_iobinding", one_percent_off)
    with pytest.raises(
        ArtifactError, match=r"answers otherwise than at the export: deviation 0\.01, tolerance 0\.0002"
    ):
        open_proven(artifacts)


def test_a_manifest_without_answers_is_refused(artifacts: Artifacts) -> None:
    with pytest.raises(ArtifactError, match="no known answers for the self-test; export again"):
        open_proven(dataclasses.replace(artifacts, known_answers=None))


@pytest.mark.parametrize("without", [{LOGITS}, LATER], ids=["logits", "logits and vocabulary"])
def test_artifacts_of_an_earlier_export_without_a_later_answer_pass(copy: Path, without: set[str]) -> None:
    edit_manifest(copy, lambda m: [m["self_test"]["answers"].pop(name) for name in without])
    assert open_proven(load_artifacts(copy)).tested.worst_share < 0.1


def test_of_a_large_vocabulary_a_sample_is_tested(artifacts: Artifacts, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(self_test, "MOST_VOCABULARY", 100)
    sizes = {name: each.values.size for name, each in self_test.outputs(*opened(artifacts), self_test.Noise(1))}
    assert sizes[VOCABULARY] == 100 * artifacts.runtime.kv_dim


@pytest.mark.parametrize("number", [1e200, 1.7e308, 5e-324])
@pytest.mark.filterwarnings("error")
def test_an_absurd_digest_is_refused_without_a_warning(artifacts: Artifacts, number: float) -> None:
    known = artifacts.known_answers
    assert known is not None
    answer = dataclasses.replace(known.answers["vision_encoder"], digest=(number,) * SUMS)
    changed = dataclasses.replace(known, answers={**known.answers, "vision_encoder": answer})
    with pytest.raises(ArtifactError, match="vision_encoder answers otherwise than at the export"):
        check_answers(*opened(artifacts), changed)


def test_a_self_test_that_takes_longer_than_its_limit_is_refused(artifacts: Artifacts) -> None:
    known = artifacts.known_answers
    assert known is not None
    with pytest.raises(ArtifactError, match=r"takes longer than its limit of 0\.001 s"):
        check_answers(*opened(artifacts), dataclasses.replace(known, limit_s=0.001))


@pytest.mark.slow
def test_a_graph_that_loops_is_ended_at_the_limit(copy: Path) -> None:
    loop_for_ever(copy)
    artifacts = load_artifacts(copy)
    assert artifacts.known_answers is not None
    known = dataclasses.replace(artifacts.known_answers, limit_s=1.5)
    with pytest.raises(ArtifactError, match=r"self-test: not done after its limit of 1\.5 s"):
        open_proven(dataclasses.replace(artifacts, known_answers=known))


def test_a_start_that_takes_more_memory_than_its_limit_is_refused(artifacts: Artifacts) -> None:
    grown = iter([0, 0])
    memory = Memory(own=lambda: next(grown, 1 << 40), available=lambda: 1 << 30)
    with pytest.raises(ArtifactError, match=r"opening the graphs: took 1048576 MiB of memory, its limit is 921 MiB"):
        open_proven(artifacts, guard=StartGuard(artifacts, memory=memory, end=lambda line: None))
