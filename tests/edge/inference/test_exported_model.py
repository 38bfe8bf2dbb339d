"""The exported model, run as the robot runs it, says what PyTorch says."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnxruntime as ort
import pytest
import torch
from tokenizers import Tokenizer

from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import Artifacts
from edge.core.geometry import SE2
from edge.inference.graph import Graph
from edge.inference.language import LanguageModel
from edge.inference.policy import Policy
from edge.state.ring import EncodedFrame
from export.evaluation.gates import gate_provider
from export.model.config import PRESETS
from export.model.network import build

NANO = PRESETS["nano"]


@pytest.mark.slow
def test_the_exported_model_generates_the_same_text_as_pytorch(artifacts: Artifacts) -> None:
    """Greedy decoding over the runner's own prompt, segments and cache, against one uncached PyTorch pass a token."""
    model = build(NANO, 0)
    policy, language = Policy(artifacts), LanguageModel(artifacts)
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (2, 1, 128, 128, 3)).astype(np.uint8)
    frames = [EncodedFrame(i, SE2(float(i), 0, 0), policy.encode(image)) for i, image in enumerate(images)]
    segments = language.prompt.build(frames, "go to the bench")
    found = language.generate(segments, max_new_tokens=12, cancelled=lambda: False)

    ids = [i for segment in segments for i in segment.ids]
    tokens = torch.cat([torch.from_numpy(f.tokens) for f in frames])
    c = NANO.language
    new: list[int] = []
    with torch.no_grad():
        while len(new) < 12:
            past = [torch.zeros(1, c.kv_heads, 0, c.head_dim) for _ in range(2 * c.layers)]
            chosen, _, kv, *_ = model.language(torch.tensor([ids + new]), tokens, past)
            token = int(chosen[0, -1])
            if token == c.im_end_id:
                break
            new.append(token)
    assert found.token_ids == tuple(new)
    tokenizer = Tokenizer.from_buffer(artifacts.contents["tokenizer.json"])
    assert found.text == tokenizer.decode(new, skip_special_tokens=True)
    full = found.last_layer_kv
    assert full.shape == (1, len(ids) + len(new), NANO.kv_dim)
    assert np.allclose(full[:, : kv.shape[1]], kv.numpy()[:, : full.shape[1]], atol=1e-3)


def test_a_provider_that_does_not_load_is_refused_and_not_silently_the_cpu(
    artifacts: Artifacts, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ort, "get_available_providers", lambda: ["CUDAExecutionProvider", "CPUExecutionProvider"])
    with (
        pytest.warns(UserWarning, match="not in available provider names"),
        pytest.raises(ArtifactError, match="on CPUExecutionProvider instead of CUDAExecutionProvider"),
    ):
        Graph(artifacts, "action_expert", threads=1, provider="CUDAExecutionProvider")


def test_openvino_gets_the_graphs_threads_and_leaves_no_node_to_another_provider(
    artifacts: Artifacts, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[str, dict[str, str], str]] = []

    def open_session(_model: bytes, *, sess_options: ort.SessionOptions, providers: list[Any]) -> None:
        (name, options), key = providers[0], "session.disable_cpu_ep_fallback"
        seen.append((name, options, sess_options.get_session_config_entry(key)))
        raise RuntimeError("not here")

    monkeypatch.setattr(ort, "get_available_providers", lambda: ["OpenVINOExecutionProvider"])
    monkeypatch.setattr(ort, "InferenceSession", open_session)
    with pytest.raises(ArtifactError, match="not here"):
        Graph(artifacts, "action_expert", threads=2, provider="OpenVINOExecutionProvider")
    assert seen == [("OpenVINOExecutionProvider", {"num_of_threads": "2"}, "1")]


def test_openvino_is_refused_on_a_machine_without_it(artifacts: Artifacts) -> None:
    with pytest.raises(ArtifactError, match="made for OpenVINOExecutionProvider, this ONNX Runtime has"):
        Graph(artifacts, "action_expert", provider="OpenVINOExecutionProvider")


def test_the_gate_runs_on_the_cpu_where_the_shipping_provider_does_not_load(monkeypatch: pytest.MonkeyPatch) -> None:
    assert gate_provider("CPUExecutionProvider") == "CPUExecutionProvider"
    assert gate_provider("TensorrtExecutionProvider") == "CPUExecutionProvider"
    monkeypatch.setattr(ort, "get_available_providers", lambda: ["ListedExecutionProvider", "CPUExecutionProvider"])
    with pytest.warns(UserWarning, match="not in available provider names"):
        assert gate_provider("ListedExecutionProvider") == "CPUExecutionProvider"
