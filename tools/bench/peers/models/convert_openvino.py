"""Writes OpenVINO's models: encoder, action expert (fp32, NNCF int8), stateful decoder (int8, int4 weights)."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import nncf
import numpy as np
import openvino as ov
import torch
from openvino._offline_transformations import apply_make_stateful_transformation
from openvino_tokenizers import convert_tokenizer
from safetensors import safe_open
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 - torch's own idiom
from transformers import AutoTokenizer

from export.model.config import LanguageConfig
from tools.bench.peers.models.reference import load_action, load_vision, qwen_name
from tools.bench.peers.workload import Workload

CALIBRATION_FRAMES = 4


class QwenLayer(nn.Module):
    """Qwen2 layer in the form that OpenVINO's fusions (rotary embedding, stateful attention) recognise."""

    def __init__(self, c: LanguageConfig) -> None:
        super().__init__()
        self.c = c
        self.q = nn.Linear(c.hidden, c.heads * c.head_dim)
        self.k = nn.Linear(c.hidden, c.kv_heads * c.head_dim)
        self.v = nn.Linear(c.hidden, c.kv_heads * c.head_dim)
        self.o = nn.Linear(c.heads * c.head_dim, c.hidden, bias=False)
        self.gate = nn.Linear(c.hidden, c.mlp, bias=False)
        self.up = nn.Linear(c.hidden, c.mlp, bias=False)
        self.down = nn.Linear(c.mlp, c.hidden, bias=False)
        self.input_norm = nn.Parameter(torch.ones(c.hidden))
        self.mlp_norm = nn.Parameter(torch.ones(c.hidden))

    def _norm(self, x: Tensor, weight: Tensor) -> Tensor:
        return weight * (x * torch.rsqrt(x.pow(2).mean(-1, keepdim=True) + self.c.rms_eps))

    def _rotate(self, x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
        # The plugin's RoPE fusion recognises this form (checked in its runtime graph).
        half = self.c.head_dim // 2
        first, second = torch.split(x, [half, half], dim=-1)
        c, s = cos[..., :half], sin[..., :half]
        return torch.cat([first * c - second * s, second * c + first * s], dim=-1)

    def _all_heads(self, x: Tensor) -> Tensor:
        c = self.c
        groups = c.heads // c.kv_heads
        n, t = x.shape[0], x.shape[2]
        spread = x[:, :, None].expand(n, c.kv_heads, groups, t, c.head_dim)
        return spread.reshape(n, c.heads, t, c.head_dim)

    def forward(
        self, x: Tensor, cos: Tensor, sin: Tensor, mask: Tensor, past_k: Tensor, past_v: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Compute hidden states and the extended keys and values."""
        c = self.c
        n, t = x.shape[0], x.shape[1]
        h = self._norm(x, self.input_norm)
        q = self._rotate(self.q(h).reshape(n, t, c.heads, c.head_dim).transpose(1, 2), cos, sin)
        k = self._rotate(self.k(h).reshape(n, t, c.kv_heads, c.head_dim).transpose(1, 2), cos, sin)
        v = self.v(h).reshape(n, t, c.kv_heads, c.head_dim).transpose(1, 2)
        k, v = torch.cat([past_k, k], dim=2), torch.cat([past_v, v], dim=2)
        attended = F.scaled_dot_product_attention(q, self._all_heads(k), self._all_heads(v), attn_mask=mask)
        x = x + self.o(attended.transpose(1, 2).reshape(n, t, c.heads * c.head_dim))
        h = self._norm(x, self.mlp_norm)
        return x + self.down(F.silu(self.gate(h)) * self.up(h)), k, v


class Qwen(nn.Module):
    """The decoder as OpenVINO GenAI expects it: ids, mask, positions and beams in, logits of the last token out."""

    inv_freq: Tensor

    def __init__(self, c: LanguageConfig) -> None:
        super().__init__()
        self.c = c
        self.embed = nn.Embedding(c.vocab, c.hidden)
        self.layers = nn.ModuleList(QwenLayer(c) for _ in range(c.layers))
        self.norm = nn.Parameter(torch.ones(c.hidden))
        self.lm_head = nn.Linear(c.hidden, c.vocab, bias=False)
        inv_freq = c.rope_theta ** (-torch.arange(0, c.head_dim, 2).float() / c.head_dim)
        self.register_buffer("inv_freq", inv_freq[None, :, None], persistent=False)

    def forward(
        self, input_ids: Tensor, attention_mask: Tensor, position_ids: Tensor, beam_idx: Tensor, past: list[Tensor]
    ) -> tuple[Tensor, ...]:
        """Compute logits [n, 1, vocab] and the extended caches."""
        x = self.embed(input_ids)
        angle = (self.inv_freq @ position_ids[:, None, :].float()).transpose(1, 2)
        angle = torch.cat([angle, angle], dim=-1)
        cos, sin = angle.cos()[:, None], angle.sin()[:, None]
        reach = torch.arange(attention_mask.shape[1])[None, None, None, :]
        mask = (reach <= position_ids[:, None, :, None]) & (attention_mask[:, None, None, :] > 0)
        present: list[Tensor] = []
        for i, layer in enumerate(self.layers):
            past_k, past_v = (past[2 * i + j].index_select(0, beam_idx) for j in (0, 1))
            x, k, v = layer(x, cos, sin, mask, past_k, past_v)
            present += [k, v]
        x = x[:, -1:]
        x = self.norm * (x * torch.rsqrt(x.pow(2).mean(-1, keepdim=True) + self.c.rms_eps))
        return self.lm_head(x), *present


def language_model(workload: Workload, reference: Path) -> ov.Model:
    """Convert the stateful decoder in fp32."""
    c = workload.config.language
    with torch.device("meta"):
        model = Qwen(c)
    with safe_open(str(reference / "language" / "model.safetensors"), framework="pt") as file:
        tensors = {}
        for name in model.state_dict():  # a norm's parameter belongs to no module here
            whole = name if name.endswith((".weight", ".bias")) else f"{name}.weight"
            tensors[name] = file.get_tensor(qwen_name(whole))
    model.load_state_dict(tensors, assign=True)
    inv_freq = c.rope_theta ** (-torch.arange(0, c.head_dim, 2).float() / c.head_dim)
    model.inv_freq = inv_freq[None, :, None]
    model.eval().requires_grad_(False)
    past = [torch.zeros(1, c.kv_heads, 3, c.head_dim) for _ in range(2 * c.layers)]
    example = (
        torch.zeros(1, 5, dtype=torch.long),
        torch.ones(1, 8, dtype=torch.long),
        torch.arange(3, 8)[None],
        torch.zeros(1, dtype=torch.int32),
        past,
    )
    converted = ov.convert_model(model, example_input=example)
    names = ["input_ids", "attention_mask", "position_ids", "beam_idx"]
    caches = [f"past_key_values.{i}.{kind}" for i in range(c.layers) for kind in ("key", "value")]
    shapes = [[-1, -1], [-1, -1], [-1, -1], [-1]] + [[-1, c.kv_heads, -1, c.head_dim]] * len(caches)
    for port, name, shape in zip(converted.inputs, names + caches, shapes, strict=True):
        port.get_tensor().set_names({name})
        port.get_node().set_partial_shape(ov.PartialShape(shape))
        port.get_node().set_friendly_name(name)
    presents = [name.replace("past_key_values", "present") for name in caches]
    for port, name in zip(converted.outputs, ["logits", *presents], strict=True):
        port.get_tensor().set_names({name})
    converted.inputs[3].get_node().set_element_type(ov.Type.i32)
    converted.validate_nodes_and_infer_types()
    apply_make_stateful_transformation(converted, dict(zip(caches, presents, strict=True)))
    _reset_caches_to_batch(converted, c)
    return converted


def _reset_caches_to_batch(model: ov.Model, c: LanguageConfig) -> None:
    """Initialise the caches empty with the batch size of the ids, as the fused attention requires."""
    from openvino import opset13 as ops

    ids = model.input("input_ids")
    batch = ops.gather(ops.shape_of(ids, output_type="i64"), ops.constant([0]), ops.constant(0))
    dims = [np.array([v], dtype=np.int64) for v in (c.kv_heads, 0, c.head_dim)]
    shape = ops.concat([batch, *(ops.constant(d) for d in dims)], axis=0)
    for op in model.get_ops():
        if op.get_type_name() == "ReadValue":
            op.set_arguments([ops.broadcast(ops.constant(0.0, dtype=np.float32), shape)])
    model.validate_nodes_and_infer_types()


def write_language(workload: Workload, reference: Path, folder: Path, kind: str) -> None:
    """Write the decoder with `int8` (per channel) or `int4` weights (blocks of 128, the head's too: its fastest)."""
    model = language_model(workload, reference)
    if kind == "int8":
        model = nncf.compress_weights(model, mode=nncf.CompressWeightsMode.INT8_SYM)
    else:
        c = workload.config.language
        group = 128 if c.hidden % 128 == c.mlp % 128 == 0 else 16
        mode = nncf.CompressWeightsMode.INT4_SYM
        model = nncf.compress_weights(model, mode=mode, ratio=1.0, group_size=group, all_layers=True)
    _save(model, folder)
    _add_genai_files(reference / "language", folder)


def _add_genai_files(source: Path, folder: Path) -> None:
    """Add the tokenizer's models and the checkpoint's configuration, which OpenVINO GenAI requires."""
    tokenizer = AutoTokenizer.from_pretrained(source)
    models = convert_tokenizer(tokenizer, with_detokenizer=True)
    for name, model in zip(("openvino_tokenizer", "openvino_detokenizer"), models, strict=True):
        ov.save_model(model, str(folder / f"{name}.xml"))
    for name in ("config.json", "generation_config.json"):
        shutil.copy(source / name, folder / name)


def write_encoder(workload: Workload, reference: Path, folder: Path, kind: str) -> None:
    """Write the encoder in `fp32` or NNCF `int8`, calibrated on the benchmark's frames."""
    frames = [workload.frame(i) for i in range(CALIBRATION_FRAMES)]
    with torch.no_grad():
        model = ov.convert_model(load_vision(workload.config, reference), example_input=torch.from_numpy(frames[0]))
    model.reshape(list(frames[0].shape))
    _save(_int8(model, frames) if kind == "int8" else model, folder)


def write_action(workload: Workload, reference: Path, folder: Path, kind: str) -> None:
    """Write the unsplit action expert in `fp32` or NNCF `int8`."""
    inputs = tuple(workload.action_inputs().values())
    with torch.no_grad():
        example = tuple(torch.from_numpy(x) for x in inputs)
        model = ov.convert_model(load_action(workload.config, reference), example_input=example)
    model.reshape({port: list(x.shape) for port, x in zip(model.inputs, inputs, strict=True)})
    _save(_int8(model, [dict(enumerate(inputs))]) if kind == "int8" else model, folder)


def _int8(model: ov.Model, samples: list[Any]) -> ov.Model:
    return nncf.quantize(model, nncf.Dataset(samples), model_type=nncf.ModelType.TRANSFORMER, subset_size=len(samples))


def _save(model: ov.Model, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    ov.save_model(model, str(folder / "openvino_model.xml"), compress_to_fp16=False)
